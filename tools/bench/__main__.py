"""Measure streamfeat on this machine; write `results.json`, two pictures and the tables of the page.

    python tools/bench --recording ncars.mcap            # everything; takes long
    python tools/bench --only floors,ingest              # these parts; others stay as they were
    python tools/bench --quick --json /tmp/quick.json    # does everything run? (figures mean nothing)
    python tools/bench --readme                          # tables from results.json, nothing is measured
    python tools/bench --plan 100,0.1,400 --cores 16     # machines for 100 cameras of 0.1 Mev/s at K = 400

Peers come with `pip install -e '.[bench]'`; those that are missing are named, and left out.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT))

import streamfeat as sf  # noqa: E402
from streamfeat.events import Resolution  # noqa: E402
from tools.bench import machine, material, tables  # noqa: E402
from tools.bench.cameras import measure_cameras  # noqa: E402
from tools.bench.cluster import measure_cluster  # noqa: E402
from tools.bench.direct import measure_floors, measure_peers  # noqa: E402
from tools.bench.fleet_plan import plan  # noqa: E402
from tools.bench.floor import compiler  # noqa: E402
from tools.bench.growth import event_ns, measure_growth  # noqa: E402
from tools.bench.growth_streams import Load  # noqa: E402
from tools.bench.ingest import measure_ingest  # noqa: E402
from tools.bench.inverse import measure_inverse  # noqa: E402
from tools.bench.kernel_rows import measure_kernels  # noqa: E402
from tools.bench.latencies import measure_latency  # noqa: E402
from tools.bench.overload import measure_overload  # noqa: E402
from tools.bench.pictures import draw_growth, draw_scaling  # noqa: E402
from tools.bench.precision import measure_memory, measure_precision  # noqa: E402
from tools.bench.replays import measure_replay  # noqa: E402
from tools.bench.scaling import measure_scaling  # noqa: E402
from tools.bench.steps import measure_learning  # noqa: E402
from tools.bench.timing import stolen_seconds  # noqa: E402

PARTS: dict[str, tuple[Callable[..., dict[str, Any]], str]] = {
    "floors": (measure_floors, "our update against the same in C, and against its bytes"),
    "peers": (measure_peers, "against matrix products, FEAST and HATS"),
    "cameras": (
        measure_cameras,
        "emissions of 346x260 and 640x480, against conv2d of PyTorch and FEAST",
    ),
    "ingest": (measure_ingest, "counting events, against voxel grids"),
    "inverse": (measure_inverse, "the lasso, against scikit-learn and SPAMS"),
    "latency": (measure_latency, "percentiles of single events"),
    "precision": (measure_precision, "codes against float64"),
    "memory": (measure_memory, "bytes of an engine"),
    "replay": (measure_replay, "a whole replay against bare reading"),
    "learning": (measure_learning, "one online learning step"),
    "scaling": (measure_scaling, "cost against K, patch, bins and stride"),
    "kernels": (measure_kernels, "every kernel against its slow twin"),
    "overload": (measure_overload, "ten times what --emit event carries, under --emit auto"),
    "growth": (
        measure_growth,
        "cost of an event against K, stride, sensor, rate and cameras",
    ),
    "cluster": (measure_cluster, "learning and encoding on workers, some of them killed"),
}


def main(arguments: list[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    try:
        if options.plan:
            return _plan(options)
        return _rewrite_readme(options.json) if options.readme else _measure(options)
    except sf.InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python tools/bench",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="parts:\n" + "\n".join(f"  {name:<10} {text}" for name, (_, text) in PARTS.items()),
    )
    samples = Path(os.environ.get("STREAMFEAT_DATA", ROOT.parent / "shared" / "data")) / "samples"
    dense = samples / "eventpacket_libcaer_cmp_346x260.mcap"
    add = parser.add_argument
    add(
        "--recording",
        type=Path,
        default=ROOT / "recordings" / "digits_train.mcap",
        help="labelled MCAP file to take events from (default: %(default)s)",
    )
    add(
        "--dense",
        type=Path,
        default=dense if dense.exists() else None,
        help="a second recording for the part replay, of many events a second (default: %(default)s)",
    )
    add(
        "--samples",
        type=Path,
        default=samples if samples.exists() else None,
        help="folder of camera samples for the part cameras (default: %(default)s)",
    )
    add("--only", metavar="PARTS", help="comma-separated parts to measure")
    add("--quick", action="store_true", help="smallest sizes; figures mean nothing")
    add("--filters", type=int, help="K (default: 1700, or 64 with --quick)")
    add("--bins", type=int, default=7, help="time bins (default: %(default)s)")
    add(
        "--json",
        type=Path,
        default=Path(__file__).with_name("results.json"),
        help="file of results (default: %(default)s)",
    )
    add(
        "--models",
        type=Path,
        default=material.DEFAULT_MODELS,
        help="folder that keeps learned models for the next run (default: %(default)s)",
    )
    add("--readme", action="store_true", help="only write the tables of the page from the results")
    add(
        "--plan",
        type=_cameras,
        metavar="N,R,K",
        help="machines for N cameras of R Mev/s at K filters",
    )
    add("--emit", choices=("event", "10ms"), default="10ms", help="with --plan (default: %(default)s)")
    add("--stride", type=int, default=4, help="with --plan (default: %(default)s)")
    add("--resolution", type=_resolution, default=(480, 640), metavar="HxW", help="with --plan")
    add("--cores", type=int, default=os.cpu_count() or 1, help="with --plan: of a machine")
    return parser


def _measure(options: argparse.Namespace) -> int:
    wanted = options.only.split(",") if options.only else list(PARTS)
    unknown = [name for name in wanted if name not in PARTS]
    if unknown:
        raise sf.InputError(f"--only {','.join(unknown)} is not known; parts are {', '.join(PARTS)}")
    events = material.Material(options.recording)
    n_filters = options.filters or (64 if options.quick else 1700)
    models = options.models / "quick" if options.quick else options.models
    setting = material.Setting(events, options.quick, n_filters, options.bins, models, _say)
    print(f"recording {events.name}: {events.describe()['samples']} samples", file=sys.stderr)
    missing = [name for name in machine.PEERS if machine.version(name) == "missing"]
    if missing:
        print(f"not measured, because not installed: pip install {' '.join(missing)}", file=sys.stderr)
    results = _results_so_far(options.json)
    program = compiler()
    results["machine"] = machine.describe(machine.compiler_version(program) if program else None)
    results["setting"] = events.describe() | {"n_filters": n_filters, "n_bins": options.bins}
    for number, name in enumerate(wanted):
        start, stolen = time.perf_counter(), stolen_seconds()
        print(f"[{number + 1}/{len(wanted)}] {name}", file=sys.stderr)
        more = {"replay": (options.dense,), "cameras": (options.samples,)}.get(name, ())
        results["parts"][name] = PARTS[name][0](setting, *more)
        seconds = time.perf_counter() - start
        share = (stolen_seconds() - stolen) / seconds
        results["runs"][name] = {
            "recording": events.name,
            "seconds": round(seconds, 1),
            "stolen_share": round(share, 3),
            "load": round(os.getloadavg()[0], 1),
            "processor": results["machine"]["processor"],
        }
        options.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        _say(f"{seconds:.0f} s, the host took {100 * share:.0f} % of a processor")
    if "scaling" in wanted and "matplotlib" not in missing:
        draw_scaling(results["parts"]["scaling"], options.json.with_name("scaling.svg"))
    if "growth" in wanted and "matplotlib" not in missing:
        draw_growth(results["parts"]["growth"], options.json.with_name("growth.svg"))
    print("\n".join(tables.verdict_lines(results)))
    return 0


def _results_so_far(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return {"parts": {}, "runs": {}} | found


def _rewrite_readme(path: Path) -> int:
    if not path.exists():
        raise sf.InputError(f"{path}: there are no results yet; run python tools/bench first")
    readme = Path(__file__).with_name("README.md")
    results = json.loads(path.read_text(encoding="utf-8"))
    readme.write_text(tables.insert(readme.read_text(encoding="utf-8"), results), encoding="utf-8")
    return 0


def _cameras(text: str) -> tuple[int, int, int]:
    n, rate, filters = text.split(",")
    return int(n), round(float(rate) * 1e6), int(filters)


def _resolution(text: str) -> Resolution:
    height, width = map(int, text.split("x"))
    return height, width


def _plan(options: argparse.Namespace) -> int:
    """Machines for so many cameras, by what an event takes here."""
    n, rate, filters = options.plan
    load = Load(options.emit, filters, options.stride, options.resolution, rate=rate)
    ns = event_ns(material.Material(options.recording), load)
    print(json.dumps(plan(ns, load, n, options.cores), indent=1))
    return 0


def _say(text: str) -> None:
    print(f"    {text}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
