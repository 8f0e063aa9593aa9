"""Event Stream, the `.es` files of loris, faery and other tools of neuromorphic vision.

Lives here: the header, and bytes to events, a bounded block at a time.
Not here: the loop over the bytes (`streamfeat.kernels.file_codes`), and which format a file has
(`event_files`).

The description (github.com/neuromorphic-paris/event_stream, version 2) does not say where y begins. Its
authors count from the bottom, and turn it in their reader, faery: so does this one, and says it.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from streamfeat.camera_files.source import BLOCK_BYTES, Contents, Losses, TableOptions, checked_resolution
from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE, Events
from streamfeat.kernels.file_codes import decode_event_stream

__all__ = ["open_event_stream"]

_HEADER_BYTES = 20
_KINDS = {0: "generic events", 1: "DVS events", 2: "ATIS events", 3: "display events", 4: "color events"}
_DVS, _ATIS = 1, 2
_EVENT_BYTES = 5


def open_event_stream(path: Path, head: bytes, options: TableOptions) -> Contents:
    """DVS events, or those of an ATIS without its exposure measurements."""
    if len(head) < _HEADER_BYTES:
        raise InputError(
            f"{path}: its header has {len(head)} of {_HEADER_BYTES} bytes; the file is cut short"
        )
    version, kind = head[12:15], head[15]
    if version[0] != 2:
        raise InputError(
            f"{path}: Event Stream version {'.'.join(map(str, version))}; only 2 is read; "
            "rewrite it with the program that made it"
        )
    if kind not in (_DVS, _ATIS):
        named = _KINDS.get(kind, f"events of kind {kind}")
        raise InputError(f"{path}: holds {named}; only DVS and ATIS events are read")
    width, height = (int.from_bytes(head[at : at + 2], "little") for at in (16, 18))
    resolution = checked_resolution(path, height, width)
    said = ["y is counted from the bottom, as faery has it"]
    if kind == _ATIS:
        said.append("exposure measurements of the ATIS are left out")
    read = partial(_read, path, kind == _ATIS, height)
    return Contents(read, resolution, _HEADER_BYTES, assumptions=tuple(said))


def _read(path: Path, is_atis: bool, height: int, losses: Losses) -> Iterator[Events]:
    """Blocks of bytes; an event that a block cuts in two is read with the next."""
    state = np.zeros(3, np.int64)
    with path.open("rb") as raw:
        raw.seek(_HEADER_BYTES)
        rest = b""
        while block := raw.read(BLOCK_BYTES):
            data = np.frombuffer(rest + block, np.uint8).copy()
            events = np.zeros(len(data) // _EVENT_BYTES, EVENT_DTYPE)
            events = events[: decode_event_stream(data, is_atis, state, events)]
            # A row outside the sensor would be negative: as 65535 it is left out, and counted.
            y = height - 1 - events["y"].astype(int)
            events["y"] = np.where(y < 0, 0xFFFF, y)
            rest = data[state[2] :].tobytes()
            yield events
        if rest:
            at = raw.tell() - len(rest)
            losses.lose(len(rest), f"{len(rest)} bytes at byte {at} are not a whole event")
