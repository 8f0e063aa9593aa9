"""Events out to the files of others: EVT3 `.raw`, Prophesee-style HDF5, NPZ, CSV; and to MCAP.

Lives here: a writer for each kind of file, all of which write in bounded memory and appear whole or not at
all.
Not here: what is written (`export`), and MCAP itself (`streamfeat.recordings.writer`).
"""

import contextlib
import tempfile
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, Literal, Protocol

import numpy as np

from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE, Events, Resolution
from streamfeat.files.atomic import is_replaced, unwritable
from streamfeat.files.outputs import OutputFile
from streamfeat.messages.codecs import EVT3_WRAP_US, encode
from streamfeat.messages.packets import Label
from streamfeat.recordings.writer import RecordingWriter

__all__ = ["KINDS", "Output", "open_output"]

_NEVER_US = 1 << 62
_LATEST_EVT3_US = 30_000_000_000  # later starts are moved: a reader would need a thousand wraps to get there
HELD_US = 100_000
"""Events that are out of order by no more than this are put in order, where a format needs that."""
_CHUNK = 16_384  # events of an HDF5 chunk, as Prophesee writes them


class Output(Protocol):
    """A file that events are written to.

    `shift_us` is what was subtracted from every time, where a format cannot hold them as they are.
    """

    shift_us: int
    holds_labels: bool

    def write(self, events: Events, resolution: Resolution) -> None:
        """Write a batch.

        Args:
            events: `(n,)` EVENT_DTYPE, not changed; n may be 0.
            resolution: `(height, width)`; but for MCAP the same in each batch.

        Raises:
            InputError: the format cannot hold them.
        """

    def label(self, label: Label) -> None:
        """Write a label, before its events, where the format has labels."""

    def finish(self) -> None:
        """Write the rest; call it last."""


class _OneSensor(ABC):
    """The common part of formats that hold one sensor and no labels.

    Where `needs_order` is set, events are put in order of time within `HELD_US`.
    """

    holds_labels = False
    needs_order = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self.shift_us = 0
        self.resolution: Resolution | None = None
        self._held = np.zeros(0, EVENT_DTYPE)
        self._written_us = -_NEVER_US

    def write(self, events: Events, resolution: Resolution) -> None:
        """See `Output.write`."""
        if self.resolution is None:
            self.resolution = resolution
            self.begin(resolution)
        elif resolution != self.resolution:
            sizes = " and ".join(f"{width}x{height}" for height, width in (self.resolution, resolution))
            raise InputError(f"{self.path}: one sensor a file, but there are {sizes}; write .mcap")
        if len(events) == 0:
            return
        height, width = resolution
        if events["x"].max() >= width or events["y"].max() >= height:
            raise InputError(f"{self.path}: an event lies outside {width}x{height}; crop, or write .mcap")
        if self.needs_order:
            self._held = np.concatenate([self._held, events])
            self._release(int(self._held["t"].max()) - HELD_US)
        else:
            self.add(events)

    def _release(self, until_us: int) -> None:
        """Write what is held of times up to `until_us`, in their order."""
        held = self._held[np.argsort(self._held["t"], kind="stable")]
        n = int(np.searchsorted(held["t"], until_us, "right"))
        ready, self._held = held[:n], held[n:]
        if n and ready["t"][0] < self._written_us:
            raise InputError(
                f"{self.path}: this format needs events in order of time, but {ready['t'][0]} us comes after "
                f"{self._written_us} us; choose one side with --start and --end, or write .mcap"
            )
        if n:
            self._written_us = int(ready["t"][-1])
            self.add(ready)

    def label(self, label: Label) -> None:  # noqa: B027  (of some formats only)
        """See `Output.label`."""

    def finish(self) -> None:
        """Write what is held, and what stands behind the last events."""
        self._release(_NEVER_US)
        self.end()

    def close(self) -> None:  # noqa: B027  (of some formats only)
        """Let go of what is open besides the file, however it ended."""

    def begin(self, resolution: Resolution) -> None:  # noqa: B027  (of some formats only)
        """Write what stands before the first events."""

    @abstractmethod
    def add(self, events: Events) -> None:
        """Write events, at least one."""

    def end(self) -> None:  # noqa: B027  (of some formats only)
        """Write what stands behind the last events."""


class Evt3Output(_OneSensor):
    """Prophesee EVT 3.0 `.raw`; 24-bit times, whose wraps a reader counts from 0."""

    needs_order = True

    def __init__(self, path: Path, file: BinaryIO) -> None:
        """Nothing is written before the first batch."""
        super().__init__(path)
        self._file = file
        self._after_us = 0

    def begin(self, resolution: Resolution) -> None:
        """See `_OneSensor.begin`."""
        height, width = resolution
        header = (
            f"% evt 3.0\n% format EVT3;height={height};width={width}\n% geometry {width}x{height}\n% end\n"
        )
        self._file.write(header.encode())

    def add(self, events: Events) -> None:
        """See `_OneSensor.add`."""
        if not self._after_us and (first_us := int(events["t"][0])) > _LATEST_EVT3_US:
            self.shift_us = first_us // EVT3_WRAP_US * EVT3_WRAP_US
        if self.shift_us:
            events = events.copy()
            events["t"] -= self.shift_us
        try:
            payload, _ = encode(events, "evt3", self._after_us)
        except InputError as error:
            raise InputError(f"{self.path}: {error}") from None
        self._file.write(payload)
        self._after_us = int(events["t"][-1])


class CsvOutput(_OneSensor):
    """Text: the names `t_us,x,y,p`, then a line for each event."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        """Write the names."""
        super().__init__(path)
        self._file = file
        file.write(b"t_us,x,y,p\n")

    def add(self, events: Events) -> None:
        """See `_OneSensor.add`."""
        columns = (events[name].tolist() for name in "txyp")
        self._file.write("".join(map("{},{},{},{}\n".format, *columns)).encode())


class NpzOutput(_OneSensor):
    """NumPy, compressed: members `x`, `y`, `p`, `t`, `t_unit` ("us") and `resolution` (height, width)."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        """Columns wait in temporary files, because a member says first how long it is."""
        super().__init__(path)
        self._file = file
        self._n = 0
        self._columns = {name: tempfile.TemporaryFile(dir=path.parent) for name in "xypt"}  # noqa: SIM115

    def add(self, events: Events) -> None:
        """See `_OneSensor.add`."""
        self._n += len(events)
        for name, column in self._columns.items():
            column.write(np.ascontiguousarray(events[name]).tobytes())

    def close(self) -> None:
        """See `_OneSensor.close`."""
        for column in self._columns.values():
            column.close()

    def end(self) -> None:
        """See `_OneSensor.end`."""
        with zipfile.ZipFile(self._file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as members:
            for name, column in self._columns.items():
                header = {"descr": EVENT_DTYPE[name].str, "fortran_order": False, "shape": (self._n,)}
                column.seek(0)
                with members.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array_header_1_0(member, header)
                    while block := column.read(1 << 20):
                        member.write(block)
            about = {"resolution": np.array(self.resolution or (0, 0)), "t_unit": np.array("us")}
            for name, array in about.items():
                with members.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, array)


class Hdf5Output(_OneSensor):
    """HDF5 with the table `CD/events`, as Metavision lays it out, but in gzip instead of its own codec."""

    needs_order = True

    def __init__(self, path: Path, file: BinaryIO) -> None:
        """Make the empty table."""
        try:
            import h5py
        except ImportError:
            raise InputError(f"{path}: writing it needs h5py: pip install 'streamfeat[convert]'") from None
        super().__init__(path)
        self._root = h5py.File(file, "w")
        self._root.attrs["version"], self._root.attrs["format"] = "1.0", "HDF5"
        options = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "track_times": False}
        self._events = self._root.create_dataset(
            "CD/events", (0,), EVENT_DTYPE, maxshape=(None,), chunks=(_CHUNK,), **options
        )

    def begin(self, resolution: Resolution) -> None:
        """See `_OneSensor.begin`."""
        self._root.attrs["geometry"] = f"{resolution[1]}x{resolution[0]}"

    def add(self, events: Events) -> None:
        """See `_OneSensor.add`."""
        n = len(self._events)
        self._events.resize((n + len(events),))
        self._events[n:] = events

    def close(self) -> None:
        """See `_OneSensor.close`; the table is whole then."""
        self._root.close()


class McapOutput:
    """A recording of this project."""

    holds_labels = True

    def __init__(self, writer: RecordingWriter) -> None:
        """Write to an open writer."""
        self._writer = writer
        self.shift_us = 0

    def write(self, events: Events, resolution: Resolution) -> None:
        """See `Output.write`."""
        self._writer.write_events(events, resolution)

    def label(self, label: Label) -> None:
        """See `Output.label`."""
        self._writer.write_label(label)

    def finish(self) -> None:
        """See `Output.finish`."""


_FOREIGN: dict[str, Callable[[Path, BinaryIO], _OneSensor]] = {
    ".raw": Evt3Output,
    ".h5": Hdf5Output,
    ".hdf5": Hdf5Output,
    ".npz": NpzOutput,
    ".csv": CsvOutput,
}

KINDS = (".mcap", *_FOREIGN)
"""Endings of files that can be written."""


@contextlib.contextmanager
def open_output(
    path: Path,
    *,
    overwrite: bool = False,
    encoding: str = "mono",
    compression: Literal["zstd", "lz4", "none"] = "zstd",
) -> Iterator[Output]:
    """A file to write events to, of the kind that its ending says; it appears when the block ends well.

    Args:
        path: the file.
        overwrite: whether an existing file may be replaced.
        encoding: of the packets in MCAP.
        compression: of the chunks in MCAP.

    Raises:
        InputError: the ending is unknown, or the file exists or cannot be written.
    """
    kind = path.suffix.lower()
    if kind not in KINDS:
        raise InputError(f"{path}: an unknown ending; files that can be written end in {', '.join(KINDS)}")
    if kind == ".mcap":
        with RecordingWriter(path, encoding=encoding, compression=compression, overwrite=overwrite) as writer:
            yield McapOutput(writer)
        return
    if not overwrite and is_replaced(path) and path.exists():
        raise InputError(f"{path}: exists already; choose another name or allow to overwrite it")
    try:
        with OutputFile(path) as whole:
            output = _FOREIGN[kind](path, whole.file)
            try:
                yield output
                output.finish()
            finally:
                output.close()
    except OSError as error:
        raise unwritable(path, error) from None
