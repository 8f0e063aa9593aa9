"""Features of one whole window: the offline path.

Lives here: counts by a histogram over all events of a window, then every volume from nothing.
Not here: anything incremental (`engine`); the two meet only in what a volume's code is.
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.geometry import Geometry
from streamfeat.engine.operator import n_features, with_fixed_point
from streamfeat.engine.state import allocate_state
from streamfeat.events import Events, Resolution, is_valid
from streamfeat.kernels.encode import read_features
from streamfeat.kernels.layout import CLOCK_SLOT, Operator, State
from streamfeat.kernels.planes import ALONE, FIRST, complete, finish, list_missing

__all__ = ["add_volumes", "count_window", "encode_window"]


def count_window(
    geometry: Geometry,
    events: Events,
    resolution: Resolution,
    origin_us: int | None = None,
    t_us: int | None = None,
) -> NDArray[np.int16]:
    """Clipped counts of the window that ends with the bin of `t_us`.

    Args:
        geometry: bins, downsampling and clipping.
        events: `(n,)` EVENT_DTYPE in any order; those outside the sensor or the window are ignored.
        resolution: `(height, width)` of the sensor.
        origin_us: start of bin 0; the earliest event if not given.
        t_us: a time in the last bin; the latest event if not given.

    Returns:
        `(n_bins, H, W)` int16 in ring pixels, oldest bin first.
    """
    ring = (geometry.n_bins, *geometry.ring_shape(resolution))
    x, y, p, t = (events[name] for name in ("x", "y", "p", "t"))
    good = is_valid(events, resolution)
    if not good.all():
        x, y, p, t = x[good], y[good], p[good], t[good]
    if len(t) == 0:
        return np.zeros(ring, np.int16)
    origin = int(t.min()) if origin_us is None else origin_us
    last = (int(t.max() if t_us is None else t_us) - origin) // geometry.bin_us
    position = (t - origin) // geometry.bin_us - (last - geometry.n_bins + 1)
    inside = (position >= 0) & (position < geometry.n_bins)
    if not inside.all():
        x, y, p, position = x[inside], y[inside], p[inside], position[inside]
    flat = np.ravel_multi_index((position, y // geometry.downsample, x // geometry.downsample), ring)
    size = int(np.prod(ring))
    counts = np.bincount(flat[p == 1], minlength=size) - np.bincount(flat[p == 0], minlength=size)
    return counts.clip(-geometry.max_count, geometry.max_count).astype(np.int16).reshape(ring)


def add_volumes(counts: NDArray[np.int16], operator: Operator, state: State) -> None:
    """Encode the volumes of some bins, and add them to the pooled sums of a state that keeps no projections.

    Args:
        counts: `(depth, H, W)` clipped, oldest bin first.
        operator: with the fixed point of the sensor.
        state: all but its pooled sums is overwritten.
    """
    state.applied[:] = counts
    state.clock[CLOCK_SLOT] = len(counts) - 1  # the volumes end with the last slot
    state.cursors[:] = 0
    state.atoms[:] = 0  # codes of the lasso follow from the counts alone
    list_missing(operator, state)
    complete(FIRST, ALONE, operator, state)
    finish(ALONE, operator, state)


def encode_window(
    geometry: Geometry,
    operator: Operator,
    events: Events,
    resolution: Resolution,
    origin_us: int | None = None,
    t_us: int | None = None,
) -> NDArray[np.float32]:
    """Features of one window; see `Encoder.encode`."""
    pooling = with_fixed_point(operator, geometry.grid_shape(resolution), len(geometry.ages))
    state = allocate_state(geometry.newest, pooling, resolution, keep=False)
    counts = count_window(geometry, events, resolution, origin_us, t_us)
    for age in geometry.ages:
        add_volumes(counts[len(counts) - geometry.depth - age : len(counts) - age], pooling, state)
    features = np.empty(n_features(pooling), np.float32)
    read_features(pooling, state, features)
    return features
