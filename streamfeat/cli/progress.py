"""Progress on standard error: a bar for each step, or a line.

Lives here: `progress_bars`, and how wide bars and remarks are. Not here: which steps there are.
"""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from streamfeat.cli.program import err

__all__ = ["progress_bars"]

_NARROW = 90
"""Columns below which bars are short, so that rate and time left stay in sight."""
_BESIDE = 38
"""Columns of the spinner, counts, rate and time, with what is between them."""
_SHORTEST = 12
"""Columns below which a remark would say nothing."""


class _RateColumn(ProgressColumn):
    """Steps a second, once there are some."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:,.{0 if speed >= 10 else 1}f}/s" if speed else "", style="dim")


class _RemarkColumn(ProgressColumn):
    """The remark, as far as there is room: it must not take it from the bar and the counts."""

    def __init__(self) -> None:
        super().__init__()
        self._longest = 0

    def render(self, task: Task) -> Text:
        self._longest = max(self._longest, len(task.description))
        room = err.width - self._longest - _BESIDE - (40 if err.width >= _NARROW else 10)
        text = Text(task.fields["remark"] if room >= _SHORTEST else "", style="dim", no_wrap=True)
        text.truncate(max(room, 0), overflow="ellipsis")
        return text


Report = Callable[[str, int, int, str], None]
"""Called with (step, done, of how many, remark); of how many is 0 where that is unknown."""


@contextlib.contextmanager
def progress_bars(
    *, from_a_thread: bool = True, quiet: bool = False, as_lines: bool = False, below: Console = err
) -> Iterator[Report]:
    """A function that keeps a bar for each step on standard error.

    A bar says how many are done, how many a second, and how long the rest will take. Nothing is shown where
    standard error is no terminal.

    Args:
        from_a_thread: keep the bars moving from a thread; without, they are drawn only when the function is
            called, once a second at most, so that nothing else runs during a measurement.
        quiet: show nothing.
        as_lines: in place of bars a line for each step's begin and end, and one a second between them,
            terminal or not.
        below: what lines are printed to meanwhile; if that is a terminal, the bars stay below them.
    """
    if quiet or not (as_lines or err.is_terminal):
        yield lambda step, done, total, remark: None
        return
    if as_lines:
        yield _lines()
        return
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(bar_width=40 if err.width >= _NARROW else 10),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeRemainingColumn(compact=True, elapsed_when_finished=True),
        _RemarkColumn(),
    )
    with Progress(
        *columns,
        console=below if below.is_terminal else err,
        auto_refresh=from_a_thread,
        redirect_stdout=False,  # what goes to a file while bars are shown is not for the terminal
    ) as progress:
        tasks: dict[str, Any] = {}
        drawn = 0.0

        def report(step: str, done: int, total: int, remark: str) -> None:
            nonlocal drawn
            if step not in tasks:
                tasks[step] = progress.add_task(step, total=total or None, remark="")
            progress.update(tasks[step], completed=done, total=total or None, remark=remark)
            if not from_a_thread and time.monotonic() > drawn + 1:
                progress.refresh()
                drawn = time.monotonic()

        yield report


def _lines() -> Report:
    """A function that prints steps as lines."""
    printed: dict[str, float] = {}

    def report(step: str, done: int, total: int, remark: str) -> None:
        now = time.monotonic()
        if step not in printed or done == total > 0 or now > printed[step] + 1:
            printed[step] = now
            count = f" {done:,}/{total:,}" if total else f" {done:,}" if done else ""
            err.print(f"{escape(step)}{count}  [dim]{escape(remark)}[/]", soft_wrap=True)

    return report
