"""Planes: all volumes at one bin, current or the next.

Lives here: letting volumes enter a plane, all at once (`complete`) or in bounded slices (`look_ahead`).
Not here: changes of volumes that are in a plane (`update`, `follow`), and the swap (`ingest`).

A bin boundary moves every entry of every volume by one bin, so all that is not empty must be projected
again. Done when somebody next reads, that is the longest wait of the whole system. Looking ahead spreads
it over the bin before: what volumes will be after the boundary is prepared beside what they are now.
A volume enters in two steps. Once it is projected an event costs it one more column; only once it is coded
does it cost a second code, so codes come last, shortly before the boundary.

What was compared, at K = 1700, 7 bins, stride 4, N-CARS at recorded order; p50, p99 and p99.9 of one
event in us. One plane, rebuilt by the first event of a bin: 3.4, 10, 770, and 10 ms at worst. Looking
ahead in slices of 96 columns an event: 8.8, 43, 82. Slices of 24 columns, and more only where a bin is
behind its pace: 7.8, 24, 38; this is kept (`tools/bench`, part `latency`, measures it and the first). A
projection for each bin to come was not built: it adds a column for every bin to every event and holds T
times the memory, and codes and pooled sums would still all change at the boundary. A plane that is not
complete when its bin begins is completed then.
"""

import numpy as np

from streamfeat.kernels.compiled import kernel
from streamfeat.kernels.encode import ADD, lower_part, pool_volume
from streamfeat.kernels.ingest import slot_of
from streamfeat.kernels.lasso import respond
from streamfeat.kernels.layout import (
    CLOCK_PLANE,
    CURSOR_CODED,
    CURSOR_ENTRY,
    CURSOR_PROJECTED,
    MOMENT_SQUARES,
    Operator,
    State,
)
from streamfeat.kernels.volume import change_entries, gather_volume, list_filled

CURRENT, NEXT = np.int64(0), np.int64(1)
"""Bins by which a plane is ahead."""

CODE_COST = 6
"""Columns that could be added while one volume is encoded and pooled."""


@kernel
def project_volume(
    plane: int,
    volume: int,
    ahead: int,
    start: int,
    most: int,
    part: int,
    shape: tuple[int, int],
    operator: Operator,
    state: State,
) -> tuple[int, int]:
    """Let entries of a volume into its projection in a plane, in order.

    Args:
        plane: which plane.
        volume: which volume. Where the plane has a single row, volumes share it.
        ahead: CURRENT for the current bin, NEXT for the bin after it.
        start: first entry that is not in yet; from 0 on, what the row held before is cleared.
        most: entries that are not zero to let in at most.
        part: whose scratch to use.
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: the row and scratch are changed.

    Returns:
        how many entries that are not zero were let in, and the entry to go on from.
    """
    row = min(volume, state.projections.shape[1] - 1)
    projection, moments = state.projections[plane, row], state.moments[plane, row]
    values, entries, changes = state.values[part], state.entries[part], state.changes[part]
    if start == 0 and moments[MOMENT_SQUARES] != 0:
        projection[:] = 0
        moments[:] = 0
    n_bins, patch = state.applied.shape[0], operator.patch
    end = (n_bins - ahead) * patch * patch
    top, left = volume // shape[1] * operator.stride, volume % shape[1] * operator.stride
    first_slot = slot_of(ahead, state)
    n, following = list_filled(
        state.applied, first_slot, start, end, most, top, left, patch, entries, changes
    )
    if operator.quadratic.shape[0]:
        gather_volume(state.applied, first_slot, start, top, left, patch, values)
    else:
        for i in range(n):
            values[entries[i]] = 0
    change_entries(n, entries, changes, values, operator, projection, moments)
    return n, following


@kernel
def enter_code(
    plane: int, volume: int, part: int, shape: tuple[int, int], operator: Operator, state: State
) -> bool:
    """Encode a volume that was projected, and add it to the pooled sums of its plane.

    Args:
        plane: which plane.
        volume: which volume. Where the plane has a single row, volumes share it.
        part: whose scratch to use.
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: `atoms`, `pooled`, `encoded` and scratch are changed.

    Returns:
        whether the volume had a count, and so a code.
    """
    row = min(volume, state.projections.shape[1] - 1)
    if state.moments[plane, row, MOMENT_SQUARES] == 0:
        state.atoms[plane, row] = 0
        return False
    if operator.inverse:
        respond(operator.gram, state.atoms[plane, row], state.work[part], state.active[part])
    pool_volume(plane, row, volume, ADD, part, shape, operator, state)
    return True


@kernel
def complete(part: int, shape: tuple[int, int], operator: Operator, state: State) -> None:
    """Let all volumes of one part of the grid that are missing enter the current plane.

    Args:
        part: 0 for the upper half, 1 for the lower. The cursors stay, for the other part to see.
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: the plane and scratch of the part are changed.
    """
    plane = state.clock[CLOCK_PLANE]
    cursors, half = state.cursors[plane], lower_part(shape, operator.pooling)
    first, last = (0, half) if part == 0 else (half, shape[0] * shape[1])
    for volume in range(max(first, cursors[CURSOR_CODED]), last):
        if volume >= cursors[CURSOR_PROJECTED]:
            start = cursors[CURSOR_ENTRY] if volume == cursors[CURSOR_PROJECTED] else np.int64(0)
            most = state.values.shape[1]
            project_volume(plane, volume, CURRENT, start, most, part, shape, operator, state)
        enter_code(plane, volume, part, shape, operator, state)


@kernel
def look_ahead(
    projected: int, coded: int, budget: int, shape: tuple[int, int], operator: Operator, state: State
) -> int:
    """Let volumes enter the plane that looks ahead, as far as asked or until the budget is spent.

    Args:
        projected: volumes that shall have a projection.
        coded: volumes that shall have a code.
        budget: columns that may be added; encoding a volume counts for `CODE_COST`.
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: the other plane and scratch are changed; nothing happens if there is one plane only, or the
            current one is not complete.

    Returns:
        what is left of the budget.
    """
    current, volumes = state.clock[CLOCK_PLANE], shape[0] * shape[1]
    if state.cursors.shape[0] == 1 or state.cursors[current, CURSOR_CODED] < volumes:
        return budget
    plane = 1 - current
    cursors, moments, part = state.cursors[plane], state.moments[plane], np.int64(0)
    while budget > 0 and cursors[CURSOR_PROJECTED] < projected:
        volume, start = cursors[CURSOR_PROJECTED], cursors[CURSOR_ENTRY]
        end = operator.columns.shape[0]
        # What is empty now will be empty then.
        if start > 0 or state.moments[current, volume, MOMENT_SQUARES] or moments[volume, MOMENT_SQUARES]:
            n, start = project_volume(plane, volume, NEXT, start, budget, part, shape, operator, state)
            budget -= 1 + n
            end -= operator.patch * operator.patch
        else:
            start = end
        cursors[CURSOR_PROJECTED] += start == end
        cursors[CURSOR_ENTRY] = 0 if start == end else start
    while budget > 0 and cursors[CURSOR_CODED] < min(coded, cursors[CURSOR_PROJECTED]):
        budget -= CODE_COST * enter_code(plane, cursors[CURSOR_CODED], part, shape, operator, state)
        cursors[CURSOR_CODED] += 1
    return budget
