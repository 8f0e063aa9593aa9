"""A camera file as the source of a recording.

Lives here: its events as packets, what had to be assumed, and what could not be read, as a loss.
Not here: the formats (`streamfeat.camera_files`).
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack

import numpy as np
from numpy.typing import NDArray

from streamfeat.camera_files.event_files import EventFile, open_events
from streamfeat.camera_files.source import TableOptions
from streamfeat.errors import InputError
from streamfeat.events import Events
from streamfeat.files.locations import Location, fetched
from streamfeat.messages.cdr import LabelMessage
from streamfeat.messages.packets import MAX_PIXELS, Label, Packet
from streamfeat.messages.strays import BACK_US, FEW, stray_events
from streamfeat.recordings.options import ReadOptions
from streamfeat.recordings.records import Losses
from streamfeat.recordings.sources import Part, Topic

__all__ = ["CameraSource"]

_TOPIC = "/events"
_LABEL_NAMES = ("label", "labels", "class", "target", "y", "gesture", "category")
_PACKET_EVENTS = 8192
_PACKET_US = 1_000_000


class CameraSource:
    """See `Source`; it is read as a whole, in packets of a length that cameras send.

    Its log time is that of its events.

    Args:
        path: the file; one in a store is copied for as long as this is open.
        topic: name of one event stream, where there are several.
        options: what the file does not say.

    Raises:
        InputError: it is of no known format, or cannot be read; or has several streams and none is chosen.
    """

    topics: list[Topic]

    def __init__(self, path: Location, topic: str | None, options: ReadOptions) -> None:
        """Open it, and find out what is there."""
        self.path = path
        stream = None if topic == _TOPIC else topic
        tables = TableOptions(options.columns, options.time_unit, options.resolution, stream)
        with ExitStack() as copies:
            local = copies.enter_context(fetched(path))
            self._local, self._copies = local, ExitStack()
            try:
                self._file: EventFile = open_events(local, options=tables)
                self.resolution = self._file.resolution
                self.assumptions = [self._named(f"{local}: {line}") for line in self._file.assumptions]
            except InputError as error:
                raise InputError(self._named(str(error))) from None
            self._copies = copies.pop_all()
        height, width = self.resolution
        if height * width > MAX_PIXELS:
            self.close()
            raise InputError(
                f"{path}: a sensor of {width}x{height} pixels; at most {MAX_PIXELS} are read; if single "
                "events lie far outside the sensor, --resolution WxH sets its size"
            )
        streams = self._file.streams
        self._topic = stream or (streams[0] if len(streams) == 1 else _TOPIC)
        self.topics = [Topic(self._topic, self._file.format, "", 0, is_events=True)]
        self._label = _label_in(self._file.labels)
        if self._label:
            self.topics.append(Topic("/label", LabelMessage.SCHEMA_NAME, "", 1))

    def read(self, topic: str, part: Part, losses: Losses) -> Iterator[tuple[int, Packet | Label]]:
        """See `Source`; the byte of every item is 0."""
        seq = 0
        try:
            if self._label:
                yield from self._labelled()
            for block in self._file.blocks():
                for first_us, events in _cut(block):
                    yield 0, Packet(self._topic, events, self.resolution, first_us * 1000, seq)
                    seq += 1
        except InputError as error:
            if seq == 0:
                raise InputError(self._named(str(error))) from None
            losses.add("damaged file", 0, self._named(str(error)))
        for line in self._file.damage:
            losses.add("damaged file", self._file.lost_bytes, self._named(f"{self._local}: {line}"))

    def _labelled(self) -> Iterator[tuple[int, Label]]:
        """The label of a file that is one sample, from its earliest to its latest event."""
        spans = [(block["t"].min(), block["t"].max()) for block in self._file.blocks() if len(block)]
        if spans:
            first, last = int(min(low for low, _ in spans)), int(max(high for _, high in spans))
            yield 0, Label(first, last - first + 1, self._label, source=self.path.name)

    def cuts(self) -> list[int]:
        """See `Source`."""
        return []

    def close(self) -> None:
        """See `Source`."""
        self._copies.close()

    def _named(self, text: str) -> str:
        """A message with the name of the file that its user knows."""
        return text.replace(str(self._local), str(self.path))


def _label_in(labels: Sequence[str]) -> str:
    """The label among those that a file holds (`name = value`): the one so called, or the only one."""
    found = dict(label.split(" = ", 1) for label in labels if " = " in label)
    named = [value for name, value in found.items() if name.lower() in _LABEL_NAMES]
    return named[0] if named else next(iter(found.values())) if len(found) == 1 else ""


def _cut(block: Events) -> Iterator[tuple[int, Events]]:
    """A block in packets of at most 8192 events, each with the time that it begins at, microseconds.

    The times of a packet lie within a second, and fall by less than half a second: what lies further is a gap
    or a clock that starts anew. Few events of absurd times stay in the packet around them, whose timeline
    leaves them out.
    """
    start, before_us = 0, None
    while start < len(block):
        packet = block[start : start + _PACKET_EVENTS]
        end, first_us, before_us = _one_packet(packet["t"], before_us)
        yield first_us, packet[:end]
        start += end


def _one_packet(t: NDArray[np.int64], before_us: int | None) -> tuple[int, int, int]:
    """How many of the first events belong together, and when they begin and end.

    Args:
        t: `(n,)` times, microseconds, n > 0.
        before_us: when the packet before them ended, None if there is none.
    """
    if np.ptp(t) < BACK_US:
        return len(t), int(t[0]), int(t.max())
    around = t if before_us is None else np.concatenate([[before_us], t])
    strays = stray_events(around, None)
    # Where what came before, or the first event of all, is apart from what follows, the clock has moved.
    kept = np.arange(len(t)) if strays[0] else np.flatnonzero(~strays[len(around) - len(t) :])
    end = _end(t, kept)
    if (end - np.searchsorted(kept, end)) * FEW > end:
        kept = np.arange(len(t))
        end = _end(t, kept)
    within = t[kept[kept < end]]
    return end, int(within[0]), int(within.max())


def _end(t: NDArray[np.int64], kept: NDArray[np.intp]) -> int:
    """Where the first packet ends. Strays behind it may begin what follows, and are left to it."""
    times = t[kept]
    fallen = times < np.maximum.accumulate(times) - BACK_US
    breaks = np.flatnonzero(fallen | (np.abs(times - times[0]) >= _PACKET_US))
    return int(kept[(breaks[0] if len(breaks) else len(kept)) - 1]) + 1
