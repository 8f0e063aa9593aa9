"""Timing on a machine that others use too.

Lives here: contestants that run in turns, rounds that are thrown away because the host took the processor,
medians and ratios of one round. Not here: what is measured.

Every round runs all contestants, each time in another order, so that a slow moment hits them alike; a ratio
is taken inside a round, and then the median over rounds. Each contestant runs once before, unmeasured, which
is where anything is compiled.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "PROCESS",
    "STOLEN_LIMIT",
    "THREAD",
    "WALL",
    "Clock",
    "Contestant",
    "Race",
    "race",
    "stolen_seconds",
    "summary",
]

STOLEN_LIMIT = 0.1
"""A round in which the host took more than this share of a processor is thrown away."""

Clock = Callable[[], int]

THREAD: Clock = time.thread_time_ns
PROCESS: Clock = time.process_time_ns
WALL: Clock = time.perf_counter_ns

_TICK = 0.01  # seconds, USER_HZ


@dataclass(frozen=True)
class Contestant:
    """Something to time: `units` things are done by a `run`; `after` is not timed.

    What runs in one thread is timed by that thread's processor time, which does not count moments in which
    other programs had the core. What runs in several takes the time on the wall, and a peer that may do so
    the processor time of the whole process.
    """

    run: Callable[[], object]
    units: float = 1.0
    after: Callable[[], object] | None = None
    clock: Clock = THREAD


@dataclass(frozen=True)
class Race:
    """Nanoseconds a unit of every contestant, `(rounds,)` each, in the rounds that were kept."""

    nanoseconds: dict[str, NDArray[np.float64]]
    discarded: int

    def figure(self, name: str) -> dict[str, float]:
        """Median and spread of one contestant."""
        return summary(self.nanoseconds[name])

    def ratio(self, name: str, to: str) -> dict[str, float]:
        """Time of one contestant over that of another in the same round."""
        return summary(self.nanoseconds[name] / self.nanoseconds[to])

    def figures(self) -> dict[str, Any]:
        """All contestants, and how many rounds there were."""
        rounds = len(next(iter(self.nanoseconds.values())))
        table: dict[str, Any] = {name: self.figure(name) for name in self.nanoseconds}
        return {"rounds": rounds, "discarded": self.discarded, "ns": table}

    def fastest(self, names: Sequence[str]) -> str:
        """The contestant with the lowest median."""
        return min(names, key=lambda name: float(np.median(self.nanoseconds[name])))


def summary(values: NDArray[np.float64]) -> dict[str, float]:
    """Median, 10th and 90th percentile."""
    p10, p50, p90 = (float(f"{value:.5g}") for value in np.percentile(values, [10, 50, 90]))
    return {"p50": p50, "p10": p10, "p90": p90}


def stolen_seconds() -> float:
    """Processor time that the host has taken so far, all processors together; 0 where nobody says."""
    try:
        first = Path("/proc/stat").read_text(encoding="ascii").partition("\n")[0].split()
    except OSError:
        return 0.0
    return int(first[8]) * _TICK if len(first) > 8 else 0.0


def race(contestants: dict[str, Contestant], rounds: int) -> Race:
    """Time contestants in turns.

    Args:
        contestants: by name.
        rounds: to keep; up to twice as many are run. Where the host takes so much that fewer than half
            are good, those with the least are kept.
    """
    names = list(contestants)
    for name in names:
        _time(contestants[name])
    rows, stolen = [], []
    while len(rows) < 2 * rounds and sum(share <= STOLEN_LIMIT for share in stolen) < rounds:
        before, start = stolen_seconds(), time.perf_counter()
        order = names[len(rows) % len(names) :] + names[: len(rows) % len(names)]
        taken = {name: _time(contestants[name]) for name in order}
        stolen.append((stolen_seconds() - before) / (time.perf_counter() - start))
        rows.append([taken[name] for name in names])
    table, shares = np.array(rows), np.array(stolen)
    kept = np.flatnonzero(shares <= STOLEN_LIMIT)
    if len(kept) < -(-rounds // 2):
        kept = np.sort(np.argsort(shares, kind="stable")[: -(-rounds // 2)])
    columns = {name: table[kept, i] for i, name in enumerate(names)}
    return Race(columns, len(rows) - len(kept))


def _time(contestant: Contestant) -> float:
    start = contestant.clock()
    contestant.run()
    taken = contestant.clock() - start
    if contestant.after:
        contestant.after()
    return taken / contestant.units
