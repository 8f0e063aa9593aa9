"""Sources of a view: a recording that is played, or live topics; with features or without.

Lives here: `PlayJob` and `WatchJob`, which bring items through a tap to sessions, if there are any.
Not here: pictures and boards (`sink`), the player itself (`player`), listening with features (`live.listen`).
"""

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from rich.console import Console

from streamfeat.classify.classifier import Classifier
from streamfeat.classify.kernel import KernelClassifier
from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.errors import InputError
from streamfeat.files.locations import Location
from streamfeat.live.inbox import Inbox
from streamfeat.live.intake import Intake
from streamfeat.live.names import Names
from streamfeat.live.network import THIS_MACHINE, Network
from streamfeat.live.subscription import Subscription
from streamfeat.live.warnings import Warnings
from streamfeat.messages.packets import Label, Packet, Watermark
from streamfeat.recordings.options import AS_IT_IS, ReadOptions
from streamfeat.recordings.reader import Recording, open_recording
from streamfeat.stream.batch import EmissionBatch
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.pipeline import Pipeline, Processor
from streamfeat.stream.replay import items_of_split
from streamfeat.stream.room import Room
from streamfeat.stream.session import Session
from streamfeat.stream.signals import run_until_interrupted, signals_wait
from streamfeat.stream.sinks import Sink
from streamfeat.view.player import Piece, Player, Timeline
from streamfeat.view.tap import EventTap

__all__ = ["PlayJob", "WatchJob"]

_WINDOW_US = 100_000


class NoFeatures:
    """Lets items pass, and makes nothing of them."""

    def batches(self, item: object, /) -> Iterator[EmissionBatch]:
        """Yield nothing."""
        return iter(())

    def last_batches(self) -> Iterator[EmissionBatch]:
        """Yield nothing."""
        return iter(())

    def rest(self) -> None:
        """Do nothing."""


class PlayJob:
    """A recording that is played, for viewers or into a file.

    Args:
        source: the recording.
        encoder: for features; None for events alone.
        classifier: to predict with.
        emit: when to read.
        speed: played seconds for each of the clock; None for as fast as possible.
        loop: start again at the end.
        stays: stay at the end, because a viewer may seek.
        split: play samples of this split only.
        topic: event topic, where there are several.
        reading: how to read what is no MCAP, and what to take out.
        make_engine: makes the engines, see `Session`.
        threads: of the engines, see `Session`.
        on_player: told what the page shows of the player.
        on_timeline: told the event rate over the recording; without it, it is not counted.
        on_pieces: told which stream time is played when, see `Timeline`.

    Raises:
        InputError: the recording cannot be used, or the parts do not fit each other.
    """

    def __init__(
        self,
        source: Location,
        encoder: Encoder | None,
        classifier: Classifier | KernelClassifier | None,
        *,
        emit: EmitPolicy,
        speed: float | None,
        loop: bool = False,
        stays: bool = False,
        split: str | None = None,
        topic: str | None = None,
        reading: ReadOptions = AS_IT_IS,
        make_engine: Callable[..., Engine] = Engine,
        threads: int = 1,
        on_player: Callable[[dict[str, Any]], None] = lambda state: None,
        on_timeline: Callable[[dict[str, Any]], None] | None = None,
        on_pieces: Callable[[Sequence[Piece], int], None] = lambda pieces, end_us: None,
    ) -> None:
        """Open and check everything."""
        self._opening: Callable[[], Recording] = partial(open_recording, source, topic, reading)
        self._on_timeline, self._on_pieces = on_timeline, on_pieces
        with self._opening() as recording:
            self.assumptions = recording.assumptions
            if encoder:
                encoder.geometry.grid_shape(recording.resolution)
            if split is not None and split not in {label.split for label in recording.labels}:
                raise InputError(f"{source}: has no samples of split {split!r}")
        self._session = (
            Session(
                encoder,
                emit,
                classifier,
                clock=time.perf_counter,
                engine=Room().maker("", make_engine),
                threads=threads,
            )
            if encoder
            else None
        )
        self.player = Player(
            self._opening,
            lambda items: items_of_split(items, split),
            speed=speed,
            loop=loop,
            stays=stays,
            on_change=on_player,
        )
        self._seconds = 0.0
        self.interrupted = False

    def run(self, tap: EventTap, sink: Sink[Emission]) -> None:
        """Play until the end, `stop`, SIGINT or SIGTERM."""
        timeline = Timeline(self._opening, self._on_timeline, self._on_pieces) if self._on_timeline else None
        started = time.perf_counter()
        try:
            with signals_wait():
                processor: Processor[Packet | Label | Watermark, Emission] = self._session or NoFeatures()
                pipeline: Pipeline[Packet | Label | Watermark, Emission] = Pipeline(
                    tap.items(self.player), processor, [sink]
                )
                self.interrupted = run_until_interrupted([pipeline], self.player.stop)
        finally:
            self._seconds = time.perf_counter() - started
            if timeline:
                timeline.close()

    def stop(self) -> None:
        """End playing; may be called from any thread."""
        self.player.stop()

    def drops(self) -> dict[str, int]:
        """What was not used so far, by reason; may be called from another thread."""
        lost = sum(list(self.player.losses.counts.values()))
        if self._session is None:
            return {"lost": lost}
        stats = self._session.stats()
        return {"late": stats.late, "rejected": stats.rejected, "lost": lost}

    def result(self) -> dict[str, Any]:
        """What happened, as JSON values."""
        result: dict[str, Any] = {"seconds": round(self._seconds, 3)}
        if self._session:
            stats = self._session.stats()
            result |= {"events": stats.events, "emissions": stats.emissions, "samples": stats.samples}
            if stats.correct is not None and stats.samples:
                result |= {"correct": stats.correct, "accuracy": round(stats.correct / stats.samples, 4)}
        return result | self.drops() | {"interrupted": self.interrupted}


class WatchJob:
    """Live topics whose events are looked at, without features.

    Args:
        names: of the topics.
        network: where to listen; `reliable` recovers missed packets, from publishers that do the same.
        console: for warnings.
    """

    def __init__(
        self,
        names: Names,
        *,
        network: Network = THIS_MACHINE,
        console: Console | None = None,
    ) -> None:
        """Nothing is subscribed to before `run`."""
        self._names, self._network = names, network
        self._inbox = Inbox()
        self._intake = Intake(self._inbox, _WINDOW_US, Warnings.on(console))
        self.interrupted = False

    def run(self, tap: EventTap, sink: Sink[Emission]) -> None:
        """Watch until `stop`, SIGINT or SIGTERM.

        Raises:
            InputError: the network cannot be used.
        """
        with self._network.open() as session, signals_wait():
            pipeline: Pipeline[Any, Emission] = Pipeline(tap.items(self._intake), NoFeatures(), [sink])
            with Subscription(session, self._names, self._inbox, reliable=self._network.reliable):
                self.interrupted = run_until_interrupted([pipeline], self.stop)

    def stop(self) -> None:
        """Take in no more; may be called from any thread."""
        self._inbox.close()

    def drops(self) -> dict[str, int]:
        """What was not used so far, by reason; may be called from another thread."""
        delivery = self._intake.delivery()
        return {"lost": delivery.lost, "dropped": self._inbox.dropped, "duplicates": delivery.duplicates}

    def result(self) -> dict[str, Any]:
        """What happened, as JSON values."""
        return (
            {"packets": self._intake.delivery().received} | self.drops() | {"interrupted": self.interrupted}
        )
