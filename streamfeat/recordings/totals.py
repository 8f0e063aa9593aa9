"""What only a full pass over a recording can tell.

Lives here: `Totals`: labels, counts, the span of time, and the digest by which two people compare events.
Not here: the pass itself (`reader`).
"""

import hashlib
from dataclasses import dataclass, field

import numpy as np

from streamfeat.events import Events
from streamfeat.messages.packets import Label

__all__ = ["Totals"]

_DIGESTED = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "u1"), ("t", "<i8")])


@dataclass(slots=True)
class Totals:
    """What only a full pass can tell."""

    labels: list[Label] = field(default_factory=list)
    n_on: int = 0
    n_off: int = 0
    first_us: int | None = None
    last_us: int | None = None
    hash: "hashlib._Hash" = field(default_factory=hashlib.sha256)

    def add(self, events: Events) -> None:
        """Count a batch: `(n,)` of `EVENT_DTYPE`, not changed."""
        if len(events) == 0:
            return
        plain = np.empty(len(events), _DIGESTED)
        for name in _DIGESTED.names or ():
            plain[name] = events[name]
        self.hash.update(plain.tobytes())
        on = int(np.count_nonzero(events["p"]))
        self.n_on += on
        self.n_off += len(events) - on
        first, last = int(events["t"].min()), int(events["t"].max())
        self.first_us = first if self.first_us is None else min(first, self.first_us)
        self.last_us = last if self.last_us is None else max(last, self.last_us)
