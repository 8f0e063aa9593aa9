"""The pixels of a simulated event camera: what they see of a picture, and when they fire.

Lives here: drawing a picture on a sensor, and threshold crossings between two frames.
Not here: motion, noise, the order of events in time (`streamfeat.simulate`).
"""

import math

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.compiled import kernel

__all__ = ["draw_picture", "fire_pixels"]


@kernel
def draw_picture(
    picture: NDArray[np.float64],
    rows: NDArray[np.int64],
    row_weights: NDArray[np.float64],
    columns: NDArray[np.int64],
    column_weights: NDArray[np.float64],
    scratch: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Write the weighted sum of 4x4 samples of a picture to each pixel, rows first.

    Args:
        picture: `(R, C)` linear intensity, not changed, as the next four.
        rows: `(H, 4)` row of the picture of each sample, inside it.
        row_weights: `(H, 4)`.
        columns: `(W, 4)` column of the picture of each sample, inside it.
        column_weights: `(W, 4)`.
        scratch: `(C,)`; changed.
        out: `(H, W)`; changed.
    """
    for y in range(out.shape[0]):
        a, b, c, d = rows[y, 0], rows[y, 1], rows[y, 2], rows[y, 3]
        of_a, of_b, of_c, of_d = row_weights[y, 0], row_weights[y, 1], row_weights[y, 2], row_weights[y, 3]
        for i in range(picture.shape[1]):
            scratch[i] = (of_a * picture[a, i] + of_b * picture[b, i]) + (
                of_c * picture[c, i] + of_d * picture[d, i]
            )
        for x in range(out.shape[1]):
            out[y, x] = (
                column_weights[x, 0] * scratch[columns[x, 0]] + column_weights[x, 1] * scratch[columns[x, 1]]
            ) + (
                column_weights[x, 2] * scratch[columns[x, 2]] + column_weights[x, 3] * scratch[columns[x, 3]]
            )


@kernel
def fire_pixels(
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    start: float,
    end: float,
    thresholds: NDArray[np.float64],
    refractory: float,
    reference: NDArray[np.float64],
    release: NDArray[np.float64],
    pixel: int,
    out_pixel: NDArray[np.int64],
    out_polarity: NDArray[np.int64],
    out_t: NDArray[np.int64],
) -> tuple[int, int]:
    """Write the events between two frames, from one pixel on, for as long as there is room.

    Log intensity is linear in time. A pixel fires where it has moved away from its reference by a threshold,
    is held in reset for the refractory time, and takes its new reference where that ends. On a straight line
    it repeats itself: reset, then a whole threshold's worth of change.

    Args:
        before: `(N,)` log intensity at `start`, not changed, as `after` and `thresholds`.
        after: `(N,)` log intensity at `end`.
        start: microseconds.
        end: microseconds, later.
        thresholds: `(2, N)` of OFF and of ON, positive.
        refractory: microseconds.
        reference: `(N,)` log intensity that each pixel memorised; changed.
        release: `(N,)` when its reset ends, or ended; changed.
        pixel: the first pixel to look at.
        out_pixel: `(room,)`; changed, as the next two.
        out_polarity: `(room,)` 0 or 1.
        out_t: `(room,)` whole microseconds.

    Returns:
        The pixel whose events found no room and whose state is as before, or `N`; and how many were written.
    """
    n = 0
    for i in range(pixel, len(before)):
        if release[i] > end:
            continue
        slope = (after[i] - before[i]) / (end - start)
        if release[i] > start:
            reference[i] = before[i] + slope * (release[i] - start)
        change = after[i] - reference[i]
        if slope == 0.0 or not (change >= thresholds[1, i] or change <= -thresholds[0, i]):
            continue
        rising = slope > 0
        step = thresholds[1, i] if rising else -thresholds[0, i]
        # Rounding may put a crossing a hair outside the interval in which it was noticed.
        first = min(max(start + (reference[i] + step - before[i]) / slope, start), end)
        period = refractory + step / slope
        count = math.floor((end - first) / period) + 1
        if count > len(out_t) - n:
            return i, n
        for k in range(count):
            out_pixel[n] = i
            out_polarity[n] = 1 if rising else 0
            out_t[n] = int(first + k * period)
            n += 1
        # A release after `end` is dealt with in the interval where it falls.
        release[i] = first + (count - 1) * period + refractory
        reference[i] = before[i] + slope * (release[i] - start)
    return len(before), n
