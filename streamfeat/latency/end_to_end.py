"""End to end: from the time that events are due to the time that a sink holds the emission.

Lives here: running the real pipeline at the pace of the recording, with a watch at both ends.
Not here: the pipeline itself, which is not changed and not told; a single update (`update`).

At recorded pace the pipeline hands on packets, cut to at most 10 ms of the clock, when their latest event
is due by the clock. A latency is the time from there until an emission that reflects this packet is handed
to the sink. It includes waiting in both queues, two changes of thread on either side, feeding, making the
emission and, under `event`, the 256 emissions that travel together. It does not include the time before a
packet is complete (an event waits for the rest of its 10 ms) and the work of a sink afterwards. When the
machine cannot keep the pace, packets are handed on late, and latency, which counts from when they were due,
grows: a source that waits hides nothing. Silence between labelled samples is cut to one window.
"""

import asyncio
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from time import monotonic_ns, perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.recordings.reader import Label, Packet
from streamfeat.stream.batch import EmissionBatch
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.session import Session, StreamItem

__all__ = ["measure_end_to_end", "without_silence"]

Item = Packet | Label

_ASK_EVERY_S = 0.05


def measure_end_to_end(
    encoder: Encoder,
    items: Iterable[Item],
    policy: EmitPolicy,
    *,
    speed: float,
    look_ahead: bool,
    threads: int = 1,
    warm_up: Iterable[Item] = (),
    goes: Callable[[], bool] = lambda: True,
) -> NDArray[np.int64]:
    """Run a stream through the pipeline at its pace.

    Args:
        encoder: the frozen encoder.
        items: packets and labels in stream order; iterated in a thread of the pipeline's own.
        policy: when features are read.
        speed: stream seconds for each second of the clock.
        look_ahead: whether engines look ahead where the policy reads after every event.
        threads: of the engines, see `Engine`.
        warm_up: items that run through the same parts beforehand, as fast as possible.
        goes: asked 20 times a second whether to go on.

    Returns:
        nanoseconds for each emission, in order, `(n,)` int64.

    Raises:
        InputError: a sensor has so many volumes that sums could overflow.
    """
    engine = partial(_engine, look_ahead)
    warming = _WatchedSession(encoder, policy, clock=perf_counter, engine=engine, threads=threads)
    warmed: Pipeline[Item, Emission] = Pipeline(warm_up, warming, [_WatchedSink()])
    asyncio.run(warmed.run())
    started: list[tuple[int, int]] = []

    def note(t_us: int) -> None:
        if not started:
            started.append((monotonic_ns(), t_us))

    session = _WatchedSession(encoder, policy, clock=perf_counter, engine=engine, threads=threads)
    sink = _WatchedSink()
    pipeline: Pipeline[Item, Emission] = Pipeline(
        without_silence(items, encoder.geometry.window_us),
        session,
        [sink],
        speed=speed,
        on_progress=note,
    )
    stopped_ns = asyncio.run(_run(pipeline, goes))
    arrived_ns, brought_by_us = (np.array(v, np.int64) for v in (sink.arrived_ns, session.brought_by_us))
    if len(arrived_ns) == 0:
        return arrived_ns
    ((started_ns, first_us),) = started
    due_ns = started_ns + np.round((brought_by_us - first_us) * (1000 / speed)).astype(np.int64)
    # A stop ends the wait for a packet that is not due yet.
    return (arrived_ns - due_ns)[due_ns <= stopped_ns]


def without_silence(items: Iterable[Item], gap_us: int) -> Iterator[Item]:
    """The same stream with the silence between labelled samples cut to `gap_us`, times moved accordingly."""
    shift_us, end_us = 0, None
    for item in items:
        if isinstance(item, Label):
            if end_us is not None:
                shift_us += max(item.start_us - end_us - gap_us, 0)
            end_us = item.start_us + item.duration_us
            yield replace(item, start_us=item.start_us - shift_us)
        else:
            events = item.events.copy()
            events["t"] -= shift_us
            yield replace(item, events=events)


async def _run(pipeline: Pipeline[Item, Emission], goes: Callable[[], bool]) -> int:
    """Run until the end or until it goes no more; when that was, in nanoseconds of the clock."""
    loop = asyncio.get_running_loop()
    stopped: list[int] = []

    def ask() -> None:
        if goes():
            loop.call_later(_ASK_EVERY_S, ask)
        else:
            stopped.append(monotonic_ns())
            pipeline.stop()

    ask()
    await pipeline.run()
    return stopped[0] if stopped else monotonic_ns()


def _engine(may_look_ahead: bool, *arguments: Any, look_ahead: bool, **options: Any) -> Engine:
    return Engine(*arguments, look_ahead=look_ahead and may_look_ahead, **options)


class _WatchedSession(Session):
    """Notes for each emission the stream time of the item that brought it about."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.brought_by_us: list[int] = []
        self._latest_us = 0

    def batches(self, item: StreamItem, /) -> Iterator[EmissionBatch]:
        if isinstance(item, Label):
            self._latest_us = max(self._latest_us, item.start_us)
        elif isinstance(item, Packet) and len(item.events):
            self._latest_us = max(self._latest_us, int(item.events["t"].max()))
        for batch in super().batches(item):
            self.brought_by_us += [self._latest_us] * len(batch)
            yield batch

    def last_batches(self) -> Iterator[EmissionBatch]:
        """Emit nothing: the measurement ends the stream, not the recording."""
        return iter(())


class _WatchedSink:
    """Notes when each emission arrives."""

    def __init__(self) -> None:
        self.arrived_ns: list[int] = []

    def write(self, emissions: Sequence[Emission]) -> None:
        self.arrived_ns += [monotonic_ns()] * len(emissions)

    def close(self, *, failed: bool) -> None:
        """Nothing is held open."""
