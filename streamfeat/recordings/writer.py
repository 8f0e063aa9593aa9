"""Writing recordings: events, labels, features and predictions into an MCAP file.

Lives here: `RecordingWriter`; cutting batches into packets, and never leaving half a file in place; and
`recover`, which copies what can be read of a damaged file.
Not here: reading (`streamfeat.recordings.reader`), what bytes a message has (`streamfeat.messages.cdr`).
"""

from collections import Counter
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import numpy as np
from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer
from numpy.typing import ArrayLike

from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution, as_events
from streamfeat.files.atomic import is_replaced, refuse_input, unwritable
from streamfeat.files.locations import StoreLocation, location_of
from streamfeat.files.outputs import OutputFile
from streamfeat.messages.cdr import EventArray, EventPacket, FeaturesMessage, LabelMessage, PredictionMessage
from streamfeat.messages.packets import Label, PacketWriter
from streamfeat.messages.strays import BACK_US
from streamfeat.recordings.records import Losses, count_missing, iter_messages, open_mcap, read_summary

__all__ = ["RecordingWriter", "recover"]

_COMPRESSION = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}

_MAX_CHANNELS = (1 << 16) - 1  # of a file, as the mcap package numbers them

_Message = EventPacket | LabelMessage | FeaturesMessage | PredictionMessage


def recover(
    source: str | PathLike[str] | StoreLocation,
    target: str | PathLike[str],
    *,
    overwrite: bool = False,
    report: Callable[[str, int, int, str], None] = lambda step, done, total, remark: None,
) -> Losses:
    """Copy every message of any topic that can be read into a new, intact recording.

    Args:
        source: the damaged or unfinished file, not changed.
        target: the file to write.
        overwrite: whether an existing file at `target` may be replaced.
        report: called with (step, messages, of how many, remark) after each message; of how many is 0 where
            the source does not say.

    Returns:
        What could not be read.

    Raises:
        InputError: `source` is no MCAP file at all, or damaged and without a single whole message; or
            `target` exists or cannot be written. `target` is then as it was before.
    """
    losses, copied = Losses(), Counter[int]()
    refuse_input(Path(target), [source])
    # The source may well be `<target>.part`, so the copy needs a temporary name of its own.
    writer = RecordingWriter(target, overwrite=overwrite, part_suffix=".recovered")
    with writer, open_mcap(location_of(source)) as file:
        summary = read_summary(file)
        total = sum(summary.message_counts.values()) if summary else 0
        for done, (_, channel, schema, message) in enumerate(iter_messages(file, summary, losses), 1):
            writer._copy(channel, schema, message)
            copied[channel.id] += 1
            report("recovering", done, total, "")
        if losses and not copied:
            reason = next(iter(losses.first.values()))
            raise InputError(f"{source}: no whole message could be recovered; {reason}")
    for channel_id in summary.message_counts if summary else ():
        count_missing(summary, channel_id, copied[channel_id], losses)
    return losses


class RecordingWriter:
    """Write one recording; a context manager.

    Everything goes to `<path>.part` first (see `OutputFile`), so that `path` is a whole recording or not
    there. Leaving the block renames it to `path`; leaving it with an exception removes it, or leaves it for
    `streamfeat recover` when `keep_partial` is set. An existing file at `path` is untouched until then.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        encoding: str = "mono",
        compression: Literal["zstd", "lz4", "none"] = "zstd",
        event_topic: str = "/events",
        frame_id: str = "",
        overwrite: bool = False,
        keep_partial: bool = False,
        private: bool = False,
        part_suffix: str = ".part",
        chunk_size: int = 1 << 20,
    ) -> None:
        """Open the temporary file.

        Args:
            path: the file to write.
            encoding: of event payloads, one of `streamfeat.messages.codecs.PAYLOAD_ENCODINGS`.
            compression: of chunks.
            event_topic: topic of the events; labels, features and predictions go to `/label`, `/features`
                and `/prediction`.
            frame_id: frame in the header of every message.
            overwrite: whether an existing file at `path` may be replaced.
            keep_partial: whether an exception leaves what was written so far.
            private: readable by this user alone, as what cameras see live should be.
            part_suffix: what the name of the temporary file has after `path`.
            chunk_size: bytes before compression that one damaged spot in the file can cost.

        Raises:
            InputError: the encoding or compression is unknown, or the file exists or cannot be written.
        """
        if compression not in _COMPRESSION:
            raise InputError(f"unknown compression {compression!r}; known are {', '.join(_COMPRESSION)}")
        self.path = Path(path)
        self._overwrite, self._keep_partial = overwrite, keep_partial
        self._event_topic, self._frame_id = event_topic, frame_id
        self._packets = PacketWriter(encoding, frame_id)
        self._channels: dict[str | int, int] = {}
        self._schemas: dict[int, int] = {}
        self._reached_us: int | None = None
        self._ahead_us = 0
        self._check_target()
        self._output = OutputFile(
            self.path, suffix=part_suffix, keep_leftover=True, private=private, outlives=keep_partial
        )
        self._writer = Writer(self._output.file, chunk_size=chunk_size, compression=_COMPRESSION[compression])
        self._writer.start(profile="ros2", library="streamfeat")

    def __enter__(self) -> Self:
        """Give the writer itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish the file and move it into place, or drop it after an exception."""
        if kind is None:
            self.close()
        else:
            self._abandon()

    def close(self) -> None:
        """Finish the file and move it into place; a second call does nothing.

        Raises:
            InputError: meanwhile a file appeared at `path` and `overwrite` is not set.
        """
        if self._output.file.closed:
            return
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._check_target()
            self._output.close()
        except OSError as error:
            self._abandon()
            raise unwritable(self.path, error) from None
        except BaseException:
            self._abandon()
            raise

    def flush(self) -> None:
        """Hand everything written so far to the operating system, so that a crash cannot take it.

        Raises:
            InputError: there is no room for it.
        """
        try:
            self._writer.flush()  # type: ignore[no-untyped-call]
        except OSError as error:
            raise unwritable(self.path, error) from None

    def write_events(self, events: Events, resolution: Resolution) -> None:
        """Write a batch as one or more packets, each at the time of its first event.

        Where a batch begins half a second or more before what was written, the camera's clock has started
        anew: log time goes on, so that what is read back is in this order and the restart is seen.

        Args:
            events: `(n,)` array of `EVENT_DTYPE`, not changed, or a structured array of another tool (see
                `as_events`); n may be 0, which writes nothing.
            resolution: `(height, width)` of the sensor.

        Raises:
            InputError: the encoding cannot represent the events (see `codecs.encode`), or a
                time is negative or 2^31 s or more.
        """
        events = as_events(events)
        if len(events):
            first_us, last_us = int(events["t"].min()), int(events["t"].max())
            if self._is_anew(first_us):
                self._ahead_us = (self._reached_us or 0) - first_us
            self._reached_us = max(self._reached_us or 0, last_us + self._ahead_us)
        for packet in self._packets.messages(events, resolution):
            self._write(self._event_topic, packet, packet.stamp_ns + self._ahead_us * 1000)

    def _is_anew(self, first_us: int) -> bool:
        return self._reached_us is not None and first_us + self._ahead_us < self._reached_us - BACK_US

    def write_label(self, label: Label, topic: str = "/label") -> None:
        """Write a label; do so before the events it speaks of.

        Raises:
            InputError: start or duration is out of range.
        """
        message = LabelMessage(
            label.start_us * 1000,
            self._frame_id,
            label.duration_us * 1000,
            label.label,
            label.split,
            label.source,
        )
        anew = self._is_anew(label.start_us)  # right before the first packet of a clock it belongs to that
        log_us = (self._reached_us or 0) if anew else label.start_us + self._ahead_us
        self._write(topic, message, log_us * 1000)

    def write_features(
        self, t_us: int, n_events: int, data: ArrayLike, *, incomplete: bool = False, topic: str = "/features"
    ) -> None:
        """Write the features at a stream time.

        Args:
            t_us: stream time, microseconds.
            n_events: events that went into them.
            data: `(n,)`, stored as float32, not changed.
            incomplete: packets are known to be missing from the window.
            topic: to write to.

        Raises:
            InputError: the time is out of range.
        """
        values = np.asarray(data, np.float32)
        self._write(topic, FeaturesMessage(t_us * 1000, self._frame_id, n_events, values, incomplete))

    def write_prediction(
        self, t_us: int, label: str, labels: Sequence[str], scores: ArrayLike, *, topic: str = "/prediction"
    ) -> None:
        """Write a prediction at a stream time.

        Args:
            t_us: stream time, microseconds.
            label: the winner.
            labels: all labels.
            scores: `(len(labels),)`, stored as float32, not changed.
            topic: to write to.

        Raises:
            InputError: the time is out of range.
        """
        values = np.asarray(scores, np.float32)
        self._write(topic, PredictionMessage(t_us * 1000, self._frame_id, label, labels, values))

    def write_message(
        self, topic: str, kind: type[_Message | EventArray], data: bytes, log_time_ns: int, sequence: int
    ) -> None:
        """Write a message as it came.

        Args:
            topic: to write to.
            kind: its type; that the bytes are of it is not checked.
            data: the CDR bytes.
            log_time_ns: when it came, since 1970.
            sequence: its number, 32 bits.
        """
        self._add(self._channel(topic, kind), log_time_ns, data, log_time_ns, sequence)

    def _write(self, topic: str, message: _Message, log_time_ns: int | None = None) -> None:
        data = message.to_cdr()
        log_time_ns = message.stamp_ns if log_time_ns is None else log_time_ns
        self._add(self._channel(topic, type(message)), log_time_ns, data, message.stamp_ns, 0)

    def _channel(self, topic: str, kind: type[_Message | EventArray]) -> int:
        which = f"{topic} {kind.SCHEMA_NAME}"
        if which not in self._channels:
            if len(self._channels) == _MAX_CHANNELS:
                raise InputError(f"{self.path}: a recording has at most {_MAX_CHANNELS} channels")
            schema = self._writer.register_schema(kind.SCHEMA_NAME, "ros2msg", kind.SCHEMA.encode())
            self._channels[which] = self._writer.register_channel(topic, "cdr", schema)
        return self._channels[which]

    def _copy(self, channel: Channel, schema: Schema, message: Message) -> None:
        """Write a message of another recording as it is; do not mix with the public ways to write."""
        if channel.id not in self._channels:
            if len(self._channels) == _MAX_CHANNELS:
                raise InputError(f"{self.path}: a recording has at most {_MAX_CHANNELS} channels")
            if channel.schema_id and channel.schema_id not in self._schemas:
                self._schemas[channel.schema_id] = self._writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            self._channels[channel.id] = self._writer.register_channel(
                channel.topic,
                channel.message_encoding,
                self._schemas.get(channel.schema_id, 0),
                channel.metadata,
            )
        times = message.log_time, bytes(message.data), message.publish_time
        self._add(self._channels[channel.id], *times, message.sequence)

    def _add(self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int) -> None:
        try:
            self._writer.add_message(channel_id, log_time, data, publish_time, sequence)
        except OSError as error:
            raise unwritable(self.path, error) from None

    def _check_target(self) -> None:
        if not self._overwrite and is_replaced(self.path) and self.path.exists():
            raise InputError(f"{self.path}: exists already; choose another name or allow to overwrite it")

    def _abandon(self) -> None:
        self._output.abandon(keep=self._keep_partial)
