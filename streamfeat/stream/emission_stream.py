"""Emissions as an asynchronous iterator, for any asyncio program.

Lives here: `EmissionStream`, which runs a job's pipeline in a task of the running loop and hands over what
comes out, one emission at a time.
Not here: the jobs (`replay`, `live.listen`) and the pipeline, which are those that the commands run.

Nothing here starts a loop, blocks it, or touches signals, so that it works in any asyncio program and in
Jupyter. Files and networks are opened and closed in a thread.

Between pipeline and program at most `_WAITING` emissions wait. When there are so many, the pipeline waits: a
replay loses nothing, and of live topics the inbox drops the oldest packets and counts them.

Cancelling: `async for`, `async with` and `aclose` can be cancelled wherever they wait. The pipeline ends as
soon as its threads return, its files and sessions are closed, and then the cancellation goes on.
"""

import asyncio
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Protocol, Self

from streamfeat.stream.batch import EmissionBatch
from streamfeat.stream.emission import Emission
from streamfeat.stream.pipeline import Pipeline, PipelineStats
from streamfeat.stream.sinks import Sink
from streamfeat.stream.state import SessionStats
from streamfeat.stream.threads import Threads, finished

__all__ = ["EmissionStream", "Job", "StreamStats"]

_WAITING, _WAITING_BYTES = 512, 64 << 20
"""Emissions that wait for the program at most, more than two parts of a pipeline; and their bytes, or those
of a single batch.
"""


class Job(Protocol):
    """Something that runs a pipeline of emissions."""

    def opened(
        self, sinks: Callable[[], Sequence[Sink[Emission]]], /
    ) -> AbstractContextManager[Pipeline[Any, Emission]]:
        """The pipeline into these sinks, opened last; all that it needs is open until the block ends."""

    def stop(self) -> None:
        """End the source; what has come is still processed. Is called from the loop's thread."""

    def session_stats(self) -> SessionStats:
        """What has been done so far."""

    def drops(self) -> dict[str, int]:
        """What was not used so far, by reason."""


@dataclass(frozen=True, slots=True)
class StreamStats:
    """How far a stream of emissions has got.

    Attributes:
        session: events, emissions, samples and so on; of all cameras together.
        pipeline: items read, and what waits in its queues.
        drops: what was not used, by reason: packets, and (`late`, `rejected`) events.
        waiting: emissions that wait for the program, at most 512.
        peak_waiting: the most that have waited so far.
    """

    session: SessionStats = field(default_factory=SessionStats)
    pipeline: PipelineStats = field(default_factory=PipelineStats)
    drops: Mapping[str, int] = field(default_factory=dict)
    waiting: int = 0
    peak_waiting: int = 0


class EmissionStream:
    """Emissions of a replay or of live topics, in order; runs once.

    Iterate with `async for`. That starts it, and closes it at the end, on an error, and where the loop is
    left by `break` or a cancellation. As `async with` it starts at once and is closed with the block; the
    loop may be left and begun again meanwhile.

    Errors of the source come out of `async for` as they were raised; `InputError` is of what a user can mend.

    Args:
        make_job: called in a thread; opens files, and may take a while.
    """

    def __init__(self, make_job: Callable[[], Job]) -> None:
        """Nothing is opened before the first use."""
        self._make_job = make_job
        self._queue = _QueueSink()
        self._taken: deque[Emission] = deque()
        self._task: asyncio.Task[None] | None = None
        self._job: Job | None = None
        self._pipeline: Pipeline[Any, Emission] | None = None
        self._is_stopped = self._is_over = False

    async def __aenter__(self) -> Self:
        """Start, and give the stream itself."""
        self._start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close; an error that has not come out yet is raised, unless the block ends with another."""
        try:
            await self.aclose()
        except Exception:
            if kind is None:
                raise

    async def __aiter__(self) -> AsyncIterator[Emission]:
        """Yield emissions to the end; after `aclose` there are none."""
        is_mine = self._task is None
        self._start()
        try:
            while True:
                if not self._taken:
                    self._taken.extend(await self._queue.take())
                if not self._taken:
                    break
                yield self._taken.popleft()
            await self._end()
        finally:
            if is_mine:
                with suppress(Exception):  # the loop's own error is on its way, or the loop was left
                    await self.aclose()

    def stop(self) -> None:
        """End the source. What has been read still comes out, and then the iteration ends.

        Call from the loop's thread.
        """
        self._is_stopped = True
        if self._job:
            self._job.stop()

    async def aclose(self) -> None:
        """Cancel what is under way and wait until everything is closed; once more does nothing.

        Raises:
            Exception: that of the pipeline, where it has failed and the error has not come out yet.
        """
        self._is_over = True
        self._taken.clear()
        if self._task:
            self._queue.abandon()
            self._task.cancel()
        await self._end()

    def stats(self) -> StreamStats:
        """What has been done so far; zeros before the first use."""
        job, pipeline = self._job, self._pipeline
        return StreamStats(
            job.session_stats() if job else SessionStats(),
            pipeline.stats() if pipeline else PipelineStats(),
            job.drops() if job else {},
            len(self._queue) + len(self._taken),
            self._queue.peak,
        )

    def _start(self) -> None:
        if self._task is None and not self._is_over:
            self._queue.serve(asyncio.get_running_loop())
            self._task = asyncio.create_task(self._run(), name="streamfeat emissions")
            self._task.add_done_callback(lambda _: self._queue.end())
        elif self._task is None:
            self._queue.end()

    async def _end(self) -> None:
        """Wait until the pipeline is over, and raise what it raised, once."""
        if self._task is None:
            return
        await finished(self._task)
        error = None if self._task.cancelled() else self._task.exception()
        self._task, self._is_over = None, True
        if error:
            raise error

    async def _run(self) -> None:
        with Threads(1) as threads, ExitStack() as opened:
            try:
                self._job = await threads.run(self._make_job)
                pipeline = await threads.run(opened.enter_context, self._job.opened(lambda: [self._queue]))
                self._pipeline = pipeline
                if self._is_stopped:
                    self.stop()
                await self._ends_with_queue(asyncio.create_task(pipeline.run()))
            finally:
                await threads.run(opened.close)

    async def _ends_with_queue(self, running: asyncio.Task[None]) -> None:
        """Wait for a pipeline; when cancelled, first let the thread go that waits for room in the queue."""
        try:
            await asyncio.wait([running])
        except asyncio.CancelledError:
            self._queue.abandon()
            running.cancel()
            await finished(running)
            if not running.cancelled():
                running.exception()  # a cancellation ends more than that
            raise
        await running


class _QueueSink:
    """A bounded queue from the threads of a pipeline to a program on the event loop."""

    def __init__(self) -> None:
        self._items: deque[Emission] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._is_abandoned = self._has_ended = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._woken = asyncio.Event()
        self.peak = 0

    def __len__(self) -> int:
        return len(self._items)

    def serve(self, loop: asyncio.AbstractEventLoop) -> None:
        """Take emissions for a program on this loop."""
        self._loop = loop

    def write(self, emissions: Sequence[Emission]) -> None:
        """Add emissions as soon as there is room, or none once the queue is abandoned."""
        weight = emissions.nbytes if isinstance(emissions, EmissionBatch) else 0

        def has_room() -> bool:
            if len(self._items) + len(emissions) > _WAITING:
                return False
            return not self._items or self._bytes + weight <= _WAITING_BYTES

        with self._changed:
            self._changed.wait_for(lambda: self._is_abandoned or has_room())
            if self._is_abandoned:
                return
            self._items += emissions
            self._bytes += weight
            self.peak = max(self.peak, len(self._items))
        if self._loop:
            with suppress(RuntimeError):  # the loop is closed: its program is gone
                self._loop.call_soon_threadsafe(self._woken.set)

    def close(self, *, failed: bool) -> None:
        """Do nothing: the end is told when all else is closed, too."""

    def abandon(self) -> None:
        """Drop everything, now and later: the program wants no more."""
        with self._changed:
            self._is_abandoned = True
            self._items.clear()
            self._changed.notify_all()

    def end(self) -> None:
        """Nothing more comes. Call from the loop's thread."""
        self._has_ended = True
        self._woken.set()

    async def take(self) -> list[Emission]:
        """What waits, at least one emission; none at the end. Lets others run before it returns."""
        await asyncio.sleep(0)
        while True:
            self._woken.clear()
            with self._changed:
                taken = list(self._items)
                self._items.clear()
                self._bytes = 0
                self._changed.notify_all()
            if taken or self._has_ended:
                return taken
            await self._woken.wait()
