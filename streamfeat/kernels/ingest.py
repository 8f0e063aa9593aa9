"""From events to counts: a few nanoseconds an event, whatever the number of filters.

Lives here: the only code that looks at single events, and that moves the ring of bins on.
Not here: projections and codes, which are brought up to date when somebody reads (`update`).

Every event is checked before it indexes anything: a batch from a hostile source can only be counted
as rejected. The check is inside the loop because it costs less there than a vectorised pass before it.
"""

import numpy as np

from streamfeat.events import Events
from streamfeat.kernels.compiled import inlined, kernel
from streamfeat.kernels.layout import (
    BEFORE_TIME,
    CLOCK_NOW,
    CLOCK_ORIGIN,
    CLOCK_PLANE,
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

UNCHANGED = -1
"""Instead of a place: no clipped count changed."""


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
    clock[CLOCK_START] = clock[CLOCK_ORIGIN] + new * operator.bin_us
    next_plane = (clock[CLOCK_PLANE] + 1) % n_planes
    for plane in range(n_planes):
        if new != now + 1 or n_planes == 1 or plane != next_plane:
            state.cursors[plane] = 0
            state.pooled[plane] = 0
    clock[CLOCK_PLANE] = next_plane


@inlined
def count_event(
    x: int, y: int, p: int, t: int, height: int, width: int, operator: Operator, state: State
) -> int:
    """Count one event in its pixel and bin.

    Args:
        x: column in pixels, any value.
        y: row in pixels, any value.
        p: polarity, any value.
        t: stream time in microseconds, any value.
        height: rows of the sensor, pixels.
        width: columns of the sensor, pixels.
        operator: geometry is read from it.
        state: `counts`, `clock` and `tally` are changed, and the planes where a bin begins.

    Returns:
        the flat index of the entry whose clipped count changed by `2 p - 1`, or UNCHANGED.
    """
    counts, clock, tally = state.counts, state.clock, state.tally
    n_bins, limit = counts.shape[0], operator.max_count
    if x >= width or y >= height or p < 0 or p > 1 or t <= BEFORE_TIME or t >= -BEFORE_TIME:
        tally[TALLY_REJECTED] += 1
        return UNCHANGED
    bin_index = clock[CLOCK_NOW]
    # Most events fall into the current bin: a division for each would cost as much as all the rest.
    if bin_index == BEFORE_TIME or t < clock[CLOCK_START] or t - clock[CLOCK_START] >= operator.bin_us:
        bin_index = (t - clock[CLOCK_ORIGIN]) // operator.bin_us
        advance_to_bin(bin_index, operator, state)
        if bin_index <= clock[CLOCK_NOW] - n_bins:
            tally[TALLY_LATE] += 1
            return UNCHANGED
    tally[TALLY_EVENTS] += 1
    slot = bin_index % n_bins
    # In 32 bits without a sign, where a division takes a third of the time.
    row = np.int64(np.uint32(y) // np.uint32(operator.downsample))
    column = np.int64(np.uint32(x) // np.uint32(operator.downsample))
    before = counts[slot, row, column]
    after = before + 2 * p - 1
    counts[slot, row, column] = after
    if min(max(before, -limit), limit) == min(max(after, -limit), limit):
        tally[TALLY_SATURATED] += 1
        return UNCHANGED
    return (slot * counts.shape[1] + row) * counts.shape[2] + column


@inlined
def current_slot(state: State) -> tuple[int, np.uint64]:
    """When the current bin began, and the flat index at which its slot begins; before all time, never."""
    now = state.clock[CLOCK_NOW]
    if now == BEFORE_TIME:
        return -BEFORE_TIME, np.uint64(0)
    n_bins, height, width = state.counts.shape
    return int(state.clock[CLOCK_START]), np.uint64(now % n_bins * height * width)


@kernel
def count_events(events: Events, height: int, width: int, operator: Operator, state: State) -> None:
    """Count every event of a batch, and note the entries that changed for the next reading.

    Same as `count_event` on each; the events of the current bin, which are nearly all, go a shorter way.

    Args:
        events: `(n,)` EVENT_DTYPE, any content; not changed.
        height: rows of the sensor, pixels.
        width: columns of the sensor, pixels.
        operator: geometry is read from it.
        state: as for `count_event`; `touched` and `is_touched` are changed too.
    """
    counts, flags = state.counts.reshape(-1), state.is_touched.reshape(-1)
    touched, tally, limit = state.touched, state.tally, operator.max_count
    # Exact for 16 bits, and a tenth of the time of a division.
    reciprocal = np.uint64((1 << 32) // operator.downsample + 1)
    row_length, bin_us = np.uint64(state.counts.shape[2]), np.uint64(operator.bin_us)
    start, first = current_slot(state)
    n_touched, n_saturated = np.uint64(state.clock[CLOCK_TOUCHED]), 0
    for i in range(events.shape[0]):
        event = events[i]
        x, y, p, t = event.x, event.y, event.p, event.t
        sound = x < width and y < height and p >> 1 == 0 and BEFORE_TIME < t < -BEFORE_TIME
        if sound and np.uint64(t - start) < bin_us:
            # Unsigned, or every index would be tested for being below zero.
            row, column = np.uint64(y) * reciprocal >> 32, np.uint64(x) * reciprocal >> 32
            place = first + row * row_length + column
            before = counts[place]
            after = before + 2 * p - 1
            counts[place] = after
            changed = min(max(before, -limit), limit) != min(max(after, -limit), limit)
            tally[TALLY_EVENTS] += 1
            n_saturated += not changed
            # Always on the stack, and kept or not: whether a count saturates cannot be predicted.
            touched[n_touched] = place
            n_touched += np.uint64(changed & (flags[place] == 0))
            flags[place] |= changed
            continue
        other = count_event(x, y, p, t, height, width, operator, state)
        start, first = current_slot(state)
        if other != UNCHANGED and flags[other] == 0:
            flags[other] = 1
            touched[n_touched] = other
            n_touched += np.uint64(1)
    state.clock[CLOCK_TOUCHED] = n_touched
    tally[TALLY_SATURATED] += n_saturated
