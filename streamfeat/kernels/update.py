"""Reading after any number of events: planes brought up to date with the counts.

Lives here: applying what has changed since the last reading. Each entry costs its net change only, and
each changed volume is encoded once, however many events fell on it.
Not here: what a volume's sums are (`volume`), what its code is (`encode`), single events (`follow`).

In four steps, because two of them can be done for both parts of the grid at once, by two threads:
`mark_dirty`, `renew` each part, `settle`, `complete` each part.
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.compiled import kernel
from streamfeat.kernels.encode import ADD, TAKE, lower_part, pool_volume, read_features
from streamfeat.kernels.ingest import slot_of
from streamfeat.kernels.layout import (
    CLOCK_DIRTY,
    CLOCK_PLANE,
    CLOCK_SLOT,
    CLOCK_TOUCHED,
    CURSOR_CODED,
    CURSOR_ENTRY,
    CURSOR_PROJECTED,
    PARTS,
    Operator,
    State,
)
from streamfeat.kernels.planes import complete
from streamfeat.kernels.volume import change_entries, gather_volume, list_changed


@kernel
def mark_dirty(shape: tuple[int, int], operator: Operator, state: State) -> None:
    """Put every volume of every plane that covers a touched entry on the dirty stack.

    Args:
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: `dirty`, `is_dirty`, `touched_slots` and the height of the dirty stack are changed.
    """
    n_bins, height, width = state.counts.shape
    applied, counts, limit = state.applied.reshape(-1), state.counts.reshape(-1), operator.max_count
    n_volumes, patch = shape[0] * shape[1], operator.patch
    state.touched_slots[:] = 0
    n_dirty = 0
    for i in range(state.clock[CLOCK_TOUCHED]):
        place = state.touched[i]
        if applied[place] == min(max(counts[place], -limit), limit):
            continue
        slot = place // (height * width)
        state.touched_slots[slot] = 1
        row, column = place // width % height, place % width
        first_row, last_row = state.volume_rows[row]
        first_column, last_column = state.volume_columns[column]
        for plane in range(state.cursors.shape[0]):
            # The oldest bin of the window is at position 0 of a volume.
            position = (slot - state.clock[CLOCK_SLOT] - 1) % n_bins - np.int64(
                plane != state.clock[CLOCK_PLANE]
            )
            last, last_entry = state.cursors[plane, CURSOR_PROJECTED], state.cursors[plane, CURSOR_ENTRY]
            if position < 0:
                continue
            for r in range(first_row, last_row):
                for c in range(first_column, last_column):
                    volume = r * shape[1] + c
                    index = plane * n_volumes + volume
                    top, left = r * operator.stride, c * operator.stride
                    entry = (position * patch + row - top) * patch + column - left
                    inside = volume < last or (volume == last and entry < last_entry)
                    if inside and state.is_dirty[index] == 0:
                        state.is_dirty[index] = 1
                        state.dirty[n_dirty] = index
                        n_dirty += 1
    state.clock[CLOCK_DIRTY] = n_dirty


@kernel
def renew(part: int, shape: tuple[int, int], operator: Operator, state: State) -> None:
    """Let the dirty volumes of one part of the grid follow the counts.

    Args:
        part: 0 for the upper half, 1 for the lower.
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: rows, pooled sums and scratch of the part are changed.
    """
    n_bins, patch, n_volumes = state.counts.shape[0], operator.patch, shape[0] * shape[1]
    values, entries, changes = state.values[part], state.entries[part], state.changes[part]
    lower = lower_part(shape, operator.pooling)
    for i in range(state.clock[CLOCK_DIRTY]):
        index = np.int64(state.dirty[i])
        plane, volume = index // n_volumes, index % n_volumes
        if part != np.int64(volume >= lower):
            continue
        cursors = state.cursors[plane]
        ahead = np.int64(plane != state.clock[CLOCK_PLANE])
        end = (n_bins - ahead) * patch * patch
        if volume == cursors[CURSOR_PROJECTED]:
            end = cursors[CURSOR_ENTRY]
        top, left = volume // shape[1] * operator.stride, volume % shape[1] * operator.stride
        first_slot = slot_of(ahead, state)
        if operator.quadratic.shape[0]:
            gather_volume(state.applied, first_slot, end, top, left, patch, values)
        n = list_changed(
            state.counts,
            state.applied,
            operator.max_count,
            state.touched_slots,
            first_slot,
            end,
            top,
            left,
            patch,
            entries,
            changes,
            values,
        )
        coded = volume < cursors[CURSOR_CODED]
        if coded:
            pool_volume(plane, volume, volume, TAKE, part, shape, operator, state)
        projection, moments = state.projections[plane, volume], state.moments[plane, volume]
        change_entries(n, entries, changes, values, operator, projection, moments)
        if coded:
            pool_volume(plane, volume, volume, ADD, part, shape, operator, state)


@kernel
def settle(operator: Operator, state: State) -> None:
    """The planes stand for the counts as they are now: both stacks are empty."""
    flags, applied, counts = state.is_touched.reshape(-1), state.applied.reshape(-1), state.counts.reshape(-1)
    for i in range(state.clock[CLOCK_TOUCHED]):
        place = state.touched[i]
        flags[place] = 0
        applied[place] = min(max(counts[place], -operator.max_count), operator.max_count)
    for i in range(state.clock[CLOCK_DIRTY]):
        state.is_dirty[state.dirty[i]] = 0
    state.clock[CLOCK_TOUCHED] = 0
    state.clock[CLOCK_DIRTY] = 0


@kernel
def finish(shape: tuple[int, int], state: State) -> None:
    """Both parts of the current plane are complete."""
    cursors = state.cursors[state.clock[CLOCK_PLANE]]
    cursors[CURSOR_CODED] = shape[0] * shape[1]
    cursors[CURSOR_PROJECTED] = shape[0] * shape[1]
    cursors[CURSOR_ENTRY] = 0


@kernel
def update(shape: tuple[int, int], operator: Operator, state: State) -> None:
    """Make the current plane that of the counts.

    Args:
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: all of it may be changed.
    """
    mark_dirty(shape, operator, state)
    for part in range(PARTS):
        renew(part, shape, operator, state)
    settle(operator, state)
    for part in range(PARTS):
        complete(part, shape, operator, state)
    finish(shape, state)


@kernel
def read(shape: tuple[int, int], operator: Operator, state: State, features: NDArray[np.float32]) -> None:
    """Make the current plane that of the counts, and read the features: both in one call from Python.

    Args:
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: all of it may be changed.
        features: as for `read_features`.
    """
    update(shape, operator, state)
    read_features(operator, state, features)
