"""Threads that share the work of one large emission.

Lives here: how many an engine uses, that one alone calls it, how many a piece of work is worth, and
handing out its parts.
Not here: what the work is (`kernels.update`, `kernels.planes`); threads that wait for files or for the
network.
"""

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import RLock
from typing import ParamSpec, TypeVar

from streamfeat.errors import InputError
from streamfeat.kernels.layout import Operator, State

__all__ = ["MOST_THREADS", "Crew", "one_thread", "usable_threads"]

P = ParamSpec("P")
T = TypeVar("T")

MOST_THREADS = 256

WORTH_A_PART = 1 << 18
"""Filters times volumes that a part has at least: a third of a millisecond of work, against a tenth of one
for handing it to another thread."""

WORTH_COUNTING = 1 << 20
"""Filters times volumes that there may be before an update is done in several steps, to find out how many."""


def usable_threads(threads: int | None = None) -> int:
    """The number of threads that an engine shall use, checked.

    Args:
        threads: 1 to 256; None for one fewer than there are cores, and at least one.

    Raises:
        InputError: fewer or more than that.
    """
    if threads is None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        return min(max(cores - 1, 1), MOST_THREADS)
    if not 1 <= threads <= MOST_THREADS:
        raise InputError(f"{threads} threads: an engine uses 1 to {MOST_THREADS}")
    return threads


def one_thread(method: Callable[P, T]) -> Callable[P, T]:
    """A method of what has a `_crew`, that refuses to run while another thread is in one.

    An engine that is shared by mistake would go on with wrong counts, and nothing would tell.
    """

    @functools.wraps(method)
    def guarded(*args: P.args, **kwargs: P.kwargs) -> T:
        turn = args[0]._crew.turn  # type: ignore[attr-defined]
        if not turn.acquire(blocking=False):
            raise RuntimeError("an engine is used by two threads at once; give each its own")
        try:
            return method(*args, **kwargs)
        finally:
            turn.release()

    return guarded


class Crew:
    """The calling thread and some others; those start with the first large piece of work.

    Args:
        threads: how many, with the calling one.

    Attributes:
        turn: held by the calling thread as long as it works.

    Raises:
        InputError: they are not 1 to 256.
    """

    def __init__(self, threads: int) -> None:
        """Start nothing yet; the threads end with this object."""
        self.turn = RLock()
        self.threads = usable_threads(threads)
        self._others = ThreadPoolExecutor(threads - 1, "streamfeat-engine") if threads > 1 else None

    def parts_for(self, work: int) -> int:
        """In how many parts to do a piece of work, given its filters times volumes."""
        return max(1, min(self.threads, work // WORTH_A_PART))

    def is_worth_counting(self, most: int) -> bool:
        """Whether to find out how much work there is, given a bound of its filters times volumes."""
        return self.threads > 1 and most >= WORTH_COUNTING

    def share(
        self,
        kernel: Callable[[int, int, Operator, State], None],
        parts: int,
        operator: Operator,
        state: State,
    ) -> None:
        """Call `kernel(part, parts, operator, state)` for each part, the first of them in this thread."""
        others = [
            self._others.submit(kernel, part, parts, operator, state)
            for part in range(1, parts)
            if self._others
        ]
        try:
            kernel(0, parts, operator, state)
        finally:  # none may still be at work on the state
            for other in others:
                other.result()
