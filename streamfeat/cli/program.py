"""What all commands share.

Lives here: the program itself, arguments and options that several commands have, bars, tables, refusals.
Not here: the commands.
"""

import contextlib
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from streamfeat.errors import InputError

if TYPE_CHECKING:
    from streamfeat.mcap_records import Losses

__all__ = [
    "JsonOption",
    "ModelOption",
    "OverwriteOption",
    "QuietOption",
    "RecordingArgument",
    "RecordingsArgument",
    "TopicOption",
    "app",
    "err",
    "out",
    "print_losses",
    "print_result",
    "progress_bars",
    "refuse_existing",
]

app = typer.Typer(
    name="streamfeat",
    help="Learned features from event cameras: event by event, exact, and never behind.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)

out = Console(highlight=False, emoji=False)
err = Console(stderr=True, highlight=False, emoji=False)

RecordingArgument = Annotated[Path, typer.Argument(metavar="REC", help="MCAP recording of events.")]
RecordingsArgument = Annotated[
    list[Path], typer.Argument(metavar="REC...", help="MCAP recordings of events.")
]
TopicOption = Annotated[str | None, typer.Option(help="Event topic, where a recording has several.")]
ModelOption = Annotated[Path, typer.Option("--model", "-m", help="Model, from `streamfeat learn`.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Show the summary only.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an existing output file.")]


@contextlib.contextmanager
def progress_bars(*, from_a_thread: bool = True) -> Iterator[Callable[[str, int, int, str], None]]:
    """A function (step, done, of how many, remark) that keeps a bar for each step on standard error.

    Args:
        from_a_thread: keep the bars moving from a thread; without, they are drawn only when the function is
            called, once a second at most, so that nothing else runs while somebody measures.
    """
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(compact=True, elapsed_when_finished=True),
        TextColumn("[dim]{task.fields[remark]}"),
    )
    with Progress(*columns, console=err, disable=not err.is_terminal, auto_refresh=from_a_thread) as progress:
        tasks: dict[str, Any] = {}
        drawn = 0.0

        def report(step: str, done: int, total: int, remark: str) -> None:
            nonlocal drawn
            if step not in tasks:
                tasks[step] = progress.add_task(step, total=total or None, remark="")
            progress.update(tasks[step], completed=done, total=total or None, remark=escape(remark))
            if not from_a_thread and time.monotonic() > drawn + 1:
                progress.refresh()
                drawn = time.monotonic()

        yield report


def print_losses(losses: "Losses") -> None:
    """Say what of a recording could not be read."""
    for reason, count in losses.counts.items():
        err.print(
            f"[yellow]lost:[/] {count:,} x {reason}, {losses.bytes[reason]:,} bytes; "
            f"first at {escape(losses.first[reason])}",
            soft_wrap=True,
        )


def print_result(result: dict[str, Any], title: str, *, as_json: bool) -> None:
    """Print a result as a table of two columns, or as JSON."""
    if as_json:
        typer.echo(json.dumps(result))
        return
    table = Table(title=title, show_header=False, title_justify="left", box=None, pad_edge=False)
    table.add_column(style="dim")
    table.add_column(overflow="fold")  # or a long path would lose its end in a narrow terminal
    for name, value in result.items():
        text = f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
        table.add_row(name.replace("_", " "), escape(text))
    out.print(table)


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Refuse to replace a file unless asked to, before any work is done."""
    if path.exists() and not overwrite:
        raise InputError(f"{path}: exists already; give another name or --overwrite")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
