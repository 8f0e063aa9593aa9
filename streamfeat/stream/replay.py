"""The main job on a recording: files in, emissions out, a summary at the end.

Lives here: `ReplayJob`, which opens what a replay needs and sums up what happened; `replay` for programs.
Not here: how it is computed (`session`, `pipeline`), how it looks (`sinks`, `cli`).
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from functools import partial
from typing import Any

from streamfeat.classify.classifier import Classifier
from streamfeat.engine.engine import Engine
from streamfeat.engine.threads import usable_threads
from streamfeat.errors import InputError
from streamfeat.recordings.opening import RecordingPath
from streamfeat.recordings.options import AS_IT_IS, ReadOptions
from streamfeat.recordings.reader import Label, Packet, Recording, open_recording
from streamfeat.recordings.records import Losses
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.emission_stream import EmissionStream
from streamfeat.stream.load import Load
from streamfeat.stream.models import ClassifierSource, ModelSource, open_models
from streamfeat.stream.outputs import NO_OUTPUTS, Outputs
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.room import Room
from streamfeat.stream.session import Session
from streamfeat.stream.signals import run_until_interrupted, signals_wait
from streamfeat.stream.sinks import Sink
from streamfeat.stream.state import SessionStats
from streamfeat.stream.warming import warm_up

__all__ = ["ReplayJob", "items_of_split", "parse_speed", "replay"]

Report = Callable[[str, int, int, str], None]


class ReplayJob:
    """One replay of one recording.

    Args:
        recording: path or URL; or an open recording, which is not closed here.
        model: path of the encoder, or the encoder; None for the general one that ships.
        classifier: path of one to predict with, or the classifier; without it there are features alone, and
            `learn_online` starts from nothing.
        emit: when to emit, see `EmitPolicy.parse`.
        speed: stream seconds for each second of the clock; None for as fast as possible.
        topic: event topic, where there are several.
        reading: how to read the recording.
        split: replay only samples of this split.
        loop: start again at the end, with times that go on.
        learn_online: learn from each labelled sample after predicting it.
        engine: makes the engines, see `Session`.
        threads: that share a large emission, see `usable_threads`.

    Attributes:
        advice: a line where the work on the first second took longer than the second.
        assumptions: what the recording leaves open, and how that was decided.
        interrupted: whether a signal ended it.

    Raises:
        InputError: a file cannot be used, the parts do not fit each other, or an argument makes no sense.
    """

    def __init__(
        self,
        recording: RecordingPath | Recording,
        model: ModelSource | None = None,
        classifier: ClassifierSource | None = None,
        *,
        emit: str | EmitPolicy = "bin",
        speed: float | None = None,
        topic: str | None = None,
        reading: ReadOptions = AS_IT_IS,
        split: str | None = None,
        loop: bool = False,
        learn_online: bool = False,
        engine: Callable[..., Engine] = Engine,
        threads: int | None = None,
    ) -> None:
        """Open and check everything, so that nothing is written when something does not fit."""
        self._policy = emit if isinstance(emit, EmitPolicy) else EmitPolicy.parse(emit)
        self._speed = checked_speed(speed)
        self._split, self._loop = split, loop
        self._opening: Callable[[], AbstractContextManager[Recording]]
        if isinstance(recording, Recording):
            self._opening = lambda: nullcontext(recording)  # it stays open, for it was opened elsewhere
        else:
            self._opening = partial(open_recording, recording, topic, reading)
        self._encoder, reader = open_models(model, classifier)
        with self._opening() as rec:
            self.assumptions = rec.assumptions
            self._encoder.geometry.grid_shape(rec.resolution)
            if learn_online and reader is None:
                reader = Classifier.untrained([label.label for label in rec.labels], self._encoder)
            if split is not None and split not in {label.split for label in rec.labels}:
                raise InputError(f"{rec.path}: has no samples of split {split!r}")
        self._labels = reader.labels if reader else ()
        self.advice: list[str] = []
        self._session = Session(
            self._encoder,
            self._policy,
            reader,
            learn_online=learn_online,
            clock=time.perf_counter,
            engine=Room().maker("", engine),
            load=Load(self._encoder.geometry, self.advice.append),
            threads=usable_threads(threads),
        )
        self._seconds = self._compile_seconds = 0.0
        self.interrupted = False
        self._played: Recording | None = None
        self._pipeline: Pipeline[Packet | Label, Emission] | None = None
        self._report: Report = lambda step, done, total, remark: None

    @contextmanager
    def opened(
        self, sinks: Callable[[], Sequence[Sink[Emission]]]
    ) -> Iterator[Pipeline[Packet | Label, Emission]]:
        """The pipeline of this replay into some sinks, with the recording open as long as the block runs."""
        started = time.perf_counter()
        self._report("compiling", 0, 1, "kernels, kept for the next time")
        warm_up(self._encoder, self._policy, self._session.classifier)  # or the first emissions would be late
        self._report("compiling", 1, 1, "")
        self._compile_seconds = time.perf_counter() - started
        with self._opening() as rec:
            self._played = rec
            played = rec.played(
                loop=self._loop, report=lambda n, total: self._report("replaying", n, total, "")
            )
            items = items_of_split(played, self._split)
            self._pipeline = Pipeline(items, self._session, sinks(), speed=self._speed)
            yield self._pipeline

    def run(
        self,
        outputs: Outputs = NO_OUTPUTS,
        report: Report = lambda step, done, total, remark: None,
    ) -> None:
        """Replay to the end, or to the first SIGINT or SIGTERM, which loses nothing already read.

        Args:
            outputs: where emissions go.
            report: called with (step, done, of how many, remark) as packets and labels are read, from a
                thread.

        Raises:
            InputError: an output cannot be written, or the recording not be read.
        """
        self._report = report
        self._session.keep_features = outputs.reads_features(has_classifier=bool(self._labels))
        with ExitStack() as held:

            def sinks() -> Sequence[Sink[Emission]]:
                held.enter_context(signals_wait())
                n_filters = 0 if self._encoder.further else self._encoder.n_filters
                return outputs.open(self._encoder.n_features, self._labels, n_filters=n_filters)

            with self.opened(sinks) as pipeline:
                started = time.perf_counter()
                self.interrupted = run_until_interrupted([pipeline])
                self._seconds = time.perf_counter() - started

    def stop(self) -> None:
        """Read no more; what has been read is still processed. Call from the loop's thread."""
        if self._pipeline:
            self._pipeline.stop()

    def session_stats(self) -> SessionStats:
        """What has been done so far; may be called from another thread."""
        return self._session.stats()

    @property
    def losses(self) -> Losses:
        """What could not be read, so far."""
        return self._played.losses if self._played else Losses()

    def drops(self) -> dict[str, int]:
        """What was not used so far, by reason; may be called from another thread."""
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
            "compile_seconds": round(self._compile_seconds, 3),
            "emissions": stats.emissions,
            "emit": str(self._policy),
            "samples": stats.samples,
        }
        if stats.correct is not None and stats.samples:
            result["correct"] = stats.correct
            result["accuracy"] = round(stats.correct / stats.samples, 4)
        result["unknown_labels"] = stats.unknown_labels
        return (
            result
            | self.drops()
            | {
                "removed": dict(self.losses.removed),
                "saturated": stats.saturated,
                "interrupted": self.interrupted,
            }
        )


def items_of_split(items: Iterable[Packet | Label], split: str | None) -> Iterator[Packet | Label]:
    """Only the labels of one split, and the packets that follow them; all items if `split` is None."""
    wanted = split is None
    for item in items:
        if split is not None and isinstance(item, Label):
            wanted = item.split == split
        if wanted:
            yield item


def parse_speed(text: str) -> float | None:
    """Read a multiple of the recorded pace, or `max`, which is None.

    Raises:
        InputError: the text is neither.
    """
    if text == "max":
        return None
    try:
        return checked_speed(float(text))
    except ValueError:  # an InputError is one, too
        raise InputError(f"--speed {text!r} is not understood; give a number above zero, or max") from None


def checked_speed(speed: float | None) -> float | None:
    """The same speed.

    Raises:
        InputError: the speed is neither None nor a number above zero.
    """
    if speed is not None and not 0 < speed < 1e9:
        raise InputError(f"a speed of {speed} is not possible; give a number above zero, or None")
    return speed


def replay(
    recording: RecordingPath | Recording,
    model: ModelSource | None = None,
    classifier: ClassifierSource | None = None,
    *,
    emit: str | EmitPolicy = "bin",
    speed: float | None = None,
    topic: str | None = None,
    split: str | None = None,
    loop: bool = False,
    learn_online: bool = False,
    threads: int | None = None,
) -> EmissionStream:
    """Replay a recording as an asynchronous iterator of emissions, those that `streamfeat replay` makes.

    Example:
        >>> async def main():
        ...     async for emission in sf.replay("digits.mcap", "model", "classifier", speed=None):
        ...         if emission.final:
        ...             print(emission.prediction, emission.sample.label)
        >>> asyncio.run(main())  # in Jupyter: await main()

    Args:
        recording: path or URL; or an open recording, which stays open and is read in a thread meanwhile.
        model: path of the encoder, or the encoder; None for the general one that ships.
        classifier: path of a classifier, or the classifier; features alone without it.
        emit: `event`, `1000ev`, `10ms` (stream time), `bin` (of the model) or `auto`; or a policy.
        speed: stream seconds for each second of the clock; None for as fast as the program takes them.
        topic: event topic, where there are several.
        split: replay only samples of this split.
        loop: start again at the end, with times that go on.
        learn_online: learn from each labelled sample after predicting it.
        threads: that share a large emission; all cores but one if not given.

    Returns:
        the stream; nothing is opened before it is used. Iterating raises InputError where a file cannot be
        used or the parts do not fit each other.

    Raises:
        InputError: `emit`, `speed` or `threads` makes no sense.
    """
    policy = emit if isinstance(emit, EmitPolicy) else EmitPolicy.parse(emit)
    options: dict[str, Any] = {"topic": topic, "split": split, "loop": loop, "learn_online": learn_online}
    options |= {"emit": policy, "speed": checked_speed(speed), "threads": usable_threads(threads)}
    return EmissionStream(lambda: ReplayJob(recording, model, classifier, **options))
