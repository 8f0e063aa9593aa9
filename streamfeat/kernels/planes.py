"""Planes: all volumes at one bin, current or the next.

Lives here: letting volumes enter a plane, all at once (`fill_plane`, or its steps, of which `complete` may
run on several threads) or in bounded slices (`look_ahead`).
Not here: changes of volumes that are in a plane (`update`, `follow`), and the swap (`ingest`).

A bin boundary moves every entry of every volume by one bin, so all that is not empty must be projected
again. Done at the next emission, that is the longest wait of the whole system. Looking ahead spreads
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
from numpy.typing import NDArray

from streamfeat.kernels.compiled import inlined, kernel, spliced
from streamfeat.kernels.dense import can_wait, let_in, multiply
from streamfeat.kernels.encode import ADD, pool_volume
from streamfeat.kernels.ingest import slot_of
from streamfeat.kernels.lasso import respond
from streamfeat.kernels.layout import (
    CLOCK_DIRTY,
    CLOCK_PLANE,
    CURSOR_CODED,
    CURSOR_ENTRY,
    CURSOR_PROJECTED,
    MOMENT_SQUARES,
    Operator,
    State,
)
from streamfeat.kernels.volume import add_moments, change_moments, gather_volume, list_entries, sum_columns

CURRENT, NEXT = np.int64(0), np.int64(1)
"""Bins by which a plane is ahead."""

FIRST, ALONE = np.int64(0), np.int64(1)
"""The first part of an update, and how many there are where no thread shares it."""

CODE_COST = 6
"""Columns that could be added while one volume is encoded and pooled."""

VOLUME_LOAD = 40
"""Entries that could be added while one volume is looked at, encoded and pooled: 340 ns against 8.6 ns."""


@kernel
def project_volume(
    plane: int, volume: int, ahead: int, start: int, most: int, part: int, operator: Operator, state: State
) -> tuple[int, int]:
    """Let entries of a volume into its projection in a plane, in order.

    Args:
        plane: which plane.
        volume: which volume. Where the plane has a single row, volumes share it.
        ahead: CURRENT for the current bin, NEXT for the bin after it.
        start: first entry that is not in yet; from 0 on, what the row held before is overwritten.
        most: entries that are not zero to let in at most.
        part: whose scratch to use.
        operator: the encoder.
        state: the row and scratch are changed.

    Returns:
        how many entries that are not zero were let in, and the entry to go on from.
    """
    row = min(volume, state.projections.shape[1] - 1)
    projection, moments = state.projections[plane, row], state.moments[plane, row]
    values, entries, changes = state.values[part, 0], state.entries[part], state.changes[part]
    n_bins, patch, columns = state.applied.shape[0], operator.patch, operator.shape[1]
    end = (n_bins - ahead) * patch[0] * patch[1]
    top, left = volume // columns * operator.stride, volume % columns * operator.stride
    first = np.int64(0) if operator.quadratic.shape[0] else start
    gather_volume(state.applied, slot_of(ahead, state), first, end, top, left, patch, values)
    n, following = list_entries(values, start, end, entries, changes), end
    if n > most:
        n, following = most, np.int64(entries[most])
    if start == 0:
        if n > 0 or moments[MOMENT_SQUARES] != 0:
            sum_columns(n, entries, changes, operator.columns, projection)
        moments[:] = 0
    else:
        sums = state.sums[part, 0]
        sum_columns(n, entries, changes, operator.columns, sums)
        for k in range(sums.shape[0]):
            projection[k] += sums[k]
    if operator.quadratic.shape[0]:
        values[start:] = 0
        change_moments(n, entries, changes, values, operator, moments)
    else:
        add_moments(n, changes, moments)
    return n, following


@inlined
def enter_atoms(
    lasso: bool | None, plane: int, row: int, part: int, operator: Operator, state: State
) -> None:
    """Let the lasso of a volume start from the code that is kept of it.

    Args:
        lasso: of the operator (see `encode.write_code`).
        plane: which plane.
        row: of the volume.
        part: whose scratch to use.
        operator: the encoder.
        state: `atoms` and scratch are changed.
    """
    if lasso is not None:
        respond(operator.gram, state.atoms[plane, row], state.work[part], state.active[part])


@kernel
def enter_code(plane: int, volume: int, part: int, operator: Operator, state: State) -> bool:
    """Encode a volume that was projected, and add it to the pooled sums of its plane.

    Args:
        plane: which plane.
        volume: which volume. Where the plane has a single row, volumes share it.
        part: whose scratch and sums to use.
        operator: the encoder.
        state: `atoms`, `pooled` or `partial`, `encoded` and scratch are changed.

    Returns:
        whether the volume had a count, and so a code.
    """
    row = min(volume, state.projections.shape[1] - 1)
    if state.moments[plane, row, MOMENT_SQUARES] == 0:
        state.atoms[plane, row] = 0
        return False
    enter_atoms(operator.lasso, plane, row, part, operator, state)
    pool_volume(plane, row, volume, ADD, part, operator, state)
    return True


@kernel
def count_filled(
    ring: NDArray[np.int16], stride: int, patch: int, lines: NDArray[np.int32], crowds: NDArray[np.int32]
) -> None:
    """Count the pixels that are not empty in each row of the ring, between the sides of each volume.

    Args:
        ring: `(T, H, W)` clipped counts; a pixel is empty if all of its bins are zero.
        stride: pixels between neighbouring volumes.
        patch: columns of a volume.
        lines: `(2, W + 1)` scratch.
        crowds: `(>= H, columns of the grid)`, overwritten in its first `H` rows.
    """
    filled, before = lines[0], lines[1]
    n_bins, height, width = ring.shape
    before[0] = 0
    for row in range(height):
        filled[:] = 0
        for slot in range(n_bins):
            pixels = ring[slot, row]
            for column in range(width):
                filled[column] |= pixels[column]
        total = np.int32(0)
        for column in range(width):
            total += np.int32(filled[column] != 0)
            before[column + 1] = total
        crowd = crowds[row]
        for c in range(crowd.shape[0]):
            crowd[c] = before[c * stride + patch] - before[c * stride]


@kernel
def list_missing(operator: Operator, state: State) -> None:
    """Put every volume that has to enter the current plane on the dirty stack, and no empty one.

    An empty volume has to, if its row is of an earlier bin and was not empty then; and under the inverse
    formulation, where it may be one whose code has to be forgotten.

    Args:
        operator: the encoder.
        state: `dirty`, the height of that stack, `load` and scratch are changed.
    """
    plane, columns, load = state.clock[CLOCK_PLANE], operator.shape[1], np.int64(0)
    n_volumes, n, coded = operator.shape[0] * columns, 0, state.cursors[plane, CURSOR_CODED]
    if coded < n_volumes:
        count_filled(state.applied, operator.stride, operator.patch[1], state.lines, state.crowds)
        moments, is_shared = state.moments[plane], state.moments.shape[1] < n_volumes
        crowd = state.crowds[state.crowds.shape[0] - 1]
        for r in range(coded // columns, operator.shape[0]):
            crowd[:] = 0
            for row in range(r * operator.stride, r * operator.stride + operator.patch[0]):
                counts = state.crowds[row]
                for c in range(columns):
                    crowd[c] += counts[c]
            for c in range(max(coded - r * columns, 0), columns):
                volume = r * columns + c
                was_filled = not is_shared and moments[volume, MOMENT_SQUARES] != 0
                if crowd[c] != 0 or was_filled or operator.inverse:
                    state.dirty[n], state.load[n] = volume, load
                    load += VOLUME_LOAD + crowd[c]
                    n += 1
    state.clock[CLOCK_DIRTY], state.load[n] = n, load


@inlined
def share_of(part: int, parts: int, state: State) -> tuple[int, int]:
    """First and last plus one of the volumes on the dirty stack that one of some parts works on."""
    n = state.clock[CLOCK_DIRTY]
    return n * part // parts, n * (part + 1) // parts


@inlined
def first_with_load(least: int, load: NDArray[np.int32], n: int) -> int:
    """The first of `n` volumes on the dirty stack before which there is at least so much work; or `n`."""
    low, high = 0, n
    while low < high:
        middle = (low + high) // 2
        if load[middle] < least:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def share_of_load(part: int, parts: int, state: State) -> tuple[int, int]:
    """The same for volumes that `list_missing` found, in parts of nearly the same work."""
    n = state.clock[CLOCK_DIRTY]
    total = np.int64(state.load[n])
    first = first_with_load(-(-total * part // parts), state.load, n)
    return first, first_with_load(-(-total * (part + 1) // parts), state.load, n)


@kernel
def complete(part: int, parts: int, operator: Operator, state: State) -> None:
    """Let one part of the volumes that `list_missing` found enter the current plane.

    Args:
        part: which. The cursors stay, for the other parts to see.
        parts: of how many.
        operator: the encoder.
        state: rows of these volumes, and sums and scratch of the part, are changed.
    """
    plane = state.clock[CLOCK_PLANE]
    cursors = state.cursors[plane]
    first, last = share_of_load(part, parts, state)
    waiting = np.int64(0)
    for i in range(first, last):
        volume, before = np.int64(state.dirty[i]), waiting
        if volume >= cursors[CURSOR_PROJECTED]:
            start = cursors[CURSOR_ENTRY] if volume == cursors[CURSOR_PROJECTED] else np.int64(0)
            if start == 0 and can_wait(state):
                _, waiting = let_in(plane, volume, CURRENT, waiting, part, operator, state)
            else:
                most = operator.columns.shape[0]
                project_volume(plane, volume, CURRENT, start, most, part, operator, state)
        if waiting == before:
            enter_code(plane, volume, part, operator, state)
        if waiting > 0 and (waiting == state.awaiting.shape[1] or i == last - 1):
            multiply(plane, waiting, part, operator, state)
            for w in range(waiting):
                enter_code(plane, np.int64(state.awaiting[part, w]), part, operator, state)
            waiting = np.int64(0)


@kernel
def finish(parts: int, operator: Operator, state: State) -> None:
    """All parts of an update are done: their sums are added up, and the current plane is complete."""
    volumes = operator.shape[0] * operator.shape[1]
    for part in range(parts - 1):
        for plane in range(state.pooled.shape[0]):
            for cell in range(state.pooled.shape[1]):
                sums, more = state.pooled[plane, cell], state.partial[part, plane, cell]
                for k in range(sums.shape[0]):
                    sums[k] += more[k]
                    more[k] = 0
    cursors = state.cursors[state.clock[CLOCK_PLANE]]
    cursors[CURSOR_CODED], cursors[CURSOR_PROJECTED], cursors[CURSOR_ENTRY] = volumes, volumes, 0
    state.clock[CLOCK_DIRTY] = 0


@spliced
def fill_plane(operator: Operator, state: State) -> None:
    """Let all volumes that are missing enter the current plane."""
    list_missing(operator, state)
    complete(FIRST, ALONE, operator, state)
    finish(ALONE, operator, state)


@kernel
def look_ahead(projected: int, coded: int, budget: int, operator: Operator, state: State) -> int:
    """Let volumes enter the plane that looks ahead, as far as asked or until the budget is spent.

    Args:
        projected: volumes that shall have a projection.
        coded: volumes that shall have a code.
        budget: columns that may be added; encoding a volume counts for `CODE_COST`.
        operator: the encoder.
        state: the other plane and scratch are changed; nothing happens if there is one plane only, or the
            current one is not complete.

    Returns:
        what is left of the budget.
    """
    current, volumes = state.clock[CLOCK_PLANE], operator.shape[0] * operator.shape[1]
    if state.cursors.shape[0] == 1 or state.cursors[current, CURSOR_CODED] < volumes:
        return budget
    plane = 1 - current
    cursors, moments, part = state.cursors[plane], state.moments[plane], np.int64(0)
    waiting = np.int64(0)
    while budget > 0 and cursors[CURSOR_PROJECTED] < projected:
        volume, start = cursors[CURSOR_PROJECTED], cursors[CURSOR_ENTRY]
        d = operator.columns.shape[0]
        end = d
        # What is empty now will be empty then.
        if start > 0 or state.moments[current, volume, MOMENT_SQUARES] or moments[volume, MOMENT_SQUARES]:
            end -= operator.patch[0] * operator.patch[1]
            if start == 0 and budget >= d and can_wait(state):
                n, waiting = let_in(plane, volume, NEXT, waiting, part, operator, state)
                start = end
                if waiting == state.awaiting.shape[1]:
                    multiply(plane, waiting, part, operator, state)
                    waiting = np.int64(0)
            else:
                n, start = project_volume(plane, volume, NEXT, start, budget, part, operator, state)
            budget -= 1 + n
        else:
            start = end
        cursors[CURSOR_PROJECTED] += start == end
        cursors[CURSOR_ENTRY] = 0 if start == end else start
    multiply(plane, waiting, part, operator, state)
    while budget > 0 and cursors[CURSOR_CODED] < min(coded, cursors[CURSOR_PROJECTED]):
        budget -= CODE_COST * enter_code(plane, cursors[CURSOR_CODED], part, operator, state)
        cursors[CURSOR_CODED] += 1
    return budget
