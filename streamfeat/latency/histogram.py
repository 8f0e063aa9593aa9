"""Distributions of latency: HDR histograms and the figures read from them.

Lives here: the only module that knows `hdrh`. Not here: clocks, or what the numbers mean.
"""

from typing import Any, Self

import numpy as np
from hdrh.histogram import HdrHistogram
from numpy.typing import NDArray

__all__ = ["PERCENTILES", "Latencies", "RecentLatencies"]

PERCENTILES = (50.0, 90.0, 99.0, 99.9)

_LONGEST_NS = 60 * 10**9
_DIGITS = 3
_RECENT = 65_536


class Latencies:
    """How long things took, in nanoseconds, to 3 significant digits and up to 60 s.

    All figures come from one HDR histogram, so that decoding it gives the same ones.

    Args:
        ns: `(n,)` int64; not changed. A value above 60 s counts as 60 s.
        weights: `(n,)` int64, how many events each stands for; one each if not given.
    """

    def __init__(self, ns: NDArray[np.int64], weights: NDArray[np.int64] | None = None) -> None:
        """Count every value."""
        self._histogram = HdrHistogram(1, _LONGEST_NS, _DIGITS)
        values, inverse = np.unique(np.clip(ns, 1, _LONGEST_NS), return_inverse=True)
        counts = np.bincount(inverse, weights, len(values)).astype(np.int64)
        for value, count in zip(values.tolist(), counts.tolist(), strict=True):
            self._histogram.record_value(value, count)

    @classmethod
    def decode(cls, text: str) -> Self:
        """Read what `encode` wrote."""
        latencies = cls(np.zeros(0, np.int64))
        latencies._histogram.decode_and_add(text)
        return latencies

    def encode(self) -> str:
        """The histogram in HdrHistogram's own format (V2, compressed, base64): others can merge it."""
        encoded: bytes = self._histogram.encode()
        return encoded.decode("ascii")

    @property
    def n(self) -> int:
        """How many were counted."""
        return int(self._histogram.get_total_count())

    def percentile(self, percent: float) -> int | None:
        """Nanoseconds that `percent` of all did not exceed; None where fewer than one lies beyond."""
        if self.n * (100 - percent) < 100 * (1 - 1e-9):
            return None
        return int(self._histogram.get_value_at_percentile(percent))

    def figures(self) -> dict[str, Any]:
        """`n`, `mean_ns`, a `..._ns` for each percentile, `max_ns`, and ratios of tail to middle."""
        names = [f"p{percent:g}" for percent in PERCENTILES]
        found = dict(zip(names, map(self.percentile, PERCENTILES), strict=True))
        middle = found["p50"]

        def ratio(tail: int | None) -> float | None:
            return round(tail / middle, 2) if tail and middle else None

        return (
            {"n": self.n, "mean_ns": round(self._histogram.get_mean_value(), 1) if self.n else None}
            | {f"{name}_ns": value for name, value in found.items()}
            | {"max_ns": int(self._histogram.get_max_value()) if self.n else None}
            | {f"{name}_to_p50": ratio(found[name]) for name in names[2:]}
        )

    def curve(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The percentile curve as steps: from `share[i]` on, `ns[i]` is reached.

        Returns:
            `1 / (1 - share)`, which is 10 at 90 % and 100 at 99 %, and nanoseconds; both `(m,)`.
        """
        beyond, ns, before = [], [], 0
        for item in self._histogram.get_recorded_iterator():
            beyond.append(self.n / (self.n - before))
            ns.append(float(self._histogram.get_highest_equivalent_value(item.value_iterated_to)))
            before = item.total_count_to_this_value
        return np.array(beyond), np.array(ns)


class RecentLatencies:
    """How long things took lately, one after the other: the latest 65,536, and up to as many before them.

    A run of any length holds two histograms. One thread adds; any thread may ask.
    """

    def __init__(self) -> None:
        """Start without any."""
        self._current, self._before = (HdrHistogram(1, _LONGEST_NS, _DIGITS) for _ in range(2))

    def add(self, ns: float) -> None:
        """Count one, in nanoseconds; a value below 1 ns or above 60 s counts as that bound."""
        if self._current.get_total_count() >= _RECENT:
            self._before, self._current = self._current, HdrHistogram(1, _LONGEST_NS, _DIGITS)
        self._current.record_value(min(max(round(ns), 1), _LONGEST_NS))

    def percentiles(self, *percents: float) -> list[tuple[str, float]]:
        """Name and seconds of each percentile, such as `("p99", 0.0012)`; empty before the first value."""
        total = HdrHistogram(1, _LONGEST_NS, _DIGITS)
        total.add(self._before)
        total.add(self._current)
        if total.get_total_count() == 0:
            return []
        return [(f"p{percent:g}", total.get_value_at_percentile(percent) / 1e9) for percent in percents]
