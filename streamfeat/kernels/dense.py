"""Volumes with more entries than not: their projections as one product, several volumes at a time.

Lives here: the choice between adding columns and multiplying all of them, volumes that wait for the product,
and the product.
Not here: which volumes enter a plane, and when (`planes`); entries that change one by one (`volume`).

Adding a column reads it from the second cache, and that is what it costs: 8.6 ns an entry at K = 400. A
product reads a pair of columns once for six volumes and keeps 32 filters of all of them in registers: 1.54 us
a volume of 432 entries whatever is in them, which is the peak of the multipliers. It is a sum of the same
integers, so the bits are the same. Measured on one core (Zen 4, `vpdpwssd` of 512 bits), ns a volume:

    entries that are not zero     40    80   120   160   200   280   350   432
    columns added                360   686  1016  1380  1726  2447  3030  3693
    product                     1532  1533  1537  1533  1536  1556  1538  1543

A product in float32 by BLAS is exact too where sums stay below 2^24, and takes 3.6 us a volume there. So a
bin boundary is bounded: it cannot cost more than the product of all volumes, however many events there are.
"""

import numpy as np

from streamfeat.kernels.assembly import BLOCK
from streamfeat.kernels.compiled import inlined, kernel
from streamfeat.kernels.ingest import slot_of
from streamfeat.kernels.layout import MOMENT_SQUARES, Operator, State
from streamfeat.kernels.vectors import TILE, multiply_tile
from streamfeat.kernels.volume import add_moments, gather_volume, list_entries, sum_columns

MOST_WAITING = 24
"""Volumes that wait for the product at most; whole tiles."""

MANY, OF = 2, 5
"""A volume waits for the product if more than `MANY / OF` of its entries are not zero."""

WORTH_A_TILE = 4
"""Volumes in a tile that is not full, for which the product is still quicker than their columns."""


@inlined
def can_wait(state: State) -> bool:
    """Whether volumes may wait: each has a row of its own, and there are no forms of its entries."""
    return state.awaiting.shape[1] > 0


@inlined
def let_in(
    plane: int, volume: int, ahead: int, waiting: int, part: int, operator: Operator, state: State
) -> tuple[int, int]:
    """Project a volume from nothing; or let it wait for the product, if most of its entries are not zero.

    Args:
        plane: which plane.
        volume: which volume.
        ahead: bins by which the plane is ahead, 0 or 1.
        waiting: volumes that wait already, fewer than `MOST_WAITING`.
        part: whose scratch to use.
        operator: the encoder, without a quadratic form.
        state: the row and scratch are changed; the moments are right in either case.

    Returns:
        how many entries are not zero, and how many volumes wait.
    """
    projection, moments = state.projections[plane, volume], state.moments[plane, volume]
    values, entries, changes = state.windows[part, waiting], state.entries[part], state.changes[part]
    patch, columns, d = operator.patch, operator.shape[1], operator.columns.shape[0]
    end = (state.applied.shape[0] - ahead) * patch[0] * patch[1]
    top, left = volume // columns * operator.stride, volume % columns * operator.stride
    gather_volume(state.applied, slot_of(ahead, state), np.int64(0), end, top, left, patch, values)
    n = 0
    for i in range(end):
        n += int(values[i] != 0)
    if OF * n > MANY * d:
        values[end:] = 0
        state.awaiting[part, waiting] = volume
        moments[:] = 0
        add_moments(end, values, moments)
        return n, waiting + 1
    list_entries(values, np.int64(0), end, entries, changes)
    if n > 0 or moments[MOMENT_SQUARES] != 0:
        sum_columns(n, entries, changes, operator.columns, projection)
    moments[:] = 0
    add_moments(n, changes, moments)
    return n, waiting


@kernel
def multiply(plane: int, waiting: int, part: int, operator: Operator, state: State) -> None:
    """Project the volumes that wait.

    Args:
        plane: that they are of.
        waiting: how many.
        part: whose scratch to use.
        operator: the encoder.
        state: their rows and scratch are changed.
    """
    projections, windows, rows = state.projections[plane], state.windows[part], state.awaiting[part]
    rest = waiting % TILE
    whole = waiting if rest >= WORTH_A_TILE else waiting - rest
    for block in range(operator.packed.shape[0]):
        columns = operator.packed[block]
        for first in range(0, whole, TILE):
            multiply_tile(whole, first, windows, rows, columns, block * BLOCK, projections)
    entries, changes = state.entries[part], state.changes[part]
    for i in range(whole, waiting):
        n = list_entries(windows[i], np.int64(0), operator.columns.shape[0], entries, changes)
        sum_columns(n, entries, changes, operator.columns, projections[rows[i]])
