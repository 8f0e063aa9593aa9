"""An emission after any number of events: planes brought up to date with the counts.

Lives here: applying what has changed since the last emission. Each entry costs its net change only, and
each changed volume is encoded once, however many events fell on it.
Not here: what a volume's sums are (`volume`), what its code is (`encode`), single events (`follow`).

In steps, because threads can share two of them: `mark_dirty`, `renew` each part, `settle`, `list_missing`,
`complete` each part, `finish`.
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.change import follow_changes, follow_rest
from streamfeat.kernels.compiled import inlined, kernel, spliced
from streamfeat.kernels.encode import read_features
from streamfeat.kernels.ingest import slot_of
from streamfeat.kernels.layout import (
    CLOCK_DIRTY,
    CLOCK_PLANE,
    CLOCK_SLOT,
    CLOCK_TOUCHED,
    CURSOR_ENTRY,
    CURSOR_PROJECTED,
    Operator,
    State,
)
from streamfeat.kernels.planes import ALONE, FIRST, fill_plane, share_of
from streamfeat.kernels.vectors import prefetch
from streamfeat.kernels.volume import gather_volume, list_entries

SOON = 16
"""Touched entries lie anywhere in a ring that caches may not hold: loaded this many ahead of their turn."""


CACHE_LINE = 64
"""Bytes of a line of the cache."""


@kernel
def mark_dirty(operator: Operator, state: State) -> None:
    """Put every volume of every plane that covers a touched entry on the dirty stack.

    Args:
        operator: the encoder.
        state: `news`, `dirty`, `is_dirty`, `touched_slots` and the height of the dirty stack are changed.
    """
    n_bins, height, width = state.counts.shape
    applied, counts, limit = state.applied.reshape(-1), state.counts.reshape(-1), operator.max_count
    n_volumes, columns = operator.shape[0] * operator.shape[1], operator.shape[1]
    rows, length = operator.patch
    news, is_dirty, stride = state.news.reshape(-1), state.is_dirty, operator.stride
    state.touched_slots[:] = 0
    n_touched = state.clock[CLOCK_TOUCHED]
    for i in range(n_touched):
        place, later = state.touched[i], np.int64(state.touched[min(i + SOON, n_touched - 1)])
        prefetch(counts, later)
        prefetch(applied, later)
        prefetch(news, later)
        change = min(max(np.int64(counts[place]), -limit), limit) - applied[place]
        if change == 0:
            continue
        news[place] = change
        line = place // width
        slot, row, column = line // height, line % height, place - line * width
        state.touched_slots[slot] = 1
        first_row, last_row = state.volume_rows[row, 0], state.volume_rows[row, 1]
        first_column, last_column = state.volume_columns[column, 0], state.volume_columns[column, 1]
        for plane in range(state.cursors.shape[0]):
            # The oldest bin of the window is at position 0 of a volume.
            position = slot - state.clock[CLOCK_SLOT] - 1
            position += n_bins if position < 0 else 0
            position -= np.int64(plane != state.clock[CLOCK_PLANE])
            last, last_entry = state.cursors[plane, CURSOR_PROJECTED], state.cursors[plane, CURSOR_ENTRY]
            if position < 0 or last + last_entry == 0:
                continue
            for r in range(first_row, last_row):
                line_entry = (position * rows + row - r * stride) * length + column
                for c in range(first_column, last_column):
                    volume = r * columns + c
                    inside = volume < last or (volume == last and line_entry - c * stride < last_entry)
                    is_dirty[plane * n_volumes + volume] |= inside
    # Listed in the order of the volumes: neighbours in memory are neighbours on the sensor.
    n_dirty = 0
    for index in range(is_dirty.shape[0] if state.clock[CLOCK_TOUCHED] else 0):
        state.dirty[n_dirty] = index
        n_dirty += np.int64(is_dirty[index])
    state.clock[CLOCK_DIRTY] = n_dirty


@inlined
def touched_bins(state: State) -> tuple[int, int]:
    """First and last plus one of the bins of the window in which an entry changed, oldest first."""
    n_bins = state.counts.shape[0]
    first, last = n_bins, 0
    for position in range(n_bins):
        if state.touched_slots[slot_of(position, state)]:
            first, last = min(first, position), position + 1
    return first, last


@kernel
def renew(part: int, parts: int, operator: Operator, state: State) -> None:
    """Let one part of the dirty volumes follow the counts.

    Args:
        part: which.
        parts: of how many.
        operator: the encoder.
        state: rows of these volumes, and sums and scratch of the part, are changed.
    """
    n_bins, patch, columns = state.counts.shape[0], operator.patch, operator.shape[1]
    area = patch[0] * patch[1]
    kinds = operator.upper, operator.wide, operator.lasso
    values, news, n_volumes = state.values[part, 0], state.values[part, 1], operator.shape[0] * columns
    first_bin, last_bin = touched_bins(state)
    first, last = share_of(part, parts, state)
    rows, width = state.projections.reshape(-1), state.projections.shape[2]
    line = CACHE_LINE // state.projections.itemsize
    for i in range(first, last):
        following = np.int64(state.dirty[min(i + 1, last - 1)]) * width
        for k in range(following, following + width, line):
            prefetch(rows, k)
        plane, volume = np.int64(state.dirty[i]) // n_volumes, np.int64(state.dirty[i]) % n_volumes
        ahead = np.int64(plane != state.clock[CLOCK_PLANE])
        end = (n_bins - ahead) * area
        if volume == state.cursors[plane, CURSOR_PROJECTED]:
            end = state.cursors[plane, CURSOR_ENTRY]
        top, left = volume // columns * operator.stride, volume % columns * operator.stride
        slot = slot_of(ahead, state)
        start, stop = max(first_bin - ahead, 0) * area, min(end, (last_bin - ahead) * area)
        gather_volume(state.news, slot, start, stop, top, left, patch, news)
        if operator.quadratic.shape[0]:
            gather_volume(state.applied, slot, np.int64(0), end, top, left, patch, values)
            values[end:] = 0
        else:
            gather_volume(state.applied, slot, start, stop, top, left, patch, values)
        n = list_entries(news, start, stop, state.entries[part], state.changes[part])
        follow_changes(*kinds, plane, volume, n, part, operator, state)
    follow_rest(operator.upper, part, operator, state)


@kernel
def settle(state: State) -> None:
    """The planes stand for the counts as they are now: both stacks are empty."""
    flags, applied, news = state.is_touched.reshape(-1), state.applied.reshape(-1), state.news.reshape(-1)
    for i in range(state.clock[CLOCK_TOUCHED]):
        place = state.touched[i]
        flags[place] = 0
        applied[place] += news[place]
        news[place] = 0
    for i in range(state.clock[CLOCK_DIRTY]):
        state.is_dirty[state.dirty[i]] = 0
    state.clock[CLOCK_TOUCHED] = 0
    state.clock[CLOCK_DIRTY] = 0


@spliced
def update(operator: Operator, state: State) -> None:
    """Make the current plane that of the counts.

    Args:
        operator: the encoder.
        state: all of it may be changed.
    """
    mark_dirty(operator, state)
    renew(FIRST, ALONE, operator, state)
    settle(state)
    fill_plane(operator, state)


@kernel
def read(operator: Operator, state: State, features: NDArray[np.float32]) -> None:
    """Make the current plane that of the counts, and read the features: both in one call from Python.

    Args:
        operator: the encoder.
        state: all of it may be changed.
        features: as for `read_features`.
    """
    update(operator, state)
    read_features(operator, state, features)
