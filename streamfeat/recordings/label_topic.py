"""Labels for a recording from one of its own topics, whose messages say what is going on.

Lives here: when each of their texts begins and ends to hold.
Not here: which messages these are (`streamfeat.messages.text_messages`), and putting labels into a stream
(`labels`).

A text holds from its message to the next one with another text, so that it may be repeated at any rate; an
empty text ends it. Its time is the stamp where the type has one, by the clock of the host, and the log time
otherwise. That clock is tied to the camera's where a packet is logged: at its last event.
"""

from itertools import pairwise
from pathlib import Path

from streamfeat.errors import InputError
from streamfeat.messages.cdr import LabelMessage
from streamfeat.messages.event_messages import ros2_name
from streamfeat.messages.packets import Label
from streamfeat.messages.text_messages import TEXT_SCHEMAS, parse_text
from streamfeat.recordings.labels import LabelTable, read_labels
from streamfeat.recordings.losses import Losses
from streamfeat.recordings.sources import WHOLE, Source, StoredMessage, unpacked_message

__all__ = ["labels_for"]

_MOST_TEXTS = 1_000_000
_LATEST_NS = 1 << 62


def labels_for(source: Source, wanted: str | None, events: str) -> LabelTable | None:
    """The labels that are to stand in place of those in a recording; None where those are wanted.

    Args:
        source: of the recording.
        wanted: name of one of its topics, or of a label file.
        events: topic of the events.

    Raises:
        InputError: there is neither, or it holds no labels.
    """
    kinds = {topic.name: ros2_name(topic.schema) for topic in source.topics}
    if wanted is None or kinds.get(wanted) == LabelMessage.SCHEMA_NAME:
        return None
    if kinds.get(wanted) in TEXT_SCHEMAS:
        return _read_topic(source, wanted, events)
    if Path(wanted).exists():
        return read_labels(Path(wanted))
    if wanted in kinds:
        known = ", ".join(TEXT_SCHEMAS)
        raise InputError(
            f"{source.path}: topic {wanted} says no label, its type is {kinds[wanted] or 'unknown'}; "
            f"known are {known}"
        )
    try:
        return read_labels(Path(wanted))
    except InputError as error:
        texts = ", ".join(sorted(name for name, kind in kinds.items() if kind in TEXT_SCHEMAS))
        raise InputError(f"{error}; topics that can be labels: {texts}" if texts else str(error)) from None


def _read_topic(source: Source, name: str, events: str) -> LabelTable:
    """Read the labels of a topic; for the end of the last one all of the recording is passed over.

    Args:
        source: of the recording.
        name: of the topic.
        events: topic of the events.

    Raises:
        InputError: the topic has no text, or more than a million changes of it.
    """
    changes: list[tuple[int, str]] = []
    bad, why = 0, ""
    for _, item in source.read(name, WHOLE, Losses()):
        if not isinstance(item, StoredMessage) or item.topic != name:
            continue
        try:
            text, stamp_ns = parse_text(item.schema, unpacked_message(item.data), item.encoding)
        except InputError as error:
            bad, why = bad + 1, why or str(error)
            continue
        if not changes or changes[-1][1] != text:
            changes.append((min(stamp_ns or item.log_time_ns, _LATEST_NS), text))
        if len(changes) > _MOST_TEXTS:
            raise InputError(f"{source.path}: topic {name} changes its text over {_MOST_TEXTS} times")
    changes.sort(key=lambda change: change[0])
    if changes and changes[-1][1]:
        last_ns = changes[-1][0]
        for _, item in source.read(events, WHOLE, Losses()):
            if isinstance(item, StoredMessage) and item.topic == events:
                last_ns = max(last_ns, item.log_time_ns)
        changes.append((last_ns + 1000, ""))
    labels = tuple(
        Label(start // 1000, stop // 1000 - start // 1000, text, source=f"{name}:{number}")
        for number, ((start, text), (stop, _)) in enumerate(pairwise(changes), 1)
        if text and stop // 1000 > start // 1000
    )
    if not labels:
        raise InputError(f"{source.path}: topic {name} holds no text to label events with{why and ': '}{why}")
    said = f"{bad} messages of topic {name} are left out: {why}" if bad else ""
    return LabelTable(Path(name), labels, "host", said)
