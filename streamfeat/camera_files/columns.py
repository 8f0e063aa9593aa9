"""Columns of a table of events: which is which, in what unit the times are, and rows to events.

Lives here: names of columns, the order and unit that values show where names do not, and refusing values
that are no events.
Not here: where the columns come from (`text`, `arrays`, `containers`).

Nothing in a table of four numbers says what they mean, so three rules decide, and each decision is said:

- order: without names, the six orders in which x stands before y are tried. Polarity is 0 and 1 or -1 and 1,
  pixels are whole, times hardly ever fall; of several that fit, the one with the fewest falls and then the
  largest times. In fewer than 50 rows a single fall says nothing. A table whose times fall at more than every
  eighth step is refused;
- unit: times with fractions are seconds, whole ones microseconds, unless that makes fewer than 100 events a
  second, fewer than any camera gives: then the next smaller unit that does not. Times since 1970 show their
  unit by their size;
- polarity: -1 is OFF. Both -1 and 0 in one file are refused.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.camera_files.source import TableOptions
from streamfeat.errors import InputError
from streamfeat.events import Events, make_events

__all__ = ["SAMPLE_ROWS", "Layout", "Rows", "field_of", "layout_of", "named_fields"]

SAMPLE_ROWS = 20_000
"""Rows from which order and unit are found."""

_NAMES = {
    "x": {
        "x",
        "xs",
        "xaddr",
        "xcoord",
        "xcoords",
        "xcoordinate",
        "xcoordinates",
        "xpos",
        "col",
        "column",
        "u",
    },
    "y": {"y", "ys", "yaddr", "ycoord", "ycoords", "ycoordinate", "ycoordinates", "ypos", "row", "v"},
    "p": {"p", "ps", "pol", "pols", "polarity", "polarities", "on", "sign", "ison"},
    "t": {"t", "ts", "time", "times", "timestamp", "timestamps", "tus", "tns", "tms"},
}
_UNIT_NAMES = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "usec", "usecs", "micros", "µs", "μs", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosecond", "nanoseconds"), "ns"),
}
_ORDERS = ("txyp", "xytp", "xypt", "tpxy", "pxyt", "ptxy")
_IN_WORDS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_NAME = re.compile(
    r"(?:event_|events?/|pixel_|addr_)?([a-z]+?)"
    r"(?:[ _]*[\[(]\s*([a-z\u00b5\u03bc]+)\s*[\])]|[ _]+([a-z\u00b5\u03bc]+))?"
)
_LEAST_RATE = 100  # events a second; of noise alone, a sensor of 128x128 pixels gives ten times as many
_LEAST_ROWS = 50  # to know a rate, or an order by its falls
_LARGEST = {"x": 0xFFFF, "y": 0x7FFF, "p": 1, "t": (1 << 31) * 1_000_000 - 1}


@dataclass(frozen=True, slots=True)
class Layout:
    """Which columns are t, x, y, p (in this order), the unit of times, and what was decided."""

    order: tuple[int, int, int, int]
    unit: str
    assumptions: tuple[str, ...]


def field_of(name: str) -> tuple[str, str]:
    """Which of t, x, y, p a column of this name is, or "", and the unit that the name says, or "".

    Case, quotes and what follows an @ (faery's `x@640`) mean nothing; a unit may follow in brackets, after an
    underscore or as a word (`timestampUs`), or stand alone.
    """
    text = name.strip().strip("\"'").strip().partition("@")[0]
    text = re.sub(r"(?<=[a-z])(?=[A-Z][a-z])", "_", text).lower()
    if len(text) > 1 and text in _UNIT_NAMES:
        return "t", _UNIT_NAMES[text]
    match = _NAME.fullmatch(text)
    if match is None:
        return "", ""
    stem, unit = match[1], _UNIT_NAMES.get(match[2] or match[3] or "", "")
    if not unit and match[3]:
        stem += match[3]  # x_coordinates, is_on
    elif not unit and match[2] and match[2] not in ("px", "pixel", "pixels", "bool"):
        return "", ""
    field = next((field for field, names in _NAMES.items() if stem in names), "")
    if field == "t" and stem in ("tus", "tns", "tms"):
        unit = stem[1:]
    return field, unit if field == "t" else ""


def named_fields(names: Sequence[str]) -> tuple[dict[str, int], str]:
    """Positions of the names that are t, x, y, p, the first of each, and the unit that is said, or "".

    Seconds and what is beyond them in columns of their own are no column of time.
    """
    fields: dict[str, int] = {}
    unit = ""
    parts = [name for name in names if field_of(name)[0] == "t" and name.strip("\"' ").lower() in _UNIT_NAMES]
    for i, name in enumerate(names):
        field, said = field_of(name)
        if field and field not in fields and (name not in parts or len(parts) == 1):
            fields[field] = i
            unit = said or unit
    return fields, unit


def layout_of(
    path: Path,
    table: Sequence[NDArray[Any]],
    names: Sequence[str] | None,
    options: TableOptions,
    *,
    unit: str = "",
) -> Layout:
    """Find out what the columns of a table are.

    Args:
        path: named in errors.
        table: four or more columns, each `(n,)` numbers, not changed; the first rows do.
        names: of the columns, None where there are none.
        options: what is known already.
        unit: of the times, where the format says it.

    Raises:
        InputError: columns are missing, or times fall in a large share of steps.
    """
    said: list[str] = []
    if options.columns:
        wanted = options.names()
        if len(wanted) > len(table):
            raise InputError(f"{path}: has {len(table)} columns, but --columns names {len(wanted)}")
        order = [wanted.index(field) for field in "txyp"]
    elif names is not None:
        fields, named_unit = named_fields(names)
        if len(fields) < 4:
            lacking = ", ".join(field for field in "txyp" if field not in fields)
            raise InputError(
                f"{path}: columns {', '.join(names):.200} lack one of t, x, y, p ({lacking}); "
                "--columns says which is which"
            )
        order, unit = [fields[field] for field in "txyp"], unit or named_unit
    else:
        first = 1 if len(table) == 5 and _is_index(table[0]) else 0
        if len(table) - first < 4:
            raise InputError(f"{path}: has {len(table)} columns; events need t, x, y and p")
        best = _fitting_order(table[first : first + 4])
        order = [first + (best or _ORDERS[0]).index(field) for field in "txyp"]
        left = ", after an index column" if first else ""
        said.append(
            f"columns are {' '.join(best or _ORDERS[0])}{left}, by their values; --columns sets the order"
        )
    _check_falls(path, table, order)
    t = np.asarray(table[order[0]])[:SAMPLE_ROWS]
    if options.time_unit:
        unit = options.time_unit
    elif not unit:
        unit, why = _unit_of(t)
        said.append(f"times are {_IN_WORDS[unit]}: {why}; --time-unit sets the unit")
    return Layout((order[0], order[1], order[2], order[3]), unit, tuple(said))


def _is_index(column: NDArray[Any]) -> bool:
    return bool(np.array_equal(column, np.arange(len(column)) + column[:1])) if len(column) > 1 else False


def _fitting_order(table: Sequence[NDArray[Any]]) -> str | None:
    """The order of four columns that their values show, None where none fits."""
    best: tuple[tuple[float, float, int], str] | None = None
    columns = [np.asarray(column)[:SAMPLE_ROWS] for column in table]
    for rank, order in enumerate(_ORDERS):
        t, x, y, p = (columns[order.index(field)] for field in "txyp")
        if not (_are_whole(x, 0, 0x7FFF) and _are_whole(y, 0, 0x7FFF) and _are_whole(p, -1, 1)):
            continue
        if t.dtype.kind not in "iuf" or not np.isfinite(t).all() or (len(t) and t.min() < 0):
            continue
        falls = _falls(t)
        if _are_many(falls, len(t)):
            continue
        said = falls if falls > 1 or len(t) >= _LEAST_ROWS else 0
        key = (said, -float(t.max(initial=0)), rank)
        if best is None or key < best[0]:
            best = key, order
    return best[1] if best else None


def _are_whole(column: NDArray[Any], least: int, largest: int) -> bool:
    return bool(((column >= least) & (column <= largest) & (column == np.rint(column))).all())


def _falls(t: NDArray[Any]) -> int:
    return int(np.count_nonzero(t[1:] < t[:-1]))


def _are_many(falls: int, n: int) -> bool:
    return falls > 1 + n // 8


def _check_falls(path: Path, table: Sequence[NDArray[Any]], order: Sequence[int]) -> None:
    """Refuse a table that is not in order of time, and say which columns would be."""
    t = np.asarray(table[order[0]])
    falls = _falls(t)
    if not _are_many(falls, len(t)):
        return
    numbers = [column for column in table if np.asarray(column).dtype.kind in "biuf"]
    first = 1 if len(numbers) == 5 and _is_index(numbers[0]) else 0
    fits = _fitting_order(numbers[first : first + 4]) if len(numbers) - first == 4 else None
    names = ",".join([*["index"] * first, *(fits or "")])
    remedy = f"--columns {names} would fit" if fits else "sort its rows by time, or name them by --columns"
    raise InputError(
        f"{path}: times fall in {falls} of {len(t) - 1} steps when column {order[0] + 1} is time; {remedy}"
    )


def _unit_of(t: NDArray[Any]) -> tuple[str, str]:
    """The unit of times, and why."""
    t = t[np.isfinite(t)] if t.dtype.kind == "f" else t
    # A few absurd times say nothing of the others.
    few = 0.01 if len(t) >= 2 * _LEAST_ROWS else 0.0
    top = float(np.quantile(t, 1 - few)) if len(t) else 0.0
    is_whole = bool((t == np.rint(t)).all())
    if is_whole and top >= 1e17:
        return "ns", "as whole numbers of this size they count from 1970"
    if top >= 1e14:
        return "us", "as numbers of this size they count from 1970"
    if not is_whole and top >= 1e11:
        return "ms", "as numbers of this size with fractions they count from 1970"
    units = (("us", 1e6), ("ns", 1e9)) if is_whole else (("s", 1.0), ("ms", 1e3), ("us", 1e6))
    form = "they are whole numbers" if is_whole else "they have fractions"
    steps = np.sort(np.maximum(np.diff(t.astype(np.float64)), 0))
    steps = steps[: len(steps) - int(few * len(steps))]  # nor do a few pauses
    if len(t) < _LEAST_ROWS or not steps.any():
        return units[0][0], form
    rates = [(unit, len(steps) / steps.sum() * ticks) for unit, ticks in units]
    unit = next((unit for unit, rate in rates if rate >= _LEAST_RATE), units[-1][0])
    if unit == units[0][0]:
        return unit, form
    slow = rates[0][1]
    return unit, f"{form}, and as {_IN_WORDS[units[0][0]]} they would hold {slow:.3g} events a second"


class Rows:
    """Makes events of the rows of one table, and counts them."""

    def __init__(self, path: Path, unit: str, offset_us: int = 0) -> None:
        """Start at row 0 of a table whose times are in `unit`, `offset_us` after those of the events."""
        self._path, self._unit, self._offset_us = path, unit, offset_us
        self.n = 0
        """Rows so far."""
        self._minus, self._zero = -1, -1  # the first row of each

    def events(self, columns: Mapping[str, NDArray[Any]]) -> Events:
        """Make events of columns that may hold anything.

        Args:
            columns: t, x, y, p, each `(n,)` numbers, not changed.

        Raises:
            InputError: a value is out of the range that events have.
        """
        columns = {name: _exact(column) for name, column in columns.items()}
        t = _microseconds(columns["t"], self._unit)
        # Fractions stay, to be refused below, and whole numbers whole.
        values = {"t": (t.astype(np.int64) if t.dtype.kind in "iu" else t) + self._offset_us}
        for name in "xyp":
            values[name] = columns[name]
        for name, column in values.items():
            least = -1 if name == "p" else 0
            good = (column >= least) & (column <= _LARGEST[name])
            if column.dtype.kind == "f":
                good &= column == np.rint(column)
            if not good.all():
                bad = int(np.argmin(good))
                given = columns[name][bad]
                raise InputError(
                    f"{self._path}: event {self.n + bad}: {name} = {given}, but must be whole, {least} to "
                    f"{_LARGEST[name]}; times are read as {_IN_WORDS[self._unit]} (--time-unit), columns may "
                    "be in another order (--columns)"
                )
        self._look_at_polarity(values["p"])
        self.n += len(t)
        return make_events(values["x"], values["y"], values["p"] > 0, values["t"])

    def _look_at_polarity(self, p: NDArray[Any]) -> None:
        if p.dtype.kind in "bu":
            return
        for name, value in (("_minus", -1), ("_zero", 0)):
            if getattr(self, name) < 0 and (hit := p == value).any():
                setattr(self, name, self.n + int(np.argmax(hit)))
        if self._minus >= 0 and self._zero >= 0:
            raise InputError(
                f"{self._path}: polarity is -1 at event {self._minus} and 0 at event {self._zero}: one of "
                "them is OFF, but which? Write 0 and 1, or -1 and 1"
            )


def _exact(column: NDArray[Any]) -> NDArray[Any]:
    """Floats as they are, but in a type that holds every limit they are compared with."""
    return column.astype(np.float64) if column.dtype.kind == "f" and column.dtype.itemsize < 8 else column


def _microseconds(t: NDArray[Any], unit: str) -> NDArray[Any]:
    """Whole microseconds: rounded, but of nanoseconds those that have passed, as with packets."""
    if unit == "us":
        return t
    if unit == "ns":
        return t // 1000 if t.dtype.kind in "iu" else np.floor(t / 1000)
    with np.errstate(over="ignore"):
        return np.rint(t.astype(np.float64) * (1e6 if unit == "s" else 1e3))
