"""Sources of recordings, of any format: the protocol that files, bags and tables follow.

Lives here: `Source`, `Topic`, `Part`, and `StoredMessage`, which a source of messages gives.
Not here: any one format (`mcap_source`), which of them a path has (`opening`), decoding and time (`reader`).
"""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import zstandard

from streamfeat.errors import InputError
from streamfeat.files.budget import Budget
from streamfeat.files.locations import Location
from streamfeat.messages.cdr import LabelMessage
from streamfeat.messages.packets import EVENT_SCHEMAS, Label, Packet
from streamfeat.recordings.records import MAX_RECORD_BYTES, Losses

__all__ = ["WHOLE", "Part", "Source", "SourceItem", "StoredMessage", "Topic", "labels_in", "unpacked_message"]


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a recording.

    Attributes:
        name: of the topic.
        schema: type of its messages; for a file that is no recording of messages, the name of its format.
        schema_encoding: how the schema is written down, `ros2msg` for one; empty if there is none.
        n_messages: how many there are; 0 if the source does not say.
        is_events: whether it holds events although its schema is none of `EVENT_SCHEMAS`.
    """

    name: str
    schema: str
    schema_encoding: str
    n_messages: int
    is_events: bool = False

    @property
    def holds(self) -> Literal["events", "labels", ""]:
        """What streamfeat can read there."""
        if self.is_events or self.schema in EVENT_SCHEMAS:
            return "events"
        return "labels" if self.schema == LabelMessage.SCHEMA_NAME else ""


@dataclass(frozen=True, slots=True)
class Part:
    """Some chunks of a recording, from byte `start` to byte `end`.

    Where there are labels it begins with the first in those chunks and reaches to the first behind them, so
    that the parts of a recording hold each label and its events once, whichever chunk these are in.
    """

    start: int
    end: float


_ZSTD = b"\x28\xb5\x2f\xfd"

WHOLE = Part(0, math.inf)
"""All of a recording."""


class StoredMessage(NamedTuple):
    """One message as it was stored.

    Attributes:
        topic: where it was published.
        schema: type of the message, as ROS 2 writes it (`package/msg/Type`).
        encoding: how its fields are laid out: `cdr`, or `ros1`.
        data: its bytes.
        log_time_ns: when it was recorded, since 1970.
        sequence: what the file counts it as; 0 if it does not.
        number: counts the messages of its topic, from 1; named in errors.
    """

    topic: str
    schema: str
    encoding: str
    data: bytes | memoryview
    log_time_ns: int
    sequence: int
    number: int


SourceItem = StoredMessage | Packet | Label
"""An item of a source: a message still to be decoded, or a packet or label that is decoded."""


class Source(Protocol):
    """Where the items of a recording come from.

    Attributes:
        path: of the file or folder, as it is shown.
        topics: all of them, also those that hold nothing for streamfeat.
    """

    path: Location
    topics: list[Topic]

    def read(self, topic: str, part: Part, losses: Losses) -> Iterator[tuple[int, SourceItem]]:
        """Yield the messages of one topic and of all topics with labels, in order of log time.

        Each comes with its byte: a number that never falls, by which `part` is cut. Damage is skipped and
        counted. A second call begins anew.

        Args:
            topic: of the events, or of texts that label them.
            part: where to begin; items behind its end still come, but what is lost there is not counted.
            losses: changed.
        """

    def cuts(self) -> list[int]:
        """Bytes at which a `Part` may begin, ascending; empty if the source can be read as a whole only."""

    def close(self) -> None:
        """Close all files; reading after that is an error."""


def unpacked_message(data: bytes | memoryview) -> bytes | memoryview:
    """A message that was compressed by itself (rosbag2's `compression_mode: message`), or as it is.

    Raises:
        InputError: it cannot be unpacked, or has more than `MAX_RECORD_BYTES` or its budget.
    """
    if data[:4] != _ZSTD:  # no CDR message begins so: its first byte is 0
        return data
    try:
        most = min(Budget(len(data)).left, MAX_RECORD_BYTES)
        unpacked = zstandard.ZstdDecompressor().stream_reader(data).read(most + 1)
    except zstandard.ZstdError as error:
        raise InputError(f"the compressed message cannot be unpacked: {error}") from None
    if len(unpacked) > most:
        raise InputError(f"the compressed message has more than {most} bytes")
    return bytes(unpacked)


def labels_in(source: Source, topic: str, part: Part) -> Iterator[Label]:
    """Yield the labels of a part without decoding its events; those that cannot be read are left out.

    Args:
        source: of messages; nothing of it is changed.
        topic: of the events.
        part: which labels; those behind its end are not read.
    """
    for at, stored in source.read(topic, part, Losses()):
        if at >= part.end:
            return
        if isinstance(stored, StoredMessage) and stored.schema == LabelMessage.SCHEMA_NAME:
            with suppress(InputError):
                yield Label.from_cdr(unpacked_message(stored.data))
