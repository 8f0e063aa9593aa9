"""The main job on live topics: events in, features and predictions out, until somebody stops it.

Lives here: putting together what listening needs, and ending well.
Not here: each of the parts.
"""

import math
import time
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console
from rich.live import Live

from streamfeat.classify.kernel import load_classifier
from streamfeat.denoise.stage import Denoising
from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.live.checkpoint import Checkpointer, read_state
from streamfeat.live.health import Health, parse_address
from streamfeat.live.inbox import Inbox
from streamfeat.live.intake import SILENCE_S, Intake, Warnings
from streamfeat.live.names import Names, beside
from streamfeat.live.network import DEFAULT_PORT, Subscription, open_session
from streamfeat.live.publisher import OutputSink
from streamfeat.live.screen import HealthTable
from streamfeat.live.shard import Shard
from streamfeat.live.topic import Barrier
from streamfeat.messages.codecs import PAYLOAD_ENCODINGS, encode, make_decoder
from streamfeat.messages.packets import Packet
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.stream.cameras import CameraLeft, Cameras
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.pipeline import Pipeline, Processor
from streamfeat.stream.session import Session, StreamItem
from streamfeat.stream.signals import run_until_interrupted, signals_wait
from streamfeat.stream.sinks import JsonLinesSink, RecordingSink, Sink, TerminalSink, open_sinks
from streamfeat.stream.table import TableSink

__all__ = ["ListenJob"]

PATIENCE_S = 0.05
"""A packet that has waited longer is read as `auto` would, so that those behind it need not wait."""
MAX_DELAY_S = 1.0
"""Where even feeding cannot keep up, packets are dropped rather than being ever further behind."""
_DRAWN_A_SECOND = 4


class ListenJob:
    """Listens on topics until `stop` or a signal.

    Args:
        names: of the topics.
        model: of the encoder.
        classifier: to predict with; none for features alone.
        emit: when to read, see `EmitPolicy.parse`.
        learn_online: learn from labels that are published beside the events.
        denoising: noise of each camera that is taken out before anything is counted.
        reliable: recover missed packets and ask for history, from publishers that do the same.
        zenoh_config: JSON5 file; without it, this machine alone.
        port: where sessions on this machine meet.
        metrics: `HOST:PORT` to serve Prometheus metrics on.
        silence_s: how long a camera must be silent before its time goes on without it.
        patience_s: how long packets may wait before readings are left out for them.
        max_delay_s: how long packets may wait before the oldest are dropped.
        state: file to keep what is needed to go on after a crash; gone on from, if it exists.
        state_every_s: how often it is written.
        shard: the share of the cameras to serve; all without it.
        announced: serve those only that announce themselves; what others publish is not asked for.
        joins_late: readings are incomplete until a window has passed, if packets were published before; as
            of one who goes on with the cameras of another.
        console: for warnings.
        engine_of: what makes the engines of a camera, given its topic; see `Session`.
        tap: what items pass through before anything is computed from them.

    Raises:
        InputError: a file cannot be used, the parts do not fit each other, or an argument makes no sense.
    """

    def __init__(
        self,
        names: Names,
        model: Path,
        classifier: Path | None = None,
        *,
        emit: str = "auto",
        learn_online: bool = False,
        denoising: Denoising | None = None,
        reliable: bool = False,
        zenoh_config: Path | None = None,
        port: int = DEFAULT_PORT,
        metrics: str | None = None,
        silence_s: float = SILENCE_S,
        patience_s: float = PATIENCE_S,
        max_delay_s: float = MAX_DELAY_S,
        state: Path | None = None,
        state_every_s: float = 1.0,
        shard: Shard | None = None,
        announced: bool = False,
        joins_late: bool = False,
        console: Console | None = None,
        engine_of: Callable[[str], Callable[..., Engine]] = lambda topic: Engine,
        tap: Callable[[Iterable[Any]], Iterable[Any]] = lambda items: items,
    ) -> None:
        """Open and check everything but the network, before anything is written."""
        self._policy = EmitPolicy.parse(emit)
        self._encoder = Encoder.load(model)
        self._classifier = load_classifier(classifier) if classifier else None
        if self._classifier:
            self._classifier.check_fits(self._encoder, path=classifier or "the classifier")
        elif learn_online:
            raise InputError("--learn-online needs a classifier to start from; give one with -c")
        if state and learn_online:
            raise InputError("--state does not keep what --learn-online learns; give one of the two")
        if state and denoising:
            raise InputError("--state does not keep what is known of noisy pixels; give one of the two")
        self._denoising = denoising
        self._address = parse_address(metrics) if metrics else None
        self._names, self._shard, self._announced = names, shard, announced
        self._learn_online, self._reliable = learn_online, reliable
        self._engine_of, self._tap = engine_of, tap
        self._zenoh_config, self._port = zenoh_config, port
        self._patience_ns = patience_s * 1e9
        self.interrupted = False
        self._warnings = Warnings.on(console)
        self._inbox = Inbox(max_delay_s=max_delay_s)
        window_us = self._encoder.geometry.window_us
        mark_s = state_every_s if state else math.inf
        options: dict[str, Any] = {"silence_s": silence_s, "mark_s": mark_s, "joins_late": joins_late}
        self._intake = Intake(self._inbox, window_us, self._warnings, **options)
        self._cameras = Cameras(self._make_session, on_refusal=self._on_refusal)
        self.health = Health(self._cameras, self._intake, self._inbox, self._warnings)
        self._state = state
        if state and state.exists():
            read_state(state, self._encoder.fingerprint, self._intake, self._cameras, shard)

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
        publish: bool = True,
    ) -> None:
        """Listen until `stop`, SIGINT or SIGTERM; what has arrived by then is still processed and written.

        Args:
            console: for a table that is kept up to date if it is a terminal, or else for lines.
            every_sample: a line for each labelled sample, however fast they come; no table then.
            recording_out: MCAP file for features and predictions; replaced if it exists.
            json_lines: file (replaced) or open stream for a JSON line for each emission.
            with_features: include features in JSON lines.
            table: Arrow or Parquet file for emissions, see `TableSink`; replaced if it exists.
            more: one sink more.
            publish: put features and predictions on the network, beside the events.

        Raises:
            InputError: an output, the network or the metrics address cannot be used.
        """
        self._warm_up()
        is_screen = console is not None and console.is_terminal and not every_sample
        labels = self._classifier.labels if self._classifier else ()
        screen = Live(
            get_renderable=lambda: HealthTable(self.health),
            console=console,
            refresh_per_second=_DRAWN_A_SECOND,
            transient=True,
        )
        with (
            open_session(self._zenoh_config, port=self._port) as session,
            screen if is_screen else nullcontext(),
            signals_wait(),
        ):
            sinks = open_sinks(
                partial(OutputSink, session, self._names, self.health.on_published) if publish else None,
                partial(TerminalSink, console, every_sample=every_sample)
                if console and not is_screen
                else None,
                partial(JsonLinesSink, json_lines, features=with_features) if json_lines else None,
                partial(_recording_sink, recording_out) if recording_out else None,
                partial(TableSink, table, self._encoder.n_features, labels) if table else None,
                (lambda: more) if more else None,
                self._keeper if self._state else None,
            )
            processor: Processor[Any, Emission] = (
                sinks[-1] if isinstance(sinks[-1], Checkpointer) else self.health
            )
            pipeline: Pipeline[StreamItem | CameraLeft | Barrier, Emission] = Pipeline(
                self._tap(self._intake), processor, sinks
            )
            self.health.queues = pipeline.stats
            try:
                if self._address:
                    self.health.serve(*self._address)
                with Subscription(
                    session,
                    self._names,
                    self._inbox,
                    reliable=self._reliable,
                    shard=self._shard,
                    announced=self._announced,
                ):
                    self.interrupted = run_until_interrupted([pipeline], self.stop)
            finally:
                self.health.stop_serving()

    def stop(self) -> None:
        """Take in no more; may be called from any thread."""
        self._inbox.close()

    def result(self) -> dict[str, Any]:
        """What happened, as JSON values."""
        return self.health.result() | {"interrupted": self.interrupted}

    def _warm_up(self) -> None:
        """Compile what the first packets would otherwise have to wait for."""
        geometry = self._encoder.geometry
        side = geometry.patch * geometry.downsample
        event = make_events([0], [0], [1], [0])
        for encoding in PAYLOAD_ENCODINGS:
            payload, base_ns = encode(event, encoding)
            make_decoder(encoding).decode(payload, base_ns)
        # In time and too late, however long compiling takes: the two ways to feed.
        for is_late in (False, True):
            session = self._make_session("", Engine, lambda log_time_ns, is_late=is_late: is_late)  # type: ignore[misc]
            for _ in session.process(Packet("", event, (side, side), 0, 0)):
                pass
            session.rest()
            for _ in session.finish():
                pass

    def drops(self) -> dict[str, int]:
        """What did not come to bear so far, by reason; may be called from another thread."""
        return self.health.drops()

    def _make_session(
        self,
        topic: str,
        engine: Callable[..., Engine] | None = None,
        is_behind: Callable[[int], bool] | None = None,
    ) -> Session:
        return Session(
            self._encoder,
            self._policy,
            self._classifier,
            learn_online=self._learn_online,
            clock=time.perf_counter,
            topic=topic,
            is_behind=is_behind or self._is_behind,
            engine=engine or self._engine_of(topic),
            denoising=self._denoising,
        )

    def _keeper(self) -> Checkpointer:
        assert self._state
        parts = self.health, self._cameras, self._intake
        return Checkpointer(
            self._state,
            self._encoder.fingerprint,
            *parts,
            lambda error: self._warnings.add("state not kept", str(self._state), error),
        )

    def _is_behind(self, log_time_ns: int) -> bool:
        return time.time_ns() - log_time_ns > self._patience_ns

    def _on_refusal(self, topic: str, reason: str, error: str) -> None:
        self._warnings.add(reason, topic, error)


def _recording_sink(path: Path) -> RecordingSink:
    writer = RecordingWriter(path, overwrite=True, keep_partial=True, compression="lz4")
    return RecordingSink(writer, lambda topic, kind: "/" + beside(topic, kind).lstrip("/"))
