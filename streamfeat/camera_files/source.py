"""A camera file before its events are read: what was asked for, and what opening it found out.

Lives here: the options of a reader, what every format tells when it is opened, and words for messages.
Not here: the formats, and which of them a file has (`event_files`).
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution

__all__ = [
    "BLOCK_BYTES",
    "HEAD_BYTES",
    "Contents",
    "Losses",
    "TableOptions",
    "checked_resolution",
    "chosen_stream",
    "one_line",
]

BLOCK_BYTES = 1_000_000
"""Bytes read at a time: a multiple of every record size, 2, 4, 5 and 8."""

HEAD_BYTES = 65_536
"""Of a file, in which its format and layout must show."""

TIME_UNITS = ("s", "ms", "us", "ns")


@dataclass(frozen=True, slots=True)
class TableOptions:
    """What a file does not say, or says wrongly. None leaves it to the file.

    Attributes:
        columns: order of the columns of a table, such as `t,x,y,p`; other names stand for columns that are
            left out.
        time_unit: of the times of a table: `s`, `ms`, `us` or `ns`.
        resolution: `(height, width)` in pixels, instead of that of the file.
        stream: name or number of one event stream of several.

    Raises:
        InputError: an option cannot be used.
    """

    columns: str | None = None
    time_unit: str | None = None
    resolution: Resolution | None = None
    stream: str | None = None

    def __post_init__(self) -> None:
        """Check all options."""
        if self.columns is not None:
            names = self.names()
            if sorted(name for name in names if name in "txyp" and name) != ["p", "t", "x", "y"]:
                raise InputError(
                    f"--columns {self.columns:.60} must name each of t, x, y and p once, such as t,x,y,p"
                )
        if self.time_unit is not None and self.time_unit not in TIME_UNITS:
            raise InputError(f"--time-unit {self.time_unit:.20} is not known; give one of s, ms, us, ns")
        if self.resolution is not None and not all(0 < side <= 0x7FFF for side in self.resolution):
            raise InputError(f"--resolution must have sides of 1 to 32767 pixels, not {self.resolution}")

    def names(self) -> tuple[str, ...]:
        """The columns, one name each; empty where none are given."""
        return tuple(name.strip().lower() for name in (self.columns or "").split(",")) if self.columns else ()


class Losses(Protocol):
    """To whom a reader tells what it could not use."""

    def lose(self, n_bytes: int, why: str) -> None:
        """Note that `n_bytes` could not be used, with one line that says why."""


@dataclass(frozen=True, slots=True)
class Contents:
    """What opening a file found out.

    Attributes:
        read: reads all events from the beginning, in batches, and notes losses; may be called again.
        resolution: `(height, width)` that the file declares, None where it does not.
        start: byte at which the events begin, 0 where that means nothing.
        streams: names of the event streams, where the format can hold several.
        assumptions: one line for each thing that the file does not say and that was decided.
        labels: names of the labels that the file holds besides its events.
    """

    read: Callable[[Losses], Iterator[Events]]
    resolution: Resolution | None = None
    start: int = 0
    streams: tuple[str, ...] = ()
    assumptions: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()


def checked_resolution(path: object, height: object, width: object) -> Resolution:
    """Make a `(height, width)` of what a header says; InputError where a side is not 1 to 32767."""
    if all(re.fullmatch(r"\d{1,5}", str(side)) and 0 < int(str(side)) <= 0x7FFF for side in (height, width)):
        return int(str(height)), int(str(width))
    raise InputError(
        f"{path}: header declares {width!s:.20} x {height!s:.20} pixels; mend the header or drop it"
    )


def chosen_stream(path: object, streams: tuple[str, ...], wanted: str | None) -> int:
    """Position of the event stream to read.

    Args:
        path: named in errors.
        streams: names; an end of a name after `/` stands for it too.
        wanted: a name or a number, None where there is no choice to make.

    Raises:
        InputError: there is no stream, none of this name, or several without a choice.
    """
    if not streams:
        raise InputError(f"{path}: holds no event stream")
    named = ", ".join(streams)
    if wanted is None:
        if len(streams) > 1:
            raise InputError(
                f"{path}: has {len(streams)} event streams ({named:.400}); choose one with --stream"
            )
        return 0
    found = [i for i, name in enumerate(streams) if name == wanted]
    found = found or [i for i, name in enumerate(streams) if f"/{name}".endswith(f"/{wanted.strip('/')}")]
    if not found and re.fullmatch(r"\d{1,4}", wanted) and int(wanted) < len(streams):
        return int(wanted)
    if len(found) != 1:
        raise InputError(f"{path}: has no one event stream {wanted!r:.60}; it has {named:.400}")
    return found[0]


def one_line(error: BaseException) -> str:
    """The message of a library, of any number of lines, as part of a one-line message."""
    return " ".join(str(error).split())[:200]
