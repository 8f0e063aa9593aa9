"""Events: the one array layout that all of streamfeat speaks.

Lives here: `EVENT_DTYPE`, and making such arrays from other columns.
Not here: files, messages, clocks, or anything that knows what the events are for.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["EVENT_DTYPE", "Events", "Resolution", "make_events"]

EVENT_DTYPE = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")], align=True)
"""One event, 16 bytes, the layout of Metavision's EventCD.

`x`, `y`: pixel, origin top-left; `p`: polarity, 0 (OFF) or 1 (ON); `t`: stream time in microseconds.
"""

Events = NDArray[np.void]
"""A batch: `(n,)` array of `EVENT_DTYPE`. Where a batch ends carries no meaning."""

Resolution = tuple[int, int]
"""`(height, width)` in pixels, always in this order."""


def make_events(x: ArrayLike, y: ArrayLike, p: ArrayLike, t: ArrayLike) -> Events:
    """Make a batch from four columns of equal length.

    Args:
        x: `(n,)` column in pixels.
        y: `(n,)` row in pixels.
        p: `(n,)` polarity, 0 or 1 (bool allowed).
        t: `(n,)` stream time in microseconds.

    Returns:
        `(n,)` array of `EVENT_DTYPE`, a copy; values are cast, not checked.
    """
    t = np.asarray(t)
    events = np.zeros(t.shape, EVENT_DTYPE)
    events["x"], events["y"], events["p"], events["t"] = x, y, p, t
    return events
