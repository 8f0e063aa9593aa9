"""Messages of events under all names and layouts in which they are recorded.

Lives here: which types carry events, and taking a message of theirs apart, in CDR (ROS 2) or ROS 1 layout.
Not here: what a payload means (`codecs`), and the messages themselves (`cdr`).

| type | the same as |
|---|---|
| `event_array_msgs/EventArray` | `event_camera_msgs/EventPacket`, under its first name |
| `prophesee_event_msgs/EventArray`, `dv_ros_msgs/EventArray` | `dvs_msgs/EventArray` |

ROS 1 packs fields without gaps, begins a header with a number, and ends no string with a zero.
"""

import struct

import numpy as np

from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.messages.cdr import EventArray, EventPacket

__all__ = ["EVENT_SCHEMAS", "PACKET_SCHEMAS", "parse_events", "ros2_name"]

PACKET_SCHEMAS = (EventPacket.SCHEMA_NAME, "event_array_msgs/msg/EventArray")
"""Types whose messages hold an encoded payload and a sequence number."""
_ARRAY_SCHEMAS = (
    EventArray.SCHEMA_NAME,
    "prophesee_event_msgs/msg/EventArray",
    "dv_ros_msgs/msg/EventArray",
)
EVENT_SCHEMAS = (*PACKET_SCHEMAS, *_ARRAY_SCHEMAS)
"""Types whose messages carry events, as ROS 2 names them."""

_ROS1_EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nanosec", "<u4"), ("polarity", "u1")])


def ros2_name(schema: str) -> str:
    """The name of a type as ROS 2 writes it.

    ROS 1 leaves the `msg` in the middle out, and DDS writes `package::msg::dds_::Type_`.
    """
    if "::" in schema:
        schema = schema.removesuffix("_").replace("::dds_::", "::").replace("::", "/")
    package, _, kind = schema.partition("/")
    return f"{package}/msg/{kind}" if kind and "/" not in kind else schema


def parse_events(schema: str, data: bytes | memoryview, layout: str = "cdr") -> EventPacket | EventArray:
    """Take a message of events apart.

    Args:
        schema: one of `EVENT_SCHEMAS`.
        data: its bytes.
        layout: `cdr` or `ros1`.

    Raises:
        InputError: the bytes are no such message.
    """
    if layout == "ros1":
        reader = _Ros1Reader(data, schema)
        return reader.packet() if schema in PACKET_SCHEMAS else reader.array()
    return (EventPacket if schema in PACKET_SCHEMAS else EventArray).from_cdr(data)


class _Ros1Reader:
    """Takes one ROS 1 message apart, front to back; every length is checked before it is used."""

    def __init__(self, data: bytes | memoryview, schema: str) -> None:
        self._data, self._at, self._schema = memoryview(data), 0, schema

    def packet(self) -> EventPacket:
        stamp_ns, frame_id = self._header()
        height, width, seq, time_base = self._numbers("<IIQQ", "height")
        encoding = self._text("encoding")
        (is_bigendian,) = self._numbers("<B", "is_bigendian")
        payload = self._bytes("events")
        about = stamp_ns, frame_id, height, width, seq, time_base
        return EventPacket(*about, encoding, bool(is_bigendian), payload)

    def array(self) -> EventArray:
        stamp_ns, frame_id = self._header()
        height, width, n = self._numbers("<III", "height")
        raw = np.frombuffer(self._take(n * _ROS1_EVENT.itemsize, "events"), _ROS1_EVENT)
        t = raw["sec"].astype(np.int64) * 1_000_000 + raw["nanosec"] // 1000
        return EventArray(
            stamp_ns, frame_id, height, width, make_events(raw["x"], raw["y"], raw["polarity"] != 0, t)
        )

    def _header(self) -> tuple[int, str]:
        _, sec, nanosec = self._numbers("<III", "header")
        return sec * 1_000_000_000 + nanosec, self._text("header.frame_id")

    def _numbers(self, code: str, field: str) -> tuple[int, ...]:
        return struct.unpack(code, self._take(struct.calcsize(code), field))

    def _bytes(self, field: str) -> memoryview:
        (length,) = self._numbers("<I", field)
        return self._take(length, field)

    def _text(self, field: str) -> str:
        at = self._at
        try:
            return bytes(self._bytes(field)).decode()
        except UnicodeDecodeError:
            raise InputError(f"{self._schema}: {field!r} at byte {at} is not UTF-8 text") from None

    def _take(self, size: int, field: str) -> memoryview:
        left = len(self._data) - self._at
        if size > left:
            raise InputError(
                f"{self._schema}: {field!r} at byte {self._at} needs {size} bytes, {left} are left; "
                "the message is cut short or damaged"
            )
        self._at += size
        return self._data[self._at - size : self._at]
