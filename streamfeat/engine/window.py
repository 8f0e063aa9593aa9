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
from streamfeat.kernels.layout import CLOCK_SLOT, Operator
from streamfeat.kernels.planes import ALONE, FIRST, complete, finish, list_missing

__all__ = ["count_window", "encode_window"]


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


def encode_window(
    geometry: Geometry,
    operator: Operator,
    events: Events,
    resolution: Resolution,
    origin_us: int | None = None,
    t_us: int | None = None,
) -> NDArray[np.float32]:
    """Features of one window; see `Encoder.encode`."""
    pooling = with_fixed_point(operator, geometry.grid_shape(resolution))
    state = allocate_state(geometry, pooling, resolution, keep=False)
    state.applied[:] = count_window(geometry, events, resolution, origin_us, t_us)
    state.clock[CLOCK_SLOT] = geometry.n_bins - 1  # the window ends with the last slot
    list_missing(pooling, state)
    complete(FIRST, ALONE, pooling, state)
    finish(ALONE, pooling, state)
    features = np.empty(n_features(pooling), np.float32)
    read_features(pooling, state, features)
    return features
