"""Blocking work in threads, for tasks of an event loop that may be cancelled.

Lives here: handing a call to a thread, and never leaving it behind.
Not here: which work that is (`pipeline`, `emissions`).

A cancelled task waits until its thread is done, without blocking the loop, however often it is cancelled
meanwhile. So nothing is closed while a thread still uses it, and no thread outlives the task.
"""

import asyncio
import concurrent.futures
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from types import TracebackType
from typing import Any, ParamSpec, Self, TypeVar

__all__ = ["Threads", "finished"]

P = ParamSpec("P")
T = TypeVar("T")


class Threads:
    """A few threads; a context manager that ends them.

    Args:
        n: how many calls may run at a time.

    Attributes:
        cancelled: a task was cancelled that waits for a call; calls without an end look at it.
    """

    def __init__(self, n: int) -> None:
        """No thread starts before there is work."""
        self.cancelled = False
        self._pool = ThreadPoolExecutor(n, thread_name_prefix="streamfeat")

    def __enter__(self) -> Self:
        """Give the threads themselves."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the threads; all of their calls have returned by then."""
        self._pool.shutdown()

    async def run(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function in a thread.

        Errors come out as they were raised. Those that would mean something else to an event loop (the end of
        an iteration, a cancellation, whatever else is no `Exception`) come out as RuntimeError, with the
        original as its cause.
        """
        work = self._pool.submit(_called, function, args, kwargs)
        try:
            return await asyncio.wrap_future(work)
        except asyncio.CancelledError:
            self.cancelled = True
            while not work.done():
                with suppress(asyncio.CancelledError):
                    await asyncio.wait([asyncio.wrap_future(work)])
            raise


_NOT_FOR_LOOPS = StopIteration, StopAsyncIteration, concurrent.futures.CancelledError


def _called(function: Callable[..., T], args: Any, kwargs: Any) -> T:
    try:
        return function(*args, **kwargs)
    except BaseException as error:
        if isinstance(error, Exception) and not isinstance(error, _NOT_FOR_LOOPS):
            raise
        raise RuntimeError(f"{type(error).__name__} out of a source, processor or sink: {error}") from error


async def finished(task: "asyncio.Task[Any]") -> None:
    """Wait until a task is over, whatever came of it; a cancellation meanwhile takes effect after that."""
    interrupted: asyncio.CancelledError | None = None
    while not task.done():
        try:
            await asyncio.wait([task])
        except asyncio.CancelledError as error:
            interrupted = error
    if interrupted:
        raise interrupted
