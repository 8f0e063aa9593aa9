"""An MCAP file as the source of a recording.

Lives here: `McapSource`: its topics, and which of its messages are asked for.
Not here: the file format and its damage (`records`), what messages mean (`streamfeat.messages`).
"""

from collections import Counter
from collections.abc import Iterator
from typing import BinaryIO

from mcap.records import Channel, Schema

from streamfeat.files.locations import Location
from streamfeat.messages.cdr import LabelMessage
from streamfeat.messages.packets import EVENT_SCHEMAS
from streamfeat.recordings.records import (
    Losses,
    Summary,
    count_missing,
    iter_messages,
    iter_records,
    open_mcap,
    read_summary,
)
from streamfeat.recordings.sources import WHOLE, Part, StoredMessage, Topic

__all__ = ["McapSource"]


class McapSource:
    """See `Source`; the byte of a message is that of its chunk.

    Args:
        path: the file.

    Raises:
        InputError: the file is missing, empty or no MCAP.
    """

    path: Location
    topics: list[Topic]

    def __init__(self, path: Location) -> None:
        """Open it and find out what is there."""
        self.path = path
        self._file = open_mcap(path)
        try:
            summary = read_summary(self._file)
            # Counts from a summary tell what should be there; a scan can only tell what is.
            self._has_summary = summary is not None
            self._known = summary or _scan(self._file)
        except BaseException:
            self._file.close()
            raise
        self.topics = _topics(self._known)

    def read(self, topic: str, part: Part, losses: Losses) -> Iterator[tuple[int, StoredMessage]]:
        """See `Source`."""
        promised = self._known.channels if self._has_summary and part == WHOLE else {}
        seen: Counter[int] = Counter()
        for at, channel, schema, message in iter_messages(
            self._file, self._known, losses, part.start, part.end
        ):
            if schema.name == LabelMessage.SCHEMA_NAME or (
                channel.topic == topic and schema.name in EVENT_SCHEMAS
            ):
                seen[channel.id] += 1
                stored = message.data, message.log_time, message.sequence, seen[channel.id]
                yield at, StoredMessage(channel.topic, schema.name, "cdr", *stored)
        for channel_id, channel in promised.items():
            kind = self._known.schemas.get(channel.schema_id)
            if channel.topic == topic or (kind and kind.name == LabelMessage.SCHEMA_NAME):
                count_missing(self._known, channel_id, seen[channel_id], losses)

    def cuts(self) -> list[int]:
        """See `Source`."""
        return sorted(self._known.chunk_starts)

    def close(self) -> None:
        """See `Source`."""
        self._file.close()


def _scan(file: BinaryIO) -> Summary:
    """Build what a summary would say, from the records that are there."""
    found, counts = Summary(), Counter[int]()
    for _, record in iter_records(file, Losses()):
        if isinstance(record, Channel):
            found.channels[record.id] = record
        elif isinstance(record, Schema):
            found.schemas[record.id] = record
        else:
            counts[record.channel_id] += 1
    found.message_counts = dict(counts)
    return found


def _topics(known: Summary) -> list[Topic]:
    """List the topics; several channels of one topic and schema are one."""
    counts: dict[tuple[str, str, str], int] = {}
    for channel in known.channels.values():
        schema = known.schemas.get(channel.schema_id)
        key = (channel.topic, schema.name if schema else "", schema.encoding if schema else "")
        counts[key] = counts.get(key, 0) + known.message_counts.get(channel.id, 0)
    return [Topic(*key, n_messages=n) for key, n in counts.items()]
