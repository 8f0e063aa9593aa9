"""From messages as they came to items of the stream: checked, counted, and in silence given time.

Lives here: which messages are refused and why, warnings, cameras that appear and leave, and time that passes
in silence.
Not here: the network (`network`), numbers and times of packets, for which recordings have the same rule
(`messages.timeline`), what is done with events (`cameras`).

Whatever arrives is hostile until proven otherwise. A payload may have 4 MiB and 2^20 events, a sensor 2^22
pixels, and no more than 256 topics are followed at a time, so that memory is bounded by those numbers and by
the inbox. What is refused is counted under its reason, with one line a second and reason at most.
"""

import math
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from streamfeat.errors import InputError
from streamfeat.files.json_fields import Fields
from streamfeat.live.inbox import Announcement, Inbox, RawMessage
from streamfeat.live.names import Attachment, beside
from streamfeat.live.refusals import RefusalError, checked_label, parsed
from streamfeat.live.topic import MAX_LIVE_PACKET_EVENTS, MAX_TOPICS, Barrier, TopicState
from streamfeat.live.warnings import Warnings
from streamfeat.messages.cdr import LabelMessage
from streamfeat.messages.delivery import DeliveryStats, Verdict
from streamfeat.messages.event_messages import EVENT_SCHEMAS
from streamfeat.messages.packets import Label, Packet, Watermark
from streamfeat.messages.timeline import HOLD_NS, Timeline
from streamfeat.stream.cameras import MAX_CAMERAS, CameraLeft

__all__ = ["Intake"]

_MAX_SPAN_US = 60_000_000
"""A label further than this from its stream is refused."""
_AHEAD_US = 5_000_000
"""Of a label further ahead than this there is a warning: events before it are late. Samples of a data set are
a second apart, and each label comes before its sample."""
_POLL_S = 0.02
_IDLE_S = 0.25
_FORGOTTEN_NS = 60_000_000_000
"""A camera that has been silent for so long gives its place to a new one, where there is no other."""
SILENCE_S = 0.2
"""A camera that has been silent for so long is taken to have nothing to say, and its time goes on."""
GRACE_S = 0.5
"""A camera whose publishers have left is released when nothing has come for so long: word of their leaving
may overtake their last packets."""
_RESTORED_S = 10.0
"""A camera of a snapshot is waited for so long: links come up again within a few seconds."""
_EVENTS_OF_TIME = {
    "restarts": "clock restarted",
    "jumps": "clock jumped",
    "wraps": "clock wrapped",
    "stray packets": "stray packet",
    "stray events": "stray events",
}
"""Reasons of warnings, by what a timeline calls them."""

Item = Packet | Label | Watermark | CameraLeft


class Intake:
    """An iterable of items for a pipeline, from an inbox; ends when the inbox is closed and empty.

    Args:
        inbox: where messages wait.
        window_us: of the encoder; a silent camera's time goes on until its window is empty.
        warnings: told what is refused and what is strange.
        silence_s: how long a camera must be silent before its time goes on without it.
        mark_s: how often to put a barrier into the stream, if anything came meanwhile.
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
        self._outputs: dict[str, str] = {}
        self._past, self._past_counts = DeliveryStats(), Counter[str]()
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

        Its time stands still until it is heard; if that does not happen soon, it is released.

        Args:
            topic: its name.
            values: what `snapshot` gave for it.
            passed_ns: since then.

        Raises:
            InputError: the values are not those of a topic.
        """
        now_ns = time.monotonic_ns()
        state = self._follow(topic)
        state.restore(values, now_ns - passed_ns)
        state.heard_ns = now_ns
        self._awaited[topic] = 0.0

    def __iter__(self) -> Iterator[Item | Barrier | None]:
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
        for topic, state in self.topics.items():
            yield from self._handed_on(topic, state, state.timeline.finish())

    def delivery(self) -> DeliveryStats:
        """Totals of all topics, past and present; may be called from another thread."""
        total = DeliveryStats()
        for part in (self._past, *(state.timeline.delivery.stats for state in list(self.topics.values()))):
            total += part
        return total

    def counts(self) -> Counter[str]:
        """What happened to packets and their times, of all topics, see `messages.timeline.Timeline.counts`.

        May be called from another thread.
        """
        return sum((state.timeline.counts for state in list(self.topics.values())), self._past_counts)

    def _announced(self, topic: str, *, here: bool) -> None:
        """Publishers come or leave. The next one is heard at once; the last may have packets under way."""
        self._leaving.pop(topic, None)
        self._awaited.pop(topic, None)
        if not here:
            self._leaving[topic] = 0.0
            if len(self._leaving) > MAX_TOPICS:
                del self._leaving[next(iter(self._leaving))]
        if topic in self.topics:
            self.topics[topic].timeline.delivery.announced(here=here)

    def _release(self, topic: str) -> Iterator[Item]:
        """Nobody publishes here any more: what comes next is another life of this camera."""
        state = self.topics[topic]
        yield from self._handed_on(topic, state, state.timeline.finish())
        state.timeline.begin()
        state.heard_ns, state.label_end_us, state.is_served = 0, 0, False
        yield CameraLeft(topic)

    def _releases(self, passed_s: float) -> Iterator[Item]:
        for topic, awaited_s in list(self._awaited.items()):
            self._awaited[topic] = awaited_s + passed_s
            if awaited_s > _RESTORED_S:
                del self._awaited[topic]
                yield from self._release(topic)
        for topic, silent_s in list(self._leaving.items()):
            self._leaving[topic] = silent_s + passed_s
            if silent_s > GRACE_S:
                del self._leaving[topic]
                if topic in self.topics:
                    yield from self._release(topic)

    def _items(self, message: RawMessage | Announcement) -> Iterator[Item]:
        if isinstance(message, Announcement):
            self._announced(message.topic, here=message.here)
            return
        try:
            if message.schema in EVENT_SCHEMAS:
                yield from self._packet(message)
            elif message.schema == LabelMessage.SCHEMA_NAME:
                yield from self._label(message)
            else:
                raise RefusalError("unknown type", message.schema[:80] or "not CDR")
        except RefusalError as refusal:
            self._warnings.add(refusal.reason, message.topic, str(refusal))

    def _label(self, message: RawMessage) -> Iterator[Item]:
        """Give a label to the camera beside it, now or when its first packet comes."""
        parent = message.topic.rpartition("/")[0]
        label = checked_label(message)
        for topic in (parent, f"{parent}/events".lstrip("/"), f"{parent}/events"):
            state = self.topics.get(topic)
            if state and state.timeline.reached_us is not None:
                ahead_us = label.start_us - state.timeline.reached_us
                if abs(ahead_us) > _MAX_SPAN_US:
                    raise RefusalError("bad label", f"it starts at {label.start_us} us, far from the stream")
                if ahead_us > _AHEAD_US:
                    seconds = ahead_us / 1e6
                    self._warnings.add("label ahead", topic, f"by {seconds:.1f} s; events before it are late")
                yield from self._handed_on(topic, state, state.timeline.label(replace(label, topic=topic)))
                return
        self._early[parent] = label
        while len(self._early) > MAX_TOPICS:
            del self._early[next(iter(self._early))]

    def _packet(self, message: RawMessage) -> Iterator[Item]:
        """Parse, number, decode and place one message of events."""
        topic = message.topic
        content, refusal = parsed(message)
        state = self.topics.get(topic)
        if state is None:
            if content is None:
                raise refusal
            yield from self._make_room(topic)
            state = self._follow(topic)
        if self._awaited:
            self._awaited.pop(topic, None)
        timeline, attachment = state.timeline, Attachment.unpack(message.attachment)
        number = (attachment.gid, attachment.seq) if attachment else None
        if content is None and number is None:
            timeline.miss()
            raise refusal
        seen = timeline.see(content, message.arrived_ns, number=number, dropped=message.dropped)
        if seen.restarted or seen.foreign or seen.lost:
            self._tell_of(seen, topic, number)
            if seen.anew:
                yield from self._release(topic)
        if not seen.use:
            return
        if topic in self._leaving:
            self._leaving[topic] = 0.0
        if content is None:
            timeline.miss()
            raise refusal
        if attachment:
            seq, source_ns = attachment.seq, attachment.source_ns
        else:
            seq, source_ns = 0, content.stamp_ns
        arrived_ns = message.arrived_ns
        about = message.schema, content, seen, message.log_time_ns, seq
        try:
            items = timeline.take(*about, now_ns=arrived_ns, source_ns=source_ns)
        except InputError as error:
            raise RefusalError("bad packet", str(error)) from None
        state.heard_ns, state.silent_s = arrived_ns, 0.0
        yield from self._handed_on(topic, state, items)

    def _handed_on(self, topic: str, state: TopicState, items: Iterable[Packet | Label]) -> Iterator[Item]:
        """Items of a topic as they leave its timeline."""
        for item in items:
            if isinstance(item, Label):
                state.label_end_us = item.start_us + item.duration_us
            else:
                if item.resolution != state.resolution:
                    if state.resolution:
                        height, width = item.resolution
                        self._warnings.add("resolution changed", topic, f"now {width}x{height}")
                    state.resolution = item.resolution
                if not state.is_served:
                    yield from self._give_place(topic)
                    state.is_served = True
                if self._early:
                    yield from self._early_label(topic, state)
            yield item

    def _early_label(self, topic: str, state: TopicState) -> Iterator[Label]:
        """The label that came before the first packet of its camera."""
        reached_us = state.timeline.reached_us
        if reached_us is None:
            return
        parent = topic.removesuffix("/events")
        label = self._early.pop(parent if parent != "events" else "", None)
        if label and abs(label.start_us - reached_us) <= _MAX_SPAN_US:
            state.label_end_us = label.start_us + label.duration_us
            yield replace(label, topic=topic)

    def _tell_of(self, seen: Verdict, topic: str, number: tuple[bytes, int] | None) -> None:
        """Warn of what numbers show."""
        publisher = (number[0].hex() if number else "") or "unnamed"
        if seen.restarted:
            self._warnings.add("publisher restarted", topic, f"now {publisher}")
        if seen.foreign:
            self._warnings.add("second publisher", topic, publisher)
        if seen.use and seen.lost:
            before = f" before number {number[1]}" if number else ""
            self._warnings.add("packets missing", topic, f"{seen.lost}{before}")

    def _follow(self, topic: str) -> TopicState:
        """Follow one topic more."""
        timeline = Timeline(
            topic,
            max_events=MAX_LIVE_PACKET_EVENTS,
            joins_late=self._joins_late,
            tell=lambda what, detail: self._warnings.add(_EVENTS_OF_TIME[what], topic, detail),
        )
        state = self.topics[topic] = TopicState(timeline)
        self._outputs[beside(topic, "")] = topic
        if topic in self._leaving:
            timeline.delivery.announced(here=False)
        return state

    def _make_room(self, topic: str) -> Iterator[Item]:
        """See that one topic more can be followed; one that has been silent for long makes room for it."""
        other = self._outputs.get(beside(topic, ""))
        if other is not None:
            raise RefusalError("one name for two outputs", f"{beside(topic, 'features')} is that of {other}")
        if len(self.topics) >= MAX_TOPICS:
            oldest = self._longest_silent(list(self.topics))
            if oldest is None:
                raise RefusalError("too many topics", f"{MAX_TOPICS} are followed already")
            yield from self._release(oldest)
            timeline = self.topics.pop(oldest).timeline
            del self._outputs[beside(oldest, "")]
            self._past = self._past + timeline.delivery.stats
            self._past_counts = self._past_counts + timeline.counts
            self._awaited.pop(oldest, None)

    def _give_place(self, topic: str) -> Iterator[Item]:
        """If all places for cameras are taken, release the camera that has been silent for longest."""
        served = [one for one, state in self.topics.items() if state.is_served and one != topic]
        if len(served) >= MAX_CAMERAS and (oldest := self._longest_silent(served)) is not None:
            yield from self._release(oldest)

    def _longest_silent(self, topics: Sequence[str]) -> str | None:
        """The topic that has been silent for longest, if that is long enough to forget it."""
        oldest = min(topics, key=lambda name: self.topics[name].heard_ns)
        silent_ns = time.monotonic_ns() - self.topics[oldest].heard_ns
        return oldest if silent_ns >= _FORGOTTEN_NS else None

    def _silences(self, passed_s: float) -> Iterator[Item]:
        """Let the time of silent cameras go on, and use what was held for the packet that does not come."""
        for topic, state in self.topics.items():
            state.silent_s += passed_s
            timeline = state.timeline
            if timeline.is_holding:
                if state.silent_s * 1e9 > HOLD_NS:
                    yield from self._handed_on(topic, state, timeline.finish())
                continue
            reached_us = timeline.reached_us
            if reached_us is None or topic in self._awaited:
                continue
            now_us = reached_us + int((state.silent_s - self._silence_s) * 1e6)
            end_us = max(reached_us + 2 * self._window_us, state.label_end_us + 1)
            if reached_us < now_us and now_us - int(passed_s * 1e6) <= end_us:
                yield Watermark(topic, now_us)
