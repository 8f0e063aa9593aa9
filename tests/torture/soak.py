"""A day of stream time through the real pipeline, half a thousand million events, at full speed.

Lives here: the stream, what is watched meanwhile, and what must not change.

Each message is decoded as a recorded one, goes through the queues and a `Session` that reads every 100 ms,
and ends in a sink. Every tenth is followed by a silence, so that windows run empty and bins are skipped.
"""

import asyncio
import os
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.events import make_events
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.codecs import encode
from streamfeat.messages.packets import Packet, Watermark
from streamfeat.messages.timeline import Timeline
from streamfeat.stream.batch import EmissionBatch
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.session import Session
from torture.table import Row, Trials

__all__ = ["soak"]

_PACKETS = 15_360
_EVENTS = 32_768
"""In each; 503 million in all."""
_PACKET_US = 3_000_000
_SILENCE_US = 26_250_000
"""After every tenth packet: 15,360 packets take 24 hours."""
_CHECKS = 40
_SAMPLES = 400
_GROWTH = 4 << 20
"""Bytes by which memory may differ: the allocator keeps what it likes."""
_RESOLUTION = 34, 34
_BASES = 16


def soak(trials: Trials) -> list[Row]:
    """Rows for exactness, for what a process holds, and for latency."""
    began = time.monotonic()
    packets = trials.times(_PACKETS, least=60)
    watch = _Watch(_encoder(trials.seed), packets, trials)
    pipeline = Pipeline(_stream(packets, trials.seed), watch, [watch])
    asyncio.run(pipeline.run())
    return watch.rows(time.monotonic() - began)


def resident_bytes() -> int:
    """Memory that this process holds."""
    with open("/proc/self/statm") as file:  # noqa: PTH123
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _encoder(seed: int) -> Encoder:
    geometry = Geometry(patch=8, stride=4, n_bins=3, bin_us=33_334, max_count=2)
    return random_encoder(seed, geometry, 32, encoding="split", threshold=0.5)


def _stream(packets: int, seed: int) -> Iterator[Packet | Watermark]:
    """Messages of a camera, decoded one after the other, and silences between them."""
    rng = np.random.default_rng(seed)
    height, width = _RESOLUTION
    bases = []
    for _ in range(_BASES):
        t = np.sort(rng.integers(0, _PACKET_US, _EVENTS))
        t[0] = 0
        x, y, p = (rng.integers(0, most, _EVENTS) for most in (width, height, 2))
        bases.append(encode(make_events(x, y, p, t), "mono")[0])
    timeline, now_us = Timeline("/events"), 0
    for i in range(packets):
        about = 0, "", height, width, i, now_us * 1000, "mono", False
        message = EventPacket(*about, bases[i % _BASES]).to_cdr()
        yield from timeline.message(EventPacket.SCHEMA_NAME, message, now_us * 1000, i)
        now_us += _PACKET_US
        if i % 10 == 9:
            if i % 20 == 9:  # in the other silences nobody says that time goes on
                yield Watermark("/events", now_us + 1_000_000)
            now_us += _SILENCE_US


@dataclass(frozen=True)
class _Held:
    """What the process holds at a moment."""

    t_us: int
    rss: int
    files: int
    threads: int
    state: int


class _Watch:
    """The processor around a session, and the sink: both of them look, and change nothing."""

    def __init__(self, encoder: Encoder, packets: int, trials: Trials) -> None:
        self._encoder, self._packets, self._trials = encoder, packets, trials
        self.session = Session(encoder, EmitPolicy.parse("100ms"), clock=time.perf_counter)
        self._recent: deque[Packet] = deque(maxlen=2)
        self._n = self._emissions = 0
        self._held: list[_Held] = []
        self._cpu: list[float] = []
        self._wall: list[float] = []
        self._wrong: list[str] = []
        self._checks = 0
        self._last_us = 0

    def batches(self, item: Packet | Watermark) -> Iterator[EmissionBatch]:
        """Time what the session does with an item, and look from time to time."""
        cpu, wall = 0.0, 0.0
        made = self.session.batches(item)
        while True:
            before = time.thread_time(), time.perf_counter()
            batch = next(made, None)
            cpu, wall = cpu + time.thread_time() - before[0], wall + time.perf_counter() - before[1]
            if batch is None:
                break
            yield batch
        if not isinstance(item, Packet):
            return
        self._recent.append(item)
        self._cpu.append(cpu)
        self._wall.append(wall)
        self._n += 1
        self._last_us = int(item.events["t"][-1])
        if self._n % max(1, self._packets // _SAMPLES) == 0:
            self._held.append(self._look())
        if self._n % max(1, self._packets // _CHECKS) == 0:
            self._check()
            self._trials.say(f"soak {self._n:,}/{self._packets:,} packets")

    def last_batches(self) -> Iterator[EmissionBatch]:
        yield from self.session.last_batches()

    def rest(self) -> None:
        self.session.rest()

    def write(self, emissions: Sequence[Emission]) -> None:
        self._emissions += len(emissions)

    def close(self, *, failed: bool) -> None:
        """Nothing to end."""

    def _check(self) -> None:
        """A fresh engine, fed what can be in the window, must have the same bits."""
        mine = self.session._engine
        assert mine
        fresh = Engine(self._encoder, _RESOLUTION)
        for packet in self._recent:
            fresh.feed(packet.events)
        fresh.advance(mine.window_us[1] - 1)
        same = all(
            getattr(mine, name)().tobytes() == getattr(fresh, name)().tobytes()
            for name in ("features", "codes", "counts", "activity")
        )
        self._checks += 1
        if not (same and mine.window_us == fresh.window_us and mine.activity().any()):
            self._wrong.append(f"at {self._last_us} us the state is not that of its window")

    def _look(self) -> _Held:
        engine = self.session._engine
        assert engine
        rss = resident_bytes()
        files = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
        state = engine._state
        size = sum(getattr(state, name).nbytes for name in state._fields)
        return _Held(self._last_us, rss, files, threading.active_count(), size)

    def rows(self, seconds: float) -> list[Row]:
        stats = self.session.stats()
        hours = self._last_us / 3.6e9
        what = f"soak, {stats.events:,} events, {hours:.1f} h of stream"
        lost = self._packets * _EVENTS - stats.events
        exact = Row(
            f"{what}: state against a fresh engine fed the last window",
            self._checks,
            self._checks - len(self._wrong),
            lost,
            seconds=seconds,
            note=f"bit for bit; {self._emissions:,} emissions",
            failures=tuple(self._wrong),
        )
        return [exact, self._steady(what), self._latency(what)]

    def _steady(self, what: str) -> Row:
        """What is held in the last hour against the first, after a twentieth for warming up."""
        held = self._held[len(self._held) // 20 :]
        span = min(3_600_000_000, (held[-1].t_us - held[0].t_us) // 4)
        first = [one for one in held if one.t_us <= held[0].t_us + span]
        last = [one for one in held if one.t_us >= held[-1].t_us - span]
        middle = {
            field.name: tuple(
                int(np.median([getattr(one, field.name) for one in part])) for part in (first, last)
            )
            for field in fields(_Held)
        }
        failures = [
            f"{name}: {one} to {other}"
            for name, (one, other) in middle.items()
            if name != "t_us" and other - one > (_GROWTH if name == "rss" else 0)
        ]
        mb = [f"{value / 1e6:.1f}" for value in (*middle["rss"], middle["state"][1])]
        files, threads = middle["files"], middle["threads"]
        note = (
            f"first to last hour: RSS {mb[0]} to {mb[1]} MB, {files[0]} to {files[1]} files, "
            f"{threads[0]} to {threads[1]} threads; engine {mb[2]} MB"
        )
        return Row(
            f"{what}: what the process holds", 1, int(not failures), note=note, failures=tuple(failures)
        )

    def _latency(self, what: str) -> Row:
        """Time of a packet, in the last tenth against the first."""
        tenth = max(1, len(self._cpu) // 10)
        skip = len(self._cpu) // 20  # while caches and branch predictors warm up
        parts = {
            name: (np.array(values[skip : skip + tenth]), np.array(values[-tenth:]))
            for name, values in (("CPU", self._cpu), ("wall", self._wall))
        }
        ratios = {name: _percentiles(last) / _percentiles(first) for name, (first, last) in parts.items()}
        note = "last to first tenth, p50, p90, p99: " + "; ".join(
            f"{name} " + ", ".join(f"{ratio:.2f}" for ratio in found) for name, found in ratios.items()
        )
        note += f"; p50 {1e3 * _percentiles(parts['CPU'][1])[0]:.2f} ms a packet"
        # A machine that has other things to do shows in the tails, and in the wall clock.
        steady = bool(ratios["CPU"][0] <= 1.1)
        failures = (
            () if steady else (f"CPU time of a packet, median: {ratios['CPU'][0]:.2f} times the first",)
        )
        return Row(f"{what}: latency of a packet", 1, int(steady), note=note, failures=failures)


def _middle(held: Sequence[_Held], name: str) -> int:
    return int(np.median([getattr(one, name) for one in held]))


def _percentiles(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.quantile(values, [0.5, 0.9, 0.99]))
