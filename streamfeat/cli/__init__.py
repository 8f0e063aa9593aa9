"""The command line: arguments and wiring.

Lives here: the entry point, and which modules hold commands.
Not here: anything another program might want to call. Commands import what they use when they run, so that
`--help` does not wait for it.
"""

import errno
import os
import sys
from contextlib import suppress
from io import TextIOWrapper
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
from streamfeat.cli.blas import spare_blas
from streamfeat.cli.program import app, err
from streamfeat.errors import InputError, printable
from streamfeat.files.outputs import remove_unfinished
from streamfeat.work import interrupts

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


_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG}


def main() -> NoReturn:
    """Run the command line; what the user can mend ends with one line and exit status 2.

    SIGTERM and SIGHUP end a command as Ctrl-C does: with what is done written, and nothing half written.
    Where nobody reads standard output any more, as behind `| head`, a command ends silently with 1.
    """
    interrupts.at_leaving(remove_unfinished)
    interrupts.hear()
    spare_blas()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # where the encoding lacks a letter, its number is shown
            stream.reconfigure(errors="backslashreplace")
    try:
        status = _run()
        if sys.stdout:
            sys.stdout.flush()
    except BrokenPipeError:
        _drop_output()
        status = 1
    except OSError as error:
        if error.errno not in _NO_ROOM or error.filename is not None:
            raise
        _drop_output()
        err.print(f"[bold red]error:[/] standard output cannot be written: {error.strerror}")
        status = 2
    interrupts.end(status)


def _run() -> int:
    """Run a command; its exit status."""
    try:
        status = app(prog_name="streamfeat", standalone_mode=False)
    except _UsageError as error:
        _tell(error)
        return 2
    except InputError as error:
        err.print(f"[bold red]error:[/] {escape(' '.join(str(error).split()))}", soft_wrap=True)
        return 2
    except MemoryError as error:
        err.print(f"[bold red]error:[/] out of memory, ask for less: {escape(str(error))}", soft_wrap=True)
        return 2
    except PermissionError as error:  # somewhere in the path of an input or output
        err.print(f"[bold red]error:[/] {escape(printable(_denied(error)))}", soft_wrap=True)
        return 2
    except KeyboardInterrupt:
        return interrupts.INTERRUPTED
    return status if isinstance(status, int) else 0


def _denied(error: PermissionError) -> str:
    """Which path another user keeps from this one."""
    return f"{os.fsdecode(error.filename or 'something')}: {error.strerror}; may this user read and enter it?"


def _drop_output() -> None:
    """Let what is still buffered go nowhere, so that the interpreter does not try to write it at its end."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


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
