"""Where emissions go: the terminal, JSON lines, MCAP.

Lives here: `Sink` and its three kinds; each is written to by one task, off the event loop's thread.
Not here: queues and tasks (`pipeline`), and what an emission holds (`emission`).
"""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Protocol, TextIO, TypeVar

import numpy as np
from rich.console import Console
from rich.text import Text

from streamfeat.errors import InputError
from streamfeat.files.atomic import unwritable
from streamfeat.files.outputs import OutputFile
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.stream.batch import EmissionBatch, batches_of
from streamfeat.stream.emission import Emission

__all__ = ["JsonLinesSink", "RecordingSink", "Sink", "TerminalSink", "emission_records", "open_sinks"]

_LINES_A_SECOND = 4.0
_FILTERS_SHOWN = 3
_ABSOLUTE_US = 86_400_000_000
"""Stream times beyond a day are no time since a camera began."""

T = TypeVar("T", contravariant=True)


class Sink(Protocol[T]):
    """Takes emissions, or whatever else a pipeline makes, in order. May block; is called from one thread at a
    time.
    """

    def write(self, emissions: Sequence[T], /) -> None:
        """Take some, at least one."""

    def close(self, *, failed: bool) -> None:
        """End: finish what was written, or (`failed`) leave nothing half done behind."""


S = TypeVar("S", bound=Sink[Any])


def open_sinks(*makers: Callable[[], S] | None) -> list[S]:
    """Make the sinks that are wanted: all of them or, when one cannot be made, none is left open.

    Args:
        makers: called without arguments; None stands for a sink that is not wanted.
    """
    with ExitStack() as opening:
        sinks: list[S] = []
        for make in makers:
            if make:
                sinks.append(make())
                opening.callback(sinks[-1].close, failed=True)
        opening.pop_all()
    return sinks


def emission_records(batch: EmissionBatch, *, features: bool = False) -> Iterator[dict[str, Any]]:
    """Emissions as JSON values."""
    sample, names = batch.sample, batch.predictions
    scores, missing = batch.scores.tolist(), batch.incomplete.tolist()
    for i, (t_us, n_events) in enumerate(zip(batch.t_us.tolist(), batch.n_events.tolist(), strict=True)):
        record: dict[str, Any] = {"t_us": t_us, "n_events": n_events}
        if batch.topic:
            record["topic"] = batch.topic
        if missing[i]:
            record["incomplete"] = True
        if batch.labels:
            record["prediction"] = names[i]
            record["scores"] = {
                label: round(score, 6) for label, score in zip(batch.labels, scores[i], strict=True)
            }
        if sample:
            record["sample"] = {
                "label": sample.label,
                "elapsed_us": t_us - sample.start_us,
                "source": sample.source,
                "final": batch.final,
            }
        if features:
            record["features"] = batch.features[i].tolist()
        yield record


class JsonLinesSink:
    """One JSON object a line; to a file (see `OutputFile`) or an open stream."""

    def __init__(self, target: Path | TextIO, *, features: bool = False) -> None:
        """Open the target.

        Raises:
            InputError: the file cannot be written, see `OutputFile`.
        """
        self._features = features
        self._output = OutputFile(target) if isinstance(target, Path) else None
        self._stream = None if isinstance(target, Path) else target

    def write(self, emissions: Sequence[Emission]) -> None:
        """Write a line for each emission.

        Raises:
            InputError: the disk is full, or the target cannot be written for another reason.
        """
        records = (
            record
            for batch in batches_of(emissions)
            for record in emission_records(batch, features=self._features)
        )
        lines = (json.dumps(record) + "\n" for record in records)
        with self._explaining():
            if self._stream:
                self._stream.writelines(lines)
                self._stream.flush()
            elif self._output:
                self._output.file.writelines(line.encode() for line in lines)
                if self._output.part is None:
                    self._output.file.flush()

    def close(self, *, failed: bool) -> None:
        """Put the file in its place, or remove it.

        Raises:
            InputError: as for `write`; the file is removed then.
        """
        if self._output is None:
            return  # each write was flushed
        if failed:
            self._output.abandon()
            return
        with self._explaining():
            self._output.close()

    @contextmanager
    def _explaining(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            raise  # the reader has enough, as `head` has, and nothing is wrong
        except OSError as error:
            raise unwritable(self._output.path if self._output else Path("standard output"), error) from None


class RecordingSink:
    """Features, predictions and labels as MCAP messages.

    Args:
        writer: closed with the sink.
        topic_of: the topic for `label`, `features` or `prediction` of the camera with a given topic.
    """

    def __init__(
        self, writer: RecordingWriter, topic_of: Callable[[str, str], str] = lambda topic, kind: f"/{kind}"
    ) -> None:
        """Write nothing yet."""
        self._writer = writer.__enter__()
        self._topic_of = topic_of

    def write(self, emissions: Sequence[Emission]) -> None:
        """Write a features message for each emission, and a prediction where there is one."""
        for e in emissions:
            if e.final and e.sample:
                self._writer.write_label(e.sample, self._topic_of(e.topic, "label"))
            topic = self._topic_of(e.topic, "features")
            self._writer.write_features(e.t_us, e.n_events, e.features, incomplete=e.incomplete, topic=topic)
            if e.prediction is not None:
                topic = self._topic_of(e.topic, "prediction")
                self._writer.write_prediction(e.t_us, e.prediction, e.labels, e.scores, topic=topic)

    def close(self, *, failed: bool) -> None:
        """Finish the file, or leave none."""
        error = InputError("abandoned") if failed else None
        self._writer.__exit__(type(error) if error else None, error, None)


class TerminalSink:
    """A line for each labelled sample, or of what happens between them; four a second, never a flood.

    Without labels a line says how fast events come, how many local volumes have some, and, without a
    classifier, which filters moved most since the line before. Times of a camera that counts from 1970 are
    counted from the first emission.

    Args:
        console: where to print; what is too narrow for all gets the beginning.
        clock: seconds, monotonic.
        every_sample: show each labelled sample, however fast they come.
        n_filters: of the encoder; 0 to say nothing of filters.
    """

    def __init__(
        self,
        console: Console,
        clock: Callable[[], float] = time.monotonic,
        *,
        every_sample: bool = False,
        n_filters: int = 0,
    ) -> None:
        """Start with nothing seen."""
        self._console = console
        self._n_filters = n_filters
        self._zero_us: int | None = None
        self._before: dict[str, Emission] = {}
        self._every_sample = every_sample
        self._clock = clock
        self._next = 0.0
        self._samples = 0
        self._correct = 0
        self._skipped = 0

    def write(self, emissions: Sequence[Emission]) -> None:
        """Count every emission, and show one where it is time to."""
        if self._zero_us is None:
            first_us = emissions[0].t_us
            self._zero_us = first_us if first_us > _ABSOLUTE_US else 0
        finals = [e for e in emissions if e.final]
        if self._every_sample:
            for e in finals:
                self._samples, self._correct = self._samples + 1, self._correct + bool(e.correct)
                self._console.print(self._line(e), highlight=False)
            finals, emissions = [], [e for e in emissions if not e.final]
            if not emissions:
                return
        self._samples += len(finals)
        self._correct += sum(bool(e.correct) for e in finals)
        self._skipped += len(finals)
        shown = finals[-1] if finals else None
        if shown is None:
            if any(e.sample for e in emissions):
                return
            shown = emissions[-1]
        if self._clock() < self._next:
            return
        self._skipped -= shown.final
        self._next = self._clock() + 1 / _LINES_A_SECOND
        self._console.print(self._line(shown), highlight=False)

    def close(self, *, failed: bool) -> None:
        """Say how many samples were not shown."""
        if self._skipped:
            samples = "1 sample" if self._skipped == 1 else f"{self._skipped:,} samples"
            self._console.print(f"[dim]... and {samples} more, too fast to show[/]")

    def _line(self, e: Emission) -> Text:
        line = Text(no_wrap=True, overflow="crop")
        line.append(f"{(e.t_us - (self._zero_us or 0)) / 1e6:8.2f} s  ", style="dim")
        if e.topic:
            line.append(f"{e.topic}  ", style="cyan")
        if e.prediction is not None:
            first, second = sorted(e.scores, reverse=True)[:2]
            line.append(f"{e.prediction:<{max(map(len, e.labels))}}", style="bold")
            line.append(f" {first - second:+6.2f}  ", style="dim")
        before = self._before.get(e.topic)
        self._before[e.topic] = e
        line.append(f"{_rate(before, e):>8}/s  ")
        if e.sample and e.final:
            if e.correct is None:
                line.append(f"is {e.sample.label}")
            elif e.correct:
                line.append("right", style="green")
            else:
                line.append(f"is {e.sample.label}", style="red")
            if e.labels:
                line.append(f"  {100 * self._correct / self._samples:.1f} % of {self._samples}", style="dim")
        elif e.active_volumes is not None:
            line.append(f"{e.active_volumes:>6,} active", style="dim")
        if e.incomplete:
            line.append("  incomplete", style="yellow")
        if e.prediction is None and self._n_filters:
            line.append("  filters ", style="dim")
            line.append(_moved(before, e, self._n_filters))
        return line


def _rate(before: Emission | None, e: Emission) -> str:
    """Events a second of stream time since the emission before, in four letters or less."""
    passed_us = e.t_us - before.t_us if before else 0
    if before is None or passed_us <= 0:
        return "-"
    rate = 1e6 * (e.n_events - before.n_events) / passed_us
    for limit, unit, name in ((999.5e6, 1e9, "G"), (999.5e3, 1e6, "M"), (999.5, 1e3, "k")):
        if rate >= limit:
            value = rate / unit
            return f"{value:.{2 if value < 9.995 else 1 if value < 99.95 else 0}f}{name}"
    return f"{rate:.0f}"


def _moved(before: Emission | None, e: Emission, n_filters: int) -> str:
    """The filters whose pooled codes rose (+) or fell (-) most, all cells and both signs together."""
    change = e.features - before.features if before else e.features
    of_filter = change.reshape(-1, n_filters).sum(axis=0)
    most = np.argsort(-np.abs(of_filter), kind="stable")[:_FILTERS_SHOWN]
    said = [f"{k + 1}{'+' if of_filter[k] > 0 else '-'}" for k in most.tolist() if of_filter[k]]
    return " ".join(said) or "at rest"
