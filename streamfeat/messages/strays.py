"""Times of one packet that cannot be right.

Lives here: events far from all others of their packet, and wraps of evt3 that are none.
Not here: whole packets, and what becomes of them (`timeline`).
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.messages.codecs import EVT3_WRAP_US

__all__ = ["BACK_US", "FEW", "STEP_US", "false_wrap", "stray_events", "tail_apart"]

BACK_US = 500_000
"""A fall of less than this is events out of order, of the same clock."""
STEP_US = 1_000_000
"""Within a packet, and beyond twice the time that passed between packets, a larger step is suspicious."""
FEW = 8
"""Events apart from the others are strays if they are fewer than one in so many."""


def stray_events(t: NDArray[np.int64], before_us: int | None) -> NDArray[np.bool_]:
    """Mark the few events of one packet whose times are more than a second apart from the others.

    Args:
        t: `(n,)` times in stored order, microseconds, n > 0.
        before_us: the time that the packets before reached, None if there are none.

    Returns:
        `(n,)`; none is marked where too many would be, for then the clock itself has moved.
    """
    strays = np.zeros(len(t), np.bool_)
    if len(t) < 2:
        return strays
    for _ in range(3):
        kept = np.flatnonzero(~strays)
        ahead, behind = _apart(t[kept], before_us)
        fewer = _less_likely(t[kept], ahead, behind)
        if not fewer.any() or (np.count_nonzero(strays) + np.count_nonzero(fewer)) * FEW > len(t):
            break
        strays[kept[fewer]] = True
    return strays


def _less_likely(
    t: NDArray[np.int64], ahead: NDArray[np.bool_], behind: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """The set of fewer events; of two equal ones, that which lies further from the middle."""
    if not (ahead.any() and behind.any()):
        return ahead | behind
    counts = np.count_nonzero(ahead), np.count_nonzero(behind)
    if counts[0] != counts[1]:
        return ahead if counts[0] < counts[1] else behind
    far = np.abs(t - np.median(t))
    return ahead if far[ahead].max() >= far[behind].max() else behind


def _apart(t: NDArray[np.int64], before_us: int | None) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Events more than a step ahead of one that follows, and more than a step behind one before."""
    lowest_after = np.minimum.accumulate(t[::-1])[::-1]
    highest_before = np.maximum.accumulate(t)
    if before_us is not None and np.median(t) >= before_us - BACK_US:
        highest_before = np.maximum(highest_before, before_us + STEP_US - BACK_US)
    return t > lowest_after + STEP_US, t < highest_before - STEP_US


def tail_apart(t: NDArray[np.int64]) -> int:
    """How many events at the end of a packet are a step ahead of all others, and few; 0 if there are none."""
    steps = np.flatnonzero(np.diff(t) > STEP_US)
    if len(steps) == 0:
        return 0
    tail = len(t) - 1 - int(steps[-1])
    return tail if tail * FEW <= len(t) else 0


def false_wrap(t: NDArray[np.int64], before_us: int | None, most: int) -> int | None:
    """Where in a packet of evt3 a wrap was counted that was none, or None.

    Times of 24 bits that jump ahead by more than half their range and come back look as if they had wrapped.
    They have not if, less that wrap, they go on from the times before the jump.

    Args:
        t: `(n,)` times in stored order, microseconds, n > 0.
        before_us: the time that the packets before reached, None if there are none.
        most: how many events may lie between the jump and the wrap.
    """
    times = t if before_us is None else np.concatenate([[before_us], t])
    skipped = len(times) - len(t)
    for jump in np.flatnonzero(np.diff(times) > EVT3_WRAP_US // 2)[:1].tolist():
        behind = times[jump + 1 : jump + 2 + most] - EVT3_WRAP_US - times[jump]
        back = np.flatnonzero((behind >= -BACK_US) & (behind <= STEP_US))
        if len(back):
            return int(jump + 1 + back[0] - skipped)
    return None
