"""From events to counts: a few nanoseconds an event, whatever the number of filters.

Lives here: the only code that looks at single events, and that moves the ring of bins on.
Not here: projections and codes, which are brought up to date at an emission (`update`).

Every event is checked before it indexes anything: a batch from a hostile source can only be counted
as rejected. The check is inside the loop because it costs less there than a vectorised pass before it.
"""

import numpy as np

from streamfeat.events import TIME_LIMIT, Events
from streamfeat.kernels.compiled import inlined, kernel
from streamfeat.kernels.layout import (
    BEFORE_TIME,
    CLOCK_NOW,
    CLOCK_ORIGIN,
    CLOCK_PLANE,
    CLOCK_SLOT,
    CLOCK_START,
    CLOCK_TOUCHED,
    TALLY_EVENTS,
    TALLY_LATE,
    TALLY_REJECTED,
    TALLY_ROLLS,
    TALLY_SATURATED,
    Operator,
    State,
)
from streamfeat.kernels.vectors import prefetch

SOON = 16
"""Pixels of events lie anywhere in a ring that caches may not hold: loaded this many events ahead."""

IN_CACHE = 1 << 20
"""Numbers of a ring that caches hold, so that nothing need be loaded ahead."""

UNCHANGED = -1
"""Instead of the position of a bin: no clipped count changed."""


@kernel
def advance_to_bin(new: int, operator: Operator, state: State) -> None:
    """Make `new` the current bin: the slots of bins that leave the window are cleared for reuse.

    To the next bin, the planes swap: the one that looked ahead is current, and the other starts anew. Any
    further, and both start anew.
    """
    clock, counts = state.clock, state.counts
    n_bins, n_planes = counts.shape[0], state.cursors.shape[0]
    now = clock[CLOCK_NOW]
    if new <= now:
        return
    for b in range(max(now + 1, new - n_bins + 1), new + 1):
        counts[b % n_bins] = 0
        state.applied[b % n_bins] = 0
    if now > BEFORE_TIME:
        state.tally[TALLY_ROLLS] += new - now
    clock[CLOCK_NOW] = new
    clock[CLOCK_SLOT] = new % n_bins
    clock[CLOCK_START] = clock[CLOCK_ORIGIN] + new * operator.bin_us
    next_plane = (clock[CLOCK_PLANE] + 1) % n_planes
    for plane in range(n_planes):
        if new != now + 1 or n_planes == 1 or plane != next_plane:
            state.cursors[plane] = 0
            state.pooled[plane] = 0
    clock[CLOCK_PLANE] = next_plane


@inlined
def is_valid(x: int, y: int, p: int, t: int, state: State) -> bool:
    """Whether an event may be counted: the rule of `events.is_valid`, which describes it."""
    inside = x < state.ring_columns.shape[0] and y < state.ring_rows.shape[0]
    return inside and p >> 1 == 0 and -TIME_LIMIT < t < TIME_LIMIT


@inlined
def count_event(x: int, y: int, p: int, t: int, operator: Operator, state: State) -> tuple[int, int, int]:
    """Count one event in its pixel and bin.

    Args:
        x: column in pixels, any value.
        y: row in pixels, any value.
        p: polarity, any value.
        t: stream time in microseconds, any value.
        operator: geometry is read from it.
        state: `counts`, `clock` and `tally` are changed, and the planes where a bin begins.

    Returns:
        the entry whose clipped count changed by `2 p - 1`: its bin in the window, oldest first, and its row
        and column in the ring. The bin is UNCHANGED if there is none.
    """
    counts, clock, tally = state.counts, state.clock, state.tally
    n_bins, limit = counts.shape[0], operator.max_count
    if not is_valid(x, y, p, t, state):
        tally[TALLY_REJECTED] += 1
        return UNCHANGED, 0, 0
    position = n_bins - 1
    # Most events fall into the current bin: a division for each would cost as much as all the rest.
    if clock[CLOCK_NOW] == BEFORE_TIME or t < clock[CLOCK_START] or t - clock[CLOCK_START] >= operator.bin_us:
        bin_index = (t - clock[CLOCK_ORIGIN]) // operator.bin_us
        advance_to_bin(bin_index, operator, state)
        position = bin_index - clock[CLOCK_NOW] + n_bins - 1
        if position < 0:
            tally[TALLY_LATE] += 1
            return UNCHANGED, 0, 0
    tally[TALLY_EVENTS] += 1
    slot, row, column = slot_of(position, state), int(state.ring_rows[y]), int(state.ring_columns[x])
    before = counts[slot, row, column]
    after = before + 2 * p - 1
    counts[slot, row, column] = after
    if min(max(before, -limit), limit) == min(max(after, -limit), limit):
        tally[TALLY_SATURATED] += 1
        return UNCHANGED, 0, 0
    return position, row, column


@inlined
def slot_of(position: int, state: State) -> int:
    """The slot of a bin of the window; the oldest is at position 0."""
    slot = state.clock[CLOCK_SLOT] + 1 + position
    n_bins = state.counts.shape[0]
    return slot if slot < n_bins else slot - n_bins


@inlined
def bin_length(operator: Operator, state: State) -> np.uint64:
    """How long the current bin is; before all time there is none, and it has no length."""
    return np.uint64(operator.bin_us if state.clock[CLOCK_NOW] > BEFORE_TIME else 0)


@kernel
def count_events(events: Events, operator: Operator, state: State) -> None:
    """Count every event of a batch, and note the entries that changed for the next emission.

    Same as `count_event` on each; the events of the current bin, which are nearly all, go a shorter way.

    Args:
        events: `(n,)` EVENT_DTYPE, any content; not changed.
        operator: geometry is read from it.
        state: as for `count_event`; `touched` and `is_touched` are changed too.
    """
    counts, flags = state.counts.reshape(-1), state.is_touched.reshape(-1)
    touched, tally, limit, clock = state.touched, state.tally, operator.max_count, state.clock
    rows, columns = state.ring_rows, state.ring_columns
    height, width = rows.shape[0], columns.shape[0]
    row_length, slot_length = state.counts.shape[2], state.counts.shape[1] * state.counts.shape[2]
    start, length, first = clock[CLOCK_START], bin_length(operator, state), clock[CLOCK_SLOT] * slot_length
    n_touched, n_saturated, n_counted = clock[CLOCK_TOUCHED], 0, 0
    is_far, last = counts.shape[0] > IN_CACHE, events.shape[0] - 1
    for i in range(events.shape[0]):
        if is_far:
            event = events[min(i + SOON, last)]
            x, y = min(int(event.x), width - 1), min(int(event.y), height - 1)
            later = first + np.int64(rows[y]) * row_length + columns[x]
            prefetch(counts, later)
            prefetch(flags, later)
        event = events[i]
        x, y, p, t = event.x, event.y, event.p, event.t
        # As `is_valid`: no time of the current bin is beyond all limits.
        if x < width and y < height and np.uint16(p) < 2 and np.uint64(t - start) < length:
            # Unsigned, or every index would be tested for being below zero.
            place = np.uint64(first + rows[y] * row_length + columns[x])
            before = counts[place]
            after = before + 2 * p - 1
            counts[place] = after
            changed = min(max(before, -limit), limit) != min(max(after, -limit), limit)
            n_counted += 1
            n_saturated += not changed
            # Always on the stack, and kept or not: whether a count saturates cannot be predicted.
            touched[np.uint64(n_touched)] = place
            flag = flags[place]
            n_touched += changed & (flag == 0)
            flags[place] = flag | changed
            continue
        position, row, column = count_event(x, y, p, t, operator, state)
        start, length, first = (
            clock[CLOCK_START],
            bin_length(operator, state),
            clock[CLOCK_SLOT] * slot_length,
        )
        if position != UNCHANGED:
            other = slot_of(position, state) * slot_length + row * row_length + column
            touched[n_touched] = other
            n_touched += flags[other] == 0
            flags[other] = 1
    clock[CLOCK_TOUCHED] = n_touched
    tally[TALLY_EVENTS] += n_counted
    tally[TALLY_SATURATED] += n_saturated
