"""One topic's packets, each once and at its place in time: the same rule for recordings and live topics.

Lives here: `Timeline`, which joins sequence numbers (`delivery`), decoders (`packets`) and a clock.
Not here: where messages come from, the order in which they are given, and what is said about them.

A single event or packet with an absurd time costs at most itself. A packet whose times step suspiciously far
is held until the next one shows whether the step was real: if so both are used, if not the first is dropped
and counted. So at most one packet waits here, for `HOLD_NS` at most, and few labels and empty packets behind
it.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from streamfeat.errors import InputError
from streamfeat.files.json_fields import Fields
from streamfeat.messages.arrived import Arrived
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.clock import CameraClock
from streamfeat.messages.codecs import MAX_PACKET_EVENTS
from streamfeat.messages.delivery import Delivery, Verdict, fingerprint_of
from streamfeat.messages.event_messages import parse_events
from streamfeat.messages.packets import MAX_STREAM_US, Content, Item, Label, Packet, PacketReader
from streamfeat.messages.strays import BACK_US, STEP_US

__all__ = ["HOLD_NS", "TIMELINE_COUNTS", "Timeline"]

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

_CLOCK_COUNTS = ("restarts", "jumps", "wraps", "steps back", "stray packets", "stray events", "out of order")
"""Those that the timeline itself counts."""

HOLD_NS = 1_500_000_000
"""A packet is held no longer than this: packets of a camera that is awake are at most a second apart."""
_MOST_BEHIND = 256
"""Labels and empty packets that wait behind a held packet; one more, and it is used."""


class Timeline:
    """Follows one topic, recorded or live.

    Messages of a recording go through `message`, packets of camera files through `packet`. A live topic, of
    which more is known, is `see`n first, by number and publisher, and then its messages are `take`n.

    Args:
        topic: named in the packets.
        max_events: packets of more events are refused.
        joins_late: packets before the first that is heard are missing from its window.
        tell: told what happened to the clock or to a packet's times, one of `TIMELINE_COUNTS`, and details.

    Attributes:
        delivery: what is known of the topic's numbers and publishers.
    """

    def __init__(
        self,
        topic: str,
        *,
        max_events: int = MAX_PACKET_EVENTS,
        joins_late: bool = False,
        tell: Callable[[str, str], None] = lambda what, detail: None,
    ) -> None:
        """Nothing has come."""
        self.delivery = Delivery()
        self._topic, self._max_events, self._joins_late, self._tell = topic, max_events, joins_late, tell
        self._happened: Counter[str] = Counter()
        self._reader = PacketReader(max_events)
        self._clock = CameraClock()
        self._heard_ns = 0
        self._span = np.zeros(2, np.int64)
        self._lost = 0
        self._counts_anew = False
        self._held: Arrived | None = None

    @property
    def counts(self) -> Counter[str]:
        """What happened, those of `TIMELINE_COUNTS` that did.

        `out of order` is of log time, further than the buffer of a recording reaches.
        """
        stats = self.delivery.stats
        told = {"duplicates": stats.duplicates, "reordered": stats.reordered, "lost": stats.lost}
        return +(self._happened + Counter(told))

    @property
    def encoding(self) -> str:
        """Of the payload of the latest message."""
        return self._reader.encoding

    @property
    def reached_us(self) -> int | None:
        """Stream time that the packets have reached; None before the first."""
        return self._clock.reached_us

    @property
    def is_holding(self) -> bool:
        """Whether a packet waits for the next one."""
        return self._held is not None

    def snapshot(self, now_ns: int) -> dict[str, Any]:
        """What is known, as JSON values. A packet that is held is no part of it: it counts as lost.

        Args:
            now_ns: by the clock that gives arrival times.
        """
        happened = {"happened": [self._happened[name] for name in _CLOCK_COUNTS], "anew": self._counts_anew}
        return {
            "reader": self._reader.snapshot(),
            "clock": self._clock.snapshot(now_ns) | happened,
            "delivery": self.delivery.snapshot(now_ns),
            "stream_us": self.reached_us,
            "lost": self._lost + self.is_holding,
        }

    def restore(self, values: Fields, now_ns: int) -> None:
        """Go on from a snapshot that was taken at `now_ns`, by the clock that gives arrival times.

        Raises:
            InputError: the values are not those of a timeline.
        """
        clock = values.inner("clock")
        self._reader.restore(values.inner("reader"))
        self._clock.restore(clock, now_ns)
        self.delivery.restore(values.inner("delivery"), now_ns)
        self._lost = values.whole("lost")
        if "happened" in clock:
            happened = clock.wholes("happened", len(_CLOCK_COUNTS))
            self._happened = Counter(dict(zip(_CLOCK_COUNTS, happened, strict=False)))
        self._counts_anew = "anew" in clock and clock.flag("anew")

    def message(
        self, schema: str, data: bytes | memoryview, log_time_ns: int, sequence: int, layout: str = "cdr"
    ) -> Iterable[Packet | Label]:
        """Take in one recorded message of events, and give what is certain now.

        Raises:
            InputError: the bytes are no such message, or its payload is not what it says.
        """
        if log_time_ns < self._heard_ns:
            self._happened["out of order"] += 1
        else:
            self._heard_ns = log_time_ns
        try:
            content = parse_events(schema, data, layout)
        except InputError:
            self.miss()
            raise
        seen = self.see(content, log_time_ns)
        return self.take(schema, content, seen, log_time_ns, sequence) if seen.use else ()

    def see(
        self,
        content: Content | None,
        now_ns: int,
        *,
        number: tuple[bytes, int] | None = None,
        dropped: int = 0,
    ) -> Verdict:
        """Judge the next message by its number; one without a number is used.

        Args:
            content: the message; None if it cannot be read.
            now_ns: when it arrived or was recorded, by a clock that does not go back.
            number: publisher and number of the message, where these came with it; else its own.
            dropped: messages of this topic that were dropped since the one before.
        """
        if number:
            seen = self.delivery.see(*number, now_ns, dropped)
        elif isinstance(content, EventPacket):
            mark, stamp_ns = fingerprint_of(content), content.stamp_ns
            seen = self.delivery.see(b"", content.seq, now_ns, dropped, mark=mark, stamp_ns=stamp_ns)
        else:
            seen = self.delivery.see_unnumbered(now_ns, dropped)
        self._lost += seen.lost + (seen.unheard if self._joins_late else 0)
        if seen.restarted:
            # Times and addresses that a decoder carried on are of the run before.
            self._reader, self._counts_anew = PacketReader(self._max_events), True
        elif seen.broken:
            self._reader.resync()
        return seen

    def miss(self) -> None:
        """A message came that cannot be used."""
        self._lost += 1

    def begin(self) -> None:
        """What comes next is another life of this camera; call `finish` before."""
        self._reader, self._clock = PacketReader(self._max_events), CameraClock()
        self._counts_anew = False

    def take(
        self,
        schema: str,
        content: Content,
        seen: Verdict,
        log_time_ns: int,
        sequence: int,
        *,
        now_ns: int | None = None,
        source_ns: int = 0,
    ) -> list[Packet | Label]:
        """Decode a message that is to be used, and give what is certain now.

        Args:
            schema: type of the message.
            content: the message.
            seen: what `see` said of it.
            log_time_ns: when it was recorded or received.
            sequence: its number, where it has none of its own.
            now_ns: when it arrived, by a clock that does not go back; `log_time_ns` where there is no other.
            source_ns: when it was published, 0 if nobody says.

        Raises:
            InputError: its payload is not what it says, or its sensor is too large.
        """
        reader = self._reader
        try:
            events = reader.decode(schema, content)
        except InputError:
            self.miss()
            raise
        resolution = reader.resolution
        assert resolution is not None
        seq = content.seq if isinstance(content, EventPacket) else sequence
        heard_ns = log_time_ns if now_ns is None else now_ns
        arrived = Arrived(events, resolution, log_time_ns, seq, source_ns, heard_ns, reader.time_us)
        arrived.first_us, arrived.last_us = reader.span.tolist()
        return self._take(arrived, reader.n_inside, is_late=seen.late, is_message=True)

    def packet(self, packet: Packet) -> list[Item]:
        """Take in a packet of a camera file, and give what is certain now."""
        log_ns, events = packet.log_time_ns, np.require(packet.events, requirements=["C", "A", "W"])
        about = events, packet.resolution, log_ns, packet.seq, packet.source_ns, log_ns
        arrived = Arrived(*about, packet.until_us)
        return self._take(arrived, arrived.measure(self._span), is_late=False, is_message=False)

    def label(self, label: Label) -> Iterable[Packet | Label]:
        """Take in a label: it comes out behind the packets before it."""
        return self._wait_behind(label)

    def finish(self) -> Iterable[Packet | Label]:
        """Nothing follows: what is held was real."""
        return self._settled(None)

    def _take(self, arrived: Arrived, n_inside: int, *, is_late: bool, is_message: bool) -> list[Item]:
        done: list[Item] = []
        if self._held and arrived.now_ns - self._held.now_ns > HOLD_NS:
            done += self._settled(None)
        if is_message and self._reader.encoding == "evt3" and self.reached_us is not None:
            placed_us = self.reached_us - self._clock.offset_us
            if self._held or n_inside < len(arrived.events) or arrived.may_have_wrapped(placed_us):
                self._reader.count_wraps(-arrived.take_wrap_back(placed_us, self._held))
                n_inside = arrived.measure(self._span)
        if is_message and n_inside and (arrived.first_us < 0 or arrived.last_us > MAX_STREAM_US):
            self._within_limits(arrived)
            if len(arrived.events) == 0:
                return done
            n_inside = arrived.measure(self._span)
        if n_inside == 0:
            return [*done, *self._without_times(arrived)]
        may_be_odd = self._held or self._counts_anew or is_late
        if not may_be_odd and self._clock.goes_on(arrived.first_us, arrived.last_us, arrived.now_ns):
            return [*done, self._made(arrived, None)]
        if is_late and self._is_behind(arrived.last_us):
            return [*done, self._use(arrived, is_late=True)]
        arrived.anew, self._counts_anew = self._counts_anew, False
        before_us = self._place_before(arrived.first_us)
        if arrived.last_us - arrived.first_us > STEP_US or (
            before_us is not None and arrived.first_us < before_us - BACK_US <= arrived.last_us
        ):
            n_strays, first_us = arrived.leave_strays_out(before_us)
            if n_strays:
                self._count("stray events", f"one at {first_us} us", n_strays)
        if self._held:
            done += self._settled(arrived.first_us)
        is_doubtful = not arrived.anew and self._clock.is_suspicious(arrived.first_us, arrived.now_ns)
        if arrived.tail or is_doubtful:
            self._held = arrived
        else:
            done.append(self._use(arrived))
        return done

    def _within_limits(self, arrived: Arrived) -> None:
        """Leave out events with times that no message can have; a packet of nothing else is lost."""
        n_strays, worst_us = arrived.leave_impossible_out()
        detail = f"one at {worst_us} us; times lie between 0 and {MAX_STREAM_US} us"
        if len(arrived.events):
            self._count("stray events", detail, n_strays)
        else:
            self._count("stray packets", detail)
            self.miss()

    def _without_times(self, arrived: Arrived) -> Iterable[Packet | Label]:
        """A packet without an event on the sensor; it may tell how far time has come."""
        until_us = arrived.until_us if len(arrived.events) == 0 else None
        if until_us is None or not 0 <= until_us <= MAX_STREAM_US:
            yield from self._wait_behind(arrived)
            return
        yield from self._settled(until_us)
        reached_us = None
        if self.reached_us is not None and not self._clock.is_suspicious(until_us, arrived.now_ns):
            self._clock.place(until_us, until_us, arrived.now_ns)
            reached_us = self.reached_us
        yield self._made(arrived, reached_us)

    def _wait_behind(self, item: Label | Arrived) -> Iterator[Packet | Label]:
        if self._held is None:
            yield item if isinstance(item, Label) else self._made(item, None)
            return
        self._held.behind.append(item)
        if len(self._held.behind) > _MOST_BEHIND:
            yield from self._settled(None)

    def _count(self, what: str, detail: str, n: int = 1) -> None:
        self._happened[what] += n
        self._tell(what, detail)

    def _is_behind(self, last_us: int) -> bool:
        """Whether a time is one that the clock has passed, if it went on as it did."""
        return self.reached_us is not None and last_us + self._clock.offset_us <= self.reached_us

    def _place_before(self, first_us: int) -> int | None:
        """The time that this topic has reached, if the next packet goes on from there."""
        if self._held and not self._held.tail:
            return self._held.last_us if first_us >= self._held.first_us - BACK_US else self.reached_us
        return self._held.last_us if self._held else self.reached_us

    def _settled(self, next_us: int | None) -> Iterator[Packet | Label]:
        """Use what is held, or drop it, as the next packet's first time shows; None if there is none."""
        held, self._held = self._held, None
        if held is None:
            return
        t = held.events["t"]
        if held.tail:
            tail_us = int(t[-held.tail])
            if next_us is not None and next_us < tail_us - BACK_US:
                self._count("stray events", f"one at {tail_us} us", held.tail)
                held.events = held.events[: -held.tail]
            else:
                held.last_us = int(t.max())
        if held.tail == 0 and self._is_stray(held, next_us):
            self._count("stray packets", f"its events begin at {held.first_us} us")
            self.miss()
        else:
            yield self._use(held)
        for item in held.behind:
            yield item if isinstance(item, Label) else self._made(item, None)

    def _is_stray(self, held: Arrived, next_us: int | None) -> bool:
        if next_us is None or self.reached_us is None:
            return False
        last_us = self.reached_us - self._clock.offset_us
        goes_on = next_us >= last_us - BACK_US
        return goes_on and (held.first_us < last_us or next_us < held.first_us - BACK_US)

    def _use(self, arrived: Arrived, *, is_late: bool = False) -> Packet:
        before_us = self.reached_us
        if not is_late:
            span = arrived.first_us, arrived.last_us
            place = self._clock.place(*span, arrived.now_ns, anew=arrived.anew)
            if place.event:
                what = {"wrapped": "wraps", "restarted": "restarts", "jumped": "jumps"}[place.event]
                self._count(what, f"{arrived.first_us} us")
                before_us = before_us if place.event == "wrapped" else None
        offset_us = self._clock.offset_us
        if before_us is not None and arrived.first_us + offset_us < before_us:
            self._happened["steps back"] += 1
        if offset_us:
            arrived.events = arrived.events.copy()
            arrived.events["t"] += np.int64(offset_us)
        return self._made(arrived, None)

    def _made(self, arrived: Arrived, until_us: int | None) -> Packet:
        lost, self._lost = self._lost, 0
        return Packet(
            self._topic,
            arrived.events,
            arrived.resolution,
            arrived.log_time_ns,
            arrived.seq,
            arrived.source_ns,
            lost,
            self._clock.epoch,
            until_us,
        )
