"""Text: lines of events, with or without a header, whatever stands between the numbers.

Lives here: byte order marks, comments, headers of faery, pandas, Metavision and others, separators, quotes,
decimal commas, boolean words, and lines to columns, a bounded block at a time.
Not here: what columns mean (`columns`), and which file is text (`event_files`).
"""

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.camera_files.columns import SAMPLE_ROWS, Layout, Rows, layout_of, named_fields
from streamfeat.camera_files.source import (
    BLOCK_BYTES,
    Contents,
    Losses,
    TableOptions,
    checked_resolution,
    one_line,
)
from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution
from streamfeat.kernels.file_codes import parse_rows

__all__ = ["open_text"]

_POWERS = np.array([float(10**n) for n in range(19)])
_HEADER_LINES = 1_000  # before the first event
_TRUE = re.compile(r"(?i)\b(?:true|on|pos(?:itive)?)\b")
_FALSE = re.compile(r"(?i)\b(?:false|off|neg(?:ative)?)\b")
_WORD = re.compile(rf"{_TRUE.pattern}|{_FALSE.pattern[4:]}")
_NUMBER = re.compile(r"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?")
_SIZES = (
    re.compile(r"(?i)geometry\D{0,4}(\d+)\s*[,;x ]\s*(\d+)"),
    re.compile(r"(?i)\bwidth\W{1,3}(\d+)\W+height\W{1,3}(\d+)"),
)


@dataclass(frozen=True, slots=True)
class _Form:
    """How the lines of a file are written.

    Attributes:
        skip: lines before the first event that are no comments.
        separator: between columns, None for any white space.
        has_words: polarities are words.
        has_decimal_commas: numbers have a comma where others have a point.
        has_notes: comments stand behind numbers.
    """

    skip: int
    separator: str | None
    has_words: bool
    has_decimal_commas: bool
    has_notes: bool


def open_text(path: Path, head: bytes, options: TableOptions) -> Contents:
    """Look at the first lines: comments, `width height`, or column names, then events.

    Raises:
        InputError: they do not show the layout of a table of events.
    """
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{path}: is UTF-16 text; save it as UTF-8")
    with path.open("rb") as raw:
        block = raw.read(BLOCK_BYTES)
    lines = _lines(block)
    lines = lines if len(block) < BLOCK_BYTES else lines[:-1]
    form, names, resolution, first = _form(path, lines)
    sample = [line for line in lines[first : first + SAMPLE_ROWS] if not _is_comment(line)]
    n_columns = len(names or _split(sample[0].partition("#")[0].rstrip(" \t,;|"), form.separator))
    fields = named_fields(names)[0] if names and not options.columns else {}
    if not fields or len(fields) == 4:
        wanted = sorted(fields.values()) or list(range(n_columns))
        if len(sample) > 1 and len(_split(sample[-1], form.separator)) <= max(wanted):
            sample = sample[:-1]  # cut short
        read = dict(zip(wanted, _columns(path, 0, sample, form, wanted), strict=True))
        table = [read.get(i, np.empty(0)) for i in range(n_columns)]
    else:
        table = [np.empty(0)] * n_columns
    layout = layout_of(path, table, names, options)
    return Contents(partial(_read, path, form, layout), resolution, assumptions=layout.assumptions)


def _lines(block: bytes) -> list[str]:
    """Lines without quotes, which mean nothing around numbers and names."""
    return block.removeprefix(b"\xef\xbb\xbf").decode("utf-8", "replace").replace('"', "").splitlines()


def _form(path: Path, lines: list[str]) -> tuple[_Form, list[str] | None, Resolution | None, int]:
    """The form of the lines, the names of columns, the resolution, and the line of the first event."""
    resolution: Resolution | None = None
    names: list[str] | None = None
    skip = 0
    for at, line in enumerate(lines[:_HEADER_LINES]):
        if match := next((m for size in _SIZES if (m := size.search(line))), None):
            resolution = checked_resolution(path, match[2], match[1])
        if _is_comment(line):
            said = _names(line.lstrip(" #%/"))
            names = said if len(named_fields(said)[0]) == 4 else names
            continue
        separator = _separator(line)
        fields = _split(line.partition("#")[0].rstrip(), separator)
        if len(fields) == 2 and all(field.isdecimal() for field in fields) and resolution is None:
            resolution = checked_resolution(path, fields[1], fields[0])
        elif _are_events(fields, names):
            has_words = any(_WORD.fullmatch(field) for field in fields)
            commas = separator != "," and "," in line
            return _Form(skip, separator, has_words, commas, "#" in line), names, resolution, at
        elif skip < 3:
            names = _names(line)
            sizes = dict(re.findall(r"(?i)\b([xy])@(\d+)", line))
            if len(sizes) == 2:
                resolution = checked_resolution(path, sizes["y"], sizes["x"])
            if len(named_fields(names)[0]) < 4:
                raise InputError(f"{path}: columns {line:.80} lack one of t, x, y, p")
        else:
            break
        skip += 1
    raise InputError(f"{path}: holds no line of events 't x y p' in its first {BLOCK_BYTES} bytes")


def _are_events(fields: list[str], names: list[str] | None) -> bool:
    """Whether all fields are numbers or polarities; where columns have names, those of events alone."""
    known = named_fields(names)[0] if names else {}
    if len(known) == 4 and len(fields) > max(known.values()):
        fields = [fields[i] for i in known.values()]
    return all(_NUMBER.fullmatch(field) or _WORD.fullmatch(field) for field in fields if field)


def _names(line: str) -> list[str]:
    separator = next((c for c in ";|\t," if c in line), None)
    return [name.strip().strip("\"'") for name in line.split(separator)]


def _separator(line: str) -> str | None:
    """What stands between the fields of a line; a comma within numbers is none."""
    if found := next((c for c in ";|" if c in line), None):
        return found
    fields = line.split()
    if len(fields) > 3 and any(map(_DECIMAL_COMMA.fullmatch, fields)):
        return None if not any(field.startswith(",") or field.endswith(",") for field in fields) else ","
    return "," if "," in line else None


def _split(line: str, separator: str | None) -> list[str]:
    return [field.strip() for field in line.split(separator)]


def _is_comment(line: str) -> bool:
    return not line.strip() or line.lstrip()[0] in "#%" or line.lstrip().startswith("//")


def _columns(
    path: Path, first_row: int, lines: list[str], form: _Form, wanted: list[int]
) -> list[NDArray[Any]]:
    """The wanted columns of lines; whole numbers stay whole where float64 would not hold them."""
    if form.has_notes:
        lines = [line.partition("#")[0] for line in lines]
    if form.has_words:
        lines = [_FALSE.sub("0", _TRUE.sub("1", line)) for line in lines]
    if form.has_decimal_commas:
        lines = [line.replace(",", ".") for line in lines]
    fields = _split(lines[0], form.separator)
    kinds = ["i8" if i < len(fields) and re.fullmatch(r"[+-]?\d{10,18}", fields[i]) else "f8" for i in wanted]
    dtype = np.dtype([(f"c{i}", kind) for i, kind in zip(wanted, kinds, strict=True)])
    try:
        with warnings.catch_warnings(action="error"):
            rows = np.loadtxt(lines, dtype, comments=None, delimiter=form.separator, usecols=wanted, ndmin=1)
    except (ValueError, IndexError, UserWarning, OverflowError, DeprecationWarning) as error:
        raise InputError(
            f"{path}: after event {first_row}: {one_line(error)}; expected lines of numbers 't x y p' columns"
        ) from error
    return [rows[name] for name in dtype.names or ()]


def _plain_columns(block: bytes, form: _Form, wanted: list[int]) -> list[NDArray[Any]] | None:
    """The wanted columns where all are plain decimal numbers, None where something else is in them.

    A float is what its digits and a power of ten make, both of which are exact: the nearest one.
    """
    if form.has_words or form.has_notes or form.has_decimal_commas:
        return None
    text = np.frombuffer(block.removeprefix(b"\xef\xbb\xbf") + b"\n", np.uint8).copy()
    digits, decimals = np.empty((2, len(wanted), block.count(b"\n") + 1), np.int64)
    separator = ord(form.separator) if form.separator else 0
    n = parse_rows(text, separator, np.array(wanted), digits, decimals)
    if n <= 0:
        return None
    return [
        column[:n] / _POWERS[points[:n]] if points[:n].any() else column[:n]
        for column, points in zip(digits, decimals, strict=True)
    ]


def _read(path: Path, form: _Form, layout: Layout, losses: Losses) -> Iterator[Events]:
    """Lines of events, in blocks; half a line at the end is counted as lost."""
    rows = Rows(path, layout.unit)
    wanted = sorted(layout.order)

    def events(block: bytes) -> Events | None:
        found = _plain_columns(block, form, wanted)
        if found is None:
            lines = [line for line in _lines(block) if not _is_comment(line)]
            if not lines:
                return None
            found = _columns(path, rows.n, lines, form, wanted)
        named = dict(zip(wanted, found, strict=True))
        return rows.events({field: named[i] for field, i in zip("txyp", layout.order, strict=True)})

    with path.open("rb") as raw:
        skip, rest = form.skip, b""
        while block := raw.read(BLOCK_BYTES):
            whole, newline, rest = (rest + block.replace(b"\r", b"\n")).rpartition(b"\n")
            if not newline and len(rest) > BLOCK_BYTES:
                raise InputError(
                    f"{path}: byte {raw.tell() - len(rest)}: no end of line; this is not event text"
                )
            start = 0
            while skip and start < len(whole):
                end = whole.find(b"\n", start)
                end = end if end >= 0 else len(whole)
                skip -= not _is_comment("".join(_lines(whole[start:end])))
                start = end + 1
            if (batch := events(whole[start:])) is not None:
                yield batch
        last = "".join(_lines(rest))
        if _is_comment(last):
            return
        if len(_split(last, form.separator)) <= max(layout.order):
            losses.lose(len(rest), f"{len(rest)} bytes at byte {raw.tell() - len(rest)} are not a whole line")
        elif (batch := events(rest)) is not None:
            yield batch
