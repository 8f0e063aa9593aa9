"""Timing settings in turns, and processes beside each other.

Lives here: engines that take turns with a stream, what they take, how late single events and readings are.
Not here: what should come out (`model`), how it is shown (`show`).
"""

import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import streamfeat as sf
from streamfeat.events import Events
from streamfeat.latency.stopwatch import follow_timed
from streamfeat.report.machine import Disturbance, describe_machine
from tools.bench.material import Material
from tools.bench.timing import Contestant, race
from tools.cost_growth.model import Constants, work_of
from tools.cost_growth.streams import FIT, Setting, Stream

__all__ = ["measure", "measure_processes"]

Report = dict[str, Any]

CHUNK = 256
"""Events that one camera has before it is the next one's turn, under `event`."""


class Run:
    """Cameras that take turns in one process.

    Args:
        setting: how many, and what.
        stream: of each.
    """

    def __init__(self, setting: Setting, stream: Stream) -> None:
        self._event, self._stream = setting.emit == "event", stream
        encoder = setting.encoder()
        self._engines = [sf.Engine(encoder, setting.resolution) for _ in range(setting.cameras)]
        self.n = len(stream.events) * setting.cameras

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
        """The same, in nanoseconds of each event that is followed, or of each reading."""
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


def measure(material: Material, settings: list[Setting], rounds: int, events: int, *, tails: bool) -> Report:
    """Time settings in turns, fit the constants to the first ones, and predict all."""
    disturbance = Disturbance()
    works, contestants, runs = [], {}, []
    for setting in settings:
        stream = Stream(material, setting, events)
        works.append(work_of(setting, stream))
        runs.append(Run(setting, stream))
        contestants[setting.name] = Contestant(runs[-1].go, runs[-1].n, runs[-1].go_on)
    with threadpool_limits(1):
        result = race(contestants, rounds)
    figures = [result.figure(setting.name) for setting in settings]
    ns = [figure["p50"] for figure in figures]
    fitted = [settings.index(setting) for setting in FIT]
    constants = Constants.fit([works[i] for i in fitted], [ns[i] for i in fitted])
    rows = []
    for setting, work, figure, run in zip(settings, works, figures, runs, strict=True):
        predicted = constants.predict(work)
        row = asdict(setting) | asdict(work) | {"fitted": setting in FIT, "ns": figure}
        row |= {"predicted_ns": predicted, "ratio": figure["p50"] / predicted}
        if tails:
            p50, p99 = np.percentile(run.latencies(), [50, 99])
            row |= {"latency_p50_us": p50 / 1e3, "latency_p99_us": p99 / 1e3}
        rows.append(row)
    return {
        "machine": describe_machine(),
        "steal": disturbance.steal_share(),
        "discarded_rounds": result.discarded,
        "recording": material.describe(),
        "constants": asdict(constants),
        "rows": rows,
    }


def measure_processes(recording: Path, setting: Setting, counts: tuple[int, ...], seconds: float) -> Report:
    """Events a second of so many processes at once, on the wall and by their own processor time."""
    found = {}
    context = multiprocessing.get_context("spawn")
    for count in counts:
        ready = context.Barrier(count)
        disturbance = Disturbance()
        with ProcessPoolExecutor(count, context, initializer=_share, initargs=(ready,)) as pool:
            jobs = [pool.submit(_process, recording, setting, seconds) for _ in range(count)]
            taken = [job.result() for job in jobs]
        events = sum(n for n, _, _ in taken)
        found[str(count)] = {
            "events_per_s": events / max(wall for _, wall, _ in taken),
            "events_per_processor_s": events / sum(cpu for _, _, cpu in taken),
            "steal": disturbance.steal_share(),
        }
    return {"setting": setting.name} | found


def _share(ready: Any) -> None:
    global _ready
    _ready = ready


def _process(recording: Path, setting: Setting, seconds: float) -> tuple[int, float, float]:
    run = Run(setting, Stream(Material(recording), setting, 20_000))
    run.go()
    _ready.wait()
    begun, cpu, n = time.perf_counter(), time.process_time(), 0
    while time.perf_counter() - begun < seconds:
        run.go_on()
        run.go()
        n += run.n
    return n, time.perf_counter() - begun, time.process_time() - cpu
