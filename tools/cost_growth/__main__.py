"""How the cost of events grows with filters, stride, resolution, rate, cameras and processes.

python tools/cost_growth -r ncars.mcap --json growth.json --plot growth.svg
python tools/cost_growth -r ncars.mcap --plan 100,0.1,400 --resolution 480x640 --cores 8

Every setting is measured on a stream of the recording's samples, put down at random places of a sensor until
there are as many events a second as asked for, and predicted from what the kernels have to do and from two
constants of this machine, which are fitted to four of the settings. Settings take turns, times are medians
and of the processor alone. `--plan N,R,K` says how many machines N cameras of R Mev/s at K filters need.
"""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT))

from streamfeat.errors import InputError  # noqa: E402
from streamfeat.events import Resolution  # noqa: E402
from tools.bench.material import Material  # noqa: E402
from tools.cost_growth.fleet import measure_fleet  # noqa: E402
from tools.cost_growth.measure import measure, measure_processes  # noqa: E402
from tools.cost_growth.model import Constants  # noqa: E402
from tools.cost_growth.plan import PACKET_US, plan  # noqa: E402
from tools.cost_growth.show import draw, table  # noqa: E402
from tools.cost_growth.streams import FIT, Setting, sweeps  # noqa: E402


def resolution(text: str) -> Resolution:
    height, width = map(int, text.split("x"))
    return height, width


def cameras(text: str) -> tuple[int, int, int]:
    n, rate, filters = text.split(",")
    return int(n), round(float(rate) * 1e6), int(filters)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("-r", "--recording", type=Path, default=ROOT / "recordings" / "digits_train.mcap")
    add("--rounds", type=int, default=9, help="of which medians are taken (default: %(default)s)")
    add("--events", type=int, default=20_000, help="of a round and camera (default: %(default)s)")
    add("--quick", action="store_true", help="few settings and no tails, to see that all runs")
    add("--seconds", type=float, default=5.0, help="of each number of processes (default: %(default)s)")
    add("--json", type=Path, metavar="FILE", help="write the figures")
    add("--plot", type=Path, metavar="FILE", help="draw .svg or .png; extra `plot`")
    add("--plan", type=cameras, metavar="N,R,K", help="machines for N cameras of R Mev/s at K filters")
    add("--constants", type=Path, metavar="FILE", help="with --plan: take them from an earlier --json")
    add("--emit", choices=("event", "10ms"), default="10ms", help="with --plan (default: %(default)s)")
    add("--stride", type=int, default=4, help="with --plan (default: %(default)s)")
    add("--resolution", type=resolution, default=(480, 640), metavar="HxW", help="with --plan")
    add("--cores", type=int, default=os.cpu_count() or 1, help="with --plan: of a machine")
    add("--port", type=int, default=17470, help="where the listener is met (default: %(default)s)")
    arguments = parser.parse_args()
    try:
        report = _report(arguments)
    except InputError as error:
        raise SystemExit(str(error)) from None
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    if arguments.plot:
        draw(report, arguments.plot)


def _report(arguments: argparse.Namespace) -> dict[str, Any]:
    material = Material(arguments.recording)
    if arguments.plan and arguments.constants:
        report = json.loads(arguments.constants.read_text())
    else:
        settings = FIT if arguments.plan else sweeps(arguments.quick)
        tails = not (arguments.quick or arguments.plan)
        report = measure(material, settings, arguments.rounds, arguments.events, tails=tails)
        print(table(report))
        if not arguments.plan:
            report |= _together(arguments, material, Constants(**report["constants"]))
        print(json.dumps({name: report[name] for name in report if name != "rows"}, indent=1))
    if arguments.plan:
        n, rate, filters = arguments.plan
        setting = Setting(arguments.emit, filters, arguments.stride, arguments.resolution, rate=rate)
        packet_us = report.get("fleet", {}).get("packet_us", PACKET_US)
        constants = Constants(**report["constants"])
        report["plan"] = plan(constants, packet_us, material, setting, n, arguments.cores)
        print(json.dumps(report["plan"], indent=1))
    return report


def _together(arguments: argparse.Namespace, material: Material, constants: Constants) -> dict[str, Any]:
    """Processes beside each other, and cameras of one listener."""
    processes, cameras = ((1,), (1,)) if arguments.quick else ((1, 2), (1, 2, 4))
    seconds = min(arguments.seconds, 0.2) if arguments.quick else arguments.seconds
    camera, turns = Setting("10ms", rate=100_000), 1 if arguments.quick else 3
    return {
        "fleet": measure_fleet(material, camera, cameras, seconds, constants, arguments.port, turns),
        "processes": measure_processes(arguments.recording, Setting("10ms"), processes, seconds),
    }


if __name__ == "__main__":
    main()
