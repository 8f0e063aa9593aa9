"""Events followed one by one: what is pooled is current after every single event.

Lives here: what each event does under `--emit event`.
Not here: what one changed entry does to volumes (`change`); events that are only counted (`ingest`); what is
read after each event (`trace`).
"""

from streamfeat.events import Events
from streamfeat.kernels.change import change_place
from streamfeat.kernels.compiled import inlined, kernel
from streamfeat.kernels.ingest import UNCHANGED, count_event
from streamfeat.kernels.layout import (
    CLOCK_PLANE,
    CLOCK_START,
    CURSOR_CODED,
    CURSOR_PROJECTED,
    Operator,
    State,
)
from streamfeat.kernels.planes import fill_plane, look_ahead

PROJECTED_BY, CODED_FROM, CODED_BY = 0.9, 0.85, 0.975
"""Shares of a bin: when all projections of the next bin shall be there, and between when all codes."""

SLICE, HASTE = 24, 100
"""Columns that one event may add for the sake of the next bin: always, and for each grid of volumes that the
next bin is behind its pace."""


@inlined
def follow_event(
    x: int,
    y: int,
    p: int,
    t: int,
    operator: Operator,
    state: State,
) -> None:
    """Count one event, and keep the current plane that of the counts.

    The plane that looks ahead is filled at the pace at which the bin goes by, a bounded slice an event.

    Args:
        x: column in pixels, any value.
        y: row in pixels, any value.
        p: polarity, any value.
        t: stream time in microseconds, any value.
        operator: the encoder.
        state: all of it may be changed. Nothing may be on the touched stack.
    """
    n_volumes = operator.shape[0] * operator.shape[1]
    position, row, column = count_event(x, y, p, t, operator, state)
    if state.cursors[state.clock[CLOCK_PLANE], CURSOR_CODED] < n_volumes:
        fill_plane(operator, state)
    if position != UNCHANGED:
        change_place(position, row, column, operator, state)
    if state.cursors.shape[0] > 1:
        start, length = state.clock[CLOCK_START], operator.bin_us
        share = (min(max(t, start), start + length) - start) / length  # any t: a difference could overflow
        projected = min(n_volumes, int(n_volumes * share / PROJECTED_BY))
        coded = min(n_volumes, int(n_volumes * max(share - CODED_FROM, 0.0) / (CODED_BY - CODED_FROM)))
        coming = state.cursors[1 - state.clock[CLOCK_PLANE]]
        behind = max(projected - coming[CURSOR_PROJECTED], coded - coming[CURSOR_CODED], 0)
        look_ahead(projected, coded, SLICE + HASTE * behind // n_volumes, operator, state)


@kernel
def follow(events: Events, operator: Operator, state: State) -> None:
    """Follow every event of a batch, one by one.

    Args:
        events: `(n,)` EVENT_DTYPE, any content; not changed.
        operator: the encoder.
        state: as for `follow_event`.
    """
    for i in range(events.shape[0]):
        event = events[i]
        follow_event(event.x, event.y, event.p, event.t, operator, state)
