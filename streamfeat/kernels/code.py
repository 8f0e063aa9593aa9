"""From the projection of a volume to its code in fixed point, and from codes to pooled features.

Lives here: normalisation by the standard deviation, the soft threshold, the triangle encoding, pooling.
Not here: the lasso (`lasso`), and which volume is encoded when (`update`).

Floats are handled one by one in float32, without `fastmath`: no contraction and no reassociation, so
the bits do not depend on how the loop is vectorised. Whatever is summed is an integer.
"""

import math

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.compiled import inlined, kernel
from streamfeat.kernels.layout import (
    MOMENT_LINEAR,
    MOMENT_QUADRATIC,
    MOMENT_SQUARES,
    MOMENT_SUM,
    SPLIT,
    Operator,
)


@inlined
def deviation(moments: NDArray[np.int64], entries: int, eps: float) -> float:
    """Standard deviation of a volume's entries, `sqrt(mean of squares - square of mean + eps)`."""
    share = 1.0 / entries  # the same for all volumes: divided once, not four times an event
    mean = moments[MOMENT_SUM] * share
    return math.sqrt(moments[MOMENT_SQUARES] * share - mean * mean + eps)


@inlined
def gain(sigma: float, operator: Operator) -> np.float32:
    """What a projection is multiplied with, to be normalised and in fixed point: `z = q gain - offset`."""
    return np.float32(operator.scale * operator.unit / sigma)


@kernel
def whitened_square(moments: NDArray[np.int64], sigma: float, operator: Operator) -> float:
    """`|x|^2` of a volume, from its quadratic and linear form; from 0 to the square of `operator.reach`."""
    quadratic = moments[MOMENT_QUADRATIC] * operator.quadratic_scale / (sigma * sigma)
    linear = moments[MOMENT_LINEAR] * operator.linear_scale / sigma
    return min(max(quadratic - 2.0 * linear + operator.constant, 0.0), operator.reach * operator.reach)


@kernel
def soft_code(
    projection: NDArray[np.int32], sigma: float, operator: Operator, code: NDArray[np.int32]
) -> None:
    """Closed-form code of the direct formulation: `sign(z) max(|z| - lambda0, 0)`, in fixed point.

    Kostadinov and Scaramuzza, ICPR 2020/21, direct problem formulation, sparse coding step.
    """
    factor, threshold = gain(sigma, operator), np.float32(operator.threshold)
    for k in range(code.shape[0]):
        z = np.float32(projection[k]) * factor - operator.offset[k]
        code[k] = np.int32(z - min(max(z, -threshold), threshold))


@kernel
def triangle_code(
    projection: NDArray[np.int32],
    sigma: float,
    square: float,
    operator: Operator,
    code: NDArray[np.int32],
) -> None:
    """Triangle encoding `max(0, mean distance - distance)` (Coates, Ng and Lee 2011), in fixed point.

    Args:
        projection: `(Kp,)`.
        sigma: standard deviation of the volume.
        square: `|x|^2` of the whitened volume.
        operator: scale, offset and squared norms.
        code: `(Kp,)`, overwritten; zero beyond `n_filters`.
    """
    n_filters, unit = operator.n_filters, np.float32(operator.unit)
    factor, length = gain(sigma, operator), np.float32(square)
    for k in range(n_filters):
        z = np.float32(projection[k]) * factor - operator.offset[k]
        code[k] = fixed_distance(z, length, operator.square_norms[k], unit)
    mean = mean_distance(code, n_filters)
    for k in range(n_filters):
        code[k] = max(mean - code[k], 0)
    code[n_filters:] = 0


@inlined
def mean_distance(distances: NDArray[np.int32], n_filters: int) -> np.int32:
    """Mean of the first `n_filters` distances, rounded down."""
    total = np.int64(0)
    for k in range(n_filters):
        total += distances[k]
    return np.int32(total // n_filters)


@inlined
def fixed_distance(z: np.float32, length: np.float32, square_norm: np.float32, unit: np.float32) -> np.int32:
    """Distance of a volume from a filter, `sqrt(|x|^2 - 2 a.x + |a|^2)`, in fixed point.

    Args:
        z: `a.x`, times `unit`.
        length: `|x|^2`.
        square_norm: `|a|^2`.
        unit: of the fixed point, a power of two.
    """
    # Dividing by a power of two is exact, and so is multiplying by what it leaves of one.
    square = length - z * (np.float32(2.0) / unit) + square_norm
    return np.int32(np.sqrt(max(square, np.float32(0.0))) * unit)


@kernel
def pool(code: NDArray[np.int32], sign: int, kind: int, pooled: NDArray[np.int32]) -> None:
    """Add (`sign` 1) or take away (`sign` -1) the code of one volume from the sums of its cell.

    Args:
        code: `(Kp,)` fixed point; not changed.
        sign: 1 or -1.
        kind: SPLIT sums absolute values too.
        pooled: `(F,)`, changed.
    """
    width = code.shape[0]
    for k in range(width):
        pooled[k] += sign * code[k]
    if kind == SPLIT:
        for k in range(width):
            pooled[width + k] += sign * abs(code[k])


@kernel
def pool_soft(
    sign: int,
    projection: NDArray[np.int32],
    factor: np.float32,
    offset: NDArray[np.float32],
    threshold: np.float32,
    kind: int,
    pooled: NDArray[np.int32],
) -> None:
    """Same bits as `soft_code` and `pool`, in one run over memory.

    Args:
        sign: 1 to add the code of a volume, -1 to take it away.
        projection: `(Kp,)` of the volume; not changed.
        factor: of the volume, see `gain`.
        offset: `(Kp,)` of the operator.
        threshold: of the operator.
        kind: SOFT or SPLIT.
        pooled: `(F,)` of the volume's cell, changed.
    """
    width = projection.shape[0]
    sums, sizes = pooled[:width], pooled[width:]
    split = kind == SPLIT
    for k in range(width):
        z = np.float32(projection[k]) * factor - offset[k]
        code = np.int32(z - min(max(z, -threshold), threshold))
        sums[k] += sign * code
        if split:
            sizes[k] += sign * abs(code)


@kernel
def move_code(
    change: int,
    column: NDArray[np.int16] | NDArray[np.int32],
    projection: NDArray[np.int32],
    gain_before: np.float32,
    gain_after: np.float32,
    offset: NDArray[np.float32],
    threshold: np.float32,
    kind: int,
    pooled: NDArray[np.int32],
) -> None:
    """Entries of a volume change: projection, soft code and pooled sums follow in one run over memory.

    Same bits as taking the old code away, adding the column, and adding the new code. The old code is
    computed again from the old projection: keeping it would move as many bytes as the projection itself.

    Args:
        change: 1 to add the column, -1 to subtract it.
        column: `(Kp,)` int16 of one entry, or the int32 sum of several columns.
        projection: `(Kp,)` of the volume, changed.
        gain_before: of the volume before the change, see `gain`.
        gain_after: and after it.
        offset: `(Kp,)` of the operator.
        threshold: of the operator.
        kind: SOFT or SPLIT.
        pooled: `(F,)` of the volume's cell, changed.
    """
    width = projection.shape[0]
    sums, sizes = pooled[:width], pooled[width:]
    # Conditions that hold for the whole run: the compiler makes a loop for each case, in a function as small
    # as this. A product of column and change would be the slowest instruction of them all.
    up, split = change > 0, kind == SPLIT
    for k in range(width):
        q, c = projection[k], np.int32(column[k])
        moved = np.int32(q + c) if up else np.int32(q - c)
        projection[k] = moved
        z = np.float32(q) * gain_before - offset[k]
        old = np.int32(z - min(max(z, -threshold), threshold))
        z = np.float32(moved) * gain_after - offset[k]
        new = np.int32(z - min(max(z, -threshold), threshold))
        sums[k] += new - old
        if split:
            sizes[k] += abs(new) - abs(old)


@kernel
def move_triangle(
    change: int,
    column: NDArray[np.int16] | NDArray[np.int32],
    projection: NDArray[np.int32],
    gains: tuple[np.float32, np.float32],
    lengths: tuple[np.float32, np.float32],
    offset: NDArray[np.float32],
    norms: NDArray[np.float32],
    n_filters: int,
    unit: np.float32,
    pooled: NDArray[np.int32],
    codes: NDArray[np.int32],
) -> None:
    """The same as `move_code` for the triangle encoding: distances in one run, the mean of them, codes.

    Args:
        change: what the column is multiplied with, as for `move_code`.
        column: `(Kp,)` of one entry, or the sum of several.
        projection: `(Kp,)` of the volume, changed.
        gains: of the volume before the change and after it, see `gain`.
        lengths: `|x|^2` of the whitened volume before the change and after it.
        offset: `(Kp,)` of the operator.
        norms: `(Kp,)` squared length of each filter.
        n_filters: of the operator.
        unit: of the fixed point.
        pooled: `(Kp,)` of the volume's cell, changed.
        codes: `(2, Kp)` scratch.
    """
    step, old, new = np.int32(change), codes[0], codes[1]
    for k in range(n_filters):
        q = projection[k]
        moved = np.int32(q + step * np.int32(column[k]))
        projection[k] = moved
        old[k] = fixed_distance(np.float32(q) * gains[0] - offset[k], lengths[0], norms[k], unit)
        new[k] = fixed_distance(np.float32(moved) * gains[1] - offset[k], lengths[1], norms[k], unit)
    mean_before, mean_after = mean_distance(old, n_filters), mean_distance(new, n_filters)
    for k in range(n_filters):
        pooled[k] += max(mean_after - new[k], 0) - max(mean_before - old[k], 0)
