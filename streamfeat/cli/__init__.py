"""The command line: arguments and wiring.

Lives here: the entry point, and which modules hold commands.
Not here: anything another program might want to call. Commands import what they use when they run, so that
`--help` does not wait for it.
"""

import signal
import sys
from types import FrameType
from typing import NoReturn

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


def main() -> NoReturn:
    """Run the command line; what the user can mend ends with one line and exit status 2.

    SIGTERM ends a command as Ctrl-C does: with what is done written, and nothing half written.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        app()
    except InputError as error:
        err.print(f"[bold red]error:[/] {escape(' '.join(str(error).split()))}", soft_wrap=True)
        sys.exit(2)
    except MemoryError as error:
        err.print(f"[bold red]error:[/] out of memory, ask for less: {escape(str(error))}", soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit(0)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
