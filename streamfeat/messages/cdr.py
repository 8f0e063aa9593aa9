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

__all__ = ["EventArray", "EventPacket", "FeaturesMessage", "LabelMessage", "PredictionMessage"]

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"

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


_NUMBERS = {code: struct.Struct(f"<{code}") for code in "BiIqQ"}


class _Reader:
    """Takes one CDR message apart, front to back; every length is checked before it is used."""

    def __init__(self, data: bytes | memoryview, message: str) -> None:
        self._data = memoryview(data)
        self._message = message
        self._at = 4
        if len(data) < 4:
            raise InputError(f"{message}: {len(data)} bytes are too few for a CDR message")
        if self._data[:2] != _LITTLE_ENDIAN[:2]:
            raise InputError(
                f"{message}: encapsulation {bytes(self._data[:2]).hex()} at byte 0 is not supported; "
                "only little-endian XCDR1 (0001) is"
            )

    def number(self, code: str, field: str) -> int:
        """Read one integer or boolean of `struct` type `code`."""
        layout = _NUMBERS[code]
        at = self._at - (self._at - 4) % -layout.size
        if at + layout.size > len(self._data):
            self._at = at
            self._take(layout.size, field)  # says what is missing
        self._at = at + layout.size
        return int(layout.unpack_from(self._data, at)[0])

    def string(self, field: str) -> str:
        """Read a string; the zero byte that ends it is dropped."""
        length = self.number("I", field)
        at = self._at
        raw = bytes(self._take(length, field))
        try:
            return raw.removesuffix(b"\0").decode()
        except UnicodeDecodeError:
            raise InputError(f"{self._message}: {field!r} at byte {at} is not UTF-8 text") from None

    def sequence(self, itemsize: int, field: str) -> memoryview:
        """Read a sequence of items that CDR packs without gaps."""
        return self._take(self.number("I", field) * itemsize, field)

    def stamp_and_frame(self) -> tuple[int, str]:
        """Read a `std_msgs/Header`: stamp in nanoseconds, and frame."""
        sec = self.number("i", "header.stamp.sec")
        nanosec = self.number("I", "header.stamp.nanosec")
        return sec * 1_000_000_000 + nanosec, self.string("header.frame_id")

    def rest(self) -> memoryview:
        """Give all bytes that were not read yet."""
        return self._data[self._at :]

    def _take(self, size: int, field: str) -> memoryview:
        left = len(self._data) - self._at
        if size > left:
            raise InputError(
                f"{self._message}: {field!r} at byte {self._at} needs {size} bytes, {max(left, 0)} are left; "
                "the message is cut short or damaged"
            )
        self._at += size
        return self._data[self._at - size : self._at]


class _Writer:
    """Puts one CDR message together."""

    def __init__(self) -> None:
        self._out = bytearray(_LITTLE_ENDIAN)

    def number(self, code: str, value: int) -> Self:
        self._out += bytes(-(len(self._out) - 4) % struct.calcsize(code)) + struct.pack(f"<{code}", value)
        return self

    def string(self, text: str) -> Self:
        raw = text.encode() + b"\0"
        return self.number("I", len(raw)).raw(raw)

    def raw(self, data: bytes | memoryview) -> Self:
        self._out += data
        return self

    def stamp_and_frame(self, stamp_ns: int, frame_id: str) -> Self:
        sec, nanosec = divmod(stamp_ns, 1_000_000_000)
        if not 0 <= sec < 1 << 31:
            raise InputError(
                f"a message stamp is 0 or more and less than 2^31 s, not {stamp_ns} ns; shift the times"
            )
        return self.number("i", sec).number("I", nanosec).string(frame_id)

    def bytes(self) -> bytes:
        return bytes(self._out)


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
        r = _Reader(data, "EventPacket")
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
        w = _Writer().stamp_and_frame(self.stamp_ns, self.frame_id)
        w.number("I", self.height).number("I", self.width).number("Q", self.seq).number("Q", self.time_base)
        w.string(self.encoding).number("B", self.is_bigendian)
        return w.number("I", len(self.events)).raw(self.events).bytes()


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
        r = _Reader(data, "EventArray")
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
        w = _Writer().stamp_and_frame(self.stamp_ns, self.frame_id)
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
        r = _Reader(data, "Label")
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
        w = _Writer().stamp_and_frame(self.stamp_ns, self.frame_id).number("Q", self.duration_ns)
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
        r = _Reader(data, "Features")
        stamp_ns, frame_id = r.stamp_and_frame()
        n_events = r.number("Q", "n_events")
        values = np.frombuffer(r.sequence(4, "data"), "<f4")
        return cls(stamp_ns, frame_id, n_events, values, bool(r.number("B", "incomplete")))

    def to_cdr(self) -> bytes:
        """Write the message.

        Raises:
            InputError: the stamp is out of range.
        """
        w = _Writer().stamp_and_frame(self.stamp_ns, self.frame_id).number("Q", self.n_events)
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
        r = _Reader(data, "Prediction")
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
        w = _Writer().stamp_and_frame(self.stamp_ns, self.frame_id).string(self.label)
        w.number("I", len(self.labels))
        for label in self.labels:
            w.string(label)
        return w.number("I", len(self.scores)).raw(self.scores.astype("<f4").tobytes()).bytes()
