"""Reading recordings: batches, packets, labels and labelled samples.

Lives here: `open_recording` and what it gives; choosing the topic, decoding, counting.
Not here: formats (`sources`), messages (`streamfeat.messages`), writing (`writer`).

A recording is read in file order with one packet in memory at a time. What cannot be read is skipped and
counted in `Recording.losses`; only a recording that yields nothing at all is an error.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from types import TracebackType
from typing import Self

from streamfeat.denoise.stage import Denoiser
from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution
from streamfeat.files.locations import Location, absolute, location_of
from streamfeat.messages.cdr import LabelMessage
from streamfeat.messages.packets import Label, Packet
from streamfeat.messages.timeline import Timeline
from streamfeat.recordings.bags import assumptions_of
from streamfeat.recordings.event_topics import choose_topic
from streamfeat.recordings.label_topic import labels_for
from streamfeat.recordings.labels import with_labels
from streamfeat.recordings.opening import RecordingPath, open_source
from streamfeat.recordings.options import AS_IT_IS, ReadOptions
from streamfeat.recordings.records import Losses
from streamfeat.recordings.samples import Sample, complete_samples
from streamfeat.recordings.sources import (
    WHOLE,
    Part,
    SourceItem,
    StoredMessage,
    Topic,
    labels_in,
    unpacked_message,
)
from streamfeat.recordings.totals import Totals
from streamfeat.report.shown import Shown

__all__ = [
    "HELD_OUT_SPLITS",
    "WHOLE",
    "Label",
    "Losses",
    "Packet",
    "Part",
    "Recording",
    "Sample",
    "Topic",
    "open_recording",
]

_LOOP_GAP_US = 1_000_000

_PART_BYTES = 1 << 20
_MOST_PARTS = 1000

HELD_OUT_SPLITS = frozenset({"validation", "valid", "val", "test"})
"""Splits that nothing is learned from."""


def open_recording(
    path: RecordingPath, topic: str | None = None, options: ReadOptions = AS_IT_IS
) -> "Recording":
    """Open a recording of events: MCAP, a bag of ROS 1 or 2, a camera file, or several of one kind.

    Args:
        path: a file; a rosbag2 folder; a pattern or a list, whose files are one recording. Text that is a
            URL means a file in a store, see `streamfeat.files.locations`.
        topic: the event topic to read; may be left out when there is only one.
        options: what the recording does not say, labels for it, noise to be taken out.

    Raises:
        InputError: the file is missing, empty or of no known format; it has no event topic, several and none
            was chosen, or not the chosen one; or not a single packet of the topic can be read. Reading raises
            it, too, where a store refuses or goes away.
    """
    return Recording(path, topic, options=options)


class Recording(Shown):
    """A recording of events, read in file order; iterate as often as you like.

    `resolution` and `encoding` are those of the first packet. `losses` tells what the latest pass
    (an iteration, or the first use of a count) could not read, `removed` what of it was taken out as noise.
    `assumptions` are lines that say what the files leave open and how it was decided.
    """

    path: Location
    topics: list[Topic]
    topic: str
    resolution: Resolution
    encoding: str
    losses: Losses
    assumptions: list[str]

    def __init__(
        self,
        path: RecordingPath,
        topic: str | None = None,
        part: Part = WHOLE,
        options: ReadOptions = AS_IT_IS,
    ) -> None:
        """See `open_recording`."""
        self._source = open_source(path, topic, options)
        self._given, self._part, self._options = path, part, options
        self.assumptions = assumptions_of(self._source)
        try:
            self.path, self.topics = self._source.path, self._source.topics
            self.topic = choose_topic(self._source, topic)
            self._labels = labels_for(self._source, options.labels, self.topic)
            if self._labels and self._labels.assumption:
                self.assumptions.append(self._labels.assumption)
            about_tables = (options.columns, options.time_unit, options.resolution)
            if any(about_tables) and not any(topic.is_events for topic in self.topics):
                self.assumptions.append(
                    f"{self.path}: its messages say columns, unit and resolution; "
                    "the options for them change nothing"
                )
            self.encoding = ""
            self._timeline = Timeline(self.topic)
            self.resolution = self._first_packet().resolution
            self.losses = Losses()
        except BaseException:
            self._source.close()
            raise

    def __enter__(self) -> Self:
        """Give the recording itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close what it is read from; iterating after that is an error."""
        self._source.close()

    def __iter__(self) -> Iterator[Events]:
        """Yield batches of events in stored order: `(n,)` arrays of `EVENT_DTYPE`, n > 0."""
        for item in self.items():
            if isinstance(item, Packet) and len(item.events):
                yield item.events

    @property
    def is_labelled(self) -> bool:
        """Whether there may be labels."""
        return self._labels is not None or any(topic.holds == "labels" for topic in self.topics)

    @property
    def removed(self) -> dict[str, int]:
        """Events that the latest pass took out as noise, by reason."""
        return {name: self.losses.removed[name] for name in self._options.denoising.names}

    def parts(self) -> list[Part]:
        """Parts of some megabytes, in stored order, by which pieces of work are cut; see `part`.

        They depend on the file alone. There is but one where the file does not tell where its chunks are,
        where packets cannot be read without those before them (evt3), where labels are put into the stream,
        and where noise is taken out of a stream without labels, at which that would start anew.
        """
        is_whole = self.encoding == "evt3" or self._labels is not None
        is_whole |= bool(self._options.denoising) and not self.is_labelled
        starts = self._source.cuts() if not is_whole else []
        cuts = [0]
        for start in starts:
            if start >= cuts[-1] + max(_PART_BYTES, starts[-1] // _MOST_PARTS):
                cuts.append(start)
        return [Part(*ends) for ends in zip(cuts, [*cuts[1:], math.inf], strict=True)]

    def part(self, part: Part) -> Callable[[], "Recording"]:
        """A function that opens a part of this recording; it can be pickled and called on any machine."""
        return partial(Recording, _wherever(self._given), self.topic, part, self._options)

    def items(self) -> Iterator[Packet | Label]:
        """Yield packets and labels in stored order; a label comes before its first packet."""
        is_labelled = self.is_labelled
        has_begun = self._part.start == 0 or not is_labelled
        for at, item in self.placed_items(self._part):
            is_cut = isinstance(item, Label) or not is_labelled
            if at >= self._part.end and is_cut:
                return
            has_begun = has_begun or is_cut
            if has_begun:
                yield item

    def placed_items(self, part: Part) -> Iterator[tuple[int, Packet | Label]]:
        """Yield packets and labels in stored order, each with the byte of its chunk, to the end of the file.

        Args:
            part: where to begin; what is lost behind it is not counted.
        """
        placed = self._stored_items(part)
        if self._labels:
            placed = with_labels(placed, self._labels)
        if self._options.denoising:
            placed = self._without_noise(placed, part)
        return placed

    def _without_noise(
        self, placed: Iterator[tuple[int, Packet | Label]], part: Part
    ) -> Iterator[tuple[int, Packet | Label]]:
        """Items of a part without their noise; what is taken out is counted in one part only."""
        denoiser = Denoiser(self._options.denoising)
        before, is_labelled = Counter[str](), self.is_labelled
        is_counted = part.start == 0 or not is_labelled
        for at, item in placed:
            if is_labelled and isinstance(item, Label):
                before = before if is_counted else Counter(denoiser.removed)
                is_counted = at < part.end
            kept = denoiser.process(item)
            if is_counted:
                self.losses.removed = Counter(denoiser.removed) - before
            yield at, kept

    def _stored_items(self, part: Part) -> Iterator[tuple[int, Packet | Label]]:
        """As `placed_items`, of what is in the files."""
        losses = self.losses = Losses()
        timeline = self._timeline = Timeline(self.topic)
        at = part.start
        for at, stored in self._source.read(self.topic, part, losses):
            if at >= part.end:
                losses = Losses()
            try:
                for item in self._placed(timeline, stored):
                    yield at, item
            except InputError as error:
                assert isinstance(stored, StoredMessage)
                where = f"topic {stored.topic!r}, message {stored.number} (byte {at}): {error}"
                kind = "bad label" if stored.schema == LabelMessage.SCHEMA_NAME else "bad packet"
                losses.add(kind, len(stored.data), where)
        for item in timeline.finish():
            yield at, item

    def _placed(self, timeline: Timeline, stored: SourceItem) -> Iterator[Packet | Label]:
        if isinstance(stored, Packet):
            yield from timeline.packet(stored)
        elif isinstance(stored, Label):
            yield from timeline.label(stored)
        elif stored.schema == LabelMessage.SCHEMA_NAME:
            yield from timeline.label(Label.from_cdr(unpacked_message(stored.data)))
        else:
            about = stored.log_time_ns, stored.sequence, stored.encoding
            for item in timeline.message(stored.schema, unpacked_message(stored.data), *about):
                self.encoding = self.encoding or timeline.encoding
                yield item

    @property
    def counts(self) -> Counter[str]:
        """Counts of packets and of their times in the latest pass, see `Timeline.counts`."""
        return self._timeline.counts

    def played(
        self, *, loop: bool, report: Callable[[int, int], None] = lambda done, total: None
    ) -> Iterator[Packet | Label]:
        """As `items`, and with `loop` again and again, a second after the end, with times that go on.

        Args:
            loop: go on for ever.
            report: told, with each item of the first time, how many there have been and how many there are;
                0 if that is unknown.
        """
        total = sum(
            t.n_messages
            for t in self.topics
            if t.holds == "labels" or (t.holds == "events" and t.name == self.topic)
        )
        # Where a clock starts anew the times of one round are several spans: the next begins behind them all.
        shift_us = epochs = 0
        while True:
            first_us = last_us = epoch = None
            for done, item in enumerate(self.items(), 1):
                if isinstance(item, Packet):
                    if len(item.events):
                        t = item.events["t"]
                        low, high = int(t.min()), int(t.max())
                        first_us = low if first_us is None else min(first_us, low)
                        last_us = high if last_us is None else max(last_us, high)
                    epoch = item.epoch
                if shift_us:
                    item = _shifted(item, shift_us, epochs)
                yield item
                if not shift_us:
                    report(done, 0 if loop else total)
            if not loop or first_us is None or last_us is None:
                return
            shift_us += last_us - first_us + _LOOP_GAP_US
            epochs += (epoch or 0) + bool(epoch)

    def samples(self) -> Iterator[Sample]:
        """Yield the labelled samples in stored order; those of a part to their end, wherever that is.

        When a sample is complete, and what memory that takes: see `complete_samples`.
        """
        return complete_samples(self.placed_items(self._part), self._part.end, self.resolution)

    @cached_property
    def _totals(self) -> Totals:
        totals = Totals()
        for item in self.items():
            if isinstance(item, Label):
                totals.labels.append(item)
            else:
                totals.add(item)
        return totals

    @property
    def labels(self) -> list[Label]:
        """All labels in stored order; the first use reads the whole file, as for the counts below."""
        return self._totals.labels

    def stored_labels(self) -> Iterator[Label]:
        """Yield the labels of this part, without its events; those that cannot be read are left out."""
        if self._labels is not None:
            yield from self.labels  # they are put into the stream by its times
        elif self.is_labelled:
            yield from labels_in(self._source, self.topic, self._part)

    @property
    def n_on(self) -> int:
        """Number of ON events."""
        return self._totals.n_on

    @property
    def n_off(self) -> int:
        """Number of OFF events."""
        return self._totals.n_off

    @property
    def n_events(self) -> int:
        """Number of events."""
        return self.n_on + self.n_off

    @property
    def n_outside(self) -> int:
        """Number of events outside the resolution of their packet, which an engine rejects."""
        return self._totals.n_outside

    @property
    def resolutions(self) -> dict[Resolution, int]:
        """How many packets have each resolution, `(height, width)`, in order of appearance; 64 at most."""
        return self._totals.resolutions

    @property
    def digest(self) -> str:
        """SHA-256, hexadecimal, of all events that are used, in their order: 13 bytes each, little-endian.

        These are x and y (uint16), p (uint8) and t (int64, microseconds). Where packets end has no say.
        """
        return self._totals.hash.hexdigest()

    @property
    def first_us(self) -> int | None:
        """Time of the earliest event, or None without events."""
        return self._totals.first_us

    @property
    def last_us(self) -> int | None:
        """Time of the latest event, or None without events."""
        return self._totals.last_us

    @property
    def duration_us(self) -> int:
        """Time from the earliest to the latest event; of each run of the camera's clock, in sum."""
        return self._totals.duration_us

    def _first_packet(self) -> Packet:
        for _, item in self._stored_items(WHOLE):
            if isinstance(item, Packet):
                return item
        reasons = list(self.losses.first.values()) or ["it has no messages"]
        if not self.losses and any(topic.is_events for topic in self.topics):
            raise InputError(f"{self.path}: holds no events")
        raise InputError(f"{self.path}: nothing can be read from topic {self.topic!r}: {reasons[0]}")


def _shifted(item: Packet | Label, shift_us: int, epochs: int) -> Packet | Label:
    if isinstance(item, Label):
        return replace(item, start_us=item.start_us + shift_us)
    events = item.events.copy()
    events["t"] += shift_us
    log_time_ns = item.log_time_ns + shift_us * 1000
    until_us = None if item.until_us is None else item.until_us + shift_us
    return replace(item, events=events, epoch=item.epoch + epochs, log_time_ns=log_time_ns, until_us=until_us)


def _wherever(path: RecordingPath) -> RecordingPath:
    """The same files, whatever the working directory."""
    if isinstance(path, str) or not isinstance(path, Sequence):
        return absolute(location_of(path))
    return [absolute(location_of(one)) for one in path]
