"""Containers that a library opens: Prophesee HDF5 by h5py.

Lives here: the library, imported when a file needs it, and what it does with damage.
Not here: the words inside; the library hands out columns.
"""

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution
from streamfeat.foreign.tables import checked_events, named_columns, one_line
from streamfeat.foreign.words import Source, declared_resolution

__all__ = ["hdf5_resolution", "read_hdf5"]

_HDF5_BLOCK_BYTES = 16 << 20
_HDF5_CHUNK_BYTES = 64 << 20  # a chunk is unpacked whole; Prophesee writes 16,384 events in each
_HDF5_SQUEEZE = 2048  # rows may take so many times their bytes in the file: deflate saves at most 1032


def hdf5_resolution(path: Path) -> Resolution | None:
    """`(height, width)` of the attribute `geometry`, where there is one."""
    try:
        with _library("h5py", path).File(path, "r") as root:
            _hdf5_dataset(path, root)
            geometry = root.attrs.get("geometry", root["CD"].attrs.get("geometry", ""))
    except InputError:
        raise
    except Exception as error:  # h5py passes on whatever the HDF5 library made of the damage
        raise InputError(f"{path}: HDF5 file is cut short or damaged: {one_line(error)}") from error
    text = geometry.decode("ascii", "replace") if isinstance(geometry, bytes) else str(geometry)
    return declared_resolution(path, {"geometry": text})


def read_hdf5(file: Source) -> Iterator[Events]:
    """Rows of `CD/events`; where a chunk is damaged, those before it are kept."""
    row = 0
    try:
        with _library("h5py", file.path).File(file.path, "r") as root:
            dataset = _hdf5_dataset(file.path, root)
            step = max(1, _HDF5_BLOCK_BYTES // max(dataset.dtype.itemsize, 1))
            for row in range(0, len(dataset), step):
                rows = dataset[row : row + step]
                yield checked_events(
                    file.path, row, named_columns(file.path, {n: rows[n] for n in rows.dtype.names})
                )
    except InputError:
        raise
    except Exception as error:  # as above
        if row == 0:
            raise InputError(f"{file.path}: damaged before the first event: {one_line(error)}") from error
        file.lose(0, f"everything after event {row} is lost: {one_line(error)}")


def _hdf5_dataset(path: Path, root: Any) -> Any:
    """`CD/events` of an open file, once it is known that it is in this file, and its codec is there.

    A dataset may say that its bytes are in any other file, and may claim any number of rows that nobody wrote.
    """
    h5py = _library("h5py", path)
    linked = any(isinstance(root.get(name, getlink=True), h5py.ExternalLink) for name in ("CD", "CD/events"))
    dataset = None if linked else root.get("CD/events")
    if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1 or dataset.dtype.names is None:
        raise InputError(f"{path}: has no CD/events table, so it is not a Prophesee HDF5 event file")
    if dataset.external or dataset.is_virtual or dataset.file.filename != root.filename:
        raise InputError(f"{path}: keeps its events in another file; convert that one")
    filters = dataset.id.get_create_plist()
    for code, name in ((f[0], f[3]) for f in map(filters.get_filter, range(filters.get_nfilters()))):
        if not h5py.h5z.filter_avail(code):
            raise InputError(
                f"{path}: is compressed with HDF5 filter {code} ({name.decode('ascii', 'replace')}), "
                "which is not installed; for ECF (36559) build github.com/prophesee-ai/hdf5_ecf and set "
                "HDF5_PLUGIN_PATH"
            )
    stored = dataset.id.get_storage_size()
    chunk_bytes = dataset.chunks[0] * dataset.dtype.itemsize if dataset.chunks else 0
    if dataset.nbytes > _HDF5_SQUEEZE * stored or chunk_bytes > _HDF5_CHUNK_BYTES:
        raise InputError(
            f"{path}: claims {len(dataset)} events in {stored} bytes, in chunks of {chunk_bytes}; it is damaged"
        )
    return dataset


def _library(name: str, path: Path) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(f"{path}: reading it needs {name}: pip install 'streamfeat[convert]'") from error
