"""Events on their way to an engine, seen as pictures before anything is computed from them.

Lives here: which events a picture is made of, and when it is time for one.
Not here: drawing (`pictures`), where it is shown (`sink`).

A tap sits at the source of a stream, so that pictures keep their rate whatever features cost.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from streamfeat.events import Events, Resolution
from streamfeat.messages.packets import Packet
from streamfeat.stream.cameras import MAX_CAMERAS, CameraLeft
from streamfeat.view.observe import Throttle

__all__ = ["EventTap", "RecentEvents"]

_SEEN_US = 33_000
"""How long an event is seen."""
_KEPT_EVENTS = 1 << 17
"""Events that a picture is made of at most: more than a screen shows."""
_RATE_US = 100_000

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True, eq=False)
class RecentEvents:
    """What a picture of a camera's events is made of.

    Attributes:
        topic: of the camera.
        resolution: `(height, width)` of the sensor.
        batches: the latest events as they came, `(n,)` EVENT_DTYPE each, not to be changed.
        now_us: stream time that events have reached.
        seen_us: how long an event is seen.
        frame: counts the pictures of this camera.
        events: so far.
        events_per_s: of the stream's own time, lately.
    """

    topic: str
    resolution: Resolution
    batches: tuple[Events, ...]
    now_us: int
    seen_us: int
    frame: int
    events: int
    events_per_s: float


class _Recent:
    """The latest events of one camera."""

    def __init__(self, throttle: Throttle) -> None:
        self.throttle = throttle
        self.epoch = 0
        self.events = self.frame = 0
        self._batches: deque[Events] = deque()
        self._kept = 0
        self._now_us = 0
        self._since: tuple[int, int] | None = None
        self._rate = 0.0

    def add(self, packet: Packet, seen_us: int) -> None:
        events = packet.events
        if packet.epoch != self.epoch:
            self.epoch, self._kept, self._since = packet.epoch, 0, None
            self._batches.clear()
            self._now_us = int(events["t"].max())
        self._batches.append(events)
        self._kept += len(events)
        self.events += len(events)
        self._now_us = max(self._now_us, int(events["t"].max()))
        while len(self._batches) > 1 and (
            self._kept > _KEPT_EVENTS or int(self._batches[0]["t"][-1]) <= self._now_us - seen_us
        ):
            self._kept -= len(self._batches.popleft())
        self._measure()

    def _measure(self) -> None:
        if self._since is None:
            self._since = self._now_us, self.events
        passed = self._now_us - self._since[0]
        if passed >= _RATE_US:
            self._rate = 1e6 * (self.events - self._since[1]) / passed
            self._since = self._now_us, self.events

    def due(self, packet: Packet, seen_us: int) -> RecentEvents | None:
        if not self.throttle.is_due(self._now_us):
            return None
        batches = tuple(self._batches)
        if self._kept > _KEPT_EVENTS:  # a single long packet
            batches = (*batches[:-1], batches[-1][-_KEPT_EVENTS:])
        self.frame += 1
        return RecentEvents(
            packet.topic,
            packet.resolution,
            batches,
            self._now_us,
            seen_us,
            self.frame,
            self.events,
            self._rate,
        )


class EventTap:
    """Looks at the packets of a stream as they pass.

    Args:
        make_throttle: how often there is a picture of a camera.
        see: told what it is made of; in the thread that iterates.
        left: told there of a camera that has left.
    """

    def __init__(
        self,
        make_throttle: Callable[[], Throttle],
        see: Callable[[RecentEvents], None],
        left: Callable[[str], None] = lambda topic: None,
    ) -> None:
        """Nothing has passed."""
        self._make_throttle, self._see, self._left = make_throttle, see, left
        self._cameras: dict[str, _Recent] = {}
        self.seen_us = _SEEN_US

    def items(self, items: Iterable[Item]) -> Iterator[Item]:
        """The same items."""
        for item in items:
            if isinstance(item, Packet) and len(item.events):
                self._look(item)
            yield item
            if isinstance(item, CameraLeft):
                self._cameras.pop(item.topic, None)
                self._left(item.topic)

    def _look(self, packet: Packet) -> None:
        recent = self._cameras.get(packet.topic)
        if recent is None:
            if len(self._cameras) >= MAX_CAMERAS:
                del self._cameras[next(iter(self._cameras))]
            recent = self._cameras[packet.topic] = _Recent(self._make_throttle())
        recent.add(packet, self.seen_us)
        seen = recent.due(packet, self.seen_us)
        if seen is not None:
            self._see(seen)
