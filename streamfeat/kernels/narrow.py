"""The narrow state: projections of 16 bits, and codes by arithmetic of 16 bits.

Lives here: the code of a volume in the narrow state, pooling it, and volumes that move together.
Not here: the vector code that does it for blocks of filters (`lanes`), the wide state (`code`), and the
arithmetic that proves that nothing overflows (`engine.narrow`).

With a step `s_k` for each filter, `P[k] ~ s_k Q[k]`, so that `max_count sum |Q[k]| < 2^15`, a projection
`Q v` fits into 16 bits whatever the volume. A code is `gain (q_k / sigma) - gain c_k / s_k`, thresholded, in
units of `s_k / gain` of its own filter; the gain is such that no code exceeds `MOST_CODE`. `q` is multiplied
as `(q << shift) * factor >> 16`, the upper half of a product of 16 bits, and the bounds of positive and
negative codes are rounded with that: one instruction for each step, of 32 numbers at once.

A code is kept as its positive and its negative part, each the saturated difference of two unsigned numbers;
what is pooled are the sums of both, whatever the encoding.
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.code import deviation
from streamfeat.kernels.compiled import inlined, kernel
from streamfeat.kernels.lanes import move_group, pool_row
from streamfeat.kernels.layout import (
    QUEUED_CELL,
    QUEUED_PLANE,
    QUEUED_SIGN,
    QUEUED_VOLUMES,
    Operator,
    State,
)
from streamfeat.kernels.volume import change_moments, sum_columns

MOST_SHIFT = 15


@inlined
def narrow_gain(moments: NDArray[np.int64], operator: Operator) -> int:
    """What a projection is multiplied with, to be normalised and in units of codes.

    Args:
        moments: `(4,)` of a volume that is not empty.
        operator: the encoder.

    Returns:
        a shift of 0 to 15, and above its 16 bits a factor below 2^15: `(q << shift) * factor >> 16`.
    """
    sigma = deviation(moments, operator.columns.shape[0], operator.eps)
    # The fifteen highest bits of the gain, and where they stand: what frexp finds, which takes longer.
    bits = np.float64(operator.gain / sigma).view(np.int64)
    shift, factor = (bits >> 52) - 1021, bits >> 38 & 0x3FFF | 0x4000
    if shift < 0:
        shift, factor = np.int64(0), factor >> min(-shift, np.int64(15))
    return min(shift, MOST_SHIFT) | factor << 16


@kernel
def narrow_code(
    packed: int,
    projection: NDArray[np.int16],
    upper: NDArray[np.uint16],
    lower: NDArray[np.uint16],
    code: NDArray[np.int32],
) -> None:
    """Closed-form code of the direct formulation in the narrow state: positive less negative part.

    Args:
        packed: see `narrow_gain`.
        projection: `(Kp,)` of a volume that is not empty.
        upper: of the operator.
        lower: of the operator.
        code: `(Kp,)`, overwritten.
    """
    shift, factor = packed & 0xFFFF, packed >> 16
    for k in range(code.shape[0]):
        level = ((np.int64(projection[k]) << shift) * factor >> 16) + 2**15
        positive = max(level - np.int64(upper[k]), 0)
        code[k] = positive - max(np.int64(lower[k]) - level, 0)


@kernel
def pool_narrow(
    sign: int,
    packed: int,
    projection: NDArray[np.int16],
    upper: NDArray[np.uint16],
    lower: NDArray[np.uint16],
    pooled: NDArray[np.int32],
) -> None:
    """Add the code of one volume to the sums of its cell, or take it away.

    Args:
        sign: 1 or -1.
        packed: see `narrow_gain`.
        projection: `(Kp,)` of a volume that is not empty.
        upper: of the operator.
        lower: of the operator.
        pooled: `(2 Kp,)` of the cell, changed: positive parts, then negative ones.
    """
    pool_row(sign, packed, projection, upper, lower, pooled)


@kernel
def move_rows(
    n: int,
    sign: int,
    queue: NDArray[np.int64],
    columns: NDArray[np.int16],
    projections: NDArray[np.int16],
    upper: NDArray[np.uint16],
    lower: NDArray[np.uint16],
    pooled: NDArray[np.int32],
) -> None:
    """Let volumes of one cell follow a column each: their projections, their codes, and the sums of the cell.

    Args:
        n: how many volumes.
        sign: -1 to subtract the columns, else they are added.
        queue: `(>= n, 3)`: where in `columns` the column begins, where in `projections` the projection; gain
            before, and shifted by 32 the gain after (see `narrow_gain`). No volume comes twice.
        columns: one after the other.
        projections: of all volumes, one after the other; changed.
        upper: of the operator.
        lower: of the operator.
        pooled: `(2 Kp,)` of the cell, changed: positive parts, then negative ones.
    """
    move_group(n, sign, queue, columns, projections, upper, lower, pooled)


@inlined
def move_queued(part: int, operator: Operator, state: State) -> None:
    """Let the volumes that wait in the queue follow their columns.

    Args:
        part: whose queue.
        operator: the encoder.
        state: projections of these volumes, sums of their cell and the queue are changed.
    """
    queued = state.queued[part]
    n, plane, cell, sign = (
        queued[QUEUED_VOLUMES],
        queued[QUEUED_PLANE],
        queued[QUEUED_CELL],
        queued[QUEUED_SIGN],
    )
    if n > 0:
        sums = state.pooled[plane, cell] if part == 0 else state.partial[part - 1, plane, cell]
        # Single columns lie in the operator, sums of several beside the queue.
        columns = state.sums[part].reshape(-1) if sign == 0 else operator.columns.reshape(-1)
        rows = state.projections.reshape(-1)
        move_rows(n, sign, state.queue[part], columns, rows, operator.upper, operator.lower, sums)
        queued[QUEUED_VOLUMES] = 0


@inlined
def queue_volume(plane: int, volume: int, n: int, part: int, operator: Operator, state: State) -> None:
    """Let listed entries of a volume change that is coded and not empty before or after: it waits in a queue.

    Volumes wait for others of the same cell, for the codes of all are summed in registers. A volume is
    queued at most once before `move_queued`.

    Args: as for `change.change_volume`.
    """
    entries, changes = state.entries[part], state.changes[part]
    moments, queued, width = state.moments[plane, volume], state.queued[part], operator.columns.shape[1]
    sign, cell = np.int64(0), np.int64(state.cells[volume])
    if n == 1 and abs(changes[0]) == 1:
        sign = np.int64(changes[0])
    if queued[QUEUED_VOLUMES] == state.queue.shape[1] or (
        queued[QUEUED_VOLUMES] > 0
        and (queued[QUEUED_PLANE] != plane or queued[QUEUED_CELL] != cell or queued[QUEUED_SIGN] != sign)
    ):
        move_queued(part, operator, state)
    at = queued[QUEUED_VOLUMES]
    queued[QUEUED_PLANE], queued[QUEUED_CELL], queued[QUEUED_SIGN] = plane, cell, sign
    place = state.queue[part, at]
    if sign == 0:
        sum_columns(n, entries, changes, operator.columns, state.sums[part, at + 1])
        place[0] = (at + 1) * width
    else:
        place[0] = np.int64(entries[0]) * width
    place[1] = (plane * state.projections.shape[1] + volume) * width
    before = narrow_gain(moments, operator)
    change_moments(n, entries, changes, state.values[part, 0], operator, moments)
    place[2] = before | narrow_gain(moments, operator) << 32
    queued[QUEUED_VOLUMES] = at + 1
    state.encoded[part] += 1
