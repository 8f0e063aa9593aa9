"""Figures of a live job: counts for people and for Prometheus.

Lives here: recent latencies, one list of everything that is counted, and serving it over HTTP.
Not here: counting, which each part does for its own work.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any
from wsgiref.simple_server import WSGIServer

from prometheus_client import CollectorRegistry, Histogram, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from streamfeat.errors import InputError
from streamfeat.latency.histogram import RecentLatencies
from streamfeat.live.inbox import Inbox
from streamfeat.live.intake import Intake
from streamfeat.live.warnings import Warnings
from streamfeat.messages.delivery import DeliveryStats
from streamfeat.stream.batch import EmissionBatch, Emitter
from streamfeat.stream.cameras import CameraLeft, Cameras
from streamfeat.stream.emission import Emission
from streamfeat.stream.pipeline import PipelineStats
from streamfeat.stream.session import StreamItem

__all__ = ["CameraFigures", "Health", "parse_address"]

_BUCKETS = tuple(scale * base for scale in (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0) for base in (1, 2, 5))
_PERCENTILES = 50, 99
_TIMES = {
    "restarts": ("clock_restarts", "Cameras' clocks that started anew"),
    "jumps": ("clock_jumps", "Cameras' clocks that jumped ahead by more than a minute"),
    "wraps": ("clock_wraps", "Cameras' clocks that wrapped, which is undone"),
    "stray packets": ("stray_packets", "Packets with absurd times, which were left out"),
    "stray events": ("stray_events", "Events with absurd times, which were left out"),
}
"""Names and meanings of what timelines count."""


@dataclass(frozen=True, slots=True)
class CameraFigures:
    """Figures of one camera.

    Attributes:
        topic: of the camera.
        events: accepted.
        latest: the latest emission; None before the first.
    """

    topic: str
    events: int
    latest: Emission | None


class Health(Emitter):
    """Counts of one live job; a processor too, which times the cameras it wraps.

    Args:
        cameras: that process the items.
        intake: that received them.
        inbox: where messages wait.
        warnings: that were given.

    Attributes:
        queues: gives the depth of the pipeline's queues.
    """

    def __init__(self, cameras: Cameras, intake: Intake, inbox: Inbox, warnings: Warnings) -> None:
        """Start the clock."""
        self._cameras = cameras
        self._intake = intake
        self._inbox = inbox
        self._warnings = warnings
        self._started = time.monotonic()
        self.queues: Callable[[], PipelineStats] = PipelineStats
        self._server: WSGIServer | None = None
        self.registry = CollectorRegistry()
        self._update = Histogram(
            "streamfeat_update_latency_seconds",
            "From a packet's turn to its last emission",
            registry=self.registry,
            buckets=_BUCKETS,
        )
        self._end_to_end = Histogram(
            "streamfeat_end_to_end_latency_seconds",
            "From a packet's publication, by its publisher's clock, to that of its features",
            registry=self.registry,
            buckets=_BUCKETS,
        )
        self._recent_updates, self._recent_end_to_end = RecentLatencies(), RecentLatencies()
        self._latest: dict[str, EmissionBatch] = {}
        self.registry.register(self)

    def batches(self, item: StreamItem | CameraLeft, /) -> Iterator[EmissionBatch]:
        """Process an item with the cameras; the time that sinks take in between is not counted."""
        spent = 0.0
        made = self._cameras.batches(item)
        while True:
            started = time.perf_counter()
            batch = next(made, None)
            spent += time.perf_counter() - started
            if batch is None:
                break
            self._latest[batch.topic] = batch
            yield batch
        if self._server:  # or nobody reads it, and it is dearer than all other figures of a packet
            self._update.observe(spent)
        self._recent_updates.add(1e9 * spent)
        if isinstance(item, CameraLeft):
            self._latest.pop(item.topic, None)

    def rest(self) -> None:
        """Let the cameras work ahead."""
        self._cameras.rest()

    def last_batches(self) -> Iterator[EmissionBatch]:
        """End the cameras' streams."""
        yield from self._cameras.last_batches()

    def on_published(self, source_ns: int, now_ns: int) -> None:
        """Count how long it took from a packet's publication to that of its features."""
        if source_ns:
            seconds = (now_ns - source_ns) / 1e9
            if self._server:
                self._end_to_end.observe(seconds)
            self._recent_end_to_end.add(now_ns - source_ns)

    def serve(self, host: str, port: int) -> int:
        """Serve the metrics over HTTP in a thread of its own; gives the port.

        Raises:
            InputError: the address cannot be used.
        """
        try:
            self._server, _ = start_http_server(port, addr=host, registry=self.registry)
        except OSError as error:
            raise InputError(f"--metrics {host}:{port}: cannot listen there: {error.strerror}") from None
        return int(self._server.server_port)

    def stop_serving(self) -> None:
        """Close the server, if there is one."""
        if self._server:
            self._server.shutdown()
            self._server.server_close()

    def delivery(self) -> DeliveryStats:
        """Totals of all topics that are or were followed."""
        return self._intake.delivery()

    def figures(self) -> list[tuple[str, int, str]]:
        """Everything that is counted: name, value, and what it means."""
        stats, delivery = self._cameras.stats(), self.delivery()
        return [
            ("events", stats.events, "Events accepted"),
            ("late_events", stats.late, "Events older than the window"),
            ("rejected_events", stats.rejected, "Events outside the sensor or malformed"),
            ("emissions", stats.emissions, "Emissions of features"),
            ("incomplete_emissions", stats.incomplete, "Emissions of windows that packets are missing from"),
            ("packets", delivery.received, "Packets used"),
            ("lost_packets", delivery.lost, "Packets that never arrived: gaps in their sequence numbers"),
            ("unheard_packets", delivery.unheard, "Sequence numbers before the first packet of a camera"),
            ("dropped_packets", self._inbox.dropped, "Packets dropped because ingest could not keep up"),
            ("duplicate_packets", delivery.duplicates, "Packets that had arrived before"),
            ("reordered_packets", delivery.reordered, "Packets that arrived late"),
            ("foreign_packets", delivery.foreign, "Packets of a second publisher on the same key"),
            ("publisher_restarts", delivery.restarts, "Publishers that took over or began to count anew"),
            *self._times(),
            *self._left(),
        ]

    def _times(self) -> list[tuple[str, int, str]]:
        """What happened to the clocks of cameras, and to packets because of their times."""
        counts = self._intake.counts()
        return [(name, counts[of], text) for of, (name, text) in _TIMES.items()]

    def _left(self) -> list[tuple[str, int, str]]:
        """Packets of other shards: a sign of life for a shard without cameras; only with `--shard`."""
        left = self._inbox.left
        return [("other_shards_packets", left, "Packets of cameras of other shards")] if left else []

    def depths(self) -> list[tuple[str, int]]:
        """What waits in each queue."""
        pipeline = self.queues()
        return [
            ("inbox_messages", self._inbox.depth),
            ("session_groups", pipeline.queued_in),
            ("sink_groups", pipeline.queued_out),
        ]

    def latencies(self) -> list[tuple[str, list[tuple[str, float]]]]:
        """Seconds at some percentiles, of the latest updates and of the latest published features."""
        return [
            ("update", self._recent_updates.percentiles(*_PERCENTILES)),
            ("end to end", self._recent_end_to_end.percentiles(*_PERCENTILES)),
        ]

    def cameras(self) -> list[CameraFigures]:
        """Each camera that is served, in order of appearance."""
        return [
            CameraFigures(topic, stats.events, latest[-1] if (latest := self._latest.get(topic)) else None)
            for topic, stats in self._cameras.stats_by_topic().items()
        ]

    def collect(self) -> Iterable[Metric]:
        """Everything that is counted elsewhere, for Prometheus."""
        for name, value, text in self.figures():
            yield CounterMetricFamily(f"streamfeat_{name}", text, value=value)
        refused = CounterMetricFamily(
            "streamfeat_warnings", "Messages that were refused, and events worth a warning", labels=["reason"]
        )
        for reason, count in sorted(self.reasons().items()):
            refused.add_metric([reason], count)
        yield refused
        depth = GaugeMetricFamily("streamfeat_queue_depth", "Items that wait in each queue", labels=["queue"])
        for name, waiting in self.depths():
            depth.add_metric([name], waiting)
        yield depth
        yield GaugeMetricFamily("streamfeat_cameras", "Cameras served", value=len(self._cameras.topics))

    def drops(self) -> dict[str, int]:
        """Packets, and (`late`, `rejected`) events, that were not used or are worth a warning, by reason."""
        stats, delivery = self._cameras.stats(), self.delivery()
        return {
            "lost": delivery.lost,
            "unheard": delivery.unheard,
            "dropped": self._inbox.dropped,
            "duplicates": delivery.duplicates,
            "reordered": delivery.reordered,
            "restarts": delivery.restarts,
            "foreign": delivery.foreign,
            "late": stats.late,
            "rejected": stats.rejected,
        }

    def result(self) -> dict[str, Any]:
        """What happened, as JSON values."""
        stats, delivery = self._cameras.stats(), self.delivery()
        seconds = time.monotonic() - self._started
        result: dict[str, Any] = {
            "seconds": round(seconds, 3),
            "cameras": self._cameras.seen,
            "packets": delivery.received,
            "events": stats.events,
            "events_per_s": round(stats.events / max(seconds, 1e-9)),
            "emissions": stats.emissions,
            "incomplete": stats.incomplete,
            "samples": stats.samples,
        }
        if stats.correct is not None and stats.samples:
            result["correct"] = stats.correct
            result["accuracy"] = round(stats.correct / stats.samples, 4)
        result |= self.drops() | {name: value for name, value, _ in self._times()}
        result |= {"warnings": dict(sorted(self.reasons().items()))}
        result |= {name: left for name, left, _ in self._left()}
        for name, seconds in self._recent_end_to_end.percentiles(*_PERCENTILES):
            result[f"end_to_end_{name}_ms"] = round(1e3 * seconds, 3)
        return result

    def reasons(self) -> Counter[str]:
        """Messages that were refused, and events worth a warning, by reason."""
        return Counter(dict(list(self._warnings.counts.items())))


def parse_address(text: str) -> tuple[str, int]:
    """Read `HOST:PORT`.

    Raises:
        InputError: the text is something else.
    """
    host, colon, port = text.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise InputError(f"--metrics {text!r} is not understood; give HOST:PORT, such as 127.0.0.1:9100")
    return host, int(port)
