"""Items in the groups in which a pipeline hands them on, and when.

Lives here: how many items go together, where long packets are cut, the clock's time for a stream time.
Not here: waiting until then (`pipeline`).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from streamfeat.messages.packets import Label, Packet

__all__ = ["Group", "Pace", "groups_of", "stream_time"]

In = TypeVar("In")

_EVENTS_A_HOP = 32_768
"""Items are handed on in groups of about so many events: a hop between threads costs 50 to 100 us."""
_ITEMS_A_HOP = 256
_PACED_SLICE_US = 10_000
"""Paced packets are cut to this length of the clock, so that nothing waits for the end of a long packet."""


def groups_of(items: Iterable[In | None], speed: float | None) -> Iterator["Group[In]"]:
    """Items in groups: as many as are worth a hop, or, at a pace, as soon as they are due."""
    if speed is None:
        return _full_groups(items)
    return _paced_groups(items, round(_PACED_SLICE_US * max(speed, 1.0)))


@dataclass(slots=True)
class Group(Generic[In]):
    """Items that go together, none if there are none at the moment; `more` may be there already."""

    items: list[In]
    more: bool = True


def _full_groups(items: Iterable[In | None]) -> Iterator[Group[In]]:
    group: list[In] = []
    events = 0
    for item in items:
        if item is not None:
            group.append(item)
            events += len(item.events) if isinstance(item, Packet) else 0
        if item is None or events >= _EVENTS_A_HOP or len(group) == _ITEMS_A_HOP:
            yield Group(group, more=item is not None)
            group, events = [], 0
    if group:
        yield Group(group)


def _paced_groups(items: Iterable[In | None], slice_us: int) -> Iterator[Group[In]]:
    for item in items:
        if item is None:
            continue
        if not isinstance(item, Packet) or len(item.events) == 0:
            yield Group([item])
            continue
        latest = np.maximum.accumulate(item.events["t"])
        start = 0
        while start < len(latest):
            stop = int(np.searchsorted(latest, latest[start] + slice_us))
            yield Group([replace(item, events=item.events[start:stop])])
            start = stop


class Pace:
    """When items are due: stream time goes on across restarts of the camera's clock.

    Args:
        speed: stream seconds for each second of the clock; None for no pace.
    """

    def __init__(self, speed: float | None) -> None:
        """No item is due yet."""
        self._speed = speed or 1.0
        self._epoch: int | None = None
        self._origin_us = self._passed_us = 0
        self._began_s = 0.0

    def due(self, item: object, t_us: int, now_s: float) -> float:
        """The clock's time for an item that is complete at stream time `t_us`."""
        if isinstance(item, Packet) and item.epoch != self._epoch:
            # The first packet of an epoch is due at once, the others by their distance from it.
            self._began_s = now_s if self._epoch is None else max(now_s, self._began_s + self._passed_s())
            self._epoch, self._origin_us = item.epoch, t_us
        elif self._epoch is None:
            self._epoch, self._origin_us, self._began_s = 0, t_us, now_s
        self._passed_us = max(t_us - self._origin_us, 0)
        return self._began_s + self._passed_s()

    def _passed_s(self) -> float:
        return self._passed_us / (1e6 * self._speed)


def stream_time(group: Sequence[object]) -> int | None:
    """The time by which a group is complete: that of its latest event."""
    last = group[-1]
    if isinstance(last, Label):
        return last.start_us
    return int(last.events["t"].max()) if isinstance(last, Packet) and len(last.events) else None
