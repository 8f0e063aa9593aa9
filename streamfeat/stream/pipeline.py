"""The asynchronous pipeline: source, processor and sinks, joined by bounded queues.

Lives here: every task and queue of the package, pacing, and ending well.
Not here: what is computed (`session`, `cameras`), read (`recording`, `live`) or written (`sinks`).

Three tasks: one reads and decodes, one runs the kernels, one writes. Blocking work happens in a thread of
each task's own; kernels and decoders release the GIL. Both queues are bounded: when one is full, whoever
fills it waits, so a replay loses nothing and needs no more memory than a few packets. A live source cannot
make a camera wait: it has an inbox of its own, which says what it does when it is full (`live.inbox`).

A live source also says when nothing more is there. If nothing is under way either, the thread that reads
processes and writes what it has by itself: there is nobody to work beside, and each hop between threads and
the loop costs about a tenth of a millisecond, more on a machine that has other things to do.

Ending: when the source is exhausted or `stop` is set, what is in the queues is processed and the sinks are
closed. When a task fails, the others are cancelled and the sinks are closed as failed.
"""

import asyncio
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from threading import current_thread, main_thread
from types import TracebackType
from typing import Generic, Protocol, TypeVar

import numpy as np

from streamfeat.messages.packets import Label, Packet
from streamfeat.stream.sinks import Sink

__all__ = ["Pipeline", "PipelineStats", "Processor", "run_until_interrupted", "signals_wait"]

In = TypeVar("In")
Out = TypeVar("Out")
Taken = TypeVar("Taken", contravariant=True)
Made = TypeVar("Made", covariant=True)

_QUEUE_ITEMS = 8
_EVENTS_A_HOP = 32_768
"""Items are handed on in groups of about so many events: a hop between threads costs 50 to 100 us."""
_ITEMS_A_HOP = 256
_EMISSIONS_A_HOP = 256
_PACED_SLICE_US = 10_000
"""Paced packets are cut to this length of the clock, so that nothing waits for the end of a long packet."""


@dataclass(slots=True)
class PipelineStats:
    """What is under way.

    Attributes:
        items: items read from the source.
        queued_in: groups of items that wait for the processor, at most 8.
        queued_out: groups of emissions that wait for the sinks, at most 8.
        dropped: items dropped; always 0, a full queue makes its producer wait.
        stopped: the source was stopped before its end.
    """

    items: int = 0
    queued_in: int = 0
    queued_out: int = 0
    dropped: int = 0
    stopped: bool = False


class Processor(Protocol[Taken, Made]):
    """Makes something of each item; runs in a thread, one item at a time."""

    def process(self, item: Taken, /) -> Iterator[Made]:
        """Take in one item, and yield what comes of it."""

    def finish(self) -> Iterator[Made]:
        """The items have ended: yield what is left."""

    def rest(self) -> None:
        """Nothing waits at the moment: a chance to work ahead, as long as one item takes at most."""


class Pipeline(Generic[In, Out]):
    """Runs items through a processor into sinks.

    Args:
        items: in stream order; iterated in a thread of its own. None says that nothing more is there at the
            moment, so that what is need not wait.
        processor: what is done with them: a `Session`, for one.
        sinks: written to in this order.
        speed: stream seconds for each second of the clock; None for as fast as possible.
        on_progress: called on the event loop's thread after each group that is handed on, with stream time in
            microseconds.
    """

    def __init__(
        self,
        items: Iterable[In | None],
        processor: Processor[In, Out],
        sinks: Sequence[Sink[Out]],
        *,
        speed: float | None = None,
        on_progress: Callable[[int], None] = lambda t_us: None,
    ) -> None:
        """Nothing runs before `run`."""
        self._items = items
        self._processor = processor
        self._sinks = sinks
        self._speed = speed
        self._on_progress = on_progress
        self._inbox: asyncio.Queue[list[In] | None] = asyncio.Queue(_QUEUE_ITEMS)
        self._outbox: asyncio.Queue[list[Out] | None] = asyncio.Queue(_QUEUE_ITEMS)
        self._stop = asyncio.Event()
        self._has_ended = False
        self._under_way = 0
        self._stats = PipelineStats()

    def stop(self) -> None:
        """End the source; what has been read is still processed and written. Call from the loop's thread."""
        self._stop.set()

    def stats(self) -> PipelineStats:
        """A copy of the counts, with the present depth of the queues."""
        return replace(self._stats, queued_in=self._inbox.qsize(), queued_out=self._outbox.qsize())

    async def run(self) -> None:
        """Run until the source ends or is stopped. Errors of any part come out as they were raised."""
        with ExitStack() as closing:
            for sink in self._sinks:
                closing.push(partial(_close, sink))
            # Threads end before sinks are closed: a cancelled write may still be under way in one.
            with ThreadPoolExecutor(3, thread_name_prefix="streamfeat") as threads:
                try:
                    async with asyncio.TaskGroup() as tasks:
                        tasks.create_task(self._read(threads))
                        tasks.create_task(self._compute(threads))
                        tasks.create_task(self._write(threads))
                except BaseExceptionGroup as group:
                    raise group.exceptions[0] from None

    async def _read(self, threads: ThreadPoolExecutor) -> None:
        loop = asyncio.get_running_loop()
        if self._speed is None:
            groups = _full_groups(self._items)
        else:
            groups = _paced_groups(self._items, round(_PACED_SLICE_US * max(self._speed, 1.0)))
        pace = _Pace(self._speed)
        while not self._stop.is_set():
            try:
                group = await loop.run_in_executor(threads, self._advance, groups)
            except asyncio.CancelledError:
                self._has_ended = True
                raise
            if group is None:
                break
            t_us = _stream_time(group)
            if self._speed is not None and t_us is not None:
                await self._sleep_until(pace.due(group[-1], t_us, time.monotonic()))
            self._under_way += 1
            await self._inbox.put(group)
            self._stats.items += len(group)
            if t_us is not None:
                self._on_progress(t_us)
        self._stats.stopped = self._stop.is_set()
        await self._inbox.put(None)

    def _advance(self, groups: "Iterator[_Group[In]]") -> list[In] | None:
        """In the reader's thread: the next group to hand on. Does by itself what nobody need do beside it."""
        while not (self._stop.is_set() or self._has_ended):
            found = next(groups, None)
            if found is None:
                return None
            # Others can only finish what they have: nobody but the reader gives them more.
            if found.items and (found.more or self._under_way):
                return found.items
            emissions = self._emissions(found.items)
            while part := _take(emissions):
                for sink in self._sinks:
                    sink.write(part)
            self._stats.items += len(found.items)
            if not self._under_way:
                self._processor.rest()
        return None

    async def _sleep_until(self, due: float) -> None:
        wait = due - time.monotonic()
        if wait > 0:
            try:
                await asyncio.wait_for(self._stop.wait(), wait)
            except TimeoutError:
                return

    async def _compute(self, threads: ThreadPoolExecutor) -> None:
        loop = asyncio.get_running_loop()
        more = True
        while more:
            group = await self._inbox.get()
            more = group is not None
            emissions = self._emissions(group)
            # One packet can give as many emissions as it has events: they are handed on in parts.
            full = True
            while full:
                part = await loop.run_in_executor(threads, _take, emissions)
                if part:
                    self._under_way += 1
                    await self._outbox.put(part)
                full = len(part) == _EMISSIONS_A_HOP
            self._under_way -= 1
        await self._outbox.put(None)

    def _emissions(self, group: list[In] | None) -> Iterator[Out]:
        if group is None:
            yield from self._processor.finish()
        else:
            for item in group:
                yield from self._processor.process(item)

    async def _write(self, threads: ThreadPoolExecutor) -> None:
        loop = asyncio.get_running_loop()
        while (part := await self._outbox.get()) is not None:
            for sink in self._sinks:
                await loop.run_in_executor(threads, sink.write, part)
            self._under_way -= 1


_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def signals_wait() -> Iterator[None]:
    """SIGINT and SIGTERM wait until `run_until_interrupted` can hear them, or until the block ends.

    For opening sinks: a signal between opening them and running would leave half an output behind.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def run_until_interrupted(
    pipelines: Sequence[Pipeline[In, Out]], interrupt: Callable[[], None] | None = None
) -> bool:
    """Run pipelines side by side in a loop of their own; SIGINT and SIGTERM end them well.

    Args:
        pipelines: none of which has run.
        interrupt: what a signal does; if not given, it stops every pipeline.

    Returns:
        whether there was a signal.
    """
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
        # Only the main thread of a process can be told of signals.
        names = _SIGNALS if current_thread() is main_thread() else ()
        before = {name: signal.getsignal(name) for name in names}
        for name in names:
            loop.add_signal_handler(name, on_signal)
        mask = signal.pthread_sigmask(signal.SIG_UNBLOCK, names)
        try:
            async with asyncio.TaskGroup() as tasks:
                for pipeline in pipelines:
                    tasks.create_task(pipeline.run())
        except BaseExceptionGroup as group:
            raise group.exceptions[0] from None
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
            for name, handler in before.items():
                loop.remove_signal_handler(name)
                signal.signal(name, handler)

    asyncio.run(run())
    return interrupted


def _close(
    sink: Sink[Out],
    kind: type[BaseException] | None,
    value: BaseException | None,
    trace: TracebackType | None,
) -> None:
    sink.close(failed=kind is not None)


def _take(emissions: Iterator[Out]) -> list[Out]:
    return list(islice(emissions, _EMISSIONS_A_HOP))


@dataclass(slots=True)
class _Group(Generic[In]):
    """Items that go together, none if there are none at the moment; `more` may be there already."""

    items: list[In]
    more: bool = True


def _full_groups(items: Iterable[In | None]) -> Iterator[_Group[In]]:
    group: list[In] = []
    events = 0
    for item in items:
        if item is not None:
            group.append(item)
            events += len(item.events) if isinstance(item, Packet) else 0
        if item is None or events >= _EVENTS_A_HOP or len(group) == _ITEMS_A_HOP:
            yield _Group(group, more=item is not None)
            group, events = [], 0
    if group:
        yield _Group(group)


def _paced_groups(items: Iterable[In | None], slice_us: int) -> Iterator[_Group[In]]:
    for item in items:
        if item is None:
            continue
        if not isinstance(item, Packet) or len(item.events) == 0:
            yield _Group([item])
            continue
        latest = np.maximum.accumulate(item.events["t"])
        start = 0
        while start < len(latest):
            stop = int(np.searchsorted(latest, latest[start] + slice_us))
            yield _Group([replace(item, events=item.events[start:stop])])
            start = stop


class _Pace:
    """When items are due: stream time goes on across restarts of the camera's clock.

    Args:
        speed: stream seconds for each second of the clock; None for no pace.
    """

    def __init__(self, speed: float | None) -> None:
        self._speed = speed or 1.0
        self._epoch: int | None = None
        self._origin_us = self._passed_us = 0
        self._began_s = 0.0

    def due(self, item: object, t_us: int, now_s: float) -> float:
        """The clock's time for an item that is complete at stream time `t_us`."""
        if isinstance(item, Packet) and item.epoch != self._epoch:
            # The first packet of an epoch is due at once, the others by their distance from it.
            self._began_s = now_s if self._epoch is None else max(now_s, self._began_s + self._passed_s())
            self._epoch, self._origin_us = item.epoch, t_us
        elif self._epoch is None:
            self._epoch, self._origin_us, self._began_s = 0, t_us, now_s
        self._passed_us = max(t_us - self._origin_us, 0)
        return self._began_s + self._passed_s()

    def _passed_s(self) -> float:
        return self._passed_us / (1e6 * self._speed)


def _stream_time(group: Sequence[object]) -> int | None:
    """The time by which a group is complete: that of its latest event."""
    last = group[-1]
    if isinstance(last, Label):
        return last.start_us
    return int(last.events["t"].max()) if isinstance(last, Packet) and len(last.events) else None
