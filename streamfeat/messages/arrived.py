"""A packet between its decoder and its place in time, and those of its events whose times cannot be right.

Lives here: `Arrived`, which knows the span of its times; telling a few events with absurd times from the
others, by the packet's own times.
Not here: packets that are absurd as a whole, and what is counted (`timeline`).
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from streamfeat.events import Events, Resolution
from streamfeat.kernels.decode import time_span
from streamfeat.messages.clock import BACK_US, STEP_US
from streamfeat.messages.packets import MAX_STREAM_US, Label

__all__ = ["Arrived", "stray_events"]

_FEW = 8
"""Events apart from the others are strays if they are fewer than one in so many."""


@dataclass(slots=True)
class Arrived:
    """A packet between its decoder and its place in time.

    Attributes:
        now_ns: when it arrived or was recorded.
        until_us: if it has no events, the time that it gives for itself, as the camera says.
        first_us: time of its earliest event on the sensor, as the camera says.
        last_us: time of its latest one.
        tail: while it is held, the number of its last events that may be strays; 0 if all of it may be one.
        anew: it is the first of a publisher that counts anew.
        behind: what came after it while it was held.
    """

    events: Events
    resolution: Resolution
    log_time_ns: int
    seq: int
    source_ns: int
    now_ns: int
    until_us: int | None = None
    first_us: int = 0
    last_us: int = 0
    tail: int = 0
    anew: bool = False
    behind: "list[Arrived | Label]" = field(default_factory=list)

    def measure(self, span: NDArray[np.int64]) -> int:
        """Find its first and last time; events outside the sensor are rejected later and have no say.

        Args:
            span: `(2,)` int64, overwritten.

        Returns:
            The number of events on the sensor; the times are those of before where there is none.
        """
        if len(self.events) == 0:
            return 0
        n_inside: int = time_span(self.events, *self.resolution, span)
        self.first_us, self.last_us = span.tolist()
        return n_inside

    def leave_impossible_out(self) -> tuple[int, int]:
        """Leave out events with times that no message can have; give their number and the time of one."""
        t = self.events["t"]
        kept = (t >= 0) & (t <= MAX_STREAM_US)
        one_us = int(t[np.argmin(kept)])
        self.events = self.events[kept]
        return len(t) - len(self.events), one_us

    def leave_strays_out(self, before_us: int | None) -> tuple[int, int]:
        """Leave out the few events whose times are apart from the others, and find a tail that may be such.

        Args:
            before_us: as of `stray_events`.

        Returns:
            The number of events that were left out, and the time of one.
        """
        t = self.events["t"]
        strays = stray_events(t, before_us)
        n_strays, one_us = int(np.count_nonzero(strays)), int(t[np.argmax(strays)])
        if n_strays:
            self.events = self.events[~strays]
            t = self.events["t"]
        self.tail = _tail(t)
        body = t[: len(t) - self.tail]
        self.first_us, self.last_us = int(body.min()), int(body.max())
        return n_strays, one_us


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
        if not fewer.any() or (np.count_nonzero(strays) + np.count_nonzero(fewer)) * _FEW > len(t):
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


def _tail(t: NDArray[np.int64]) -> int:
    """How many events at the end of a packet are a step ahead of all others, and few; 0 if there are none."""
    steps = np.flatnonzero(np.diff(t) > STEP_US)
    if len(steps) == 0:
        return 0
    tail = len(t) - 1 - int(steps[-1])
    return tail if tail * _FEW <= len(t) else 0
