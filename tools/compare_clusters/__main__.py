"""Compare Ray and Dask on the jobs that streamfeat has for a cluster, in turns, each run from nothing.

python tools/compare_clusters cost worker
python tools/compare_clusters all -r ncars.mcap -m model.safetensors --samples 1600 --rounds 3 --json out.json

`cost` starts a cluster of one and of two workers, has it run empty tasks, and does both jobs, which are done
in a process without an engine as well; `worker` and `node` kill while the jobs run; `serve`, `serve_own`,
`serve_node` and `cut` kill or cut off who serves four keys (`quick`: with short timeouts), `actor` kills an
actor of Dask; `install` makes an environment. Those with nodes need the right to make network namespaces.
BLAS has one thread in each process. `cores` is what two processes got that only count, before a run.
"""

import argparse
import json
import os
import secrets
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT))

from streamfeat.machine import Disturbance, describe_machine  # noqa: E402
from tools.compare_clusters import installed, live, nodes, offline, work  # noqa: E402
from tools.compare_clusters.engines import QUICK  # noqa: E402

MEASUREMENTS: dict[str, Callable[[str, argparse.Namespace], dict[str, Any]]] = {
    "install": installed.install,
    "cost": offline.cost,
    "worker": offline.worker_killed,
    "node": offline.node_killed,
    "serve": live.process_killed,
    "serve_own": live.own_process_killed,
    "serve_node": live.node_killed,
    "serve_node_quick": live.node_killed,
    "cut": live.node_cut_off,
    "cut_quick": live.node_cut_off,
    "actor": live.dask_actor_killed,
}
MODULES = {"ray": "ray", "dask": "distributed"}
_LIMIT_S = 600


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("what", nargs="+", choices=[*MEASUREMENTS, "all"])
    add("-r", "--recording", type=Path, default=ROOT / "recordings" / "digits_train.mcap")
    add("-m", "--model", type=Path, default=ROOT / "recordings" / "digits.safetensors")
    add("--engines", nargs="+", choices=list(MODULES), default=list(MODULES))
    add("--samples", type=int, default=800, help="labelled samples (default: %(default)s)")
    add("--each", type=int, default=100, help="of them in a task (default: %(default)s)")
    add("--rounds", type=int, default=1, help="of all engines in turn (default: %(default)s)")
    add("--json", type=Path, help="write every run there")
    add("--child", nargs=3, metavar=("ENGINE", "WORKERS", "FOLDER"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        _child(arguments)
        return
    engines = [name for name in arguments.engines if find_spec(MODULES[name])]
    if not engines:
        parser.error("none of the engines is installed: pip install ray distributed")
    with tempfile.TemporaryDirectory(prefix="clusters") as name:
        folder = Path(name)
        work.split_recording(arguments.recording, arguments.model, folder, arguments.samples, arguments.each)
        runs = _all_runs(arguments, engines, folder)
    report = {"machine": describe_machine(), "load": os.getloadavg()[0], "runs": runs}
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps(report["machine"]))
    _show(runs)


def _all_runs(arguments: argparse.Namespace, engines: list[str], folder: Path) -> list[dict[str, Any]]:
    runs = []
    for what in MEASUREMENTS if "all" in arguments.what else arguments.what:
        for number in range(arguments.rounds):
            cases = [(engine, 2) for engine in engines]
            if what == "cost":
                cases = [("none", 1), *((engine, n) for n in (1, 2) for engine in engines)]
            for engine, workers in cases:
                steal, cores = Disturbance(), _cores_given()
                found = _in_child(what, engine, workers, folder, arguments)
                run = {"what": what, "engine": engine, "workers": workers, "round": number} | found
                runs.append(run | {"cores": cores, "steal": round(steal.steal_share() or 0.0, 3)})
                print(json.dumps(runs[-1]), file=sys.stderr, flush=True)
    return runs


def _cores_given() -> float:
    """How many cores two processes that only count get: a shared machine may have fewer than it shows."""

    def seconds(n: int) -> float:
        began = time.perf_counter()
        counting = [sys.executable, "-S", "-c", "for i in range(15_000_000): pass"]
        for process in [subprocess.Popen(counting) for _ in range(n)]:
            process.wait(_LIMIT_S)
        return time.perf_counter() - began

    return round(2 * seconds(1) / seconds(2), 2)


def _in_child(
    what: str, engine: str, workers: int, parts: Path, arguments: argparse.Namespace
) -> dict[str, Any]:
    """One measurement in a process of its own, all of whose descendants end with it."""
    folder = parts / f"{what}-{engine}-{workers}"
    folder.mkdir()
    # Ray's folder holds sockets, whose paths may not be long.
    short = tempfile.mkdtemp(prefix="r")
    for path in (*parts.glob("*.mcap"), *parts.glob("*.npy")):
        (folder / path.name).hardlink_to(path)
    one = [f"{name}_NUM_THREADS" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")]
    environment = os.environ | dict.fromkeys(one, "1")
    # Its own token, or Ray writes one into the home folder; and no reports to its makers.
    environment |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    environment |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_TMPDIR": short}
    environment |= {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    environment |= QUICK if what.endswith("quick") else {}
    command = [sys.executable, "-m", "tools.compare_clusters", what, "-m", str(arguments.model.resolve())]
    command += ["--child", engine, str(workers), str(folder)]
    child = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, cwd=ROOT,
        start_new_session=True,
    )  # fmt: skip
    try:
        text, errors = child.communicate(timeout=_LIMIT_S)
    except subprocess.TimeoutExpired:
        return {"failed": f"not done after {_LIMIT_S} s"}
    finally:
        if child.poll() is None:
            os.killpg(child.pid, signal.SIGKILL)
            child.communicate()
        shutil.rmtree(folder, ignore_errors=True)
        shutil.rmtree(short, ignore_errors=True)
    if child.returncode or not text.strip():
        return {"failed": (errors.strip() or "no output").splitlines()[-1]}
    return json.loads(text.splitlines()[-1])


def _child(arguments: argparse.Namespace) -> None:
    engine, workers, folder = arguments.child
    arguments.workers, arguments.folder = int(workers), folder
    try:
        found = MEASUREMENTS[arguments.what[0]](engine, arguments)
    except nodes.NotHereError as why:
        found = {"skipped": str(why)}
    print(json.dumps(found), flush=True)


def _show(runs: list[dict[str, Any]]) -> None:
    """A table of medians: a line for each figure, a column for each engine."""
    cases = dict.fromkeys((run["what"], run["workers"]) for run in runs if run["engine"] != "none")
    columns = [name for name in ("none", *MODULES) if any(run["engine"] == name for run in runs)]
    print(f"{'':<28}" + "".join(f"{name:>24}" for name in columns))
    for what, workers in cases:
        mine = [run for run in runs if run["what"] == what and run["workers"] in (workers, 1)]
        mine = [run for run in mine if run["engine"] == "none" or run["workers"] == workers]
        known = {"what", "engine", "workers", "round"}
        for figure in dict.fromkeys(key for run in mine for key in run if key not in known):
            cells = [_middle([r[figure] for r in mine if r["engine"] == e and figure in r]) for e in columns]
            print(f"{what} {workers}: {figure:<20}"[:28].ljust(28) + "".join(f"{cell:>24}" for cell in cells))


def _middle(values: list[Any]) -> str:
    numbers = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
    if numbers and len(numbers) == len(values):
        spread = f" ({min(numbers):.3g}-{max(numbers):.3g})" if len(numbers) > 1 else ""
        return f"{statistics.median(numbers):.3g}{spread}"
    return ", ".join(dict.fromkeys(json.dumps(v) for v in values))[:60]


if __name__ == "__main__":
    main()
