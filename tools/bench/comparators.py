"""One table of all methods: accuracy, what an event costs, what a whole sample costs, how many features.

Lives here: accuracies of a result of `streamfeat evaluate`, beside updates that are timed now, method by
method in turns.
Not here: the methods (`streamfeat.evaluate`), and how updates are timed (`streamfeat.latency`).

    streamfeat evaluate ncars.mcap --method direct --method hats --method dart -o result.json
    python -m tools.bench.comparators ncars.mcap result.json --json table.json

Filters of `direct`, `inverse`, `kmeans` and `random` are learned again in the setting of the result, in two
iterations: which filters they are hardly changes what an update costs. EST has no update: its network reads a
whole sample, and what that took in the result is the column beside.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT))

import streamfeat as sf  # noqa: E402
from streamfeat.evaluate.methods import make_features  # noqa: E402
from streamfeat.evaluate.plan import Trial  # noqa: E402
from streamfeat.evaluate.run import read_result  # noqa: E402
from streamfeat.latency.histogram import Latencies  # noqa: E402
from streamfeat.latency.others import TIMED, Method, walk_method  # noqa: E402
from streamfeat.latency.update import walk  # noqa: E402
from streamfeat.recordings.reader import Packet  # noqa: E402
from tools.bench.machine import describe  # noqa: E402

__all__ = ["measure", "table"]

Walker = Callable[[], NDArray[np.int64]]

_COLUMNS = (
    "method",
    "accuracy",
    "95 %",
    "p50, us",
    "p99, us",
    "p99.9, us",
    "events/s",
    "a sample, ms",
    "features",
)


def measure(recording: Path, result: dict[str, Any], *, events: int, rounds: int) -> list[dict[str, Any]]:
    """A row for each method of the result, in its order.

    Args:
        recording: labelled MCAP file to take events from.
        result: as from `evaluate -o`; rows of sweeps are left out.
        events: of its beginning, in each round.
        rounds: methods take turns, so often.
    """
    rows = [row for row in result["rows"] if not row["swept"]]
    with sf.open_recording(recording) as opened:
        items = _beginning(opened.items(), events)
    walkers = {row["method"]: _walker(recording, row, items) for row in rows}
    taken: dict[str, list[NDArray[np.int64]]] = {method: [] for method in walkers}
    for _ in range(rounds):
        for method, walker in walkers.items():
            if walker:
                taken[method].append(walker())
    samples = sum(result["samples"].values())
    found = []
    for row in rows:
        ns = taken[row["method"]]
        one = {name: row[name] for name in ("method", "accuracy", "low", "high", "features")}
        one["sample_ms"] = round(1e3 * row["encode_s"] / samples, 3)
        one["update"] = Latencies(np.concatenate(ns)).figures() if ns else None
        one["events_per_s"] = round(1e9 / float(np.concatenate(ns).mean())) if ns else None
        found.append(one)
    return found


def _beginning(items: Any, events: int) -> list[Any]:
    """Labels and packets until there are enough events."""
    kept: list[Any] = []
    for item in items:
        kept.append(item)
        if isinstance(item, Packet):
            events -= len(item.events)
            if events <= 0:
                break
    return kept


def _walker(recording: Path, row: dict[str, Any], items: Sequence[Any]) -> Walker | None:
    """What times every event of the items with a method; None where it has no update."""
    method = row["method"]
    if method in TIMED:
        timed = Method(method)
        return lambda: walk_method(timed, items, warm_up=500, goes=lambda done: True)
    if method == "est":
        return None
    known = {field.name for field in fields(Trial)}
    setting = Trial(**{name: value for name, value in row["setting"].items() if name in known})
    if method == "inverse":
        setting = replace(setting, formulation="inverse")
    setting = replace(setting, iterations=min(setting.iterations, 2))
    with sf.open_recording(recording) as opened:
        encoder = make_features(method, [opened], setting, lambda *step: None)
    assert isinstance(encoder, sf.Encoder)
    return lambda: walk(encoder, items, look_ahead=True, warm_up=500).ns


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows in Markdown."""
    lines = [f"| {' | '.join(_COLUMNS)} |", "|---|" + "---:|" * (len(_COLUMNS) - 1)]
    for row in rows:
        update = row["update"] or {}
        found = [update.get(name) for name in ("p50_ns", "p99_ns", "p99.9_ns")]
        times = ["-" if ns is None else f"{ns / 1e3:,.2f}" for ns in found]
        rate = f"{row['events_per_s']:,}" if update else "-"
        cells = [
            f"`{row['method']}`",
            f"{row['accuracy']:.3f}",
            f"{row['low']:.3f} to {row['high']:.3f}",
            *times,
            rate,
            f"{row['sample_ms']:.1f}",
            f"{row['features']:,}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("recording", type=Path, help="MCAP file to take events from")
    add("result", type=Path, help="of `streamfeat evaluate -o`")
    add("--events", type=int, default=20_000, help="in each round (default: %(default)s)")
    add("--rounds", type=int, default=3, help="in which methods take turns (default: %(default)s)")
    add("--json", type=Path, help="write the figures, too")
    given = parser.parse_args(arguments)
    try:
        result = read_result(given.result)
        with threadpool_limits(1):
            rows = measure(given.recording, result, events=given.events, rounds=given.rounds)
    except sf.InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(table(rows))
    load = round(os.getloadavg()[0], 1)
    print(f"\nload {load}; the columns of accuracy, samples and features are those of {given.result.name}")
    if given.json:
        said = {"rows": rows, "load": load, "machine": describe(None)}
        given.json.write_text(json.dumps(said, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
