"""A view: a recording or live topics as pictures.

Lives here: putting boards, page and sink beside a source; waiting for the first viewer.
Not here: sources (`sources`, `live.listen`), what is shown (`sink`).
"""

import os
import sys
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from threading import Event, Thread
from typing import Any

from streamfeat.classify.kernel import load_classifier
from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.engine.threads import usable_threads
from streamfeat.errors import InputError
from streamfeat.files.atomic import write_atomically
from streamfeat.files.locations import Location
from streamfeat.files.outputs import OutputFile
from streamfeat.live.listen import ListenJob
from streamfeat.live.names import Names, beside
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.outputs import Outputs
from streamfeat.stream.warming import warm_up
from streamfeat.view.gate import FOXGLOVE_ORIGINS
from streamfeat.view.labelling import LabelSheet
from streamfeat.view.layout import foxglove_layout
from streamfeat.view.observe import ObservedEngine
from streamfeat.view.page import page
from streamfeat.view.player import Piece
from streamfeat.view.server import PageServer
from streamfeat.view.sink import Shows, ViewSink, about
from streamfeat.view.sources import PlayJob, WatchJob
from streamfeat.work.interrupts import kept_by

__all__ = ["View", "has_display", "prefix_of"]

_MAX_RATE = 1000.0
_MIN_SPEED, _MAX_SPEED = 0.001, 1000.0
_TURN_S = 0.1


def prefix_of(topic: str) -> str:
    """What the names of a camera's channels begin with."""
    return "/" + beside(topic, "view").lstrip("/") if topic else "/view"


def has_display() -> bool:
    """Whether a browser that is opened here would be seen."""
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return "SSH_CONNECTION" not in os.environ


class View:
    """Shows a recording, or live topics, until it ends or is interrupted.

    Args:
        source: a recording, or the names of live topics.
        model: of the encoder; None to look at events alone.
        classifier: to predict with; none for features alone.
        emit: when to read, see `EmitPolicy.parse`.
        rate: pictures a second: of the clock, or of the stream where a recording only becomes a file.
        web_port: serve the page there on 127.0.0.1; 0 for any port, None for no page.
        foxglove_port: serve Foxglove's protocol there, too; extra `view`.
        origins: further pages that may connect there, such as `http://localhost:8080`.
        recording_out: MCAP file to write; replaced if it exists; extra `view`.
        open_browser: show the page in a browser.
        speed: of a recording, a multiple of the recorded pace; None for as fast as possible.
        loop: start a recording again at its end.
        labels: labels of the recording that the page changes.
        threads: that share a large emission, see `usable_threads`.
        say: told addresses, and what is waited for.
        options: further ones of `PlayJob`, `WatchJob` or `ListenJob`.

    Raises:
        InputError: a file cannot be used, or an argument makes no sense.
    """

    def __init__(
        self,
        source: Location | Names,
        model: Path | None = None,
        classifier: Path | None = None,
        *,
        emit: str = "auto",
        rate: float = 20.0,
        web_port: int | None = 0,
        foxglove_port: int | None = None,
        origins: Sequence[str] = (),
        recording_out: Path | None = None,
        open_browser: bool = False,
        speed: float | None = 1.0,
        loop: bool = False,
        labels: LabelSheet | None = None,
        threads: int | None = None,
        say: Callable[[str], None] = lambda line: None,
        **options: Any,
    ) -> None:
        """Check everything; nothing is served or written before `run`."""
        if not 0 < rate <= _MAX_RATE:
            raise InputError(f"--rate {rate:g} is not possible; give up to {_MAX_RATE:g} pictures a second")
        if classifier and not model:
            raise InputError("a classifier reads features: give the model it was trained with, too (-m)")
        threads = usable_threads(threads)
        self._encoder = Encoder.load(model) if model else None
        self._policy = EmitPolicy.parse(emit)
        reader = load_classifier(classifier) if classifier else None
        if reader and self._encoder:
            reader.check_fits(self._encoder, path=classifier or "the classifier")
        self._labels = reader.labels if reader else ()
        self._web_port, self._foxglove_port, self._origins = web_port, foxglove_port, origins
        self._recording_out, self._open_browser, self._say = recording_out, open_browser, say
        self._is_served = web_port is not None or foxglove_port is not None
        self._looked, self._stopped = Event(), Event()
        self._is_recording = isinstance(source, Location)
        self._boards: list[Shows] = []
        self._page: PageServer | None = None
        self._sheet = labels
        self._sink = ViewSink(
            self._boards,
            self._encoder,
            rate=rate,
            live=self._is_served or not self._is_recording,
            prefix=(lambda topic: prefix_of("")) if self._is_recording else prefix_of,
            drops=lambda: self._job.drops(),
        )
        self._tap = self._sink.tap()
        self._job: PlayJob | WatchJob | ListenJob
        if isinstance(source, Location):
            self._job = PlayJob(
                source,
                self._encoder,
                reader,
                emit=self._policy,
                speed=speed,
                loop=loop,
                stays=self._is_served,
                make_engine=self._engine_of(""),
                threads=threads,
                on_player=self._tell("player"),
                on_timeline=self._tell("timeline") if web_port is not None else None,
                on_pieces=self._place,
                **options,
            )
        elif model:
            self._job = ListenJob(
                source,
                model,
                classifier,
                emit=emit,
                engine_of=self._engine_of,
                threads=threads,
                tap=self._tap.items,
                publish=False,
                **options,
            )
        else:
            self._job = WatchJob(source, **options)

    def run(self) -> None:
        """Show the source to its end or to SIGINT.

        A recording that is served begins with the first viewer, and can be sought in until SIGINT.

        Raises:
            InputError: an output, a port or the network cannot be used.
        """
        with ExitStack() as opened:
            with kept_by(self._stopped.set, is_promised=False):  # opening and compiling may be cut off
                self._open(opened)
                if self._is_recording and self._encoder:
                    warm_up(self._encoder, self._policy)
            with kept_by(self._stopped.set):
                if self._is_recording and self._is_served:
                    self._wait_for(self._looked, "waiting for the first viewer; Ctrl-C ends")
            if self._stopped.is_set():
                return
            if isinstance(self._job, ListenJob):
                self._job.run(Outputs(more=self._sink))
            else:
                self._job.run(self._tap, self._sink)

    @property
    def assumptions(self) -> list[str]:
        """What a recording leaves open and how that was decided; nothing of live topics."""
        return self._job.assumptions if isinstance(self._job, PlayJob) else []

    def write_layout(self, path: Path, topic: str) -> None:
        """Write a Foxglove layout that shows all channels of a camera.

        Args:
            path: replaced if it exists.
            topic: of the camera; '' for a recording.

        Raises:
            InputError: it cannot be written, there is no model, or the topic could be several.
        """
        if "*" in topic:
            raise InputError(f"--layout needs the key of one camera; {topic!r} may be several")
        if self._encoder is None:
            raise InputError("--layout needs a model: its panels show features (-m)")
        pooling = self._encoder.geometry.pooling
        write_atomically(path, foxglove_layout(prefix_of(topic), self._labels, pooling).encode())

    def stop(self) -> None:
        """End the view. May be called from any thread."""
        self._stopped.set()
        self._job.stop()

    def result(self) -> dict[str, Any]:
        """What happened, as JSON values."""
        result = self._job.result() | {"frames": self._sink.frames, "frames_skipped": self._sink.skipped}
        return result | (self._sheet.result() if self._sheet else {})

    def _open(self, opened: ExitStack) -> None:
        """Open what is shown on."""
        known = about(self._encoder, self._labels)
        if self._recording_out:
            from streamfeat.view.channels import FileBoard

            output = opened.enter_context(OutputFile(self._recording_out))
            file = FileBoard(known, output.part or output.path, output.path)
            opened.callback(file.close)
            self._boards.append(file)
        if self._foxglove_port is not None:
            from streamfeat.view.channels import LiveBoard

            allowed = FOXGLOVE_ORIGINS | set(self._origins)
            live = LiveBoard(known, "streamfeat view", self._foxglove_port, self._looked.set, allowed)
            opened.callback(live.close)
            self._boards.append(live)
            if self._is_recording:
                live.announce(prefix_of(""))  # so that a viewer has something to subscribe to
            self._say(f"Foxglove: {live.address}")
        if self._web_port is not None:
            server = PageServer(page, self._web_port, on_viewer=self._looked.set, on_asked=self._asked)
            opened.callback(server.close)
            self._boards.append(server)
            self._page = server
            server.record("", "about", 0, known | {"recording": self._is_recording})
            self._show_labels()
            self._say(f"page: {server.address}")
            if self._open_browser:
                Thread(target=webbrowser.open, args=(server.address,), daemon=True).start()

    def _tell(self, channel: str) -> Callable[[dict[str, Any]], None]:
        """What shows something of a recording that is no picture on the page."""

        def tell(record: dict[str, Any]) -> None:
            if self._page:
                self._page.record(prefix_of(""), channel, 0, record)

        return tell

    def _place(self, pieces: Sequence[Piece], end_us: int) -> None:
        """Tell labels which stream time is played when."""
        if self._sheet:
            self._sheet.read_to(pieces, end_us)
            self._show_labels()

    def _show_labels(self) -> None:
        if self._sheet:
            self._tell("labels")(self._sheet.record())

    def _asked(self, asked: dict[str, Any]) -> None:
        """Do what a button of the page asks for; what makes no sense is left alone."""
        if not isinstance(self._job, PlayJob):
            return
        if self._sheet and asked["op"] in LabelSheet.OPERATIONS:
            self._sheet.do(asked)
            self._show_labels()
            return
        player, op, value = self._job.player, asked["op"], asked.get("value")
        number = float(value) if isinstance(value, int | float) and 0 <= value < 1e9 else None
        if op == "pause" and isinstance(value, bool):
            player.pause(value)
        elif op == "step":
            player.step()
        elif op == "seek" and number is not None:
            player.seek(round(number * 1e6))
        elif op == "speed" and (value is None or (number is not None and _MIN_SPEED <= number <= _MAX_SPEED)):
            player.set_speed(number)

    def _wait_for(self, event: Event, line: str) -> None:
        if not self._stopped.is_set():
            self._say(line)
        while not event.is_set() and not self._stopped.is_set():
            event.wait(_TURN_S)

    def _engine_of(self, topic: str) -> Callable[..., Engine]:
        def make(*arguments: Any, **options: Any) -> Engine:
            return ObservedEngine(*arguments, watch=self._sink.watch(topic), **options)

        return make
