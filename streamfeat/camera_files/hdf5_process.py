"""Opens a Prophesee HDF5 file for another process, and tells it what is there: rows to standard output.

Lives here: h5py, what it is asked for, and the limits on it. Imports nothing heavy: each file waits for it.
Not here: what rows mean, and what becomes of a process that does not end in order (`containers`).

The HDF5 library trusts what it reads: a few changed bytes make it loop without end. Nothing of that can be
mended from outside, so it happens here, where it costs a process.

What is written is a row of frames, each a kind (one byte), a length (int64) and so many bytes: the geometry
(`g`); for each block of rows its columns (`x`, `y`, `p`, `t`, each as `.npy`) and an end (`b`); last, one of
end of file (`z`), refused (`r`) and damaged (`d`), these with a reason.
"""

import resource
import signal
import struct
import sys
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from streamfeat.errors import InputError
from streamfeat.events import FIELD_NAMES

__all__ = ["FRAME", "serve"]

FRAME = struct.Struct("<cq")

_BLOCK_BYTES = 4 << 20
_CHUNK_BYTES = 64 << 20  # a chunk is unpacked whole; Prophesee writes 16,384 events in each
_SQUEEZE = 2048  # rows may take so many times their bytes in the file: deflate saves at most 1032
_ROOM_BYTES = 1 << 30
_OPEN_S, _BLOCK_S = 1.0, 5.0  # of the processor: a thousand times what they take


def serve(path: Path, out: BinaryIO) -> None:
    """Write the frames of one file."""
    try:
        import h5py
    except ImportError:
        _say(out, b"r", b"reading it needs h5py: pip install 'streamfeat[convert]'")
        return
    _limit(_OPEN_S)
    try:
        with h5py.File(path, "r") as root:
            dataset = _dataset(h5py, root)
            geometry = root.attrs.get("geometry", root["CD"].attrs.get("geometry", ""))
            _say(out, b"g", geometry if isinstance(geometry, bytes) else str(geometry).encode())
            step = max(1, _BLOCK_BYTES // max(dataset.dtype.itemsize, 1))
            for row in range(0, len(dataset), step):
                _limit(_BLOCK_S)
                _say_rows(out, dataset[row : row + step])
    except InputError as error:
        _say(out, b"r", str(error).encode())
    except Exception as error:  # h5py passes on whatever the HDF5 library made of the damage
        _say(out, b"d", str(error).encode("utf-8", "replace"))
    else:
        _say(out, b"z", b"")


def _limit(seconds: float) -> None:
    """End this process if it takes so long from now on, even inside of a library."""
    signal.setitimer(signal.ITIMER_PROF, seconds)


def _say(out: BinaryIO, kind: bytes, data: bytes) -> None:
    out.write(FRAME.pack(kind, len(data)) + data)
    out.flush()


def _say_rows(out: BinaryIO, rows: Any) -> None:
    for kind, names in FIELD_NAMES.items():
        for name in names:
            if name in rows.dtype.names:
                column = BytesIO()
                np.save(column, rows[name], allow_pickle=False)
                _say(out, kind.encode(), column.getvalue())
                break
    _say(out, b"b", b"")


def _dataset(h5py: Any, root: Any) -> Any:
    """`CD/events` of an open file, once it is known that it is in this file, and its codec is there.

    A dataset may say that its bytes are in any other file, and claim any number of rows that nobody wrote.
    """
    linked = any(isinstance(root.get(name, getlink=True), h5py.ExternalLink) for name in ("CD", "CD/events"))
    dataset = None if linked else root.get("CD/events")
    if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1 or dataset.dtype.names is None:
        raise InputError("has no CD/events table, so it is not a Prophesee HDF5 event file")
    if dataset.external or dataset.is_virtual or dataset.file.filename != root.filename:
        raise InputError("keeps its events in another file; convert that one")
    filters = dataset.id.get_create_plist()
    for code, name in ((f[0], f[3]) for f in map(filters.get_filter, range(filters.get_nfilters()))):
        if not h5py.h5z.filter_avail(code):
            raise InputError(
                f"is compressed with HDF5 filter {code} ({name.decode('ascii', 'replace')}), which is not "
                "installed; for ECF (36559) build github.com/prophesee-ai/hdf5_ecf and set HDF5_PLUGIN_PATH"
            )
    stored = dataset.id.get_storage_size()
    chunk_bytes = dataset.chunks[0] * dataset.dtype.itemsize if dataset.chunks else 0
    if dataset.nbytes > _SQUEEZE * stored or chunk_bytes > _CHUNK_BYTES:
        raise InputError(f"claims {len(dataset)} events in {stored} bytes, in chunks of {chunk_bytes}")
    return dataset


if __name__ == "__main__":
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_DATA, (_ROOM_BYTES, _ROOM_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    serve(Path(sys.argv[1]), sys.stdout.buffer)
