"""Events read one by one: what is pooled is current after every single event.

Lives here: the kernel that runs for each event under `--emit event`.
Not here: events that are only counted, to be read together (`ingest`, `update`).
"""

import numpy as np
from numba import njit

from streamfeat.events import Events
from streamfeat.kernels.code import deviation, move_code
from streamfeat.kernels.encode import ADD, TAKE, covering, pool_volume, quadrant
from streamfeat.kernels.ingest import UNCHANGED, count_event
from streamfeat.kernels.layout import (
    CLOCK_NOW,
    CLOCK_PLANE,
    CLOCK_START,
    MOMENT_SQUARES,
    TALLY_ENCODED,
    TRIANGLE,
    Operator,
    State,
)
from streamfeat.kernels.planes import complete, look_ahead
from streamfeat.kernels.volume import change_entry, change_moments, gather_volume

SLICE = 96
"""Columns that one event may add for the sake of the next bin."""


@njit(cache=True, nogil=True)
def change_volume(
    plane: int,
    volume: int,
    entry: int,
    before: int,
    after: int,
    shape: tuple[int, int],
    operator: Operator,
    state: State,
) -> None:
    """Let one entry of one volume change, and its code and the pooled sums with it.

    Args:
        plane: of the volume.
        volume: which.
        entry: index into the volume.
        before: clipped count that the plane stands for; `state.values` holds the whole volume where the
            operator has a quadratic form.
        after: clipped count that it shall stand for, one more or one less.
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: the plane and scratch are changed.
    """
    projection, moments = state.projections[plane, volume], state.moments[plane, volume]
    squares = moments[MOMENT_SQUARES]
    emptied = squares + after * after == before * before
    if operator.inverse or operator.kind == TRIANGLE or squares == 0 or emptied:
        pool_volume(plane, volume, volume, TAKE, shape, operator, state)
        change_entry(entry, before, after, state.values, operator, projection, moments)
        pool_volume(plane, volume, volume, ADD, shape, operator, state)
        return
    entries = operator.columns.shape[0]
    sigma = deviation(moments, entries, operator.eps)
    change_moments(before, after, moments)
    move_code(
        after - before,
        operator.columns[entry],
        projection,
        sigma,
        deviation(moments, entries, operator.eps),
        operator,
        state.pooled[plane, quadrant(volume, shape)],
    )
    state.tally[TALLY_ENCODED] += 1


@njit(cache=True, nogil=True)
def change_place(place: int, shape: tuple[int, int], operator: Operator, state: State) -> None:
    """Let the volumes of all planes that cover one changed entry of the ring follow it.

    Args:
        place: flat index of the entry, whose clipped count went up or down by one.
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: planes, `applied` and scratch are changed.
    """
    n_bins, height, width = state.counts.shape
    patch, now, limit = operator.patch, state.clock[CLOCK_NOW], operator.max_count
    applied, counts = state.applied.reshape(-1), state.counts.reshape(-1)
    before = np.int64(applied[place])
    after = min(max(np.int64(counts[place]), -limit), limit)
    row, column = place // width % height, place % width
    first_row, last_row = covering(row, shape[0], operator)
    first_column, last_column = covering(column, shape[1], operator)
    for plane in range(state.cursors.shape[0]):
        ahead = np.int64(plane != state.clock[CLOCK_PLANE])
        # The oldest bin of the window is at position 0 of a volume.
        position = (place // (height * width) - now - 1) % n_bins - ahead
        if position < 0:
            continue
        for r in range(first_row, last_row):
            for c in range(first_column, last_column):
                volume = r * shape[1] + c
                if volume >= state.cursors[plane]:
                    continue
                top, left = r * operator.stride, c * operator.stride
                if operator.quadratic.shape[0]:
                    first_slot = (now + 1 + ahead) % n_bins
                    gather_volume(state.applied, first_slot, n_bins - ahead, top, left, patch, state.values)
                entry = (position * patch + row - top) * patch + column - left
                change_volume(plane, volume, entry, before, after, shape, operator, state)
    applied[place] = after


@njit(cache=True, nogil=True)
def follow(
    events: Events, height: int, width: int, shape: tuple[int, int], operator: Operator, state: State
) -> None:
    """Count events one by one, and keep the current plane that of the counts after each.

    The plane that looks ahead is filled at the pace at which the bin goes by, a bounded slice an event.

    Args:
        events: `(n,)` EVENT_DTYPE, any content; not changed.
        height: rows of the sensor, pixels.
        width: columns of the sensor, pixels.
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: all of it may be changed. Nothing may be on the touched stack.
    """
    for i in range(events.shape[0]):
        event = events[i]
        place = count_event(event.x, event.y, event.p, event.t, height, width, operator, state)
        complete(shape, operator, state)
        if place != UNCHANGED:
            change_place(place, shape, operator, state)
        start = state.clock[CLOCK_START]
        elapsed = min(max(event.t, start), start + operator.bin_us) - start  # any time: no overflow
        goal = shape[0] * shape[1] * elapsed * 5 // (4 * operator.bin_us)
        look_ahead(goal, SLICE, shape, operator, state)
