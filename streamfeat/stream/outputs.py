"""Where the emissions of a job go, as one value.

Lives here: `Outputs`, and opening its sinks, all of them or none.
Not here: each kind of sink (`sinks`, `table`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TextIO

from rich.console import Console

from streamfeat.recordings.writer import RecordingWriter
from streamfeat.stream.emission import Emission
from streamfeat.stream.sinks import JsonLinesSink, RecordingSink, Sink, TerminalSink, open_sinks
from streamfeat.stream.table import TableSink

__all__ = ["NO_OUTPUTS", "Outputs"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Outputs:
    """Where the emissions of a job go; nowhere unless something is given.

    Attributes:
        console: terminal for live lines.
        every_sample: print a line for each labelled sample, however fast they come.
        recording: MCAP file for features and predictions; replaced if it exists.
        json_lines: file (replaced) or open stream for a JSON line for each emission.
        with_features: include features in JSON lines.
        table: Arrow or Parquet file, see `TableSink`; replaced if it exists.
        more: one sink more.
    """

    console: Console | None = None
    every_sample: bool = False
    recording: Path | None = None
    json_lines: Path | TextIO | None = None
    with_features: bool = False
    table: Path | None = None
    more: Sink[Emission] | None = None

    def reads_features(self, *, has_classifier: bool) -> bool:
        """Whether any of them reads the features of emissions; a terminal does where nothing is predicted."""
        everything = self.recording or self.table or self.more
        lines = self.json_lines and self.with_features
        return bool(everything or lines or (self.console and not has_classifier))

    def open(
        self,
        n_features: int,
        labels: Sequence[str],
        *,
        n_filters: int = 0,
        before: Callable[[], Sink[Emission]] | None = None,
        after: Callable[[], Sink[Emission]] | None = None,
        recording_sink: Callable[[Path], RecordingSink] = lambda path: RecordingSink(
            RecordingWriter(path, overwrite=True)
        ),
    ) -> list[Sink[Emission]]:
        """Open the sinks: all of them or, when one cannot be opened, none is left open.

        Args:
            n_features: length of a feature vector.
            labels: names of the scores; empty without a classifier.
            n_filters: of the encoder, where features are those of filters that a person may look up.
            before: opens a sink of the job's own that is written to before the others.
            after: opens one that is written to after them.
            recording_sink: opens the sink of `recording`.

        Raises:
            InputError: one of them cannot be written.
        """
        return open_sinks(
            before,
            partial(TerminalSink, self.console, every_sample=self.every_sample, n_filters=n_filters)
            if self.console
            else None,
            partial(JsonLinesSink, self.json_lines, features=self.with_features) if self.json_lines else None,
            partial(recording_sink, self.recording) if self.recording else None,
            partial(TableSink, self.table, n_features, labels) if self.table else None,
            (lambda: self.more) if self.more else None,  # type: ignore[arg-type, return-value]
            after,
        )


NO_OUTPUTS = Outputs()
"""Emissions that go nowhere else than a job takes them by itself."""
