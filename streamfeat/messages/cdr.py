"""The five ROS 2 messages of a recording: CDR bytes to dataclasses and back.

Lives here: one dataclass per message with `from_cdr` and `to_cdr`, its schema name and its ros2msg text.
Not here: what an event payload means (`streamfeat.messages.codecs`), and where messages are kept.

The CDR is XCDR1, little endian, with its four-byte encapsulation header; anything else is refused. Lengths
are hostile until compared with the bytes that are there, so nothing is allocated that the buffer does not
hold. Messages are told apart by schema *name*: real recordings carry the same one as ros2msg and as ros2idl.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.events import Events, make_events
from streamfeat.messages.cdr_bytes import CdrReader, CdrWriter

__all__ = ["EventArray", "EventPacket", "FeaturesMessage", "LabelMessage", "PredictionMessage"]

_HEADER_TEXT = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""
_TIME_TEXT = """
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def _schema(fields: str, *more: str) -> str:
    return "std_msgs/Header header\n" + fields + "".join(more) + _HEADER_TEXT + _TIME_TEXT


@dataclass(frozen=True, slots=True)
class EventPacket:
    """One encoded packet of events; `time_base` in nanoseconds."""

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    seq: int
    time_base: int
    encoding: str
    is_bigendian: bool
    events: bytes | memoryview

    SCHEMA_NAME: ClassVar[str] = "event_camera_msgs/msg/EventPacket"
    SCHEMA: ClassVar[str] = _schema(
        "uint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
        "string encoding\nbool is_bigendian\nuint8[] events\n"
    )

    @classmethod
    def from_cdr(cls, data: bytes | memoryview) -> Self:
        """Read one message; `events` is a view of `data`.

        Raises:
            InputError: the bytes are no such message.
        """
        at_once = _packet_fields(data)
        if at_once:
            return cls(*at_once)
        r = CdrReader(data, "EventPacket")
        stamp_ns, frame_id = r.stamp_and_frame()
        return cls(
            stamp_ns,
            frame_id,
            height=r.number("I", "height"),
            width=r.number("I", "width"),
            seq=r.number("Q", "seq"),
            time_base=r.number("Q", "time_base"),
            encoding=r.string("encoding"),
            is_bigendian=bool(r.number("B", "is_bigendian")),
            events=r.sequence(1, "events"),
        )

    def to_cdr(self) -> bytes:
        """Write the message.

        Raises:
            InputError: the stamp is out of range.
        """
        w = CdrWriter().stamp_and_frame(self.stamp_ns, self.frame_id)
        w.number("I", self.height).number("I", self.width).number("Q", self.seq).number("Q", self.time_base)
        w.string(self.encoding).number("B", self.is_bigendian)
        return w.number("I", len(self.events)).raw(self.events).bytes()


_PACKET_START = struct.Struct("<HxxiII")
_PACKET_MIDDLE = {0: struct.Struct("<IIQQI"), 4: struct.Struct("<II4xQQI")}
"""Sizes, numbers and the length of the encoding, by how far from a multiple of 8 they begin."""
_PACKET_END = {at: struct.Struct(f"<B{-(at + 1) % 4}xI") for at in range(4)}


_PacketFields = tuple[int, str, int, int, int, int, str, bool, memoryview]


def _packet_fields(data: bytes | memoryview) -> _PacketFields | None:
    """The fields of an `EventPacket` in three reads where `CdrReader` needs twelve.

    Returns:
        None if anything is wrong with the message, which `CdrReader` then names.
    """
    try:
        view = memoryview(data)
        kind, sec, nanosec, length = _PACKET_START.unpack_from(view)
        at = 16 + length
        frame_id = str(view[16:at], "utf-8").removesuffix("\0")
        at += -at % 4
        middle = _PACKET_MIDDLE[(at - 4) % 8]
        height, width, seq, time_base, length = middle.unpack_from(view, at)
        at += middle.size
        encoding = str(view[at : at + length], "utf-8").removesuffix("\0")
        at += length
        end = _PACKET_END[at % 4]
        is_bigendian, length = end.unpack_from(view, at)
        at += end.size
    except (struct.error, UnicodeDecodeError):
        return None
    if kind != 0x0100 or at + length > len(view):
        return None
    stamp_ns = sec * 1_000_000_000 + nanosec
    payload = view[at : at + length]
    return stamp_ns, frame_id, height, width, seq, time_base, encoding, bool(is_bigendian), payload


_DVS_NAMES = ["x", "y", "sec", "nanosec", "polarity"]
_DVS_FORMATS = ["<u2", "<u2", "<i4", "<u4", "u1"]
# CDR aligns each field: the first event takes 13 bytes, and every later one starts 16 after the one before.
_DVS_FIRST = np.dtype(
    {"names": _DVS_NAMES, "formats": _DVS_FORMATS, "offsets": [0, 2, 4, 8, 12], "itemsize": 13}
)
_DVS_LATER = np.dtype(
    {"names": _DVS_NAMES, "formats": _DVS_FORMATS, "offsets": [0, 2, 6, 10, 14], "itemsize": 15}
)
_DVS_STRIDE = 16


@dataclass(frozen=True, slots=True, eq=False)
class EventArray:
    """One packet of events that each carry their own time; `events` is `(n,)` of `EVENT_DTYPE`."""

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    events: Events

    SCHEMA_NAME: ClassVar[str] = "dvs_msgs/msg/EventArray"
    SCHEMA: ClassVar[str] = _schema(
        "uint32 height\nuint32 width\ndvs_msgs/Event[] events\n",
        "\n" + "=" * 80 + "\nMSG: dvs_msgs/Event\n",
        "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity\n",
    )

    @classmethod
    def from_cdr(cls, data: bytes | memoryview) -> Self:
        """Read one message; times are cut to whole microseconds.

        Raises:
            InputError: the bytes are no such message.
        """
        r = CdrReader(data, "EventArray")
        stamp_ns, frame_id = r.stamp_and_frame()
        height, width = r.number("I", "height"), r.number("I", "width")
        n = r.number("I", "events")
        rest = r.rest()
        if n and len(rest) < 13 + _DVS_STRIDE * (n - 1):
            raise InputError(
                f"EventArray: 'events' at byte {len(data) - len(rest)} claims {n} events, {len(rest)} bytes "
                "are left; the message is cut short or damaged"
            )
        parts = (
            np.frombuffer(rest[: 13 * min(n, 1)], _DVS_FIRST),
            np.ndarray(max(n - 1, 0), _DVS_LATER, rest[14:] if n > 1 else b"", 0, (_DVS_STRIDE,)),
        )
        events = np.concatenate([_from_dvs(part) for part in parts])
        return cls(stamp_ns, frame_id, height, width, events)

    def to_cdr(self) -> bytes:
        """Write the message.

        Raises:
            InputError: the stamp is out of range.
        """
        w = CdrWriter().stamp_and_frame(self.stamp_ns, self.frame_id)
        w.number("I", self.height).number("I", self.width).number("I", len(self.events))
        # The stride holds from the first event on if that event's x and y sit two bytes further back.
        block = np.zeros(len(self.events), np.dtype((np.void, _DVS_STRIDE)))
        later = np.ndarray(len(block), _DVS_LATER, block.data, 0, (_DVS_STRIDE,))
        later["x"], later["y"], later["polarity"] = (self.events[name] for name in ("x", "y", "p"))
        later["sec"], us = np.divmod(self.events["t"], 1_000_000)
        later["nanosec"] = us * 1000
        raw = block.tobytes()
        return w.raw(raw[:4] + raw[6:-1]).bytes() if raw else w.bytes()


def _from_dvs(part: NDArray[np.void]) -> Events:
    t = part["sec"].astype(np.int64) * 1_000_000 + part["nanosec"] // 1000
    return make_events(part["x"], part["y"], part["polarity"] != 0, t)


@dataclass(frozen=True, slots=True)
class LabelMessage:
    """A label for the events from `stamp_ns` on, for `duration_ns`."""

    stamp_ns: int
    frame_id: str
    duration_ns: int
    label: str
    split: str
    source: str

    SCHEMA_NAME: ClassVar[str] = "streamfeat_msgs/msg/Label"
    SCHEMA: ClassVar[str] = _schema("uint64 duration_ns\nstring label\nstring split\nstring source\n")

    @classmethod
    def from_cdr(cls, data: bytes | memoryview) -> Self:
        """Read one message.

        Raises:
            InputError: the bytes are no such message.
        """
        r = CdrReader(data, "Label")
        stamp_ns, frame_id = r.stamp_and_frame()
        duration_ns = r.number("Q", "duration_ns")
        return cls(stamp_ns, frame_id, duration_ns, r.string("label"), r.string("split"), r.string("source"))

    def to_cdr(self) -> bytes:
        """Write the message.

        Raises:
            InputError: the stamp or the duration is out of range.
        """
        if not 0 <= self.duration_ns < 1 << 64:
            raise InputError(f"label {self.label!r}: a duration of {self.duration_ns} ns is not possible")
        w = CdrWriter().stamp_and_frame(self.stamp_ns, self.frame_id).number("Q", self.duration_ns)
        return w.string(self.label).string(self.split).string(self.source).bytes()


@dataclass(frozen=True, slots=True, eq=False)
class FeaturesMessage:
    """Features at `stamp_ns`, after `n_events` events; `data` is `(n,)` float32.

    `incomplete` says that packets are known to be missing from the window.
    """

    stamp_ns: int
    frame_id: str
    n_events: int
    data: NDArray[np.float32]
    incomplete: bool = False

    SCHEMA_NAME: ClassVar[str] = "streamfeat_msgs/msg/Features"
    SCHEMA: ClassVar[str] = _schema("uint64 n_events\nfloat32[] data\nbool incomplete\n")

    @classmethod
    def from_cdr(cls, data: bytes | memoryview) -> Self:
        """Read one message; `data` is a view of the bytes.

        Raises:
            InputError: the bytes are no such message.
        """
        r = CdrReader(data, "Features")
        stamp_ns, frame_id = r.stamp_and_frame()
        n_events = r.number("Q", "n_events")
        values = np.frombuffer(r.sequence(4, "data"), "<f4")
        return cls(stamp_ns, frame_id, n_events, values, bool(r.number("B", "incomplete")))

    def to_cdr(self) -> bytes:
        """Write the message.

        Raises:
            InputError: the stamp is out of range.
        """
        w = CdrWriter().stamp_and_frame(self.stamp_ns, self.frame_id).number("Q", self.n_events)
        w.number("I", len(self.data)).raw(self.data.astype("<f4").tobytes())
        return w.number("B", self.incomplete).bytes()


@dataclass(frozen=True, slots=True, eq=False)
class PredictionMessage:
    """The winning `label` at `stamp_ns`, with `scores` `(n,)` float32, one for each of `labels`."""

    stamp_ns: int
    frame_id: str
    label: str
    labels: Sequence[str]
    scores: NDArray[np.float32]

    SCHEMA_NAME: ClassVar[str] = "streamfeat_msgs/msg/Prediction"
    SCHEMA: ClassVar[str] = _schema("string label\nstring[] labels\nfloat32[] scores\n")

    @classmethod
    def from_cdr(cls, data: bytes | memoryview) -> Self:
        """Read one message; `scores` is a view of the bytes.

        Raises:
            InputError: the bytes are no such message.
        """
        r = CdrReader(data, "Prediction")
        stamp_ns, frame_id = r.stamp_and_frame()
        label = r.string("label")
        # Each string takes four bytes or more, so a lying count ends at the end of the buffer.
        labels = [r.string(f"labels[{i}]") for i in range(r.number("I", "labels"))]
        return cls(stamp_ns, frame_id, label, labels, np.frombuffer(r.sequence(4, "scores"), "<f4"))

    def to_cdr(self) -> bytes:
        """Write the message.

        Raises:
            InputError: the stamp is out of range.
        """
        w = CdrWriter().stamp_and_frame(self.stamp_ns, self.frame_id).string(self.label)
        w.number("I", len(self.labels))
        for label in self.labels:
            w.string(label)
        return w.number("I", len(self.scores)).raw(self.scores.astype("<f4").tobytes()).bytes()
