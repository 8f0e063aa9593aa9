"""Measure live topics: latency against a bare zenoh echo, rates, and what happens when something breaks.

python tools/live_bench latency rate router -m model.safetensors -r ncars.mcap
python tools/live_bench all -m model.safetensors -r ncars.mcap --seconds 60
"""

import argparse
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT))

from tools.live_bench import faults  # noqa: E402
from tools.live_bench.latency import measure_latency  # noqa: E402
from tools.live_bench.rates import measure_rate  # noqa: E402
from tools.live_bench.shards import measure_shards  # noqa: E402
from tools.live_bench.workers import CASES, measure_workers, table  # noqa: E402

MEASUREMENTS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "latency": measure_latency,
    "rate": measure_rate,
    "shards": measure_shards,
    "publisher": faults.publisher_killed,
    "router": faults.router_killed,
    "stopped": faults.subscriber_stopped,
    "cut": faults.network_cut,
    "workers": measure_workers,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("what", nargs="+", choices=[*MEASUREMENTS, "all"])
    add("-m", "--model", type=Path, required=True)
    add("-r", "--recording", type=Path, required=True, help="labelled samples, shown by the camera")
    add("--seconds", type=float, default=10.0, help="of latency and rate (default: %(default)s)")
    add("--cut", type=float, default=5.0, help="seconds of SIGSTOP, and of the cut (default: %(default)s)")
    add("--first-rate", type=float, default=500_000, help="events a second (default: %(default)s)")
    add("--rounds", type=int, default=3, help="of each case of workers (default: %(default)s)")
    add("--cases", nargs="+", choices=list(CASES), help="of workers (default: all)")
    add("--json", action="store_true", help="workers too as JSON, with every round, instead of a table")
    add("--port", type=int, default=17470, help="and the ones after it (default: %(default)s)")
    arguments = parser.parse_args()
    load = os.getloadavg()[0]
    print(json.dumps({"cores": os.cpu_count(), "load before": load, "python": sys.version.split()[0]}))
    for name in MEASUREMENTS if "all" in arguments.what else arguments.what:
        arguments.port += 10
        result = MEASUREMENTS[name](arguments)
        shown = table(result) if name == "workers" and not arguments.json else json.dumps({name: result})
        print(shown, flush=True)


if __name__ == "__main__":
    main()
