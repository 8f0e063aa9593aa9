"""The records of an MCAP file in file order, whatever state the file is in.

Lives here: framing, chunks, checksums, finding the next chunk behind damage, and counting what was lost.
Not here: what messages mean (`streamfeat.recordings.reader`), and writing (`streamfeat.recordings.writer`).

The readers of the `mcap` package stop at the first damaged byte and believe every length they read. Here a
length is compared with the file before it is used, one record is in memory at a time, no record or
uncompressed chunk may exceed `MAX_RECORD_BYTES`, and all chunks together not the budget of a file
(`streamfeat.files.budget`). Schemas and channels, which are kept, have a bound of their own (`unpacking`).
"""

import math
import os
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Header, Message, Schema, Statistics

from streamfeat.errors import InputError
from streamfeat.files.budget import Budget
from streamfeat.files.locations import Location, open_binary
from streamfeat.recordings.losses import Losses
from streamfeat.recordings.unpacking import MAX_RECORD_BYTES, Described, Record, records_of_chunk

__all__ = [
    "MAX_RECORD_BYTES",
    "Block",
    "Losses",
    "Summary",
    "count_missing",
    "iter_messages",
    "iter_records",
    "open_mcap",
    "read_summary",
]

_MAGIC = b"\x89MCAP0\r\n"
_VERSION_AT = 5
_FRAME = struct.Struct("<BQ")
_FOOTER = struct.Struct("<BQQQI")
_SCAN_BYTES = 1 << 16
_ENDS = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}
"""Records after which no message comes, and their lengths."""

# A chunk's header is recognised by its compression name; its two lengths must then agree.
_CHUNK_HEAD = re.compile(rb"\x06(?=.{36}(?:\0\0\0\0|\x03\0\0\0lz4|\x04\0\0\0zstd))", re.DOTALL)
_CHUNK_HEAD_BYTES = 1 + 8 + 8 + 8 + 8 + 4 + 4 + 32 + 8  # with room for any name of a compression

_DAMAGE = (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError, RuntimeError, EOFError)

_MESSAGE_HEAD = struct.Struct("<HIQQ")

_NO_SCHEMA = Schema(id=0, data=b"", encoding="", name="")


class Block(NamedTuple):
    """A chunk of a file: its byte, and the earliest and latest log time in it, nanoseconds since 1970."""

    at: int
    first_ns: int
    last_ns: int


@dataclass(slots=True)
class Summary:
    """The summary at the end of an intact file."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    message_counts: dict[int, int] = field(default_factory=dict)
    """Messages of each channel id."""
    blocks: list[Block] = field(default_factory=list)  # not sorted


def open_mcap(place: Location) -> BinaryIO:
    """Open a file that begins like an MCAP file.

    Raises:
        InputError: it is missing, empty, or begins otherwise; and while a file in a store is read, the store
            does not give what is in it.
    """
    file = open_binary(place)
    try:
        magic = file.read(len(_MAGIC))
    except BaseException:
        file.close()
        raise
    # One byte may be damaged, if it is not the version: what follows has sums of its own.
    wrong = [at for at, (byte, right) in enumerate(zip(magic, _MAGIC, strict=False)) if byte != right]
    if len(magic) < len(_MAGIC) or len(wrong) > 1 or _VERSION_AT in wrong:
        file.close()
        if not magic:
            raise InputError(f"{place}: is empty (0 bytes); copy the file again")
        raise InputError(
            f"{place}: is not an MCAP recording (byte 0); `streamfeat convert` turns other formats into MCAP"
        )
    return file


def iter_messages(
    file: BinaryIO,
    known: Summary | None,
    losses: Losses,
    start: int = 0,
    end: float = math.inf,
    stop: float = math.inf,
) -> Iterator[tuple[int, Channel, Schema, Message]]:
    """Yield messages in file order, each with its byte (see `iter_records`), channel and schema.

    Args:
        file: opened by `open_mcap`.
        known: what the summary said; its channels stand in for those lost in a damaged chunk.
        losses: changed.
        start, end, stop: see `iter_records`.
    """
    schemas = {0: _NO_SCHEMA} | (known.schemas if known else {})
    channels = dict(known.channels if known else {})
    for at, record in iter_records(file, losses, start, end, stop):
        if at >= end:
            losses = Losses()
        if isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Schema):
            schemas[record.id] = record
        else:
            channel = channels.get(record.channel_id)
            schema = schemas.get(channel.schema_id) if channel else None
            if channel is None or schema is None:
                where = f"byte {at}: nothing tells what channel {record.channel_id} is"
                losses.add("unknown channel", len(record.data), where)
            else:
                yield at, channel, schema, record


def iter_records(
    file: BinaryIO, losses: Losses, start: int = 0, end: float = math.inf, stop: float = math.inf
) -> Iterator[tuple[int, Record]]:
    """Yield schemas, channels and messages in file order, each with the byte where it starts.

    Messages of a chunk carry the byte of the chunk, and their data is a view of it. Damage is skipped up to
    the next readable record or chunk and counted in `losses`, which is changed. Nothing is raised but errors
    of reading: `OSError`, or `InputError` where the file is in a store.

    Args:
        file: opened by `open_mcap`.
        losses: changed.
        start: the byte of a chunk to begin with; 0 for the first record.
        end: from this byte on losses are not counted; the reader of the next part counts them.
        stop: end at this byte.
    """
    size = file.seek(0, os.SEEK_END)
    budget, described = Budget(size), Described()
    at = trusted = max(start, len(_MAGIC))  # up to `trusted`, records start where we think they do
    while True:
        if at >= end:
            losses = Losses()
        if at >= stop:
            return
        file.seek(at)
        head = file.read(_CHUNK_HEAD_BYTES)
        if len(head) < _FRAME.size:
            losses.add("truncated", len(head), f"byte {at}: the file ends without an end-of-data record")
            return
        opcode, length = _FRAME.unpack_from(head)
        after = at + _FRAME.size + length
        if _ENDS.get(opcode) == length:
            if more := _find_chunk(file, after, size):
                losses.add("second recording", size - more, f"byte {more}: chunks of another file follow")
            return
        wrong = after > size or not _is_record(opcode, length, head)
        if wrong or (opcode == Opcode.HEADER and _swallows_a_chunk(file, at, after, size)):
            # The record before may have had a wrong length, and chunks may lie inside of it.
            following = _find_chunk(file, trusted + 1, size)
            reason = "truncated" if following is None and after > size else "damaged record"
            where = f"byte {at}: record type {opcode} with {length} bytes cannot be here"
            where += f"; the file ends at byte {size}" if after > size else ""
            start = at if following is None or following > at else trusted
            losses.add(reason, (following or size) - start, where)
            if following is None:
                if reason == "truncated" and opcode == Opcode.CHUNK:
                    file.seek(at + _FRAME.size)
                    yield from described.bounded(_cut_chunk(file.read(MAX_RECORD_BYTES), at), losses)
                return
            at = trusted = following
            continue
        trusted = at
        file.seek(at + _FRAME.size)
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK):
            pass
        elif length > MAX_RECORD_BYTES:
            losses.add("oversized", length, f"byte {at}: a record of {length} bytes")
        elif opcode == Opcode.CHUNK:
            yield from described.bounded(_chunk_records(file.read(length), at, losses, budget), losses)
            trusted = after
        else:
            yield from described.bounded(_one_record(opcode, file.read(length), at, losses), losses)
        at = after


def count_missing(summary: Summary | None, channel_id: int, seen: int, losses: Losses) -> None:
    """Count the messages of a channel that a summary promises beyond those `seen`; `losses` is changed."""
    channel = summary.channels.get(channel_id) if summary else None
    missing = summary.message_counts.get(channel_id, 0) - seen if summary else 0
    if channel and missing > 0:
        losses.add("missing message", 0, f"topic {channel.topic!r}: {missing} not found", missing)


def read_summary(file: BinaryIO) -> Summary | None:
    """Read the summary section, or give None when it is absent, damaged or not what its CRC says."""
    size = file.seek(0, os.SEEK_END)
    footer_at = size - _FOOTER.size - len(_MAGIC)
    if footer_at < len(_MAGIC):
        return None
    file.seek(footer_at)
    footer = file.read(_FOOTER.size)
    opcode, length, start, _, crc = _FOOTER.unpack(footer)
    if opcode != Opcode.FOOTER or length != _FOOTER.size - _FRAME.size or file.read(len(_MAGIC)) != _MAGIC:
        return None
    if not len(_MAGIC) <= start < footer_at or footer_at - start > MAX_RECORD_BYTES:
        return None
    file.seek(start)
    section = file.read(footer_at - start)
    if crc not in (0, zlib.crc32(footer[:-4], zlib.crc32(section))):
        return None
    return _parse_summary(section)


def _parse_summary(section: bytes) -> Summary | None:
    summary = Summary()
    at = 0
    try:
        while at < len(section):
            opcode, length = _FRAME.unpack_from(section, at)
            at += _FRAME.size + length
            body = ReadDataStream(BytesIO(section[at - length : at]))
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(body)
                summary.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(body)
                summary.channels[channel.id] = channel
            elif opcode == Opcode.STATISTICS:
                summary.message_counts = Statistics.read(body).channel_message_counts
            elif opcode == Opcode.CHUNK_INDEX:
                index = ChunkIndex.read(body)
                times = index.message_start_time, index.message_end_time
                summary.blocks.append(Block(index.chunk_start_offset, *times))
    except _DAMAGE:
        return None
    return summary if summary.channels else None


def _one_record(
    opcode: int, body: bytes | memoryview, at: int, losses: Losses
) -> Iterator[tuple[int, Record]]:
    record: Record
    try:
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(body)
            data = memoryview(body)[_MESSAGE_HEAD.size :]
            record = Message(channel, log_time, data, publish_time, sequence)  # type: ignore[arg-type]
        elif opcode == Opcode.CHANNEL:
            record = Channel.read(ReadDataStream(BytesIO(body)))
        else:
            record = Schema.read(ReadDataStream(BytesIO(body)))
    except _DAMAGE as error:
        losses.add("damaged record", len(body), f"byte {at}: {error or type(error).__name__}")
    else:
        yield at, record


def _chunk_records(body: bytes, at: int, losses: Losses, budget: Budget) -> Iterator[tuple[int, Record]]:
    try:
        data = records_of_chunk(memoryview(body), budget)
    except _DAMAGE as error:
        losses.add("damaged chunk", len(body), f"byte {at}: {error or type(error).__name__}")
        return
    inner, view = 0, memoryview(data)
    while inner < len(data):
        start = inner + _FRAME.size
        opcode, length = _FRAME.unpack_from(data, inner) if start <= len(data) else (0, 0)
        if opcode == 0 or start + length > len(data):
            losses.add("damaged chunk", len(data) - inner, f"byte {at}: record {inner} bytes in does not fit")
            return
        inner = start + length
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            yield from _one_record(opcode, view[start:inner], at, losses)


def _cut_chunk(body: bytes, at: int) -> Iterator[tuple[int, Record]]:
    """The whole records of an uncompressed chunk that the end of the file cuts short."""
    if body[28:32] == bytes(4):  # no compression
        inner, view = 40, memoryview(body)
        while inner + _FRAME.size <= len(body):
            opcode, length = _FRAME.unpack_from(body, inner)
            start, inner = inner + _FRAME.size, inner + _FRAME.size + length
            if inner <= len(body) and opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                yield from _one_record(opcode, view[start:inner], at, Losses())


def _find_chunk(file: BinaryIO, start: int, size: int) -> int | None:
    """Find the next byte where a whole chunk starts."""
    for window in range(start, size, _SCAN_BYTES):
        file.seek(window)
        block = file.read(_SCAN_BYTES + _CHUNK_HEAD_BYTES)
        for match in _CHUNK_HEAD.finditer(block):
            at = window + match.start()
            length = _chunk_length(block, match.start())
            if length is not None and at + _FRAME.size + length <= size:
                return at
    return None


def _swallows_a_chunk(file: BinaryIO, at: int, end: int, size: int) -> bool:
    """Whether a file's header is longer than its two strings, so that stepping over it leaves out a chunk."""
    file.seek(at + _FRAME.size)
    body = file.read(min(end - at - _FRAME.size, _SCAN_BYTES))
    stream = ReadDataStream(BytesIO(body))
    with suppress(*_DAMAGE):
        Header.read(stream)
        if stream.count == len(body):
            return False
    following = _find_chunk(file, at + 1, size)
    return following is not None and following < end


def _is_record(opcode: int, length: int, head: bytes) -> bool:
    """Whether a record may start with these bytes; types above 0x80 are private to their writer."""
    if opcode == Opcode.CHUNK:
        return _chunk_length(head, 0) == length
    is_index = _is_index(length, head)
    if opcode == Opcode.MESSAGE_INDEX:
        return is_index
    if is_index and opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
        return False  # nor make a message of what is none
    # A damaged type must not end the file early, nor pass a chunk for something to step over.
    if opcode in _ENDS or _chunk_length(head, 0) == length:
        return False
    return Opcode.HEADER <= opcode < Opcode.DATA_END or opcode >= 0x80


def _is_index(length: int, head: bytes) -> bool:
    """Whether a record has the shape of a message index: a length that agrees, an offset that may be one."""
    if length < 6 or len(head) < 31:
        return False
    (size,) = struct.unpack_from("<I", head, 11)
    (offset,) = struct.unpack_from("<Q", head, 23) if size else (0,)
    return bool(length == 6 + size and size % 16 == 0 and offset <= MAX_RECORD_BYTES)


def _chunk_length(block: bytes, at: int) -> int | None:
    """Length of the chunk whose header is at this place of a block, when both its lengths agree."""
    if at + 41 > len(block):
        return None
    (length,) = struct.unpack_from("<Q", block, at + 1)
    (name_length,) = struct.unpack_from("<I", block, at + 37)
    if at + 49 + name_length > len(block):
        return None
    (data_length,) = struct.unpack_from("<Q", block, at + 41 + name_length)
    return int(length) if length == 40 + name_length + data_length else None
