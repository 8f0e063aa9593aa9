"""What a stream is made of: packets of events, labels, and time that passes in silence.

Lives here: `Packet`, `Label`, `Tick`, and reading the first two from the messages that carry them.
Not here: where messages come from (`recording`, `live`), what bytes they have (`messages`, `codecs`).
"""

from dataclasses import dataclass
from typing import Self

from streamfeat.codecs import MAX_PACKET_EVENTS, Decoder, make_decoder
from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution
from streamfeat.messages import EventArray, EventPacket, LabelMessage

__all__ = ["EVENT_SCHEMAS", "Label", "Packet", "PacketReader", "Tick"]

EVENT_SCHEMAS = (EventPacket.SCHEMA_NAME, EventArray.SCHEMA_NAME)
"""Messages that carry events."""

_MAX_SIDE = 1 << 16  # pixels: coordinates are uint16


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
    """

    topic: str
    events: Events
    resolution: Resolution
    log_time_ns: int
    seq: int
    source_ns: int = 0
    lost: int = 0
    epoch: int = 0


@dataclass(frozen=True, slots=True)
class Tick:
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
            InputError: the bytes are no such message.
        """
        m = LabelMessage.from_cdr(data)
        return cls(m.stamp_ns // 1000, m.duration_ns // 1000, m.label, m.split, m.source, topic)


class PacketReader:
    """Turns the event messages of one topic into packets; keeps what decoders carry from one to the next.

    Args:
        topic: named in the packets.
        max_events: packets of more events are refused.
    """

    def __init__(self, topic: str, max_events: int = MAX_PACKET_EVENTS) -> None:
        """Start with no decoder."""
        self.encoding = ""
        self._topic = topic
        self._max_events = max_events
        self._decoders: dict[str, Decoder] = {}
        self._last_seq: int | None = None

    def read(self, schema: str, data: bytes | memoryview, log_time_ns: int, sequence: int) -> Packet:
        """Read one message; `sequence` stands in where the message has no number of its own.

        Raises:
            InputError: the bytes are no such message, or its payload is not what it says.
        """
        if schema == EventArray.SCHEMA_NAME:
            array = EventArray.from_cdr(data)
            self.encoding = "dvs_msgs"
            resolution = _resolution(array.height, array.width)
            return Packet(self._topic, array.events, resolution, log_time_ns, sequence)
        packet = EventPacket.from_cdr(data)
        if self._last_seq is not None and packet.seq > self._last_seq + 1:
            self.resync()
        self._last_seq = packet.seq
        if packet.is_bigendian:
            raise InputError("big-endian payloads are not supported; record with is_bigendian false")
        resolution = _resolution(packet.height, packet.width)
        if packet.encoding not in self._decoders:
            self._decoders[packet.encoding] = make_decoder(packet.encoding, self._max_events)
        events = self._decoders[packet.encoding].decode(packet.events, packet.time_base)
        self.encoding = packet.encoding
        return Packet(self._topic, events, resolution, log_time_ns, packet.seq)

    def resync(self) -> None:
        """Messages are missing: what came before says nothing about what follows."""
        for decoder in self._decoders.values():
            decoder.resync()


def _resolution(height: int, width: int) -> Resolution:
    if not (0 < height <= _MAX_SIDE and 0 < width <= _MAX_SIDE):
        raise InputError(f"a sensor of height {height} and width {width} is not possible")
    return height, width
