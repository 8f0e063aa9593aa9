"""Bringing projections, codes and pooled sums up to date with the counts.

Lives here: which volumes an entry belongs to, and the order in which changed ones are redone.
Not here: what a volume's sums are (`volume`), what its code is (`code`, `lasso`).

Between two readings any number of events may have come: each entry costs its net change only, and
each changed volume is encoded once. When a bin boundary was crossed every entry of every volume has
moved, and all volumes that are not empty are projected anew.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from streamfeat.kernels.code import deviation, pool, soft_code, triangle_code, whitened_square
from streamfeat.kernels.lasso import fix_atoms, lasso_code
from streamfeat.kernels.layout import (
    CLOCK_NOW,
    CLOCK_PROJECTED,
    CLOCK_TOUCHED,
    MOMENT_SQUARES,
    TRIANGLE,
    Operator,
    State,
)
from streamfeat.kernels.volume import change_entry, gather_volume, project_volume


@njit(cache=True, nogil=True)
def quadrant(volume: int, rows: int, columns: int) -> int:
    """Quadrant of a volume: 0 top left, 1 top right, 2 bottom left, 3 bottom right."""
    row, column = volume // columns, volume % columns
    return 2 * (2 * row >= rows) + (2 * column >= columns)


@njit(cache=True, nogil=True)
def encode_volume(
    projection: NDArray[np.int32],
    moments: NDArray[np.int64],
    atoms: NDArray[np.float32],
    fresh: bool,
    operator: Operator,
    state: State,
) -> None:
    """Write the code of a volume to `state.code`; a volume whose counts are all zero has code zero.

    Args:
        projection: `(Kp,)` of the volume.
        moments: `(4,)` of the volume.
        atoms: `(K,)` last lasso code; changed when `fresh`.
        fresh: solve the lasso again (True), or show the code that was found last (False).
        operator: the encoder.
        state: `code`, `work` and `active` are overwritten.
    """
    if moments[MOMENT_SQUARES] == 0:
        if fresh:
            atoms[:] = 0
        state.code[:] = 0
        return
    sigma = deviation(moments, operator.columns.shape[0], operator.eps)
    if operator.inverse:
        if fresh:
            square = whitened_square(moments, sigma, operator)
            lasso_code(projection, sigma, square, operator, atoms, state.work, state.active)
        fix_atoms(atoms, state.code)
    elif operator.kind == TRIANGLE:
        triangle_code(projection, sigma, whitened_square(moments, sigma, operator), operator, state.code)
    else:
        soft_code(projection, sigma, operator, state.code)


@njit(cache=True, nogil=True)
def pool_volume(volume: int, sign: int, shape: tuple[int, int], operator: Operator, state: State) -> None:
    """Encode one volume and add it to (1) or take it from (-1) the pooled sums."""
    encode_volume(
        state.projections[volume], state.moments[volume], state.atoms[volume], sign > 0, operator, state
    )
    pool(state.code, sign, operator.kind, state.pooled[quadrant(volume, shape[0], shape[1])])


@njit(cache=True, nogil=True)
def covering(pixel: int, count: int, operator: Operator) -> tuple[int, int]:
    """First and last plus one of the `count` volumes along one axis that cover a pixel."""
    first = max(0, (pixel - operator.patch + operator.stride) // operator.stride)
    return first, min(count, pixel // operator.stride + 1)


@njit(cache=True, nogil=True)
def update(shape: tuple[int, int], operator: Operator, state: State) -> int:
    """Make projections, codes and pooled sums those of the counts.

    Args:
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: all of it may be changed.

    Returns:
        how many volumes were encoded.
    """
    if state.clock[CLOCK_PROJECTED] != state.clock[CLOCK_NOW]:
        return rebuild(shape, operator, state)
    return apply_touched(shape, operator, state)


@njit(cache=True, nogil=True)
def rebuild(shape: tuple[int, int], operator: Operator, state: State) -> int:
    """Project and encode every volume anew, for the current bin. Returns how many are not empty."""
    counts, applied = state.counts, state.applied
    n_bins = counts.shape[0]
    limit = operator.max_count
    state.clock[CLOCK_TOUCHED] = 0
    state.is_touched[:] = 0
    for slot in range(n_bins):
        for row in range(counts.shape[1]):
            for column in range(counts.shape[2]):
                applied[slot, row, column] = min(max(counts[slot, row, column], -limit), limit)
    state.clock[CLOCK_PROJECTED] = state.clock[CLOCK_NOW]
    first_slot = (state.clock[CLOCK_NOW] + 1) % n_bins
    return encode_ring(applied, first_slot, shape, operator, state)


@njit(cache=True, nogil=True)
def encode_ring(
    ring: NDArray[np.int16], first_slot: int, shape: tuple[int, int], operator: Operator, state: State
) -> int:
    """Project, encode and pool every volume of a ring of clipped counts from nothing.

    Args:
        ring: `(T, H, W)` clipped counts; not changed.
        first_slot: slot of the oldest bin.
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: `projections`, `moments`, `atoms`, `pooled` and scratch are overwritten. One with a single
            row of projections keeps nothing of a volume once it is pooled.

    Returns:
        how many volumes are not empty.
    """
    values = state.values
    filled = 0
    state.pooled[:] = 0
    for volume in range(shape[0] * shape[1]):
        top, left = volume // shape[1] * operator.stride, volume % shape[1] * operator.stride
        row = min(volume, state.projections.shape[0] - 1)
        projection, moments, atoms = state.projections[row], state.moments[row], state.atoms[row]
        if gather_volume(ring, first_slot, top, left, operator.patch, values) == 0:
            projection[:] = 0
            moments[:] = 0
            atoms[:] = 0
            continue
        filled += 1
        project_volume(values, operator, projection, moments)
        encode_volume(projection, moments, atoms, True, operator, state)
        pool(state.code, 1, operator.kind, state.pooled[quadrant(volume, shape[0], shape[1])])
    return filled


@njit(cache=True, nogil=True)
def apply_touched(shape: tuple[int, int], operator: Operator, state: State) -> int:
    """Apply the net change of every touched entry to the volumes that cover it, and encode those again.

    Returns how many volumes were encoded.
    """
    counts, applied = state.counts, state.applied
    n_bins, height, width = counts.shape
    limit = operator.max_count
    now = state.clock[CLOCK_NOW]
    n_dirty = 0
    for i in range(state.clock[CLOCK_TOUCHED]):
        place = state.touched[i]
        slot, row, column = place // (height * width), place // width % height, place % width
        state.is_touched[slot, row, column] = 0
        before = np.int64(applied[slot, row, column])
        after = min(max(np.int64(counts[slot, row, column]), -limit), limit)
        if before == after:
            continue
        # The oldest bin is at position 0 of a volume, the current one at the last.
        position = (slot - now - 1) % n_bins
        first_row, last_row = covering(row, shape[0], operator)
        first_column, last_column = covering(column, shape[1], operator)
        for r in range(first_row, last_row):
            for c in range(first_column, last_column):
                volume = r * shape[1] + c
                projection, moments = state.projections[volume], state.moments[volume]
                if state.is_dirty[volume] == 0:
                    state.is_dirty[volume] = 1
                    state.dirty[n_dirty] = volume
                    n_dirty += 1
                    pool_volume(volume, -1, shape, operator, state)
                top, left = r * operator.stride, c * operator.stride
                if operator.quadratic.shape[0]:
                    gather_volume(applied, (now + 1) % n_bins, top, left, operator.patch, state.values)
                entry = (position * operator.patch + row - top) * operator.patch + column - left
                change_entry(entry, before, after, state.values, operator, projection, moments)
        applied[slot, row, column] = after
    for i in range(n_dirty):
        volume = state.dirty[i]
        state.is_dirty[volume] = 0
        pool_volume(volume, 1, shape, operator, state)
    state.clock[CLOCK_TOUCHED] = 0
    return n_dirty
