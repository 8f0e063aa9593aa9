"""Which source a path leads to.

Lives here: telling formats apart, by what a file begins with and then by its name.
Not here: reading them (`mcap_source` and its neighbours).
"""

import bz2
import glob
import gzip
import os
import re
import tempfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

import zstandard

from streamfeat.errors import InputError
from streamfeat.files.locations import Location, StoreLocation, fetched, is_folder, location_of, open_binary
from streamfeat.recordings.bags import FilesSource, assumptions_of, bag_members
from streamfeat.recordings.camera_source import CameraSource
from streamfeat.recordings.mcap_source import McapSource
from streamfeat.recordings.options import AS_IT_IS, ReadOptions
from streamfeat.recordings.records import Losses
from streamfeat.recordings.ros1_source import Ros1Source
from streamfeat.recordings.sources import Part, Source, SourceItem
from streamfeat.recordings.sqlite_source import SqliteSource

__all__ = ["RecordingPath", "open_source"]

RecordingPath = str | PathLike[str] | StoreLocation | Sequence[str | PathLike[str] | StoreLocation]
"""One place, a pattern (`drive_*.mcap`), names with commas between them, or a list of places."""

_HEAD_BYTES = 16
_MCAP, _ROS1, _SQLITE = b"\x89MCAP", b"#ROSBAG V", b"SQLite format 3\0"
_UNPACKERS: dict[bytes, Callable[[BinaryIO], Any]] = {
    b"\x28\xb5\x2f\xfd": lambda packed: zstandard.ZstdDecompressor().stream_reader(
        packed, read_across_frames=True
    ),
    b"\x1f\x8b": lambda packed: gzip.GzipFile(fileobj=packed),
    b"BZh": bz2.BZ2File,
}
"""How a file is unpacked that was compressed as a whole, by what it begins with."""
_PACKED_ENDING = re.compile(r"\.(?:zstd|zst|gz|bz2)$")
_MOST_UNPACKED = 1000
"""A compressed file may unpack to so many times its bytes, and a mebibyte; bags take 2 to 20."""
_BLOCK_BYTES = 1 << 20


def open_source(path: RecordingPath, topic: str | None = None, options: ReadOptions = AS_IT_IS) -> Source:
    """Open whatever is at a path.

    Args:
        path: see `RecordingPath`; several files are one recording.
        topic: of the events, for files that hold several streams.
        options: what a file does not say.

    Raises:
        InputError: it is missing, empty, or of no format that can be read.
    """
    opener = partial(_open_file, topic=topic, options=options)
    if isinstance(path, Sequence) and not isinstance(path, str):
        places = [location_of(place) for place in path]
        if not places:
            raise InputError("a recording needs at least one file")
        if len(places) == 1:
            return open_source(places[0], topic, options)
        return FilesSource(_all_of(places), places, opener)
    place = location_of(path)
    if is_folder(place):
        members, metadata, said = bag_members(place)
        return FilesSource(place, members, opener, metadata, said)
    if isinstance(place, Path) and not place.exists() and (listed := _listed(place)):
        return FilesSource(place, listed, opener)
    return opener(place)


def _listed(pattern: Path) -> list[Location]:
    """The files that a pattern, or a list with commas, means; empty if it is neither."""
    text = str(pattern)
    if glob.has_magic(text):
        found = sorted(pattern.parent.glob(pattern.name))
        if not found:
            raise InputError(f"{text}: no file matches this pattern")
        return [*found]
    parts = [Path(name) for name in text.split(",")]
    return [*parts] if len(parts) > 1 and all(part.exists() for part in parts) else []


def _all_of(places: Sequence[Location]) -> Path:
    """How several places are called together."""
    return Path(",".join(map(str, places)))


def _open_file(place: Location, topic: str | None, options: ReadOptions) -> Source:
    if isinstance(place, Path) and place.exists() and not place.is_file():
        raise InputError(f"{place}: is a pipe or device, and cannot be read twice; give the name of a file")
    with open_binary(place) as file:
        head = file.read(_HEAD_BYTES)
    ending = place.suffix.lower()
    if head.startswith(tuple(_UNPACKERS)):
        return _unpacked(place, head, topic, options)
    if head.startswith(_ROS1) or ending == ".bag":
        return _local(place, Ros1Source)
    if head.startswith(_SQLITE) or ending == ".db3":
        return _local(place, SqliteSource)
    # One byte of the magic may be damaged: the name then says what the file is.
    if head.startswith(_MCAP) or ending in (".mcap", ".part"):
        return McapSource(place)
    return CameraSource(place, topic, options)


class _OfCopy:
    """A source that reads a copy, which goes away with it."""

    def __init__(self, path: Location, copy: Path, source: Source, copies: ExitStack, damage: str) -> None:
        # A recording notices by itself that it is cut short; a table of events may end anywhere.
        self._damage = damage if isinstance(source, CameraSource) else ""
        self.path, self.topics = path, source.topics
        self.assumptions = [line.replace(str(copy), str(path)) for line in assumptions_of(source)]
        self._source, self._copy, self._copies = source, copy, copies

    def read(self, topic: str, part: Part, losses: Losses) -> Iterator[tuple[int, SourceItem]]:
        if self._damage:
            losses.add("damaged file", 0, self._damage)
        yield from self._source.read(topic, part, losses)
        for reason, line in losses.first.items():
            losses.first[reason] = line.replace(str(self._copy), str(self.path))

    def cuts(self) -> list[int]:
        return self._source.cuts()

    def close(self) -> None:
        self._source.close()
        self._copies.close()


def _local(place: Location, open_local: Callable[[Path], Source]) -> Source:
    """A file that only a path can be given for; of one in a store a copy is made."""
    if isinstance(place, Path):
        return open_local(place)
    with ExitStack() as copies:
        return _of_copy(place, copies.enter_context(fetched(place)), open_local, copies)


def _of_copy(
    place: Location, copy: Path, open_copy: Callable[[Path], Source], copies: ExitStack, damage: str = ""
) -> Source:
    try:
        source = open_copy(copy)
    except InputError as error:
        raise InputError(str(error).replace(str(copy), str(place))) from None
    return _OfCopy(place, copy, source, copies.pop_all(), damage)


def _unpacked(place: Location, head: bytes, topic: str | None, options: ReadOptions) -> Source:
    """A file that was compressed as a whole (rosbag2's `compression_mode: file`, `.csv.gz`), unpacked for the
    while.
    """
    opened = next(opened for magic, opened in _UNPACKERS.items() if head.startswith(magic))
    damage = ""
    with ExitStack() as copies:
        folder = copies.enter_context(tempfile.TemporaryDirectory(prefix="streamfeat-"))
        path = Path(folder, _PACKED_ENDING.sub("", place.name))
        with open_binary(place) as packed, path.open("wb") as copy:
            limit = packed.seek(0, os.SEEK_END) * _MOST_UNPACKED + _BLOCK_BYTES
            packed.seek(0)
            try:
                with opened(packed) as stream:
                    while block := stream.read1(_BLOCK_BYTES):
                        copy.write(block)
                        if copy.tell() > limit:
                            raise InputError(f"{place}: unpacks to over {_MOST_UNPACKED} times its bytes")
            except (zstandard.ZstdError, zlib.error, gzip.BadGzipFile, EOFError) as error:
                # What came before the damage is read, and counted as cut short.
                damage = f"{place}: cannot be unpacked after its byte {packed.tell()}: {error}"
            except OSError as error:
                raise InputError(
                    f"{place}: cannot be unpacked: {error.strerror or error}; is there room?"
                ) from None
        if not path.stat().st_size:
            raise InputError(f"{place}: nothing in it can be unpacked; copy the file again")
        opener = partial(_open_file, topic=topic, options=options)
        return _of_copy(place, path, opener, copies, damage)
