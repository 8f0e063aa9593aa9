"""Events as 16-bit words, for the two encodings in which each word depends on those before it.

Lives here: `libcaer_cmp` and `evt3`, written. Not here: reading them, other encodings (`codecs`).
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.events import Events

__all__ = ["EVT3_WRAP_US", "Words", "check_sorted", "encode_evt3", "libcaer_cmp_words"]

Words = NDArray[np.uint16]

EVT3_WRAP_US = 1 << 24
_EVT3_MAX_STEP = 1 << 11  # of TIME_HIGH: half of its 12 bits, so that no reader takes it for a step back
_EVT3_MAX_BRIDGE = 1 << 12  # TIME_HIGH words that may cross a silent gap: 9.5 hours


def check_sorted(events: Events, encoding: str) -> None:
    """Refuse events that are not in order of time.

    Raises:
        InputError: an event is earlier than the one before it.
    """
    falls = np.flatnonzero(np.diff(events["t"]) < 0)
    if len(falls):
        raise InputError(
            f"{encoding} needs events in order of time, but event {falls[0] + 1} is earlier than the one "
            "before it; sort them, or write mono"
        )


def _changed(column: NDArray[np.int64], before: int) -> NDArray[np.bool_]:
    """Mark the entries that differ from the one before."""
    changed: NDArray[np.bool_] = np.diff(column, prepend=before) != 0
    return changed


def libcaer_cmp_words(events: Events, offset_us: NDArray[np.int64]) -> Words:
    """Words TIME_HIGH, TIME_LOW and X where they change, and Y for every event."""
    high, low, x = offset_us >> 12, offset_us & 0xFFF, events["x"].astype(np.int64)
    y = events["y"] | events["p"].astype(np.uint16) << 11
    words = np.stack([high, 0x1000 | low, 0x2000 | x, 0x3000 | y], axis=1).astype("<u2")
    keep = np.stack([_changed(high, 0), _changed(low, 0), _changed(x, -1), np.ones(len(x), bool)], axis=1)
    kept: Words = words[keep]
    return kept


def encode_evt3(events: Events, after_us: int) -> bytes:
    """Words TIME_HIGH, TIME_LOW and ADDR_Y where they change, and ADDR_X for every event.

    TIME_LOW follows each TIME_HIGH, as from a sensor: faery and eventcv take it for 0 until it comes.
    """
    check_sorted(events, "evt3")
    t, y = events["t"], events["y"].astype(np.int64)
    if t[0] < after_us:
        raise InputError(f"evt3 needs events in order of time, but {t[0]} us follows {after_us} us")
    high, low = t >> 12, t & 0xFFF
    x = events["x"] | events["p"].astype(np.uint16) << 11
    words = np.stack([0x8000 | high & 0xFFF, 0x6000 | low, y, 0x2000 | x], axis=1).astype("<u2")
    is_high, is_low = _changed(high, -1), _changed(low, -1)
    keep = np.stack([is_high, is_low | is_high, _changed(y, -1), np.ones(len(y), bool)], axis=1)
    # A packet can be read on its own when it starts with both times; bridges stand in front of their event.
    before = np.concatenate([[after_us >> 12], high[:-1]])
    pieces, done = [], 0
    for gap in np.flatnonzero((high - before > _EVT3_MAX_STEP) | (high >> 12 != before >> 12)):
        pieces += [words[done:gap][keep[done:gap]], _evt3_bridge(int(before[gap]), int(high[gap]))]
        done = int(gap)
    pieces.append(words[done:][keep[done:]])
    return np.concatenate(pieces).tobytes()


def _evt3_bridge(start: int, stop: int) -> Words:
    """TIME_HIGH words from `start` towards `stop` in steps that count every wrap.

    Each wrap is a step from 0xFFF to 0: faery 0.7.1 takes no other for one, and OpenEB none that is far off.
    """
    if stop - start > _EVT3_MAX_STEP * _EVT3_MAX_BRIDGE:
        raise InputError(
            f"evt3 has 24-bit time and cannot jump from {start << 12} to {stop << 12} us; "
            "subtract an offset from all times, or write mono"
        )
    steps = np.arange((start // _EVT3_MAX_STEP + 1) * _EVT3_MAX_STEP, stop + 1, _EVT3_MAX_STEP)
    wraps = steps[steps % (EVT3_WRAP_US >> 12) == 0]
    bridge = np.unique(np.concatenate([[start], wraps - 1, steps[steps < stop]]))
    words: Words = (0x8000 | bridge & 0xFFF).astype("<u2")
    return words
