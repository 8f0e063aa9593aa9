"""One entry of the ring changes by one: the volumes that cover it follow, in every plane.

Lives here: what one event costs beyond being counted.
Not here: counting it (`ingest`), the events of a stream (`follow`), many changes at once (`update`).
"""

import numpy as np

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
from streamfeat.kernels.volume import change_entries, change_moments, gather_volume


@kernel
def change_volume(
    plane: int, volume: int, entry: int, change: int, shape: tuple[int, int], operator: Operator, state: State
) -> None:
    """Let one entry of a volume change, whatever its code is; its part in the pooled sums follows if coded.

    Args:
        plane: of the volume.
        volume: which.
        entry: index into the volume.
        change: of its clipped count, 1 or -1.
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: the plane and scratch are changed; `values[0]` holds the entries before the change, all of
            them where the operator has a quadratic form.
    """
    part = np.int64(0)
    coded = volume < state.cursors[plane, CURSOR_CODED]
    if coded:
        pool_volume(plane, volume, volume, TAKE, part, shape, operator, state)
    state.entries[part, 0] = entry
    state.changes[part, 0] = change
    change_entries(
        np.int64(1),
        state.entries[part],
        state.changes[part],
        state.values[part],
        operator,
        state.projections[plane, volume],
        state.moments[plane, volume],
    )
    if coded:
        pool_volume(plane, volume, volume, ADD, part, shape, operator, state)


@inlined
def move_volume(
    plane: int, volume: int, entry: int, change: int, shape: tuple[int, int], operator: Operator, state: State
) -> None:
    """The same for a volume that has a code in closed form and is not empty before or after, in one run.

    Args: as for `change_volume`.
    """
    projection, moments = state.projections[plane, volume], state.moments[plane, volume]
    pooled, column = state.pooled[plane, state.cells[volume]], operator.columns[entry]
    entries, eps = operator.columns.shape[0], operator.eps
    sigma = deviation(moments, entries, eps)
    if operator.kind == TRIANGLE:
        length = np.float32(whitened_square(moments, sigma, operator))
        change_moments(entry, change, state.values[0], operator, moments)
        after = deviation(moments, entries, eps)
        move_triangle(
            change,
            column,
            projection,
            (gain(sigma, operator), gain(after, operator)),
            (length, np.float32(whitened_square(moments, after, operator))),
            operator.offset,
            operator.square_norms,
            operator.n_filters,
            np.float32(operator.unit),
            pooled,
            state.code[0],
        )
    else:
        change_moments(entry, change, state.values[0], operator, moments)
        move_code(
            change,
            column,
            projection,
            gain(sigma, operator),
            gain(deviation(moments, entries, eps), operator),
            operator.offset,
            np.float32(operator.threshold),
            operator.kind,
            pooled,
        )
    state.encoded[0] += 1


@inlined
def change_place(
    position: int, row: int, column: int, shape: tuple[int, int], operator: Operator, state: State
) -> None:
    """Let the volumes of all planes that cover one changed entry of the ring follow it.

    Args:
        position: bin of the entry in the window, oldest first; its clipped count went up or down by one.
        row: of the entry in the ring.
        column: of the entry in the ring.
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: planes, `applied` and scratch are changed.
    """
    n_bins, patch, limit = state.counts.shape[0], operator.patch, operator.max_count
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
        coded, projected = state.cursors[plane, CURSOR_CODED], state.cursors[plane, CURSOR_PROJECTED]
        last_entry = state.cursors[plane, CURSOR_ENTRY]
        for r in range(first_row, last_row):
            for c in range(first_column, last_column):
                volume = r * shape[1] + c
                top, left = r * operator.stride, c * operator.stride
                entry = ((position - ahead) * patch + row - top) * patch + column - left
                if volume > projected or (volume == projected and entry >= last_entry):
                    continue
                if operator.quadratic.shape[0]:
                    end = (n_bins - ahead) * patch * patch
                    if volume == projected:
                        end = last_entry
                    first_slot = slot_of(ahead, state)
                    gather_volume(state.applied, first_slot, end, top, left, patch, state.values[0])
                state.values[0, entry] = before
                squares = state.moments[plane, volume, MOMENT_SQUARES]
                stays = squares != 0 and squares + after * after > before * before
                if stays and volume < coded and not operator.inverse:
                    move_volume(plane, volume, entry, after - before, shape, operator, state)
                else:
                    change_volume(plane, volume, entry, after - before, shape, operator, state)
    state.applied[slot, row, column] = after
