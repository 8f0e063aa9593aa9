"""The words that sensors write: `.dat`, 40-bit `.bin`, EVT 2.0 and EVT 3.0, in files of their own.

Lives here: headers of `% key value` lines, and fixed-size records to events, a bounded block at a time.
Not here: which format a file has (`event_files`), and packets (`streamfeat.messages`).

Records of fixed size are a few lines of NumPy: 13 to 27 million events a second on two shared cores, where
packets are written at 2 to 5, so a library would buy nothing. (EVT2: faery 15, eventcv 20, expelliarmus 49;
N-CARS `.dat`: expelliarmus 67, the other two refuse its header.) EVT3 uses the decoder of packets, reading
t = TIME_HIGH << 12 | TIME_LOW as published. On recorded words where TIME_LOW steps back, expelliarmus 1.1.12
adds 4096 us at each step, beyond what the TIME_HIGH words allow, and faery 0.7.1 holds the time until it is
reached again. `tools/compare_decoders.py` prints all of this.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Protocol

import numpy as np

from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution, make_events
from streamfeat.messages.codecs import make_decoder

__all__ = [
    "BLOCK_BYTES",
    "Source",
    "checked_resolution",
    "declared_resolution",
    "percent_header",
    "read_bin40",
    "read_dat",
    "read_evt2",
    "read_evt3",
    "start_of_dat",
]

BLOCK_BYTES = 1_000_000  # a multiple of every record size: 2, 4, 5 and 8
_SENSORS = {"genx320": (320, 320), "gen3": (480, 640), "gen4": (720, 1280), "imx636": (720, 1280)}


class Source(Protocol):
    """What a reader needs to know of a file: where its events begin, and whom to tell of a loss."""

    path: Path
    start: int

    def lose(self, n_bytes: int, why: str) -> None:
        """Note that `n_bytes` could not be used, with one line that says why."""


def percent_header(path: Path, head: bytes) -> tuple[dict[str, str], int]:
    """Fields of the leading `% key value` lines, keys in lower case, and the byte after them."""
    fields: dict[str, str] = {}
    start = 0
    while head.startswith((b"% ", b"%\n"), start):
        end = head.find(b"\n", start)
        if end < 0:
            raise InputError(
                f"{path}: header line at byte {start} does not end; the file is cut short or damaged"
            )
        key, _, value = head[start + 1 : end].decode("ascii", "replace").strip().partition(" ")
        fields[key.lower()] = value.strip()
        start = end + 1
        if key == "end":
            break
    return fields, start


def declared_resolution(path: Path, fields: Mapping[str, str]) -> Resolution | None:
    """`(height, width)` of a header, else of the sensor generation it names, else None."""
    described = f"{fields.get('geometry', '')};{fields.get('format', '')}".lower()
    width, height = fields.get("width", ""), fields.get("height", "")
    if match := re.search(r"(?<!\d)(\d+)x(\d+)", described):
        width, height = match.groups()
    elif "width=" in described and "height=" in described:
        width, height = (described.partition(f"{k}=")[2].partition(";")[0] for k in ("width", "height"))
    if width or height:
        return checked_resolution(path, height, width)
    plugin = fields.get("plugin_name", "")
    return next((resolution for name, resolution in _SENSORS.items() if name in plugin), None)


def checked_resolution(path: Path, height: object, width: object) -> Resolution:
    """Make a `(height, width)` of what a header says; InputError where a side is not 1 to 32767."""
    if all(re.fullmatch(r"\d{1,5}", str(side)) and 0 < int(str(side)) <= 0x7FFF for side in (height, width)):
        return int(str(height)), int(str(width))
    raise InputError(
        f"{path}: header declares {width!s:.20} x {height!s:.20} pixels; mend the header or drop it"
    )


def start_of_dat(path: Path, fields: Mapping[str, str], head: bytes, start: int) -> int:
    """Check the two bytes after a `.dat` header: event type and size."""
    kind = head[start : start + 2]
    if len(kind) < 2 or kind[0] not in (0x00, 0x0C) or kind[1] != 8 or fields.get("version", "2") != "2":
        raise InputError(
            f"{path}: byte {start}: event type and size {kind.hex(' ') or 'missing'}, version "
            f"{fields.get('version', '2')}; only CD events (00 or 0c) of 8 bytes, version 2, are read"
        )
    return start + 2


def read_dat(file: Source) -> Iterator[Events]:
    """u32 microseconds, then u32: x in bits 0-13, y in bits 14-27, polarity above."""
    for block in _blocks(file, 8):
        t, word = np.frombuffer(block, "<u4").reshape(-1, 2).T
        yield make_events(word & 0x3FFF, word >> 14 & 0x3FFF, word >> 28 != 0, t)


def read_bin40(file: Source) -> Iterator[Events]:
    """Bytes x and y, then polarity (1 bit) and microseconds (23 bits), big-endian; Orchard et al. (2015).

    A record with y = 240 is no event (the ATIS has rows 0 to 239): it adds 2^13 us to all times after it.
    """
    overflow, previous, steps, backsteps = 0, 0, 0, 0
    for block in _blocks(file, 5):
        x, y, high, middle, low = np.frombuffer(block, "u1").reshape(-1, 5).T
        t = (high & 0x7F).astype(np.int64) << 16 | middle.astype(np.int64) << 8 | low
        is_marker = y == 240
        t += overflow + (np.cumsum(is_marker) << 13)
        overflow += int(is_marker.sum()) << 13
        events = make_events(x, y, high >> 7, t)[~is_marker]
        # The format has no mark of its own, but in anything else about every second step goes back in time.
        steps += len(events)
        backsteps += int((np.diff(events["t"], prepend=previous) < 0).sum())
        if backsteps > 1 + steps // 8:
            raise InputError(
                f"{file.path}: time goes back {backsteps} times in the first {steps} events; "
                "this is no 40-bit event file, or it is damaged"
            )
        previous = int(events["t"][-1]) if len(events) else previous
        yield events


def read_evt2(file: Source) -> Iterator[Events]:
    """u32 words (Prophesee EVT 2.0): type in bits 28-31; CD words hold 6 bits of time, x (11), y (11).

    TIME_HIGH holds 28 bits of time above those 6; its wraps are counted. Events before the first are skipped.
    """
    high, seen = 0, False
    for block in _blocks(file, 4):
        words = np.frombuffer(block, "<u4")
        kind = words >> 28
        is_high = kind == 8
        steps = np.diff((words[is_high] & 0xFFFFFFF).astype(np.int64), prepend=high & 0xFFFFFFF)
        steps[steps < -(1 << 27)] += 1 << 28
        highs = high + np.concatenate([[0], np.cumsum(steps)])
        latest = np.cumsum(is_high)
        high = int(highs[-1])
        keep = (kind <= 1) & (seen | (latest > 0))
        seen = seen or bool(is_high.any())
        word = words[keep]
        t = highs[latest[keep]] << 6 | (word >> 22 & 0x3F)
        yield make_events(word >> 11 & 0x7FF, word & 0x7FF, word >> 28, t)


def read_evt3(file: Source) -> Iterator[Events]:
    """u16 words (Prophesee EVT 3.0), read as one long packet."""
    decoder = make_decoder("evt3")
    for block in _blocks(file, 2):
        yield decoder.decode(block, 0)


def _blocks(file: Source, record: int) -> Iterator[bytes]:
    """Whole records in blocks; a partial record at the end is counted as lost."""
    with file.path.open("rb") as raw:
        raw.seek(file.start)
        while block := raw.read(BLOCK_BYTES):
            if partial := len(block) % record:
                file.lose(partial, f"{partial} bytes at byte {raw.tell() - partial} are not a whole record")
                block = block[:-partial]
            yield block
