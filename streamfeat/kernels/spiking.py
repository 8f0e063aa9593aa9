"""Spiking neurons with oriented receptive fields: what HFirst and Gabor-SNN compute for each event.

Lives here: the loops over events and neurons of both.
Not here: the filters, parameters and features (`streamfeat.evaluate.spiking`).

The state of a neuron is brought up to date when an event reaches it, so that an event costs the same whatever
the sensor's size: side^2 pixels with O neurons each.
"""

import math

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.compiled import kernel

__all__ = ["spike_first", "spike_leaky"]


@kernel
def spike_first(
    x: NDArray[np.int64],
    y: NDArray[np.int64],
    p: NDArray[np.int64],
    t: NDArray[np.int64],
    weights: NDArray[np.int32],
    limits: NDArray[np.int64],
    potential: NDArray[np.int32],
    updated: NDArray[np.int64],
    fired: NDArray[np.int64],
    pooled: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> None:
    """Count the spikes of layer C1 of HFirst (Orchard et al. 2015, layers S1 and C1).

    A neuron of S1 leaks linearly towards 0, adds its weight, and spikes above the threshold. The first to
    spike at a pixel resets all orientations there and holds them in refraction. A neuron of C1 repeats the
    spikes of one orientation in a cell of S1, and is deaf for its own refractory time after each.

    Args:
        x: `(n,)` column of each event, in order of time, as the other three; none is changed.
        y: `(n,)` row.
        p: `(n,)` 0 or 1; each polarity has neurons of its own in S1, and C1 listens to both.
        t: `(n,)` milliseconds.
        weights: `(S, S, O)` mV, S odd: of a neuron of each orientation, for events around it; not changed.
        limits: `(5,)` threshold in mV, leak in mV a millisecond, refractory milliseconds of S1 and of C1, and
            pixels along each side of a cell; not changed.
        potential: `(2, H, W, O)` mV; changed, as all that follow.
        updated: `(2, H, W)` millisecond to which the potentials belong.
        fired: `(2, H, W)` millisecond of the latest spike, far in the past before the first.
        pooled: `(rows, columns, O)` millisecond of the latest spike of C1, likewise.
        counts: `(rows, columns, O)` spikes of C1 so far.
    """
    threshold, leak, dead, pooled_dead, cell = limits[0], limits[1], limits[2], limits[3], limits[4]
    height, width, n_orientations = potential.shape[1], potential.shape[2], potential.shape[3]
    radius = weights.shape[0] // 2
    for i in range(len(t)):
        for row in range(max(y[i] - radius, 0), min(y[i] + radius + 1, height)):
            for column in range(max(x[i] - radius, 0), min(x[i] + radius + 1, width)):
                if t[i] - fired[p[i], row, column] <= dead:
                    continue
                leaked = leak * (t[i] - updated[p[i], row, column])
                updated[p[i], row, column] = t[i]
                at = y[i] - row + radius, x[i] - column + radius
                spikes = False
                for k in range(n_orientations):
                    before = potential[p[i], row, column, k]
                    left = max(before - leaked, 0) if before > 0 else min(before + leaked, 0)
                    after = left + weights[at[0], at[1], k]
                    potential[p[i], row, column, k] = after
                    if after > threshold:
                        spikes = True
                        latest = pooled[row // cell, column // cell, k]
                        if t[i] - latest > pooled_dead:
                            pooled[row // cell, column // cell, k] = t[i]
                            counts[row // cell, column // cell, k] += 1
                if spikes:
                    fired[p[i], row, column] = t[i]
                    for k in range(n_orientations):
                        potential[p[i], row, column, k] = 0


@kernel
def spike_leaky(
    x: NDArray[np.int64],
    y: NDArray[np.int64],
    p: NDArray[np.int64],
    t: NDArray[np.float64],
    weights: NDArray[np.float64],
    threshold: float,
    dead: float,
    cell: int,
    potential: NDArray[np.float64],
    updated: NDArray[np.float64],
    fired: NDArray[np.float64],
    counts: NDArray[np.int64],
) -> None:
    """Count the spikes of leaky integrate-and-fire neurons in cells (as of Bichler et al. 2012).

    A potential fades exponentially, adds its weight, and at the threshold spikes and falls to 0; that neuron,
    and no other, is deaf for a refractory time then.

    Args:
        x: `(n,)` column of each event, in order of time, as the other three; none is changed.
        y: `(n,)` row.
        p: `(n,)` 0 or 1; each polarity has neurons of its own.
        t: `(n,)` time in units in which a potential fades to 1/e.
        weights: `(S, S, O)`, S odd: of a neuron of each orientation, for events around it; not changed.
        threshold: of a potential.
        dead: refractory time, in the same unit.
        cell: pixels along each side of a cell.
        potential: `(2, H, W, O)`; changed, as all that follow.
        updated: `(2, H, W)` time to which the potentials belong.
        fired: `(2, H, W, O)` time of the latest spike, -inf before the first.
        counts: `(rows, columns, O)` spikes so far.
    """
    height, width, n_orientations = potential.shape[1], potential.shape[2], potential.shape[3]
    radius = weights.shape[0] // 2
    for i in range(len(t)):
        for row in range(max(y[i] - radius, 0), min(y[i] + radius + 1, height)):
            for column in range(max(x[i] - radius, 0), min(x[i] + radius + 1, width)):
                fade = math.exp(updated[p[i], row, column] - t[i])
                updated[p[i], row, column] = t[i]
                at = y[i] - row + radius, x[i] - column + radius
                for k in range(n_orientations):
                    before = potential[p[i], row, column, k] * fade
                    if t[i] - fired[p[i], row, column, k] >= dead:
                        before += weights[at[0], at[1], k]
                    if before >= threshold:
                        before = 0.0
                        fired[p[i], row, column, k] = t[i]
                        counts[row // cell, column // cell, k] += 1
                    potential[p[i], row, column, k] = before
