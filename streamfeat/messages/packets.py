"""What a stream is made of: packets of events, labels, and time that passes in silence.

Lives here: `Packet`, `Label`, `Watermark`, and the way between packets and the messages that carry them.
Not here: where messages come from (`recording`, `live`), what bytes they have (`messages`, `codecs`).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution
from streamfeat.files.json_fields import Fields
from streamfeat.kernels.decode import time_span
from streamfeat.messages.cdr import EventArray, EventPacket, LabelMessage
from streamfeat.messages.codecs import (
    EVT3_WRAP_US,
    MAX_PACKET_EVENTS,
    PAYLOAD_ENCODINGS,
    Decoder,
    Evt3Decoder,
    encode,
    make_decoder,
)
from streamfeat.messages.event_messages import EVENT_SCHEMAS

__all__ = [
    "EVENT_SCHEMAS",
    "MAX_LABEL_TEXT",
    "MAX_LABEL_US",
    "MAX_PIXELS",
    "MAX_STREAM_US",
    "Content",
    "Item",
    "Label",
    "Packet",
    "PacketReader",
    "PacketWriter",
    "Watermark",
]

PACKET_EVENTS = 8192
PACKET_US = 1_000_000  # well inside the 4.29 s of a mono packet, and no packet holds a live reader up
_MOST_WRAPS = 86_400_000_000 // EVT3_WRAP_US  # in a day
_MAX_SIDE = 1 << 16  # pixels: coordinates are uint16
_LARGEST = 1 << 62  # of a number in a snapshot
MAX_PIXELS = 1 << 22
"""Of a sensor whose packets are used: the largest have 2^20, and an engine takes memory for each pixel."""
MAX_LABEL_US = 3_600_000_000
MAX_LABEL_TEXT = 4096
"""Characters of each text of a label, which each emission of its sample says again."""
"""The longest labelled sample of a live topic."""
MAX_STREAM_US = (1 << 31) * 1_000_000 - 2 * MAX_LABEL_US
"""The latest time of a message: times go into message stamps, which have 31 bits of seconds."""

Content = EventPacket | EventArray
"""A message of events, taken apart."""


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """One message of events.

    Attributes:
        topic: where it was published.
        events: `(n,)` EVENT_DTYPE; n may be 0.
        resolution: `(height, width)` of the sensor.
        log_time_ns: when it was recorded or received.
        seq: its number at the source.
        source_ns: when it was published, by the publisher's clock; 0 when nobody said.
        lost: packets known to be missing between the one before and this one.
        epoch: counts how often the camera's clock started anew; times of two epochs cannot be compared.
        until_us: of a packet without events, stream time that it has reached; None where it does not say.
    """

    topic: str
    events: Events
    resolution: Resolution
    log_time_ns: int
    seq: int
    source_ns: int = 0
    lost: int = 0
    epoch: int = 0
    until_us: int | None = None


@dataclass(frozen=True, slots=True)
class Watermark:
    """Stream time of a silent `topic`: nothing older than `t_us` is expected any more."""

    topic: str
    t_us: int


@dataclass(frozen=True, slots=True)
class Label:
    """A labelled sample: the events in `[start_us, start_us + duration_us)`, of `topic` if it names one."""

    start_us: int
    duration_us: int
    label: str
    split: str = ""
    source: str = ""
    topic: str = ""

    @classmethod
    def from_cdr(cls, data: bytes | memoryview, topic: str = "") -> Self:
        """Read a `streamfeat_msgs/msg/Label`.

        Raises:
            InputError: the bytes are no such message, its times cannot be those of a message, or a text has
                more than `MAX_LABEL_TEXT` characters.
        """
        m = LabelMessage.from_cdr(data)
        start_us, duration_us = m.stamp_ns // 1000, m.duration_ns // 1000
        if start_us < 0 or start_us + duration_us > MAX_STREAM_US:
            raise InputError(
                f"label {m.label[:40]!r} from {start_us} us on, {duration_us} us long: times lie between "
                f"0 and {MAX_STREAM_US} us"
            )
        longest = max(len(text) for text in (m.label, m.split, m.source))
        if longest > MAX_LABEL_TEXT:
            raise InputError(f"a label with a text of {longest} characters; at most {MAX_LABEL_TEXT}")
        return cls(start_us, duration_us, m.label, m.split, m.source, topic)


Item = Packet | Label
"""What comes out of a timeline."""


class PacketReader:
    """Decodes the event messages of one topic; keeps what decoders carry from one message to the next.

    Args:
        max_events: packets of more events are refused.

    Attributes:
        encoding: of the latest message.
        resolution: `(height, width)` of the latest message that could be decoded; None before it.
        time_us: the time that the latest message gave for itself; None where it has none.
        n_inside: how many events of the latest message are on the sensor.
        span: `(2,)` int64, their earliest and latest time; as it was where there are none.
    """

    def __init__(self, max_events: int = MAX_PACKET_EVENTS) -> None:
        """Start with no decoder."""
        self.encoding = ""
        self.resolution: Resolution | None = None
        self.time_us: int | None = None
        self.n_inside = 0
        self.span = np.zeros(2, np.int64)
        self._max_events = max_events
        self._decoders: dict[str, Decoder] = {}
        self._last_seq: int | None = None
        self._is_broken = False
        self._before: tuple[int, int] | None = None

    def decode(self, schema: str, content: Content) -> Events:
        """Decode one message.

        Args:
            schema: its type.
            content: the message, see `streamfeat.messages.event_messages.parse_events`.

        Returns:
            `(n,)` array of `EVENT_DTYPE`, times as the camera says, in stored order.

        Raises:
            InputError: the payload is not what the message says, or the sensor is not possible.
        """
        if isinstance(content, EventArray):
            self.resolution = _resolution(content.height, content.width)
            self.encoding, self.time_us = schema.partition("/")[0], None
            self.n_inside = time_span(content.events, *self.resolution, self.span)
            return content.events
        if self._last_seq is not None and content.seq > self._last_seq + 1:
            self.resync()
        self._last_seq = content.seq
        if content.is_bigendian:
            raise InputError("big-endian payloads are not supported; record with is_bigendian false")
        resolution = _resolution(content.height, content.width)
        decoder = self._decoders.get(content.encoding)
        if decoder is None:
            decoder = self._decoders[content.encoding] = make_decoder(content.encoding, self._max_events)
        events = decoder.decode(content.events, content.time_base, resolution)
        self.n_inside, self.span = decoder.n_inside, decoder.span
        if isinstance(decoder, Evt3Decoder) and len(events):
            self._place(decoder, events, content.stamp_ns)
        self.encoding, self.resolution = content.encoding, resolution
        # The times of evt3 are the camera's own; its time_base is on another clock.
        timed = content.time_base and content.encoding != "evt3"
        self.time_us = content.time_base // 1000 if timed else None
        return events

    def snapshot(self) -> dict[str, Any]:
        """What decoders carry on, as JSON values."""
        return {
            "last_seq": self._last_seq,
            "is_broken": self._is_broken,
            "before": self._before,
            "decoders": {name: decoder.snapshot() for name, decoder in self._decoders.items()},
        }

    def restore(self, values: Fields) -> None:
        """Go on from a snapshot.

        Raises:
            InputError: the values are not those of a reader.
        """
        self._last_seq = values.maybe("last_seq", 0, 1 << 64)
        self._is_broken = values.flag("is_broken")
        before = values.wholes("before", 2, -_LARGEST) if "before" in values else []
        self._before = (before[0], before[1]) if len(before) == 2 else None
        decoders = values.inner("decoders")
        for name in PAYLOAD_ENCODINGS:
            if name in decoders:
                self._decoders[name] = make_decoder(name, self._max_events)
                self._decoders[name].restore(decoders.wholes(name, 8))

    def _place(self, decoder: Evt3Decoder, events: Events, stamp_ns: int) -> None:
        """After missing packets, count the wraps of 16.8 s that they would have shown, by the stamps around.

        Args:
            decoder: of the packet, changed.
            events: of the packet, at least one, changed.
            stamp_ns: of the packet.
        """
        if self._is_broken and self._before:
            stamp_before_ns, last_us = self._before
            expected_us = last_us + (stamp_ns - stamp_before_ns) // 1000
            wraps = round((expected_us - int(events["t"][0])) / EVT3_WRAP_US)
            if 0 < wraps <= _MOST_WRAPS:
                decoder.count_wraps(wraps)
                events["t"] += wraps * EVT3_WRAP_US
                decoder.span += wraps * EVT3_WRAP_US
        self._is_broken = False
        self._before = stamp_ns, int(events["t"][-1])

    def count_wraps(self, n: int) -> None:
        """The times of evt3 have wrapped so often more than was counted, in this packet and from now on."""
        decoder = self._decoders.get("evt3")
        if n and isinstance(decoder, Evt3Decoder):
            decoder.count_wraps(n)
            if self._before:
                self._before = self._before[0], self._before[1] + n * EVT3_WRAP_US

    def resync(self) -> None:
        """Messages are missing: what came before says nothing about what follows."""
        self._is_broken = True
        for decoder in self._decoders.values():
            decoder.resync()


class PacketWriter:
    """Cuts the events of one topic into messages, numbered from 0.

    Args:
        encoding: of the payloads, one of `streamfeat.messages.codecs.PAYLOAD_ENCODINGS`.
        frame_id: in the header of every message.

    Raises:
        InputError: the encoding is unknown.
    """

    def __init__(self, encoding: str = "mono", frame_id: str = "") -> None:
        """Nothing written yet."""
        make_decoder(encoding)
        self._encoding, self._frame_id = encoding, frame_id
        self._seq = 0
        self._after_us = 0

    def restart(self) -> None:
        """The events that follow are of another epoch: their times have nothing to do with those before."""
        self._after_us = 0

    def messages(self, events: Events, resolution: Resolution) -> Iterator[EventPacket]:
        """Yield a batch as messages, each with the time of its earliest event as its stamp.

        Args:
            events: `(n,)` array of `EVENT_DTYPE`, not changed; n may be 0, which yields nothing.
            resolution: `(height, width)` of the sensor.

        Raises:
            InputError: the encoding cannot represent the events (see `streamfeat.messages.codecs.encode`).
        """
        start = 0
        height, width = resolution
        while start < len(events):
            block = events[start : start + PACKET_EVENTS]
            far = np.flatnonzero(np.abs(block["t"] - block["t"][0]) >= PACKET_US)
            block = block[: far[0]] if len(far) else block
            payload, base_ns = encode(block, self._encoding, self._after_us)
            stamp_ns, about = int(block["t"].min()) * 1000, (self._frame_id, height, width)
            yield EventPacket(stamp_ns, *about, self._seq, base_ns, self._encoding, False, payload)
            self._seq += 1
            self._after_us = int(block["t"][-1])
            start += len(block)


def _resolution(height: int, width: int) -> Resolution:
    if not (0 < height <= _MAX_SIDE and 0 < width <= _MAX_SIDE):
        raise InputError(f"a sensor of height {height} and width {width} is not possible")
    if height * width > MAX_PIXELS:
        raise InputError(f"a sensor of {width}x{height} pixels; at most {MAX_PIXELS} are read")
    return height, width
