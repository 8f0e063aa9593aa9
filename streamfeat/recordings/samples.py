"""Labelled samples: a label and its events, out of a stream of both.

Lives here: gathering them while the stream passes. Not here: where the stream comes from (`recording`).
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from streamfeat.events import EVENT_DTYPE, Events, Resolution
from streamfeat.messages.packets import Label, Packet

__all__ = ["Sample", "complete_samples"]

_MOST_OPEN = 16
"""Each holds its events, so labels without end would hold the recording once for each of them."""


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """A label, its events in stored order, and the resolution of the packet that brought the first."""

    label: Label
    events: Events
    resolution: Resolution


@dataclass(slots=True)
class _Pending:
    """A sample whose end has not been reached."""

    label: Label
    is_wanted: bool
    epoch: int | None = None
    parts: list[Events] = field(default_factory=list)
    resolution: Resolution | None = None

    def add(self, packet: Packet) -> None:
        self.epoch = packet.epoch
        t = packet.events["t"]
        inside = packet.events[(t >= self.label.start_us) & (t < self.end_us)]
        if len(inside):
            self.parts.append(inside)
            self.resolution = self.resolution or packet.resolution

    @property
    def end_us(self) -> int:
        return self.label.start_us + self.label.duration_us

    def finish(self, default: Resolution) -> Iterator[Sample]:
        if self.is_wanted:
            events = np.concatenate([np.zeros(0, EVENT_DTYPE), *self.parts])
            yield Sample(self.label, events, self.resolution or default)


def complete_samples(
    items: Iterable[tuple[int, Packet | Label]], end: float, default: Resolution
) -> Iterator[Sample]:
    """Yield the samples of a stream in stored order, with memory bounded by those open at a time.

    A sample is complete when a packet starts, or a label begins, at or after its end; when the camera's clock
    starts anew; or when 16 more have begun before its end. A label right before the first packet of a new
    clock is of that clock.

    Args:
        items: packets and labels, each with its byte; a label comes before its first packet.
        end: samples whose label is at this byte or behind are not wanted.
        default: resolution of samples without events.
    """
    pending: list[_Pending] = []
    for at, item in items:
        if at >= end and not any(sample.is_wanted for sample in pending):
            return
        if isinstance(item, Packet):
            while pending and pending[0].epoch not in (None, item.epoch):
                yield from pending.pop(0).finish(default)
        now = item.start_us if isinstance(item, Label) else _start_us(item)
        while now is not None and pending and now >= pending[0].end_us:
            yield from pending.pop(0).finish(default)
        if isinstance(item, Label):
            if len(pending) == _MOST_OPEN:
                yield from pending.pop(0).finish(default)
            pending.append(_Pending(item, at < end))
        else:
            for sample in pending:
                sample.add(item)
    for sample in pending:
        yield from sample.finish(default)


def _start_us(packet: Packet) -> int | None:
    return int(packet.events["t"].min()) if len(packet.events) else None
