"""Warnings: counted by reason, and said seldom.

Lives here: `Warnings`, which a live job counts in.
Not here: what is worth a warning (`intake`, `record`), and showing the counts (`health`).
"""

import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Self

from rich.console import Console

from streamfeat.errors import printable

__all__ = ["Warnings"]

_SHOWN = 200
"""Characters of a name in a line."""


class Warnings:
    """Counts by reason, and says so once a second and reason at most.

    Args:
        say: given a line of text.
        clock: seconds, monotonic.
    """

    def __init__(
        self, say: Callable[[str], None] = lambda line: None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Nothing counted yet."""
        self.counts: Counter[str] = Counter()
        self._say = say
        self._clock = clock
        self._next: dict[str, float] = {}
        self._silent: Counter[str] = Counter()

    @classmethod
    def on(cls, console: Console | None) -> Self:
        """Say it there, or only count."""
        if console is None:
            return cls()
        return cls(partial(console.print, style="yellow", markup=False, soft_wrap=True))

    def add(self, reason: str, topic: str, detail: str) -> None:
        """Count one, and say it unless that reason was said less than a second ago."""
        self.counts[reason] += 1
        now = self._clock()
        if now < self._next.get(reason, now):
            self._silent[reason] += 1
            return
        self._next[reason] = now + 1.0
        more = self._silent.pop(reason, 0)
        # Names and details come from the network.
        said = printable(f"{reason}: {topic[:_SHOWN]}: {detail}")
        self._say(said + (f" ({more} more of these)" if more else ""))
