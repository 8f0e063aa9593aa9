"""One local volume: which of its entries change, and its projection and moments following them.

Lives here: the sums that are linear or quadratic in the counts of a volume, all of them integers.
Not here: which volumes an event covers, and when they are read (`update`, `follow`); codes (`code`, `lasso`).

A volume always follows a list of changes: one entry for one event, some for a reading after many, and all
that are not zero for a volume that is projected from nothing.
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.compiled import inlined, kernel
from streamfeat.kernels.layout import (
    MOMENT_LINEAR,
    MOMENT_QUADRATIC,
    MOMENT_SQUARES,
    MOMENT_SUM,
    Operator,
)


@inlined
def add_column(change: int, column: NDArray[np.int16], projection: NDArray[np.int32]) -> None:
    """Add `change` times an int16 column to an int32 projection: `q += s P[:, i]`."""
    for k in range(projection.shape[0]):
        projection[k] += change * np.int32(column[k])


@kernel
def add_columns(
    n: int,
    entries: NDArray[np.int32],
    changes: NDArray[np.int16],
    columns: NDArray[np.int16],
    projection: NDArray[np.int32],
) -> None:
    """Add a multiple of each listed column to a projection, four in one run over it.

    Args:
        n: length of the list.
        entries: `(>= n,)` rows of `columns`.
        changes: `(>= n,)` what each is multiplied with.
        columns: `(d, Kp)`.
        projection: `(Kp,)`, changed.
    """
    i = 0
    while i + 4 <= n:
        c0, c1 = np.int32(changes[i]), np.int32(changes[i + 1])
        c2, c3 = np.int32(changes[i + 2]), np.int32(changes[i + 3])
        column0, column1 = columns[entries[i]], columns[entries[i + 1]]
        column2, column3 = columns[entries[i + 2]], columns[entries[i + 3]]
        for k in range(projection.shape[0]):
            projection[k] += c0 * column0[k] + c1 * column1[k] + c2 * column2[k] + c3 * column3[k]
        i += 4
    for j in range(i, n):
        add_column(np.int32(changes[j]), columns[entries[j]], projection)


@inlined
def change_moments(
    entry: int,
    change: int,
    values: NDArray[np.int16],
    operator: Operator,
    moments: NDArray[np.int64],
) -> None:
    """Let one entry of a volume change, and the moments with it.

    Args:
        entry: index into the volume, bin-major.
        change: of its clipped count.
        values: `(d,)` clipped counts, changed. Only this entry has to be right, unless the operator has a
            quadratic form.
        operator: forms.
        moments: `(4,)`, changed.
    """
    before = np.int64(values[entry])
    moments[MOMENT_SUM] += change
    moments[MOMENT_SQUARES] += change * (2 * before + change)
    if operator.quadratic.shape[0]:
        form = operator.quadratic[entry]
        product = np.int64(0)
        for j in range(values.shape[0]):
            product += np.int64(form[j]) * values[j]
        moments[MOMENT_QUADRATIC] += change * (2 * product + change * np.int64(form[entry]))
        moments[MOMENT_LINEAR] += change * np.int64(operator.linear[entry])
    values[entry] = before + change


@kernel
def change_entries(
    n: int,
    entries: NDArray[np.int32],
    changes: NDArray[np.int16],
    values: NDArray[np.int16],
    operator: Operator,
    projection: NDArray[np.int32],
    moments: NDArray[np.int64],
) -> None:
    """Let listed entries of a volume change, and all that is kept of the volume with them.

    Args:
        n: length of the list.
        entries: `(>= n,)` indices into the volume, bin-major, each at most once.
        changes: `(>= n,)` by how much each changes.
        values: `(d,)` clipped counts before the change, and after it on return. Only the listed entries have
            to be right, unless the operator has a quadratic form.
        operator: columns and forms.
        projection: `(Kp,)`, changed.
        moments: `(4,)`, changed.
    """
    add_columns(n, entries, changes, operator.columns, projection)
    for i in range(n):
        change_moments(entries[i], np.int64(changes[i]), values, operator, moments)


@kernel
def gather_volume(
    ring: NDArray[np.int16],
    first_slot: int,
    end: int,
    top: int,
    left: int,
    patch: int,
    values: NDArray[np.int16],
) -> None:
    """Copy the entries of a volume out of a ring of clipped counts, oldest bin first.

    Args:
        ring: `(T, H, W)` clipped counts.
        first_slot: slot of the oldest bin.
        end: entries from this one on are zero.
        top: first row of the volume.
        left: first column of the volume.
        patch: rows and columns of the volume.
        values: `(T * patch * patch,)`, overwritten.
    """
    n_bins = ring.shape[0]
    i = 0
    for position in range(n_bins):
        if i >= end:
            break
        plane = ring[(first_slot + position) % n_bins]
        for row in range(top, top + patch):
            pixels, copies = plane[row, left : left + patch], values[i : i + patch]
            for column in range(patch):
                copies[column] = pixels[column]
            i += patch
    values[end:] = 0


@kernel
def list_filled(
    ring: NDArray[np.int16],
    first_slot: int,
    start: int,
    end: int,
    most: int,
    top: int,
    left: int,
    patch: int,
    entries: NDArray[np.int32],
    changes: NDArray[np.int16],
) -> tuple[int, int]:
    """List the entries of a volume that are not zero, from one entry on, at most so many.

    Args:
        ring: `(T, H, W)` clipped counts.
        first_slot: slot of the oldest bin.
        start: entry to begin with.
        end: entries from this one on are taken for zero.
        most: entries to list at most.
        top: first row of the volume.
        left: first column of the volume.
        patch: rows and columns of the volume.
        entries: `(d,)`, overwritten: indices into the volume, ascending.
        changes: `(d,)`, overwritten: their counts.

    Returns:
        how many are listed, and the entry to go on from: `end` if there are no more.
    """
    n_bins = ring.shape[0]
    n = 0
    for line in range(start // patch, end // patch):
        position, row = line // patch, line % patch
        pixels = ring[(first_slot + position) % n_bins, top + row, left : left + patch]
        for column in range(patch):
            entry = line * patch + column
            if entry < start or pixels[column] == 0:
                continue
            if n == most:
                return n, entry
            entries[n] = entry
            changes[n] = pixels[column]
            n += 1
    return n, end


@kernel
def list_changed(
    counts: NDArray[np.int32],
    applied: NDArray[np.int16],
    limit: int,
    slots: NDArray[np.uint8],
    first_slot: int,
    end: int,
    top: int,
    left: int,
    patch: int,
    entries: NDArray[np.int32],
    changes: NDArray[np.int16],
    values: NDArray[np.int16],
) -> int:
    """List the entries of a volume whose clipped count is not the one that was applied.

    Args:
        counts: `(T, H, W)` counts.
        applied: `(T, H, W)` clipped counts that the volume's sums stand for.
        limit: counts are clipped to plus and minus this.
        slots: `(T,)` which slots to look at.
        first_slot: slot of the oldest bin.
        end: entries from this one on are not looked at.
        top: first row of the volume.
        left: first column of the volume.
        patch: rows and columns of the volume.
        entries: `(d,)`, overwritten: indices into the volume, ascending.
        changes: `(d,)`, overwritten: by how much their counts differ.
        values: `(d,)`, overwritten at the listed entries: what was applied.

    Returns:
        how many are listed.
    """
    n_bins = counts.shape[0]
    n = 0
    for position in range(n_bins):
        slot = (first_slot + position) % n_bins
        if slots[slot] == 0:
            continue
        for row in range(patch):
            entry = (position * patch + row) * patch
            was = applied[slot, top + row, left : left + patch]
            now = counts[slot, top + row, left : left + patch]
            for column in range(patch):
                before = np.int64(was[column])
                change = min(max(np.int64(now[column]), -limit), limit) - before
                if change != 0 and entry + column < end:
                    entries[n] = entry + column
                    changes[n] = change
                    values[entry + column] = before
                    n += 1
    return n
