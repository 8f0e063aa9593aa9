"""One local volume: its projection and moments, from scratch or by one changed entry.

Lives here: the sums that are linear or quadratic in the counts of a volume, all of them integers.
Not here: which volumes an event covers, and when they are read (`update`); codes (`code`, `lasso`).
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from streamfeat.kernels.layout import (
    MOMENT_LINEAR,
    MOMENT_QUADRATIC,
    MOMENT_SQUARES,
    MOMENT_SUM,
    Operator,
)


@njit(cache=True, nogil=True)
def add_column(change: int, column: NDArray[np.int16], projection: NDArray[np.int32]) -> None:
    """Add `change` times an int16 column to an int32 projection: `q += s P[:, i]`."""
    for k in range(projection.shape[0]):
        projection[k] += change * np.int32(column[k])


@njit(cache=True, nogil=True)
def change_moments(before: int, after: int, moments: NDArray[np.int64]) -> None:
    """Let one entry of a volume change in the sum and in the sum of squares."""
    moments[MOMENT_SUM] += after - before
    moments[MOMENT_SQUARES] += after * after - before * before


@njit(cache=True, nogil=True)
def change_entry(
    entry: int,
    before: int,
    after: int,
    values: NDArray[np.int16],
    operator: Operator,
    projection: NDArray[np.int32],
    moments: NDArray[np.int64],
) -> None:
    """Let one entry of a volume change, and all that is kept of the volume with it.

    Args:
        entry: index into the volume, bin-major.
        before: clipped count that the sums stand for.
        after: clipped count that they shall stand for.
        values: `(d,)` all entries of the volume before the change; read only where the operator has a
            quadratic form.
        operator: columns and forms.
        projection: `(Kp,)`, changed.
        moments: `(4,)`, changed.
    """
    change = np.int32(after - before)
    add_column(change, operator.columns[entry], projection)
    change_moments(before, after, moments)
    if operator.quadratic.shape[0]:
        form = operator.quadratic[entry]
        product = np.int64(0)
        for j in range(values.shape[0]):
            product += np.int64(form[j]) * values[j]
        moments[MOMENT_QUADRATIC] += change * (2 * product + change * np.int64(form[entry]))
        moments[MOMENT_LINEAR] += change * np.int64(operator.linear[entry])


@njit(cache=True, nogil=True)
def gather_volume(
    ring: NDArray[np.int16],
    first_slot: int,
    filled_bins: int,
    top: int,
    left: int,
    patch: int,
    values: NDArray[np.int16],
) -> int:
    """Copy the entries of a volume out of a ring of clipped counts, oldest bin first.

    Args:
        ring: `(T, H, W)` clipped counts.
        first_slot: slot of the oldest bin.
        filled_bins: bins to copy; those after them, which have not begun, are zero.
        top: first row of the volume.
        left: first column of the volume.
        patch: rows and columns of the volume.
        values: `(T * patch * patch,)`, overwritten.

    Returns:
        how many entries are not zero.
    """
    n_bins = ring.shape[0]
    filled, i = 0, 0
    values[filled_bins * patch * patch :] = 0
    for position in range(filled_bins):
        plane = ring[(first_slot + position) % n_bins]
        for row in range(top, top + patch):
            for column in range(left, left + patch):
                value = plane[row, column]
                values[i] = value
                filled += value != 0
                i += 1
    return filled


@njit(cache=True, nogil=True)
def project_volume(
    values: NDArray[np.int16],
    operator: Operator,
    projection: NDArray[np.int32],
    moments: NDArray[np.int64],
) -> None:
    """Project a volume from nothing: one column for each entry that is not zero.

    Args:
        values: `(d,)` clipped counts; not changed.
        operator: columns and forms.
        projection: `(Kp,)`, overwritten.
        moments: `(4,)`, overwritten.
    """
    projection[:] = 0
    moments[:] = 0
    for i in range(values.shape[0]):
        value = np.int64(values[i])
        if value == 0:
            continue
        add_column(np.int32(value), operator.columns[i], projection)
        moments[MOMENT_SUM] += value
        moments[MOMENT_SQUARES] += value * value
        if operator.quadratic.shape[0]:
            # Each pair of entries once: the form is symmetric.
            product = value * operator.quadratic[i, i]
            for j in range(i):
                product += 2 * np.int64(operator.quadratic[i, j]) * values[j]
            moments[MOMENT_QUADRATIC] += value * product
            moments[MOMENT_LINEAR] += value * operator.linear[i]
