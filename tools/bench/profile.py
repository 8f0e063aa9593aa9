"""Where the time of an emission goes, before and now, and how it grows: tables and a picture.

    python -m tools.bench.profile ../streamfeat-before --samples ../shared/data/samples --recording ncars.mcap

Emissions every 10 ms of five cameras, K = 400: the share of a bin boundary (volumes that enter the plane), of
renewing volumes whose entries changed, and of the rest (feeding, marking, settling). Then the processor time
of a second of stream against rate, K, stride and resolution. Both versions take turns.

Lives here: the table, the curves. Not here: goals (`goals`), streams, the kernels' steps (`tree_worker`).
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tools.bench.camera_streams import CAMERAS, at_rate
from tools.bench.goals import RATES, Bench
from tools.bench.pictures import draw_curves
from tools.bench.trees import ROOT, Tree, compared

__all__ = ["main"]

PROFILED = ("DAVIS", "DAVIS, stride 2", "VGA", "HD", "N-CARS", "HD, downsample 4")

STEPS = {
    "bin boundary": ("boundary",),
    "renewing dirty volumes": ("renewing",),
    "feeding, marking, settling": ("feed", "marking"),
}

Point = tuple[float, dict[str, Any]]
"""A value of what is varied, and the task that has it."""


def profiles(bench: Bench) -> Iterator[list[str]]:
    """A row for each camera: milliseconds of an emission and the share of each step, before and now."""
    for name in PROFILED:
        task = bench.camera(CAMERAS[name]) | {"steps": True}
        found = compared(bench.trees, bench.rounds, {"before": task, "now": task})
        row = [name]
        spent = {
            version: {
                step: float(np.median([_milliseconds(result, parts) for result in results]))
                for step, parts in STEPS.items()
            }
            for version, results in found.items()
        }
        for version in ("before", "now"):
            total = sum(spent[version].values())
            row.append(f"{total:.2f} ms")
            row += [f"{100 * spent[version][step] / total:.0f} %" for step in STEPS]
        row.append(f"{sum(spent['before'].values()) / sum(spent['now'].values()):.2f}x")
        yield row


def curves(bench: Bench) -> dict[str, list[tuple[float, float, float]]]:
    """For each quantity: its value, and milliseconds of an emission before and now."""
    found: dict[str, list[tuple[float, float, float]]] = {}
    for quantity, points in _points(bench).items():
        for value, task in points:
            results = compared(bench.trees, bench.rounds, {"before": task, "now": task})
            before, now = (
                float(np.median([_milliseconds(r, ("feed", "features")) for r in results[version]]))
                for version in ("before", "now")
            )
            found.setdefault(quantity, []).append((value, before, now))
            print(f"{quantity} {value:g}: {before:.2f} ms, {now:.2f} ms", file=sys.stderr, flush=True)
    return found


def _points(bench: Bench) -> dict[str, list[Point]]:
    davis = CAMERAS["DAVIS"]
    rates: list[Point] = []
    for rate in RATES:
        path = bench.folder / f"rate-{rate:g}.npz"
        at_rate(bench.samples, rate, 30).save(path)
        rates.append((rate / 1e6, bench.camera(davis) | {"stream": path}))
    cropped = [
        replace(davis, name=f"{width}x{height}", resolution=(height, width))
        for width, height in ((80, 60), (160, 120), (240, 180), (346, 260))
    ]
    return {
        "million events/s, 346x260": rates,
        "filters K, 346x260": [(k, bench.camera(davis, k)) for k in (100, 400, 1700)],
        "stride, 346x260": [
            (stride, bench.camera(replace(davis, name=f"stride {stride}", stride=stride)))
            for stride in (2, 4, 6, 12)
        ],
        "pixels, cut out of 346x260": [
            (crop.resolution[0] * crop.resolution[1], bench.camera(crop)) for crop in cropped
        ],
    }


def _milliseconds(result: dict[str, Any], parts: tuple[str, ...]) -> float:
    seconds = sum(result[part]["processor"] for part in parts if part in result)
    return float(1e3 * seconds / result["emissions"])


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench.profile",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("before", type=Path, help="checkout of the version to compare with")
    parser.add_argument("--samples", type=Path, required=True, help="folder of the camera samples")
    parser.add_argument("--recording", type=Path, required=True, help="labelled crops, N-CARS")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--emissions", type=int, default=40, help="of each stream (default: %(default)s)")
    parser.add_argument("--picture", type=Path, default=Path(__file__).with_name("curves.svg"))
    parser.add_argument("--only", choices=("profiles", "curves"), help="one of the two")
    options = parser.parse_args(arguments)
    trees = {"before": Tree(options.before, anew=True), "now": Tree(ROOT, anew=True)}
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(
            trees, options.samples, options.recording, Path(folder), options.rounds, options.emissions
        )
        try:
            if options.only != "curves":
                _print_profiles(bench)
            if options.only != "profiles":
                _print_curves(bench, options.picture)
        finally:
            for tree in trees.values():
                tree.close()
    return 0


def _print_profiles(bench: Bench) -> None:
    print(f"load of the machine {os.getloadavg()[0]:.1f}\n")
    steps = [f"{version}: {step}" for version in ("before", "now") for step in ("an emission", *STEPS)]
    print(_line(["camera", *steps, "ratio"]))
    print(_line(["---", *["---:"] * (len(steps) + 1)]))
    for row in profiles(bench):
        print(_line(row), flush=True)


def _print_curves(bench: Bench, picture: Path) -> None:
    found = curves(bench)
    print(_line(["", "", "before", "now", "ratio"]))
    print(_line(["---", *["---:"] * 4]))
    for quantity, points in found.items():
        for value, before, now in points:
            print(
                _line([quantity, f"{value:g}", f"{before:.2f} ms", f"{now:.2f} ms", f"{before / now:.2f}x"])
            )
    draw_curves(found, picture)


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    sys.exit(main())
