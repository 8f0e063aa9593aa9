"""One latency report: every model with every emission policy, update and whole hop.

Lives here: opening what a report needs, the order of measurements, rows, the result as JSON values.
Not here: the measurements (`update`, `hop`), how rows look (`picture`, `cli`).
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from streamfeat.emission import EmitPolicy
from streamfeat.encoder import Encoder
from streamfeat.engine import Engine
from streamfeat.errors import InputError
from streamfeat.latency.histogram import Latencies
from streamfeat.latency.hop import hop
from streamfeat.latency.stopwatch import clock_cost_ns, follow_timed, python_clock_cost_ns
from streamfeat.latency.update import Walk, call_each, feed_and_read, walk
from streamfeat.machine import StealClock, describe_machine
from streamfeat.recording import Label, Packet, Recording, open_recording
from streamfeat.replay import items_of_split

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
            "patch": geometry.patch,
            "stride": geometry.stride,
            "bins": geometry.n_bins,
            "bin_us": geometry.bin_us,
            "downsample": geometry.downsample,
        }


@dataclass(frozen=True, slots=True)
class Row:
    """One distribution.

    Attributes:
        model: what was measured.
        emit: under which policy.
        what: which part of it.
        latencies: how long it took.
        boundary_share: share of events that began a new bin, where that is known.
        walk: each event by itself, where each was timed by itself.
    """

    model: Model
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
        split: measure on samples of this split only.
        warm_up: events at the start that run but are not counted.
        limit_events: events to count at most in each measurement of updates.
        seconds: clock seconds that each measurement takes at most.
        speed: of the whole hop, a multiple of the recorded pace.
        look_ahead: prepare bin boundaries beforehand where every event is followed.

    Raises:
        InputError: a file cannot be used, the parts do not fit each other, or an argument makes no sense.
    """

    def __init__(
        self,
        recording: Path,
        models: Sequence[Path],
        emits: Sequence[str],
        *,
        topic: str | None = None,
        split: str | None = None,
        warm_up: int = 2_000,
        limit_events: int = 50_000,
        seconds: float = 3.0,
        speed: float = 1.0,
        look_ahead: bool = True,
    ) -> None:
        """Open and check everything; nothing is measured yet."""
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
        self._warm_up, self._limit = warm_up, limit_events
        self._seconds, self._speed, self._look_ahead = seconds, speed, look_ahead
        names = [path.stem for path in models]
        self._models = [
            Model(path.stem if names.count(path.stem) == 1 else str(path), Encoder.load(path))
            for path in models
        ]
        with open_recording(recording, topic) as rec:
            self._items = self._load(rec)
        self._check_fit(models)
        self.rows: list[Row] = []
        self.interrupted = False
        self.clock_ns: float | None = None
        self.python_clock_ns: float | None = None
        self.steal: float | None = None

    def run(self, report: Report, stopped: Callable[[], bool]) -> None:
        """Measure; `rows` grows as it goes.

        Args:
            report: told (step, done, of how many, remark).
            stopped: asked often whether to end early, with what has been measured so far.
        """
        steal = StealClock()
        report("compiling", 0, 0, "not counted")
        self._compile(self._models[0].encoder)
        report("compiling", 1, 1, "")
        self.clock_ns = clock_cost_ns()
        self.python_clock_ns = python_clock_cost_ns()
        with open_recording(self._recording, self._topic) as rec:
            for model in self._models:
                for emit, policy in self._policies:
                    for row in self._rows_of(model, emit, policy, rec, report, stopped):
                        if row.latencies.n or not stopped():
                            self.rows.append(row)
                        if stopped():
                            break
        self.interrupted = stopped()
        self.steal = steal.share()

    def result(self) -> dict[str, Any]:
        """What was measured, as JSON values."""
        return {
            "recording": str(self._recording),
            "machine": describe_machine(),
            "clock_ns": self.clock_ns,
            "python_clock_ns": self.python_clock_ns,
            "steal_share": None if self.steal is None else round(self.steal, 4),
            "warm_up_events": self._warm_up,
            "limit_events": self._limit,
            "seconds": self._seconds,
            "speed": self._speed,
            "look_ahead": self._look_ahead,
            "interrupted": self.interrupted,
            "models": [model.describe() for model in self._models],
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

    def _check_fit(self, paths: Sequence[Path]) -> None:
        for resolution in {item.resolution for item in self._items if isinstance(item, Packet)}:
            for path, model in zip(paths, self._models, strict=True):
                try:
                    model.encoder.geometry.grid_shape(resolution)
                except InputError as error:
                    raise InputError(f"{path}: does not fit {self._recording}: {error}") from error

    def _compile(self, encoder: Encoder) -> None:
        packet = next(item for item in self._items if isinstance(item, Packet) and len(item.events))
        engine = Engine(encoder, packet.resolution, look_ahead=self._look_ahead)
        engine.feed(packet.events[:1])
        engine.follow(packet.events[:1])
        follow_timed(engine, packet.events[:1].copy())
        engine.advance(int(packet.events["t"][0]) + encoder.geometry.window_us)
        engine.features()

    def _rows_of(
        self,
        model: Model,
        emit: str,
        policy: EmitPolicy,
        rec: Recording,
        report: Report,
        stopped: Callable[[], bool],
    ) -> Iterator[Row]:
        encoder, step = model.encoder, f"{model.name}, {emit}"

        def row(what: str, latencies: Latencies, **more: Any) -> Row:
            return Row(model, emit, what, latencies, **more)

        def goes(what: str) -> Callable[[int], bool]:
            begun: list[float] = []

            def ask(done: int) -> bool:
                report(step, min(done, self._warm_up + self._limit), self._warm_up + self._limit, what)
                if done >= self._warm_up and not begun:
                    begun.append(time.monotonic())
                return not stopped() and (not begun or time.monotonic() < begun[0] + self._seconds)

            return ask

        if policy == EmitPolicy("events", 1):
            each = {"look_ahead": self._look_ahead, "warm_up": self._warm_up}
            walked = walk(encoder, self._items, **each, goes=goes("update"))  # type: ignore[arg-type]
            share = float(walked.begins_bin.mean()) if len(walked.ns) else 0.0
            yield row("update", Latencies(walked.ns), boundary_share=share, walk=walked)
            yield row("bin boundary", Latencies(walked.ns[walked.begins_bin]))
            called = call_each(encoder, self._items, **each, goes=goes("from Python"))  # type: ignore[arg-type]
            yield row("from Python", Latencies(called.ns))
        else:
            found = feed_and_read(
                encoder, self._items, policy, warm_up=self._warm_up, goes=goes("feed and read")
            )
            per_event = np.round(found.batch_ns / np.maximum(found.batch_events, 1)).astype(np.int64)
            yield row("ingest", Latencies(per_event, found.batch_events))
            yield row("reading", Latencies(found.reading_ns))
        hop_ends: list[float] = []

        def hop_goes() -> bool:
            if not hop_ends:  # what warms up comes before the first question
                report(step, 0, 0, f"whole hop, {self._seconds:g} s")
                hop_ends.append(time.monotonic() + self._seconds)
            going = time.monotonic() < hop_ends[0] and not stopped()
            if not going:
                report(step, 0, 0, "whole hop, what is still queued")
            return going

        took = hop(
            encoder,
            items_of_split(rec.items(), self._split),
            policy,
            speed=self._speed,
            look_ahead=self._look_ahead,
            warm_up=_first_events(self._items, self._warm_up),
            goes=hop_goes,
        )
        yield row("whole hop", Latencies(took))


def _first_events(items: Iterable[Item], n: int) -> Iterator[Item]:
    """Items until `n` events are there; the packet that has the last of them is cut."""
    for item in items:
        if isinstance(item, Packet):
            item = replace(item, events=item.events[:n])
            n -= len(item.events)
        yield item
        if n <= 0:
            return
