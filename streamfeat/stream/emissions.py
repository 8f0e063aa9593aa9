"""Emissions for asyncio programs: a recording replayed inside a loop that is running already.

Lives here: `replay`, and the bounded channel between a pipeline's threads and whatever iterates.
Not here: the pipeline (`pipeline`), signals and files (`streamfeat.stream.replay`).
"""

import asyncio
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Sequence
from os import PathLike
from pathlib import Path

from streamfeat.classify.classifier import Classifier
from streamfeat.classify.kernel import KernelClassifier, load_classifier
from streamfeat.engine.encoder import Encoder
from streamfeat.files.locations import StoreLocation
from streamfeat.messages.packets import Label, Packet
from streamfeat.recordings.reader import open_recording
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.replay import items_of_split
from streamfeat.stream.session import Session
from streamfeat.stream.state import SessionStats

__all__ = ["Emissions", "replay"]

_HELD_GROUPS = 8


class _Channel:
    """A sink whose emissions are taken in a loop. Holds at most eight groups; then the pipeline waits."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._groups: deque[Sequence[Emission]] = deque()
        self._changed = threading.Condition()
        self._has_more = asyncio.Event()
        self._ended = self._shut = False

    def write(self, emissions: Sequence[Emission], /) -> None:
        with self._changed:
            self._changed.wait_for(lambda: len(self._groups) < _HELD_GROUPS or self._shut)
            if not self._shut:
                self._groups.append(emissions)
        self._loop.call_soon_threadsafe(self._has_more.set)

    def close(self, *, failed: bool) -> None:
        self._ended = True
        self._has_more.set()  # sinks are closed on the loop's thread

    def shut(self) -> None:
        """Nothing is taken any more: what is written is left out, and nothing waits for room."""
        with self._changed:
            self._shut = True
            self._changed.notify_all()

    async def take(self) -> Sequence[Emission] | None:
        """The next group, or None at the end."""
        while True:
            with self._changed:
                if self._groups:
                    self._changed.notify_all()
                    return self._groups.popleft()
                if self._ended:
                    return None
                self._has_more.clear()
            await self._has_more.wait()


class Emissions:
    """What `replay` gives: iterate it with `async for`, once.

    Args:
        source: of the recording.
        session: makes the emissions.
        topic: of the events, where the recording has several.
        split: samples of this split only.
        speed: stream seconds for each second of the clock; None for as fast as possible.
    """

    def __init__(
        self,
        source: str | PathLike[str] | StoreLocation,
        session: Session,
        *,
        topic: str | None,
        split: str | None,
        speed: float | None,
    ) -> None:
        """Nothing runs before iteration."""
        self._source, self._session = source, session
        self._topic, self._split, self._speed = topic, split, speed

    def stats(self) -> SessionStats:
        """What has been done so far, a copy."""
        return self._session.stats()

    async def __aiter__(self) -> AsyncIterator[Emission]:
        """Yield emissions in order; threads and files are gone when iteration ends, however it ends."""
        channel = _Channel(asyncio.get_running_loop())
        with open_recording(self._source, self._topic) as recording:
            items = items_of_split(recording.played(loop=False), self._split)
            pipeline: Pipeline[Packet | Label, Emission] = Pipeline(
                items, self._session, [channel], speed=self._speed
            )
            running = asyncio.create_task(pipeline.run())
            try:
                while (group := await channel.take()) is not None:
                    for emission in group:
                        yield emission
                await running
            finally:
                channel.shut()
                pipeline.stop()
                cancelled = False
                while not running.done():  # threads first, or files would be closed under them
                    try:
                        await asyncio.wait([running])
                    except asyncio.CancelledError:
                        cancelled = True
                if not running.cancelled():
                    running.exception()  # was raised above, or iteration was left before it came
                if cancelled:
                    raise asyncio.CancelledError


def replay(
    recording: str | PathLike[str] | StoreLocation,
    model: str | PathLike[str] | Encoder,
    classifier: str | PathLike[str] | Classifier | KernelClassifier | None = None,
    *,
    emit: str = "auto",
    speed: float | None = None,
    topic: str | None = None,
    split: str | None = None,
) -> Emissions:
    """Replay a recording inside a running asyncio loop, with what the command `streamfeat replay` computes.

        async for emission in sf.replay("rec.mcap", "model.safetensors", emit="10ms"):
            print(emission.t_us, emission.features)

    At most eight groups of 256 emissions wait to be taken; then the replay waits. Leaving the loop, an error
    or a cancellation ends the threads and closes the file; use `contextlib.aclosing` on the iterator where
    that must have happened before the next line.

    Args:
        recording: whatever `open_recording` opens.
        model: an encoder, or its file.
        classifier: to predict with, or its file.
        emit: how often, see `EmitPolicy.parse`.
        speed: stream seconds for each second of the clock; None for as fast as possible.
        topic: event topic, where there are several.
        split: replay only samples of this split.

    Raises:
        InputError: a file cannot be used, the parts do not fit each other, or `emit` makes no sense; errors
            of the recording come out of the iteration.
    """
    encoder = model if isinstance(model, Encoder) else Encoder.load(Path(model))
    if isinstance(classifier, str | PathLike):
        classifier = load_classifier(Path(classifier))
    session = Session(encoder, EmitPolicy.parse(emit), classifier, clock=time.perf_counter)
    return Emissions(recording, session, topic=topic, split=split, speed=speed)
