"""A ROS 1 bag (`.bag`) as the source of a recording, read by the library `rosbags` (extra `bags`).

Lives here: what of a bag is asked for. Not here: what messages mean (`streamfeat.messages`).
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from streamfeat.errors import InputError
from streamfeat.files.locations import Location
from streamfeat.recordings.records import Losses
from streamfeat.recordings.sources import Part, StoredMessage, Topic

__all__ = ["Ros1Source"]


class Ros1Source:
    """See `Source`; it is read as a whole.

    Args:
        path: the file, which is local.

    Raises:
        InputError: `rosbags` is not installed, or the file is no whole bag.
    """

    path: Location
    topics: list[Topic]

    def __init__(self, path: Path) -> None:
        """Open it and read its index."""
        try:
            from rosbags.rosbag1 import Reader
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError:
            raise InputError(f"{path}: a ROS 1 bag needs rosbags: pip install 'streamfeat[bags]'") from None
        self.path = path
        try:
            self._bag: Any = Reader(path)
            self._bag.open()
        except Exception as error:  # the library lets through whatever damage makes of it
            raise InputError(
                f"{path}: cannot be opened as a ROS 1 bag: {error or type(error).__name__}; "
                "`rosbag reindex` mends one that was not closed"
            ) from None
        counts: dict[tuple[str, str], int] = {}
        for connection in self._bag.connections:
            key = (connection.topic, connection.msgtype)
            counts[key] = counts.get(key, 0) + connection.msgcount
        self._types = get_typestore(Stores.ROS2_HUMBLE)
        for kind, connection in {c.msgtype: c for c in self._bag.connections}.items():
            try:
                found = get_types_from_msg(connection.msgdef.data, kind)
                # Types that ROS 2 has as well stay its own: a header of ROS 1 has a number more.
                new = {name: type_ for name, type_ in found.items() if name not in self._types.types}
                self._types.register(new)
            except Exception:  # a type that the library cannot parse has no messages for us
                continue
        self.topics = [Topic(*key, "ros1msg", n_messages=n) for key, n in counts.items()]

    def read(self, topic: str, part: Part, losses: Losses) -> Iterator[tuple[int, StoredMessage]]:
        """See `Source`; the byte of every message is 0."""
        wanted = {t.name for t in self.topics if t.holds == "labels"} | {topic}
        connections = [c for c in self._bag.connections if c.topic in wanted]
        promised = sum(c.msgcount for c in connections)
        seen: Counter[str] = Counter()
        try:
            for connection, log_time_ns, data in self._bag.messages(connections) if connections else ():
                name = connection.topic
                seen[name] += 1
                cdr = bytes(self._types.ros1_to_cdr(data, connection.msgtype))
                yield 0, StoredMessage(name, connection.msgtype, "cdr", cdr, log_time_ns, 0, seen[name])
        except Exception as error:  # as above
            where = f"after message {sum(seen.values())}: {error or type(error).__name__}"
            losses.add("damaged bag", 0, where)
        missing = promised - sum(seen.values())
        if missing > 0:
            losses.add("missing message", 0, f"topic {topic!r}: {missing} not found", missing)

    def cuts(self) -> list[int]:
        """See `Source`."""
        return []

    def close(self) -> None:
        """See `Source`."""
        self._bag.close()
