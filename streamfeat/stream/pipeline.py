"""The asynchronous pipeline: source, processor and sinks, joined by bounded queues.

Lives here: its tasks and queues, and ending well.
Not here: what is computed (`session`, `cameras`), read (`recordings`, `live`) or written (`sinks`); pace and
groups (`pacing`), threads (`threads`), signals (`signals`).

Three tasks (`_Stages`): one reads and decodes, one runs the kernels, one writes. Blocking work happens in a
thread of each task's own; kernels and decoders release the GIL. Both queues are bounded, that of emissions by
their bytes, too: when one is full, the task that fills it waits, so a replay loses nothing and needs no more
memory than a few packets. A live source cannot make a camera wait: it has an inbox of its own, which says
what happens when it is full (`live.inbox`).

A live source also says when nothing more is there. If nothing is under way either, the thread that reads also
processes and writes (`_Bypass`): no other thread has anything to do meanwhile, and each hop between
threads and the loop costs about a tenth of a millisecond, more on a machine that is busy.

Ending: when the source is exhausted or `stop` is set, what is in the queues is processed and the sinks are
closed. When a task fails or `run` is cancelled, the tasks end as soon as their threads return, and the sinks
are closed as failed. Sinks are closed in a thread, and after all others have ended.
"""

import asyncio
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from streamfeat.stream.batch import EmissionBatch
from streamfeat.stream.pacing import Group, In, Pace, groups_of, stream_time
from streamfeat.stream.sinks import Sink
from streamfeat.stream.threads import Threads

__all__ = ["Pipeline", "PipelineStats", "Processor"]

Out = TypeVar("Out")
Taken = TypeVar("Taken", contravariant=True)
Made = TypeVar("Made", covariant=True)

_QUEUE_ITEMS = 8
_EMISSIONS_A_HOP, _BYTES_A_HOP = 256, 4 << 20
_MOST_OUT_BYTES = 64 << 20
"""Of emissions under way to the sinks, or a single part: features of one emission may have megabytes."""


@dataclass(slots=True)
class PipelineStats:
    """How far a pipeline has got, and what waits in its queues.

    Attributes:
        items: items read from the source.
        queued_in: groups of items that wait for the processor, at most 8.
        queued_out: groups of emissions that wait for the sinks, at most 8.
        dropped: items dropped; always 0, for a full queue makes the task before it wait.
        stopped: `stop` ended the source before its end.
    """

    items: int = 0
    queued_in: int = 0
    queued_out: int = 0
    dropped: int = 0
    stopped: bool = False


class Processor(Protocol[Taken, Made]):
    """Makes something of each item; is called from one thread at a time."""

    def batches(self, item: Taken, /) -> Iterator[Sequence[Made]]:
        """Take in one item, and yield what comes of it, some at a time."""

    def last_batches(self) -> Iterator[Sequence[Made]]:
        """Yield what is left when the items have ended."""

    def rest(self) -> None:
        """Work ahead while no item waits, for no longer than one item takes."""


class Pipeline(Generic[In, Out]):
    """Runs items through a processor into sinks, once.

    Example:
        >>> class Print:
        ...     def write(self, emissions):
        ...         print(sum(len(e.features) for e in emissions))
        ...     def close(self, *, failed):
        ...         print("failed" if failed else "done")
        >>> session = sf.Session(encoder, sf.EmitPolicy.parse("1000ev"))
        >>> asyncio.run(sf.Pipeline([], session, [Print()]).run())
        done

    Args:
        items: packets and labels in stream order, such as `recording.items()`; iterated in a thread. A live
            source gives None when nothing more is there at the moment, so that what is there need not wait.
        processor: what is done with them: a `Session`, for one.
        sinks: written to in this order, and closed in the reverse one.
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
        self._traffic: _Traffic[In, Out] = _Traffic()

    def stop(self) -> None:
        """End the source; what has been read is still processed and written. Call from the loop's thread."""
        self._traffic.stop.set()

    def stats(self) -> PipelineStats:
        """A copy of the counts, with the present depth of the queues."""
        return self._traffic.stats()

    async def run(self) -> None:
        """Run until the source ends or is stopped.

        Errors of any part come out as they were raised, but for those that an event loop would take for
        something else, see `Threads.run`. Cancelling ends the pipeline as a failure; it takes as long as the
        call of source, processor or sink that is under way.
        """
        failure: BaseException | None = None
        with Threads(3) as threads:
            bypass = _Bypass(self._processor, self._sinks, self._traffic, threads)
            stages = _Stages(self._processor, self._sinks, self._traffic, threads)
            try:
                async with asyncio.TaskGroup() as tasks:
                    tasks.create_task(
                        stages.read(
                            groups_of(self._items, self._speed), bypass, self._speed, self._on_progress
                        )
                    )
                    tasks.create_task(stages.compute())
                    tasks.create_task(stages.write())
            except BaseExceptionGroup as group:
                failure = group.exceptions[0]
            except BaseException as error:
                failure = error
            try:
                await threads.run(_close_all, self._sinks, failed=failure is not None)
            except BaseException:
                if failure is None:
                    raise
        if failure:
            raise failure


@dataclass(slots=True)
class _Traffic(Generic[In, Out]):
    """What is on its way through a pipeline; changed by its tasks, and by `_Bypass` when those are idle.

    Attributes:
        inbox: groups of items for the processor; None ends it.
        outbox: batches of emissions for the sinks; None ends it.
        out_bytes: of emissions that wait for the sinks or are being written.
        lighter: set when there are fewer of these.
        stop: set to end the source.
        under_way: groups and parts that were handed on and are not done with.
        items: items read.
        stopped: the source was stopped before its end.
    """

    inbox: asyncio.Queue[list[In] | None] = field(default_factory=lambda: asyncio.Queue(_QUEUE_ITEMS))
    outbox: asyncio.Queue[list[Sequence[Out]] | None] = field(
        default_factory=lambda: asyncio.Queue(_QUEUE_ITEMS)
    )
    out_bytes: int = 0
    lighter: asyncio.Event = field(default_factory=asyncio.Event)
    stop: asyncio.Event = field(default_factory=asyncio.Event)
    under_way: int = 0
    items: int = 0
    stopped: bool = False

    async def hand_out(self, part: list[Sequence[Out]]) -> None:
        """Give the sinks a part, as soon as all that they have is light enough."""
        weight = _weight(part)
        while self.out_bytes and self.out_bytes + weight > _MOST_OUT_BYTES:
            self.lighter.clear()
            await self.lighter.wait()
        self.out_bytes += weight
        self.under_way += 1
        await self.outbox.put(part)

    def written(self, part: list[Sequence[Out]]) -> None:
        """A part is done with."""
        self.out_bytes -= _weight(part)
        self.under_way -= 1
        self.lighter.set()

    def stats(self) -> PipelineStats:
        return PipelineStats(self.items, self.inbox.qsize(), self.outbox.qsize(), 0, self.stopped)


class _Connected(Generic[In, Out]):
    """A processor and its sinks, with what is on its way between them."""

    def __init__(
        self,
        processor: Processor[In, Out],
        sinks: Sequence[Sink[Out]],
        traffic: _Traffic[In, Out],
        threads: Threads,
    ) -> None:
        self._processor, self._sinks = processor, sinks
        self._traffic, self._threads = traffic, threads


class _Stages(_Connected[In, Out]):
    """The three tasks of a pipeline."""

    async def read(
        self,
        groups: Iterator[Group[In]],
        bypass: "_Bypass[In, Out]",
        speed: float | None,
        on_progress: Callable[[int], None],
    ) -> None:
        traffic = self._traffic
        pace = Pace(speed)
        while not traffic.stop.is_set():
            group = await self._threads.run(bypass.next_group, groups)
            if group is None:
                break
            t_us = stream_time(group)
            if speed is not None and t_us is not None:
                await self._sleep_until(pace.due(group[-1], t_us, time.monotonic()))
            traffic.under_way += 1
            await traffic.inbox.put(group)
            traffic.items += len(group)
            if t_us is not None:
                on_progress(t_us)
        traffic.stopped = traffic.stop.is_set()
        await traffic.inbox.put(None)

    async def _sleep_until(self, due: float) -> None:
        wait = due - time.monotonic()
        if wait > 0:
            try:
                await asyncio.wait_for(self._traffic.stop.wait(), wait)
            except TimeoutError:
                return

    async def compute(self) -> None:
        traffic, more = self._traffic, True
        while more:
            group = await traffic.inbox.get()
            more = group is not None
            batches = _batches(self._processor, group)
            # One packet can give as many emissions as it has events: they are handed on in parts.
            more_batches = True
            while more_batches:
                part, more_batches = await self._threads.run(_take, batches)
                if part:
                    await traffic.hand_out(part)
            traffic.under_way -= 1
        await traffic.outbox.put(None)

    async def write(self) -> None:
        while (part := await self._traffic.outbox.get()) is not None:
            for sink in self._sinks:
                await self._threads.run(_write, sink, part)
            self._traffic.written(part)


class _Bypass(_Connected[In, Out]):
    """Processes and writes in the reader's thread, as long as the other two would only wait for it."""

    def next_group(self, groups: Iterator[Group[In]]) -> list[In] | None:
        """The next group that the other tasks shall see to; None at the end, or when that has come early."""
        while not (self._traffic.stop.is_set() or self._threads.cancelled):
            found = next(groups, None)
            if found is None:
                return None
            # The other tasks can only finish what they have: the reader alone gives them more.
            if found.items and (found.more or self._traffic.under_way):
                return found.items
            for batch in _batches(self._processor, found.items):
                for sink in self._sinks:
                    sink.write(batch)
            self._traffic.items += len(found.items)
            if not self._traffic.under_way:
                self._processor.rest()
        return None


def _batches(processor: Processor[In, Out], group: list[In] | None) -> Iterator[Sequence[Out]]:
    if group is None:
        yield from processor.last_batches()
    else:
        for item in group:
            yield from processor.batches(item)


def _take(batches: Iterator[Sequence[Out]]) -> tuple[list[Sequence[Out]], bool]:
    """The next batches, as many as are worth a hop to another thread, and whether there may be more."""
    taken: list[Sequence[Out]] = []
    n = weight = 0
    for batch in batches:
        taken.append(batch)
        n += len(batch)
        weight += _weight([batch])
        if n >= _EMISSIONS_A_HOP or weight >= _BYTES_A_HOP:
            return taken, True
    return taken, False


def _weight(part: list[Sequence[Out]]) -> int:
    """Bytes of emissions; what is none weighs nothing."""
    return sum(batch.nbytes for batch in part if isinstance(batch, EmissionBatch))


def _write(sink: Sink[Out], batches: list[Sequence[Out]]) -> None:
    for batch in batches:
        sink.write(batch)


def _close_all(sinks: Sequence[Sink[Out]], *, failed: bool) -> None:
    """Close all, whatever becomes of each; once one has failed, the others close as failed."""
    first: BaseException | None = None
    for sink in reversed(sinks):
        try:
            sink.close(failed=failed or first is not None)
        except BaseException as error:
            first = first or error
    if first:
        raise first
