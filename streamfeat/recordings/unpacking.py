"""What is unpacked from an MCAP file, and what of it is kept, within bounds.

Lives here: unpacking a chunk, the bound of one record, and of all schemas and channels.
Not here: finding chunks and records (`records`), and the budget of a file (`streamfeat.files.budget`).
"""

import struct
import zlib
from collections.abc import Iterator

import lz4.frame
import zstandard
from mcap.records import Channel, Message, Schema

from streamfeat.files.budget import Budget
from streamfeat.recordings.losses import Losses

__all__ = ["MAX_RECORD_BYTES", "Described", "Record", "records_of_chunk"]

MAX_RECORD_BYTES = 1 << 28
_DESCRIPTION_BYTES, _DESCRIBED_BYTES = 4 << 20, 64 << 20
"""Of one schema, and of all schemas and channels of a file; that of a ROS message has some thousand."""
_CHUNK = struct.Struct("<QQQII")  # times, size and CRC of its records, length of the compression's name

Record = Schema | Channel | Message


class Described:
    """What schemas and channels have taken so far; those that are too large, or too many, are left out."""

    def __init__(self) -> None:
        """Nothing is kept."""
        self._used = 0

    def bounded(self, records: Iterator[tuple[int, Record]], losses: Losses) -> Iterator[tuple[int, Record]]:
        """Yield records, without schemas and channels for which there is no room; `losses` is changed."""
        for at, record in records:
            if not isinstance(record, Message):
                size = len(record.data) if isinstance(record, Schema) else len(record.topic)
                if size > _DESCRIPTION_BYTES or self._used + size > _DESCRIBED_BYTES:
                    losses.add("oversized", size, f"byte {at}: a schema or channel of {size} bytes")
                    continue
                self._used += size
            yield at, record


def records_of_chunk(body: memoryview, budget: Budget) -> bytes | memoryview:
    """Uncompress a chunk, never to more than it claims, and check its CRC.

    Args:
        body: of the record.
        budget: of its file; what the chunk claims is taken from it.

    Raises:
        ValueError: it is damaged, or claims too much.
        struct.error, RuntimeError, EOFError: it is damaged.
    """
    _, _, claimed, crc, name_length = _CHUNK.unpack_from(body)
    start = _CHUNK.size + name_length + 8
    (length,) = struct.unpack_from("<Q", body, start - 8)
    compression, stored = bytes(body[_CHUNK.size : start - 8]), body[start : start + length]
    if len(stored) < length:
        raise ValueError(f"the chunk claims {length} stored bytes and holds {len(stored)}")
    if claimed > MAX_RECORD_BYTES:
        raise ValueError(f"the chunk claims {claimed} bytes, the limit is {MAX_RECORD_BYTES}")
    budget.take(claimed)
    data: bytes | memoryview = stored
    if compression == b"zstd":
        # `zstandard.decompress` believes the size in the frame; the stream reader takes ours.
        try:
            data = zstandard.ZstdDecompressor().stream_reader(stored).read(claimed + 1)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from None
    elif compression == b"lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=claimed + 1)
    elif compression:
        raise ValueError(f"unknown compression {compression.decode()!r}")
    if len(data) != claimed:
        raise ValueError(f"the chunk claims {claimed} bytes and holds {len(data)}")
    if crc not in (0, zlib.crc32(data)):
        raise ValueError("the CRC of the chunk does not match")
    return data
