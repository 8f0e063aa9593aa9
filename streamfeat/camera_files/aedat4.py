"""AEDAT 4, the files of iniVation's DV: a header, then packets of several streams, one of them events.

Lives here: the header, the description of the streams, packets and their compression.
Not here: which format a file has (`streamfeat.camera_files.event_files`).

The layout is that of docs.inivation.com, "AEDAT 4.0": a FlatBuffers table with the compression, where the
index is, and an XML description of the streams; then packets, each with its stream, its length, and a
FlatBuffers table of events that is compressed by itself. The index is not needed to read from front to back,
so a file without one, or with one that is damaged, is read like any other.

Every offset is compared with the bytes that are there. Decoders by others do not: on a few changed bytes
faery 0.7.1 ends the process, dv-processing 2.0.4 can hang, and eventcv 1.0.8 says nothing of what is lost.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree

import lz4.frame
import numpy as np
import zstandard

from streamfeat.camera_files.source import (
    Contents,
    Losses,
    TableOptions,
    checked_resolution,
    chosen_stream,
)
from streamfeat.errors import InputError
from streamfeat.events import Events, make_events
from streamfeat.files.budget import Budget

__all__ = ["open_aedat4"]

_MAGIC = b"#!AER-DAT4.0\r\n"
_LARGEST_HEADER = 1 << 20
_LARGEST_PACKET = 64 << 20  # bytes when unpacked, 2^22 events; DV writes some thousand
_UNPACK = {0: "", 1: "lz4", 2: "lz4", 3: "zstd", 4: "zstd"}
_EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("on", "u1"), ("", "V3")])
_DAMAGE = (ValueError, RuntimeError, EOFError, MemoryError, zstandard.ZstdError)


@dataclass(frozen=True, slots=True)
class _Header:
    """What a file says before its first packet.

    Attributes:
        start: byte of the first packet.
        stop: byte of the index, or -1.
        compression: of the packets.
        streams: by their numbers.
    """

    start: int
    stop: int
    compression: str
    streams: dict[int, "_Stream"]


@dataclass(frozen=True, slots=True)
class _Stream:
    """Type, name and size of one stream, as text; empty where it is not said."""

    kind: str
    name: str
    width: str
    height: str


class _Table:
    """A FlatBuffers table; every offset is checked before it is followed."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = self._number("I", 4) + 4  # a size comes first, then where the table is
        self._fields = self._at - self._number("i", self._at)
        self._n_fields = (self._number("H", self._fields) - 4) // 2

    def scalar(self, field: int, code: str, default: int) -> int:
        """A number."""
        at = self._place(field)
        return self._number(code, at) if at else default

    def vector(self, field: int, itemsize: int) -> memoryview:
        """The bytes of a vector, or of a string."""
        at = self._place(field)
        if not at:
            return memoryview(b"")
        at += self._number("I", at)
        size = self._number("I", at) * itemsize
        if size > len(self._data) - at - 4:
            raise ValueError(f"a vector of {size} bytes at byte {at} of {len(self._data)}")
        return memoryview(self._data)[at + 4 : at + 4 + size]

    def _place(self, field: int) -> int:
        if field >= self._n_fields:
            return 0
        offset = self._number("H", self._fields + 4 + 2 * field)
        return self._at + offset if offset else 0

    def _number(self, code: str, at: int) -> int:
        if not 0 <= at <= len(self._data) - struct.calcsize(code):
            raise ValueError(f"an offset to byte {at} of {len(self._data)}")
        (value,) = struct.unpack_from(f"<{code}", self._data, at)
        return int(value)


def open_aedat4(path: Path, head: bytes, options: TableOptions) -> Contents:
    """The event stream that is there, or the one of several that is chosen."""
    with path.open("rb") as raw:
        header = _header(path, raw)
    events = {number: stream for number, stream in header.streams.items() if stream.kind == "EVTS"}
    names = tuple(stream.name or str(number) for number, stream in events.items())
    if len(set(names)) < len(names):
        names = tuple(str(number) for number in events)
    number, stream = [*events.items()][chosen_stream(path, names, options.stream)]
    resolution = None if options.resolution else checked_resolution(path, stream.height, stream.width)
    return Contents(partial(_read_aedat4, path, header, number), resolution, header.start, names)


def _read_aedat4(path: Path, header: _Header, number: int, losses: Losses) -> Iterator[Events]:
    """Packets of one event stream; where one is damaged, those before it are kept."""
    n = 0
    budget = Budget(path.stat().st_size)
    with path.open("rb") as raw:
        try:
            for stream, data in _packets(raw, header):
                if stream == number:
                    events = _events(_unpacked(data, header.compression, budget))
                    n += len(events)
                    yield events
        except _DAMAGE as error:
            if n == 0:
                raise InputError(f"{path}: damaged before the first event: {error}") from error
            losses.lose(0, f"everything after event {n} is lost: {error}")


def _header(path: Path, raw: BinaryIO) -> _Header:
    """Read what precedes the packets.

    Raises:
        InputError: it is cut short, damaged, or of a kind that is not known.
    """
    head = raw.read(len(_MAGIC) + 4)
    try:
        if len(head) < len(_MAGIC) + 4:
            raise ValueError(f"the file has {len(head)} bytes")
        (size,) = struct.unpack_from("<I", head, len(_MAGIC))
        if not 0 < size <= _LARGEST_HEADER:
            raise ValueError(f"a header of {size} bytes")
        table = _Table(head[-4:] + raw.read(size))
        compression = table.scalar(0, "i", 0)
        if compression not in _UNPACK:
            raise ValueError(f"compression {compression} is not known")
        streams = _streams(bytes(table.vector(2, 1)))
        return _Header(len(head) + size, table.scalar(1, "q", -1), _UNPACK[compression], streams)
    except (ValueError, LookupError, ElementTree.ParseError) as error:
        raise InputError(f"{path}: AEDAT4 header is cut short or damaged: {error}") from error


def _streams(description: bytes) -> dict[int, _Stream]:
    """The streams of an XML description: nodes of numbers, each with a type and a node `info`."""
    if b"<!" in description:  # no description has a document type, whose entities may grow without end
        raise ValueError("the description of the streams is none of DV's")
    streams = {}
    for node in ElementTree.fromstring(description.rstrip(b"\0")).iterfind("node[@name='outInfo']/node"):
        number = node.get("name", "")
        if number.isascii() and number.isdecimal() and len(number) < 10:
            streams[int(number)] = _Stream(
                _value(node, "", "typeIdentifier"),
                _value(node, "", "originalOutputName"),
                _value(node, "info", "sizeX"),
                _value(node, "info", "sizeY"),
            )
    return streams


def _value(node: ElementTree.Element, child: str, key: str) -> str:
    inner = node.find(f"node[@name='{child}']") if child else node
    found = inner.find(f"attr[@key='{key}']") if inner is not None else None
    return (found.text or "") if found is not None else ""


def _packets(raw: BinaryIO, header: _Header) -> Iterator[tuple[int, bytes]]:
    """Stream and bytes of each packet, to the index or to the end of the file."""
    raw.seek(header.start)
    while (at := raw.tell()) != header.stop:
        head = raw.read(8)
        if not head and header.stop < 0:
            return
        if len(head) < 8:
            raise ValueError(f"byte {at}: the file ends within a packet")
        stream, size = struct.unpack("<2i", head)
        if stream not in header.streams or not 0 <= size <= _LARGEST_PACKET:
            raise ValueError(f"byte {at}: stream {stream} with {size} bytes cannot be here")
        data = raw.read(size)
        if len(data) < size:
            raise ValueError(f"byte {at}: the file ends within a packet")
        yield stream, data


def _unpacked(data: bytes, compression: str, budget: Budget) -> bytes:
    if compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=_LARGEST_PACKET + 1)
    elif compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(data).read(_LARGEST_PACKET + 1)
    if len(data) > _LARGEST_PACKET:
        raise ValueError(f"a packet of more than {_LARGEST_PACKET} bytes")
    budget.take(len(data))
    return data


def _events(data: bytes) -> Events:
    """The events of one packet.

    Raises:
        ValueError: it cannot be what it says.
    """
    if len(data) < 12 or data[8:12] != b"EVTS":
        raise ValueError("a packet of events holds something else")
    table = _Table(data)
    rows = np.frombuffer(table.vector(0, _EVENT.itemsize), _EVENT)
    if (rows["t"] < 0).any():
        raise ValueError("an event before time 0")
    return make_events(rows["x"], rows["y"], rows["on"] != 0, rows["t"])
