"""Reading after any number of events: planes brought up to date with the counts.

Lives here: applying what has changed since the last reading. Each entry costs its net change only, and
each changed volume is encoded once, however many events fell on it.
Not here: what a volume's sums are (`volume`), what its code is (`encode`), single events (`follow`).
"""

import numpy as np
from numba import njit

from streamfeat.kernels.encode import ADD, TAKE, covering, pool_volume
from streamfeat.kernels.layout import CLOCK_NOW, CLOCK_PLANE, CLOCK_TOUCHED, Operator, State
from streamfeat.kernels.planes import complete
from streamfeat.kernels.volume import change_entry, gather_volume


@njit(cache=True, nogil=True)
def apply_touched(shape: tuple[int, int], operator: Operator, state: State) -> None:
    """Apply the net change of every touched entry to all planes; encode each changed volume once."""
    n_bins, height, width = state.counts.shape
    flags, applied, counts = state.is_touched.reshape(-1), state.applied.reshape(-1), state.counts.reshape(-1)
    limit = operator.max_count
    n_volumes, patch, now = shape[0] * shape[1], operator.patch, state.clock[CLOCK_NOW]
    n_dirty = 0
    for i in range(state.clock[CLOCK_TOUCHED]):
        place = state.touched[i]
        flags[place] = 0
        before = np.int64(applied[place])
        after = min(max(np.int64(counts[place]), -limit), limit)
        if before == after:
            continue
        row, column = place // width % height, place % width
        first_row, last_row = covering(row, shape[0], operator)
        first_column, last_column = covering(column, shape[1], operator)
        for plane in range(state.cursors.shape[0]):
            ahead = np.int64(plane != state.clock[CLOCK_PLANE])
            # The oldest bin of the window is at position 0 of a volume.
            position = (place // (height * width) - now - 1) % n_bins - ahead
            if position < 0:
                continue
            for r in range(first_row, last_row):
                for c in range(first_column, last_column):
                    volume = r * shape[1] + c
                    if volume >= state.cursors[plane]:
                        continue
                    index = plane * n_volumes + volume
                    if state.is_dirty[index] == 0:
                        state.is_dirty[index] = 1
                        state.dirty[n_dirty] = index
                        n_dirty += 1
                        pool_volume(plane, volume, volume, TAKE, shape, operator, state)
                    top, left = r * operator.stride, c * operator.stride
                    if operator.quadratic.shape[0]:
                        first_slot = (now + 1 + ahead) % n_bins
                        gather_volume(
                            state.applied, first_slot, n_bins - ahead, top, left, patch, state.values
                        )
                    entry = (position * patch + row - top) * patch + column - left
                    change_entry(
                        entry,
                        before,
                        after,
                        state.values,
                        operator,
                        state.projections[plane, volume],
                        state.moments[plane, volume],
                    )
        applied[place] = after
    for i in range(n_dirty):
        index = np.int64(state.dirty[i])
        state.is_dirty[index] = 0
        volume = index % n_volumes
        pool_volume(index // n_volumes, volume, volume, ADD, shape, operator, state)
    state.clock[CLOCK_TOUCHED] = 0


@njit(cache=True, nogil=True)
def update(shape: tuple[int, int], operator: Operator, state: State) -> None:
    """Make the current plane that of the counts.

    Args:
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: all of it may be changed.
    """
    apply_touched(shape, operator, state)
    complete(shape, operator, state)
