"""Messages that name a state in a word or a number, which can label a stream.

Lives here: which types these are, and the text of one, in CDR (ROS 2) or ROS 1 layout.
Not here: when a text begins and ends to hold (`streamfeat.recordings.label_topic`).

| type | text | time |
|---|---|---|
| `std_msgs/String` | as it is | log time |
| `std_msgs/Bool`, `Byte`, `Char`, `Int8` ... `UInt64` | the number; `true`, `false` | log time |
| `std_stamped_msgs/StringStamped` | its `data` | stamp |
| `vision_msgs/Classification` | `class_id` of the result with the highest score | stamp |
"""

import struct
from typing import NamedTuple

from streamfeat.errors import InputError

__all__ = ["TEXT_SCHEMAS", "Text", "parse_text"]

_NUMBERS = {
    "Byte": "B", "Char": "B", "Int8": "b", "UInt8": "B", "Int16": "h", "UInt16": "H", "Int32": "i",
    "UInt32": "I", "Int64": "q", "UInt64": "Q",
}  # fmt: skip
_STAMPED = "std_stamped_msgs/msg/StringStamped"
_CLASSIFICATION = "vision_msgs/msg/Classification"
TEXT_SCHEMAS = (
    "std_msgs/msg/String",
    "std_msgs/msg/Bool",
    *(f"std_msgs/msg/{name}" for name in _NUMBERS),
    _STAMPED,
    _CLASSIFICATION,
)
"""Types whose messages can be labels, as ROS 2 names them."""

_LONGEST = 1 << 16


class Text(NamedTuple):
    """What a message says; `stamp_ns` is 0 where it has no stamp."""

    text: str
    stamp_ns: int


def parse_text(schema: str, data: bytes | memoryview, layout: str = "cdr") -> Text:
    """Read one message.

    Args:
        schema: one of `TEXT_SCHEMAS`.
        data: its bytes.
        layout: `cdr` or `ros1`.

    Raises:
        InputError: the bytes are no such message, or its text has more than 65,536 bytes.
    """
    reader = _Reader(memoryview(data), schema, layout)
    kind = schema.rpartition("/")[2]
    if kind == "String":
        return Text(reader.text(), 0)
    if kind == "Bool":
        return Text("true" if reader.number("B") else "false", 0)
    if kind in _NUMBERS:
        return Text(str(reader.number(_NUMBERS[kind])), 0)
    stamp_ns = reader.stamp_ns()
    if schema == _STAMPED:
        return Text(reader.text(), stamp_ns)
    # Each result takes 12 bytes or more, so a lying count ends at the end of the message.
    results = [(reader.text(), reader.number("d")) for _ in range(int(reader.number("I")))]
    best = max(results, key=lambda result: result[1], default=("", 0.0))
    return Text(best[0], stamp_ns)


class _Reader:
    """Takes a message apart; every length is checked before it is used."""

    def __init__(self, data: memoryview, schema: str, layout: str) -> None:
        self._data, self._schema, self._is_cdr = data, schema, layout != "ros1"
        self._at = 0
        if self._is_cdr and bytes(self._take(4)[:2]) != b"\x00\x01":
            raise InputError(f"{schema}: only little-endian XCDR1 (0001) is supported")

    def number(self, code: str) -> float:
        size = struct.calcsize(code)
        if self._is_cdr:
            self._at += -(self._at - 4) % size
        (value,) = struct.unpack(f"<{code}", self._take(size))
        return value  # type: ignore[no-any-return]

    def text(self) -> str:
        raw = bytes(self._take(int(self.number("I"))))
        if len(raw) > _LONGEST:
            raise InputError(f"{self._schema}: a text of {len(raw)} bytes; a label has at most {_LONGEST}")
        return raw.removesuffix(b"\0").decode("utf-8", "replace").strip()

    def stamp_ns(self) -> int:
        if not self._is_cdr:
            self.number("I")  # ROS 1 numbers its headers
        sec, nanosec = int(self.number("I")), int(self.number("I"))
        self.text()
        return sec * 1_000_000_000 + nanosec

    def _take(self, size: int) -> memoryview:
        left = len(self._data) - self._at
        if size > left:
            raise InputError(
                f"{self._schema}: {size} bytes are needed at byte {self._at}, {max(left, 0)} are left; the "
                "message is cut short or damaged"
            )
        self._at += size
        return self._data[self._at - size : self._at]
