"""The main job on a recording: files in, emissions out, a summary at the end.

Lives here: opening what a replay needs, running the pipeline until it ends or is interrupted, the result.
Not here: how it is computed (`session`, `pipeline`), how it looks (`sinks`, `cli`).
"""

import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console

from streamfeat.classify.classifier import Classifier
from streamfeat.classify.kernel import load_classifier
from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.files.locations import Location
from streamfeat.recordings.options import AS_IT_IS, ReadOptions
from streamfeat.recordings.reader import Label, Packet, Recording, open_recording
from streamfeat.recordings.records import Losses
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.session import Session
from streamfeat.stream.signals import run_until_interrupted, signals_wait
from streamfeat.stream.sinks import JsonLinesSink, RecordingSink, Sink, TerminalSink, open_sinks
from streamfeat.stream.table import TableSink

__all__ = ["ReplayJob", "items_of_split", "parse_speed", "warm_up"]


class ReplayJob:
    """One replay of one recording.

    Args:
        recording: MCAP file.
        model: of the encoder.
        classifier: to predict with; none for features alone, or to learn from nothing with `learn_online`.
        emit: when to read, see `EmitPolicy.parse`.
        speed: a number for a multiple of the recorded pace, or `max`.
        topic: event topic, where there are several.
        reading: how to read the recording.
        split: replay only samples of this split.
        learn_online: learn from each labelled sample after predicting it.
        engine: makes the engines, see `Session`.

    Raises:
        InputError: a file cannot be used, the parts do not fit each other, or an argument makes no sense.
    """

    def __init__(
        self,
        recording: Location,
        model: Path,
        classifier: Path | None = None,
        *,
        emit: str = "auto",
        speed: str = "max",
        topic: str | None = None,
        reading: ReadOptions = AS_IT_IS,
        split: str | None = None,
        learn_online: bool = False,
        engine: Callable[..., Engine] = Engine,
    ) -> None:
        """Open and check everything, so that nothing is written when something does not fit."""
        policy = EmitPolicy.parse(emit)
        self._speed = parse_speed(speed)
        self._split = split
        self._topic, self._reading = topic, reading
        self._recording = recording
        encoder = Encoder.load(model)
        reader = load_classifier(classifier) if classifier else None
        with open_recording(recording, topic, reading) as rec:
            self.assumptions = rec.assumptions
            encoder.geometry.grid_shape(rec.resolution)
            if learn_online and reader is None:
                reader = Classifier.untrained([label.label for label in rec.labels], encoder)
            if split is not None and split not in {label.split for label in rec.labels}:
                raise InputError(f"{recording}: has no samples of split {split!r}")
        if reader:
            reader.check_fits(encoder, path=classifier or "the classifier")
        self._shape_of_emissions = encoder.n_features, reader.labels if reader else ()
        self._session = Session(
            encoder,
            policy,
            reader,
            learn_online=learn_online,
            clock=time.perf_counter,
            engine=engine,
        )
        self._seconds = 0.0
        self.interrupted = False
        self._played: Recording | None = None

    def run(
        self,
        *,
        console: Console | None = None,
        every_sample: bool = False,
        recording_out: Path | None = None,
        json_lines: Path | TextIO | None = None,
        with_features: bool = False,
        table: Path | None = None,
        more: Sink[Emission] | None = None,
        loop: bool = False,
        report: Callable[[str, int, int, str], None] = lambda step, done, total, remark: None,
    ) -> None:
        """Replay to the end, or to the first SIGINT or SIGTERM, which loses nothing already read.

        Args:
            console: for live lines.
            every_sample: a line for each labelled sample, however fast they come.
            recording_out: MCAP file for features and predictions; replaced if it exists.
            json_lines: file (replaced) or open stream for a JSON line for each emission.
            with_features: include features in JSON lines.
            table: Arrow or Parquet file for emissions, see `TableSink`; replaced if it exists.
            more: one sink more.
            loop: start again at the end, with times that go on.
            report: called with (step, done, of how many, remark) as packets and labels are read, from a
                thread.
        """
        with open_recording(self._recording, self._topic, self._reading) as rec, signals_wait():
            self._played = rec
            sinks = open_sinks(
                partial(TerminalSink, console, every_sample=every_sample) if console else None,
                partial(JsonLinesSink, json_lines, features=with_features) if json_lines else None,
                partial(_recording_sink, recording_out) if recording_out else None,
                partial(TableSink, table, *self._shape_of_emissions) if table else None,
                (lambda: more) if more else None,
            )
            played = rec.played(loop=loop, report=lambda n, total: report("replaying", n, total, ""))
            items = items_of_split(played, self._split)
            pipeline: Pipeline[Packet | Label, Emission] = Pipeline(
                items, self._session, sinks, speed=self._speed
            )
            started = time.perf_counter()
            self.interrupted = run_until_interrupted([pipeline])
            self._seconds = time.perf_counter() - started

    @property
    def losses(self) -> Losses:
        """What could not be read, so far."""
        return self._played.losses if self._played else Losses()

    def drops(self) -> dict[str, int]:
        """What did not come to bear so far, by reason; may be called from another thread."""
        stats = self._session.stats()
        return {
            "dropped": 0,
            "late": stats.late,
            "rejected": stats.rejected,
            "lost": sum(list(self.losses.counts.values())),
        }

    def result(self) -> dict[str, Any]:
        """What happened, as JSON values."""
        stats = self._session.stats()
        result: dict[str, Any] = {
            "events": stats.events,
            "seconds": round(self._seconds, 3),
            "events_per_s": round(stats.events / max(self._seconds, 1e-9)),
            "emissions": stats.emissions,
            "samples": stats.samples,
        }
        if stats.correct is not None and stats.samples:
            result["correct"] = stats.correct
            result["accuracy"] = round(stats.correct / stats.samples, 4)
        if stats.unknown_labels:
            result["unknown_labels"] = stats.unknown_labels
        removed = dict(self.losses.removed)
        return (
            result | self.drops() | removed | {"saturated": stats.saturated, "interrupted": self.interrupted}
        )


def items_of_split(items: Iterable[Packet | Label], split: str | None) -> Iterator[Packet | Label]:
    """Only the labels of one split, and the packets that follow them; all items if `split` is None."""
    wanted = split is None
    for item in items:
        if split is not None and isinstance(item, Label):
            wanted = item.split == split
        if wanted:
            yield item


def warm_up(encoder: Encoder, policy: EmitPolicy) -> None:
    """Compile what the first packets would otherwise have to wait for."""
    session = Session(encoder, policy)
    side = encoder.geometry.patch * encoder.geometry.downsample
    for _ in session.process(Packet("", make_events([0], [0], [1], [0]), (side, side), 0, 0)):
        pass
    for _ in session.finish():
        pass


def _recording_sink(path: Path) -> RecordingSink:
    return RecordingSink(RecordingWriter(path, overwrite=True))


def parse_speed(text: str) -> float | None:
    """Read a multiple of the recorded pace, or `max`, which is None.

    Raises:
        InputError: the text is neither.
    """
    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0 < speed < 1e9:
        raise InputError(f"--speed {text!r} is not understood; give a number above zero, or max")
    return speed
