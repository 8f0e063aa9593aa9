"""Watching an engine at work without getting in its way.

Lives here: an engine that leaves a copy of what it sees now and then; how often; where the copy waits.
Not here: pictures (`pictures`), and showing them (`sink`).

An observed engine does what any engine does. After an emission, when the last look is long enough ago, it
copies counts and activity, which takes about as long as an emission after a few events. A copy that was not
taken when the next one comes is replaced and counted: a slow viewer sees fewer pictures.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.engine import Engine, EngineStats
from streamfeat.engine.trace import Trace
from streamfeat.events import Events, Resolution
from streamfeat.kernels.predict import Weights

__all__ = ["ObservedEngine", "Sight", "Slot", "Throttle", "Updates", "Watch"]

_KEPT_EVENTS = 1 << 18
"""Events that a picture can be made of; more than a sensor shows in one bin, and 4 MB."""
_KEPT_BATCHES = 1 << 13
_KEPT_UPDATES = 1 << 12


@dataclass(frozen=True, slots=True)
class Updates:
    """How long bringing the features up to date took since the last look.

    Attributes:
        n: emissions, or events where features follow each event.
        median_us: microseconds; 0 without any.
        max_us: the longest; of events that are followed together, their mean counts.
    """

    n: int
    median_us: float
    max_us: float


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What one look at an engine saw.

    Attributes:
        topic: of the camera.
        resolution: `(height, width)` of the sensor.
        batches: the latest events as they came, `(n,)` EVENT_DTYPE each, not to be changed.
        window_us: stream times at which the window starts and ends.
        now_us: stream time that had passed for certain.
        counts: `(n_bins, H, W)` int32, oldest bin first.
        activity: `(rows, columns)` int64, sums of squared entries.
        stats: of the engine.
        updates: since the last look.
    """

    topic: str
    resolution: Resolution
    batches: tuple[Events, ...]
    window_us: tuple[int, int]
    now_us: int
    counts: NDArray[np.int32]
    activity: NDArray[np.int64]
    stats: EngineStats
    updates: Updates


class Throttle:
    """So many times a second, of the clock or of the stream.

    Args:
        rate: in Hz.
        clock: seconds, monotonic; without one it is stream time that counts.
    """

    def __init__(self, rate: float, clock: Callable[[], float] | None = time.monotonic) -> None:
        """The first time is at once."""
        self._interval = 1 / rate
        self._clock = clock
        self._last = float("-inf")

    def is_due(self, t_us: int) -> bool:
        """Whether it is time again, given stream time.

        The next time is counted from when this one was due, not from when it was asked for: events come in
        slices, and each picture would be late by a part of one. After a pause it is counted from now.
        """
        now = self._clock() if self._clock else t_us / 1e6
        due = self._last + self._interval
        if self._last <= now < due:
            return False
        self._last = due if due <= now < due + self._interval else now
        return True


class Slot:
    """Room for one sight: the next one replaces it. Written by one thread, read by another."""

    def __init__(self) -> None:
        """Empty."""
        self._waiting: deque[Sight] = deque(maxlen=1)
        self.skipped = 0

    def put(self, sight: Sight) -> None:
        """Leave a sight; the one before, if it was not taken, is counted in `skipped`."""
        self.skipped += len(self._waiting)
        self._waiting.append(sight)

    def take(self) -> Sight | None:
        """The latest sight that was not taken yet."""
        try:
            return self._waiting.popleft()
        except IndexError:
            return None


@dataclass(frozen=True, slots=True)
class Watch:
    """How the engines of one camera are watched: what they are called, how often, who is told."""

    topic: str
    throttle: Throttle
    see: Callable[[Sight], None]


class ObservedEngine(Engine):
    """An engine that shows what it sees; all that it computes is what `Engine` computes.

    Args:
        arguments: of `Engine`.
        watch: how it is watched.
        options: of `Engine`.
    """

    def __init__(self, *arguments: Any, watch: Watch, **options: Any) -> None:
        """As `Engine`, with nothing seen."""
        super().__init__(*arguments, **options)
        self._watch = watch
        self._batches: deque[Events] = deque(maxlen=_KEPT_BATCHES)
        self._kept = 0
        self._now_us = 0
        self._took_us: deque[float] = deque(maxlen=_KEPT_UPDATES)
        self._n_updates = 0

    def feed(self, batch: Events) -> None:
        """As `Engine.feed`; the batch is remembered for a picture."""
        super().feed(batch)
        self._remember(batch)

    def advance(self, t_us: int) -> None:
        """As `Engine.advance`."""
        super().advance(t_us)
        self._now_us = max(self._now_us, t_us)

    def restart(self, origin_us: int) -> None:
        """As `Engine.restart`; what was seen belongs to the past."""
        super().restart(origin_us)
        self._batches.clear()
        self._kept, self._now_us = 0, origin_us

    def trace(self, batch: Events, weights: Weights | None = None, *, keep_features: bool = True) -> Trace:
        """As `Engine.trace`, timed."""
        started = time.perf_counter_ns()
        traced = super().trace(batch, weights, keep_features=keep_features)
        self._note(started, len(batch))
        self._remember(batch)
        self._look()
        return traced

    def features(self) -> NDArray[np.float32]:
        """As `Engine.features`, timed."""
        started = time.perf_counter_ns()
        features = super().features()
        self._note(started, 1)
        self._look()
        return features

    def _note(self, started_ns: int, updates: int) -> None:
        if updates:
            self._took_us.append((time.perf_counter_ns() - started_ns) / 1e3 / updates)
            self._n_updates += updates

    def _remember(self, batch: Events) -> None:
        if len(self._batches) == _KEPT_BATCHES:
            self._kept -= len(self._batches[0])  # which falls out
        self._batches.append(batch)
        self._kept += len(batch)
        while self._kept > _KEPT_EVENTS and len(self._batches) > 1:
            self._kept -= len(self._batches.popleft())

    def _look(self) -> None:
        window_us = self.window_us
        now_us = min(max(self._now_us, self._latest_us()), window_us[1])
        if not self._watch.throttle.is_due(now_us):
            return
        took = np.array(self._took_us or [0.0])
        updates = Updates(self._n_updates, float(np.median(took)), float(took.max()))
        self._took_us.clear()
        self._n_updates = 0
        self._watch.see(
            Sight(
                self._watch.topic,
                self.resolution,
                tuple(self._batches),
                window_us,
                now_us,
                self.counts(),
                self.activity(),
                self.stats(),
                updates,
            )
        )

    def _latest_us(self) -> int:
        return int(self._batches[-1]["t"][-1]) if self._batches and len(self._batches[-1]) else 0
