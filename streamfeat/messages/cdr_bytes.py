"""The parts of a CDR message: numbers, strings and sequences, with their alignment.

Lives here: taking a message apart and putting one together, field by field.
Not here: which fields a message has (`cdr`).
"""

import struct
from typing import Self

from streamfeat.errors import InputError

__all__ = ["CdrReader", "CdrWriter"]

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_NUMBERS = {code: struct.Struct(f"<{code}") for code in "BiIqQ"}


class CdrReader:
    """Takes one CDR message apart, front to back; every length is checked before it is used."""

    def __init__(self, data: bytes | memoryview, message: str) -> None:
        """Check the encapsulation of `data`; errors name `message`.

        Raises:
            InputError: it is not little-endian XCDR1.
        """
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


class CdrWriter:
    """Puts one CDR message together, front to back; the methods are those of `CdrReader`."""

    def __init__(self) -> None:
        """Begin with the encapsulation header."""
        self._out = bytearray(_LITTLE_ENDIAN)

    def number(self, code: str, value: int) -> Self:
        """Write one integer or boolean of `struct` type `code`."""
        self._out += bytes(-(len(self._out) - 4) % struct.calcsize(code)) + struct.pack(f"<{code}", value)
        return self

    def string(self, text: str) -> Self:
        """Write a string and its zero byte."""
        raw = text.encode() + b"\0"
        return self.number("I", len(raw)).raw(raw)

    def raw(self, data: bytes | memoryview) -> Self:
        """Write bytes as they are."""
        self._out += data
        return self

    def stamp_and_frame(self, stamp_ns: int, frame_id: str) -> Self:
        """Write a `std_msgs/Header`.

        Raises:
            InputError: the stamp is out of range.
        """
        sec, nanosec = divmod(stamp_ns, 1_000_000_000)
        if not 0 <= sec < 1 << 31:
            raise InputError(
                f"a message stamp is 0 or more and less than 2^31 s, not {stamp_ns} ns; shift the times"
            )
        return self.number("i", sec).number("I", nanosec).string(frame_id)

    def bytes(self) -> bytes:
        """The message."""
        return bytes(self._out)
