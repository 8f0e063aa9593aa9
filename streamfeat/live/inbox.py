"""Where messages wait between the network's threads and the pipeline.

Lives here: one bounded queue that never makes the network wait.
Not here: what messages mean (`intake`), and who puts them in (`network`).

When it is full, or the oldest has waited too long, whole messages are dropped, the oldest first, and counted
for their topic.
"""

import math
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass

__all__ = ["Announcement", "Inbox", "RawMessage"]

_MAX_BYTES = 64 << 20
_OVERHEAD = 512
"""What a message costs besides its payload, so that their number is bounded too: 131,072 empty ones; with a
name of more than 256 characters it costs more."""
_TAKEN_AT_ONCE = 64
_MAX_ANNOUNCEMENTS = 4096
"""Announcements that may wait; further ones are refused and counted."""
_MAX_NAMED = 4096
"""Topics whose drops are remembered one by one; those of further topics are in the total alone."""


@dataclass(slots=True)
class RawMessage:
    """One message as it came.

    Attributes:
        topic: where it was published, as shown.
        schema: type of the message; '' if it can be none of ours.
        payload: its bytes; empty if they are refused.
        attachment: its bytes, at most 33 of interest.
        arrived_ns: when, by the monotonic clock.
        log_time_ns: when, since 1970.
        problem: why it cannot be used, if that is known.
        dropped: messages of this topic that were dropped since the one before.
    """

    topic: str
    schema: str
    payload: bytes
    attachment: bytes
    arrived_ns: int
    log_time_ns: int
    problem: str = ""
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class Announcement:
    """The first publisher of a topic has come, or the last has left; it may overtake their packets."""

    topic: str
    here: bool


class Inbox:
    """A bounded queue from many threads to one.

    Args:
        max_bytes: of payloads, with 512 more for each message.
        max_delay_s: how long a message may wait.

    Attributes:
        dropped: messages dropped so far.
        left: messages left to other processes.
        refused: announcements that were not taken in, because too many waited.
    """

    def __init__(self, max_bytes: int = _MAX_BYTES, max_delay_s: float = math.inf) -> None:
        """Start empty and open."""
        self._max_bytes = max_bytes
        self._max_delay_ns = max_delay_s * 1e9
        self._items: deque[RawMessage | Announcement] = deque()
        self._bytes = 0
        self._dropped: Counter[str] = Counter()
        self._changed = threading.Condition()
        self._closed = False
        self._announcements = 0
        self.dropped = self.left = self.refused = 0

    @property
    def depth(self) -> int:
        """Messages that wait."""
        return len(self._items)

    def put(self, item: RawMessage | Announcement) -> None:
        """Add one at the end, and drop from the front while there is too much. Never waits."""
        with self._changed:
            if self._closed:
                return
            if isinstance(item, Announcement):
                if self._announcements >= _MAX_ANNOUNCEMENTS:
                    self.refused += 1
                    return
                self._announcements += 1
            self._items.append(item)
            if isinstance(item, RawMessage):
                self._bytes += _cost(item)
                self._drop_oldest(item.arrived_ns - self._max_delay_ns)
            self._changed.notify()

    def refuse(self) -> None:
        """Count an announcement that was not worth putting in."""
        with self._changed:
            self.refused += 1

    def leave(self) -> None:
        """Count a message that is another process's to take."""
        with self._changed:
            self.left += 1

    def _drop_oldest(self, limit_ns: float) -> None:
        kept = []
        while self._items and (self._bytes > self._max_bytes or self._arrived_ns(self._items[0]) < limit_ns):
            oldest = self._items.popleft()
            if isinstance(oldest, RawMessage):
                self._bytes -= _cost(oldest)
                if oldest.topic in self._dropped or len(self._dropped) < _MAX_NAMED:
                    self._dropped[oldest.topic] += 1
                self.dropped += 1
            else:
                kept.append(oldest)
        self._items.extendleft(reversed(kept))

    @staticmethod
    def _arrived_ns(item: RawMessage | Announcement) -> float:
        return item.arrived_ns if isinstance(item, RawMessage) else math.inf

    def take(self, timeout: float) -> list[RawMessage | Announcement] | None:
        """Take what is there, at most 64; wait if there is nothing.

        Returns:
            an empty list after `timeout` seconds, and None when the inbox is closed and empty.
        """
        with self._changed:
            if not self._items and not self._closed:
                self._changed.wait(timeout)
            # Also when nothing new comes: what waits too long is dropped before it is taken.
            self._drop_oldest(time.monotonic_ns() - self._max_delay_ns)
            if not self._items:
                return None if self._closed else []
            taken = [self._items.popleft() for _ in range(min(len(self._items), _TAKEN_AT_ONCE))]
            for item in taken:
                if isinstance(item, RawMessage):
                    self._bytes -= _cost(item)
                    item.dropped = self._dropped.pop(item.topic, 0)
                elif isinstance(item, Announcement):
                    self._announcements -= 1
            return taken

    def close(self) -> None:
        """Take in no more; what waits can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


def _cost(message: RawMessage) -> int:
    return len(message.payload) + max(_OVERHEAD, 2 * len(message.topic))
