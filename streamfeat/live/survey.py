"""What topics carry: type, encoding, resolution and rate of each, by listening for a while.

Lives here: counting what comes on topics that were found. Not here: finding them (`network`), and what their
messages do to a pipeline (`intake`).
"""

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import zenoh
from zenoh.handlers import Callback

from streamfeat.errors import InputError
from streamfeat.events import Resolution
from streamfeat.live.names import Names, PlainNames, RosNames
from streamfeat.live.network import FoundTopic
from streamfeat.messages.cdr import EventArray
from streamfeat.messages.event_messages import EVENT_SCHEMAS, parse_events

__all__ = ["HeardTopic", "hear_topics"]

MOST_HEARD = 256
"""Topics that are listened to at a time; further ones are listed without a rate."""
_LARGEST_BYTES = 4 << 20


@dataclass(slots=True)
class _Counts:
    """What came on one topic; `last` is the latest message of events, with its type."""

    messages: int = 0
    payload_bytes: int = 0
    last: tuple[str, bytes] | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)


@dataclass(frozen=True, slots=True)
class HeardTopic:
    """A topic and what it carries.

    Attributes:
        found: the topic.
        type: of its messages, as ROS 2 writes it; empty where no message came.
        encoding: of its payloads; empty where the type has none, or no message could be read.
        resolution: `(height, width)` of the sensor; None where no message could be read.
        rate_hz: messages a second.
        bytes_per_s: of those messages.
    """

    found: FoundTopic
    type: str
    encoding: str
    resolution: Resolution | None
    rate_hz: float
    bytes_per_s: float


def hear_topics(
    session: zenoh.Session, found: Sequence[FoundTopic], seconds: float = 1.0
) -> list[HeardTopic]:
    """Listen to topics for a while, and tell what they carry.

    Args:
        session: open.
        found: from `find_topics`; the first 256 are listened to.
        seconds: how long.
    """
    counts = [_Counts() for _ in found]
    watching: list[object] = []
    started = time.monotonic()
    for topic, count in zip(found[:MOST_HEARD], counts, strict=False):
        if "*" in topic.name:
            continue  # it would stand for others
        try:
            is_ros = topic.kind == "ros2"
            names = RosNames(topic.name, topic.domain) if is_ros else PlainNames(topic.name)
            watching += [
                session.declare_subscriber(expression, Callback(_counting(names, count), indirect=False))
                for expression in names.subscriptions
            ]
        except (zenoh.ZError, InputError):
            continue  # a token can name what is no topic
    time.sleep(max(seconds, 0))
    for one in watching:
        one.undeclare()  # type: ignore[attr-defined]
    passed_s = max(time.monotonic() - started, 1e-3)
    return [_heard(topic, count, passed_s) for topic, count in zip(found, counts, strict=True)]


def _counting(names: Names, count: _Counts):  # type: ignore[no-untyped-def]
    def on_sample(sample: zenoh.Sample) -> None:
        schema = names.schema(str(sample.key_expr), str(sample.encoding))
        size = len(sample.payload)
        if sample.kind != zenoh.SampleKind.PUT or schema not in EVENT_SCHEMAS or size > _LARGEST_BYTES:
            return
        with count.lock:
            count.messages += 1
            count.payload_bytes += size
            count.last = str(schema), sample.payload.to_bytes()

    return on_sample


def _heard(topic: FoundTopic, count: _Counts, seconds: float) -> HeardTopic:
    encoding, resolution, schema = "", None, ""
    if count.last:
        schema, data = count.last
        try:
            message = parse_events(schema, data)
            resolution = message.height, message.width
            encoding = "" if isinstance(message, EventArray) else message.encoding
        except InputError:
            pass
    rates = count.messages / seconds, count.payload_bytes / seconds
    return HeardTopic(topic, schema, encoding, resolution, *rates)
