"""Options of every command that reads a recording.

Lives here: what tells how to read it, as one decorator; what is said of it afterwards.
Not here: what the options mean (`streamfeat.recordings`, `streamfeat.denoise`).
"""

import functools
import inspect
import re
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from streamfeat.cli.program import err
from streamfeat.errors import InputError

if TYPE_CHECKING:
    from streamfeat.recordings.options import ReadOptions
    from streamfeat.recordings.records import Losses

__all__ = [
    "HotPixels",
    "Isolated",
    "Refractory",
    "denoising_of",
    "print_assumptions",
    "print_removed",
    "reads_recordings",
]

HotPixels = Annotated[
    float | None,
    typer.Option(metavar="RATE", help="Take out pixels that go on with more events a second than this."),
]
Refractory = Annotated[
    str | None,
    typer.Option(metavar="TIME", help="Take out events that follow at their pixel sooner, such as 1ms."),
]
Isolated = Annotated[
    str | None,
    typer.Option(metavar="TIME", help="Take out events without a neighbour's within this time, such as 5ms."),
]

_OPTIONS: dict[str, Any] = {
    "columns": Annotated[
        str | None, typer.Option(metavar="NAMES", help="Columns of a table in their order, such as t,x,y,p.")
    ],
    "time_unit": Annotated[
        str | None, typer.Option(metavar="UNIT", help="Of the times of a table: s, ms, us or ns.")
    ],
    "resolution": Annotated[
        str | None, typer.Option(metavar="WxH", help="Of the sensor, where a camera file does not say it.")
    ],
    "labels": Annotated[
        str | None,
        typer.Option(
            metavar="FILE.csv|TOPIC",
            help="Labels for the recording: a table start,end,label, or one of its topics (std_msgs/String).",
        ),
    ],
    "hot_pixels": HotPixels,
    "refractory": Refractory,
    "isolated": Isolated,
}


def reads_recordings(
    *, labels: bool = True, noise: bool = True
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options, of which it gets the sum as its argument `reading`.

    Args:
        labels: whether it uses labels, so that they can be given.
        noise: whether it can be asked to take noise out.
    """
    left_out = set() if noise else {"hot_pixels", "refractory", "isolated"}
    left_out |= set() if labels else {"labels"}
    options = {name: kind for name, kind in _OPTIONS.items() if name not in left_out}

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def with_options(**given: Any) -> None:
            chosen = {name: given.pop(name) for name in options}
            command(**given, reading=_read_options(**chosen))

        before = inspect.signature(command).parameters
        own = [p for name, p in before.items() if name != "reading"]
        more = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)
            for name, kind in options.items()
        ]
        own = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in own]
        with_options.__signature__ = inspect.Signature([*own, *more])  # type: ignore[attr-defined]
        with_options.__annotations__ = {p.name: p.annotation for p in [*own, *more]}
        return with_options

    return decorate


def _read_options(
    columns: str | None,
    time_unit: str | None,
    resolution: str | None,
    labels: str | None = None,
    hot_pixels: float | None = None,
    refractory: str | None = None,
    isolated: str | None = None,
) -> "ReadOptions":
    from streamfeat.recordings.options import ReadOptions

    size = None
    if resolution is not None:
        found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", resolution.strip())
        if not found or not (int(found[1]) and int(found[2])):
            raise InputError(f"--resolution {resolution!r} is not understood; give WxH, such as 640x480")
        size = int(found[2]), int(found[1])
    return ReadOptions(columns, time_unit, size, labels, denoising_of(hot_pixels, refractory, isolated))


def denoising_of(hot_pixels: float | None, refractory: str | None, isolated: str | None) -> Any:
    """The noise that is to be taken out."""
    from streamfeat.denoise.stage import Denoising

    return Denoising.parse(hot_pixels, refractory, isolated)


def print_removed(losses: "Losses") -> None:
    """Say on standard error how much was taken out as noise."""
    for name, count in losses.removed.items():
        err.print(f"[dim]taken out:[/] {count:,} events, {name}", soft_wrap=True)


def print_assumptions(lines: Iterable[str]) -> None:
    """Say on standard error what was assumed of a recording."""
    for line in lines:
        err.print(f"[yellow]assumed:[/] {escape(line)}", soft_wrap=True)
