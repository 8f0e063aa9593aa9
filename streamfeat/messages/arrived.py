"""A packet between its decoder and its place in time.

Lives here: `Arrived`, which knows the span of its times, and leaves out events whose times cannot be right.
Not here: how these are told from the others (`strays`), packets that are absurd as a whole, and what is
counted (`timeline`).
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from streamfeat.events import Events, Resolution
from streamfeat.kernels.decode import time_span
from streamfeat.messages.codecs import EVT3_WRAP_US
from streamfeat.messages.packets import MAX_STREAM_US, Label
from streamfeat.messages.strays import BACK_US, STEP_US, false_wrap, stray_events, tail_apart

__all__ = ["Arrived"]


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

    def may_have_wrapped(self, before_us: int) -> bool:
        """Whether a time may be more than half the range of evt3 ahead of the one before, `measure`d."""
        return self.last_us - min(self.first_us, before_us) > EVT3_WRAP_US // 2

    def take_wrap_back(self, before_us: int, held: "Arrived | None") -> int:
        """Undo a wrap that strays more than half the range of evt3 ahead have made; changes the events.

        One packet may be such a stray, or one event in eight of a packet.

        Args:
            before_us: the time that the packets before reached, as the camera says.
            held: the packet before, if that is held.

        Returns:
            The number of wraps that were undone, 0 or 1.
        """
        t = self.events["t"]
        if len(t) == 0:
            return 0
        is_behind = held is not None and bool(held.tail or held.first_us > before_us + EVT3_WRAP_US // 2)
        if held and held.tail:
            before_us = held.last_us
        if is_behind and -BACK_US <= int(t[0]) - EVT3_WRAP_US - before_us <= STEP_US:
            at: int | None = 0
        else:
            at = None if held else false_wrap(t, before_us, len(t) // 8)
        if at is None:
            return 0
        t[at:] -= EVT3_WRAP_US
        return 1

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
        self.tail = tail_apart(t)
        body = t[: len(t) - self.tail]
        self.first_us, self.last_us = int(body.min()), int(body.max())
        return n_strays, one_us
