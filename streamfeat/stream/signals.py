"""Interrupts of programs that run pipelines and nothing else.

Lives here: running pipelines in an event loop of their own until a signal stops them.
Not here: the pipeline itself, which knows nothing of signals and runs in any loop (`pipeline`), and how a
signal is heard (`work.interrupts`).
"""

import asyncio
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from streamfeat.errors import InputError
from streamfeat.stream.pipeline import Pipeline
from streamfeat.work.interrupts import deferred, kept_by

__all__ = ["run_until_interrupted", "signals_wait"]


@contextmanager
def signals_wait() -> Iterator[None]:
    """Interrupts wait until `run_until_interrupted` can hear them, or until the block ends.

    For opening sinks: a signal between opening them and running would leave half an output behind.

    Raises:
        InputError: an event loop is running in this thread, so that pipelines cannot have one of their own.
    """
    _refuse_running_loop()
    with deferred():
        yield


def _refuse_running_loop() -> None:
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return
    raise InputError(
        "an event loop is running here already, as in Jupyter: iterate sf.replay(...) or sf.listen(...) with "
        "`async for`, or `await` the run of a sf.Pipeline"
    )


def run_until_interrupted(
    pipelines: Sequence[Pipeline[Any, Any]], interrupt: Callable[[], None] | None = None
) -> bool:
    """Run pipelines side by side in a loop of their own; SIGINT, SIGTERM and SIGHUP end them well.

    Args:
        pipelines: not run before.
        interrupt: what a signal does; if not given, it stops every pipeline.

    Returns:
        whether there was a signal.

    Raises:
        InputError: as for `signals_wait`.
    """
    _refuse_running_loop()
    interrupted = False

    def on_signal() -> None:
        nonlocal interrupted
        interrupted = True
        if interrupt:
            interrupt()
        else:
            for pipeline in pipelines:
                pipeline.stop()

    async def run() -> None:
        loop = asyncio.get_running_loop()

        def hear() -> None:
            with suppress(RuntimeError):  # the loop has just ended
                loop.call_soon_threadsafe(on_signal)

        with kept_by(hear):
            try:
                async with asyncio.TaskGroup() as tasks:
                    for pipeline in pipelines:
                        tasks.create_task(pipeline.run())
            except BaseExceptionGroup as group:
                raise group.exceptions[0] from None

    asyncio.run(run())
    return interrupted
