"""The common part of all commands.

Lives here: the program itself, arguments and options that several commands have, bars, tables, refusals.
Not here: the commands.
"""

import contextlib
import json
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup

from streamfeat.cli.consoles import err, out
from streamfeat.cli.rendering import complete, for_people
from streamfeat.cli.results import RESULTS
from streamfeat.errors import InputError
from streamfeat.files.atomic import is_replaced, refuse_input
from streamfeat.files.locations import Location, location_of

if TYPE_CHECKING:
    from streamfeat.recordings.records import Losses
    from streamfeat.work.workers import Workers

__all__ = [
    "AnyLocation",
    "ClusterOption",
    "EmitOption",
    "JsonOption",
    "ModelOption",
    "OpenOption",
    "OverwriteOption",
    "QuietOption",
    "RecordingArgument",
    "RecordingsArgument",
    "SpeedOption",
    "StepsOption",
    "TopicOption",
    "VerboseOption",
    "WebPortOption",
    "WorkersOption",
    "app",
    "compile_first",
    "completing",
    "err",
    "out",
    "print_json",
    "print_losses",
    "print_result",
    "refuse_existing",
    "tell_compiling",
    "working",
]

_ORDER = (
    "demo",
    "info",
    "convert",
    "simulate",
    "learn",
    "label",
    "train",
    "replay",
    "evaluate",
    "latency",
    "view",
)
_LAST = ("listen", "publish", "record", "recover", "topics", "doctor")


class _InOrder(TyperGroup):
    """Commands in the order in which a newcomer needs them, each with its whole first sentence."""

    def list_commands(self, ctx: Any) -> list[str]:
        names = super().list_commands(ctx)
        known = [*_ORDER, *(name for name in names if name not in _ORDER + _LAST), *_LAST]
        return [name for name in known if name in names]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        rows = [(name, self.commands[name].get_short_help_str(200)) for name in self.list_commands(ctx)]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


app = typer.Typer(
    name="streamfeat",
    cls=_InOrder,
    help="Learned features from event cameras: event by event, exact, and never behind.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,  # plain pages: for others Typer imports a parser of Markdown, a third of a start
    pretty_exceptions_enable=False,
)


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=lambda asked: _tell_version(asked), help="Print the version."
        ),
    ] = False,
    unpack: Annotated[
        str | None,
        typer.Option(
            metavar="BYTES",
            help="Let a file unpack to so much, such as 4G, where that is over 64M and 200 times the file.",
        ),
    ] = None,
    memory: Annotated[
        str | None,
        typer.Option(
            metavar="BYTES",
            help="Let engines of all cameras hold so much, such as 4G.",
            show_default="half of the memory",
        ),
    ] = None,
) -> None:
    # Processes that this one starts have them, too.
    if unpack is not None:
        from streamfeat.files.budget import VARIABLE, parse_bytes

        os.environ[VARIABLE] = str(parse_bytes(unpack))
    if memory is not None:
        from streamfeat.files.budget import parse_bytes

        os.environ["STREAMFEAT_MEMORY"] = str(parse_bytes(memory, "--memory"))


def _tell_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"streamfeat {version('streamfeat')}")
        raise typer.Exit


def completing(*values: str) -> Callable[[str], list[str]]:
    """A function for a shell that completes the value of an option: those that begin as what is typed."""

    def complete(incomplete: str) -> list[str]:
        return [value for value in values if value.startswith(incomplete)]

    return complete


if TYPE_CHECKING:
    AnyLocation = Location
else:
    # Typer knows no unions: help shows this name, and a command gets what the parser gives.
    AnyLocation = type("path|URL", (), {"__doc__": "A path, or the URL of something in a store."})
RecordingArgument = Annotated[
    AnyLocation,
    typer.Argument(metavar="REC", help="Recording: MCAP, bag, camera file; or its URL.", parser=location_of),
]
RecordingsArgument = Annotated[
    list[AnyLocation],
    typer.Argument(metavar="REC...", help="Recordings, or their URLs.", parser=location_of),
]
TopicOption = Annotated[
    str | None,
    typer.Option("--topic", "--stream", help="Event topic or stream, where a recording has several."),
]
EmitOption = Annotated[
    str,
    typer.Option(
        help="When to emit features: event, 1000ev, 10ms, bin (of the model) or auto.",
        autocompletion=completing("event", "1000ev", "10ms", "bin", "auto"),
    ),
]
SpeedOption = Annotated[
    str,
    typer.Option(
        help="1 is the recorded pace, 2 twice that, or max.", autocompletion=completing("1", "2", "max")
    ),
]
ModelOption = Annotated[
    Path | None,
    typer.Option("--model", "-m", help="Model, from `streamfeat learn`.", show_default="the general one"),
]
ThreadsOption = Annotated[
    int | None,
    typer.Option(
        help="Threads that share a large emission; features are the same for any number.",
        show_default="all cores but one",
    ),
]
WebPortOption = Annotated[
    int, typer.Option(min=0, max=65535, help="Where the page is, on loopback; 0 is any.")
]
OpenOption = Annotated[
    bool | None,
    typer.Option("--open/--no-open", help="Open the page in a browser. Opened where there is a display."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Show the summary only.")]
VerboseOption = Annotated[bool, typer.Option("--verbose", "-v", help="Show every sample.")]
StepsOption = Annotated[
    bool, typer.Option("--verbose", "-v", help="Show steps as lines, also where there is no terminal.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an existing output file.")]


ClusterOption = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Work on the cluster of this Dask scheduler; extra `cluster`."),
]
WorkersOption = Annotated[
    int | None, typer.Option(help="Number of processes of this machine to work in; extra `cluster`.")
]


@contextlib.contextmanager
def working(cluster: str | None, workers: int | None, *, quiet: bool) -> Iterator["Workers"]:
    """Where the options say that work is done: this process, or a cluster that is left at the end.

    Raises:
        InputError: both are given, the extra is not installed, or the cluster cannot be used.
    """
    from streamfeat.work.workers import THIS_PROCESS

    if cluster is None and workers is None:
        yield THIS_PROCESS
        return
    if cluster is not None and workers is not None:
        raise InputError("--cluster and --workers exclude each other; give one")
    from streamfeat.work.cluster import connected, local

    with connected(cluster) if cluster is not None else local(workers or 0) as found:
        if not quiet:
            err.print(f"[dim]{found.description}[/]", soft_wrap=True)
        yield found


def model_or_general(model: Path | None) -> Path:
    """The model that was given; without one the general model, which is said on standard error."""
    from streamfeat.shipped.general import GENERAL_MODEL

    if model is None:
        err.print(
            "[dim]model:[/] the general one that ships; filters learned from your own recordings fit them "
            "better: `streamfeat learn`, then -m",
            soft_wrap=True,
        )
    return model or GENERAL_MODEL


def compile_first(states: Iterable[str], *, quiet: bool) -> None:
    """Compile the kernels that encoders need, on two cores; nothing where that was done before.

    Args:
        states: kinds of state of the encoders, see `compiling.state_of`.
        quiet: say nothing.
    """
    from streamfeat.stream.compiling import compile_together

    tell_compiling(quiet=quiet)
    for state in sorted(set(states)):
        compile_together(state)


def tell_compiling(*, quiet: bool) -> None:
    """Say why nothing else is said for half a minute, where kernels were not compiled before."""
    from streamfeat.stream.compiling import STATES, is_compiled

    if not quiet and not any(is_compiled(state) for state in STATES):
        err.print(
            "[dim]compiling:[/] kernels, once for this version; it takes half a minute or more",
            soft_wrap=True,
        )


def print_losses(losses: "Losses") -> None:
    """Say what of a recording could not be read."""
    for reason, count in losses.counts.items():
        err.print(
            f"[yellow]lost:[/] {count:,} x {reason}, {losses.bytes[reason]:,} bytes; "
            f"first at {escape(losses.first[reason])}",
            soft_wrap=True,
        )


def print_result(result: dict[str, Any], title: str, *, as_json: bool, command: str = "") -> None:
    """Print a result as a table of two columns, or as JSON.

    Args:
        result: its fields; those of the command that are missing are null in JSON.
        title: of the table.
        as_json: print JSON.
        command: whose fields these are, see `results`; a table only, if it is none.
    """
    if as_json:
        print_json(command, result)
        return
    # Above the table and not its title, which would be wrapped at the width of the columns.
    out.print(Text(title, style="table.title", overflow="fold"))
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="dim")
    table.add_column(overflow="fold")  # or a long path would lose its end in a narrow terminal
    for name, text in for_people(result, RESULTS.get(command, {})):
        table.add_row(name, escape(text))
    out.print(table)


def print_json(command: str, result: dict[str, Any]) -> None:
    """Print the fields of a command's result as one line of JSON."""
    typer.echo(json.dumps(complete(command, result), allow_nan=False))


def refuse_existing(path: Path, *inputs: object, overwrite: bool) -> None:
    """Refuse to replace a file unless asked to, and an input in any case, before any work is done."""
    refuse_input(path, inputs)
    if is_replaced(path) and path.exists() and not overwrite:
        raise InputError(f"{path}: exists already; give another name or --overwrite")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
