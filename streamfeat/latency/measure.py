"""One latency report: every model with every emission policy, update and end to end.

Lives here: opening what a report needs, the order of measurements, rows, the result as JSON values.
Not here: the measurements (`update`, `end_to_end`), how rows look (`picture`, `cli`).
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.engine.threads import usable_threads
from streamfeat.errors import InputError
from streamfeat.files.locations import Location
from streamfeat.latency.end_to_end import measure_end_to_end
from streamfeat.latency.histogram import Latencies
from streamfeat.latency.others import Method, walk_method
from streamfeat.latency.stopwatch import clock_cost_ns, follow_timed, python_clock_cost_ns
from streamfeat.latency.update import Walk, call_each, feed_and_read, walk
from streamfeat.recordings.options import AS_IT_IS, ReadOptions
from streamfeat.recordings.reader import Label, Packet, Recording, open_recording
from streamfeat.report.machine import Disturbance, describe_machine
from streamfeat.stream.compiling import state_of
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.replay import items_of_split

__all__ = ["LatencyReport", "Model", "Row"]

Item = Packet | Label
Report = Callable[[str, int, int, str], None]

_MOST_SECONDS = 3600.0


@dataclass(frozen=True, slots=True)
class Model:
    """A model under a name that tells it from the others."""

    name: str
    encoder: Encoder

    def describe(self) -> dict[str, Any]:
        """Name and size, as JSON values."""
        encoder, geometry = self.encoder, self.encoder.geometry
        return {
            "model": self.name,
            "formulation": encoder.formulation,
            "encoding": encoder.encoding,
            "filters": encoder.n_filters,
            "patch": geometry.patch_name,
            "stride": geometry.stride,
            "bins": geometry.n_bins,
            "volume_bins": geometry.depth,
            "bin_us": geometry.bin_us,
            "downsample": geometry.downsample,
            "scales": len(encoder.scales),
        }


@dataclass(frozen=True, slots=True)
class Row:
    """One distribution.

    Attributes:
        model: the model or method that was measured.
        emit: under which policy.
        what: the part of the way.
        latencies: their distribution.
        boundary_share: share of events that began a new bin, where that is known.
        walk: each event by itself, where each was timed by itself.
    """

    model: Model | Method
    emit: str
    what: str
    latencies: Latencies
    boundary_share: float | None = None
    walk: Walk | None = None


class LatencyReport:
    """Measures the latency of models on a recording.

    Args:
        recording: MCAP file.
        models: files of encoders.
        emits: emission policies, see `EmitPolicy.parse`.
        topic: event topic, where there are several.
        reading: how to read the recording.
        split: measure on samples of this split only.
        warm_up: events at the start that run but are not counted.
        limit_events: events to count at most in each measurement of updates.
        seconds: clock seconds that each measurement takes at most.
        speed: of the end to end, a multiple of the recorded pace.
        look_ahead: prepare bin boundaries beforehand where every event is followed.
        threads: that share a large emission, see `usable_threads`.
        methods: methods of others whose updates are measured as well, see `others`.

    Raises:
        InputError: a file cannot be used, the parts do not fit each other, or an argument makes no sense.
    """

    def __init__(
        self,
        recording: Location,
        models: Sequence[Path],
        emits: Sequence[str],
        *,
        topic: str | None = None,
        reading: ReadOptions = AS_IT_IS,
        split: str | None = None,
        warm_up: int = 2_000,
        limit_events: int = 50_000,
        seconds: float = 2.0,
        speed: float = 1.0,
        look_ahead: bool = True,
        threads: int | None = None,
        methods: Sequence[str] = (),
    ) -> None:
        """Open and check everything, without measuring."""
        for name, value, most in (("--seconds", seconds, _MOST_SECONDS), ("--speed", speed, 1e9)):
            if not 0 < value < most:
                raise InputError(
                    f"{name} {value:g} is not possible; give a number above zero, below {most:g}"
                )
        for name, count, least in (("--warm-up", warm_up, 0), ("--limit-events", limit_events, 1)):
            if count < least:
                raise InputError(f"{name} {count} is not possible; give at least {least}")
        self._policies = [(emit, EmitPolicy.parse(emit)) for emit in dict.fromkeys(emits)]
        self._recording, self._topic, self._split = recording, topic, split
        self._reading, self._threads = reading, usable_threads(threads)
        self._warm_up, self._limit = warm_up, limit_events
        self._seconds, self._speed, self._look_ahead = seconds, speed, look_ahead
        self._methods = [Method(name) for name in dict.fromkeys(methods)]
        names = [path.stem for path in models]
        self._models = [
            Model(path.stem if names.count(path.stem) == 1 else str(path), Encoder.load(path))
            for path in models
        ]
        with open_recording(recording, topic, reading) as rec:
            self.assumptions = rec.assumptions
            self._items = self._load(rec)
        self.rows: list[Row] = []
        self.interrupted = False
        self.clock_ns = self.python_clock_ns = 0.0
        self.steal: float | None = None
        self.preemptions = 0

    @property
    def states(self) -> list[str]:
        """The kind of state that engines of each model have, see `compiling.state_of`."""
        return [state_of(model.encoder) for model in self._models]

    def compile(self) -> None:
        """Let numba compile what `run` will call, and measure what reading the clock costs."""
        packet = next(item for item in self._items if isinstance(item, Packet) and len(item.events))
        first = packet.events[:1].copy()
        for model in self._models:
            engine = Engine(model.encoder, packet.resolution, look_ahead=self._look_ahead)
            engine.feed(first)
            engine.follow(first)
            follow_timed(engine, first)
            engine.advance(int(first["t"][0]) + model.encoder.geometry.window_us)
            engine.features()
        for method in self._methods:
            walk_method(method, [replace(packet, events=first)], warm_up=0, goes=lambda done: True)
        self.clock_ns, self.python_clock_ns = clock_cost_ns(), python_clock_cost_ns()

    def run(self, report: Report, stopped: Callable[[], bool]) -> None:
        """Measure; `rows` grows as it goes. To be called after `compile`.

        Args:
            report: told (step, done, of how many, remark).
            stopped: asked often whether to end early, with what has been measured so far.
        """
        disturbance = Disturbance()
        with open_recording(self._recording, self._topic, self._reading) as rec:
            for model in self._models:
                for emit, policy in self._policies:
                    found = self._rows_of(_Job(model, emit, policy, rec, report, stopped))
                    self.rows += [row for row in found if row.latencies.n or not stopped()]
            for method in self._methods:
                if not stopped():
                    self.rows.append(self._update_of(method, report, stopped))
        self.interrupted = stopped()
        self.steal, self.preemptions = disturbance.steal_share(), disturbance.preemptions()

    def result(self) -> dict[str, Any]:
        """The measurements as JSON values."""
        return {
            "recording": str(self._recording),
            "machine": describe_machine(),
            "clock_ns": self.clock_ns,
            "python_clock_ns": self.python_clock_ns,
            "steal_share": None if self.steal is None else round(self.steal, 4),
            "preemptions": self.preemptions,
            "warm_up_events": self._warm_up,
            "limit_events": self._limit,
            "seconds": self._seconds,
            "speed": self._speed,
            "look_ahead": self._look_ahead,
            "threads": self._threads,
            "interrupted": self.interrupted,
            "models": [*(m.describe() for m in self._models), *(m.describe() for m in self._methods)],
            "rows": [
                {"model": row.model.name, "emit": row.emit, "what": row.what}
                | ({} if row.boundary_share is None else {"boundary_share": round(row.boundary_share, 6)})
                | row.latencies.figures()
                | {"histogram": row.latencies.encode()}
                for row in self.rows
            ],
        }

    def _load(self, rec: Recording) -> list[Item]:
        wanted = self._warm_up + self._limit
        items = list(_first_events(items_of_split(rec.items(), self._split), wanted))
        events = sum(len(item.events) for item in items if isinstance(item, Packet))
        if self._split is not None and not items:
            raise InputError(f"{self._recording}: has no samples of split {self._split!r}")
        if events == 0:
            raise InputError(f"{self._recording}: has no events to measure with")
        if events <= self._warm_up:
            raise InputError(
                f"{self._recording}: its {events:,} events are not more than the warm-up of "
                f"{self._warm_up:,}; give a longer recording or a smaller --warm-up"
            )
        return items

    def _update_of(self, method: Method, report: Report, stopped: Callable[[], bool]) -> Row:
        goes = self._budget(partial(report, f"{method.name}, event"), stopped, "update")
        took = walk_method(method, self._items, warm_up=self._warm_up, goes=goes)
        return Row(method, "event", "update", Latencies(took))

    def _rows_of(self, job: "_Job") -> Iterator[Row]:
        if job.policy == EmitPolicy("events", 1):
            steps = [self._updates, self._calls, self._end_to_end]
        else:
            steps = [self._emissions, self._end_to_end]
        for step in steps:
            if not job.stopped():
                yield from step(job)

    def _updates(self, job: "_Job") -> Iterator[Row]:
        goes = self._budget(job.tell, job.stopped, "update")
        found = walk(
            job.model.encoder, self._items, look_ahead=self._look_ahead, warm_up=self._warm_up, goes=goes
        )
        share = float(found.begins_bin.mean()) if len(found.ns) else 0.0
        yield job.row("update", Latencies(found.ns), boundary_share=share, walk=found)
        yield job.row("bin boundary", Latencies(found.ns[found.begins_bin]))

    def _calls(self, job: "_Job") -> Iterator[Row]:
        goes = self._budget(job.tell, job.stopped, "from Python")
        found = call_each(
            job.model.encoder, self._items, look_ahead=self._look_ahead, warm_up=self._warm_up, goes=goes
        )
        yield job.row("from Python", Latencies(found.ns))

    def _emissions(self, job: "_Job") -> Iterator[Row]:
        goes = self._budget(job.tell, job.stopped, "feed and read")
        found = feed_and_read(job.model.encoder, self._items, job.policy, warm_up=self._warm_up, goes=goes)
        each_event = np.round(found.batch_ns / found.batch_events).astype(np.int64)
        yield job.row("ingest", Latencies(each_event, found.batch_events))
        yield job.row("emission", Latencies(found.emission_ns))

    def _end_to_end(self, job: "_Job") -> Iterator[Row]:
        ends: list[float] = []

        def goes() -> bool:
            if not ends:  # what warms up comes before the first question
                job.tell(0, 0, f"end to end, {self._seconds:g} s")
                ends.append(time.monotonic() + self._seconds)
            going = time.monotonic() < ends[0] and not job.stopped()
            if not going:
                job.tell(0, 0, "end to end, what is still queued")
            return going

        took = measure_end_to_end(
            job.model.encoder,
            items_of_split(job.recording.items(), self._split),
            job.policy,
            speed=self._speed,
            look_ahead=self._look_ahead,
            threads=self._threads,
            warm_up=_first_events(self._items, self._warm_up),
            goes=goes,
        )
        yield job.row("end to end", Latencies(took))

    def _budget(
        self, tell: Callable[[int, int, str], None], stopped: Callable[[], bool], what: str
    ) -> Callable[[int], bool]:
        """Says, told how many events are done, whether to go on; the clock starts after the warm-up."""
        ends: list[float] = []
        total = self._warm_up + self._limit

        def goes(done: int) -> bool:
            tell(done, total, what)
            if done >= self._warm_up and not ends:
                ends.append(time.monotonic() + self._seconds)
            return not stopped() and (not ends or time.monotonic() < ends[0])

        return goes


@dataclass(frozen=True, slots=True)
class _Job:
    """One model with one policy, and whom to tell and ask meanwhile."""

    model: Model
    emit: str
    policy: EmitPolicy
    recording: Recording
    report: Report
    stopped: Callable[[], bool]

    def row(self, what: str, latencies: Latencies, **more: Any) -> Row:
        return Row(self.model, self.emit, what, latencies, **more)

    def tell(self, done: int, total: int, what: str) -> None:
        self.report(f"{self.model.name}, {self.emit}", done, total, what)


def _first_events(items: Iterable[Item], n: int) -> Iterator[Item]:
    """Items until `n` events are there; the packet that has the last of them is cut."""
    for item in items:
        if isinstance(item, Packet):
            item = replace(item, events=item.events[:n])
            n -= len(item.events)
        yield item
        if n <= 0:
            return
