"""The command line: arguments and wiring.

Lives here: the entry point, and which modules hold commands.
Not here: anything another program might want to call. Commands import what they use when they run, so that
`--help` does not wait for it.
"""

import signal
import sys
from types import FrameType
from typing import Any, NoReturn

import typer
from rich.markup import escape

from streamfeat.cli import (
    evaluating,
    labelling,
    learning,
    live,
    measuring,
    recordings,
    simulating,
    starting,
    streaming,
    viewing,
)
from streamfeat.cli.program import app, err
from streamfeat.errors import InputError

__all__ = [
    "app",
    "evaluating",
    "labelling",
    "learning",
    "live",
    "main",
    "measuring",
    "recordings",
    "simulating",
    "starting",
    "streaming",
    "viewing",
]

_UsageError: type[Exception] = typer.BadParameter.__bases__[0]
"""Of the library of Typer, which has it under no name of its own."""


def main() -> NoReturn:
    """Run the command line; what the user can mend ends with one line and exit status 2.

    SIGTERM ends a command as Ctrl-C does: with what is done written, and nothing half written.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        status = app(prog_name="streamfeat", standalone_mode=False)
    except _UsageError as error:
        _tell(error)
        sys.exit(2)
    except InputError as error:
        err.print(f"[bold red]error:[/] {escape(' '.join(str(error).split()))}", soft_wrap=True)
        sys.exit(2)
    except MemoryError as error:
        err.print(f"[bold red]error:[/] out of memory, ask for less: {escape(str(error))}", soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit(status if isinstance(status, int) else 0)


def _tell(error: Any) -> None:
    """A command line that makes no sense: one line in place of three. Without a command it is the help."""
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()
        return
    said = error.format_message().rstrip(".")
    line = said[:1].lower() + said[1:]
    if error.ctx:
        line += f" (`{error.ctx.command_path} -h` says more)"
    err.print(f"[bold red]error:[/] {escape(line)}", soft_wrap=True)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
