"""A view: a replay, or listening, that somebody looks at.

Lives here: putting boards, page and sink beside a job that exists already; waiting for whoever looks.
Not here: the job itself (`replay`, `live.listen`), what is shown (`sink`).
"""

import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from threading import Event, current_thread, main_thread
from typing import Any

from streamfeat.classify.kernel import load_classifier
from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.errors import InputError
from streamfeat.files.atomic import replacing, write_atomically
from streamfeat.files.locations import Location
from streamfeat.live.listen import ListenJob
from streamfeat.live.names import Names, beside
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.replay import ReplayJob, warm_up
from streamfeat.view.channels import Board, FileBoard, LiveBoard
from streamfeat.view.layout import foxglove_layout
from streamfeat.view.observe import ObservedEngine
from streamfeat.view.page import PageServer, page
from streamfeat.view.sink import ViewSink, about

__all__ = ["View", "prefix_of"]

_MAX_RATE = 1000.0
_TURN_S = 0.1


def prefix_of(topic: str) -> str:
    """What the names of a camera's channels begin with; the camera of a recording is ''."""
    return "/" + beside(topic, "view").lstrip("/") if topic else "/view"


class View:
    """Shows a recording, or live topics, until it ends or is interrupted.

    Args:
        source: a recording, or the names of live topics.
        model: of the encoder.
        classifier: to predict with; none for features alone.
        emit: when to read, see `EmitPolicy.parse`.
        rate: looks a second: of the clock, or of the stream where a recording only becomes a file.
        live_port: serve Foxglove's protocol there on 127.0.0.1; 0 for any, None for no server.
        web_port: serve a page there, too.
        recording_out: MCAP file to write; replaced if it exists.
        say: told addresses, and what is waited for.
        options: further ones of `ReplayJob` or `ListenJob`.

    Raises:
        InputError: a file cannot be used, or an argument makes no sense.
    """

    def __init__(
        self,
        source: Location | Names,
        model: Path,
        classifier: Path | None = None,
        *,
        emit: str = "auto",
        rate: float = 20.0,
        live_port: int | None = 0,
        web_port: int | None = None,
        recording_out: Path | None = None,
        say: Callable[[str], None] = lambda line: None,
        **options: Any,
    ) -> None:
        """Check everything; nothing is served or written before `run`."""
        if not 0 < rate <= _MAX_RATE:
            raise InputError(f"--rate {rate:g} is not possible; give up to {_MAX_RATE:g} looks a second")
        self._encoder, self._policy = Encoder.load(model), EmitPolicy.parse(emit)
        self._live_port, self._web_port, self._recording_out = live_port, web_port, recording_out
        self._say = say
        self._looked, self._stopped = Event(), Event()
        self._is_recording = isinstance(source, Location)
        self._boards: list[Board] = []
        self._sink = ViewSink(
            self._boards,
            self._encoder,
            rate=rate,
            live=live_port is not None or not self._is_recording,
            prefix=prefix_of,
            drops=lambda: self._job.drops(),
        )
        common = {"model": model, "classifier": classifier, "emit": emit} | options
        self._job: ReplayJob | ListenJob = (
            ReplayJob(source, engine=self._engine_of(""), **common)
            if isinstance(source, Location)
            else ListenJob(source, engine_of=self._engine_of, **common)
        )
        self._labels = load_classifier(classifier).labels if classifier else ()

    def run(self, **options: Any) -> None:
        """Show the source to its end or to SIGINT.

        A recording that is served begins when somebody looks, and its last picture stays until SIGINT.

        Args:
            options: of `Replay.run` or `Listen.run`.

        Raises:
            InputError: an output, a port or the network cannot be used.
        """
        waits = self._is_recording and self._live_port is not None
        with ExitStack() as serving:
            with ExitStack() as writing:
                with self._heeding_signals():
                    self._open(serving, writing)
                    if self._is_recording:
                        warm_up(self._encoder, self._policy)
                    if waits:
                        self._wait_for(self._looked, "waiting for somebody to look; Ctrl-C ends")
                if not self._stopped.is_set():
                    self._job.run(more=self._sink, **options)
            if waits and not self._job.interrupted:
                with self._heeding_signals():
                    self._wait_for(self._stopped, "that was all; Ctrl-C ends")

    @property
    def assumptions(self) -> list[str]:
        """What a recording leaves open and how that was decided; nothing of live topics."""
        return self._job.assumptions if isinstance(self._job, ReplayJob) else []

    def write_layout(self, path: Path, topic: str) -> None:
        """Write a Foxglove layout that shows all channels of a camera.

        Args:
            path: replaced if it exists.
            topic: of the camera; '' for a recording.

        Raises:
            InputError: it cannot be written, or the topic could be several.
        """
        if "*" in topic:
            raise InputError(f"--layout needs the key of one camera; {topic!r} may be several")
        pooling = self._encoder.geometry.pooling
        write_atomically(path, foxglove_layout(prefix_of(topic), self._labels, pooling).encode())

    def stop(self) -> None:
        """End listening, or waiting; a recording plays to its end. May be called from any thread."""
        self._stopped.set()
        if isinstance(self._job, ListenJob):
            self._job.stop()

    def result(self) -> dict[str, Any]:
        """What happened, as JSON values."""
        return self._job.result() | {"frames": self._sink.frames, "frames_skipped": self._sink.skipped}

    def _open(self, serving: ExitStack, writing: ExitStack) -> None:
        """Open what is shown on: a file that is complete when the job is done, servers that go on."""
        known = about(self._encoder, self._labels)
        if self._recording_out:
            path = writing.enter_context(replacing(self._recording_out))
            file = FileBoard(known, path, self._recording_out)
            writing.callback(file.close)
            self._boards.append(file)
        if self._live_port is None:
            return
        live = LiveBoard(known, "streamfeat view", self._live_port, self._looked.set)
        serving.callback(live.close)
        self._boards.append(live)
        if self._is_recording:
            live.announce(prefix_of(""))  # whoever looks has something to subscribe to
        self._say(f"Foxglove: ws://127.0.0.1:{live.port}")
        if self._web_port is not None:
            server = PageServer(page(live.port), self._web_port)
            serving.callback(server.close)
            self._say(f"page: http://127.0.0.1:{server.port}")

    @contextmanager
    def _heeding_signals(self) -> Iterator[None]:
        """SIGINT and SIGTERM mean to stop, and wait for what is under way: compiling cannot be cut off."""
        # Only the main thread of a process can be told of signals.
        names = (signal.SIGINT, signal.SIGTERM) if current_thread() is main_thread() else ()
        before = {name: signal.signal(name, lambda *_: self._stopped.set()) for name in names}
        try:
            yield
        finally:
            for name, handler in before.items():
                signal.signal(name, handler)

    def _wait_for(self, event: Event, line: str) -> None:
        if not self._stopped.is_set():
            self._say(line)
        while not event.is_set() and not self._stopped.is_set():
            event.wait(_TURN_S)

    def _engine_of(self, topic: str) -> Callable[..., Engine]:
        return partial(ObservedEngine, watch=self._sink.watch(topic))
