"""Planes: all volumes at one bin, current or the next.

Lives here: letting volumes enter a plane, all at once (`complete`) or in bounded slices (`look_ahead`).
Not here: changes of volumes that are in a plane (`update`, `follow`), and the swap (`ingest`).

A bin boundary moves every entry of every volume by one bin, so all that is not empty must be projected
again. Done when somebody next reads, that is the longest wait of the whole system. Looking ahead spreads
it over the bin before: what volumes will be after the boundary is prepared beside what they are now.
"""

import numpy as np
from numba import njit

from streamfeat.kernels.encode import ADD, pool_volume
from streamfeat.kernels.layout import CLOCK_NOW, CLOCK_PLANE, MOMENT_SQUARES, Operator, State
from streamfeat.kernels.volume import gather_volume, project_volume

CURRENT, NEXT = np.int64(0), np.int64(1)
"""Bins by which a plane is ahead."""


@njit(cache=True, nogil=True)
def enter_volume(plane: int, ahead: int, shape: tuple[int, int], operator: Operator, state: State) -> int:
    """Let the next volume enter a plane: project it from nothing, encode it, pool it.

    Args:
        plane: which plane; its cursor moves on.
        ahead: CURRENT for the current bin, NEXT for the bin after it.
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: the plane and scratch are changed. Where it has a single row, volumes share it.

    Returns:
        how many entries of the volume are not zero.
    """
    volume = state.cursors[plane]
    state.cursors[plane] += 1
    row = min(volume, state.projections.shape[1] - 1)
    projection, moments = state.projections[plane, row], state.moments[plane, row]
    n_bins = state.applied.shape[0]
    top, left = volume // shape[1] * operator.stride, volume % shape[1] * operator.stride
    first_slot = (state.clock[CLOCK_NOW] + 1 + ahead) % n_bins
    filled = gather_volume(state.applied, first_slot, n_bins - ahead, top, left, operator.patch, state.values)
    if filled == 0:
        if moments[MOMENT_SQUARES] != 0:
            projection[:] = 0
            moments[:] = 0
            state.atoms[plane, row] = 0
        return 0
    project_volume(state.values, operator, projection, moments)
    pool_volume(plane, row, volume, ADD, shape, operator, state)
    return filled


@njit(cache=True, nogil=True)
def complete(shape: tuple[int, int], operator: Operator, state: State) -> None:
    """Let all volumes that are missing enter the current plane."""
    plane = state.clock[CLOCK_PLANE]
    while state.cursors[plane] < shape[0] * shape[1]:
        enter_volume(plane, CURRENT, shape, operator, state)


@njit(cache=True, nogil=True)
def look_ahead(goal: int, budget: int, shape: tuple[int, int], operator: Operator, state: State) -> int:
    """Let volumes enter the plane that looks ahead, until `goal` are in it or the budget is spent.

    Args:
        goal: volumes that shall be in the plane.
        budget: columns that may be added; encoding a volume counts for four.
        shape: rows and columns of the grid of volumes.
        operator: the encoder.
        state: the other plane and scratch are changed; nothing happens if there is one plane only, or the
            current one is not complete.

    Returns:
        what is left of the budget.
    """
    current = state.clock[CLOCK_PLANE]
    volumes = shape[0] * shape[1]
    if state.cursors.shape[0] == 1 or state.cursors[current] < volumes:
        return budget
    plane = 1 - current
    while budget > 0 and state.cursors[plane] < min(goal, volumes):
        volume = state.cursors[plane]
        if (
            state.moments[current, volume, MOMENT_SQUARES]
            == 0
            == state.moments[plane, volume, MOMENT_SQUARES]
        ):
            state.cursors[plane] += 1  # what is empty now will be empty then
        else:
            budget -= 4 + enter_volume(plane, NEXT, shape, operator, state)
    return budget
