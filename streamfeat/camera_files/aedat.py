"""AEDAT 2.0 and 3.1, the files of jAER and cAER.

Lives here: their headers, and records to events, a bounded block at a time.
Not here: AEDAT 4 (`aedat4`), and which format a file has (`event_files`).

Where the y axis begins and which polarity is ON differ between chips and tools, so what is read is said. jAER
shows a DAVIS with x mirrored and y from the bottom (`DavisBaseCamera`), as v2e writes it; eventcv 1.0.8 turns
y only. Files that name no chip, as those of CIFAR10-DVS, are read as their addresses stand.
"""

import re
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from streamfeat.camera_files.prophesee import Unwrapped, blocks_of
from streamfeat.camera_files.source import Contents, Losses, TableOptions
from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution, make_events

__all__ = ["open_aedat2", "open_aedat3"]

_CHIPS = (
    ("dvs128", (128, 128)),
    ("davis640", (480, 640)),
    ("davis346", (260, 346)),
    ("davis240", (180, 240)),
    ("davis128", (128, 128)),
    ("davis208", (192, 208)),
)
_PACKET = struct.Struct("<hhiiiiii")
_LARGEST_PACKET = 64 << 20


def _chip(header: str) -> tuple[str, Resolution | None]:
    named = re.findall(r"(?im)^#\s*(?:AEChip|Source \d+)\s*:\s*(.*)$", header)
    for name, resolution in _CHIPS:
        if any(name in line.lower() for line in named):
            return name, resolution
    return "", None


def _header(path: Path, head: bytes, end: bytes) -> tuple[str, int]:
    """Lines that begin with #, up to a line `end` where there must be one, and the byte after them."""
    start = 0
    while head.startswith(b"#", start):
        stop = head.find(b"\n", start)
        if stop < 0:
            raise InputError(f"{path}: header line at byte {start} does not end; the file is cut short")
        line, start = head[start:stop].strip(), stop + 1
        if end and line == end:
            return head[:start].decode("ascii", "replace"), start
    if end:
        raise InputError(f"{path}: its header has no line {end.decode()}; the file is cut short or damaged")
    return head[:start].decode("ascii", "replace"), start


def open_aedat2(path: Path, head: bytes, options: TableOptions) -> Contents:
    """AEDAT 2.0: big-endian addresses and microseconds."""
    header, start = _header(path, head, b"")
    chip, resolution = _chip(header)
    if chip.startswith("davis"):
        assert resolution
        said = f"AEDAT 2.0 addresses of a {chip}: x is mirrored and y from the bottom, as jAER has it"
        return Contents(partial(_read_davis, path, start, resolution), resolution, start, assumptions=(said,))
    said = "AEDAT 2.0 addresses of a DVS128, as they stand: x and y from 0, ON where bit 0 is set"
    return Contents(partial(_read_dvs128, path, start), (128, 128), start, assumptions=(said,))


def _read_dvs128(path: Path, start: int, losses: Losses) -> Iterator[Events]:
    """Address: polarity in bit 0, x in bits 1-7, y in bits 8-14; bit 15 is no pixel."""
    unwrapped = Unwrapped(32)
    for block in blocks_of(path, start, 8, losses):
        address, us = np.frombuffer(block, ">u4").reshape(-1, 2).T
        t = unwrapped(us.astype(np.int64))
        events = make_events(address >> 1 & 0x7F, address >> 8 & 0x7F, address & 1, t)
        yield events[address >> 15 == 0]


def _read_davis(path: Path, start: int, resolution: Resolution, losses: Losses) -> Iterator[Events]:
    """Address: polarity in bit 11, x in bits 12-21, y in bits 22-30; bits 31 and 10 are no pixels."""
    unwrapped = Unwrapped(32)
    height, width = resolution
    for block in blocks_of(path, start, 8, losses):
        address, us = np.frombuffer(block, ">u4").reshape(-1, 2).T
        t = unwrapped(us.astype(np.int64))
        x, y = (
            width - 1 - (address >> 12 & 0x3FF).astype(int),
            height - 1 - (address >> 22 & 0x1FF).astype(int),
        )
        # An address outside the sensor would be negative: as 65535 it is left out, and counted.
        x[x < 0], y[y < 0] = 0xFFFF, 0xFFFF
        yield make_events(x, y, address >> 11 & 1, t)[address & 0x80000400 == 0]


def open_aedat3(path: Path, head: bytes, options: TableOptions) -> Contents:
    """AEDAT 3.1: packets of one kind of event each."""
    header, start = _header(path, head, b"#!END-HEADER")
    if (form := re.search(r"(?m)^#Format:\s*(\S+)", header)) and form[1].upper() != "RAW":
        raise InputError(f"{path}: AEDAT 3 events are compressed ({form[1]:.20}); only RAW is read")
    _, resolution = _chip(header)
    return Contents(partial(_read_aedat3, path, start), resolution, start)


def _read_aedat3(path: Path, start: int, losses: Losses) -> Iterator[Events]:
    """Polarity events: u32 with valid (bit 0), ON (1), y (2-16) and x (17-31), then i32 microseconds."""
    with path.open("rb") as raw:
        raw.seek(start)
        while head := raw.read(_PACKET.size):
            at = raw.tell() - len(head)
            if len(head) < _PACKET.size:
                losses.lose(len(head), f"{len(head)} bytes at byte {at} are not a whole packet header")
                return
            kind, _, size, _, overflow, _, number, _ = _PACKET.unpack(head)
            n_bytes = size * number
            if (
                size < 1
                or number < 0
                or n_bytes > _LARGEST_PACKET
                or overflow < 0
                or (kind == 1 and size != 8)
            ):
                losses.lose(0, f"byte {at}: {number} events of {size} bytes in a packet; the rest is lost")
                return
            data = raw.read(n_bytes)
            if len(data) < n_bytes:
                rest = len(data) % size
                losses.lose(rest, f"the packet at byte {at} is cut short")
                data = data[: len(data) - rest]
            if kind != 1:
                continue
            word, us = np.frombuffer(data, "<u4").reshape(-1, 2).T
            t = (us & 0x7FFFFFFF).astype(np.int64) + (overflow << 31)
            yield make_events(word >> 17, word >> 2 & 0x7FFF, word >> 1 & 1, t)[word & 1 == 1]
