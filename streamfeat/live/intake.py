"""From messages as they came to items of the stream: checked, counted, placed in time.

Lives here: what is refused and why, warnings, who appears and who leaves, and time that passes in silence.
Not here: the network (`network`), what is done with events (`cameras`).

Whatever arrives is hostile until proven otherwise. A payload may have 4 MiB and 2^20 events, a sensor 2^22
pixels, and no more than 256 topics are followed at a time, so that memory is bounded by those numbers and by
the inbox. What is refused is counted under its reason, with one line a second and reason at most.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, Self

import numpy as np
from rich.console import Console

from streamfeat.errors import InputError
from streamfeat.files.json_fields import Fields
from streamfeat.live.inbox import Announcement, Inbox, RawMessage
from streamfeat.live.names import Attachment
from streamfeat.live.topic import (
    MAX_LABEL_US,
    MAX_LIVE_PACKET_EVENTS,
    MAX_STREAM_US,
    MAX_TOPICS,
    Barrier,
    TopicState,
)
from streamfeat.messages.cdr import EventPacket, LabelMessage
from streamfeat.messages.clock import CameraClock
from streamfeat.messages.delivery import DeliveryStats
from streamfeat.messages.packets import EVENT_SCHEMAS, MAX_PIXELS, Label, Packet, PacketReader, Watermark
from streamfeat.stream.cameras import CameraLeft

__all__ = ["MAX_PAYLOAD_BYTES", "Intake", "Warnings"]

MAX_PAYLOAD_BYTES = 4 << 20
_MAX_SPAN_US = 60_000_000
_POLL_S = 0.02
_IDLE_S = 0.25
_FORGOTTEN_NS = 60_000_000_000
SILENCE_S = 0.2
"""A camera that has been silent for so long is taken to have nothing to say, and its time goes on."""
GRACE_S = 0.5
"""Who leaves is released when nothing has come for so long: zenoh may tell of it before the last packets."""
_RESTORED_S = 10.0
"""A camera of a snapshot is waited for so long: links come up again within a few seconds."""


class Warnings:
    """Counts by reason, and says so once a second and reason at most.

    Args:
        say: given a line of text.
        clock: seconds, monotonic.
    """

    def __init__(
        self, say: Callable[[str], None] = lambda line: None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Nothing counted yet."""
        self.counts: Counter[str] = Counter()
        self._say = say
        self._clock = clock
        self._next: dict[str, float] = {}
        self._silent: Counter[str] = Counter()

    @classmethod
    def on(cls, console: Console | None) -> Self:
        """Say it there, or only count."""
        if console is None:
            return cls()
        return cls(partial(console.print, style="yellow", markup=False, soft_wrap=True))

    def add(self, reason: str, topic: str, detail: str) -> None:
        """Count one, and say it unless that reason was said less than a second ago."""
        self.counts[reason] += 1
        now = self._clock()
        if now < self._next.get(reason, now):
            self._silent[reason] += 1
            return
        self._next[reason] = now + 1.0
        more = self._silent.pop(reason, 0)
        self._say(f"{reason}: {topic}: {detail}" + (f" ({more} more of these)" if more else ""))


class Intake:
    """An iterable of items for a pipeline, from an inbox; ends when the inbox is closed and empty.

    Args:
        inbox: where messages wait.
        window_us: of the encoder; a silent camera's time goes on until its window is empty.
        warnings: told what is refused and what is strange.
        silence_s: how long a camera must be silent before its time goes on without it.
        mark_s: how often to put a mark into the stream, if anything came meanwhile.
        joins_late: packets before the first that is heard are missing from its window.
    """

    def __init__(
        self,
        inbox: Inbox,
        window_us: int,
        warnings: Warnings,
        *,
        silence_s: float = SILENCE_S,
        mark_s: float = math.inf,
        joins_late: bool = False,
    ) -> None:
        """Nothing is taken before iteration."""
        self._inbox = inbox
        self._window_us = window_us
        self._warnings = warnings
        self._silence_s = silence_s
        self.topics: dict[str, TopicState] = {}
        self._past = DeliveryStats()
        self._early: dict[str, Label] = {}
        self._leaving: dict[str, float] = {}
        self._awaited: dict[str, float] = {}
        self._mark_s, self._joins_late = mark_s, joins_late

    def snapshot(self) -> dict[str, dict[str, Any]]:
        """What is known of each topic, as JSON values."""
        now_ns = time.monotonic_ns()
        return {topic: state.snapshot(now_ns) for topic, state in self.topics.items()}

    def restore(self, topic: str, values: Fields, passed_ns: int) -> None:
        """Go on with a topic from a snapshot, before anything is taken.

        Its time stands still until it is heard; if that does not happen soon, it is gone.

        Args:
            topic: which.
            values: what `snapshot` gave for it.
            passed_ns: since then.

        Raises:
            InputError: the values are not a snapshot.
        """
        now_ns = time.monotonic_ns()
        state = TopicState(PacketReader(topic, MAX_LIVE_PACKET_EVENTS), CameraClock(self._window_us))
        state.restore(values, now_ns - passed_ns)
        state.heard_ns = now_ns
        self.topics[topic] = state
        self._awaited[topic] = 0.0

    def __iter__(self) -> Iterator[Packet | Label | Watermark | CameraLeft | Barrier | None]:
        """Yield items as they come; None when nothing more is there at the moment."""
        looked = marked = time.monotonic()
        is_new, refused = False, 0
        while (taken := self._inbox.take(_POLL_S if self.topics else _IDLE_S)) is not None:
            for message in taken:
                yield from self._items(message)
            if self._inbox.refused > refused:
                more, refused = self._inbox.refused - refused, self._inbox.refused
                self._warnings.add(
                    "announcements refused", "the network", f"{more} more than can be followed"
                )
            now = time.monotonic()
            is_new |= bool(taken)
            if is_new and now >= marked + self._mark_s:
                yield Barrier(self.snapshot())
                is_new, marked = False, now
            # Time during which this process was stopped says nothing about a camera's silence.
            passed_s = min(now - looked, 2 * _POLL_S)
            yield from self._silences(passed_s)
            # Nor does that of those who leave begin before all that had arrived was looked at.
            looked = now
            if not self._inbox.depth:
                yield from self._releases(passed_s)
                yield None

    def delivery(self) -> DeliveryStats:
        """Totals of all topics, past and present; may be called from another thread."""
        total = DeliveryStats()
        for part in (self._past, *(state.delivery.stats for state in list(self.topics.values()))):
            total += part
        return total

    def _announced(self, topic: str, *, here: bool) -> None:
        """Publishers come or leave. Who comes next is heard at once; who left may have packets under way."""
        self._leaving.pop(topic, None)
        self._awaited.pop(topic, None)
        if not here:
            self._leaving[topic] = 0.0
            if len(self._leaving) > MAX_TOPICS:
                del self._leaving[next(iter(self._leaving))]
        if topic in self.topics:
            self.topics[topic].delivery.announced(here=here)

    def _release(self, topic: str, state: TopicState) -> CameraLeft:
        """Nobody publishes here any more: what comes next is another life of this camera."""
        state.reader = PacketReader(topic, MAX_LIVE_PACKET_EVENTS)
        state.clock = CameraClock(self._window_us)
        state.stream_us, state.heard_ns, state.label_end_us = None, 0, 0
        return CameraLeft(topic)

    def _releases(self, passed_s: float) -> Iterator[CameraLeft]:
        for topic, awaited_s in list(self._awaited.items()):
            self._awaited[topic] = awaited_s + passed_s
            if awaited_s > _RESTORED_S:
                del self._awaited[topic]
                yield self._release(topic, self.topics[topic])
        for topic, silent_s in list(self._leaving.items()):
            self._leaving[topic] = silent_s + passed_s
            if silent_s > GRACE_S:
                del self._leaving[topic]
                if topic in self.topics:
                    yield self._release(topic, self.topics[topic])

    def _items(self, message: RawMessage | Announcement) -> Iterator[Packet | Label | Watermark | CameraLeft]:
        if isinstance(message, Announcement):
            self._announced(message.topic, here=message.here)
            return
        try:
            if message.schema == LabelMessage.SCHEMA_NAME:
                yield from self._label(message)
            elif message.schema in EVENT_SCHEMAS:
                yield from self._packet(message)
            else:
                raise _RefusalError("unknown type", message.schema[:80] or "not CDR")
        except _RefusalError as refusal:
            self._warnings.add(refusal.reason, message.topic, str(refusal))

    def _label(self, message: RawMessage) -> Iterator[Label]:
        """Give a label to the camera beside it, now or when its first packet comes."""
        parent = message.topic.rpartition("/")[0]
        try:
            label = Label.from_cdr(message.payload)
        except InputError as error:
            raise _RefusalError("bad label", str(error)) from None
        if not 0 <= label.duration_us <= MAX_LABEL_US:
            raise _RefusalError("bad label", f"{label.label[:40]!r} lasts {label.duration_us} us")
        for topic in (parent, f"{parent}/events".lstrip("/"), f"{parent}/events"):
            state = self.topics.get(topic)
            if state and state.stream_us is not None:
                if abs(label.start_us - state.stream_us) > _MAX_SPAN_US:
                    raise _RefusalError("bad label", f"it starts at {label.start_us} us, far from the stream")
                yield self._accept(label, topic, state)
                return
        self._early[parent] = label
        while len(self._early) > MAX_TOPICS:
            del self._early[next(iter(self._early))]

    @staticmethod
    def _accept(label: Label, topic: str, state: TopicState) -> Label:
        state.label_end_us = label.start_us + label.duration_us
        return replace(label, topic=topic)

    def _packet(self, message: RawMessage) -> Iterator[Packet | Label | Watermark | CameraLeft]:
        if message.topic not in self.topics:
            yield from self._begin(message.topic)
        state = self.topics[message.topic]
        self._awaited.pop(message.topic, None)
        attachment = Attachment.unpack(message.attachment)
        numbered = attachment or self._number_in(message)
        unheard = state.delivery.stats.unheard
        verdict = state.delivery.see(numbered.gid, numbered.seq, message.arrived_ns, message.dropped)
        if verdict.broken:
            state.reader.resync()
        if verdict.restarted:
            self._warnings.add("publisher restarted", message.topic, f"now {numbered.gid.hex() or 'unnamed'}")
            if verdict.anew:
                yield self._release(message.topic, state)
        state.lost += verdict.lost
        if self._joins_late:
            state.lost += state.delivery.stats.unheard - unheard
        if verdict.foreign:
            self._warnings.add("second publisher", message.topic, numbered.gid.hex() or "unnamed")
        if not verdict.use:
            return
        if message.topic in self._leaving:
            self._leaving[message.topic] = 0.0
        if verdict.lost:
            self._warnings.add(
                "packets missing", message.topic, f"{verdict.lost} before number {numbered.seq}"
            )
        try:
            packet = self._placed(state, message, numbered)
        except _RefusalError:
            state.lost += 1
            raise
        parent = message.topic.removesuffix("/events")
        early = self._early.pop(parent if parent != "events" else "", None)
        if early and state.stream_us is not None and abs(early.start_us - state.stream_us) <= _MAX_SPAN_US:
            yield self._accept(early, message.topic, state)
        yield replace(packet, lost=state.lost)
        state.lost = 0
        if len(packet.events) == 0 and state.stream_us is not None:
            yield Watermark(message.topic, state.stream_us)

    def _placed(self, state: TopicState, message: RawMessage, numbered: Attachment) -> Packet:
        """Decode a packet and bring its times onto the stream's."""
        if message.problem:
            raise _RefusalError(message.problem, f"at most {MAX_PAYLOAD_BYTES} bytes are read")
        try:
            packet = state.reader.read(message.schema, message.payload, message.log_time_ns, numbered.seq)
        except InputError as error:
            raise _RefusalError("bad packet", str(error)) from None
        height, width = packet.resolution
        if height * width > MAX_PIXELS:
            raise _RefusalError("sensor too large", f"{width}x{height} pixels, at most {MAX_PIXELS}")
        if state.resolution not in (None, packet.resolution):
            self._warnings.add("resolution changed", message.topic, f"now {width}x{height}")
        events = packet.events
        # Events outside the sensor are rejected later; their times have no say.
        sound = events["t"][(events["x"] < width) & (events["y"] < height)]
        first = last = state.reader.time_us
        if len(sound):
            first, last = int(sound.min()), int(sound.max())
        if first is not None and last is not None:
            if last - first > _MAX_SPAN_US:
                raise _RefusalError(
                    "bad times", f"events of one packet are {(last - first) // 1_000_000} s apart"
                )
            if first < 0 or last > MAX_STREAM_US:
                raise _RefusalError("bad times", f"an event at {first if first < 0 else last} us")
            place = state.clock.place(first, last, message.arrived_ns)
            if place.event:
                self._warnings.add(f"clock {place.event}", message.topic, f"{first} us")
            if place.offset_us:
                events = events.copy()
                events["t"] += np.int64(place.offset_us)
            if place.event in ("restarted", "jumped"):
                state.stream_us = None
            state.stream_us = max(state.stream_us or 0, last + place.offset_us)
            packet = replace(packet, events=events, epoch=place.epoch)
        state.resolution = packet.resolution
        state.packets += 1
        state.payload_bytes += len(message.payload)
        state.heard_ns, state.silent_s = message.arrived_ns, 0.0
        return replace(packet, source_ns=numbered.source_ns)

    @staticmethod
    def _number_in(message: RawMessage) -> Attachment:
        """What a packet says of itself, for publishers that attach nothing."""
        if message.schema == EventPacket.SCHEMA_NAME and not message.problem:
            try:
                packet = EventPacket.from_cdr(message.payload)
            except InputError as error:
                raise _RefusalError("bad packet", str(error)) from None
            return Attachment(min(packet.seq, (1 << 63) - 1), packet.stamp_ns, b"")
        reason = message.problem or "no sequence number"
        raise _RefusalError(reason, f"{len(message.attachment)} bytes of attachment")

    def _begin(self, topic: str) -> Iterator[CameraLeft]:
        """Follow one topic more; the one that has been silent for longest makes room for it."""
        if len(self.topics) >= MAX_TOPICS:
            oldest = min(self.topics, key=lambda name: self.topics[name].heard_ns)
            if time.monotonic_ns() - self.topics[oldest].heard_ns < _FORGOTTEN_NS:
                raise _RefusalError("too many topics", f"{MAX_TOPICS} are followed already")
            self._past = self._past + self.topics.pop(oldest).delivery.stats
            self._awaited.pop(oldest, None)
            yield CameraLeft(oldest)
        reader = PacketReader(topic, MAX_LIVE_PACKET_EVENTS)
        state = self.topics[topic] = TopicState(reader, CameraClock(self._window_us))
        if topic in self._leaving:
            state.delivery.announced(here=False)

    def _silences(self, passed_s: float) -> Iterator[Watermark]:
        for topic, state in self.topics.items():
            if state.stream_us is None or topic in self._awaited:
                continue
            state.silent_s += passed_s
            now_us = state.stream_us + int((state.silent_s - self._silence_s) * 1e6)
            end_us = max(state.stream_us + 2 * self._window_us, state.label_end_us + 1)
            if state.stream_us < now_us and now_us - int(passed_s * 1e6) <= end_us:
                yield Watermark(topic, now_us)


class _RefusalError(Exception):
    """A message that cannot be used."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason
