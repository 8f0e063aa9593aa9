"""From nothing to predictions: simulate, learn, train, replay, with what every installation has.

Lives here: the steps of the demonstration and their sizes.
Not here: each step itself (`simulate`, `learn`, `classifier`, `session`), and the command (`cli`).
"""

import shlex
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from streamfeat.classify.classifier import Classifier, train_classifier
from streamfeat.classify.features import encode_samples
from streamfeat.demo.terminal import EventPicture, TerminalView, draw_while
from streamfeat.engine.encoder import Encoder
from streamfeat.events import make_events
from streamfeat.learn.fit import learn_encoder
from streamfeat.learn.settings import Setting
from streamfeat.messages.packets import Packet
from streamfeat.recordings.reader import Label, open_recording
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.simulate.camera import CameraModel
from streamfeat.simulate.saccades import digit_samples
from streamfeat.stream.batch import EmissionBatch
from streamfeat.stream.compiling import Compilers
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.session import Session
from streamfeat.stream.signals import run_until_interrupted
from streamfeat.stream.sinks import Sink, TerminalSink
from streamfeat.stream.warming import warm_up

__all__ = ["FILES", "Demo"]

FILES = ("train.mcap", "test.mcap", "model.safetensors", "classifier.safetensors")
"""Files that the demonstration writes."""

SIZES = {"train": 200, "test": 40}
"""Digits of each recording."""

_SAMPLE_US, _GAP_US = 300_000, 300_000
"""A sample is three saccades; the silence after it is one window."""
_SETTING = Setting(patch=10, max_count=2, window_ms=300, filters=64, volumes=4_000, iterations=6)
_POLICY = EmitPolicy.parse("10ms")
_SPEED = 4.0
"""Stream seconds for each second of the live view: its forty digits take six."""

Report = Callable[[str, int, int, str], None]


class Demo:
    """The steps, each of which needs those before it.

    Args:
        folder: where `FILES` are written, replaced if they exist.
        report: told about progress, as (step, done, of how many, remark).
    """

    def __init__(self, folder: Path, report: Report = lambda step, done, total, remark: None) -> None:
        """Write nothing before `simulate`."""
        self.train, self.test, self.model, self.classifier = (folder / name for name in FILES)
        self._report = report
        self._compilers: Compilers | None = None
        self.interrupted = False

    @contextmanager
    def compiling(self) -> Iterator[None]:
        """Compile on other cores while the block runs, into numba's cache, where `compile` finds it."""
        with Compilers("narrow") as self._compilers:
            yield

    def simulate(self) -> int:
        """Write both recordings, and return how many events they have."""
        total, n_events = sum(SIZES.values()), 0
        self._report("simulating", 0, total, "")
        for path, split, before in ((self.train, "train", 0), (self.test, "test", SIZES["train"])):
            with RecordingWriter(path, overwrite=True) as writer:
                start_us = _GAP_US
                for i, sample in enumerate(digit_samples(SIZES[split], 0, split), 1):
                    events = sample.events
                    events["t"] += start_us
                    writer.write_label(Label(start_us, _SAMPLE_US, sample.label, split, sample.source))
                    writer.write_events(events, CameraModel().resolution)
                    n_events += len(events)
                    start_us += _SAMPLE_US + _GAP_US
                    self._report("simulating", before + i, total, path.name)
        return n_events

    def learn(self) -> Encoder:
        """Learn features from the training recording, without its labels.

        Raises:
            KeyboardInterrupt: Ctrl-C, as anywhere else; here it would only end the learning.
        """
        with open_recording(self.train) as recording:
            encoder = learn_encoder([recording], _SETTING, report=self._report)
        if encoder.provenance["interrupted"]:
            raise KeyboardInterrupt
        encoder.save(self.model)
        return encoder

    def compile(self, encoder: Encoder, console: Console | None = None) -> None:
        """Compile what encoding and replaying would otherwise wait for, without a word, when first needed.

        Args:
            encoder: that was learned.
            console: a terminal that the camera's picture is drawn on meanwhile, if it has room.
        """
        remark = "kernels, kept for the next time"
        self._report("compiling", 0, 2, remark)
        if self._compilers:
            if console and TerminalView.fits(console) and self._compilers.is_alive():
                with open_recording(self.test) as recording:
                    items = recording.played(loop=True)
                    draw_while(self._compilers.is_alive, console, items, recording.resolution)
            self._compilers.wait()
        self._report("compiling", 1, 2, remark)
        encoder.encode(make_events([0], [0], [1], [0]), CameraModel().resolution)
        warm_up(encoder, _POLICY)
        self._report("compiling", 2, 2, remark)

    def fit(self, encoder: Encoder) -> Classifier:
        """Train a classifier on the labelled samples of the training recording."""
        features, labels = [], []
        with open_recording(self.train) as recording:
            for label, row in encode_samples(encoder, recording.samples()):
                features.append(row)
                labels.append(label.label)
                self._report("encoding", len(labels), SIZES["train"], "")
        self._report("training", 0, 1, "")
        classifier = train_classifier(np.stack(features), labels, encoder)
        self._report("training", 1, 1, "")
        classifier.save(self.classifier)
        return classifier

    def replay(self, encoder: Encoder, classifier: Classifier, console: Console | None) -> dict[str, Any]:
        """Replay the test recording, live where a console is given, and return what came of it.

        A console that is no terminal, or one too narrow, gets lines. Without one nothing waits for the clock.
        """
        session = Session(encoder, _POLICY, classifier, clock=time.perf_counter)
        with open_recording(self.test) as recording:
            view = (
                TerminalView(console, recording.resolution)
                if console and TerminalView.fits(console)
                else None
            )
            sinks: list[Sink[Emission]] = [view or TerminalSink(console)] if console else []
            pipeline: Pipeline[Packet | Label, Emission] = Pipeline(
                recording.items(),
                _Watched(session, view.picture) if view else session,
                sinks,
                speed=_SPEED if console else None,
            )
            self.interrupted = run_until_interrupted([pipeline])
        stats = session.stats()
        return {
            "events": stats.events,
            "emissions": stats.emissions,
            "samples": stats.samples,
            "correct": stats.correct,
            "accuracy": round((stats.correct or 0) / max(stats.samples, 1), 4),
        }

    def commands(self) -> list[str]:
        """Commands to try next, quoted for a shell."""
        train, test, model, classifier = (
            shlex.quote(str(path)) for path in (self.train, self.test, self.model, self.classifier)
        )
        return [
            f"streamfeat replay {test} -m {model} -c {classifier} --emit event",
            f"streamfeat latency {test} -m {model}",
            f"streamfeat evaluate {train} {test} --method direct --method counts --patch {_SETTING.patch} "
            f"--max-count {_SETTING.max_count} --filters {_SETTING.filters} --volumes {_SETTING.volumes} "
            f"--iterations {_SETTING.iterations}",
        ]


class _Watched:
    """A session whose events are drawn: they are when they are processed, not when they were read."""

    def __init__(self, session: Session, picture: EventPicture) -> None:
        self._session, self._picture = session, picture

    def batches(self, item: Packet | Label) -> Iterator[EmissionBatch]:
        if isinstance(item, Packet):
            self._picture.add(item.events)
        return self._session.batches(item)

    def last_batches(self) -> Iterator[EmissionBatch]:
        return self._session.last_batches()

    def rest(self) -> None:
        self._session.rest()
