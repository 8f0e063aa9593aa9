"""What is known of one topic, from message to message, and on request from one run of a program to the next.

Lives here: `TopicState`, `Barrier`, and the limits of what a topic may carry.
Not here: what becomes of a message (`intake`).
"""

from dataclasses import dataclass, field
from typing import Any

from streamfeat.errors import InputError
from streamfeat.events import Resolution
from streamfeat.files.json_fields import Fields
from streamfeat.messages.clock import CameraClock
from streamfeat.messages.delivery import Delivery
from streamfeat.messages.packets import MAX_PIXELS, PacketReader

__all__ = [
    "MAX_LABEL_US",
    "MAX_LIVE_PACKET_EVENTS",
    "MAX_STREAM_US",
    "MAX_TOPICS",
    "Barrier",
    "TopicState",
    "resolution_in",
]

MAX_LIVE_PACKET_EVENTS = 1 << 20
MAX_TOPICS = 256
MAX_LABEL_US = 3_600_000_000
MAX_STREAM_US = (1 << 31) * 1_000_000 - 2 * MAX_LABEL_US
"""Times go into message stamps, which have 31 bits of seconds."""
_LATEST_US = 1 << 52
"""A clock that wraps can lead beyond that, if never so far."""


@dataclass(slots=True)
class TopicState:
    """What is known of one topic.

    Attributes:
        reader: its decoders.
        clock: of its camera.
        delivery: of its packets.
        resolution: of its latest packet.
        packets: used.
        payload_bytes: of those.
        heard_ns: when the latest message came, by the monotonic clock.
        stream_us: time that its events have reached; None before the first.
        silent_s: how long it has been silent, as far as this process was awake.
        label_end_us: end of the latest labelled sample.
        lost: packets missing or refused since the latest one.
    """

    reader: PacketReader
    clock: CameraClock
    delivery: Delivery = field(default_factory=Delivery)
    resolution: Resolution | None = None
    packets: int = 0
    payload_bytes: int = 0
    heard_ns: int = 0
    stream_us: int | None = None
    silent_s: float = 0.0
    label_end_us: int = 0
    lost: int = 0

    def snapshot(self, now_ns: int) -> dict[str, Any]:
        """What is known, as JSON values; `now_ns` by the monotonic clock."""
        return {
            "reader": self.reader.snapshot(),
            "clock": self.clock.snapshot(now_ns),
            "delivery": self.delivery.snapshot(now_ns),
            "resolution": self.resolution,
            "stream_us": self.stream_us,
            "label_end_us": self.label_end_us,
            "lost": self.lost,
        }

    def restore(self, values: Fields, now_ns: int) -> None:
        """Go on from a snapshot that was taken at `now_ns`, by the monotonic clock as it is now.

        Raises:
            InputError: the values are not a snapshot.
        """
        self.reader.restore(values.inner("reader"))
        self.clock.restore(values.inner("clock"), now_ns)
        self.delivery.restore(values.inner("delivery"), now_ns)
        self.resolution = resolution_in(values)
        self.stream_us = values.maybe("stream_us", 0, _LATEST_US)
        self.label_end_us = values.whole("label_end_us", -_LATEST_US, _LATEST_US)
        self.lost = values.whole("lost")


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
