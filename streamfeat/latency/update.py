"""Update latency: from events in an engine's hands to features that are current.

Lives here: walking a stream event by event, and by an emission policy, with the time each step takes.
Not here: queues, threads and sinks on the way to a user (`end_to_end`).

Both walks go through a stream as a session does: a label starts an empty window with its own origin, and
packets of another resolution start a new engine. None of that is timed. A new engine's memory is written
to before its first event, so that no event pays for pages which the system has promised but not yet given.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from time import monotonic_ns, perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.events import Events, Resolution
from streamfeat.latency.stopwatch import follow_timed
from streamfeat.recordings.reader import Label, Packet
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session

__all__ = ["Emissions", "Walk", "call_each", "feed_and_read", "walk"]

_CHUNK = 256
"""Events between two questions whether to go on."""

_NOTHING = np.zeros(0, np.int64)

Item = Packet | Label
Goes = Callable[[int], bool]
"""Told how many events are done; says whether to go on."""


@dataclass(slots=True)
class Walk:
    """A stream gone through event by event.

    Attributes:
        ns: `(n,)` int64, nanoseconds of each event.
        begins_bin: `(n,)` bool, whether the event began a new bin.
        t_us: `(n,)` int64, stream time.
        features: as they were after the last event.
    """

    ns: NDArray[np.int64]
    begins_bin: NDArray[np.bool_]
    t_us: NDArray[np.int64]
    features: NDArray[np.float32]


@dataclass(slots=True)
class Emissions:
    """A stream fed, and its features emitted as a policy says.

    Attributes:
        batch_events: `(m,)` int64, events of each batch fed.
        batch_ns: `(m,)` int64, nanoseconds of feeding it.
        emission_ns: `(r,)` int64, nanoseconds of each emission, moving stream time on included.
    """

    batch_events: NDArray[np.int64]
    batch_ns: NDArray[np.int64]
    emission_ns: NDArray[np.int64]


def walk(
    encoder: Encoder, items: Iterable[Item], *, look_ahead: bool, warm_up: int, goes: Goes = lambda done: True
) -> Walk:
    """Follow every event in a compiled loop, see `stopwatch`.

    Args:
        encoder: the frozen encoder.
        items: packets and labels in stream order.
        look_ahead: as for `Engine`.
        warm_up: events at the start that are followed but not counted.
        goes: asked from time to time.

    Raises:
        InputError: a sensor has so many volumes that sums could overflow.
    """
    return _each_event(follow_timed, encoder, items, look_ahead, warm_up, goes)


def call_each(
    encoder: Encoder, items: Iterable[Item], *, look_ahead: bool, warm_up: int, goes: Goes = lambda done: True
) -> Walk:
    """Follow every event by a call from Python, and read features after each; otherwise as `walk`.

    `begins_bin` is not known here, and false.
    """
    return _each_event(_call_timed, encoder, items, look_ahead, warm_up, goes)


def feed_and_read(
    encoder: Encoder,
    items: Sequence[Item],
    policy: EmitPolicy,
    *,
    warm_up: int,
    goes: Goes = lambda done: True,
) -> Emissions:
    """Let a session feed and read an engine as the policy says, as fast as it can.

    Args:
        encoder: the frozen encoder.
        items: packets and labels in stream order.
        policy: when to read; not after every event, which is `walk`.
        warm_up: events at the start that are fed but not counted; a batch or an emission counts that reaches
            beyond them.
        goes: asked after each item.
    """
    log = _Log()
    session = Session(encoder, policy, clock=perf_counter, engine=lambda *a, **k: _LoggedEngine(log, *a, **k))
    done = 0
    for item in items:
        for _ in session.process(item):
            pass
        done += len(item.events) if isinstance(item, Packet) else 0
        if not goes(done):
            break
    batches = np.array(log.batches, np.int64).reshape(-1, 3)
    emissions = np.array(log.emissions, np.int64).reshape(-1, 2)
    batches, emissions = batches[batches[:, 0] > warm_up], emissions[emissions[:, 0] > warm_up]
    return Emissions(batches[:, 1], batches[:, 2], emissions[:, 1])


def _each_event(
    timed: Callable[[Engine, Events], tuple[NDArray[np.int64], NDArray[np.bool_]]],
    encoder: Encoder,
    items: Iterable[Item],
    look_ahead: bool,
    warm_up: int,
    goes: Goes,
) -> Walk:
    ns, begins_bin, t_us, done = [_NOTHING], [_NOTHING.astype(np.bool_)], [_NOTHING], 0
    features = np.zeros(encoder.n_features, np.float32)
    for engine, events in _engines(encoder, items, look_ahead):
        took, begins = timed(engine, events)
        features = engine.features()
        done += len(events)
        skip = min(max(warm_up - (done - len(events)), 0), len(events))
        ns.append(took[skip:])
        begins_bin.append(begins[skip:])
        t_us.append(events["t"][skip:])
        if not goes(done):
            break
    return Walk(np.concatenate(ns), np.concatenate(begins_bin), np.concatenate(t_us), features)


def _engines(encoder: Encoder, items: Iterable[Item], look_ahead: bool) -> Iterator[tuple[Engine, Events]]:
    """Chunks of events in stream order, each with the engine that they go to."""
    engine: Engine | None = None
    origin_us = 0
    for item in items:
        if isinstance(item, Label):
            origin_us = item.start_us
            if engine:
                engine.restart(origin_us)
            continue
        if engine is None or engine.resolution != item.resolution:
            engine = _ready_engine(encoder, item.resolution, origin_us, look_ahead)
        for start in range(0, len(item.events), _CHUNK):
            yield engine, item.events[start : start + _CHUNK].copy()


def _ready_engine(encoder: Encoder, resolution: Resolution, origin_us: int, look_ahead: bool) -> Engine:
    engine = Engine(encoder, resolution, origin_us=origin_us, look_ahead=look_ahead)
    _touch(engine)
    return engine


def _touch(engine: Engine) -> None:
    """Write to all memory of an engine without changing it."""
    for array in engine._state:
        array += 0
    for _, scale in engine._further:
        _touch(scale)


def _call_timed(engine: Engine, events: Events) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    ns = np.empty(len(events), np.int64)
    for i in range(len(events)):
        begun = monotonic_ns()
        engine.follow(events[i : i + 1])
        engine.features()
        ns[i] = monotonic_ns() - begun
    return ns, np.zeros(len(events), np.bool_)


@dataclass(slots=True)
class _Log:
    """Calls of the engines of one session, each with the number of events until then."""

    events: int = 0
    batches: list[tuple[int, int, int]] = field(default_factory=list)
    emissions: list[tuple[int, int]] = field(default_factory=list)


class _LoggedEngine(Engine):
    """An engine that notes how long it takes."""

    def __init__(self, log: _Log, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._log = log
        self._moved_ns = 0
        _touch(self)

    def feed(self, batch: Events) -> None:
        begun = monotonic_ns()
        super().feed(batch)
        took = monotonic_ns() - begun
        self._log.events += len(batch)
        self._log.batches.append((self._log.events, len(batch), took))

    def advance(self, t_us: int) -> None:
        begun = monotonic_ns()
        super().advance(t_us)
        self._moved_ns = monotonic_ns() - begun

    def features(self) -> NDArray[np.float32]:
        begun = monotonic_ns()
        features = super().features()
        took = monotonic_ns() - begun + self._moved_ns
        self._log.emissions.append((self._log.events, took))
        return features
