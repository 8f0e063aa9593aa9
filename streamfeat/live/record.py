"""Live topics to a recording that survives a crash.

Lives here: which messages are recorded, and how often chunks are closed.
Not here: writing (`recordings.writer`), the network (`network`, `subscription`).

Messages are written as they came. Every `chunk_s` seconds what was written is closed as a chunk and handed to
the operating system, so a process that is killed at any byte loses only messages that came after that.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from streamfeat.errors import InputError
from streamfeat.live.inbox import Announcement, Inbox, RawMessage
from streamfeat.live.names import Attachment, Names
from streamfeat.live.network import THIS_MACHINE, Network
from streamfeat.live.subscription import Subscription
from streamfeat.live.topic import MAX_TOPICS
from streamfeat.live.warnings import Warnings
from streamfeat.messages.cdr import EventArray, EventPacket, LabelMessage
from streamfeat.messages.delivery import DeliveryStats
from streamfeat.messages.timeline import Timeline
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.signals import run_until_interrupted, signals_wait
from streamfeat.stream.sinks import open_sinks

__all__ = ["RecordJob"]

_POLL_S = 0.05
_MAX_WRITTEN = 4096
"""Topics of one file, whose format has room for 65,535."""
_MESSAGES = {kind.SCHEMA_NAME: kind for kind in (EventPacket, EventArray, LabelMessage)}


@dataclass(frozen=True, slots=True)
class _Flush:
    """Close a chunk here and hand it to the operating system."""


class RecordJob:
    """Records topics until `stop` or a signal.

    Args:
        names: of the topics; labels beside them are recorded too.
        target: MCAP file; until the end it is `<target>.part`.
        compression: of chunks.
        chunk_s: seconds that a crash can cost.
        overwrite: whether an existing file may be replaced.
        network: where to listen; `reliable` recovers missed packets, from publishers that do the same.
        console: for warnings.

    Raises:
        InputError: an argument makes no sense.
    """

    def __init__(
        self,
        names: Names,
        target: Path,
        *,
        compression: Literal["zstd", "lz4", "none"] = "lz4",
        chunk_s: float = 0.5,
        overwrite: bool = False,
        network: Network = THIS_MACHINE,
        console: Console | None = None,
    ) -> None:
        """Check the arguments."""
        if not 0.01 <= chunk_s <= 3600:
            raise InputError(f"a chunk of {chunk_s} s is not possible; give 0.01 to 3600")
        self._names, self._target = names, target
        self._compression, self._chunk_s, self._overwrite = compression, chunk_s, overwrite
        self._network = network
        self._inbox = Inbox()
        self._warnings = Warnings.on(console)
        self._topics: dict[str, Timeline] = {}
        self._past = DeliveryStats()
        self._written: Counter[str] = Counter()
        self._bytes = 0
        self._seconds = 0.0
        self.interrupted = False

    def run(
        self, report: Callable[[str, int, int, str], None] = lambda step, done, total, remark: None
    ) -> None:
        """Record until `stop`, SIGINT or SIGTERM; what has arrived by then is written.

        Args:
            report: called with (step, messages, 0, remark) from a thread, whenever there was something.

        Raises:
            InputError: the file cannot be written, or the network not be used.
        """
        with self._network.open() as session, signals_wait():
            (sink,) = open_sinks(
                lambda: _MessageSink(
                    RecordingWriter(
                        self._target,
                        compression=self._compression,
                        overwrite=self._overwrite,
                        keep_partial=True,
                        private=True,
                    )
                )
            )
            pipeline: Pipeline[RawMessage | _Flush, RawMessage | _Flush] = Pipeline(
                self._items(report), _Unchanged(), [sink]
            )
            started = time.monotonic()
            with Subscription(session, self._names, self._inbox, reliable=self._network.reliable):
                self.interrupted = run_until_interrupted([pipeline], self.stop)
            self._seconds = time.monotonic() - started

    def stop(self) -> None:
        """Take in no more; may be called from any thread."""
        self._inbox.close()

    def result(self) -> dict[str, Any]:
        """What happened, as JSON values."""
        delivery = sum((topic.delivery.stats for topic in self._topics.values()), self._past)
        return {
            "written": str(self._target),
            "topics": sorted(self._written),
            "messages": self._written.total(),
            "bytes": self._bytes,
            "seconds": round(self._seconds, 3),
            "lost": delivery.lost,
            "unheard": delivery.unheard,
            "dropped": self._inbox.dropped,
            "duplicates": delivery.duplicates,
            "restarts": delivery.restarts,
            "warnings": dict(sorted(self._warnings.counts.items())),
            "interrupted": self.interrupted,
        }

    def _items(self, report: Callable[[str, int, int, str], None]) -> Iterator[RawMessage | _Flush | None]:
        due = time.monotonic() + self._chunk_s
        while (taken := self._inbox.take(min(_POLL_S, self._chunk_s))) is not None:
            for message in taken:
                if isinstance(message, Announcement):
                    if message.topic in self._topics:
                        self._topics[message.topic].delivery.announced(here=message.here)
                elif self._is_wanted(message):
                    self._written[message.topic] += 1
                    self._bytes += len(message.payload)
                    yield message
            if time.monotonic() >= due:
                due = time.monotonic() + self._chunk_s
                yield _Flush()
            if not self._inbox.depth:
                report("recording", self._written.total(), 0, f"{self._bytes:,} bytes")
                yield None

    def _is_wanted(self, message: RawMessage) -> bool:
        """Whether a message is of a known type and new; warns of those that are missing before it."""
        kind = _MESSAGES.get(message.schema)
        if message.problem or kind is None:
            self._warnings.add(message.problem or "unknown type", message.topic, message.schema[:80])
            return False
        try:
            content = kind.from_cdr(message.payload)
        except InputError as error:
            self._warnings.add("bad message", message.topic, str(error))
            return False
        if message.topic not in self._written and len(self._written) >= _MAX_WRITTEN:
            self._warnings.add("too many topics", message.topic, f"{_MAX_WRITTEN} are in this file already")
            return False
        if isinstance(content, LabelMessage):
            return True
        if message.topic not in self._topics and len(self._topics) >= MAX_TOPICS:
            # The one that was heard first: if it goes on, its numbers are followed anew.
            self._past += self._topics.pop(next(iter(self._topics))).delivery.stats
        timeline = self._topics.setdefault(message.topic, Timeline(message.topic))
        attachment = Attachment.unpack(message.attachment)
        number = (attachment.gid, attachment.seq) if attachment else None
        seen = timeline.see(content, message.arrived_ns, number=number, dropped=message.dropped)
        if seen.lost:
            self._warnings.add("packets missing", message.topic, f"{seen.lost} before this one")
        return seen.use


class _Unchanged:
    """The processor that does nothing."""

    def batches(self, item: RawMessage | _Flush) -> Iterator[list[RawMessage | _Flush]]:
        yield [item]

    def last_batches(self) -> Iterator[list[RawMessage | _Flush]]:
        yield from ()

    def rest(self) -> None:
        pass


class _MessageSink:
    """Writes messages as they came."""

    def __init__(self, writer: RecordingWriter) -> None:
        self._writer = writer

    def write(self, messages: Sequence[RawMessage | _Flush]) -> None:
        for message in messages:
            if isinstance(message, _Flush):
                self._writer.flush()
                continue
            attachment = Attachment.unpack(message.attachment)
            topic = "/" + message.topic.lstrip("/")
            kind = _MESSAGES[message.schema]
            seq = attachment.seq if attachment else 0
            self._writer.write_message(topic, kind, message.payload, message.log_time_ns, seq & 0xFFFFFFFF)

    def close(self, *, failed: bool) -> None:
        error = InputError("abandoned") if failed else None
        self._writer.__exit__(type(error) if error else None, error, None)
