"""What is known of one topic, from message to message, and on request from one run of a program to the next.

Lives here: `TopicState`, `Barrier`, and the limits of what a topic may carry.
Not here: what becomes of a message (`intake`).
"""

from dataclasses import dataclass
from typing import Any

from streamfeat.errors import InputError
from streamfeat.events import Resolution
from streamfeat.files.json_fields import Fields
from streamfeat.messages.packets import MAX_PIXELS
from streamfeat.messages.timeline import Timeline

__all__ = [
    "MAX_LIVE_PACKET_EVENTS",
    "MAX_TOPICS",
    "Barrier",
    "TopicState",
    "resolution_in",
]

MAX_LIVE_PACKET_EVENTS = 1 << 20
MAX_TOPICS = 256
_LATEST_US = 1 << 52
"""No snapshot holds a later time."""


@dataclass(slots=True)
class TopicState:
    """What is known of one topic.

    Attributes:
        timeline: of its packets.
        resolution: of its latest packet.
        heard_ns: when the latest message came, by the monotonic clock.
        silent_s: how long it has been silent, as far as this process was awake.
        label_end_us: end of the latest labelled sample.
        is_served: packets of it were handed on since it was last released.
    """

    timeline: Timeline
    resolution: Resolution | None = None
    heard_ns: int = 0
    silent_s: float = 0.0
    label_end_us: int = 0
    is_served: bool = False

    def snapshot(self, now_ns: int) -> dict[str, Any]:
        """What is known, as JSON values; `now_ns` by the monotonic clock."""
        about = {"resolution": self.resolution, "label_end_us": self.label_end_us}
        return self.timeline.snapshot(now_ns) | about

    def restore(self, values: Fields, now_ns: int) -> None:
        """Go on from a snapshot that was taken at `now_ns`, by the monotonic clock as it is now.

        Raises:
            InputError: the values are not those of a topic.
        """
        self.timeline.restore(values, now_ns)
        self.resolution = resolution_in(values)
        self.label_end_us = values.whole("label_end_us", -_LATEST_US, _LATEST_US)
        self.is_served = self.timeline.reached_us is not None


@dataclass(frozen=True, slots=True)
class Barrier:
    """A place in the stream: what an intake knew when all items before this one had been taken from it."""

    topics: dict[str, dict[str, Any]]


def resolution_in(values: Fields) -> Resolution | None:
    """`(height, width)` of a sensor that is not too large, or None where there is none.

    Raises:
        InputError: it is something else.
    """
    if "resolution" not in values:
        return None
    sides = values.wholes("resolution", 2, least=1)
    if len(sides) != 2 or sides[0] * sides[1] > MAX_PIXELS:
        raise InputError(f"{values.where}: a sensor of {sides} is not possible")
    return sides[0], sides[1]
