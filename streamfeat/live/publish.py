"""Recordings as live cameras.

Lives here: one or several recordings played to topics, at their pace or another, once or for ever.
Not here: reading (`recordings`), pacing (`stream.pacing`), the network (`network`, `publisher`).
"""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any

import zenoh

from streamfeat.errors import InputError
from streamfeat.files.locations import Location
from streamfeat.live.names import Names
from streamfeat.live.network import THIS_MACHINE, Network
from streamfeat.live.publisher import CameraSink
from streamfeat.messages.cdr import EventPacket, LabelMessage
from streamfeat.messages.packets import Label, Packet, PacketWriter
from streamfeat.recordings.options import AS_IT_IS, ReadOptions
from streamfeat.recordings.reader import open_recording
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.signals import run_until_interrupted
from streamfeat.stream.sinks import open_sinks

__all__ = ["PublishJob"]

_POLL_S = 0.01


class PublishJob:
    """Plays recordings to topics, each on its own.

    Args:
        sources: recordings, with the topic of each.
        names: plain or ROS 2.
        topic: event topic of the recordings, where they have several.
        reading: how to read the recordings.
        speed: stream seconds for each second of the clock; None for as fast as subscribers take them.
        loop: start again at the end, with times that go on.
        encoding: of the payloads.
        wait_s: how long to wait for a subscriber.
        network: where to publish; `reliable` keeps packets for readers that missed them.

    Raises:
        InputError: a recording cannot be read, or an argument makes no sense.
    """

    def __init__(
        self,
        sources: list[tuple[Location, str]],
        names: Names,
        *,
        topic: str | None = None,
        reading: ReadOptions = AS_IT_IS,
        speed: float | None = 1.0,
        loop: bool = False,
        encoding: str = "mono",
        wait_s: float = 1.0,
        network: Network = THIS_MACHINE,
    ) -> None:
        """Check the arguments."""
        if not 0 <= wait_s < 1e9:
            raise InputError(f"--wait {wait_s}: give seconds from 0 on")
        topics = [topic for _, topic in sources]
        if len(set(topics)) < len(topics) or any("*" in topic for topic in topics):
            raise InputError(f"each recording needs a topic of its own, without wildcards, not {topics}")
        self.assumptions: list[str] = []
        for path, _ in sources:
            with open_recording(path, topic, reading) as recording:
                self.assumptions += recording.assumptions
        PacketWriter(encoding)
        self._sources, self._names = sources, names
        self._topic, self._reading = topic, reading
        self._speed, self._loop, self._encoding = speed, loop, encoding
        self._wait_s, self._network = wait_s, network
        self._cutters: list[_Cutter] = []
        self._sinks: list[CameraSink] = []
        self._seconds = 0.0
        self.interrupted = False

    def run(
        self, report: Callable[[str, int, int, str], None] = lambda step, done, total, remark: None
    ) -> None:
        """Publish to the end, or to the first SIGINT or SIGTERM.

        Args:
            report: called with (step, done, of how many, remark) as packets and labels are read, from a
                thread.
        """
        # Only a publisher without a pace can wait for subscribers; a camera cannot.
        options = {"block": self._speed is None, "reliable": self._network.reliable}
        with self._network.open() as session, ExitStack() as recordings:
            self._sinks = open_sinks(
                *(partial(CameraSink, session, self._names, topic, **options) for _, topic in self._sources)
            )
            self._cutters = [_Cutter(self._encoding) for _ in self._sources]
            pipelines: list[Pipeline[Packet | Label, EventPacket | LabelMessage]] = []
            for (path, topic), cutter, sink in zip(self._sources, self._cutters, self._sinks, strict=True):
                _wait_for_readers(session, self._names.key(topic, EventPacket.SCHEMA_NAME), self._wait_s)
                items = recordings.enter_context(open_recording(path, self._topic, self._reading)).played(
                    loop=self._loop,
                    report=lambda n, total, topic=topic: report(f"publishing {topic}", n, total, ""),  # type: ignore[misc]
                )
                pipelines.append(Pipeline(items, cutter, [sink], speed=self._speed))
            started = time.perf_counter()
            self.interrupted = run_until_interrupted(pipelines)
            self._seconds = time.perf_counter() - started

    def result(self) -> dict[str, Any]:
        """What happened, as JSON values."""
        events = sum(cutter.events for cutter in self._cutters)
        return {
            "topics": [topic for _, topic in self._sources],
            "packets": sum(sink.events.seq for sink in self._sinks),
            "events": events,
            "bytes": sum(sink.n_bytes for sink in self._sinks),
            "seconds": round(self._seconds, 3),
            "events_per_s": round(events / max(self._seconds, 1e-9)),
            "interrupted": self.interrupted,
        }


class _Cutter:
    """Turns packets and labels into messages."""

    def __init__(self, encoding: str) -> None:
        self._writer = PacketWriter(encoding)
        self._epoch = 0
        self.events = 0

    def batches(self, item: Packet | Label) -> Iterator[list[EventPacket | LabelMessage]]:
        if isinstance(item, Packet):
            if item.epoch != self._epoch:
                self._epoch = item.epoch
                self._writer.restart()
            for message in self._writer.messages(item.events, item.resolution):
                yield [message]
            self.events += len(item.events)
        else:
            stamp_ns, duration_ns = item.start_us * 1000, item.duration_us * 1000
            yield [LabelMessage(stamp_ns, "", duration_ns, item.label, item.split, item.source)]

    def last_batches(self) -> Iterator[list[EventPacket | LabelMessage]]:
        yield from ()

    def rest(self) -> None:
        pass


def _wait_for_readers(session: zenoh.Session, key: str, seconds: float) -> None:
    with session.declare_publisher(key) as probe:
        until = time.monotonic() + seconds
        # A status is an object, whatever its type hint says.
        while not probe.matching_status.matching and time.monotonic() < until:  # type: ignore[attr-defined]
            time.sleep(_POLL_S)
