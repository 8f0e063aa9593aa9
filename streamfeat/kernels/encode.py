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
from streamfeat.kernels.compiled import inlined, kernel
from streamfeat.kernels.lasso import CODE, fix_atoms, lasso_code
from streamfeat.kernels.layout import CLOCK_PLANE, MOMENT_SQUARES, SPLIT, TRIANGLE, Operator, State
from streamfeat.kernels.narrow import narrow_code, narrow_gain, pool_narrow

ADD, TAKE = np.int64(1), np.int64(-1)
"""NumPy scalars, because a kernel is compiled once more for each Python literal it is called with."""


@kernel
def encode_volume(
    projection: NDArray[np.int32] | NDArray[np.int16],
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
    kinds = operator.upper, operator.wide, operator.lasso
    write_code(*kinds, projection, moments, atoms, fresh, part, operator, state)


@inlined
def write_code(
    narrow: NDArray[np.uint16] | None,
    wide: bool | None,
    lasso: bool | None,
    projection: NDArray[np.int32] | NDArray[np.int16],
    moments: NDArray[np.int64],
    atoms: NDArray[np.float64],
    fresh: bool,
    part: int,
    operator: Operator,
    state: State,
) -> None:
    """Write the code of a volume that is not empty.

    Args: as for `encode_volume`, after `operator.upper`, `operator.wide` and `operator.lasso`, all but one
        of which are None: numba forgets what would be done if they were not, so that each kind of state
        compiles the code of its own only.
    """
    code = state.code[part, 0]
    if narrow is not None:
        narrow_code(narrow_gain(moments, operator), projection, operator.upper, operator.lower, code)
    if wide is not None:
        sigma = deviation(moments, operator.columns.shape[0], operator.eps)
        if operator.kind == TRIANGLE:
            triangle_code(projection, sigma, whitened_square(moments, sigma, operator), operator, code)
        else:
            soft_code(projection, sigma, operator, code)
    if lasso is not None:
        if fresh:
            sigma = deviation(moments, operator.columns.shape[0], operator.eps)
            square = whitened_square(moments, sigma, operator)
            work, active, corners = state.work[part], state.active[part], state.corners[part]
            lasso_code(projection, sigma, square, operator, atoms, work, active, corners)
        fix_atoms(atoms[CODE], operator, code)


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
    if sign == ADD:
        state.encoded[part] += 1
    cell = state.cells[volume]
    sums = state.pooled[plane, cell] if part == 0 else state.partial[part - 1, plane, cell]
    kinds = operator.upper, operator.wide, operator.lasso
    pool_row_of(*kinds, plane, row, sign, part, operator, state, sums)


@inlined
def pool_row_of(
    narrow: NDArray[np.uint16] | None,
    wide: bool | None,
    lasso: bool | None,
    plane: int,
    row: int,
    sign: int,
    part: int,
    operator: Operator,
    state: State,
    sums: NDArray[np.int32],
) -> None:
    """Encode a row of a plane, and add it to the sums of its cell or take it away.

    Args: as for `pool_volume`, after the kinds of state (see `write_code`) and before the sums of the cell.
    """
    projection, moments = state.projections[plane, row], state.moments[plane, row]
    atoms, fresh = state.atoms[plane, row], sign == ADD
    if narrow is not None:  # noqa: SIM102 - a None alone is seen through
        if moments[MOMENT_SQUARES] != 0:
            factors = narrow_gain(moments, operator)
            pool_narrow(sign, factors, projection, operator.upper, operator.lower, sums)
    if lasso is not None:
        encode_volume(projection, moments, atoms, fresh, part, operator, state)
        if moments[MOMENT_SQUARES] != 0:
            pool(state.code[part, 0], sign, operator.kind, sums)
    if wide is not None:
        if operator.kind == TRIANGLE or moments[MOMENT_SQUARES] == 0:
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
    pooled, size = state.pooled[state.clock[CLOCK_PLANE]], features.shape[0] // state.pooled.shape[1]
    own, place = pooled[cell : cell + 1], features[cell * size : (cell + 1) * size]
    write_features(operator.steps, operator, own, place)


@kernel
def read_features(operator: Operator, state: State, features: NDArray[np.float32]) -> None:
    """Write the pooled sums of the current plane as floats, cell by cell and without padding.

    Args:
        operator: number of filters, encoding and fixed point.
        state: not changed.
        features: `(cells * K,)`, or `(cells * 2 K,)` for SPLIT, in each cell positive parts before negative
            ones; overwritten.
    """
    write_features(operator.steps, operator, state.pooled[state.clock[CLOCK_PLANE]], features)


@inlined
def write_features(
    steps: NDArray[np.float64] | None,
    operator: Operator,
    pooled: NDArray[np.int32],
    features: NDArray[np.float32],
) -> None:
    """Write pooled sums of the cells as floats.

    Args:
        steps: of the operator (see `write_code`).
        operator: number of filters, encoding and fixed point.
        pooled: `(cells, F)`.
        features: as for `read_features`.
    """
    n, width, per_unit = operator.n_filters, operator.offset.shape[0], 1.0 / operator.unit
    split = operator.kind == SPLIT
    for q in range(pooled.shape[0]):
        one, other = pooled[q, :width], pooled[q, width:]
        first = features[2 * q * n :] if split else features[q * n :]
        if steps is not None:
            for k in range(n):
                first[k] = np.float32((one[k] if split else one[k] - other[k]) * steps[k])
            if split:
                for k in range(n):
                    first[n + k] = np.float32(other[k] * steps[k])
        else:
            if split:
                for k in range(n):
                    first[k] = np.float32((np.int64(other[k]) + one[k]) // 2 * per_unit)
                for k in range(n):
                    first[n + k] = np.float32((np.int64(other[k]) - one[k]) // 2 * per_unit)
            else:
                for k in range(n):
                    first[k] = np.float32(one[k] * per_unit)
