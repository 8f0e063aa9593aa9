"""One local volume: which of its entries change, and its projection and moments following them.

Lives here: the sums that are linear or quadratic in the counts of a volume, all of them integers.
Not here: which volumes an event covers, and when they are updated (`update`, `follow`); codes (`code`,
`lasso`).

A volume always follows a list of changes: one entry for one event, some for an emission after many, and all
that are not zero for a volume that is projected from nothing. Lists are made without a branch for each
entry: lines of the ring are copied eight pixels at a time, and 64 copies are compared with zero at once.
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.compiled import inlined, kernel
from streamfeat.kernels.layout import MOMENT_LINEAR, MOMENT_QUADRATIC, MOMENT_SQUARES, MOMENT_SUM, Operator
from streamfeat.kernels.vectors import EIGHT, MASK_BITS, copy_eight, filled_mask, lowest_bit, sum_listed


@inlined
def add_column(change: int, column: NDArray[np.int16], projection: NDArray[np.int32]) -> None:
    """Add `change` times a column to an int32 projection: `q += s P[:, i]`."""
    for k in range(projection.shape[0]):
        projection[k] += change * np.int32(column[k])


@kernel
def sum_columns(
    n: int,
    entries: NDArray[np.int32],
    changes: NDArray[np.int16],
    columns: NDArray[np.int16],
    sums: NDArray[np.int32] | NDArray[np.int16],
) -> None:
    """Sum a multiple of each listed column, in as many bits as the sums have.

    Args:
        n: length of the list.
        entries: `(> n,)` rows of `columns`; one more is written behind an odd number.
        changes: `(> n,)` what each is multiplied with; the same.
        columns: `(d, Kp)`, more than -2^15.
        sums: `(Kp,)` int32 or int16, overwritten.
    """
    if n % 2:
        entries[n], changes[n] = entries[n - 1], 0
    sum_listed(n, entries, changes, columns, sums)


@inlined
def add_moments(n: int, changes: NDArray[np.int16], moments: NDArray[np.int64]) -> None:
    """The same as `change_moments` for entries that were zero, without the forms.

    Args:
        n: length of the list.
        changes: `(>= n,)` what the entries are from now on.
        moments: `(4,)`, changed.
    """
    total, squares = np.int64(0), np.int64(0)
    for i in range(n):
        change = np.int64(changes[i])
        total += change
        squares += change * change
    moments[MOMENT_SUM] += total
    moments[MOMENT_SQUARES] += squares


@inlined
def change_moments(
    n: int,
    entries: NDArray[np.int32],
    changes: NDArray[np.int16],
    values: NDArray[np.int16],
    operator: Operator,
    moments: NDArray[np.int64],
) -> None:
    """Let listed entries of a volume change, and the moments with them.

    Args:
        n: length of the list.
        entries: `(>= n,)` indices into the volume, bin-major, each at most once.
        changes: `(>= n,)` by how much each clipped count changes.
        values: `(>= d,)` clipped counts, changed. Only the listed entries have to be right, unless the
            operator has a quadratic form.
        operator: forms.
        moments: `(4,)`, changed.
    """
    total, squares = np.int64(0), np.int64(0)
    for i in range(n):
        entry, change = entries[i], np.int64(changes[i])
        before = np.int64(values[entry])
        total += change
        squares += change * (2 * before + change)
        if operator.quadratic.shape[0]:
            form = operator.quadratic[entry]
            product = np.int64(0)
            for j in range(form.shape[0]):
                product += np.int64(form[j]) * values[j]
            moments[MOMENT_QUADRATIC] += change * (2 * product + change * np.int64(form[entry]))
            moments[MOMENT_LINEAR] += change * np.int64(operator.linear[entry])
        values[entry] = before + change
    moments[MOMENT_SUM] += total
    moments[MOMENT_SQUARES] += squares


@kernel
def change_entries(
    n: int,
    entries: NDArray[np.int32],
    changes: NDArray[np.int16],
    values: NDArray[np.int16],
    operator: Operator,
    projection: NDArray[np.int32] | NDArray[np.int16],
    moments: NDArray[np.int64],
    sums: NDArray[np.int32] | NDArray[np.int16],
) -> None:
    """Let listed entries of a volume change, and all that is kept of the volume with them.

    Args:
        n: length of the list.
        entries: `(> n,)` indices into the volume, bin-major, each at most once; see `sum_columns`.
        changes: `(> n,)` by how much each changes; the same.
        values: `(>= d,)` clipped counts before the change, and after it on return. Only the listed entries
            have to be right, unless the operator has a quadratic form.
        operator: columns and forms.
        projection: `(Kp,)`, changed.
        moments: `(4,)`, changed.
        sums: `(Kp,)` scratch.
    """
    sum_columns(n, entries, changes, operator.columns, sums)
    for k in range(sums.shape[0]):
        projection[k] += sums[k]
    change_moments(n, entries, changes, values, operator, moments)


@inlined
def gather_volume(
    ring: NDArray[np.int16],
    first_slot: int,
    start: int,
    end: int,
    top: int,
    left: int,
    patch: tuple[int, int],
    values: NDArray[np.int16],
) -> None:
    """Copy lines of a volume out of a ring, oldest bin first.

    Args:
        ring: `(T, H, W)` clipped counts, or changes of them.
        first_slot: slot of the oldest bin.
        start: first entry that is wanted; its whole line is copied.
        end: entries from this one on are not wanted; the line that it is in is copied.
        top: first row of the volume.
        left: first column of the volume.
        patch: rows and columns of the volume.
        values: `(>= d,)`, overwritten in the lines that are copied.
    """
    n_bins, height, width = ring.shape
    rows, columns = patch
    pixels, line, last = ring.reshape(-1), start // columns, (end + columns - 1) // columns
    while line < last:  # one bin after the other
        position = line // rows
        slot = first_slot + position
        slot = slot if slot < n_bins else slot - n_bins
        source = (slot * height + top + line - position * rows) * width + left
        following = min(last, (position + 1) * rows)
        for to in range(line * columns, following * columns, columns):
            if columns < EIGHT:
                for column in range(columns):
                    values[to + column] = pixels[source + column]
            else:
                copy_eight(pixels, source, values, to)
                for column in range(EIGHT, columns - EIGHT, EIGHT):
                    copy_eight(pixels, source + column, values, to + column)
                copy_eight(pixels, source + columns - EIGHT, values, to + columns - EIGHT)
            source += width
        line = following


@inlined
def list_entries(
    values: NDArray[np.int16],
    start: int,
    end: int,
    entries: NDArray[np.int32],
    changes: NDArray[np.int16],
) -> int:
    """List the entries of a volume that are not zero.

    Args:
        values: of the volume, whole vectors of 64; only those from `start` to `end` mean anything.
        start: first entry to look at.
        end: last entry plus one.
        entries: `(>= end - start,)`, overwritten: indices into the volume, ascending.
        changes: `(>= end - start,)`, overwritten: their values.

    Returns:
        how many are listed.
    """
    n = 0
    for first in range(start // MASK_BITS * MASK_BITS, end, MASK_BITS):
        mask: np.uint64 = filled_mask(values, first)
        if first < start:
            mask &= ~np.uint64(0) << np.uint64(start - first)
        if end - first < MASK_BITS:
            mask &= ~(~np.uint64(0) << np.uint64(end - first))
        while mask != 0:
            entry = first + lowest_bit(mask)
            mask &= mask - np.uint64(1)
            entries[n], changes[n] = entry, values[entry]
            n += 1
    return n
