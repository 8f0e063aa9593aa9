"""One volume of a plane: where it lies, what its code is, and its part in the pooled sums.

Lives here: the choice of the code that the operator asks for, pooling by cell, reading what is pooled.
Not here: the codes themselves (`code`, `lasso`), and which volume is encoded when (`planes`, `update`).
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.code import (
    deviation,
    gain,
    pool,
    pool_soft,
    soft_code,
    triangle_code,
    whitened_square,
)
from streamfeat.kernels.compiled import kernel
from streamfeat.kernels.lasso import CODE, fix_atoms, lasso_code
from streamfeat.kernels.layout import CLOCK_PLANE, MOMENT_SQUARES, SPLIT, TRIANGLE, Operator, State

ADD, TAKE = np.int64(1), np.int64(-1)
"""NumPy scalars, because a kernel is compiled once more for each Python literal it is called with."""


@kernel
def encode_volume(
    projection: NDArray[np.int32],
    moments: NDArray[np.int64],
    atoms: NDArray[np.float64],
    fresh: bool,
    part: int,
    operator: Operator,
    state: State,
) -> None:
    """Write the code of a volume to `state.code[part, 0]`; a volume whose counts are all zero has code zero.

    Args:
        projection: `(Kp,)` of the volume.
        moments: `(4,)` of the volume.
        atoms: `(2, K)` last lasso code and its response; changed when `fresh`.
        fresh: solve the lasso again (True), or show the code that was found last (False).
        part: whose scratch to use.
        operator: the encoder.
        state: `code`, `work`, `active` and `corners` of the part are overwritten.
    """
    code = state.code[part, 0]
    if moments[MOMENT_SQUARES] == 0:
        if fresh:
            atoms[:] = 0
        code[:] = 0
        return
    sigma = deviation(moments, operator.columns.shape[0], operator.eps)
    if operator.inverse:
        if fresh:
            square = whitened_square(moments, sigma, operator)
            work, active, corners = state.work[part], state.active[part], state.corners[part]
            lasso_code(projection, sigma, square, operator, atoms, work, active, corners)
        fix_atoms(atoms[CODE], operator, code)
    elif operator.kind == TRIANGLE:
        triangle_code(projection, sigma, whitened_square(moments, sigma, operator), operator, code)
    else:
        soft_code(projection, sigma, operator, code)


@kernel
def pool_volume(
    plane: int, row: int, volume: int, sign: int, part: int, operator: Operator, state: State
) -> None:
    """Encode one volume, and add it to the pooled sums of its plane or take what was added from them.

    Args:
        plane: of the volume.
        row: where its projection is; `volume`, but where volumes share a row.
        volume: which.
        sign: ADD its code as it is now, or TAKE away the code it had.
        part: whose scratch and sums to use.
        operator: the encoder.
        state: `pooled` or `partial`, `atoms`, `encoded` and scratch are changed.
    """
    projection, moments = state.projections[plane, row], state.moments[plane, row]
    atoms = state.atoms[plane, row]
    fresh = sign == ADD
    if fresh:
        state.encoded[part] += 1
    cell = state.cells[volume]
    sums = state.pooled[plane, cell] if part == 0 else state.partial[part - 1, plane, cell]
    if operator.inverse or operator.kind == TRIANGLE or moments[MOMENT_SQUARES] == 0:
        encode_volume(projection, moments, atoms, fresh, part, operator, state)
        if moments[MOMENT_SQUARES] != 0:
            pool(state.code[part, 0], sign, operator.kind, sums)
    else:
        factor = gain(deviation(moments, operator.columns.shape[0], operator.eps), operator)
        threshold = np.float32(operator.threshold)
        pool_soft(sign, projection, factor, operator.offset, threshold, operator.kind, sums)


@kernel
def read_cell(cell: int, operator: Operator, state: State, features: NDArray[np.float32]) -> None:
    """Write the pooled sums of one cell of the current plane as floats, without padding.

    Args:
        cell: which.
        operator: number of filters, encoding and fixed point.
        state: not changed.
        features: as for `read_features`; those of the cell are overwritten.
    """
    pooled, n = state.pooled[state.clock[CLOCK_PLANE], cell], operator.n_filters
    width, per_unit = operator.offset.shape[0], 1.0 / operator.unit
    if operator.kind == SPLIT:
        sums, sizes = pooled[:width], pooled[width:]
        positive, negative = features[2 * cell * n : (2 * cell + 1) * n], features[(2 * cell + 1) * n :]
        for k in range(n):
            positive[k] = np.float32((np.int64(sizes[k]) + sums[k]) // 2 * per_unit)
        for k in range(n):
            negative[k] = np.float32((np.int64(sizes[k]) - sums[k]) // 2 * per_unit)
    else:
        for k in range(n):
            features[cell * n + k] = np.float32(pooled[k] * per_unit)


@kernel
def read_features(operator: Operator, state: State, features: NDArray[np.float32]) -> None:
    """Write the pooled sums of the current plane as floats, cell by cell and without padding.

    Args:
        operator: number of filters, encoding and fixed point.
        state: not changed.
        features: `(cells * K,)`, or `(cells * 2 K,)` for SPLIT, in each cell positive parts before negative
            ones; overwritten.
    """
    for cell in range(state.pooled.shape[1]):
        read_cell(cell, operator, state, features)
