"""One camera file of another tool -> batches of events.

Lives here: which format a file has, its resolution, what was assumed, and its events, read lazily in batches.
Not here: the formats themselves (`prophesee`, `aedat`, `text`, ...), folders and labels
(`streamfeat.convert.datasets`), and MCAP (`streamfeat.recordings.reader`).
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from streamfeat.camera_files.aedat import open_aedat1, open_aedat2, open_aedat3
from streamfeat.camera_files.aedat4 import open_aedat4
from streamfeat.camera_files.arrays import open_numpy
from streamfeat.camera_files.containers import open_hdf5
from streamfeat.camera_files.event_stream import open_event_stream
from streamfeat.camera_files.prophesee import (
    encoding_of_header,
    open_bin40,
    open_dat,
    open_evt2,
    open_evt3,
)
from streamfeat.camera_files.source import HEAD_BYTES, Contents, TableOptions
from streamfeat.camera_files.text import open_text
from streamfeat.camera_files.vectors import open_evt4, open_evt21
from streamfeat.errors import InputError, printable
from streamfeat.events import EVENT_DTYPE, Events, Resolution

__all__ = [
    "AS_THE_FILE_SAYS",
    "EXTENSIONS",
    "FORMATS",
    "EventFile",
    "ForeignFile",
    "open_events",
    "read_events",
]

FORMATS = {
    "dat": "Prophesee .dat (CD events, version 2)",
    "bin40": "40-bit .bin (N-MNIST, N-Caltech101)",
    "evt2": "Prophesee EVT 2.0 .raw",
    "evt21": "Prophesee EVT 2.1 .raw",
    "evt3": "Prophesee EVT 3.0 .raw",
    "evt4": "Prophesee EVT 4.0 .raw",
    "aedat1": "AEDAT 1.0 .aedat (DVS128)",
    "aedat2": "AEDAT 2.0 .aedat (DVS128, DAVIS)",
    "aedat3": "AEDAT 3.1 .aedat",
    "aedat4": "AEDAT 4 .aedat4",
    "es": "Event Stream 2 .es (DVS, ATIS)",
    "hdf5": "HDF5 .h5/.hdf5 (Prophesee, DSEC, M3ED, MVSEC, e2vid, v2e)",
    "numpy": ".npz or .npy (columns or fields x, y, p, t)",
    "text": "text .txt/.csv/.tsv (t x y p)",
}
"""Formats that can be read, by the name that `open_events` takes."""

EXTENSIONS = frozenset(
    [
        ".dat",
        ".bin",
        ".raw",
        ".aedat",
        ".aedat4",
        ".es",
        ".h5",
        ".hdf5",
        ".npz",
        ".npy",
        ".txt",
        ".csv",
        ".tsv",
    ]
)
"""Endings, lower case, of files in which events are looked for."""

AS_THE_FILE_SAYS = TableOptions()
"""No options."""

_Open = Callable[[Path, bytes, TableOptions], Contents]


class EventFile:
    """A camera file, opened but not read. Iterating yields `(n,)` batches of `EVENT_DTYPE`, in stored order.

    Each iteration reads the file anew, a bounded block at a time (`.npy` and `.npz` whole).
    Events outside a resolution that the file or an option declares are left out and counted.
    """

    def __init__(self, path: Path, format: str, contents: Contents, options: TableOptions) -> None:
        """Describe the file; `open_events` finds out the arguments."""
        self.path, self.format = path, format
        self.declared: Resolution | None = options.resolution or contents.resolution
        """`(height, width)` in pixels by option or by the file, None where neither says."""
        self.start = contents.start
        """Byte at which the events begin."""
        self.streams = contents.streams
        """Names of the event streams, where the format can hold several."""
        self.labels = contents.labels
        """Labels that the file holds besides its events."""
        self.lost_bytes = 0
        """Bytes that the last iteration could not use, where that can be counted."""
        self.skipped = 0
        """Events that the last iteration left out: those outside the declared resolution."""
        self.damage: list[str] = []
        """What the last iteration left out, a line for each reason; empty for a whole file."""
        self._contents = contents
        self._guessed: Resolution | None = None

    @property
    def resolution(self) -> Resolution:
        """`(height, width)`: `declared`, else the smallest that holds all events, for which the file is read
        once from beginning to end.
        """
        if self.declared:
            return self.declared
        if self._guessed is None:
            height = width = 1
            for batch in self._contents.read(_Unheard()):
                if len(batch):
                    height = max(height, int(batch["y"].max()) + 1)
                    width = max(width, int(batch["x"].max()) + 1)
            self._guessed = height, width
        return self._guessed

    @property
    def assumptions(self) -> tuple[str, ...]:
        """One line for each thing that the file does not say and that was decided; may read the file once, as
        `resolution` does.
        """
        if self.declared:
            return self._contents.assumptions
        height, width = self.resolution
        return (
            *self._contents.assumptions,
            f"the file does not say its resolution: {width}x{height} is the smallest that holds all events; "
            "--resolution WxH sets it",
        )

    def __iter__(self) -> Iterator[Events]:
        """Read all batches.

        Raises:
            InputError: nothing more can be read, and the format does not allow to keep what came before.
        """
        return self.blocks()

    def blocks(self) -> Iterator[Events]:
        """Read all batches; see `__iter__`."""
        self.lost_bytes, self.skipped, self.damage = 0, 0, []
        try:
            for batch in self._contents.read(self):
                if self.declared is not None:
                    height, width = self.declared
                    inside = (batch["x"] < width) & (batch["y"] < height)
                    if not inside.all():
                        self.skipped += int((~inside).sum())
                        batch = batch[inside]
                yield batch
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read: {error}") from error
        if self.skipped and self.declared is not None:
            height, width = self.declared
            self.damage.append(f"{self.skipped} events outside {width}x{height} left out")

    def lose(self, n_bytes: int, why: str) -> None:
        """Note a loss while reading."""
        self.lost_bytes += n_bytes
        self.damage.append(printable(why))


class _Unheard:
    """Losses that are counted when the events are read."""

    def lose(self, n_bytes: int, why: str) -> None:
        """Nothing: see `EventFile.lose`."""


@dataclass(frozen=True, slots=True)
class ForeignFile:
    """All of one file: `events` `(n,)` of `EVENT_DTYPE`; the rest as in `EventFile`."""

    events: Events
    resolution: Resolution
    format: str
    lost_bytes: int
    damage: tuple[str, ...]


def open_events(
    path: str | Path, format: str | None = None, *, options: TableOptions = AS_THE_FILE_SAYS
) -> EventFile:
    """Open a camera file; its events are read when it is iterated.

    Args:
        path: the file.
        format: a key of `FORMATS`; None finds it from the content, then from the ending.
        options: what the file does not say, or says wrongly.

    Raises:
        InputError: no such file, an unknown format, a header that does not fit it, or several event streams
            and none chosen.
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
    return EventFile(path, format, _OPENERS[format](path, head, options), options)


def read_events(
    path: str | Path, format: str | None = None, *, options: TableOptions = AS_THE_FILE_SAYS
) -> ForeignFile:
    """Read all events of one camera file into memory; for large files iterate `open_events`.

    Args:
        path: the file.
        format: see `open_events`.
        options: see `open_events`.

    Raises:
        InputError: see `open_events` and `EventFile.__iter__`.
    """
    file = open_events(path, format, options=options)
    # As numbers: records NumPy joins field by field, in ten times the time.
    batches = [np.ascontiguousarray(batch).view(np.int64) for batch in file]
    events = np.concatenate([np.empty(0, np.int64), *batches]).view(EVENT_DTYPE)
    resolution = file.declared or (int(events["y"].max(initial=0)) + 1, int(events["x"].max(initial=0)) + 1)
    return ForeignFile(events, resolution, file.format, file.lost_bytes, tuple(file.damage))


def _find_format(path: Path, head: bytes) -> str:
    ending = path.suffix.lower()
    for magic, name in _MAGIC.items():
        if head.startswith(magic):
            return name
    if head.startswith(b"\x89MCAP0\r\n"):
        raise InputError(f"{path}: is an MCAP recording already; no conversion is needed")
    if ending in (".txt", ".csv", ".tsv"):
        return "text"
    if head.startswith((b"\x93NUMPY", b"PK\x03\x04")) and ending in (".npy", ".npz"):
        return "numpy"
    if head.startswith(b"%"):
        encoding = encoding_of_header(path, head)
        if encoding:
            return encoding
        if ending == ".dat":
            return "dat"
    if ending == ".bin":
        return "bin40"
    if ending == ".aedat" and not head.startswith(b"#!AER-DAT"):
        return "aedat1"
    if _TEXT.fullmatch(head[:1000]):
        return "text"
    if ending == ".raw":
        raise InputError(
            f"{path}: not a known event file: no header says how its events are encoded; if you know it, "
            f"put one in front: printf '%% evt 3.0\\n' | cat - {path.name} > with_header.raw"
        )
    raise InputError(f"{path}: not a known event file; known are {'; '.join(FORMATS.values())}")


_TEXT = re.compile(rb"(?:\xef\xbb\xbf)?[\t\n\r -~]*\d[\t\n\r -~]*")
"""What a file without a known ending begins with, if it is lines of numbers."""

_MAGIC = {
    b"#!AER-DAT1": "aedat1",
    b"#!AER-DAT2": "aedat2",
    b"#!AER-DAT3": "aedat3",
    b"#!AER-DAT4": "aedat4",
    b"\x89HDF\r\n\x1a\n": "hdf5",
    b"Event Stream": "es",
}

_OPENERS: dict[str, _Open] = {
    "dat": open_dat,
    "bin40": open_bin40,
    "evt2": open_evt2,
    "evt21": open_evt21,
    "evt3": open_evt3,
    "evt4": open_evt4,
    "aedat1": open_aedat1,
    "aedat2": open_aedat2,
    "aedat3": open_aedat3,
    "aedat4": open_aedat4,
    "es": open_event_stream,
    "hdf5": open_hdf5,
    "numpy": open_numpy,
    "text": open_text,
}
