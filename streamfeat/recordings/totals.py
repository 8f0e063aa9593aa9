"""Totals that take a full pass over a recording.

Lives here: `Totals`: labels, counts, the span of time, and the digest by which two people compare events.
Not here: the pass itself (`reader`).
"""

import hashlib
from dataclasses import dataclass, field

import numpy as np

from streamfeat.events import Resolution
from streamfeat.messages.packets import Label, Packet

__all__ = ["Totals"]

_DIGESTED = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "u1"), ("t", "<i8")])

_MOST_RESOLUTIONS = 64


@dataclass(slots=True)
class Totals:
    """Totals of a full pass."""

    labels: list[Label] = field(default_factory=list)
    n_on: int = 0
    n_off: int = 0
    n_outside: int = 0
    first_us: int | None = None
    last_us: int | None = None
    resolutions: dict[Resolution, int] = field(default_factory=dict)
    """Packets with events of each, of the first 64 in order of appearance."""
    hash: "hashlib._Hash" = field(default_factory=hashlib.sha256)
    _epoch: int = 0
    _span: tuple[int, int] | None = None
    _before_us: int = 0

    @property
    def duration_us(self) -> int:
        """Time from the earliest to the latest event, of each run of the camera's clock, in sum."""
        return self._before_us + (self._span[1] - self._span[0] if self._span else 0)

    def add(self, packet: Packet) -> None:
        """Count a packet; its events are not changed."""
        events = packet.events
        if len(events) == 0:
            return
        plain = np.empty(len(events), _DIGESTED)
        for name in _DIGESTED.names or ():
            plain[name] = events[name]
        self.hash.update(plain.tobytes())
        on = int(np.count_nonzero(events["p"]))
        self.n_on += on
        self.n_off += len(events) - on
        height, width = packet.resolution
        if len(self.resolutions) < _MOST_RESOLUTIONS or packet.resolution in self.resolutions:
            self.resolutions[packet.resolution] = self.resolutions.get(packet.resolution, 0) + 1
        self.n_outside += int(np.count_nonzero((events["x"] >= width) | (events["y"] >= height)))
        first, last = int(events["t"].min()), int(events["t"].max())
        if packet.epoch != self._epoch:
            self._before_us, self._span, self._epoch = self.duration_us, None, packet.epoch
        self._span = (min(first, self._span[0]), max(last, self._span[1])) if self._span else (first, last)
        self.first_us = first if self.first_us is None else min(first, self.first_us)
        self.last_us = last if self.last_us is None else max(last, self.last_us)
