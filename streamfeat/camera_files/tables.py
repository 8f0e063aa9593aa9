"""Tables of events: text, NumPy arrays, and the checks that any columns need.

Lives here: finding the columns x, y, p, t and their units, and refusing values that are no events.
Not here: which file is a table (`streamfeat.camera_files.event_files`).
"""

import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.camera_files.prophesee import BLOCK_BYTES, Source, checked_resolution
from streamfeat.errors import InputError
from streamfeat.events import FIELD_NAMES, Events, Resolution, make_events

__all__ = [
    "HEAD_BYTES",
    "checked_events",
    "named_columns",
    "one_line",
    "read_numpy",
    "read_text",
    "text_resolution",
]

_LARGEST_UNPACKED = 2 << 30  # bytes of an .npz in memory at once
HEAD_BYTES = 65_536  # of a text file, in which its layout must show
_LARGEST = {"x": 0xFFFF, "y": 0x7FFF, "p": 1, "t": (1 << 31) * 1_000_000 - 1}


def read_text(file: Source) -> Iterator[Events]:
    """Lines of events, in blocks; half a line at the end is counted as lost."""
    with file.path.open("rb") as raw:
        layout = _text_layout(file.path, raw.read(HEAD_BYTES))
        raw.seek(0)
        skip, n, rest = layout.skip, 0, b""
        while block := raw.read(BLOCK_BYTES):
            whole, newline, rest = (rest + block).rpartition(b"\n")
            if not newline and len(rest) > BLOCK_BYTES:
                raise InputError(
                    f"{file.path}: byte {raw.tell() - len(rest)}: no end of line; this is not event text"
                )
            lines = [line for line in whole.decode("ascii", "replace").splitlines() if not _is_comment(line)]
            lines, skip = lines[skip:], max(0, skip - len(lines))
            if lines:
                yield _text_events(file.path, n, lines, layout)
                n += len(lines)
        last = rest.decode("ascii", "replace")
        if _is_comment(last):
            return
        if len(last.replace(",", " ").split()) <= max(layout.order):
            file.lose(len(rest), f"{len(rest)} bytes at byte {raw.tell() - len(rest)} are not a whole line")
        else:
            yield _text_events(file.path, n, [last], layout)


def read_numpy(file: Source) -> Iterator[Events]:
    """Columns of an `.npz`, or the fields of one structured array; float times are seconds."""
    try:
        with file.path.open("rb") as raw:
            loaded = np.load(raw, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                columns = {"events": loaded}
            else:
                unpacked = sum(member.file_size for member in loaded.zip.infolist())
                if unpacked > _LARGEST_UNPACKED:
                    raise ValueError(f"{unpacked} bytes when unpacked, more than {_LARGEST_UNPACKED}")
                columns = {name: loaded[name] for name in loaded.files}
                if not all(isinstance(column, np.ndarray) for column in columns.values()):
                    raise ValueError("a member is no array")
    except Exception as error:  # zip, zlib and header parsers raise a dozen unrelated types on damage
        raise InputError(
            f"{file.path}: not a readable NumPy file without pickles: {one_line(error)}"
        ) from error
    if len(columns) == 1 and (fields := next(iter(columns.values())).dtype.names) is not None:
        (table,) = columns.values()
        columns = {name: table[name] for name in fields}
    yield checked_events(file.path, 0, named_columns(file.path, columns))


def named_columns(path: Path, columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Pick the columns x, y, p, t, each `(n,)`, by their usual names; float times are seconds.

    Raises:
        InputError: one is missing, or they are not numbers of one length.
    """
    found = {k: next((columns[a] for a in names if a in columns), None) for k, names in FIELD_NAMES.items()}
    picked = {k: column for k, column in found.items() if column is not None}
    shapes = {column.shape for column in picked.values()}
    if len(picked) < 4 or len(shapes) != 1 or len(shapes.pop()) != 1:
        held = ", ".join(f"{name} {array.shape}" for name, array in columns.items())
        raise InputError(f"{path}: needs columns x, y, p, t of one length, but holds {held:.200}")
    if any(column.dtype.kind not in "biuf" for column in picked.values()):
        raise InputError(f"{path}: columns x, y, p, t must be numbers")
    if picked["t"].dtype.kind == "f":
        picked["t"] = _microseconds(picked["t"])
    return picked


def _microseconds(seconds: NDArray[Any]) -> NDArray[np.float64]:
    """Whole microseconds; infinite where there is no such time."""
    with np.errstate(over="ignore"):
        return np.rint(seconds.astype(np.float64) * 1e6)


def checked_events(path: Path, first_row: int, columns: Mapping[str, NDArray[Any]]) -> Events:
    """Make events of columns that may hold anything; polarity -1 means 0."""
    for name, column in columns.items():
        least = -1 if name == "p" else 0
        good = (column >= least) & (column <= _LARGEST[name]) & (column == np.rint(column))
        if not good.all():
            bad = int(np.argmin(good))
            raise InputError(
                f"{path}: event {first_row + bad}: {name} = {column[bad]}, but must be whole, {least} to "
                f"{_LARGEST[name]}; t is microseconds, or seconds when the first is written with a point"
            )
    return make_events(columns["x"], columns["y"], columns["p"] > 0, columns["t"])


@dataclass(frozen=True, slots=True)
class _TextLayout:
    resolution: Resolution | None
    skip: int  # lines before the first event that are no comments
    order: tuple[int, ...]  # columns of t, x, y, p
    delimiter: str | None
    in_seconds: bool


def _text_layout(path: Path, head: bytes) -> _TextLayout:
    """Look at the first lines: `width height`, or column names, then an event.

    Without names the order is `t x y p`. Times are seconds when the first one has a point or an
    exponent.
    """
    lines = [line for line in head.decode("ascii", "replace").splitlines() if not _is_comment(line)]
    resolution, order = None, (0, 1, 2, 3)
    for skip, line in enumerate(lines[:3]):
        fields = line.replace(",", " ").split()
        if len(fields) == 2 and resolution is None:
            resolution = checked_resolution(path, fields[1], fields[0])
        elif all(name.isidentifier() for name in fields):
            found = [next((fields.index(a) for a in FIELD_NAMES[k] if a in fields), -1) for k in "txyp"]
            if min(found) < 0:
                raise InputError(f"{path}: columns {line:.80} lack one of t, x, y, p")
            order = (found[0], found[1], found[2], found[3])
        else:
            time = fields[order[0]] if len(fields) > order[0] else ""
            return _TextLayout(
                resolution, skip, order, "," if "," in line else None, bool(re.search("[.eE]", time))
            )
    raise InputError(f"{path}: holds no line 't x y p' in its first {HEAD_BYTES} bytes")


def text_resolution(path: Path, head: bytes) -> Resolution | None:
    """`(height, width)` of a first line `width height`, where there is one.

    Raises:
        InputError: the first `HEAD_BYTES` bytes, `head`, do not show the layout of a table of events.
    """
    return _text_layout(path, head).resolution


def one_line(error: BaseException) -> str:
    """What a library says, however many lines it takes, as part of a one-line message."""
    return " ".join(str(error).split())[:200]


def _is_comment(line: str) -> bool:
    return not line.strip() or line.lstrip()[0] in "#%"


def _text_events(path: Path, first_row: int, lines: list[str], layout: _TextLayout) -> Events:
    try:
        with warnings.catch_warnings(action="error"):
            table = np.loadtxt(lines, np.float64, comments=None, delimiter=layout.delimiter, ndmin=2)
        t, x, y, p = (table[:, column] for column in layout.order)
    except (ValueError, IndexError, UserWarning) as error:
        raise InputError(
            f"{path}: after event {first_row}: {one_line(error)}; expected lines of numbers 't x y p'"
        ) from error
    return checked_events(
        path, first_row, {"x": x, "y": y, "p": p, "t": _microseconds(t) if layout.in_seconds else t}
    )
