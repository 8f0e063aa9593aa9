"""How the cost of events grows with filters, stride, resolution, rate and cameras.

Lives here: the part `growth`: loads timed in turns, the latency of single events and emissions.
Not here: the loads (`growth_streams`), how it is shown (`tables`, `pictures`).
"""

import time
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import streamfeat as sf
from streamfeat.events import Events
from streamfeat.latency.stopwatch import follow_timed
from streamfeat.report.machine import Disturbance
from tools.bench.growth_streams import Load, Stream, sweeps
from tools.bench.material import Material, Setting
from tools.bench.timing import Contestant, race

__all__ = ["event_ns", "measure_growth"]

Report = dict[str, Any]

CHUNK = 256
"""Events that one camera has before it is the next one's turn, under `event`."""


class Run:
    """Cameras that take turns in one process.

    Args:
        load: how many, and what.
        stream: of each.
    """

    def __init__(self, load: Load, stream: Stream) -> None:
        self._event, self._stream = load.emit == "event", stream
        encoder = load.encoder()
        self._engines = [sf.Engine(encoder, load.resolution) for _ in range(load.cameras)]
        self.n = len(stream.events) * load.cameras

    def go(self) -> None:
        """The stream once, to all cameras."""
        for part in self._parts():
            for engine in self._engines:
                if self._event:
                    engine.follow(part)
                else:
                    engine.feed(part)
                    engine.features()

    def latencies(self) -> NDArray[np.float64]:
        """The same, in nanoseconds of each event that is followed, or of each emission."""
        found = []
        for part in self._parts():
            for engine in self._engines:
                if self._event:
                    found.append(follow_timed(engine, part)[0])
                    continue
                engine.feed(part)
                begun = time.perf_counter_ns()
                engine.features()
                found.append(np.array([time.perf_counter_ns() - begun]))
        return np.concatenate(found).astype(np.float64)

    def go_on(self) -> None:
        """Move on in time; with several cameras a stream is shared, and moved once."""
        self._stream.go_on()

    def _parts(self) -> Iterator[Events]:
        if not self._event:
            yield from self._stream.slices
            return
        for start in range(0, len(self._stream.events), CHUNK):
            yield self._stream.events[start : start + CHUNK]


def measure_growth(setting: Setting) -> Report:
    """Time every load in turns, and then the latencies of each."""
    quick, disturbance = setting.quick, Disturbance()
    loads, contestants, runs = sweeps(quick), {}, []
    for load in loads:
        stream = Stream(setting.material, load, 1000 if quick else 20_000)
        runs.append(Run(load, stream))
        contestants[load.name] = Contestant(runs[-1].go, runs[-1].n, runs[-1].go_on)
    with threadpool_limits(1):
        result = race(contestants, 1 if quick else 9)
    rows = []
    for load, run in zip(loads, runs, strict=True):
        row: Report = asdict(load) | {"ns": result.figure(load.name)}
        if not quick:
            p50, p99 = np.percentile(run.latencies(), [50, 99])
            row |= {"latency_p50_us": p50 / 1e3, "latency_p99_us": p99 / 1e3}
        rows.append(row)
    return {
        "steal": disturbance.steal_share(),
        "discarded_rounds": result.discarded,
        "recording": setting.material.describe(),
        "rows": rows,
    }


def event_ns(material: Material, load: Load, rounds: int = 5) -> float:
    """Nanoseconds of the processor that an event of a load costs its engine."""
    run = Run(load, Stream(material, load, 20_000))
    with threadpool_limits(1):
        result = race({load.name: Contestant(run.go, run.n, run.go_on)}, rounds)
    return result.figure(load.name)["p50"]
