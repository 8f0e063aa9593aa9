"""One topic's packets, each once and at its place in time.

Lives here: `Timeline`, which joins sequence numbers (`delivery`), decoders (`packets`) and a clock.
Not here: where messages come from, and the order in which they are given.

A single event or packet with an absurd time costs at most itself. A packet whose times step suspiciously far
is held until the next one shows whether the step was real: if so both are used, if not the first is dropped
and counted. So at most one packet, and the labels behind it, wait here.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.kernels.decode import time_span
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.clock import CameraClock
from streamfeat.messages.delivery import Delivery, fingerprint_of
from streamfeat.messages.event_messages import parse_events
from streamfeat.messages.packets import MAX_PIXELS, Label, Packet, PacketReader

__all__ = ["TIMELINE_COUNTS", "Timeline", "stray_events"]

TIMELINE_COUNTS = (
    "restarts",
    "jumps",
    "wraps",
    "steps back",
    "lost",
    "duplicates",
    "reordered",
    "stray packets",
    "stray events",
    "out of order",
)
"""What is counted, see `Timeline.counts`."""

_BACK_US = 500_000
"""A fall of less than this is events out of order, of the same clock."""
_STEP_US = 1_000_000
"""Within a packet, and beyond twice the time that passed between packets, a larger step is suspicious."""
_FEW = 8
"""Events apart from the others are strays if they are fewer than one in so many."""


@dataclass(slots=True)
class _Held:
    """A packet that waits for the next one, with the labels behind it.

    `tail` is the number of its last events that may be strays; 0 if the whole packet may be one.
    """

    packet: Packet
    first_us: int
    last_us: int
    tail: int
    behind: list[Label]


class Timeline:
    """Follows one topic of a recording.

    Args:
        topic: named in the packets.

    Attributes:
        encoding: of the latest packet.
        counts: what happened: `duplicates`, `reordered`, `lost`, `restarts`, `jumps`, `wraps`, `steps back`,
            `stray packets`, `stray events`, `out of order` (of log time, further than the buffer reaches);
            those that did not happen are missing.
    """

    def __init__(self, topic: str) -> None:
        """Nothing has come."""
        self.encoding = ""
        self._topic = topic
        self._events: Counter[str] = Counter()
        self._reader = PacketReader(topic)
        self._delivery = Delivery()
        self._clock = CameraClock(0, _BACK_US)
        self._last_us: int | None = None
        self._log_time_ns = 0
        self._heard_ns = 0
        self._span = np.zeros(2, np.int64)
        self._lost = 0
        self._counts_anew = False
        self._held: _Held | None = None

    @property
    def counts(self) -> Counter[str]:
        """See the class."""
        stats = self._delivery.stats
        told = {"duplicates": stats.duplicates, "reordered": stats.reordered, "lost": stats.lost}
        return +(self._events + Counter(told))

    def label(self, label: Label) -> Iterator[Label]:
        """Take in a label: it comes out behind the packets before it."""
        if self._held:
            self._held.behind.append(label)
        else:
            yield label

    def message(
        self, schema: str, data: bytes | memoryview, log_time_ns: int, sequence: int, layout: str = "cdr"
    ) -> Iterator[Packet | Label]:
        """Take in one message of events, and yield what is certain now.

        Raises:
            InputError: the bytes are no such message, or its payload is not what it says.
        """
        self._events["out of order"] += log_time_ns < self._heard_ns
        self._heard_ns = max(self._heard_ns, log_time_ns)
        try:
            message = parse_events(schema, data, layout)
        except InputError:
            self._lost += 1
            raise
        if isinstance(message, EventPacket):
            mark = fingerprint_of(message)
            seen = self._delivery.see(b"", message.seq, log_time_ns, mark=mark, stamp_ns=message.stamp_ns)
            self._lost += seen.lost
            if not seen.use:
                return
            if seen.restarted:
                # Times and addresses that a decoder carried on are of the run before.
                self._reader, self._counts_anew = PacketReader(self._topic), True
            elif seen.broken:
                self._reader.resync()
        try:
            packet = self._reader.read(schema, message, log_time_ns, sequence)
            height, width = packet.resolution
            if height * width > MAX_PIXELS:
                raise InputError(f"a sensor of {width}x{height} pixels; at most {MAX_PIXELS} are read")
        except InputError:
            self._lost += 1
            raise
        self.encoding = self._reader.encoding
        yield from self.packet(packet)

    def packet(self, packet: Packet) -> Iterator[Packet | Label]:
        """Take in a packet that is decoded, and yield what is certain now."""
        events = packet.events
        height, width = packet.resolution
        if len(events) == 0:
            yield replace(packet, lost=self._taken_lost(), epoch=self._clock.epoch)
            return
        t = events["t"]
        # Events outside the sensor are rejected later; their times have no say.
        n_inside = time_span(np.require(events, requirements=["C", "A", "W"]), height, width, self._span)
        first, last = self._span.tolist()
        if n_inside == 0:
            yield from self._settled(int(t.min()))
            yield replace(packet, lost=self._taken_lost(), epoch=self._clock.epoch)
            return
        tail = 0
        before_us = self._place_before(first)
        if last - first > _STEP_US or (before_us is not None and first < before_us - _BACK_US <= last):
            strays = stray_events(t, before_us)
            if strays.any():
                self._events["stray events"] += int(np.count_nonzero(strays))
                events = events[~strays]
                packet, t = replace(packet, events=events), events["t"]
            tail = _tail(t)
            body = t[: len(t) - tail]
            first, last = int(body.min()), int(body.max())
        yield from self._settled(first)
        held = _Held(packet, first, last, tail, [])
        if tail or self._is_suspicious(first, packet.log_time_ns):
            self._held = held
        else:
            yield self._use(held)

    def finish(self) -> Iterator[Packet | Label]:
        """Nothing follows: what is held was real."""
        yield from self._settled(None)

    def _taken_lost(self) -> int:
        lost, self._lost = self._lost, 0
        return lost

    def _place_before(self, first_us: int) -> int | None:
        """The time that this topic has reached, if the next packet goes on from there."""
        if self._held and not self._held.tail:
            return self._held.last_us if first_us >= self._held.first_us - _BACK_US else self._last_us
        return self._held.last_us if self._held else self._last_us

    def _is_suspicious(self, first_us: int, log_time_ns: int) -> bool:
        if self._last_us is None or self._counts_anew:
            return False
        step = first_us + self._clock.offset_us - self._last_us
        elapsed_us = max((log_time_ns - self._log_time_ns) // 1000, 0)
        return step < -_BACK_US or step > _STEP_US + 2 * elapsed_us

    def _settled(self, next_us: int | None) -> Iterator[Packet | Label]:
        """Use what is held, or drop it, as the next packet's first time shows; None if there is none."""
        held, self._held = self._held, None
        if held is None:
            return
        packet = held.packet
        if held.tail:
            tail_us = int(packet.events["t"][-held.tail])
            if next_us is not None and next_us < tail_us - _BACK_US:
                self._events["stray events"] += held.tail
                held.packet = replace(packet, events=packet.events[: -held.tail])
            else:
                held.last_us = int(packet.events["t"].max())
        if held.tail == 0 and self._is_stray(held, next_us):
            self._events["stray packets"] += 1
            self._lost += 1
        else:
            yield self._use(held)
        yield from held.behind

    def _is_stray(self, held: _Held, next_us: int | None) -> bool:
        if next_us is None or self._last_us is None:
            return False
        last_us = self._last_us - self._clock.offset_us
        goes_on = next_us >= last_us - _BACK_US
        return goes_on and (held.first_us < last_us or next_us < held.first_us - _BACK_US)

    def _use(self, held: _Held) -> Packet:
        packet = held.packet
        place = self._clock.place(held.first_us, held.last_us, packet.log_time_ns, anew=self._counts_anew)
        self._counts_anew = False
        if place.event:
            self._events[{"wrapped": "wraps", "restarted": "restarts", "jumped": "jumps"}[place.event]] += 1
        if place.offset_us:
            events = packet.events.copy()
            events["t"] += np.int64(place.offset_us)
            packet = replace(packet, events=events)
        first, last = held.first_us + place.offset_us, held.last_us + place.offset_us
        if self._last_us is None or place.event in ("restarted", "jumped"):
            self._last_us = last
        else:
            self._events["steps back"] += first < self._last_us
            self._last_us = max(self._last_us, last)
        self._log_time_ns = packet.log_time_ns
        if self._lost == 0 and place.epoch == 0:
            return packet
        return replace(packet, lost=self._taken_lost(), epoch=place.epoch)


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
    if before_us is not None and np.median(t) >= before_us - _BACK_US:
        highest_before = np.maximum(highest_before, before_us + _STEP_US - _BACK_US)
    return t > lowest_after + _STEP_US, t < highest_before - _STEP_US


def _tail(t: NDArray[np.int64]) -> int:
    """How many events at the end of a packet are a step ahead of all others, and few; 0 if there are none."""
    steps = np.flatnonzero(np.diff(t) > _STEP_US)
    if len(steps) == 0:
        return 0
    tail = len(t) - 1 - int(steps[-1])
    return tail if tail * _FEW <= len(t) else 0
