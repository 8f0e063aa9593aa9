"""The main job on live topics: events in, features and predictions out, until it is stopped.

Lives here: putting together what listening needs, and ending well.
Not here: the parts themselves.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live

from streamfeat.denoise.stage import Denoising
from streamfeat.engine.engine import Engine
from streamfeat.engine.threads import usable_threads
from streamfeat.errors import InputError
from streamfeat.files.outputs import locked_file
from streamfeat.live.checkpoint import Checkpointer, read_state
from streamfeat.live.health import Health, parse_address
from streamfeat.live.inbox import Inbox
from streamfeat.live.intake import SILENCE_S, Intake
from streamfeat.live.names import Names, PlainNames, RosNames, beside
from streamfeat.live.network import THIS_MACHINE, Network
from streamfeat.live.publisher import OutputSink
from streamfeat.live.screen import HealthTable
from streamfeat.live.shard import Shard
from streamfeat.live.subscription import Subscription
from streamfeat.live.topic import Barrier
from streamfeat.live.warnings import Warnings
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.stream.cameras import CameraLeft, Cameras
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.emission_stream import EmissionStream
from streamfeat.stream.load import Load
from streamfeat.stream.models import ClassifierSource, ModelSource, open_models
from streamfeat.stream.outputs import NO_OUTPUTS, Outputs
from streamfeat.stream.pipeline import Pipeline, Processor
from streamfeat.stream.session import Session, StreamItem
from streamfeat.stream.signals import run_until_interrupted, signals_wait
from streamfeat.stream.sinks import RecordingSink, Sink
from streamfeat.stream.state import SessionStats
from streamfeat.stream.warming import warm_up

__all__ = ["ListenJob", "listen"]

PATIENCE_S = 0.05
"""Behind a packet that has waited longer, a session emits as `auto` does, until it has caught up."""
MAX_DELAY_S = 1.0
"""Where even feeding cannot keep up, packets are dropped, so that the delay does not grow."""
_DRAWN_A_SECOND = 4


class ListenJob:
    """Listens on topics until `stop` or a signal.

    Args:
        names: of the topics.
        model: path of the encoder, or the encoder; None for the general one that ships.
        classifier: path of one to predict with, or the classifier; features alone without it.
        emit: when to emit, see `EmitPolicy.parse`.
        learn_online: learn from labels that are published beside the events.
        denoising: noise of each camera that is taken out before anything is counted.
        network: where to listen; `reliable` recovers missed packets and asks for history, from publishers
            that do the same.
        publish: put features and predictions on the network, beside the events.
        metrics: `HOST:PORT` to serve Prometheus metrics on.
        silence_s: how long a camera must be silent before its time goes on without it.
        patience_s: how long packets may wait before emissions are left out for them.
        max_delay_s: how long packets may wait before the oldest are dropped.
        state: file to keep what is needed to go on after a crash; gone on from, if it exists.
        state_every_s: how often it is written.
        shard: the share of the cameras to serve; all of them without it.
        announced: serve only cameras that announce themselves, and ask for nothing else.
        joins_late: emissions are incomplete until a window has passed, if packets were published before;
            for a job that goes on with the cameras of another.
        console: for warnings.
        engine_of: what makes the engines of a camera, given its topic; see `Session`.
        tap: what items pass through before anything is computed from them.
        threads: that share a large emission, for each camera; see `usable_threads`.

    Raises:
        InputError: a file cannot be used, the parts do not fit each other, or an argument makes no sense.
    """

    def __init__(
        self,
        names: Names,
        model: ModelSource | None = None,
        classifier: ClassifierSource | None = None,
        *,
        emit: str | EmitPolicy = "auto",
        learn_online: bool = False,
        denoising: Denoising | None = None,
        network: Network = THIS_MACHINE,
        publish: bool = True,
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
        threads: int | None = None,
    ) -> None:
        """Open and check everything but the network, before anything is written."""
        self._policy = emit if isinstance(emit, EmitPolicy) else EmitPolicy.parse(emit)
        limits = {"delay": max_delay_s, "silence": silence_s, "patience": patience_s}
        for name, seconds in limits.items():
            if not seconds >= 0:
                raise InputError(f"a {name} of {seconds} s is not possible; give a number from 0 on")
        self._encoder, self._classifier = open_models(model, classifier)
        if learn_online and self._classifier is None:
            raise InputError("--learn-online needs a classifier to start from; give one with -c")
        if state and learn_online:
            raise InputError("--state does not keep what --learn-online learns; give one of the two")
        if state and denoising:
            raise InputError("--state does not keep what is known of noisy pixels; give one of the two")
        self._denoising = denoising
        self._address = parse_address(metrics) if metrics else None
        self._names, self._shard, self._announced = names, shard, announced
        self._learn_online, self._network, self._publish = learn_online, network, publish
        self._engine_of, self._tap, self._threads = engine_of, tap, usable_threads(threads)
        self._patience_ns = patience_s * 1e9
        self.interrupted, self._keep_features = False, True
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

    @contextmanager
    def opened(self, sinks: Callable[[], Sequence[Sink[Emission]]]) -> Iterator[Pipeline[Any, Emission]]:
        """The pipeline of this job into some sinks, with network and metrics open as long as the block runs.

        Args:
            sinks: opens them, when all else is open.

        Raises:
            InputError: an output, the network or the metrics address cannot be used.
        """
        with ExitStack() as opened:
            if self._state:
                _hold(self._state, opened)
            warm_up(self._encoder, self._policy, self._classifier, decoders=True)
            session = opened.enter_context(self._network.open())
            if self._address:
                opened.callback(self.health.stop_serving)
                self.health.serve(*self._address)
            heard = Subscription(
                session,
                self._names,
                self._inbox,
                reliable=self._network.reliable,
                shard=self._shard,
                announced=self._announced,
            )
            opened.enter_context(heard)
            processor: Processor[Any, Emission] = self.health
            checkpointed: list[Sink[Emission]] = []
            published: list[Sink[Emission]] = []
            if self._publish:
                published = [OutputSink(session, self._names, self.health.on_published, self._on_unpublished)]
            written = sinks()
            if self._state:
                # Last of the sinks: what it keeps says that all others have written.
                processor = checkpointer = self._checkpointer(self._state)
                checkpointed = [checkpointer]
            pipeline: Pipeline[StreamItem | CameraLeft | Barrier, Emission] = Pipeline(
                self._tap(self._intake), processor, [*published, *written, *checkpointed]
            )
            self.health.queues = pipeline.stats
            yield pipeline

    def run(self, outputs: Outputs = NO_OUTPUTS) -> None:
        """Listen until `stop`, SIGINT or SIGTERM; what has arrived by then is still processed and written.

        Args:
            outputs: where emissions go. A console that is a terminal shows a table that is kept up to date,
                unless every sample is to have a line.

        Raises:
            InputError: an output, the network or the metrics address cannot be used.
        """
        console = outputs.console
        labels = self._classifier.labels if self._classifier else ()
        self._keep_features = self._publish or outputs.reads_features(has_classifier=bool(labels))
        with ExitStack() as held:

            def sinks() -> Sequence[Sink[Emission]]:
                lines = outputs
                if console and console.is_terminal and not outputs.every_sample:
                    held.enter_context(_screen(self.health, console))
                    lines = replace(outputs, console=None)
                held.enter_context(signals_wait())
                n_filters = 0 if self._encoder.further else self._encoder.n_filters
                return lines.open(
                    self._encoder.n_features, labels, n_filters=n_filters, recording_sink=_recording_sink
                )

            with self.opened(sinks) as pipeline:
                self.interrupted = run_until_interrupted([pipeline], self.stop)

    def stop(self) -> None:
        """Take in no more; may be called from any thread."""
        self._inbox.close()

    def result(self) -> dict[str, Any]:
        """What happened, as JSON values."""
        return self.health.result() | {"interrupted": self.interrupted}

    def drops(self) -> dict[str, int]:
        """What was not used so far, by reason; may be called from another thread."""
        return self.health.drops()

    def session_stats(self) -> SessionStats:
        """Totals of all cameras so far; may be called from another thread."""
        return self._cameras.stats()

    def _make_session(self, topic: str) -> Session:
        return Session(
            self._encoder,
            self._policy,
            self._classifier,
            learn_online=self._learn_online,
            clock=time.perf_counter,
            topic=topic,
            is_behind=self._is_behind,
            engine=self._engine_of(topic),
            denoising=self._denoising,
            load=Load(self._encoder.geometry, lambda line: self._warnings.add("too much work", topic, line)),
            keep_features=self._keep_features,
            threads=self._threads,
        )

    def _checkpointer(self, path: Path) -> Checkpointer:
        return Checkpointer(
            path,
            self._encoder.fingerprint,
            self.health,
            self._cameras,
            self._intake,
            lambda error: self._warnings.add("state not kept", str(path), error),
        )

    def _is_behind(self, log_time_ns: int) -> bool:
        return time.time_ns() - log_time_ns > self._patience_ns

    def _on_unpublished(self, topic: str, error: str) -> None:
        self._warnings.add("not published", topic, error)

    def _on_refusal(self, topic: str, reason: str, error: str) -> None:
        self._warnings.add(reason, topic, error)


def _screen(health: Health, console: Console) -> Live:
    return Live(
        HealthTable(health),
        console=console,
        refresh_per_second=_DRAWN_A_SECOND,
        transient=True,
    )


def _hold(state: Path, opened: ExitStack) -> None:
    """Keep a state for this job alone, as long as `opened` is; so it is seen, too, that it can be written.

    Raises:
        InputError: another listener has it, or its folder cannot be written to.
    """
    path = state.with_name(f"{state.name}.lock")
    lock = locked_file(path, state, private=True)
    opened.callback(lock.close)
    opened.callback(path.unlink, missing_ok=True)


def _recording_sink(path: Path) -> RecordingSink:
    writer = RecordingWriter(path, overwrite=True, keep_partial=True, private=True, compression="lz4")
    return RecordingSink(writer, lambda topic, kind: "/" + beside(topic, kind).lstrip("/"))


def listen(
    topics: str,
    model: ModelSource | None = None,
    classifier: ClassifierSource | None = None,
    *,
    emit: str | EmitPolicy = "auto",
    ros_domain: int = 0,
    learn_online: bool = False,
    max_delay_s: float = MAX_DELAY_S,
    port: int = THIS_MACHINE.port,
    zenoh_config: str | PathLike[str] | None = None,
    reliable: bool = False,
    publish: bool = False,
    threads: int | None = None,
) -> EmissionStream:
    """Listen to live topics as an asynchronous iterator of emissions, those that `streamfeat listen` makes.

    It goes on until `stop`, `aclose`, or the loop is left. A program that takes emissions too slowly makes
    the job emit less often; packets that wait for more than `max_delay_s` are dropped and counted.

    Example:
        >>> async def main():
        ...     async with sf.listen("robot/*/events", "model", "classifier") as emissions:
        ...         async for emission in emissions:
        ...             print(emission.topic, emission.prediction, emissions.stats().drops)
        >>> asyncio.run(main())  # in Jupyter: await main()

    Args:
        topics: zenoh key expression, such as `robot/*/events`; or a ROS 2 topic (rmw_zenoh), with its slash
            in front.
        model: path of the encoder, or the encoder; None for the general one that ships.
        classifier: path of a classifier, or the classifier; features alone without it.
        emit: `event`, `1000ev`, `10ms` (stream time) or `auto`; or a policy.
        ros_domain: ROS_DOMAIN_ID, of a ROS 2 topic.
        learn_online: learn from labels that are published beside the events.
        max_delay_s: how long packets may wait before the oldest are dropped.
        port: where sessions on this machine meet.
        zenoh_config: JSON5 configuration of zenoh; without it, this machine alone.
        reliable: recover missed packets, from publishers that do the same.
        publish: publish features and predictions beside the events, too.
        threads: that share a large emission, for each camera; all cores but one if not given.

    Returns:
        the stream; nothing is opened before it is used. Iterating raises InputError where a file or the
        network cannot be used.

    Raises:
        InputError: a topic, `emit`, `port` or `threads` makes no sense.
    """
    names: Names = RosNames(topics, ros_domain) if topics.startswith("/") else PlainNames(topics)
    policy = emit if isinstance(emit, EmitPolicy) else EmitPolicy.parse(emit)
    usable_threads(threads)  # now, not when it is used
    network = Network(Path(zenoh_config) if zenoh_config else None, port, reliable)

    def make_job() -> ListenJob:
        return ListenJob(
            names,
            model,
            classifier,
            emit=policy,
            learn_online=learn_online,
            max_delay_s=max_delay_s,
            network=network,
            publish=publish,
            threads=threads,
        )

    return EmissionStream(make_job)
