"""Labels for a recording that has none: from a table, put between its packets.

Lives here: reading and writing a label file, and where its labels stand in a stream.
Not here: labels that are in the recording (`reader`), and samples made of them (`samples`).

A label file is a table with commas and a line of names: `start`, `end` (or `duration`) and `label`, and if
wanted `split` and `source`. What the names of the times end in is their unit: `start_s` counts seconds after
the first event, `start_ms` milliseconds after it, `start_us` is stream time in microseconds, as emissions
and `info` print it. Without such an ending the values decide: whole numbers of which one reaches 100,000 are
stream time, all others are seconds after the first event; which of the two is said. Lines that begin with #
are remarks; those before the names may say something by name, as `# recording: drive.mcap`.
"""

import csv
import io
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, takewhile
from math import isfinite
from pathlib import Path
from typing import Literal

import numpy as np

from streamfeat.errors import InputError
from streamfeat.messages.packets import Label, Packet

__all__ = ["LabelTable", "label_text", "read_labels", "with_labels"]

_MOST_BYTES = 64 << 20
_LATEST_US = 1 << 52
_LEAST_STREAM_US = 100_000
_NAMES = {
    "start": ("start", "begin", "onset", "from", "t_start", "start_time", "starttime"),
    "end": ("end", "stop", "offset", "to", "t_end", "end_time", "endtime"),
    "duration": ("duration", "length"),
    "label": ("label", "class", "name", "category", "annotation"),
    "split": ("split", "set", "subset"),
    "source": ("source", "file"),
}
_UNITS_US = {"s": 1e6, "ms": 1e3, "us": 1.0}
_UNIT_NAMES = {"sec": "s", "seconds": "s", "msec": "ms", "usec": "us"} | {unit: unit for unit in _UNITS_US}


@dataclass(frozen=True, slots=True)
class LabelTable:
    """Labels of one file, in order of time.

    Attributes:
        path: of the file.
        labels: with times as they are there, in microseconds.
        clock: what times count: `stream` time; since the `first` event; or since 1970 by the `host`'s clock,
            which log times are of.
        assumption: what the file does not say; empty if it says all.
        remarks: what lines that begin with # say by name.
    """

    path: Path
    labels: tuple[Label, ...]
    clock: Literal["stream", "first", "host"]
    assumption: str = ""
    remarks: Mapping[str, str] = field(default_factory=dict)


def read_labels(path: Path) -> LabelTable:
    """Read a label file.

    Raises:
        InputError: the file is missing or not such a table, a time is not a number, or two labels overlap.
            Names the line.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(f"{path}: a label file of over {_MOST_BYTES >> 20} MiB; is this the right file?")
        text = path.read_text("utf-8-sig", "replace")
    except OSError as error:
        raise InputError(f"{path}: labels cannot be read: {error.strerror}") from None
    rows = [(n, row) for n, row in enumerate(_rows(path, text), 1) if any(row) and not row[0].startswith("#")]
    if len(rows) < 2:
        raise InputError(f"{path}: holds no labels; expected a line 'start,end,label' and one for each label")
    columns, unit = _columns(path, rows[0][1])
    times: list[tuple[float, float]] = []
    for n, row in rows[1:]:
        start, end = (_number(path, n, row, columns, name) for name in ("start", "end"))
        if "duration" in columns:
            end = start + _number(path, n, row, columns, "duration")
        if not start < end:
            raise InputError(f"{path}: line {n}: ends at {end:g}, which is not after its start at {start:g}")
        times.append((start, end))
    assumption = ""
    if not unit:
        largest = max(end for _, end in times)
        is_whole = all(value.is_integer() for pair in times for value in pair)
        unit = "us" if is_whole and largest >= _LEAST_STREAM_US else "s"
        meant = "stream time in microseconds" if unit == "us" else "seconds after the first event"
        assumption = f"{path}: times are taken for {meant}; name the columns start_s or start_us to say so"
    labels = []
    for (n, row), (start, end) in zip(rows[1:], times, strict=True):
        start_us, end_us = round(start * _UNITS_US[unit]), round(end * _UNITS_US[unit])
        if not (abs(start_us) < _LATEST_US and start_us < end_us < _LATEST_US):
            raise InputError(f"{path}: line {n}: from {start:g} to {end:g} {unit} is no time of a recording")
        name, split, source = (
            row[columns[c]].strip() if columns.get(c, len(row)) < len(row) else ""
            for c in ("label", "split", "source")
        )
        if not name:
            raise InputError(f"{path}: line {n}: the label is empty")
        labels.append((Label(start_us, end_us - start_us, name, split, source or f"{path.name}:{n}"), n))
    labels.sort(key=lambda found: found[0].start_us)
    for (first, n), (second, m) in pairwise(labels):
        if second.start_us < first.start_us + first.duration_us:
            raise InputError(
                f"{path}: lines {n} and {m} overlap: {first.label!r} ends after {second.label!r} begins; "
                "a moment has one label"
            )
    clock: Literal["stream", "first"] = "stream" if unit == "us" else "first"
    return LabelTable(path, tuple(label for label, _ in labels), clock, assumption, _remarks(text))


def label_text(labels: Sequence[Label], remarks: Mapping[str, str]) -> str:
    """A label file in stream time, as `read_labels` reads it.

    Args:
        labels: in order of time.
        remarks: what its first lines say, text of one line by name.
    """
    more = [name for name in ("split", "source") if any(getattr(label, name) for label in labels)]
    file = io.StringIO()
    file.writelines(f"# {name}: {text}\n" for name, text in remarks.items())
    table = csv.writer(file, lineterminator="\n")
    table.writerow(["start_us", "end_us", "label", *more])
    for label in labels:
        end_us = label.start_us + label.duration_us
        table.writerow([label.start_us, end_us, label.label, *(getattr(label, name) for name in more)])
    return file.getvalue()


def _remarks(text: str) -> dict[str, str]:
    lines = (line[1:].partition(":") for line in takewhile(lambda line: line[:1] == "#", text.splitlines()))
    return {name.strip(): said.strip() for name, _, said in lines}


def _rows(path: Path, text: str) -> Iterator[list[str]]:
    names = next((line for line in text.splitlines() if line.strip() and line[0] != "#"), "")
    delimiter = max(",;\t", key=names.count)
    try:
        yield from csv.reader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True)
    except csv.Error as error:
        raise InputError(f"{path}: is no table of labels: {error}") from None


def _columns(path: Path, names: Sequence[str]) -> tuple[dict[str, int], str]:
    """Where each column is, and the unit of the times, "" if no name says it.

    Raises:
        InputError: a column is missing or unknown, or times have two units.
    """
    found: dict[str, int] = {}
    units: set[str] = set()
    unknown = []
    for at, name in enumerate(n.strip().lower() for n in names):
        plain, _, unit = name.rpartition("_")
        plain, unit = (plain, _UNIT_NAMES[unit]) if unit in _UNIT_NAMES else (name, "")
        column = next((column for column, others in _NAMES.items() if plain in others), None)
        if column is None or column in found:
            unknown.append(names[at].strip())
            continue
        found[column] = at
        if column in ("start", "end", "duration"):
            units.add(unit)
    shown = ",".join(n.strip() for n in names)
    if (
        "start" not in found
        or "label" not in found
        or not ("end" in found) ^ ("duration" in found)
        or unknown
    ):
        wrong = f"unknown: {', '.join(unknown)}" if unknown else "columns are missing or twice there"
        raise InputError(
            f"{path}: columns {shown:.80} are not those of labels ({wrong:.80}); expected start, end (or "
            "duration), label, and perhaps split and source"
        )
    if len(units) > 1:
        raise InputError(f"{path}: columns {shown:.80} have times of two units; give both the same")
    return found, units.pop()


def _number(path: Path, n: int, row: Sequence[str], columns: dict[str, int], name: str) -> float:
    if name not in columns:
        return 0.0
    text = row[columns[name]].strip() if columns[name] < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        raise InputError(f"{path}: line {n}: {name} {text!r:.40} is no number")
    return value


def with_labels(
    placed: Iterable[tuple[int, Packet | Label]], table: LabelTable
) -> Iterator[tuple[int, Packet | Label]]:
    """Put labels into a stream, in place of its own: each before the first event at or after its start.

    A packet in which a label begins is cut there. Events that come later but are earlier stay behind it.
    Where the camera's clock starts anew, seconds after the first event go on by log time, and stream times
    mean the first run of the clock that reaches them.

    Args:
        placed: items of a recording, each with its byte.
        table: the labels.

    Raises:
        InputError: at the end, if no label has begun: the file is of another recording.
    """
    begun = [False] * len(table.labels)
    ends = [label.start_us + label.duration_us for label in table.labels]
    span: tuple[int, int] | None = None
    epoch = log_time_ns = shift_us = first_us = at_label = 0
    for at, item in placed:
        if isinstance(item, Label):
            continue
        if not len(item.events):
            yield at, item
            continue
        latest = np.maximum.accumulate(item.events["t"])
        if table.clock == "host":
            shift_us = int(latest[-1]) - item.log_time_ns // 1000
        if span is None or item.epoch != epoch:
            passed_us = 0
            if span is not None:
                # A camera sends a packet when its last event has come.
                between_us = (item.log_time_ns - log_time_ns) // 1000 - int(latest[-1] - latest[0])
                passed_us = span[1] - first_us + max(between_us, 0)
            epoch, first_us = item.epoch, int(latest[0]) - passed_us
            shift_us = first_us if table.clock == "first" else shift_us
            # What ended before this clock began has nothing to begin with.
            at_label = bisect_right(ends, int(latest[0]) - shift_us)
            span = span or (first_us, first_us)
        span, log_time_ns = (span[0], int(latest[-1])), item.log_time_ns
        done = 0
        while at_label < len(ends) and table.labels[at_label].start_us + shift_us <= int(latest[-1]):
            label, is_new = table.labels[at_label], not begun[at_label]
            begun[at_label] = True
            at_label += 1
            if is_new:
                label = replace(label, start_us=label.start_us + shift_us)
                cut = max(int(np.searchsorted(latest, label.start_us)), done)
                if cut > done:
                    yield at, replace(item, events=item.events[done:cut], lost=item.lost if done == 0 else 0)
                done = cut
                yield at, label
        if done < len(latest):
            yield at, item if done == 0 else replace(item, events=item.events[done:], lost=0)
    if not any(begun):
        label = table.labels[0]
        where = "{} to {} us".format(*(span or (0, 0)))
        raise InputError(
            f"{table.path}: no label lies within the recording, which goes from {where}; the first is from "
            f"{label.start_us + shift_us} us on. Is it the file of another recording?"
        )
