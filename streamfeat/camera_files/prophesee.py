"""The words that sensors write: `.dat`, 40-bit `.bin`, EVT 2.0 and EVT 3.0, in files of their own.

Lives here: headers of `% key value` lines, and fixed-size records to events, a bounded block at a time.
Not here: the loops over words (`streamfeat.kernels.file_codes`), EVT 2.1 and 4.0 (`vectors`), which format a
file has (`event_files`), and packets (`streamfeat.messages`).

EVT3 uses the decoder of packets, reading t = TIME_HIGH << 12 | TIME_LOW as published. On recorded words where
TIME_LOW steps back, expelliarmus 1.1.12 adds 4096 us at each step, beyond what the TIME_HIGH words allow, and
faery 0.7.1 holds the time until it is reached again. `tools/compare_decoders.py` prints all of this.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.camera_files.source import BLOCK_BYTES, Contents, Losses, TableOptions, checked_resolution
from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE, Events, Resolution, make_events
from streamfeat.kernels.file_codes import decode_dat, decode_evt2
from streamfeat.messages.codecs import make_decoder

__all__ = [
    "HighTimes",
    "Unwrapped",
    "blocks_of",
    "declared_resolution",
    "encoding_of_header",
    "header_contents",
    "open_bin40",
    "open_dat",
    "open_evt2",
    "open_evt3",
    "percent_header",
    "resolution_of_sensor",
]

_ENCODINGS = {
    "EVT2": "evt2",
    "EVT2.0": "evt2",
    "EVT2.1": "evt21",
    "EVT21": "evt21",
    "EVT3": "evt3",
    "EVT3.0": "evt3",
    "EVT4": "evt4",
    "EVT4.0": "evt4",
}
_SENSORS = {
    "genx320": (320, 320),
    "gen3": (480, 640),
    "gen4": (720, 1280),
    "imx636": (720, 1280),
    "imx646": (720, 1280),
}
_GENERATIONS = {"320": (320, 320), "3": (480, 640), "4": (720, 1280)}


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


def encoding_of_header(path: Path, head: bytes) -> str:
    """`evt2`, `evt21`, `evt3` or `evt4` as a header says, "" where it says nothing.

    Raises:
        InputError: it names another encoding.
    """
    fields, _ = percent_header(path, head)
    version = fields.get("format", "").split(";")[0] or "EVT" + fields.get("evt", "")
    if version == "EVT":
        return ""
    if version.upper() not in _ENCODINGS:
        raise InputError(f"{path}: events are encoded as {version:.40}; EVT2, EVT2.1, EVT3 and EVT4 are read")
    return _ENCODINGS[version.upper()]


def declared_resolution(path: Path, fields: Mapping[str, str]) -> Resolution | None:
    """`(height, width)` of a header, None where it gives none."""
    described = f"{fields.get('geometry', '')};{fields.get('format', '')}".lower()
    width, height = fields.get("width", ""), fields.get("height", "")
    if match := re.search(r"(?<!\d)(\d+)x(\d+)", described):
        width, height = match.groups()
    elif "width=" in described and "height=" in described:
        width, height = (described.partition(f"{k}=")[2].partition(";")[0] for k in ("width", "height"))
    return checked_resolution(path, height, width) if width or height else None


def resolution_of_sensor(fields: Mapping[str, str]) -> tuple[Resolution, str] | None:
    """`(height, width)` of the sensor that a header names, and the field that names it."""
    for key in ("sensor_name", "plugin_name"):
        for name, resolution in _SENSORS.items():
            if name in fields.get(key, "").lower():
                return resolution, f"{key} {fields[key]:.40}"
    generation = fields.get("generation", "").partition(".")[0]
    if generation in _GENERATIONS:
        return _GENERATIONS[generation], f"generation {fields['generation']:.40}"
    return None


def header_contents(path: Path, head: bytes) -> tuple[dict[str, str], Contents]:
    """Fields of a header, and what they say of the file; its reader is still to be set."""
    fields, start = percent_header(path, head)
    resolution = declared_resolution(path, fields)
    assumptions: tuple[str, ...] = ()
    if resolution is None and (sensor := resolution_of_sensor(fields)):
        resolution, named = sensor
        assumptions = (f"resolution {resolution[1]}x{resolution[0]} is that of the sensor in '{named}'",)
    return fields, Contents(_nothing, resolution, start, assumptions=assumptions)


def _nothing(losses: Losses) -> Iterator[Events]:
    return iter(())


def open_dat(path: Path, head: bytes, options: TableOptions) -> Contents:
    """`.dat`: after the header two bytes, event type and size."""
    fields, contents = header_contents(path, head)
    start = contents.start + 2
    kind = head[contents.start : start]
    if len(kind) < 2 or kind[0] not in (0x00, 0x0C) or kind[1] != 8 or fields.get("version", "2") != "2":
        raise InputError(
            f"{path}: byte {contents.start}: event type and size {kind.hex(' ') or 'missing'}, version "
            f"{fields.get('version', '2')}; only CD events (00 or 0c) of 8 bytes, version 2, are read; "
            "write it anew with the camera's software, or give a table of x, y, p, t"
        )
    return replace(contents, start=start, read=partial(_read_dat, path, start))


def open_bin40(path: Path, head: bytes, options: TableOptions) -> Contents:
    """40-bit `.bin`, which has no header."""
    return Contents(partial(_read_bin40, path))


def open_evt2(path: Path, head: bytes, options: TableOptions) -> Contents:
    """EVT 2.0."""
    contents = _little_endian(path, head)
    return replace(contents, read=partial(_read_evt2, path, contents.start))


def open_evt3(path: Path, head: bytes, options: TableOptions) -> Contents:
    """EVT 3.0."""
    contents = _little_endian(path, head)
    return replace(contents, read=partial(_read_evt3, path, contents.start))


def _little_endian(path: Path, head: bytes) -> Contents:
    fields, contents = header_contents(path, head)
    if (order := fields.get("endianness", "little")) != "little":
        raise InputError(f"{path}: header says {order:.20} endian; only little endian is read")
    return contents


class Unwrapped:
    """Times of a counter that starts anew at `1 << bits`: only a fall of more than half of that is a wrap."""

    def __init__(self, bits: int) -> None:
        """Start with no wrap."""
        self._range, self._wraps, self._last = 1 << bits, 0, -1

    def __call__(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Go on with `(n,)` int64 counts."""
        if not len(times):
            return times
        steps = np.diff(times, prepend=times[0] if self._last < 0 else self._last)
        half = self._range // 2
        wraps = self._wraps + np.cumsum((steps < -half).astype(np.int64) - (steps > half))
        # An event from before the wrap may still come after it, but there is nothing before the first.
        np.maximum(wraps, 0, out=wraps)
        self._wraps, self._last = int(wraps[-1]), int(times[-1])
        return times + wraps * self._range


def _read_dat(path: Path, start: int, losses: Losses) -> Iterator[Events]:
    """Records of 8 bytes; their 32-bit times wrap inside the file and go on."""
    state = np.array([-1, 0])
    for block in blocks_of(path, start, 8, losses):
        records = np.frombuffer(block, "<u4").reshape(-1, 2).copy()
        events = np.zeros(len(records), EVENT_DTYPE)
        decode_dat(records, state, events)
        yield events


def _read_bin40(path: Path, losses: Losses) -> Iterator[Events]:
    """Bytes x and y, then polarity (1 bit) and microseconds (23 bits), big-endian; Orchard et al. (2015).

    A record with y = 240 is no event (the ATIS has rows 0 to 239): it adds 2^13 us to all times after it.
    """
    overflow, previous, steps, backsteps = 0, 0, 0, 0
    for block in blocks_of(path, 0, 5, losses):
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
                f"{path}: time goes back {backsteps} times in the first {steps} events; "
                "this is no 40-bit event file, or it is damaged"
            )
        previous = int(events["t"][-1]) if len(events) else previous
        yield events


def _read_evt2(path: Path, start: int, losses: Losses) -> Iterator[Events]:
    """u32 words; wraps of their TIME_HIGH are counted, events before the first are skipped."""
    state = np.array([-1, 0])
    for block in blocks_of(path, start, 4, losses):
        words = np.frombuffer(block, "<u4").copy()
        events = np.zeros(len(words), EVENT_DTYPE)
        yield events[: decode_evt2(words, state, events)]


class HighTimes:
    """TIME_HIGH of 28 bits, which holds for the words after it; its wraps are counted."""

    def __init__(self) -> None:
        """Start with no TIME_HIGH seen."""
        self._unwrapped, self._high, self._seen = Unwrapped(28), 0, False

    def __call__(
        self, is_high: NDArray[np.bool_], values: NDArray[Any]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Go on with `(n,)` words.

        Args:
            is_high: which of them are TIME_HIGH.
            values: their low 28 bits are the time.

        Returns:
            For each word the TIME_HIGH that holds, and whether there has been one.
        """
        highs = self._unwrapped((values[is_high] & 0xFFFFFFF).astype(np.int64))
        latest = np.cumsum(is_high)
        high = np.concatenate([[self._high], highs])[latest]
        known = self._seen | (latest > 0)
        self._high, self._seen = int(high[-1]) if len(high) else self._high, self._seen or bool(len(highs))
        return high, known


def _read_evt3(path: Path, start: int, losses: Losses) -> Iterator[Events]:
    """u16 words (Prophesee EVT 3.0), read as one long packet."""
    decoder = make_decoder("evt3")
    for block in blocks_of(path, start, 2, losses):
        yield decoder.decode(block, 0)


def blocks_of(path: Path, start: int, record: int, losses: Losses) -> Iterator[bytes]:
    """Whole records in blocks; a partial record at the end is counted as lost."""
    with path.open("rb") as raw:
        raw.seek(start)
        while block := raw.read(BLOCK_BYTES):
            if rest := len(block) % record:
                losses.lose(rest, f"{rest} bytes at byte {raw.tell() - rest} are not a whole record")
                block = block[:-rest]
            yield block
