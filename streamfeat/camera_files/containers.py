"""Containers that a library opens: HDF5 by h5py, in a process of its own.

Lives here: that process, what it tells, chunks of ECF to columns, and what becomes of a file whose process
does not end in order.
Not here: what it does with h5py (`hdf5_process`), the loop over ECF (`streamfeat.kernels.file_codes`), and
columns (`columns`).

ECF is the codec of Prophesee's own HDF5 files. No package has a decoder of it that is right: hdf5plugin 7.1
has none, and evlib 0.13.2 fails on three of four files whose chunks Prophesee's encoder wrote.
"""

import json
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

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


def open_hdf5(path: Path, head: bytes, options: TableOptions) -> Contents:
    """Find the event stream, its resolution, and what its columns are; reads the first block."""
    about: dict[str, Any] = {}
    columns: list[NDArray[Any]] = []
    try:
        for kind, data in _frames(path, options.stream):
            if kind == b"i":
                about = json.loads(data)
            elif kind == b"b":
                break
            elif kind == b"e":
                columns = _ecf_columns(data)
                break
            else:
                columns.append(np.load(BytesIO(data), allow_pickle=False))
    except _DamageError as error:
        raise InputError(f"{path}: HDF5 file is cut short or damaged: {error}") from error
    said = list(about["assumptions"])
    layout: Layout | None = None
    if columns:
        layout = layout_of(path, columns, about["names"], options, unit=about["unit"])
        said += layout.assumptions
    resolution = None
    if about["resolution"] and not options.resolution:
        resolution = checked_resolution(path, *about["resolution"])
    read = partial(_read_hdf5, path, options.stream, layout, int(about["offset"]))
    return Contents(read, resolution, 0, tuple(about["streams"]), tuple(said))


def _read_hdf5(
    path: Path, stream: str | None, layout: Layout | None, offset_us: int, losses: Losses
) -> Iterator[Events]:
    """Rows of one event stream; where a chunk is damaged, those before it are kept."""
    if layout is None:
        return
    rows = Rows(path, layout.unit, offset_us)
    columns: list[NDArray[Any]] = []
    try:
        for kind, data in _frames(path, stream):
            if kind == b"e":
                columns = _ecf_columns(data)
            if kind in b"eb":
                yield rows.events({f: columns[i] for f, i in zip("txyp", layout.order, strict=True)})
                columns = []
            elif kind == b"c":
                columns.append(np.load(BytesIO(data), allow_pickle=False))
    except _DamageError as error:
        if rows.n == 0:
            raise InputError(f"{path}: damaged before the first event: {error}") from error
        losses.lose(0, f"everything after event {rows.n} is lost: {error}")


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
    quiet = subprocess.DEVNULL
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
            process.kill()  # its output is not read any further
        raise _DamageError("the HDF5 library does not come to an end, or fails")
