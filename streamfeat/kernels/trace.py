"""Events followed one by one, with the features and the scores after each.

Lives here: the kernel that runs for each event under `--emit event`, and which cells an event touches.
Not here: what an event does to volumes (`follow`, `change`), how scores are summed (`predict`).

Features of cells that no event touched stay as they are, and so do the products of a classifier with them. At
a bin boundary, and at the start of a batch, all are read.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from streamfeat.events import Events
from streamfeat.kernels.compiled import inlined, kernel
from streamfeat.kernels.encode import read_cell
from streamfeat.kernels.follow import follow_event
from streamfeat.kernels.layout import (
    CLOCK_NOW,
    CLOCK_PLANE,
    CURSOR_CODED,
    TALLY_EVENTS,
    TALLY_SATURATED,
    Operator,
    State,
)
from streamfeat.kernels.predict import PARTS, Weights, part_of, score_parts, sum_part


class Reading(NamedTuple):
    """What was read after the latest event; scratch of `trace`."""

    features: NDArray[np.float32]
    """`(F,)`."""
    roots: NDArray[np.float32]
    """`(L,)`: see `sum_part`."""
    sums: NDArray[np.float32]
    """`(PARTS, C + 1)`: see `sum_part`."""
    is_stale: NDArray[np.uint8]
    """`(cells,)`: cells whose features are to be read again."""
    parts: NDArray[np.uint8]
    """`(PARTS,)`: parts whose products are to be summed again."""


@inlined
def mark_cells(x: int, y: int, operator: Operator, state: State, is_stale: NDArray[np.uint8]) -> None:
    """Mark the cells of all volumes that cover a pixel.

    Args:
        x: column of the pixel, on the sensor.
        y: row of the pixel, on the sensor.
        operator: geometry is read from it.
        state: not changed.
        is_stale: `(cells,)`, changed.
    """
    row, column = state.ring_rows[y], state.ring_columns[x]
    top, bottom = state.volume_rows[row, 0], state.volume_rows[row, 1]
    left, right = state.volume_columns[column, 0], state.volume_columns[column, 1]
    if top >= bottom or left >= right:
        return
    columns, side = operator.shape[1], operator.pooling
    first, last = state.cells[top * columns + left], state.cells[(bottom - 1) * columns + right - 1]
    for down in range(first // side, last // side + 1):
        for across in range(first % side, last % side + 1):
            is_stale[down * side + across] = 1


@kernel
def read_stale(operator: Operator, state: State, weights: Weights, reading: Reading) -> int:
    """Read the features of stale cells, and sum the products of the parts that they are in.

    Args:
        operator: number of filters, encoding and fixed point.
        state: not changed.
        weights: of a classifier, or of no class.
        reading: changed.

    Returns:
        How many cells were read.
    """
    is_stale, features = reading.is_stale, reading.features
    n_features, n = features.shape[0], 0
    width = n_features // is_stale.shape[0]
    for cell in range(is_stale.shape[0]):
        if is_stale[cell]:
            is_stale[cell] = 0
            n += 1
            read_cell(cell, operator, state, features)
            first, last = part_of(cell * width, n_features), part_of((cell + 1) * width - 1, n_features)
            reading.parts[first : last + 1] = 1
    if weights.rows.shape[1]:
        for part in range(PARTS):
            if reading.parts[part]:
                sum_part(part, features, weights, reading.roots, reading.sums)
    reading.parts[:] = 0
    return n


@kernel
def trace(
    events: Events,
    operator: Operator,
    state: State,
    weights: Weights,
    reading: Reading,
    features: NDArray[np.float32],
    scores: NDArray[np.float32],
    accepted: NDArray[np.int64],
) -> None:
    """Follow every event of a batch, and read features and scores after each.

    Args:
        events: `(n,)` EVENT_DTYPE, any content; not changed.
        operator: the encoder.
        state: as for `follow_event`.
        weights: of a classifier, or of no class.
        reading: changed; what it holds before means nothing.
        features: `(n, F)`, overwritten; or of no row, where features are not wanted.
        scores: `(n, C)`, overwritten.
        accepted: `(n,)`, overwritten: events accepted so far.
    """
    n_volumes, tally = operator.shape[0] * operator.shape[1], state.tally
    reading.is_stale[:] = 1
    reading.parts[:] = 1  # those behind the last feature, too
    for i in range(events.shape[0]):
        event, now = events[i], state.clock[CLOCK_NOW]
        changes = tally[TALLY_EVENTS] - tally[TALLY_SATURATED]
        was_complete = state.cursors[state.clock[CLOCK_PLANE], CURSOR_CODED] == n_volumes
        follow_event(event.x, event.y, event.p, event.t, operator, state)
        if state.clock[CLOCK_NOW] != now or not was_complete:
            reading.is_stale[:] = 1
        elif tally[TALLY_EVENTS] - tally[TALLY_SATURATED] != changes:
            mark_cells(event.x, event.y, operator, state, reading.is_stale)
        if read_stale(operator, state, weights, reading) or i == 0:
            score_parts(reading.sums, weights.bias, scores[i])
        else:
            for c in range(scores.shape[1]):
                scores[i, c] = scores[i - 1, c]
        if features.shape[0]:
            for k in range(features.shape[1]):
                features[i, k] = reading.features[k]
        accepted[i] = tally[TALLY_EVENTS]
