"""One foreign event file -> batches of events.

Lives here: which format a file has, its resolution where it says so, and its events, read lazily in batches.
Not here: the formats themselves (`words`, `aedat4`, `containers`, `tables`), folders and labels (`datasets`),
and MCAP (`streamfeat.recordings.reader`).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from streamfeat.camera_files.aedat4 import aedat4_resolution, read_aedat4
from streamfeat.camera_files.containers import hdf5_resolution, read_hdf5
from streamfeat.camera_files.prophesee import (
    declared_resolution,
    percent_header,
    read_bin40,
    read_dat,
    read_evt2,
    read_evt3,
    start_of_dat,
)
from streamfeat.camera_files.tables import HEAD_BYTES, read_numpy, read_text, text_resolution
from streamfeat.errors import InputError, printable
from streamfeat.events import EVENT_DTYPE, Events, Resolution

__all__ = ["EXTENSIONS", "FORMATS", "EventFile", "ForeignFile", "open_events", "read_events"]

FORMATS = {
    "dat": "Prophesee .dat (CD events, version 2)",
    "bin40": "40-bit .bin (N-MNIST, N-Caltech101)",
    "evt2": "Prophesee EVT 2.0 .raw",
    "evt3": "Prophesee EVT 3.0 .raw",
    "aedat4": "AEDAT 4 .aedat4",
    "hdf5": "Prophesee HDF5 .h5/.hdf5 (CD/events)",
    "numpy": ".npz or .npy (columns or fields x, y, p, t)",
    "text": "text .txt/.csv (t x y p)",
}
"""What can be read, by the name that `open_events` takes."""

EXTENSIONS = frozenset([".dat", ".bin", ".raw", ".aedat4", ".h5", ".hdf5", ".npz", ".npy", ".txt", ".csv"])
"""Endings, lower case, of files in which events are looked for."""


class EventFile:
    """A foreign file, opened but not read. Iterating yields `(n,)` batches of `EVENT_DTYPE`, in stored order.

    Each iteration reads the file anew, a bounded block at a time (`.npy` and `.npz` whole).
    Events outside a `resolution` that the file declares are left out and counted as damage.
    """

    def __init__(self, path: Path, format: str, resolution: Resolution | None, start: int) -> None:
        """Describe the file; `open_events` finds out the arguments.

        Args:
            path: the file.
            format: a key of `FORMATS`.
            resolution: `(height, width)` in pixels, None where the file does not say.
            start: byte at which the events begin.
        """
        self.path, self.format, self.resolution, self.start = path, format, resolution, start
        self.lost_bytes = 0
        """Bytes that the last iteration could not use, where that can be counted."""
        self.damage: list[str] = []
        """What the last iteration left out, a line for each reason; empty for a whole file."""

    def __iter__(self) -> Iterator[Events]:
        """Read all batches.

        Raises:
            InputError: nothing more can be read, and the format does not allow to keep what came before.
        """
        self.lost_bytes, self.damage = 0, []
        outside = 0
        try:
            for batch in _READERS[self.format](self):
                if self.resolution is not None:
                    height, width = self.resolution
                    inside = (batch["x"] < width) & (batch["y"] < height)
                    if not inside.all():
                        outside += int((~inside).sum())
                        batch = batch[inside]
                yield batch
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read: {error}") from error
        if outside and self.resolution is not None:
            self.damage.append(f"{outside} events outside {self.resolution[1]}x{self.resolution[0]} left out")

    def lose(self, n_bytes: int, why: str) -> None:
        """Note a loss while reading."""
        self.lost_bytes += n_bytes
        self.damage.append(printable(why))


@dataclass(frozen=True, slots=True)
class ForeignFile:
    """All of one file: `events` `(n,)` of `EVENT_DTYPE`; the rest as in `EventFile`.

    Where the file does not say its resolution, `resolution` is the smallest that holds all events.
    """

    events: Events
    resolution: Resolution
    format: str
    lost_bytes: int
    damage: tuple[str, ...]


def open_events(path: str | Path, format: str | None = None) -> EventFile:
    """Open a foreign event file; its events are read when it is iterated.

    Args:
        path: the file.
        format: a key of `FORMATS`; None finds it from the content, then from the ending.

    Raises:
        InputError: no such file, an unknown format, or a header that does not fit it.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if not head:
        raise InputError(f"{path}: is empty (0 bytes); copy the file again")
    if format is None:
        format = _find_format(path, head)
    elif format not in FORMATS:
        raise InputError(f"unknown format {format!r}; known are {', '.join(FORMATS)}")
    resolution, start = None, 0
    if format in ("dat", "evt2", "evt3"):
        fields, start = percent_header(path, head)
        resolution = declared_resolution(path, fields)
        if format == "dat":
            start = start_of_dat(path, fields, head, start)
        elif fields.get("endianness", "little") != "little":
            raise InputError(f"{path}: header says {fields['endianness']} endian; only little endian is read")
    elif format == "text":
        resolution = text_resolution(path, head)
    elif format == "aedat4":
        resolution = aedat4_resolution(path)
    elif format == "hdf5":
        resolution = hdf5_resolution(path)
    return EventFile(path, format, resolution, start)


def read_events(path: str | Path, format: str | None = None) -> ForeignFile:
    """Read all events of one foreign file into memory; for large files iterate `open_events`.

    Args:
        path: the file.
        format: see `open_events`.

    Raises:
        InputError: see `open_events` and `EventFile.__iter__`.
    """
    file = open_events(path, format)
    events = np.concatenate([np.empty(0, EVENT_DTYPE), *file])
    resolution = file.resolution or (int(events["y"].max(initial=0)) + 1, int(events["x"].max(initial=0)) + 1)
    return ForeignFile(events, resolution, file.format, file.lost_bytes, tuple(file.damage))


def _find_format(path: Path, head: bytes) -> str:
    ending = path.suffix.lower()
    if ending in (".txt", ".csv"):
        return "text"
    for magic, name in ((b"#!AER-DAT4", "aedat4"), (b"\x89HDF\r\n\x1a\n", "hdf5")):
        if head.startswith(magic):
            return name
    if head.startswith((b"\x93NUMPY", b"PK\x03\x04")) and ending in (".npy", ".npz"):
        return "numpy"
    if head.startswith(b"\x89MCAP0\r\n"):
        raise InputError(f"{path}: is an MCAP recording already; no conversion is needed")
    if head.startswith(b"%"):
        fields, _ = percent_header(path, head)
        version = fields.get("format", "").split(";")[0] or "EVT" + fields.get("evt", "")
        known = {"EVT2": "evt2", "EVT2.0": "evt2", "EVT3": "evt3", "EVT3.0": "evt3"}
        if version.upper() in known:
            return known[version.upper()]
        if version != "EVT":
            raise InputError(f"{path}: events are encoded as {version}; of these, EVT2 and EVT3 are read")
        if ending == ".dat":
            return "dat"
    if ending == ".bin":
        return "bin40"
    raise InputError(f"{path}: not a known event file; known are {'; '.join(FORMATS.values())}")


_READERS: dict[str, Callable[[EventFile], Iterator[Events]]] = {
    "dat": read_dat,
    "bin40": read_bin40,
    "evt2": read_evt2,
    "evt3": read_evt3,
    "aedat4": read_aedat4,
    "hdf5": read_hdf5,
    "numpy": read_numpy,
    "text": read_text,
}
