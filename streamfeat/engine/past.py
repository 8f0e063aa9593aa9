"""Volumes shorter than the window: those that ended in earlier bins.

Lives here: the counts of the whole window, the pooled sums of each bin that is over, what a belated event
does to them.
Not here: volumes that end with the current bin (`engine`), what is pooled (`kernels.encode`).

A volume that ended in an earlier bin has the counts, and so the code, that the newest one at its place had
when that bin was over. So nothing is computed for it: the sums of each bin are kept as they were at its end,
and those that the window still holds are added to the sums of the current plane, on which kernels go on as
ever. An event of the current bin moves the newest volumes only. The sums of an earlier bin are computed from
counts where they were not kept: nothing was read in that bin, it was passed over, or an event of one of its
volumes came after it was over.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.geometry import Geometry
from streamfeat.engine.state import allocate_state, clear_state
from streamfeat.engine.window import add_volumes
from streamfeat.events import Events, Resolution, is_valid
from streamfeat.kernels.ingest import advance_to_bin, count_events
from streamfeat.kernels.layout import (
    BEFORE_TIME,
    CLOCK_NOW,
    CLOCK_ORIGIN,
    CLOCK_PLANE,
    CLOCK_START,
    Operator,
    State,
)

__all__ = ["Past", "Run"]

_NO_BIN = np.iinfo(np.int64).min


class Run(NamedTuple):
    """Some events of a batch, of which at most the first begins a bin."""

    events: Events
    bin: int
    """The current one, once they are in."""
    over: NDArray[np.int64]
    """Bins that were over when an event of them came."""


class Past:
    """What volumes of earlier bins add to the pooled sums.

    Args:
        geometry: whose volumes are shorter than its window.
        operator: of the sensor, with a fixed point for the volumes of all ages.
        resolution: `(height, width)` of the sensor.
        origin_us: start of bin 0.
    """

    def __init__(
        self, geometry: Geometry, operator: Operator, resolution: Resolution, origin_us: int
    ) -> None:
        """Allocate everything."""
        self._geometry, self._operator, self._resolution = geometry, operator, resolution
        self.window = allocate_state(geometry.whole, operator, resolution, origin_us=origin_us, keep=False)
        """Of which only the counts of the whole window, the clock and the tally mean anything."""
        self._one = allocate_state(geometry.newest, operator, resolution, keep=False)
        kept, shape = geometry.n_bins - geometry.depth, self._one.pooled.shape[1:]
        self._sums, self._bins = np.zeros((kept, *shape), np.int32), np.full(kept, _NO_BIN)
        self._added, self._added_in = np.zeros(shape, np.int32), BEFORE_TIME
        self._is_stale = True

    @property
    def encoded(self) -> int:
        """Volumes encoded for bins that were over."""
        return int(self._one.encoded.sum())

    def cut(self, events: Events, *, singly: bool) -> Iterator[Run]:
        """Cut a batch where a bin begins.

        Args:
            events: `(n,)` EVENT_DTYPE; not changed.
            singly: each event of a bin that is over makes a run by itself.
        """
        clock, bin_us = self.window.clock, self._geometry.bin_us
        now, start, times = int(clock[CLOCK_NOW]), int(clock[CLOCK_START]), events["t"]
        if not len(events) or (now > BEFORE_TIME and start <= times.min() and times.max() - start < bin_us):
            yield Run(events, now, times[:0])
            return
        good, origin = is_valid(events, self._resolution), clock[CLOCK_ORIGIN]
        bins = np.where(good, (np.where(good, times, origin) - origin) // bin_us, BEFORE_TIME)
        reached = np.maximum(np.maximum.accumulate(bins), now)
        is_over = good & (bins < reached)
        is_cut = np.diff(reached, prepend=now) > 0
        if singly:
            is_cut |= is_over
            is_cut[1:] |= is_over[:-1]
        edges = np.unique([0, *np.flatnonzero(is_cut), len(events)])
        for first, last in itertools.pairwise(edges.tolist()):
            over = np.unique(bins[first:last][is_over[first:last]])
            yield Run(events[first:last], int(reached[first]), over)

    def count(self, run: Run) -> None:
        """Count events in the window; bins that are over and whose volumes they may change have no sums."""
        count_events(run.events, self._operator, self.window)
        for number in run.over:
            self._bins[(self._bins >= number) & (self._bins < number + self._geometry.depth)] = _NO_BIN
            self._is_stale = True

    def keep(self, state: State) -> None:
        """Keep the sums of the current bin of an engine, which is over.

        Args:
            state: of the engine, up to date with its counts; not changed.
        """
        now = int(state.clock[CLOCK_NOW])
        sums = state.pooled[state.clock[CLOCK_PLANE]]
        place = now % len(self._bins)
        self._sums[place], self._bins[place] = sums - self._added_to(now), now

    def advance(self, new: int) -> None:
        """Make `new` the current bin."""
        advance_to_bin(new, self._operator, self.window)

    def add(self, state: State) -> None:
        """Add what earlier bins are worth to the pooled sums of an engine, as far as it is not in them yet.

        Args:
            state: of the engine, whose plane is up to date; its pooled sums are changed.
        """
        now = int(state.clock[CLOCK_NOW])
        if now == BEFORE_TIME or (now == self._added_in and not self._is_stale):
            return
        before = self._added_to(now).copy()
        self._added[:], self._added_in, self._is_stale = 0, now, False
        for age in self._geometry.ages[1:]:
            self._added += self._sums_of(now - age)
        state.pooled[state.clock[CLOCK_PLANE]] += self._added - before

    def _added_to(self, now: int) -> NDArray[np.int32]:
        """What was added to the current plane; nothing since a bin began, for then planes begin anew."""
        if now != self._added_in:
            self._added[:] = 0
        return self._added

    def _sums_of(self, number: int) -> NDArray[np.int32]:
        """The pooled sums of a bin that is over."""
        place = number % len(self._bins)
        if self._bins[place] != number:
            self._sums[place], self._bins[place] = 0, number
            counts = self.counts_of(number)
            if counts.any():
                limit = self._operator.max_count
                self._one.pooled[:] = 0
                add_volumes(counts.clip(-limit, limit).astype(np.int16), self._operator, self._one)
                self._sums[place] = self._one.pooled[0]
        sums: NDArray[np.int32] = self._sums[place]
        return sums

    def counts_of(self, number: int) -> NDArray[np.int32]:
        """Counts of the volumes that end with a bin, `(depth, H, W)`, oldest bin first."""
        slots = np.arange(number - self._geometry.depth + 1, number + 1) % self._geometry.n_bins
        counts: NDArray[np.int32] = self.window.counts[slots]
        return counts

    def newest_counts(self) -> NDArray[np.int32]:
        """Counts of the newest volumes, bin `b` in slot `b % depth`."""
        now = int(self.window.clock[CLOCK_NOW])
        return np.roll(self.counts_of(now), (now + 1) % self._geometry.depth, axis=0)

    def forget(self) -> None:
        """Forget all sums; planes begin anew."""
        self._bins[:] = _NO_BIN
        self._added_in = BEFORE_TIME

    def restart(self, origin_us: int) -> None:
        """Forget every event and start bin 0 at `origin_us`."""
        clear_state(self.window, origin_us)
        self.forget()
