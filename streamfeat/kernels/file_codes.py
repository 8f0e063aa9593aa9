"""Codes that occur in files only: EVT 2.0, `.dat`, Event Stream (`.es`), ECF of HDF5, and numbers in text.

Lives here: one loop for each, bytes or words in and events out, every read within bounds.
Not here: headers, blocks and damage (`streamfeat.camera_files`), and packets (`decode`).
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.events import Events
from streamfeat.kernels.compiled import inlined, kernel

__all__ = [
    "ECF_PADDING",
    "decode_dat",
    "decode_ecf",
    "decode_event_stream",
    "decode_evt2",
    "decode_groups",
    "parse_rows",
    "turns_between",
]

ECF_PADDING = 16
"""Bytes that must follow the data of `decode_ecf`, so that a field at its end is read within the array."""


@inlined
def turns_between(before: int, now: int, bits: int) -> int:
    """How often a counter turned: a fall of more than half its range is a turn, such a rise takes one back.

    Args:
        before: the count before, -1 if there is none.
        now: the count.
        bits: of the counter.

    Returns:
        -1, 0 or 1.
    """
    half = np.int64(1) << (bits - 1)
    if before < 0:
        return 0
    return int(now - before < -half) - int(now - before > half)


@kernel
def decode_evt2(words: NDArray[np.uint32], state: NDArray[np.int64], out: Events) -> int:
    """Decode words of EVT 2.0: type in bits 28 to 31; CD words hold 6 bits of time, x (11) and y (11).

    TIME_HIGH holds 28 bits of time above those 6. Events before the first are left out, and so are words of
    other types.

    Args:
        words: `(n,)` uint32, not changed.
        state: `(2,)` int64, changed: the latest TIME_HIGH, -1 before the first, and how often it has turned.
        out: `(n,)` EVENT_DTYPE, changed.

    Returns:
        The number of events written.
    """
    latest, turns = state
    # An event from before a turn may still come after it, but there is nothing before the first.
    high = (latest | max(turns, 0) << 28) << 6
    n = 0
    for value in words:
        word = np.int64(value)
        kind = word >> 28
        if kind <= 1 and latest >= 0:
            out[n].x = word >> 11 & 0x7FF
            out[n].y = word & 0x7FF
            out[n].p = kind
            out[n].t = high | (word >> 22 & 0x3F)
            n += 1
        elif kind == 8:
            turns += turns_between(latest, word & 0xFFFFFFF, 28)
            latest = word & 0xFFFFFFF
            high = (latest | max(turns, 0) << 28) << 6
    state[0], state[1] = latest, turns
    return n


@kernel
def decode_dat(records: NDArray[np.uint32], state: NDArray[np.int64], out: Events) -> None:
    """Decode records of `.dat`: microseconds that wrap; x in bits 0 to 13, y in 14 to 27, polarity above.

    Args:
        records: `(n, 2)` uint32, not changed.
        state: `(2,)` int64, changed: the latest time as counted, -1 before the first, and how often it has
            turned.
        out: `(n,)` EVENT_DTYPE, changed.
    """
    latest, turns = state
    for i in range(records.shape[0]):
        t, word = np.int64(records[i, 0]), np.int64(records[i, 1])
        turns += turns_between(latest, t, 32)
        latest = t
        out[i].x = word & 0x3FFF
        out[i].y = word >> 14 & 0x3FFF
        out[i].p = word >> 28 != 0
        out[i].t = t + (max(turns, 0) << 32)
    state[0], state[1] = latest, turns


@kernel
def decode_event_stream(data: NDArray[np.uint8], is_atis: bool, state: NDArray[np.int64], out: Events) -> int:
    """Decode the bytes of an Event Stream 2.0 of DVS or ATIS events.

    An event takes five bytes: time since the last one and polarity, x, y. Single bytes between events count
    longer times, or are resets, which mean nothing where no byte is missing.

    Args:
        data: `(n,)` uint8, not changed.
        is_atis: whether times have 6 bits and events may be threshold crossings, which are left out.
        state: `(3,)` int64, changed: the time so far in microseconds; threshold crossings so far; and how
            many bytes of `data` were used: all but an event whose bytes are not all there.
        out: `EVENT_DTYPE`, changed; room for an event in every five bytes.

    Returns:
        The number of events written.
    """
    t, crossings = state[0], state[1]
    at, n = 0, 0
    while at < len(data):
        first = np.int64(data[at])
        if is_atis and first >= 0xFC:
            t += 63 * (first & 3)
            at += 1
        elif not is_atis and first >= 0xFE:
            t += 127 * (first & 1)
            at += 1
        elif at + 5 > len(data):
            break
        else:
            t += first >> (2 if is_atis else 1)
            if is_atis and first & 1:
                crossings += 1
            else:
                out[n].x = data[at + 1] | np.int64(data[at + 2]) << 8
                out[n].y = data[at + 3] | np.int64(data[at + 4]) << 8
                out[n].p = (first >> 1) & 1 if is_atis else first & 1
                out[n].t = t
                n += 1
            at += 5
    state[0], state[1], state[2] = t, crossings, at
    return n


@kernel
def decode_ecf(data: NDArray[np.uint8], size: int, out: Events) -> int:
    """Decode one chunk of ECF (github.com/prophesee-ai/hdf5_ecf, filter 0x8ECF).

    After a number of events with two flags come the first time and runs of equal times, then, as the flags
    say, all pixels in groups of four times 24 bits; or runs of equal rows and columns in groups of four times
    12 bits; or runs of rows, columns with masks of the five after each, and runs of equal polarities.

    Args:
        data: `(size + ECF_PADDING,)` uint8, not changed; at least 12 bytes without the padding.
        size: bytes of the chunk.
        out: `(n,)` EVENT_DTYPE, changed; n as the first four bytes say.

    Returns:
        The number of bytes used, or `-1 - i` where a run at byte i is longer than the events that are left,
        or the chunk ends at byte i before all events are there.
    """
    n = len(out)
    at, t = 12, np.int64(0)
    for k in range(8):
        t |= np.int64(data[4 + k]) << (8 * k)
    i = 0
    while i < n:
        if at >= size:
            return -1 - at
        step, run = np.int64(data[at] >> 4), np.int64(data[at] & 15)
        if step == 15:
            shift = 0
            while data[at] >> 4 == 15 and shift < 64:
                t += np.int64(data[at] & 15) << shift
                shift += 4
                at += 1
            continue
        t += step
        if run == 15:
            run = np.int64(data[at + 1]) | np.int64(data[at + 2]) << 8
            at += 2
        if run > n - i:
            return -1 - at
        for k in range(run):
            out[i + k].t = t
        i += run
        at += 1
    if data[0] & 2:
        return decode_groups(data, size, at, 24, out)
    i = 0
    while i < n:
        if at >= size:
            return -1 - at
        word = np.int64(data[at]) | np.int64(data[at + 1]) << 8
        run = word & 31
        if run == 31:
            run = np.int64(data[at + 2]) | np.int64(data[at + 3]) << 8
            at += 2
        if run > n - i:
            return -1 - at
        for k in range(run):
            out[i + k].y = word >> 5
        i += run
        at += 2
    if data[0] & 1:
        return decode_groups(data, size, at, 12, out)
    i = 0
    while i < n:
        if at >= size:
            return -1 - at
        word = np.int64(data[at]) | np.int64(data[at + 1]) << 8
        out[i].x = word >> 5
        i += 1
        for k in range(5):
            # Behind the last event an encoder may leave anything in its mask.
            if word >> (4 - k) & 1 and i < n:
                out[i].x = (word >> 5) + k + 1
                i += 1
        at += 2
    i = 0
    while i < n:
        if at >= size:
            return -1 - at
        polarity, run = np.int64(data[at] >> 7), np.int64(data[at] & 127)
        if run == 127:
            run = np.int64(data[at + 1]) | np.int64(data[at + 2]) << 8
            at += 2
        if run > n - i:
            return -1 - at
        for k in range(run):
            out[i + k].p = polarity
        i += run
        at += 1
    return at if at <= size else -1 - at


@inlined
def decode_groups(data: NDArray[np.uint8], size: int, at: int, bits: int, out: Events) -> int:
    """Read the pixels of `decode_ecf` in groups of four numbers of 12 bits, without rows, or 24.

    Four numbers are in three words, from the top of each: the whole first one, second and third, each with
    the lower part of the one after it below; the fourth has what is left. A number has its polarity in bit 0.

    Args:
        data: see `decode_ecf`.
        size: see `decode_ecf`.
        at: where the groups begin.
        bits: of a number, 12 or 24.
        out: see `decode_ecf`.

    Returns:
        See `decode_ecf`.
    """
    width = bits // 3
    for i in range(0, len(out), 4):
        if at + bits // 2 > size:
            return -1 - at
        word0 = word1 = word2 = np.int64(0)
        for k in range(bits // 6):
            word0 |= np.int64(data[at + k]) << (8 * k)
            word1 |= np.int64(data[at + bits // 6 + k]) << (8 * k)
            word2 |= np.int64(data[at + bits // 3 + k]) << (8 * k)
        low = (np.int64(1) << width) - 1
        for k in range(min(4, len(out) - i)):
            if k == 0:
                value = word0 >> width
            elif k == 1:
                value = (word0 & low) | (word1 >> 2 * width) << width
            elif k == 2:
                value = (word1 & (low << width | low)) | (word2 >> 3 * width) << 2 * width
            else:
                value = word2 & (low << 2 * width | low << width | low)
            out[i + k].p = value & 1
            out[i + k].x = value >> 1 & 0x7FF
            if bits == 24:
                out[i + k].y = value >> 12 & 0x7FF
        at += bits // 2
    return at


@kernel
def parse_rows(
    text: NDArray[np.uint8],
    separator: int,
    wanted: NDArray[np.int64],
    digits: NDArray[np.int64],
    decimals: NDArray[np.int64],
) -> int:
    """Read columns of plain decimal numbers, such as `-12` and `0.000125`; empty lines are passed over.

    Args:
        text: `(n,)` uint8, lines that end with a newline, not changed.
        separator: the byte between fields, around which blanks mean nothing; 0 for runs of blanks.
        wanted: `(k,)` int64, positions of the fields to read, ascending; others may hold anything.
        digits: `(k, rows)` int64, changed: each number without its point.
        decimals: `(k, rows)` int64, changed: how many of its digits are behind the point.

    Returns:
        The number of rows, or -1 where a field is missing or is no such number, has more than 18 digits, or
        has a point and more than the 53 bits of which a float holds every whole number.
    """
    n = at = 0
    end = len(text)
    while at < end:
        while at < end and (text[at] == 32 or text[at] == 9):
            at += 1
        if at >= end or text[at] == 10:
            at += 1
            continue
        if n >= digits.shape[1]:
            return -1
        k = field = 0
        while at < end and text[at] != 10:
            if k < len(wanted) and field == wanted[k]:
                is_negative = text[at] == 45
                if text[at] == 45 or text[at] == 43:
                    at += 1
                number, n_digits, n_decimals = np.int64(0), 0, 0
                has_point = False
                while at < end:
                    if text[at] == 46 and not has_point:
                        has_point = True
                    elif 48 <= text[at] <= 57:
                        number = number * 10 + (np.int64(text[at]) - 48)
                        n_digits += 1
                        n_decimals += has_point
                        if n_digits > 18:
                            return -1
                    else:
                        break
                    at += 1
                if n_digits == 0 or (n_decimals > 0 and number >= 1 << 53):
                    return -1
                digits[k, n] = -number if is_negative else number
                decimals[k, n] = n_decimals
                k += 1
            else:
                while at < end and text[at] != 10 and text[at] != separator:
                    if separator == 0 and (text[at] == 32 or text[at] == 9):
                        break
                    at += 1
            blanks = at
            while at < end and (text[at] == 32 or text[at] == 9):
                at += 1
            if at < end and text[at] != 10:
                if separator == 0:
                    if at == blanks:
                        return -1
                elif text[at] == separator:
                    at += 1
                    while at < end and (text[at] == 32 or text[at] == 9):
                        at += 1
                else:
                    return -1
            field += 1
        if k < len(wanted):
            return -1
        at += 1
        n += 1
    return n
