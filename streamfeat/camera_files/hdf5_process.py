"""Opens an HDF5 file for another process, and tells it what is there: rows to standard output.

Lives here: h5py, what it is asked for, and the limits on it. Imports nothing heavy: each file waits for it.
Not here: what rows mean, and what becomes of a process that does not end in order (`containers`).

The HDF5 library trusts what it reads: a few changed bytes make it loop without end. Nothing of that can be
mended from outside, so it happens here, where it costs a process.

What is written is a row of frames, each a kind (one byte), a length (int64) and so many bytes: what the file
says (`i`, JSON); for each block of rows its columns (`c`, each as `.npy`) and an end (`b`), or one chunk of
ECF as it is stored (`e`); last, one of end of file (`z`), refused (`r`) and damaged (`d`), these two with a
reason.
"""

import contextlib
import json
import math
import re
import resource
import signal
import struct
import sys
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from streamfeat.camera_files.columns import field_of, named_fields
from streamfeat.camera_files.source import chosen_stream
from streamfeat.errors import InputError
from streamfeat.files.budget import Budget

__all__ = ["ECF_FILTER", "FRAME", "ROWS", "serve"]

FRAME = struct.Struct("<cq")
ROWS = struct.Struct("<q")
"""What stands before a chunk of ECF: how many of its rows belong to the table."""
ECF_FILTER = 0x8ECF

_MOST_OBJECTS, _DEEPEST = 2_000, 5  # that are looked at to find events
_BLOCK_BYTES = 4 << 20
_CHUNK_BYTES = 64 << 20  # a chunk is unpacked whole; Prophesee writes 16,384 events in each
_ECF_BYTES = 12 + 65_535 * 9  # a chunk at its largest
_ROOM_BYTES = 1 << 30
_OPEN_S, _BLOCK_S = 1.0, 5.0  # of the processor: a thousand times what they take


def serve(path: Path, stream: str, out: BinaryIO) -> None:
    """Write the frames of one event stream, `stream` or the only one."""
    try:
        import h5py
    except ImportError:
        _say(out, b"r", b"reading it needs h5py: pip install 'streamfeat[convert]'")
        return
    _limit(_OPEN_S)
    try:
        with h5py.File(path, "r") as root:
            tables, halves = _tables(h5py, root)
            name, assumptions = _chosen(tables, halves, stream)
            datasets, names = tables[name]
            for dataset in datasets:
                _check(h5py, root, dataset)
            if len({len(dataset) for dataset in datasets}) > 1:
                raise InputError(f"{name}: its tables differ in length; the file is cut short or damaged")
            _say(out, b"i", json.dumps(_about(h5py, root, name, tables, names, assumptions)).encode())
            if _filters(datasets[0]) == [ECF_FILTER]:
                _say_chunks(out, datasets[0])
                _say(out, b"z", b"")
                return
            step = _rows_of_block(datasets)
            for row in range(0, len(datasets[0]), step):
                _limit(_BLOCK_S)
                _say_rows(out, [dataset[row : row + step] for dataset in datasets])
    except InputError as error:
        _say(out, b"r", str(error).encode())
    except Exception as error:  # h5py passes on whatever the HDF5 library made of the damage
        _say(out, b"d", str(error).encode("utf-8", "replace"))
    else:
        _say(out, b"z", b"")


def _rows_of_block(datasets: list[Any]) -> int:
    """Rows that are read at a time: whole chunks, for one that is read in parts is unpacked for each."""
    size: int = max(1, sum(dataset.dtype.itemsize * math.prod(dataset.shape[1:]) for dataset in datasets))
    length: int = max((dataset.chunks[0] for dataset in datasets if dataset.chunks), default=1)
    chunks: int = max(1, _BLOCK_BYTES // size // length)
    return max(1, min(chunks * length, _CHUNK_BYTES // size))


def _limit(seconds: float) -> None:
    """End this process if it takes so long from now on, even inside of a library."""
    signal.setitimer(signal.ITIMER_PROF, seconds)


def _say(out: BinaryIO, kind: bytes, data: bytes) -> None:
    out.write(FRAME.pack(kind, len(data)) + data)
    out.flush()


def _say_rows(out: BinaryIO, parts: list[Any]) -> None:
    """The columns of one block: fields of a table, columns of an `(n, 4)` array, or one each."""
    for part in parts:
        columns = [part[name] for name in part.dtype.names] if part.dtype.names else [*part.T]
        for column in columns if part.dtype.names or part.ndim == 2 else [part]:
            data = BytesIO()
            np.save(data, np.ascontiguousarray(column), allow_pickle=False)
            _say(out, b"c", data.getvalue())
    _say(out, b"b", b"")


def _say_chunks(out: BinaryIO, dataset: Any) -> None:
    """The chunks of a table whose only filter is ECF, each with how many of its rows are in the table."""
    length = dataset.chunks[0]
    for row in range(0, len(dataset), length):
        _limit(_BLOCK_S)
        info = dataset.id.get_chunk_info_by_coord((row,))
        if not 0 < info.size <= _ECF_BYTES or info.filter_mask:
            raise ValueError(f"a chunk of ECF of {info.size} bytes at row {row}")
        _, data = dataset.id.read_direct_chunk((row,))
        _say(out, b"e", ROWS.pack(min(length, len(dataset) - row)) + data)


def _filters(dataset: Any) -> list[int]:
    """Codes of the filters of a table, in the order in which they were applied."""
    filters = dataset.id.get_create_plist()
    return [filters.get_filter(i)[0] for i in range(filters.get_nfilters())]


_Tables = dict[str, tuple[list[Any], list[str] | None]]


def _tables(h5py: Any, root: Any) -> tuple[_Tables, list[str]]:
    """Event streams by the names of their group or table, and what lacks a part of one."""
    tables: _Tables = {}
    halves: list[str] = []
    waiting, seen = [("", root)], 0
    while waiting and seen < _MOST_OBJECTS:
        path, group = waiting.pop(0)
        found: dict[str, Any] = {}
        for key in group:
            seen += 1
            name = f"{path}/{key}".strip("/")
            if isinstance(group.get(key, getlink=True), h5py.ExternalLink):
                if key in ("CD", "events"):
                    raise InputError("keeps its events in another file; convert that one")
                continue
            thing = group.get(key)
            if isinstance(thing, h5py.Group):
                if name.count("/") < _DEEPEST:
                    waiting.append((name, thing))
            elif isinstance(thing, h5py.Dataset) and thing.dtype.names and thing.ndim == 1:
                if len(named_fields(thing.dtype.names)[0]) == 4:
                    tables[name] = [thing], [*thing.dtype.names]
            elif isinstance(thing, h5py.Dataset) and thing.ndim == 2 and thing.shape[1] == 4:
                if "event" in key.lower() or name == key:
                    tables[name] = [thing], None
            elif isinstance(thing, h5py.Dataset) and (thing.ndim == 1 or thing.shape[1:] == (1,)):
                field, _ = field_of(key)
                if field and field not in found:
                    found[field] = (key, thing)
        if len(found) == 4:
            tables[path or "events"] = [d for _, d in found.values()], [k for k, _ in found.values()]
        elif len(found) > 1:
            lacking = ", ".join(field for field in "txyp" if field not in found)
            halves.append(
                f"{path or 'the root'} has {', '.join(k for k, _ in found.values())}, but no {lacking}"
            )
    return tables, halves


def _chosen(tables: _Tables, halves: list[str], stream: str) -> tuple[str, list[str]]:
    """The name of the event stream to read, and what was assumed.

    Of a pair `left` and `right`, as MVSEC and M3ED have it, the left one is read unless another is chosen.
    """
    if not tables:
        lacks = f" ({'; '.join(halves)})" if halves else ""
        raise InputError(f"has no CD/events table, and no other layout of events that is known{lacks}")
    names = [*tables]
    if not stream and len(names) == 2 and names[0].replace("left", "right") == names[1]:
        return names[0], [f"of two cameras {names[0]} is read; --stream {names[1]} chooses the other"]
    return names[chosen_stream("it", tuple(names), stream or None)], []


def _about(
    h5py: Any, root: Any, name: str, tables: _Tables, names: list[str] | None, assumptions: list[str]
) -> dict[str, Any]:
    """What the file says of the stream, for `containers`."""
    group = root.get(name, root)
    group = group if isinstance(group, h5py.Group) else group.parent
    sizes: list[int] = []
    for holder in (group, root):
        geometry = holder.attrs.get("geometry", "")
        text = geometry.decode() if isinstance(geometry, bytes) else str(geometry)
        if match := re.fullmatch(r"\s*(\d{1,6})x(\d{1,6})\s*", text):
            sizes = sizes or [int(match[2]), int(match[1])]
        size = np.ravel(holder.attrs.get("sensor_resolution", ()))
        if len(size) == 2 and not sizes:
            sizes = [int(size[0]), int(size[1])]
    calibrated = group.get("calib/resolution")
    if isinstance(calibrated, h5py.Dataset) and calibrated.shape == (2,) and not sizes:
        sizes = [int(calibrated[1]), int(calibrated[0])]
    offset, unit = 0, "us" if name == "CD/events" else ""
    for holder in (group, root):
        table = holder.get("t_offset")
        if isinstance(table, h5py.Dataset) and table.size == 1 and not unit:
            offset, unit = int(np.ravel(table[()])[0]), "us"
            assumptions = [*assumptions, f"times are microseconds after t_offset = {offset} us, as in DSEC"]
    return {
        "streams": [*tables] if len(tables) > 1 else [],
        "names": names,
        "unit": unit,
        "offset": offset,
        "resolution": sizes,
        "assumptions": assumptions,
    }


def _check(h5py: Any, root: Any, dataset: Any) -> None:
    """Refuse a dataset that is not in this file, whose codec is missing, or that claims too much.

    A dataset may say that its bytes are in any other file, and claim rows that were never written.
    """
    if dataset.external or dataset.is_virtual or dataset.file.filename != root.filename:
        raise InputError("keeps its events in another file; convert that one")
    filters = dataset.id.get_create_plist()
    for code, name in ((f[0], f[3]) for f in map(filters.get_filter, range(filters.get_nfilters()))):
        if code == ECF_FILTER:
            if _filters(dataset) != [code] or dataset.dtype.names != ("x", "y", "p", "t"):
                raise InputError(
                    "is compressed with ECF, but is no table of x, y, p, t with this filter alone"
                )
        elif not _is_available(h5py, code):
            raise InputError(
                f"is compressed with HDF5 filter {code} ({name.decode('ascii', 'replace')}), which is not "
                "installed; pip install 'streamfeat[convert]' has Blosc, LZ4, Zstandard and others"
            )
    stored = dataset.id.get_storage_size()
    row = dataset.dtype.itemsize
    chunk_bytes = math.prod(dataset.chunks) * row if dataset.chunks else 0
    if dataset.nbytes > Budget(stored).left or chunk_bytes > _CHUNK_BYTES:
        raise InputError(f"claims {len(dataset)} events in {stored} bytes, in chunks of {chunk_bytes}")


def _is_available(h5py: Any, code: int) -> bool:
    """Whether a filter can be undone, if need be with the package that brings most of them, slow to load."""
    if not h5py.h5z.filter_avail(code):
        with contextlib.suppress(ImportError):
            import hdf5plugin  # noqa: F401  registers Blosc and others with h5py
    return bool(h5py.h5z.filter_avail(code))


if __name__ == "__main__":
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_DATA, (_ROOM_BYTES, _ROOM_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    serve(Path(sys.argv[1]), sys.argv[2], sys.stdout.buffer)
