"""What the figures are held against: floors that physics or the work itself sets, with the reason of each.

Lives here: every bound and its reason, where its figure is found in the results, and whether it is met.
Not here: how figures are measured or shown; goals against an earlier version (`goals`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

__all__ = ["TARGETS", "Target", "Verdict", "judge"]

Found = float | dict[str, float] | None
"""A figure, with its spread if it has one; None where it was not measured."""


@dataclass(frozen=True)
class Target:
    """One figure, its bound, and in one line why the bound is where it is."""

    part: str
    figure: str
    bound: float
    at_most: bool
    unit: str
    why: str
    find: Callable[[dict[str, Any]], Found]

    @property
    def text(self) -> str:
        """The bound in words."""
        return f"{'at most' if self.at_most else 'at least'} {self.bound:g}{self.unit}"


@dataclass(frozen=True)
class Verdict:
    """A target with what was measured."""

    target: Target
    found: Found

    @property
    def value(self) -> float | None:
        """The median, or the figure itself."""
        return self.found["p50"] if isinstance(self.found, dict) else self.found

    @property
    def met(self) -> bool | None:
        """Whether the target is met; None where nothing was measured."""
        if self.value is None:
            return None
        return self.value <= self.target.bound if self.target.at_most else self.value >= self.target.bound


def judge(results: dict[str, Any]) -> list[Verdict]:
    """Every target with the figure found for it."""
    parts = results.get("parts", {})
    return [Verdict(target, _found(target, parts)) for target in TARGETS]


def _found(target: Target, parts: dict[str, Any]) -> Found:
    try:
        return target.find(parts[target.part])
    except (KeyError, TypeError, StopIteration):  # not measured, or a peer is missing
        return None


def _at(*keys: str) -> Callable[[dict[str, Any]], Found]:
    def find(part: Any) -> Found:
        for key in keys:
            part = part[key]
        found: Found = part
        return found

    return find


def _tail(percentile: str, which: str) -> Callable[[dict[str, Any]], Found]:
    def find(part: dict[str, Any]) -> Found:
        """As under `--emit event`, which looks ahead."""
        update = part["looking ahead"][which]
        return float(update[f"{percentile}_ns"] / update["p50_ns"])

    return find


def _pace(dense: bool) -> Callable[[dict[str, Any]], Found]:
    def find(part: dict[str, Any]) -> Found:
        names = list(part)
        if dense and len(names) < 2:
            return None
        found: Found = part[names[-1 if dense else 0]]["pace"]
        return found

    return find


def _allocations(part: dict[str, Any]) -> Found:
    return float(max(mode["allocations_in_1000_events"] for mode in part.values()))


_DIRECT = "direct, one volume an event, `soft`:"
_INVERSE = "inverse, an event and volume, gap 1e-4, penalty lambda0 ="

_PER_PENALTY = {
    "1": (
        (
            15,
            "the Gram matrix of some 370 atoms is read at least once: 84 us, and a peer takes 15 ms",
        ),
        (50, "the same rows; a batched solver reads them for many volumes at once, and still begins anew"),
    ),
    "2": (
        (90, "some 70 rows of the Gram matrix, and the gap is proven over all K atoms each time"),
        (20, "the same"),
    ),
    "4": (
        (300, "three atoms: what is left is one pass over K projections and the proof of the gap"),
        (8, "the same; SPAMS has nothing to begin anew with either"),
    ),
}
"""Bounds over lasso_cd and over SPAMS for each penalty, with their reasons."""

TARGETS = (
    Target(
        "floors",
        f"{_DIRECT} time over the floor in C",
        2,
        True,
        " x",
        "the C knows one volume and one encoding; the kernel asks which, and is handed forty arrays",
        _at("ours_over_floor"),
    ),
    Target(
        "floors",
        f"{_DIRECT} time over the bytes floor",
        3.5,
        True,
        " x",
        "bytes walked over alone; an update computes two codes a filter beside them",
        _at("bytes", "ours_over_bytes"),
    ),
    Target(
        "peers",
        f"{_DIRECT} faster than a matrix-vector product",
        300,
        False,
        " x",
        "d columns against one, and each as long",
        _at("over_ours", "matrix-vector product"),
    ),
    Target(
        "peers",
        f"{_DIRECT} faster than a batched matrix product, one thread",
        25,
        False,
        " x",
        "K d multiplications at the peak of a core over the bytes floor of ours leave less than 100",
        _at("over_ours", "batched matrix product, one thread"),
    ),
    Target(
        "peers",
        f"{_DIRECT} faster than FEAST of eventcv, 256 features",
        25,
        False,
        " x",
        "its time over the bytes floor of ours, for 1,700 filters where it has 256",
        _at("over_ours", "FEAST of eventcv, 256 features"),
    ),
    Target(
        "precision",
        "codes against float64, relative to the largest",
        2e-3,
        True,
        "",
        "integers of 16 bits round each entry of a filter, and predictions are the same to this",
        _at("relative"),
    ),
    Target(
        "latency",
        "update, stride 4, bin boundaries included: p99 over p50",
        4,
        True,
        " x",
        "an event changes one volume or nine, and the next bin is prepared beside it",
        _tail("p99", "as they came"),
    ),
    Target(
        "latency",
        "the same, each event's median of several runs: p99.9 over p50",
        8,
        True,
        " x",
        "one event in six hundred begins a bin; in a single run the system's interrupts are among these",
        _tail("p99.9", "update"),
    ),
    *(
        Target(
            "inverse",
            f"{_INVERSE} {penalty}: faster than {name}",
            bound,
            False,
            " x",
            why,
            _at(penalty, *keys),
        )
        for penalty, bounds in _PER_PENALTY.items()
        for (bound, why), name, keys in zip(
            bounds,
            ("scikit-learn lasso_cd", "SPAMS, batched, one thread"),
            (("over_ours", "scikit-learn lasso_cd"), ("over_ours", "SPAMS, batch, 1 thread")),
            strict=True,
        )
    ),
    Target(
        "ingest",
        "ingest alone: events a second over tonic ToVoxelGrid",
        5,
        False,
        " x",
        "each event is checked, clipped, and noted for the next emission; a voxel grid only adds",
        _at("over_ours", "tonic ToVoxelGrid"),
    ),
    Target(
        "ingest",
        "ingest alone: events a second over eventcv voxel",
        0.45,
        False,
        " x",
        "the same: three arrays of the ring are touched where a voxel grid touches one",
        _at("over_ours", "eventcv voxel"),
    ),
    Target(
        "replay",
        "`replay --emit 10ms`, K = 400, stride 4: speed over the camera's own pace, N-CARS",
        10,
        False,
        " x",
        "bare reading takes 11 ns an event, one column of nine volumes 400: reading is no floor, the pace is",
        _pace(dense=False),
    ),
    Target(
        "replay",
        "the same, 346x260",
        1.5,
        False,
        " x",
        "never behind, with a third of one core left",
        _pace(dense=True),
    ),
    Target(
        "memory",
        "engine for 640x480: bytes over the arithmetic minimum",
        2,
        True,
        " x",
        "counts, one projection a volume, pooled sums",
        _at("one plane", "state_over_least"),
    ),
    Target(
        "memory",
        "the same, looking ahead",
        2,
        True,
        " x",
        "the minimum with a second projection a volume, that of the next bin",
        _at("looking ahead", "state_over_least"),
    ),
    Target(
        "memory",
        "arrays allocated in 1,000 events after warm-up",
        0,
        True,
        "",
        "a kernel that allocates does not compile",
        _allocations,
    ),
)
