"""The command line: arguments and wiring.

Lives here: the entry point, and which modules hold commands.
Not here: anything another program might want to call. Commands import what they use when they run, so that
`--help` does not wait for it.
"""

import errno
import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from io import TextIOWrapper
from types import FrameType
from typing import Any, NoReturn

from rich.markup import escape

from streamfeat.cli import (
    evaluating,
    labelling,
    learning,
    live,
    measuring,
    recordings,
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
    "starting",
    "streaming",
    "viewing",
]


_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG}


def main() -> NoReturn:
    """Run the command line; what the user can mend ends with one line and exit status 2.

    SIGTERM ends a command as Ctrl-C does: with what is done written, and nothing half written. Where nobody
    reads standard output any more, as behind `| head`, the command ends silently with 1.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # where the encoding lacks a letter, its number is shown
            stream.reconfigure(errors="backslashreplace")
    try:
        app()
    except SystemExit as end:
        sys.exit(_status(partial(_flushed, end.code)))
    except BaseException as error:
        sys.exit(_status(partial(_failed, error)))
    sys.exit(_status(partial(_flushed, 0)))


def _status(ending: Callable[[], Any]) -> Any:
    """The exit status of a command, whose last words may meet a pipe without a reader or a full disk."""
    try:
        return ending()
    except BrokenPipeError:
        _drop_output()
        return 1
    except OSError as error:
        if error.errno not in _NO_ROOM or error.filename is not None:
            raise
        _drop_output()
        with suppress(OSError):
            err.print(f"[bold red]error:[/] standard output cannot be written: {error.strerror}")
        return 2


def _flushed(status: Any) -> Any:
    if sys.stdout:
        sys.stdout.flush()
    return status


def _failed(error: BaseException) -> int:
    """Say what went wrong, if it is no bug."""
    match error:
        case InputError():
            told, status = " ".join(str(error).split()), 2
        case MemoryError():
            told, status = f"out of memory, ask for less: {error}", 2
        case KeyboardInterrupt():
            return 130
        case _:
            raise error
    err.print(f"[bold red]error:[/] {escape(told)}", soft_wrap=True)
    return status


def _drop_output() -> None:
    """Let what is still buffered go nowhere, so that the interpreter does not try to write it at its end."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
