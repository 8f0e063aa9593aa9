"""From events to the events that are worth looking at: hot pixels, refractory period, isolated events.

Lives here: the one loop over events that decides which of them are noise.
Not here: what the periods are called and how they are given (`streamfeat.denoise`).

Each pixel remembers the event before, in the order in which events arrive. So the result depends on that
order alone, not on where batches end; and an event with an absurd time is forgotten with the next one of its
pixel, whichever way it was wrong.
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.events import Events
from streamfeat.kernels.compiled import kernel
from streamfeat.kernels.layout import BEFORE_TIME

__all__ = [
    "HOT",
    "HOT_LEVEL",
    "ISOLATED",
    "REFRACTORY",
    "mark_noise",
]

HOT, REFRACTORY, ISOLATED = 0, 1, 2
"""Reasons, in the order in which they are looked at; also the rows of `past` and `removed`."""

HOT_LEVEL = 1_000_000
"""A pixel is hot above this level, which falls by one in each microsecond; at most twice as much is kept."""


@kernel
def mark_noise(
    events: Events,
    limits: NDArray[np.int64],
    past: NDArray[np.int64],
    level: NDArray[np.int64],
    removed: NDArray[np.int64],
    keep: NDArray[np.bool_],
) -> None:
    """Decide for each event whether it is kept.

    An event is looked at for three reasons, of which any may be switched off by a limit of 0; the first that
    removes it counts it, and the later ones do not see it.

    - hot: each event raises its pixel's level by the limit, and time lowers it (a leaky bucket). An event
      that finds it above `HOT_LEVEL` is removed.
    - refractory: the pixel's last event that came through here is less than the limit away.
    - isolated: none of the eight pixels around had its latest event within the limit (background activity;
      Delbruck, Frame-free dynamic digital vision, 2008). A pixel does not support itself.

    What no engine would count (outside the sensor, polarity or time impossible) is kept, for the engine
    rejects and counts it.

    Args:
        events: `(n,)` EVENT_DTYPE, not changed.
        limits: `(3,)` microseconds: rise of the level with an event, refractory period, time of support.
        past: `(3, H, W)` time of the latest event of each pixel for each reason, `BEFORE_TIME` where there
            was none; changed.
        level: `(H, W)` in microseconds; changed.
        removed: `(3,)` events removed so far for each reason; changed.
        keep: `(n,)`; written.
    """
    height, width = level.shape
    for i in range(len(events)):
        x, y, t = int(events[i]["x"]), int(events[i]["y"]), int(events[i]["t"])
        keep[i] = True
        if x >= width or y >= height or events[i]["p"] >> 1 != 0 or not BEFORE_TIME < t < -BEFORE_TIME:
            continue
        if limits[HOT] > 0:
            passed = max(t - past[HOT, y, x], 0)
            past[HOT, y, x] = t
            level[y, x] = min(max(level[y, x] - passed, 0) + limits[HOT], 2 * HOT_LEVEL)
            if level[y, x] > HOT_LEVEL:
                removed[HOT] += 1
                keep[i] = False
                continue
        if limits[REFRACTORY] > 0:
            if abs(t - past[REFRACTORY, y, x]) < limits[REFRACTORY]:
                removed[REFRACTORY] += 1
                keep[i] = False
                continue
            past[REFRACTORY, y, x] = t
        if limits[ISOLATED] > 0:
            supported = False
            for row in range(max(y - 1, 0), min(y + 2, height)):
                for column in range(max(x - 1, 0), min(x + 2, width)):
                    near = abs(t - past[ISOLATED, row, column]) <= limits[ISOLATED]
                    supported |= near and (row != y or column != x)
            past[ISOLATED, y, x] = t
            if not supported:
                removed[ISOLATED] += 1
                keep[i] = False
