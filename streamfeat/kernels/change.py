"""One entry of the ring changes by one: the volumes that cover it follow, in every plane.

Lives here: what one event costs beyond being counted.
Not here: counting it (`ingest`), the events of a stream (`follow`), many changes at once (`update`).
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.code import deviation, gain, move_code, move_triangle, whitened_square
from streamfeat.kernels.compiled import inlined, kernel
from streamfeat.kernels.encode import ADD, TAKE, pool_volume
from streamfeat.kernels.ingest import slot_of
from streamfeat.kernels.layout import (
    CLOCK_PLANE,
    CURSOR_CODED,
    CURSOR_ENTRY,
    CURSOR_PROJECTED,
    MOMENT_SQUARES,
    TRIANGLE,
    Operator,
    State,
)
from streamfeat.kernels.narrow import move_queued, queue_volume
from streamfeat.kernels.volume import change_entries, change_moments, gather_volume, sum_columns

ONCE, NO_THREAD = np.int64(1), np.int64(0)
"""The list of one event has one entry; the first part of an update is that of the calling thread."""


@kernel
def change_volume(plane: int, volume: int, n: int, part: int, operator: Operator, state: State) -> None:
    """Let listed entries of a volume change, whatever its code is; its part in the sums follows if coded.

    Args:
        plane: of the volume.
        volume: which.
        n: length of the list, which is in `entries` and `changes` of the part.
        part: whose scratch and sums to use.
        operator: the encoder.
        state: the plane, sums and scratch are changed; `values[part, 0]` holds the listed entries before the
            change, and all others too where the operator has a quadratic form.
    """
    coded = volume < state.cursors[plane, CURSOR_CODED]
    if coded:
        pool_volume(plane, volume, volume, TAKE, part, operator, state)
    change_entries(
        n,
        state.entries[part],
        state.changes[part],
        state.values[part, 0],
        operator,
        state.projections[plane, volume],
        state.moments[plane, volume],
        state.sums[part, 0],
    )
    if coded:
        pool_volume(plane, volume, volume, ADD, part, operator, state)


@inlined
def move_volume(plane: int, volume: int, n: int, part: int, operator: Operator, state: State) -> None:
    """The same for a volume that has a code in closed form and is not empty before or after, in one run.

    Args: as for `change_volume`.
    """
    projection, moments = state.projections[plane, volume], state.moments[plane, volume]
    entries, changes, values = state.entries[part], state.changes[part], state.values[part, 0]
    d, eps, cell = operator.columns.shape[0], operator.eps, state.cells[volume]
    sums = state.pooled[plane, cell] if part == 0 else state.partial[part - 1, plane, cell]
    sigma = deviation(moments, d, eps)
    length = np.float32(0)
    if operator.kind == TRIANGLE:
        length = np.float32(whitened_square(moments, sigma, operator))
    change_moments(n, entries, changes, values, operator, moments)
    after = deviation(moments, d, eps)
    before_after = gain(sigma, operator), gain(after, operator)
    if operator.kind == TRIANGLE:
        total = state.sums[part, 0]
        sum_columns(n, entries, changes, operator.columns, total)
        move_triangle(
            ONCE,
            total,
            projection,
            before_after,
            (length, np.float32(whitened_square(moments, after, operator))),
            operator.offset,
            operator.square_norms,
            operator.n_filters,
            np.float32(operator.unit),
            sums,
            state.code[part],
        )
    else:
        threshold, offset, kind = np.float32(operator.threshold), operator.offset, operator.kind
        if n == 1 and abs(changes[0]) == 1:
            change, column = np.int64(changes[0]), operator.columns[entries[0]]
            move_code(
                change,
                column,
                projection,
                before_after[0],
                before_after[1],
                offset,
                threshold,
                kind,
                sums,
            )
        else:
            total = state.sums[part, 0]
            sum_columns(n, entries, changes, operator.columns, total)
            move_code(
                ONCE, total, projection, before_after[0], before_after[1], offset, threshold, kind, sums
            )
    state.encoded[part] += 1


@inlined
def follow_changes(
    narrow: NDArray[np.uint16] | None,
    wide: bool | None,
    lasso: bool | None,
    plane: int,
    volume: int,
    n: int,
    part: int,
    operator: Operator,
    state: State,
) -> None:
    """Let listed entries of a volume change, in the shortest way.

    Args: as for `change_volume`, after the kinds of state (see `encode.write_code`). In the narrow state the
        volume may wait in the queue: `follow_rest` has to be called behind the last.
    """
    squares = state.moments[plane, volume, MOMENT_SQUARES]
    after = squares
    for i in range(n):
        change = np.int64(state.changes[part, i])
        after += change * (2 * np.int64(state.values[part, 0, state.entries[part, i]]) + change)
    closed = volume < state.cursors[plane, CURSOR_CODED] and squares != 0 and after != 0
    if narrow is not None:  # noqa: SIM102 - see `encode.write_code`
        if closed:
            queue_volume(plane, volume, n, part, operator, state)
    if lasso is not None:
        closed = False
    if wide is not None:  # noqa: SIM102 - see `encode.write_code`
        if closed:
            move_volume(plane, volume, n, part, operator, state)
    if not closed:
        change_volume(plane, volume, n, part, operator, state)


@inlined
def follow_rest(narrow: NDArray[np.uint16] | None, part: int, operator: Operator, state: State) -> None:
    """Let no volume wait in the queue.

    Args:
        narrow: `operator.upper` (see `encode.write_code`).
        part: whose queue.
        operator: the encoder.
        state: as for `narrow.move_queued`.
    """
    if narrow is not None:
        move_queued(part, operator, state)


@inlined
def change_place(position: int, row: int, column: int, operator: Operator, state: State) -> None:
    """Let the volumes of all planes that cover one changed entry of the ring follow it.

    Args:
        position: bin of the entry in the window, oldest first; its clipped count went up or down by one.
        row: of the entry in the ring.
        column: of the entry in the ring.
        operator: the encoder.
        state: planes, `applied` and scratch are changed.
    """
    n_bins, patch, limit = state.counts.shape[0], operator.patch, operator.max_count
    height, width = patch
    kinds = operator.upper, operator.wide, operator.lasso
    values = state.values[0, 0]
    slot = slot_of(position, state)
    before = np.int64(state.applied[slot, row, column])
    after = min(max(np.int64(state.counts[slot, row, column]), -limit), limit)
    first_row, last_row = state.volume_rows[row, 0], state.volume_rows[row, 1]
    first_column, last_column = state.volume_columns[column, 0], state.volume_columns[column, 1]
    for plane in range(state.cursors.shape[0]):
        # A plane that is ahead has moved on by a bin.
        ahead = np.int64(plane != state.clock[CLOCK_PLANE])
        if position < ahead:
            continue
        projected, last_entry = state.cursors[plane, CURSOR_PROJECTED], state.cursors[plane, CURSOR_ENTRY]
        for r in range(first_row, last_row):
            for c in range(first_column, last_column):
                volume = r * operator.shape[1] + c
                top, left = r * operator.stride, c * operator.stride
                entry = ((position - ahead) * height + row - top) * width + column - left
                if volume > projected or (volume == projected and entry >= last_entry):
                    continue
                if operator.quadratic.shape[0]:
                    end = (n_bins - ahead) * height * width
                    if volume == projected:
                        end = last_entry
                    gather_volume(
                        state.applied, slot_of(ahead, state), np.int64(0), end, top, left, patch, values
                    )
                    values[end:] = 0
                values[entry] = before
                state.entries[0, 0], state.changes[0, 0] = entry, after - before
                follow_changes(*kinds, plane, volume, ONCE, NO_THREAD, operator, state)
    follow_rest(operator.upper, NO_THREAD, operator, state)
    state.applied[slot, row, column] = after
