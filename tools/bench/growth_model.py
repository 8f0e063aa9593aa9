"""What events make the kernels do, counted without running any, and how long that takes on a machine.

Lives here: the work of a load on a stream, and the two constants of a machine.
Not here: timing (`growth`).

Kernels do two kinds of things: they walk over arrays of K filters, as quickly as bytes come, and they look at
single events, volumes and entries, as quickly as instructions go. Both are counted from the events of a
stream and the geometry; nanoseconds of a byte and of a step are fitted to measurements of a few loads.
Not counted: caches. Settings whose projections outgrow one show it as a ratio above 1.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

import streamfeat as sf
from tools.bench.growth_streams import SLICE_US, Load, Stream

__all__ = ["Constants", "Work", "work_of"]

EVENT_STEPS, FEED_STEPS, TOUCH_STEPS, UPDATE_STEPS, CODE_STEPS = 50, 10, 25, 30, 50
SCAN_STEPS, COMPARE_STEPS, LIST_STEPS = 1, 5, 5
"""What kernels do one by one, whatever K is, in units of looking at one entry of a volume: an event that is
followed, or fed; a place of the ring that a reading finds touched; a volume that follows an event, or is
encoded; an entry that is looked at for being filled, compared with what it was, or listed. Estimated from the
kernels' loops, rounded, and the same for all machines."""


@dataclass(frozen=True)
class Work:
    """Of one event, on average.

    Attributes:
        steps: done one by one.
        walked: bytes a vector unit walks over.
    """

    steps: float
    walked: float


class _Tally:
    """Adds up work; bytes are of one filter."""

    def __init__(self, geometry: sf.Geometry) -> None:
        self.area, self.bins = geometry.patch**2, geometry.n_bins
        self.steps = self.walked = 0.0

    # Columns are int16; projections, offsets, codes and each of two sums are 4 bytes, sums read and written.
    UPDATE, CODE, CLEAR = 2 + 8 + 4 + 16, 4 + 4 + 12 + 16, 4

    def events(self, n: int, volumes: int) -> None:
        """Events that were followed, and how many volumes followed them, in one run over all arrays."""
        self.steps += EVENT_STEPS * n + UPDATE_STEPS * volumes
        self.walked += self.UPDATE * volumes

    def boundary(self, filled: NDArray[np.int64]) -> None:
        """All volumes are looked at, and those that are not empty are projected and encoded anew."""
        active = np.count_nonzero(filled)
        self.steps += SCAN_STEPS * self.bins * self.area * filled.size + CODE_STEPS * active
        self.walked += (self.CLEAR + self.CODE) * active
        self._columns(filled)

    def reading(self, changed: NDArray[np.int64]) -> None:
        """Volumes with a change are compared with what they were, and encoded as before and as after."""
        dirty = np.count_nonzero(changed)
        self.steps += (COMPARE_STEPS * self.area + 2 * CODE_STEPS) * dirty
        self.walked += 2 * self.CODE * dirty
        self._columns(changed)

    def _columns(self, entries: NDArray[np.int64]) -> None:
        """Four columns in one run over the projection, what is left one by one."""
        self.steps += LIST_STEPS * entries.sum()
        self.walked += 2 * entries.sum() + 8 * (entries // 4 + entries % 4).sum()


def work_of(load: Load, stream: Stream) -> Work:
    """Count what the events of a stream make the kernels do, without running any."""
    geometry = load.geometry
    shape, tally = geometry.grid_shape(stream.resolution), _Tally(geometry)
    for work in _slices(stream, geometry):
        if load.emit == "event":
            if work.begins_bin:
                tally.boundary(by_volume(work.filled_before, shape, geometry))
            tally.events(work.n, int(by_volume(work.events_changed, shape, geometry).sum()))
            continue
        tally.steps += FEED_STEPS * work.n
        if work.begins_bin:
            tally.boundary(by_volume(work.filled, shape, geometry))
        else:
            tally.steps += TOUCH_STEPS * np.count_nonzero(work.events_changed)
            tally.reading(by_volume(work.changed, shape, geometry))
        tally.walked += 4 * 2 * (4 + 4)  # four cells, two sums: read, and written as features
    n = len(stream.events)
    return Work(tally.steps / n, tally.walked * load.padded / n)


def by_volume(pixels: NDArray[np.int64], shape: tuple[int, int], geometry: sf.Geometry) -> NDArray[np.int64]:
    """Sums over the patch of each volume, `(rows, columns)`."""
    table = np.pad(pixels.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    top, left = (geometry.stride * np.arange(n) for n in shape)
    bottom, right = top + geometry.patch, left + geometry.patch
    a, b, c, d = (table[np.ix_(rows, columns)] for rows in (top, bottom) for columns in (left, right))
    return a - b - c + d


@dataclass(frozen=True)
class _Slice:
    """Counts of 10 ms, `(height, width)`: changes of clipped counts in the newest bin, filled entries.

    Attributes:
        n: events.
        begins_bin: whether it is the first of its bin.
        events_changed: how many events changed the clipped count of a pixel.
        changed: whether it changed from the beginning to the end.
        filled_before: entries of the window that were not zero at the beginning, over all bins.
        filled: the same at the end.
    """

    n: int
    begins_bin: bool
    events_changed: NDArray[np.int64]
    changed: NDArray[np.int64]
    filled_before: NDArray[np.int64]
    filled: NDArray[np.int64]


def _slices(stream: Stream, geometry: sf.Geometry) -> Iterator[_Slice]:
    """Go through a stream twice, so that the second time the window is full; give the second."""
    ring = np.zeros((geometry.n_bins, *stream.resolution), np.int64)
    limit = geometry.max_count
    for turn in range(2):
        for i, events in enumerate(stream.slices):
            begins_bin = i * SLICE_US % geometry.bin_us == 0
            if begins_bin:
                ring = np.roll(ring, -1, axis=0)
                ring[-1] = 0
            filled_before = (ring != 0).sum(0)
            before = ring[-1].clip(-limit, limit)
            events_changed = np.zeros(stream.resolution, np.int64)
            for x, y, p in zip(*(events[name].tolist() for name in "xyp"), strict=True):
                was = ring[-1, y, x]
                now = ring[-1, y, x] = was + 2 * p - 1
                events_changed[y, x] += min(abs(was), abs(now)) < limit
            if turn:
                changed = (ring[-1].clip(-limit, limit) != before).astype(np.int64)
                filled = (ring != 0).sum(0)
                yield _Slice(len(events), begins_bin, events_changed, changed, filled_before, filled)


@dataclass(frozen=True)
class Constants:
    """Of a machine: nanoseconds of a step, and of a byte that is walked over."""

    step_ns: float
    byte_ns: float

    def predict(self, work: Work) -> float:
        """Nanoseconds an event."""
        return self.step_ns * work.steps + self.byte_ns * work.walked

    @classmethod
    def fit(cls, works: list[Work], ns: list[float]) -> "Constants":
        """The least squares of relative errors, neither constant below zero."""
        table = np.array([(work.steps, work.walked) for work in works]) / np.array(ns)[:, None]
        (step_ns, byte_ns), _ = nnls(table, np.ones(len(ns)))
        return cls(float(step_ns), float(byte_ns))
