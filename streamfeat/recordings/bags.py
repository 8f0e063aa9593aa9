"""Several files as one recording: rosbag2 folders, and lists of files.

Lives here: which files of a folder belong to the bag, what its `metadata.yaml` promises, and reading all of
them in the order of log time, each opened when its time comes.
Not here: the files themselves (`mcap_source`, `sqlite_source`, `ros1_source`), and which of them a path has
(`opening`).
"""

import heapq
import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

from streamfeat.errors import InputError
from streamfeat.files.locations import Location, StoreLocation, files_below, natural_order, open_binary
from streamfeat.recordings.records import Losses
from streamfeat.recordings.sources import WHOLE, Part, Source, SourceItem, StoredMessage, Topic

__all__ = ["BAG_ENDINGS", "METADATA", "FilesSource", "Metadata", "bag_members", "is_bag", "read_metadata"]

BAG_ENDINGS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
"""Files of a rosbag2 folder."""

MOST_FILES = 512
METADATA = "metadata.yaml"
"""What rosbag2 puts beside the files of a bag."""

_METADATA_BYTES = 1 << 24
_SHOWN = 3


@dataclass(frozen=True, slots=True)
class Metadata:
    """The contents of a bag according to its `metadata.yaml`.

    Attributes:
        names: of files, without folders.
        counts: messages of each topic.
    """

    names: tuple[str, ...] = ()
    counts: dict[str, int] = field(default_factory=dict)


def read_metadata(text: str) -> Metadata:
    """Read file names and counts, whatever version wrote them and however it was edited since.

    The few lines that matter have kept their form from version 1 on. A YAML library would refuse a file with
    one wrong line, and nothing in it is needed to read the bag.
    """
    names = re.findall(r"""[^\s"'\[\],/\\]+\.(?:mcap|db3)(?:\.zstd)?(?=["'\s,\]]|$)""", text)
    counts = {}
    topics = text.partition("topics_with_message_count:")[2]
    for entry in re.split(r"^\s*- (?=message_count|topic_metadata)", topics, flags=re.MULTILINE)[1:]:
        name = re.search(r"^\s*name:\s*(\S+)", entry, re.MULTILINE)
        count = re.search(r"^\s*(?:- )?message_count:\s*(\d{1,18})\b", entry, re.MULTILINE)
        if name and count:
            counts[name[1].strip("'\"")] = int(count[1])
    return Metadata(tuple(dict.fromkeys(names)), counts)


def is_bag(folder: Location) -> bool:
    """Whether a folder holds a bag: its `metadata.yaml`, or a file that one can have."""
    return any(f.name == METADATA or f.name.endswith(BAG_ENDINGS) for f in _files_in(folder))


def bag_members(folder: Location) -> tuple[list[Location], Metadata, list[str]]:
    """The files of a bag in a folder, its metadata, and a line for each assumption that was made.

    The files are those that `metadata.yaml` names, as far as they are there; all that a bag can have if none
    of them is there. A file beside its own compressed copy stands for both.

    Raises:
        InputError: the folder holds no file of a bag.
    """
    there = {place.name: place for place in _files_in(folder)}
    files = {
        name: place
        for name, place in there.items()
        if name.endswith(BAG_ENDINGS)
        and (not name.endswith(".zstd") or name.removesuffix(".zstd") not in there)
    }
    metadata, said = Metadata(), []
    if METADATA in there:
        with open_binary(there[METADATA]) as file:
            metadata = read_metadata(file.read(_METADATA_BYTES).decode("utf-8", "replace"))
    # A bag that was unpacked, or packed, keeps the names that it had before.
    named = {n for name in metadata.names for n in (name, name.removesuffix(".zstd"), f"{name}.zstd")}
    missing = [n for n in metadata.names if not {n, n.removesuffix(".zstd"), f"{n}.zstd"} & set(files)]
    chosen = {name: place for name, place in files.items() if name in named} or files
    if not chosen:
        wanted = f"; {METADATA} names {_some(missing)}" if missing else ""
        raise InputError(
            f"{folder}: is a folder without a bag: no file in it ends in {', '.join(BAG_ENDINGS)}{wanted}. "
            "`streamfeat convert` makes a recording of a data set folder"
        )
    if missing:
        said.append(f"{METADATA} names {_some(missing)}, which the folder does not hold")
    if left_out := sorted(set(files) - set(chosen)):
        said.append(f"{_some(left_out)} left out: {METADATA} does not name them")
    return [chosen[name] for name in sorted(chosen, key=natural_order)], metadata, said


class FilesSource:
    """See `Source`: several files, read as a whole, in the order of log time.

    A file that cannot be opened is counted as lost; only where none can is that an error. At a time those
    files are read whose log times overlap.

    Args:
        path: how all of them are called.
        members: the files, at most 512.
        open_member: opens one.
        metadata: what is promised of them.
        said: about them, for `assumptions`.

    Raises:
        InputError: no file can be opened, or there are too many.
    """

    topics: list[Topic]

    def __init__(
        self,
        path: Location,
        members: Sequence[Location],
        open_member: Callable[[Location], Source],
        metadata: Metadata = Metadata(),
        said: Sequence[str] = (),
    ) -> None:
        """Open all files, and find out what is there."""
        self.path = path
        if len(members) > MOST_FILES:
            raise InputError(f"{path}: {len(members)} files; a recording has at most {MOST_FILES}")
        self._metadata = metadata
        self._sources: list[Source] = []
        self._unreadable: list[tuple[str, str]] = []
        self._starts: dict[str, list[float]] = {}
        with ExitStack() as opened:
            for member in members:
                try:
                    self._sources.append(open_member(member))
                    opened.callback(self._sources[-1].close)
                except InputError as error:
                    self._unreadable.append((member.name, str(error)))
            if not self._sources:
                raise InputError(self._unreadable[0][1] if self._unreadable else f"{path}: no such files")
            self._closing = opened.pop_all()
        self.assumptions = [*said, *(line for s in self._sources for line in assumptions_of(s))]
        counts: dict[tuple[str, str, str, bool], int] = {}
        for source in self._sources:
            for t in source.topics:
                key = (t.name, t.schema, t.schema_encoding, t.is_events)
                counts[key] = counts.get(key, 0) + t.n_messages
        self.topics = [
            Topic(name, schema, encoding, n, is_events)
            for (name, schema, encoding, is_events), n in counts.items()
        ]

    def read(self, topic: str, part: Part, losses: Losses) -> Iterator[tuple[int, SourceItem]]:
        """See `Source`; the byte of every item is 0."""
        for name, error in self._unreadable:
            losses.add("unreadable file", 0, error if name in error else f"{name}: {error}")
        seen = 0
        for item in self._merged(topic, losses):
            seen += isinstance(item, StoredMessage) and item.topic == topic
            yield 0, item
        missing = self._metadata.counts.get(topic, 0) - seen - sum(losses.counts.values())
        if missing > 0:
            where = f"topic {topic!r}: {missing} that {METADATA} counts are not in the files"
            losses.add("missing message", 0, where, missing)

    def _merged(self, topic: str, losses: Losses) -> Iterator[SourceItem]:
        """Items of all files; a file is begun when nothing of the others is earlier."""
        if topic not in self._starts:
            self._starts[topic] = [_first_time(source, topic) for source in self._sources]
        waiting = sorted(zip(self._starts[topic], range(len(self._sources)), strict=True))
        heap: list[tuple[float, int, SourceItem, Iterator[tuple[int, SourceItem]]]] = []
        while waiting or heap:
            while waiting and (not heap or waiting[0][0] <= heap[0][0]):
                start, i = waiting.pop(0)
                source = self._sources[i]
                _push(heap, start, i, source.read(topic, WHOLE, losses.of(source.path.name)))
            if heap:
                time, i, item, rest = heapq.heappop(heap)
                yield item
                _push(heap, time, i, rest)

    def cuts(self) -> list[int]:
        """See `Source`."""
        return []

    def close(self) -> None:
        """See `Source`."""
        self._closing.close()


def assumptions_of(source: Source) -> list[str]:
    """Assumptions that a source had to make; only some kinds do."""
    return list(getattr(source, "assumptions", ()))


def _push(
    heap: list[tuple[float, int, SourceItem, Iterator[tuple[int, SourceItem]]]],
    time: float,
    i: int,
    items: Iterator[tuple[int, SourceItem]],
) -> None:
    """Put the next item of a file where its time is; what has no time comes with what was before it."""
    following = next(items, None)
    if following:
        heapq.heappush(heap, (_time_of(following[1], time), i, following[1], items))


def _time_of(item: SourceItem, otherwise: float) -> float:
    return float(getattr(item, "log_time_ns", otherwise))


def _first_time(source: Source, topic: str) -> float:
    """Log time of the first item; infinite if there is none."""
    for _, item in source.read(topic, WHOLE, Losses()):
        return _time_of(item, -math.inf)
    return math.inf


def _files_in(folder: Location) -> list[Location]:
    if isinstance(folder, StoreLocation):
        return [place for place, name in files_below(folder) if "/" not in name]
    try:
        return [path for path in folder.iterdir() if path.is_file()]
    except OSError as error:
        raise InputError(f"{folder}: cannot be listed: {error.strerror}") from None


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
