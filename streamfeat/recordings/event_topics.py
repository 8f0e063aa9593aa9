"""Which topic of a recording is read.

Lives here: the topics that carry events, and the one that is meant. Not here: reading it (`reader`).
"""

from streamfeat.errors import InputError
from streamfeat.recordings.opening import RecordingPath, open_source
from streamfeat.recordings.options import AS_IT_IS, ReadOptions
from streamfeat.recordings.sources import Source

__all__ = ["choose_topic", "event_topics"]

_TOPICS_SHOWN = 20


def choose_topic(source: Source, wanted: str | None) -> str:
    """The event topic that is wanted, or the only one.

    Raises:
        InputError: there is none, several of which none is chosen, or not this one.
    """
    path, topics = source.path, source.topics
    names = _event_topics(source)
    if not names:
        others = ", ".join(f"{topic.name} ({topic.schema or 'no type'})" for topic in topics[:_TOPICS_SHOWN])
        more = f" and {len(topics) - _TOPICS_SHOWN} more" if len(topics) > _TOPICS_SHOWN else ""
        told = f"there are {others}{more}" if topics else "it has none"
        damage = getattr(source, "damage", "")
        told += f". Not all of it can be read: {damage}" if damage else ""
        raise InputError(f"{path}: no topic carries events; {told}")
    if wanted is None and len(names) > 1:
        raise InputError(
            f"{path}: {len(names)} topics carry events: {', '.join(names)}; choose one with --topic"
        )
    if wanted is not None and wanted not in names:
        raise InputError(f"{path}: no events on topic {wanted}; --topic can be {', '.join(names)}")
    return wanted or names[0]


def _event_topics(source: Source) -> list[str]:
    return sorted({topic.name for topic in source.topics if topic.holds == "events"})


def event_topics(path: RecordingPath, options: ReadOptions = AS_IT_IS) -> list[str]:
    """Names of the event topics at a place, sorted.

    Raises:
        InputError: it cannot be opened.
    """
    source = open_source(path, None, options)
    try:
        return _event_topics(source)
    finally:
        source.close()
