"""A rosbag2 SQLite file (`.db3`) as the source of a recording.

Lives here: its two tables, read in the order of log time. Not here: the folder around it (`bags`).

The `sqlite3` of Python reads it, so that no ROS and no other library is needed.
"""

import sqlite3
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from streamfeat.errors import InputError
from streamfeat.files.locations import Location
from streamfeat.recordings.records import MAX_RECORD_BYTES, Losses
from streamfeat.recordings.sources import Part, StoredMessage, Topic

__all__ = ["SqliteSource"]


class SqliteSource:
    """See `Source`; it is read as a whole.

    Args:
        path: the file, which is local.

    Raises:
        InputError: it is not there, damaged from its begin, or holds other tables.
    """

    path: Location
    topics: list[Topic]

    def __init__(self, path: Path) -> None:
        """Open it, to read only, and find out what is there."""
        self.path = path
        if not path.is_file():
            raise InputError(f"{path}: cannot be opened: no such file")
        # immutable: a bag on a disk that cannot be written to has no room for a journal.
        self._database = sqlite3.connect(
            f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True, check_same_thread=False
        )
        self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_RECORD_BYTES)
        try:
            rows = self._database.execute(
                "SELECT id, name, type, serialization_format FROM topics"
            ).fetchall()
            counts = self._counts()
        except (sqlite3.Error, OverflowError) as error:
            self._database.close()
            raise InputError(
                f"{path}: cannot be read as a rosbag2 database: {error}; is it one, and is it whole?"
            ) from None
        self._formats = {number: str(encoding) for number, _, _, encoding in rows}
        self._names = {number: (str(name), str(kind)) for number, name, kind, _ in rows}
        self.topics = [
            Topic(str(name), str(kind), "", n_messages=counts.get(number, 0))
            for number, name, kind, _ in rows
        ]

    def _counts(self) -> dict[int, int]:
        """Messages of each topic; none are known where the table is damaged."""
        try:
            return dict(self._database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
        except sqlite3.DatabaseError:
            return {}

    def read(self, topic: str, part: Part, losses: Losses) -> Iterator[tuple[int, StoredMessage]]:
        """See `Source`; the byte of a message is its row."""
        wanted = {t.name for t in self.topics if t.holds == "labels"} | {topic}
        numbers = {number for number, (name, _) in self._names.items() if name in wanted}
        marks = ", ".join(map(str, sorted(numbers)))
        seen: Counter[str] = Counter()
        try:
            rows = self._database.execute(
                "SELECT topic_id, timestamp, data FROM messages "
                f"WHERE topic_id IN ({marks}) ORDER BY timestamp, id"
            )
            for number, log_time_ns, data in rows:
                name, kind = self._names[number]
                seen[name] += 1
                if not isinstance(data, bytes) or not isinstance(log_time_ns, int):
                    where = f"topic {name!r}, message {seen[name]}: no bytes, or no time"
                    losses.add("damaged record", 0, where)
                    continue
                yield (
                    0,
                    StoredMessage(name, kind, self._formats[number], data, log_time_ns, 0, seen[name]),
                )
        except (sqlite3.Error, OverflowError) as error:
            n = sum(seen.values())
            losses.add("damaged database", 0, f"after message {n}: {error}")
        for name in wanted:
            missing = sum(t.n_messages for t in self.topics if t.name == name) - seen[name]
            if missing > 0:
                losses.add("missing message", 0, f"topic {name!r}: {missing} not found", missing)

    def cuts(self) -> list[int]:
        """See `Source`."""
        return []

    def close(self) -> None:
        """See `Source`."""
        self._database.close()
