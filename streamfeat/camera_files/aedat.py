"""AEDAT 1.0, 2.0 and 3.1, the files of jAER and cAER.

Lives here: their headers, and records to events, a bounded block at a time.
Not here: AEDAT 4 (`aedat4`), and which format a file has (`event_files`).

Where the axes begin and which polarity is ON differ between chips and tools, so what is read is said.

- A DAVIS has x mirrored and y from the bottom, as jAER shows it (`DavisBaseCamera`) and v2e writes it;
  eventcv 1.0.8 turns y only.
- A DVS128 that a header names has both too, and ON where bit 0 is clear (jAER's `DVS128.Extractor`; the
  MATLAB reader of MNIST-DVS and the reader of CIFAR10-DVS in SpikingJelly agree on the polarity). The page of
  iniVation has ON where the bit is set, but jAER wrote these files.
- Files that name no chip are of jAER before 2014, or of other tools that write plain pixels; they are read as
  their addresses stand, as evlib and tonic do.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from streamfeat.camera_files.prophesee import Unwrapped, blocks_of
from streamfeat.camera_files.source import Contents, Losses, TableOptions
from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution, make_events

__all__ = ["open_aedat1", "open_aedat2", "open_aedat3"]

_CHIPS = (
    ("dvs128", (128, 128)),
    ("davis640", (480, 640)),
    ("davis346", (260, 346)),
    ("davis240", (180, 240)),
    ("davis128", (128, 128)),
    ("davis208", (192, 208)),
)
_CONTROL = re.compile(rb"[\x00-\x08\x0e-\x1f]")
_DVS128_SIDE = 128
_PACKET = struct.Struct("<hhiiiiii")
_LARGEST_PACKET = 64 << 20


def _chip(header: str) -> tuple[str, Resolution | None]:
    named = re.findall(r"(?im)^#\s*(?:AEChip|Source \d+)\s*:\s*(.*)$", header)
    for name, resolution in _CHIPS:
        if any(name in line.lower() for line in named):
            return name, resolution
    return "", None


def _header(path: Path, head: bytes, end: bytes) -> tuple[str, int]:
    """Lines that begin with #, up to a line `end` where there must be one, and the byte after them.

    The first address may begin with the byte of a #: what has control characters in it is no line.
    """
    start = 0
    while head.startswith(b"#", start):
        stop = head.find(b"\n", start)
        if _CONTROL.search(head, start, stop if stop > 0 else len(head)):
            break
        if stop < 0:
            raise InputError(f"{path}: header line at byte {start} does not end; the file is cut short")
        line, start = head[start:stop].strip(), stop + 1
        if end and line == end:
            return head[:start].decode("ascii", "replace"), start
    if end:
        raise InputError(f"{path}: its header has no line {end.decode()}; the file is cut short or damaged")
    return head[:start].decode("ascii", "replace"), start


def open_aedat1(path: Path, head: bytes, options: TableOptions) -> Contents:
    """AEDAT 1.0: big-endian addresses of 16 bits, and microseconds; the header may be missing."""
    header, start = _header(path, head, b"")
    chip, _ = _chip(header)
    if chip.startswith("davis"):
        raise InputError(f"{path}: AEDAT 1.0 addresses have 16 bits, which hold none of a {chip}")
    contents = _dvs128("1.0", ">u2", path, start, chip)
    if header.startswith("#!AER-DAT1"):
        return contents
    said = "AEDAT 1.0, because it names no version"
    return replace(contents, assumptions=(said, *contents.assumptions))


def open_aedat2(path: Path, head: bytes, options: TableOptions) -> Contents:
    """AEDAT 2.0: big-endian addresses of 32 bits, and microseconds."""
    header, start = _header(path, head, b"")
    chip, resolution = _chip(header)
    if chip.startswith("davis"):
        assert resolution
        said = f"AEDAT 2.0 addresses of a {chip}: x is mirrored and y from the bottom, as jAER has it"
        return Contents(partial(_read_davis, path, start, resolution), resolution, start, assumptions=(said,))
    return _dvs128("2.0", ">u4", path, start, chip)


def _dvs128(version: str, address: str, path: Path, start: int, chip: str) -> Contents:
    """A DVS128 as jAER shows it where `chip` names it, or its addresses as they stand."""
    said = (
        "x is mirrored, y from the bottom, and ON where bit 0 is clear, as jAER has it"
        if chip
        else "as they stand, because the header names no chip: x and y from 0, ON where bit 0 is set"
    )
    return Contents(
        partial(_read_dvs128, path, start, np.dtype([("address", address), ("us", ">u4")]), bool(chip)),
        (_DVS128_SIDE, _DVS128_SIDE),
        start,
        assumptions=(f"AEDAT {version} addresses of a DVS128, {said}",),
    )


def _read_dvs128(
    path: Path, start: int, record: np.dtype[np.void], is_turned: bool, losses: Losses
) -> Iterator[Events]:
    """Address: polarity in bit 0, x in bits 1-7, y in bits 8-14; bit 15 is no pixel.

    Files without a version are read too, so times must show that these are records.
    """
    unwrapped = Unwrapped(32)
    n = falls = 0
    for block in blocks_of(path, start, record.itemsize, losses):
        records = np.frombuffer(block, record)
        address = records["address"].astype(np.uint32)
        t = unwrapped(records["us"].astype(np.int64))
        n, falls = n + len(t), falls + int(np.count_nonzero(np.diff(t) < 0))
        if falls > 1 + n // 8:
            raise InputError(
                f"{path}: time goes back {falls} times in the first {n} events; this is no such file, or it "
                "is damaged"
            )
        x, y, p = address >> 1 & 0x7F, address >> 8 & 0x7F, address & 1
        if is_turned:
            x, y, p = _DVS128_SIDE - 1 - x, _DVS128_SIDE - 1 - y, 1 - p
        yield make_events(x, y, p, t)[address >> 15 == 0]


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
