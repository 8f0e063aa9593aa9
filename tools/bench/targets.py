"""What the figures are held against.

Lives here: every target, where its figure is found in the results, and whether it is met.
Not here: how figures are measured or shown.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

__all__ = ["TARGETS", "Target", "Verdict", "judge"]

Found = float | dict[str, float] | None
"""A figure, with its spread if it has one; None where it was not measured."""


@dataclass(frozen=True)
class Target:
    """One figure and its bound."""

    part: str
    figure: str
    bound: float
    at_most: bool
    unit: str
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


def _tail(percentile: str) -> Callable[[dict[str, Any]], Found]:
    def find(part: dict[str, Any]) -> Found:
        """As under `--emit event`, which looks ahead; every event of every run."""
        update = part["looking ahead"]["as they came"]
        return float(update[f"{percentile}_ns"] / update["p50_ns"])

    return find


def _replay(dense: bool) -> Callable[[dict[str, Any]], Found]:
    def find(part: dict[str, Any]) -> Found:
        names = list(part)
        if dense and len(names) < 2:
            return None
        found: Found = part[names[-1 if dense else 0]]["speed_of_reading"]["messages, not decoded"]
        return found

    return find


def _allocations(part: dict[str, Any]) -> Found:
    return float(max(mode["allocations_in_1000_events"] for mode in part.values()))


_DIRECT = "direct, one volume an event, `soft`:"
_INVERSE = "inverse, an event and volume, gap 1e-4, penalty lambda0 ="

TARGETS = (
    Target("floors", f"{_DIRECT} time over the floor in C", 1.25, True, " x", _at("ours_over_floor")),
    Target("floors", f"{_DIRECT} time over the bytes floor", 2, True, " x", _at("bytes", "ours_over_bytes")),
    Target(
        "peers",
        f"{_DIRECT} faster than a matrix-vector product",
        300,
        False,
        " x",
        _at("over_ours", "matrix-vector product"),
    ),
    Target(
        "peers",
        f"{_DIRECT} faster than a batched matrix product, one thread",
        100,
        False,
        " x",
        _at("over_ours", "batched matrix product, one thread"),
    ),
    Target("precision", "codes against float64, relative to the largest", 1e-4, True, "", _at("relative")),
    Target("latency", "update, stride 4, bin boundaries included: p99 over p50", 3, True, " x", _tail("p99")),
    Target("latency", "the same: p99.9 over p50", 8, True, " x", _tail("p99.9")),
    Target(
        "peers",
        f"{_DIRECT} faster than FEAST of eventcv, 256 features",
        150,
        False,
        " x",
        _at("over_ours", "FEAST of eventcv, 256 features"),
    ),
    *(
        Target(
            "inverse", f"{_INVERSE} {penalty}: faster than {name}", bound, False, " x", _at(penalty, *keys)
        )
        for penalty in ("1", "2", "4")
        for name, bound, keys in (
            ("scikit-learn lasso_cd", 300, ("over_ours", "scikit-learn lasso_cd")),
            ("SPAMS, batched, one thread", 8, ("over_ours", "SPAMS, batch, 1 thread")),
        )
    ),
    Target(
        "ingest",
        "ingest alone: events a second over tonic ToVoxelGrid",
        15,
        False,
        " x",
        _at("over_ours", "tonic ToVoxelGrid"),
    ),
    Target(
        "ingest",
        "ingest alone: events a second over eventcv voxel",
        0.8,
        False,
        " x",
        _at("over_ours", "eventcv voxel"),
    ),
    Target(
        "replay",
        "`replay --emit 10ms`, K = 400, stride 4: speed over bare reading",
        0.3,
        False,
        " x",
        _replay(dense=False),
    ),
    Target("replay", "the same, dense recording", 0.3, False, " x", _replay(dense=True)),
    Target(
        "memory",
        "engine for 640x480: bytes over the arithmetic minimum",
        2,
        True,
        " x",
        _at("one plane", "state_over_least"),
    ),
    Target(
        "memory",
        "the same, looking ahead: a second copy of the projections",
        2,
        True,
        " x",
        _at("looking ahead", "state_over_least"),
    ),
    Target("memory", "arrays allocated in 1,000 events after warm-up", 0, True, "", _allocations),
)
