"""Log-polar descriptors: how the latest events lie around each event, finer near it than far from it.

Lives here: the loop over events of DART, with the events that it remembers.
Not here: the grid, words and features (`streamfeat.evaluate.retina`).

An event costs (2 R + 1)^2 looks at counts of remembered events, however many those are.
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.compiled import kernel

__all__ = ["describe_events"]


@kernel
def describe_events(
    x: NDArray[np.int64],
    y: NDArray[np.int64],
    places: NDArray[np.int64],
    recent: NDArray[np.int64],
    queue: NDArray[np.int64],
    head: NDArray[np.int64],
    out: NDArray[np.float32],
) -> None:
    """Write the descriptor of each event: the distribution of remembered events over a grid around it.

    An event is remembered before it is described, and the oldest is forgotten for it; its own pixel belongs
    to no place of the grid. A descriptor sums to 1, or is 0 where nothing is remembered around the event.

    Args:
        x: `(n,)` column of each event, in order of time, as `y`; neither is changed.
        y: `(n,)` row.
        places: `(2 R + 1, 2 R + 1)` place of the grid for each offset, -1 for none; not changed.
        recent: `(H + 2 R, W + 2 R)` remembered events at each pixel, with a margin of R pixels; changed.
        queue: `(N,)` flat places in `recent` of remembered events, -1 before the first N; changed.
        head: `(1,)` where in the queue the oldest stands; changed.
        out: `(n, B)`; changed.
    """
    side, width = places.shape[0], recent.shape[1]
    radius = side // 2
    for i in range(len(x)):
        oldest = queue[head[0]]
        if oldest >= 0:
            recent[oldest // width, oldest % width] -= 1
        recent[y[i] + radius, x[i] + radius] += 1
        queue[head[0]] = (y[i] + radius) * width + x[i] + radius
        head[0] = (head[0] + 1) % len(queue)
        out[i] = 0
        total = 0
        for row in range(side):
            for column in range(side):
                n = recent[y[i] + row, x[i] + column]
                place = places[row, column]
                if n > 0 and place >= 0:
                    out[i, place] += np.float32(n)
                    total += n
        if total > 0:
            for b in range(out.shape[1]):
                out[i, b] /= np.float32(total)
