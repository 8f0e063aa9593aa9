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

from streamfeat.errors import InputError
from streamfeat.events import Events
from streamfeat.kernels.decode import time_span
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.clock import CameraClock
from streamfeat.messages.codecs import EVT3_WRAP_US
from streamfeat.messages.delivery import Delivery, fingerprint_of
from streamfeat.messages.event_messages import parse_events
from streamfeat.messages.packets import MAX_PIXELS, Label, Packet, PacketReader
from streamfeat.messages.strays import BACK_US, STEP_US, false_wrap, stray_events, tail_apart

__all__ = ["TIMELINE_COUNTS", "Timeline"]

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
        self._clock = CameraClock(0, BACK_US)
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
        if self.encoding == "evt3":
            self._take_wrap_back(packet)
        yield from self.packet(packet)

    def _take_wrap_back(self, packet: Packet) -> None:
        """Undo a wrap that strays more than half the range of evt3 ahead have made; changes the events.

        One packet may be such a stray, or one event in eight of a packet.
        """
        t = packet.events["t"]
        if len(t) == 0 or self._last_us is None:
            return
        held, before_us = self._held, self._last_us - self._clock.offset_us
        is_behind = held is not None and bool(held.tail or held.first_us > before_us + EVT3_WRAP_US // 2)
        if held and held.tail:
            before_us = held.last_us
        if is_behind and -BACK_US <= int(t[0]) - EVT3_WRAP_US - before_us <= STEP_US:
            at: int | None = 0
        else:
            is_plain = bool(held) or self._is_short(packet.events, before_us)
            at = None if is_plain else false_wrap(t, before_us, len(t) // 8)
        if at is not None:
            t[at:] -= EVT3_WRAP_US
            self._reader.count_wraps(-1)

    def _is_short(self, events: Events, before_us: int) -> bool:
        """Whether no two times of a packet of evt3, or before it, are half the range of its clock apart."""
        time_span(events, 1 << 16, 1 << 16, self._span)
        first, last = self._span.tolist()
        return bool(last - min(first, before_us) <= EVT3_WRAP_US // 2)

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
        if last - first > STEP_US or (before_us is not None and first < before_us - BACK_US <= last):
            strays = stray_events(t, before_us)
            if strays.any():
                self._events["stray events"] += int(np.count_nonzero(strays))
                events = events[~strays]
                packet, t = replace(packet, events=events), events["t"]
            tail = tail_apart(t)
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
            return self._held.last_us if first_us >= self._held.first_us - BACK_US else self._last_us
        return self._held.last_us if self._held else self._last_us

    def _is_suspicious(self, first_us: int, log_time_ns: int) -> bool:
        if self._last_us is None or self._counts_anew:
            return False
        step = first_us + self._clock.offset_us - self._last_us
        elapsed_us = max((log_time_ns - self._log_time_ns) // 1000, 0)
        return step < -BACK_US or step > STEP_US + 2 * elapsed_us

    def _settled(self, next_us: int | None) -> Iterator[Packet | Label]:
        """Use what is held, or drop it, as the next packet's first time shows; None if there is none."""
        held, self._held = self._held, None
        if held is None:
            return
        packet = held.packet
        if held.tail:
            tail_us = int(packet.events["t"][-held.tail])
            if next_us is not None and next_us < tail_us - BACK_US:
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
        goes_on = next_us >= last_us - BACK_US
        return goes_on and (held.first_us < last_us or next_us < held.first_us - BACK_US)

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
