"""Packet words to events, and the span of time that a packet's events cover.

Lives here: the four encodings, one short loop each, writing to `out`. Where each event has a record of its
own, its time is compared on the way; of 16-bit words that is another pass, over the events.
Not here: payload checks and capacity; see `streamfeat.messages.codecs`.
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.events import TIME_LIMIT, Events
from streamfeat.kernels.compiled import kernel

__all__ = ["decode_evt3", "decode_libcaer", "decode_libcaer_cmp", "decode_mono", "place_events", "time_span"]

# A TIME_HIGH that goes back by less than half of its 12 bits is late or has a flipped bit; by more, a wrap.
TIME_HIGH_BACKSTEP = 0x7FF

LIBCAER_WRAP_US = 1 << 31

EARLIEST, LATEST = np.int64(-0x7FFF_FFFF_FFFF_FFFF - 1), np.int64(0x7FFF_FFFF_FFFF_FFFF)
"""What no time of an event is beyond."""


@kernel
def decode_evt3(words: NDArray[np.uint16], state: NDArray[np.int64], out: Events) -> int:
    """Decode EVT3 words; `state` carries what the next packet needs.

    Args:
        words: `(n,)` uint16, not changed.
        state: `(6,)` int64, changed: time high with its wraps, time low, y, next x of a vector, polarity of
            a vector, and what was seen (0 nothing, 1 TIME_HIGH, 2 then TIME_LOW, 3 then ADDR_Y, 4 then
            VECT_BASE_X).
        out: `EVENT_DTYPE`, changed; at least as long as the words can hold events.

    Returns:
        The number of events written.
    """
    high, low, y, base, polarity, seen = state
    n = 0
    for word in words:
        kind = word >> 12
        if kind == 0x2 and seen >= 3:  # ADDR_X
            out[n].x = word & 0x7FF
            out[n].y = y
            out[n].p = (word >> 11) & 1
            out[n].t = (high << 12) | low
            n += 1
        elif kind == 0x0 and seen >= 2:  # ADDR_Y
            y = np.int64(word & 0x7FF)
            seen = max(seen, 3)
        elif kind == 0x3 and seen >= 3:  # VECT_BASE_X
            base = np.int64(word & 0x7FF)
            polarity = np.int64((word >> 11) & 1)
            seen = np.int64(4)
        elif (kind == 0x4 or kind == 0x5) and seen >= 4:  # VECT_12, VECT_8
            width = 12 if kind == 0x4 else 8
            for i in range(width):
                if word >> i & 1:
                    out[n].x = base + i
                    out[n].y = y
                    out[n].p = polarity
                    out[n].t = (high << 12) | low
                    n += 1
            base = (base + width) & 0xFFFF
        elif kind == 0x6 and seen >= 1:  # TIME_LOW
            low = np.int64(word & 0xFFF)
            seen = max(seen, 2)
        elif kind == 0x8:  # TIME_HIGH
            step = ((word & 0xFFF) - high) & 0xFFF
            if step >= 0x1000 - TIME_HIGH_BACKSTEP and high + step >= 0x1000:
                step -= 0x1000
            high += step
            seen = max(seen, 1)
        # Triggers (0xA), vendor words (0xE, 0x7, 0xF) and reserved types carry no events.
    state[0], state[1], state[2], state[3], state[4], state[5] = high, low, y, base, polarity, seen
    return n


@kernel
def decode_libcaer_cmp(words: NDArray[np.uint16], base_us: int, state: NDArray[np.int64], out: Events) -> int:
    """Decode libcaer_cmp words; time starts again with each packet, addresses carry over.

    Args:
        words: `(n,)` uint16, not changed.
        base_us: time of the packet, microseconds.
        state: `(3,)` int64, changed: x, next y of a vector, polarity of a vector.
        out: `EVENT_DTYPE`, changed; at least as long as the words can hold events.

    Returns:
        The number of events written, or `-1 - i` when word `i` is of no known type.
    """
    x, base, polarity = state
    high = low = np.int64(0)
    n = 0
    for i, word in enumerate(words):
        kind = word >> 12
        if kind == 3:  # ADDR_Y
            out[n].x = x
            out[n].y = word & 0x7FF
            out[n].p = (word >> 11) & 1
            out[n].t = base_us + (high | low)
            n += 1
        elif kind == 2:  # ADDR_X
            x = np.int64(word & 0x7FF)
        elif kind == 1:  # TIME_LOW
            low = np.int64(word & 0xFFF)
        elif kind == 0:  # TIME_HIGH
            high = np.int64(word & 0xFFF) << 12
        elif kind == 4:  # VECT_BASE_Y
            base = np.int64(word & 0x7FF)
            polarity = np.int64((word >> 11) & 1)
        elif kind == 5:  # VECT_8
            for bit in range(8):
                if word >> bit & 1:
                    out[n].x = x
                    out[n].y = base + bit
                    out[n].p = polarity
                    out[n].t = base_us + (high | low)
                    n += 1
            base = (base + 8) & 0xFFFF
        else:
            return -1 - i
    state[0], state[1], state[2] = x, base, polarity
    return n


@kernel
def decode_mono(
    words: NDArray[np.uint64],
    base_us: int,
    rest_ns: int,
    height: int,
    width: int,
    out: NDArray[np.int64],
    span: NDArray[np.int64],
) -> int:
    """Decode mono words, and find the span of their times on the way, as `time_span` does.

    Args:
        words: `(n,)` uint64, not changed.
        base_us: time of the packet, whole microseconds.
        rest_ns: what the time of the packet has beyond those, 0 to 999 ns.
        height: of the sensor, pixels.
        width: of the sensor, pixels.
        out: `(2 n,)` int64, changed: the memory of `n` events.
        span: as of `time_span`.

    Returns:
        How many events are on the sensor.
    """
    n = 0
    first, last = LATEST, EARLIEST
    for i in range(words.shape[0]):
        word = words[i]
        dt_ns = word & np.uint64(0xFFFFFFFF)
        # Division of 32 bits by 1000 (Granlund and Montgomery 1994): a product, for vectors have no other.
        dt_us = (dt_ns * np.uint64(274877907)) >> np.uint64(38)
        ns = np.int64(dt_ns - dt_us * np.uint64(1000)) + rest_ns
        t = base_us + np.int64(dt_us) + np.int64(ns >= 1000)
        pixel = (word >> np.uint64(32)) & np.uint64(0x7FFFFFFF)
        out[2 * i] = np.int64(pixel | (word >> np.uint64(63)) << np.uint64(32))
        out[2 * i + 1] = t
        if np.int64(pixel & np.uint64(0xFFFF)) < width and np.int64(pixel >> np.uint64(16)) < height:
            first, last = min(first, t), max(last, t)
            n += 1
    if n:
        span[0], span[1] = first, last
    return n


@kernel
def decode_libcaer(
    words: NDArray[np.uint64],
    base_us: int,
    height: int,
    width: int,
    out: NDArray[np.int64],
    span: NDArray[np.int64],
) -> int:
    """Decode libcaer records, and find the span of their times on the way, as `time_span` does.

    Microseconds wrap at 31 bits within a packet: only a fall of more than half of that is a wrap, a smaller
    one is an event out of order.

    Args:
        words: `(n,)` uint64, not changed: address and polarity in the lower 32 bits, microseconds above.
        base_us: time of the packet, microseconds.
        height: of the sensor, pixels.
        width: of the sensor, pixels.
        out: `(2 n,)` int64, changed: the memory of `n` events.
        span: as of `time_span`.

    Returns:
        How many events are on the sensor.
    """
    n = 0
    first, last = LATEST, EARLIEST
    turn_us, before_us = base_us, np.int64(0)
    for i in range(words.shape[0]):
        word = np.int64(words[i] & np.uint64(0x7FFFFFFF_FFFFFFFF))
        us = word >> 32
        if us - before_us < -(LIBCAER_WRAP_US // 2):
            turn_us += LIBCAER_WRAP_US
        before_us = us
        t = turn_us + us
        x, y, p = word >> 17 & 0x7FFF, word >> 2 & 0x7FFF, word >> 1 & 1
        out[2 * i] = x | y << 16 | p << 32
        out[2 * i + 1] = t
        if x < width and y < height:
            first, last = min(first, t), max(last, t)
            n += 1
    if n:
        span[0], span[1] = first, last
    return n


@kernel
def time_span(events: Events, height: int, width: int, span: NDArray[np.int64]) -> int:
    """Find the earliest and the latest time of the events that lie on the sensor.

    Args:
        events: `(n,)` `EVENT_DTYPE`, not changed.
        height: of the sensor, pixels.
        width: of the sensor, pixels.
        span: `(2,)` int64, changed: earliest and latest time; as it was where no event is on the sensor.

    Returns:
        How many events are on the sensor.
    """
    n = 0
    first, last = LATEST, EARLIEST
    for i in range(len(events)):
        if events["x"][i] < width and events["y"][i] < height:
            first, last = min(first, events["t"][i]), max(last, events["t"][i])
            n += 1
    if n:
        span[0], span[1] = first, last
    return n


@kernel
def place_events(
    events: Events,
    height: int,
    width: int,
    reached_us: int,
    latest: NDArray[np.int64],
    span: NDArray[np.int64],
) -> int:
    """Find stream time after each event: it never goes back, and events that cannot be used have no say.

    Args:
        events: `(n,)` `EVENT_DTYPE`, not changed.
        height: of the sensor, pixels.
        width: of the sensor, pixels.
        reached_us: stream time before the first event.
        latest: `(n,)` int64, overwritten: stream time after each event.
        span: `(2,)` int64, changed: earliest and latest time of the events that can be used; as it was where
            none can.

    Returns:
        How many events can be used, see `events.is_valid`.
    """
    n = 0
    first, last = LATEST, EARLIEST
    now = np.int64(reached_us)
    for i in range(events.shape[0]):
        event = events[i]
        t = event.t
        inside = event.x < width and event.y < height
        if inside and event.p >> 1 == 0 and -TIME_LIMIT < t < TIME_LIMIT:
            first, last, now = min(first, t), max(last, t), max(now, t)
            n += 1
        latest[i] = now
    if n:
        span[0], span[1] = first, last
    return n
