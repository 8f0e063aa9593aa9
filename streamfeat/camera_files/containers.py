"""Containers that a library opens: Prophesee HDF5 by h5py, in a process of its own.

Lives here: that process, what it tells, and what becomes of a file whose process does not end in order.
Not here: what it does with h5py (`hdf5_process`), and columns (`tables`).
"""

import subprocess
import sys
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.camera_files.hdf5_process import FRAME
from streamfeat.camera_files.prophesee import Source, declared_resolution
from streamfeat.camera_files.tables import checked_events, named_columns, one_line
from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution

__all__ = ["hdf5_resolution", "read_hdf5"]


class _DamageError(Exception):
    """The file, or what the library makes of it."""


def hdf5_resolution(path: Path) -> Resolution | None:
    """`(height, width)` of the attribute `geometry`, where there is one."""
    try:
        for kind, data in _frames(path):
            if kind == b"g":
                return declared_resolution(path, {"geometry": data.decode("ascii", "replace")})
    except _DamageError as error:
        raise InputError(f"{path}: HDF5 file is cut short or damaged: {error}") from error
    return None


def read_hdf5(file: Source) -> Iterator[Events]:
    """Rows of `CD/events`; where a chunk is damaged, those before it are kept."""
    n = 0
    columns: dict[str, NDArray[Any]] = {}
    try:
        for kind, data in _frames(file.path):
            if kind == b"b":
                events = checked_events(file.path, n, named_columns(file.path, columns))
                yield events
                n += len(events)
                columns = {}
            elif kind != b"g":
                columns[kind.decode()] = np.load(BytesIO(data), allow_pickle=False)
    except _DamageError as error:
        if n == 0:
            raise InputError(f"{file.path}: damaged before the first event: {error}") from error
        file.lose(0, f"everything after event {n} is lost: {error}")


def _frames(path: Path) -> Iterator[tuple[bytes, bytes]]:
    """What the other process tells, but for how it ended.

    Raises:
        InputError: it refuses the file.
        _DamageError: the library gave up, or did not come to an end.
    """
    # -P: the folder that somebody works in is no place to import from.
    command = [sys.executable, "-P", "-m", "streamfeat.camera_files.hdf5_process", str(path.resolve())]
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
            process.kill()  # nobody reads on
        raise _DamageError("the HDF5 library does not come to an end, or fails")
