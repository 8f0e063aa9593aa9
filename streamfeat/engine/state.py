"""Allocating the state that kernels change.

Lives here: shapes of the arrays in `kernels.layout.State`.
Not here: what an event does to them.
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.geometry import Geometry
from streamfeat.engine.operator import aligned_zeros
from streamfeat.events import Resolution
from streamfeat.kernels.dense import MOST_WAITING
from streamfeat.kernels.layout import (
    BEFORE_TIME,
    CLOCK_NOW,
    CLOCK_ORIGIN,
    CLOCK_SLOT,
    CLOCK_START,
    MOMENT_SQUARES,
    QUEUE,
    SPLIT,
    Operator,
    State,
)
from streamfeat.kernels.vectors import MASK_BITS

__all__ = ["allocate_state", "clear_state", "enter_counts"]


def allocate_state(
    geometry: Geometry,
    operator: Operator,
    resolution: Resolution,
    *,
    origin_us: int = 0,
    planes: int = 1,
    keep: bool = True,
    threads: int = 1,
) -> State:
    """An empty state for one sensor.

    Args:
        geometry: of the local volumes.
        operator: gives the number of filters and the encoding.
        resolution: `(height, width)` of the sensor.
        origin_us: start of bin 0.
        planes: 1, or 2 to look ahead.
        threads: that share the work of large emissions.
        keep: keep a projection for each volume; without, the state serves whole windows only.
    """
    rows, columns = geometry.grid_shape(resolution)
    ring = (geometry.n_bins, *geometry.ring_shape(resolution))
    volumes = rows * columns if keep else 1
    padded = operator.offset.shape[0]
    atoms = operator.n_filters if operator.inverse else 0
    clock = np.zeros(7, np.int64)
    clock[[CLOCK_NOW, CLOCK_START]] = BEFORE_TIME
    clock[CLOCK_ORIGIN] = origin_us
    narrow = operator.steps is not None
    numbers, queue = (np.int16, QUEUE) if narrow else (np.int32, 0)
    features = 2 * padded if narrow or operator.kind == SPLIT else padded
    waiting = MOST_WAITING if keep and operator.packed.size else 0
    length = -(-geometry.entries // MASK_BITS) * MASK_BITS
    return State(
        counts=np.zeros(ring, np.int32),
        applied=np.zeros(ring, np.int16),
        news=np.zeros(ring, np.int16),
        touched=np.zeros(int(np.prod(ring)) + 1, np.int32),
        is_touched=np.zeros(ring, np.uint8),
        touched_slots=np.zeros(geometry.n_bins, np.uint8),
        ring_rows=(np.arange(resolution[0]) // geometry.downsample).astype(np.int32),
        ring_columns=(np.arange(resolution[1]) // geometry.downsample).astype(np.int32),
        volume_rows=_covering(geometry.sides[0], geometry.stride, ring[1], rows),
        volume_columns=_covering(geometry.sides[1], geometry.stride, ring[2], columns),
        clock=clock,
        cursors=np.zeros((planes, 3), np.int64),
        tally=np.zeros(5, np.int64),
        encoded=np.zeros(threads, np.int64),
        projections=aligned_zeros((planes, volumes, padded), numbers),
        moments=np.zeros((planes, volumes, 4), np.int64),
        atoms=np.zeros((planes, volumes, 2, atoms), np.float64),
        pooled=aligned_zeros((planes, operator.pooling**2, features), np.int32),
        partial=aligned_zeros((threads - 1, planes, operator.pooling**2, features), np.int32),
        cells=_cells(operator.pooling, rows, columns),
        lines=np.zeros((2, ring[2] + 1), np.int32),
        crowds=np.zeros((ring[1] + 1, columns), np.int32),
        dirty=np.zeros(planes * rows * columns, np.int32),
        load=np.zeros(rows * columns + 1, np.int32),
        is_dirty=np.zeros(planes * volumes, np.uint8),
        code=aligned_zeros((threads, 2, padded), np.int32),
        sums=aligned_zeros((threads, queue + 1, padded), numbers),
        queue=np.zeros((threads, queue, 3), np.int64),
        queued=np.zeros((threads, 4), np.int64),
        work=np.zeros((threads, 5, padded), np.float64),
        active=np.zeros((threads, padded), np.int64),
        values=aligned_zeros((threads, 2, length), np.int16),
        windows=aligned_zeros((threads, waiting, length), np.int16),
        awaiting=np.zeros((threads, waiting), np.int32),
        entries=np.zeros((threads, geometry.entries + 1), np.int32),
        changes=np.zeros((threads, geometry.entries + 1), np.int16),
        corners=np.zeros((threads, atoms * padded), np.float32),
    )


def clear_state(state: State, origin_us: int) -> None:
    """Make a state that of an engine without events whose bin 0 starts at `origin_us`; tallies stay."""
    state.projections[state.moments[:, :, MOMENT_SQUARES] != 0] = 0
    for array in (state.counts, state.applied, state.is_touched, state.moments, state.atoms):
        array[:] = 0
    state.pooled[:] = 0
    state.cursors[:] = 0
    state.clock[:] = 0
    state.clock[[CLOCK_NOW, CLOCK_START]] = BEFORE_TIME
    state.clock[CLOCK_ORIGIN] = origin_us


def enter_counts(counts: NDArray[np.int32], now: int, operator: Operator, state: State) -> None:
    """Give a cleared state the counts of a window; planes follow with the next update.

    Args:
        counts: `(T, H, W)`, bin `b` in slot `b % T`.
        now: the current bin.
        operator: limit of counts, length of a bin.
        state: changed.
    """
    state.counts[:] = counts
    state.applied[:] = counts.clip(-operator.max_count, operator.max_count)
    if now > BEFORE_TIME:
        state.clock[CLOCK_NOW] = now
        state.clock[CLOCK_START] = state.clock[CLOCK_ORIGIN] + now * operator.bin_us
        state.clock[CLOCK_SLOT] = now % len(counts)


def _cells(pooling: int, rows: int, columns: int) -> NDArray[np.int32]:
    """Cell of each volume of a grid, row by row: the sides of the grid are cut into `pooling` equal parts."""
    down, across = np.arange(rows) * pooling // rows, np.arange(columns) * pooling // columns
    return np.add.outer(down * pooling, across).astype(np.int32).ravel()


def _covering(side: int, stride: int, pixels: int, volumes: int) -> NDArray[np.int32]:
    """First and last plus one of the volumes along an axis that cover each of `n` pixels: `(n, 2)`."""
    starts, pixel = np.arange(volumes) * stride, np.arange(pixels)
    first = np.searchsorted(starts, pixel - side, side="right")
    return np.stack([first, np.searchsorted(starts, pixel, side="right")], axis=1).astype(np.int32)
