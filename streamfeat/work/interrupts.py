"""SIGINT, SIGTERM and SIGHUP: heard within a second, whatever the process is doing.

Lives here: what an interrupt does at the moment, the thread that hears it while the main thread is busy, and
leaving the process. Not here: how pipelines end (`stream.signals`), and what commands say of it (`cli`).

Python runs a signal's handler in the main thread, between two of its instructions: while that thread
compiles, solves or loads a library, no handler runs for seconds. So a thread of its own waits
here for the byte that the C level writes at once. An interrupt means one of four things:

* nothing is open yet (imports): the process ends at once;
* nothing is promised: `KeyboardInterrupt`, and if the command has not ended `GRACE_S` later, the process
  ends, after unfinished outputs are removed;
* something is promised (`kept_by`): a function is called that ends it in order, however long that takes;
* not now (`deferred`): it waits for the first `kept_by`, or for the end of the block.

A second interrupt, `AGAIN_S` later or more, ends the process at once in any case. Only a command's process is
ended here: a program that calls this package gets `KeyboardInterrupt`, or the function.
"""

import atexit
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Event, Thread, current_thread, main_thread
from types import FrameType
from typing import Any, NoReturn, TypeVar

from streamfeat.errors import printable

__all__ = [
    "AGAIN_S",
    "GRACE_S",
    "INTERRUPTED",
    "aside",
    "at_leaving",
    "deferred",
    "end",
    "hear",
    "kept_by",
    "last_words",
    "promised",
    "start",
    "take_last_words",
]

R = TypeVar("R")

INTERRUPTED = 130
"""The exit status of a command that was interrupted, by whichever signal."""

GRACE_S = 0.5
"""Seconds that the main thread has to end a command that has promised nothing."""

AGAIN_S = 0.4
"""Interrupts closer together are one: a launcher may pass on what the terminal has sent to both."""

_TURN_S = 0.05
_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
_QUIT = 0
_SHOW_CURSOR = b"\x1b[?25h"


@dataclass(slots=True)
class _Phase:
    """What an interrupt does now: call a function, wait, end the process, or else be raised."""

    action: Callable[[], None] | None = None
    is_promised: bool = False
    waits: bool = False
    ends: bool = False


class _Interrupts:
    """The interrupts of this process: phases, one in the other, and the thread that hears."""

    def __init__(self) -> None:
        self.leaves = False
        self.phases: list[_Phase] = []
        self.at_leaving: list[Callable[[], object]] = []
        self.words = ""
        self.status = INTERRUPTED
        self.heard_s: float | None = None
        self._leave_at_s: float | None = None
        self._waiting = self._raised = False
        self._watcher: Thread | None = None
        self._ends, self._woken_before = (-1, -1), -1
        self._before: dict[int, Any] = {}

    @property
    def phase(self) -> _Phase:
        return self.phases[-1] if self.phases else _Phase()

    def install(self) -> None:
        """Have signals come here; in the main thread only."""
        self.heard_s = self._leave_at_s = None
        self._waiting = self._raised = False
        for number in _SIGNALS:
            before = signal.getsignal(number)
            # As `nohup` has it. SIGINT is ignored in the background of a script, and heard all the same.
            if number == getattr(signal, "SIGHUP", None) and before is signal.SIG_IGN:
                continue
            self._before[number] = before
            signal.signal(number, self._on_signal)

    def restore(self) -> None:
        """Have signals go where they went before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()

    @property
    def is_installed(self) -> bool:
        return bool(self._before)

    def watch(self) -> bool:
        """Start the thread that hears; whether it was not there."""
        if self._watcher:
            return False
        self._ends = os.pipe()
        os.set_blocking(self._ends[1], False)
        self._woken_before = signal.set_wakeup_fd(self._ends[1], warn_on_full_buffer=False)
        self._watcher = Thread(target=self._watch, args=(self._ends[0],), name="interrupts", daemon=True)
        self._watcher.start()
        return True

    def unwatch(self) -> None:
        """End that thread."""
        if not self._watcher:
            return
        signal.set_wakeup_fd(self._woken_before)
        os.write(self._ends[1], bytes([_QUIT]))
        self._watcher.join()
        self._close()

    def deafen(self) -> None:
        """Let the interpreter end: the last that it does is to give signals back to the system."""
        for number in self._before:
            signal.signal(number, signal.SIG_IGN)

    def forget(self) -> None:
        """In a process that was forked: its parent's thread and its ends of the pipe are not its own."""
        if self._watcher:
            with suppress(ValueError):
                signal.set_wakeup_fd(-1)
            self._close()
        self.leaves = False
        self.at_leaving.clear()

    def _close(self) -> None:
        for number in self._ends:
            os.close(number)
        self._watcher = None

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        """In the main thread, as soon as that runs Python."""
        phase = self.phase
        self.heard_s = self.heard_s or time.monotonic()
        if phase.waits:
            self._waiting = True
        elif phase.action:
            phase.action()
        elif phase.ends:
            self.leave()
        elif not (self.leaves and self._raised):
            self._raised = True
            raise KeyboardInterrupt

    def _watch(self, end: int) -> None:
        first_s: float | None = None
        poll = select.poll()
        poll.register(end, select.POLLIN)
        while True:
            until = self._leave_at_s
            if not poll.poll(None if until is None else max(0, 1000 * (until - time.monotonic()))):
                if self._leave_at_s is not None and time.monotonic() >= self._leave_at_s:
                    if not self.phase.is_promised:
                        self.leave()
                    self._leave_at_s = None  # something was promised after the interrupt was heard
                continue
            number = os.read(end, 1)[0]
            if number == _QUIT:
                return
            if number in self._before:
                first_s = self._hear(first_s)

    def _hear(self, first_s: float | None) -> float:
        """In the watching thread; when the first interrupt was heard."""
        now, phase = time.monotonic(), self.phase
        if first_s is None or not self.leaves:
            self.heard_s = self.heard_s or now
            if phase.ends:
                self.leave()
            if self.leaves and not phase.is_promised:
                self._leave_at_s = now + GRACE_S
            if phase.action:
                phase.action()
        elif now - first_s > AGAIN_S:
            self.leave()
        return now if first_s is None else first_s

    def leave(self) -> NoReturn:
        """End the process at once; what is unfinished is removed, and nothing is waited for."""
        self.clean_up()
        with suppress(OSError):
            os.write(2, self.take_words().encode(errors="backslashreplace"))
        for number in (1, 2):
            with suppress(OSError):
                if os.isatty(number):
                    os.write(number, _SHOW_CURSOR)
                    break
        os._exit(self.status)

    def clean_up(self) -> None:
        """Remove what is unfinished, end processes that were started."""
        for callback in reversed(self.at_leaving):
            with suppress(BaseException):
                callback()

    def take_words(self) -> str:
        """What is left to say, once."""
        words, self.words = self.words, ""
        return words and f"{words}\n"

    def take_waiting(self, *, promised: bool) -> bool:
        """Whether an interrupt waits, which then waits no more; a promise takes the end back."""
        waiting, self._waiting = self._waiting, False
        if waiting and promised:
            self._leave_at_s = None
        return waiting


_interrupts = _Interrupts()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_interrupts.forget)


def start() -> None:
    """Hear interrupts from here on, and end the process at the first; for the first line of a command."""
    _interrupts.leaves = True
    _interrupts.phases = [_Phase(ends=True)]
    _interrupts.install()
    _interrupts.watch()


def hear() -> None:
    """From here on an interrupt is a `KeyboardInterrupt`, in a process that `start` has begun or another."""
    _interrupts.phases = []
    if not _interrupts.is_installed:
        _interrupts.install()


def at_leaving(callback: Callable[[], object]) -> None:
    """Have something done before the process leaves in haste; it waits for no lock, and raises nothing."""
    if callback not in _interrupts.at_leaving:
        _interrupts.at_leaving.append(callback)


def last_words(line: str) -> None:
    """Have a line said on standard error if the process leaves in haste, unless `take_last_words` has it."""
    _interrupts.words = printable(line)


def take_last_words() -> str:
    """That line, for a command that ends in order."""
    return _interrupts.take_words().rstrip("\n")


def end(status: int) -> NoReturn:
    """End a command: after an interrupt without waiting for threads that are still at work.

    An interrupt from here on changes nothing of what came of it: the process ends at once, with this status.
    """
    if _interrupts.leaves:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        _interrupts.status = status
        _interrupts.phases = [_Phase(ends=True)]
        if _interrupts.heard_s is not None:
            _interrupts.leave()
        atexit.register(_interrupts.deafen)
    sys.exit(status)


@contextmanager
def kept_by(action: Callable[[], None], *, is_promised: bool = True) -> Iterator[None]:
    """Interrupts call a function while the block runs; elsewhere than in the main thread none is heard.

    Args:
        action: called from any thread, perhaps more than once; it waits for nothing.
        is_promised: whether the block has so long as it takes, or `GRACE_S`.
    """
    if current_thread() is not main_thread():
        yield
        return
    with _installed():
        if is_promised:
            for phase in _interrupts.phases:
                phase.is_promised = phase.is_promised or phase.waits
        _interrupts.phases.append(_Phase(action, is_promised=is_promised))
        started = _interrupts.watch()
        try:
            if _interrupts.take_waiting(promised=is_promised):
                action()
            yield
        finally:
            if started:
                _interrupts.unwatch()
            _interrupts.phases.pop()


@contextmanager
def deferred() -> Iterator[None]:
    """Interrupts wait while the block runs: for the first `kept_by`, or else they are raised at its end.

    For opening outputs: a `KeyboardInterrupt` between opening and running would leave half of one behind.
    """
    if current_thread() is not main_thread():
        yield
        return
    with _installed():
        _interrupts.phases.append(_Phase(waits=True))
        try:
            yield
        finally:
            _interrupts.phases.pop()
        if not _interrupts.phase.waits and _interrupts.take_waiting(promised=False):
            raise KeyboardInterrupt


@contextmanager
def promised() -> Iterator[None]:
    """A `KeyboardInterrupt` in this block is caught by one who keeps something, however long that takes."""
    _interrupts.phases.append(_Phase(is_promised=True))
    try:
        yield
    finally:
        _interrupts.phases.pop()


def aside(function: Callable[..., R], *arguments: Any) -> R:
    """Call a function so that a `KeyboardInterrupt` comes at once, whatever the function is doing.

    It runs in a thread of its own, and after an interrupt is left behind: what it works on must not be used
    any more. In other threads, and in programs that call this package, it is a plain call.
    """
    if not _interrupts.leaves or current_thread() is not main_thread():
        return function(*arguments)
    result: list[R] = []
    errors: list[BaseException] = []
    done = Event()

    def call() -> None:
        try:
            result.append(function(*arguments))
        except BaseException as error:
            errors.append(error)
        finally:
            done.set()

    Thread(target=call, name="aside", daemon=True).start()
    while not done.wait(_TURN_S):
        pass
    if errors:
        raise errors[0]
    return result[0]


@contextmanager
def _installed() -> Iterator[None]:
    """Handlers of signals, as long as the outermost block runs."""
    if _interrupts.is_installed:
        yield
        return
    _interrupts.install()
    try:
        yield
    finally:
        _interrupts.restore()
