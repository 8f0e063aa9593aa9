"""Containers that a library opens: HDF5 by h5py, in a process of its own.

Lives here: that process, what it tells, chunks of ECF to columns, and what becomes of a file whose process
does not end in order.
Not here: what it does with h5py (`hdf5_process`), the loop over ECF (`streamfeat.kernels.file_codes`), and
columns (`columns`).

ECF is the codec of Prophesee's own HDF5 files. No package has a decoder of it that is right: hdf5plugin 7.1
has none, and evlib 0.13.2 fails on three of four files whose chunks Prophesee's encoder wrote.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from streamfeat.camera_files.columns import Layout, Rows, layout_of
from streamfeat.camera_files.hdf5_process import FRAME, ROWS
from streamfeat.camera_files.source import Contents, Losses, TableOptions, checked_resolution, one_line
from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE, Events
from streamfeat.kernels.file_codes import ECF_PADDING, decode_ecf

__all__ = ["open_hdf5"]

_ECF_HEAD_BYTES, _ECF_MOST_EVENTS = 12, 65_535


class _DamageError(Exception):
    """The file, or what the library makes of it."""


@dataclass(slots=True)
class _Begun:
    """A process that has told what is in a file, and its first block.

    Attributes:
        about: what the file says.
        columns: of the first block; None if there is no row.
        frames: what it tells next.
        pid: of this process; after a fork none but the one before it may go on.
    """

    about: dict[str, Any]
    columns: list[NDArray[Any]] | None
    frames: Iterator[tuple[bytes, bytes]]
    pid: int


class _Stream:
    """One event stream of a file. Its process waits behind the first block until that is read.

    So that there are never many processes, only those of the latest `_MOST_WAITING` files wait; of others it
    starts anew.

    Args:
        path: of the file.
        name: of the stream; None for the only one.
    """

    def __init__(self, path: Path, name: str | None) -> None:
        self._path, self._name = path, name
        self._begun: _Begun | None = None

    def take(self) -> _Begun:
        """The process that waits, or a new one.

        Raises:
            InputError: it refuses the file.
            _DamageError: it fails before the first block.
        """
        begun, self._begun = self._begun, None
        _waiting.pop(self, None)
        if begun and begun.pid == os.getpid():
            return begun
        frames = _frames(self._path, self._name)
        _, data = next(frames)
        return _Begun(json.loads(data), next(_blocks(frames), None), frames, os.getpid())

    def keep(self, begun: _Begun) -> None:
        """Have it wait; nothing behind its first block has been read."""
        self._begun = begun
        _waiting[self] = None
        if len(_waiting) > _MOST_WAITING:
            oldest, _ = next(iter(_waiting.items()))
            del _waiting[oldest]
            oldest._begun = None


_MOST_WAITING = 4
_waiting: "WeakKeyDictionary[_Stream, None]" = WeakKeyDictionary()


def open_hdf5(path: Path, head: bytes, options: TableOptions) -> Contents:
    """Find the event stream, its resolution, and what its columns are; reads the first block."""
    stream = _Stream(path, options.stream)
    try:
        begun = stream.take()
    except _DamageError as error:
        raise InputError(f"{path}: HDF5 file is cut short or damaged, copy it anew: {error}") from error
    about = begun.about
    said = list(about["assumptions"])
    layout: Layout | None = None
    if begun.columns:
        layout = layout_of(path, begun.columns, about["names"], options, unit=about["unit"])
        said += layout.assumptions
        stream.keep(begun)
    resolution = None
    if about["resolution"] and not options.resolution:
        resolution = checked_resolution(path, *about["resolution"])
    read = partial(_read_hdf5, path, stream, layout, int(about["offset"]))
    return Contents(read, resolution, 0, tuple(about["streams"]), tuple(said))


def _read_hdf5(
    path: Path, stream: _Stream, layout: Layout | None, offset_us: int, losses: Losses
) -> Iterator[Events]:
    """Rows of one event stream; where a chunk is damaged, those before it are kept."""
    if layout is None:
        return
    rows = Rows(path, layout.unit, offset_us)
    try:
        begun = stream.take()
        events = rows.events(_named(begun.columns or [], layout))
        try:
            yield events
        except GeneratorExit:
            stream.keep(begun)
            raise
        begun.columns = None
        for columns in _blocks(begun.frames):
            yield rows.events(_named(columns, layout))
    except _DamageError as error:
        if rows.n == 0:
            raise InputError(f"{path}: damaged before the first event: {error}") from error
        losses.lose(0, f"everything after event {rows.n} is lost: {error}")


def _named(columns: list[NDArray[Any]], layout: Layout) -> dict[str, NDArray[Any]]:
    return {field: columns[i] for field, i in zip("txyp", layout.order, strict=True)}


def _blocks(frames: Iterator[tuple[bytes, bytes]]) -> Iterator[list[NDArray[Any]]]:
    """The columns of one block after the other."""
    columns: list[NDArray[Any]] = []
    for kind, data in frames:
        if kind == b"e":
            yield _ecf_columns(data)
        elif kind == b"b":
            yield columns
            columns = []
        else:
            columns.append(np.load(BytesIO(data), allow_pickle=False))


def _ecf_columns(frame: bytes) -> list[NDArray[Any]]:
    """Columns x, y, p, t of one chunk.

    Raises:
        _DamageError: the chunk is not whole, or has fewer events than rows.
    """
    (n_rows,) = ROWS.unpack_from(frame)
    data = frame[ROWS.size :]
    n = int.from_bytes(data[:4], "little") >> 2
    if len(data) < _ECF_HEAD_BYTES or not n_rows <= n <= _ECF_MOST_EVENTS:
        raise _DamageError(f"a chunk of ECF has {len(data)} bytes with {n} events for {n_rows} rows")
    events = np.zeros(n, EVENT_DTYPE)
    padded = np.zeros(len(data) + ECF_PADDING, np.uint8)
    padded[: len(data)] = np.frombuffer(data, np.uint8)
    if (used := decode_ecf(padded, len(data), events)) < 0:
        raise _DamageError(f"a chunk of ECF is damaged at its byte {-1 - used} of {len(data)}")
    return [events[name][:n_rows] for name in ("x", "y", "p", "t")]


def _frames(path: Path, stream: str | None) -> Iterator[tuple[bytes, bytes]]:
    """Frames from the other process, without the last, which tells how it ended.

    Raises:
        InputError: it refuses the file.
        _DamageError: the library gave up, or did not come to an end.
    """
    # -P: modules are not imported from the working directory.
    command = [
        sys.executable,
        "-P",
        "-m",
        "streamfeat.camera_files.hdf5_process",
        str(path.resolve()),
        stream or "",
    ]
    quiet, pid = subprocess.DEVNULL, os.getpid()
    with subprocess.Popen(command, stdin=quiet, stdout=subprocess.PIPE, stderr=quiet) as process:
        assert process.stdout
        try:
            while len(head := process.stdout.read(FRAME.size)) == FRAME.size:
                kind, length = FRAME.unpack(head)
                data = process.stdout.read(length)
                if kind == b"z":
                    return
                if kind == b"r":
                    raise InputError(f"{path}: {data.decode()}")
                if kind == b"d":
                    raise _DamageError(one_line(ValueError(data.decode())))
                yield kind, data
        finally:
            if os.getpid() == pid:
                process.kill()  # its output is not read any further
        raise _DamageError("the HDF5 library does not come to an end, or fails")
