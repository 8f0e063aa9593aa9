"""Time surfaces: what others compute for each event from the recent past around it.

Lives here: the surfaces of two published methods, for the baselines of `streamfeat.evaluate`.
Not here: anything of our own features; cells, prototypes and histograms (`streamfeat.evaluate.surfaces`).
"""

import math

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.compiled import kernel

__all__ = ["add_memory_surfaces", "time_surfaces"]


@kernel
def add_memory_surfaces(
    x: NDArray[np.int64],
    y: NDArray[np.int64],
    p: NDArray[np.int64],
    t: NDArray[np.float64],
    cell: int,
    memory: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """Add the local memory time surface of each event to the sum of its cell (Sironi et al. 2018).

    The surface at offset `z` is the sum of `exp(-(t_i - t_j) / tau)` over the earlier events `j` at
    `x_i + z`, of the same polarity and in the same cell. The sum over a pixel's past is one number:
    `exp(-t_i / tau)` times the sum of `exp(t_j / tau)`.

    Args:
        x: `(n,)` column of each event, in order of time, as the other three; none is changed.
        y: `(n,)` row.
        p: `(n,)` 0 or 1.
        t: `(n,)` time since the start of the sample, in units of `tau`; below 700.
        cell: rows and columns of a cell, in pixels.
        memory: `(2, H, W)` sum of `exp(t_j / tau)` over the past of each polarity and pixel; changed.
        sums: `(rows, columns, 2, 2 R + 1, 2 R + 1)`; changed.
    """
    height, width = memory.shape[1], memory.shape[2]
    radius = sums.shape[3] // 2
    for i in range(len(t)):
        top, left = y[i] // cell * cell, x[i] // cell * cell
        bottom, right = min(top + cell, height), min(left + cell, width)
        fade = math.exp(-t[i])
        for row in range(max(y[i] - radius, top), min(y[i] + radius + 1, bottom)):
            for column in range(max(x[i] - radius, left), min(x[i] + radius + 1, right)):
                at = row - y[i] + radius, column - x[i] + radius
                sums[top // cell, left // cell, p[i], at[0], at[1]] += fade * memory[p[i], row, column]
        memory[p[i], y[i], x[i]] += math.exp(t[i])


@kernel
def time_surfaces(
    x: NDArray[np.int64],
    y: NDArray[np.int64],
    p: NDArray[np.int64],
    t: NDArray[np.float64],
    latest: NDArray[np.float64],
    out: NDArray[np.float32],
) -> None:
    """Write the time surface of each event: `exp(-(t_i - T(u, p)) / tau)` (Lagorce et al. 2017, eq. 3).

    Args:
        x: `(n,)` column of each event, in order of time, as the other three; none is changed.
        y: `(n,)` row.
        p: `(n,)` from 0 to P - 1; P is 2 for events of a camera, and in later layers the prototypes before.
        t: `(n,)` time since the start of the sample, in units of `tau`.
        latest: `(P, H + 2 R, W + 2 R)` time of the latest event of each polarity and pixel, with a margin of
            `R` pixels; -inf where there was none; changed.
        out: `(n, P, 2 R + 1, 2 R + 1)`; changed.
    """
    side = out.shape[2]
    for i in range(len(t)):
        latest[p[i], y[i] + side // 2, x[i] + side // 2] = t[i]
        for polarity in range(out.shape[1]):
            for row in range(side):
                for column in range(side):
                    age = t[i] - latest[polarity, y[i] + row, x[i] + column]
                    out[i, polarity, row, column] = math.exp(-age)
