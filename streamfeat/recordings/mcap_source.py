"""An MCAP file as the source of a recording.

Lives here: `McapSource`: its topics, and which of its messages are asked for.
Not here: the file format and its damage (`records`), what messages mean (`streamfeat.messages`).
"""

import math
from collections import Counter
from collections.abc import Iterator
from typing import BinaryIO

from mcap.records import Channel, Schema

from streamfeat.files.locations import Location
from streamfeat.messages.cdr import LabelMessage
from streamfeat.messages.event_messages import EVENT_SCHEMAS, ros2_name
from streamfeat.messages.text_messages import TEXT_SCHEMAS
from streamfeat.recordings.order import are_in_order, clean_cuts, in_log_order
from streamfeat.recordings.records import (
    Block,
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

_BLOCK_BYTES = 1 << 16
_READ = frozenset((*EVENT_SCHEMAS, *TEXT_SCHEMAS))


class McapSource:
    """See `Source`; the byte of a message is that of its chunk.

    Args:
        path: the file.

    Attributes:
        damage: where a file without a summary is cut short or damaged first; empty otherwise.

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
            losses = Losses()
            self._known = summary or _scan(self._file, losses)
            self.damage = next(iter(losses.first.values()), "")
        except BaseException:
            self._file.close()
            raise
        self.topics = _topics(self._known)
        blocks = sorted(self._known.blocks)
        if not are_in_order(blocks):
            blocks.sort(key=lambda block: (block.first_ns, block.at))
        self._blocks = blocks

    def read(self, topic: str, part: Part, losses: Losses) -> Iterator[tuple[int, StoredMessage]]:
        """See `Source`."""
        promised = self._known.channels if self._has_summary and part == WHOLE else {}
        seen: Counter[int] = Counter()
        yield from in_log_order(self._stored(topic, part, losses, seen), self._blocks)
        for channel_id, channel in promised.items():
            kind = self._known.schemas.get(channel.schema_id)
            if channel.topic == topic or (kind and kind.name == LabelMessage.SCHEMA_NAME):
                count_missing(self._known, channel_id, seen[channel_id], losses)

    def _stored(
        self, topic: str, part: Part, losses: Losses, seen: Counter[int]
    ) -> Iterator[tuple[int, StoredMessage]]:
        """Messages as they stand in the file, or chunk by chunk in order of their first times.

        A label stays before the message of events that follows it, whichever has the earlier log time.
        """
        labels: list[tuple[int, StoredMessage]] = []
        for start, stop in self._stretches(part):
            for at, channel, schema, message in iter_messages(
                self._file, self._known, losses, start, part.end, stop
            ):
                kind = ros2_name(schema.name)
                if kind == LabelMessage.SCHEMA_NAME or (channel.topic == topic and kind in _READ):
                    seen[channel.id] += 1
                    layout = "ros1" if channel.message_encoding == "ros1" else "cdr"
                    stored = message.log_time, message.sequence, seen[channel.id]
                    item = StoredMessage(channel.topic, kind, layout, message.data, *stored)
                    if kind == LabelMessage.SCHEMA_NAME:
                        labels.append((at, item))
                        continue
                    for place, label in labels:
                        yield place, label._replace(log_time_ns=min(label.log_time_ns, item.log_time_ns))
                    labels.clear()
                    yield at, item
        yield from labels

    def _stretches(self, part: Part) -> Iterator[tuple[int, float]]:
        starts = [block.at for block in self._blocks]
        if starts == sorted(starts):
            yield part.start, math.inf
            return
        starts.sort()
        ends = dict(zip(starts, [*starts[1:], math.inf], strict=True))
        if part.start < starts[0]:
            yield part.start, starts[0]
        for block in self._blocks:
            if block.at >= part.start:
                yield block.at, ends[block.at]

    def cuts(self) -> list[int]:
        """See `Source`."""
        return clean_cuts(sorted(self._known.blocks))

    def close(self) -> None:
        """See `Source`."""
        self._file.close()


def _scan(file: BinaryIO, losses: Losses) -> Summary:
    """Build what a summary would say, from the records that are there; `losses` is changed."""
    found, counts = Summary(), Counter[int]()
    for at, record in iter_records(file, losses):
        if isinstance(record, Channel):
            found.channels[record.id] = record
        elif isinstance(record, Schema):
            found.schemas[record.id] = record
        else:
            counts[record.channel_id] += 1
            last = found.blocks[-1] if found.blocks else None
            # Messages outside of chunks are taken together, so that there are few blocks.
            if last is None or (at != last.at and at > last.at + _BLOCK_BYTES):
                found.blocks.append(Block(at, record.log_time, record.log_time))
            else:
                first_ns, last_ns = min(last.first_ns, record.log_time), max(last.last_ns, record.log_time)
                found.blocks[-1] = Block(last.at, first_ns, last_ns)
    found.message_counts = dict(counts)
    return found


def _topics(known: Summary) -> list[Topic]:
    """List the topics; several channels of one topic and schema are one."""
    counts: dict[tuple[str, str, str], int] = {}
    for channel in known.channels.values():
        schema = known.schemas.get(channel.schema_id)
        key = (channel.topic, ros2_name(schema.name) if schema else "", schema.encoding if schema else "")
        counts[key] = counts.get(key, 0) + known.message_counts.get(channel.id, 0)
    return [Topic(*key, n_messages=n) for key, n in counts.items()]
