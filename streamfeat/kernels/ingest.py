"""From events to counts: a few nanoseconds an event, whatever the number of filters.

Lives here: the only code that looks at single events, and that moves the ring of bins on.
Not here: projections and codes, which are brought up to date when somebody reads (`update`).

Every event is checked before it indexes anything: a batch from a hostile source can only be counted
as rejected. The check is inside the loop because it costs less there than a vectorised pass before it.
"""

import numpy as np
from numba import njit

from streamfeat.events import Events
from streamfeat.kernels.layout import (
    BEFORE_TIME,
    CLOCK_NOW,
    CLOCK_ORIGIN,
    CLOCK_TOUCHED,
    TALLY_EVENTS,
    TALLY_LATE,
    TALLY_REJECTED,
    TALLY_ROLLS,
    TALLY_SATURATED,
    Operator,
    State,
)


@njit(cache=True, nogil=True)
def advance_to_bin(new: int, state: State) -> None:
    """Make `new` the current bin: the slots of bins that leave the window are cleared for reuse."""
    clock, counts = state.clock, state.counts
    n_bins = counts.shape[0]
    now = clock[CLOCK_NOW]
    if new <= now:
        return
    for b in range(max(now + 1, new - n_bins + 1), new + 1):
        counts[b % n_bins] = 0
    if now > BEFORE_TIME:
        state.tally[TALLY_ROLLS] += new - now
    clock[CLOCK_NOW] = new


@njit(cache=True, nogil=True)
def count_events(events: Events, height: int, width: int, operator: Operator, state: State) -> None:
    """Count every event of a batch in its pixel and bin, and note the entries that changed.

    Args:
        events: `(n,)` EVENT_DTYPE, any content; not changed.
        height: rows of the sensor, pixels.
        width: columns of the sensor, pixels.
        operator: geometry is read from it.
        state: `counts`, `touched`, `is_touched`, `clock` and `tally` are changed.
    """
    counts, clock, tally = state.counts, state.clock, state.tally
    n_bins = counts.shape[0]
    limit = operator.max_count
    origin = clock[CLOCK_ORIGIN]
    bin_start, bin_index = np.int64(0), np.int64(BEFORE_TIME)
    for i in range(events.shape[0]):
        event = events[i]
        x, y, p, t = event.x, event.y, event.p, event.t
        if x >= width or y >= height or p < 0 or p > 1 or t <= BEFORE_TIME or t >= -BEFORE_TIME:
            tally[TALLY_REJECTED] += 1
            continue
        # Neighbours in a stream share their bin: a division for each event would cost as much as the rest.
        if bin_index == BEFORE_TIME or t < bin_start or t - bin_start >= operator.bin_us:
            bin_index = (t - origin) // operator.bin_us
            bin_start = bin_index * operator.bin_us + origin
            if bin_index > clock[CLOCK_NOW]:
                advance_to_bin(bin_index, state)
        if bin_index <= clock[CLOCK_NOW] - n_bins:
            tally[TALLY_LATE] += 1
            continue
        tally[TALLY_EVENTS] += 1
        slot, row, column = bin_index % n_bins, y // operator.downsample, x // operator.downsample
        before = counts[slot, row, column]
        after = before + 2 * p - 1
        counts[slot, row, column] = after
        if min(max(before, -limit), limit) == min(max(after, -limit), limit):
            tally[TALLY_SATURATED] += 1
        elif state.is_touched[slot, row, column] == 0:
            state.is_touched[slot, row, column] = 1
            state.touched[clock[CLOCK_TOUCHED]] = (slot * counts.shape[1] + row) * counts.shape[2] + column
            clock[CLOCK_TOUCHED] += 1
