"""From the items of a stream to emissions, one item at a time and synchronously.

Lives here: which engine an event goes to, where labelled samples begin and end, when emissions are made,
predicting and, on request, learning from labels.
Not here: threads, queues, files, terminals (`pipeline`, `sinks`); the clock, where one is needed, is given.
"""

from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from streamfeat.classify.classifier import Classifier
from streamfeat.classify.kernel import KernelClassifier
from streamfeat.classify.online import OnlineClassifier
from streamfeat.denoise.stage import Denoiser, Denoising
from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.events import Events, Resolution, is_valid
from streamfeat.messages.packets import Label, Packet, Watermark
from streamfeat.stream.batch import EmissionBatch, Emitter
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.load import Load
from streamfeat.stream.state import SessionSnapshot, SessionState, SessionStats

__all__ = ["Session", "StreamItem"]

StreamItem = Packet | Label | Watermark

_TRACED, _TRACED_BYTES = 256, 1 << 20
"""Events that are followed at a time under `event`: so many, and as many as their features may take."""
_AHEAD_COLUMNS = 4096
"""Operator columns that are added at most to look ahead of a bin boundary: a fraction of a millisecond."""
_AUTO_REST = 4.0
"""Under `auto`, time that passes after an emission, in multiples of what that emission took."""


class Session(Emitter):
    """Feeds one camera's packets and labels to an engine, and emits features as the policy says.

    A labelled sample starts with an empty window and its own origin, so its features are those of the
    offline path. Packets of another resolution start a new engine, packets of another epoch an empty window.
    A session that is behind emits as `auto` does until it has caught up, whatever the policy: it leaves out
    emissions and drops no events. Emissions of a window that packets are missing from are marked.

    Example:
        >>> session = sf.Session(encoder, sf.EmitPolicy.parse("10ms"), clock=time.perf_counter)
        >>> with sf.open_recording("digits.mcap") as recording:
        ...     for item in recording.items():
        ...         for emission in session.process(item):
        ...             print(emission.t_us, emission.features.sum())
        >>> final = list(session.finish())

    Args:
        encoder: the frozen encoder.
        policy: when to emit.
        classifier: predicts at each emission; of one with a kernel the linear one beside it where each event
            has an emission, or where it learns online.
        learn_online: learn from each labelled sample after predicting it (prequential).
        clock: seconds, monotonic; used by the `auto` policy, and by a session that is behind.
        topic: named in emissions.
        is_behind: whether the packet in hand has waited too long, given its `log_time_ns`.
        engine: makes the engines, as `Engine` does; a subclass may observe what is done with one.
        denoising: noise that is taken out before anything is counted; no part of a snapshot.
        load: times the work of the first second, if somebody is to be told that it is too much.
        keep_features: whether emissions under `event` have features, or scores alone, which takes less time;
            may be changed before the first item.
        threads: of the engines, see `Engine`.

    Raises:
        InputError: the classifier does not fit the encoder.
    """

    def __init__(
        self,
        encoder: Encoder,
        policy: EmitPolicy,
        classifier: Classifier | KernelClassifier | None = None,
        *,
        learn_online: bool = False,
        clock: Callable[[], float] = lambda: 0.0,
        topic: str = "",
        is_behind: Callable[[int], bool] = lambda log_time_ns: False,
        engine: Callable[..., Engine] = Engine,
        denoising: Denoising | None = None,
        load: Load | None = None,
        keep_features: bool = True,
        threads: int = 1,
    ) -> None:
        """Check that the parts fit; the engine comes with the first packet."""
        if classifier:
            classifier.check_fits(encoder)
        self.encoder = encoder
        self.policy = policy = policy.with_bins(encoder.geometry.bin_us)
        self._every_event = policy == EmitPolicy("events", 1)
        if classifier and (learn_online or self._every_event):
            classifier = classifier.linear
        self.learner = OnlineClassifier(classifier.linear) if classifier and learn_online else None
        self._classifier = classifier
        self._clock, self._topic, self._load = clock, topic, load
        self.keep_features = keep_features
        self._window_us = encoder.geometry.window_us
        self._is_behind = is_behind
        self._make_engine = partial(engine, threads=threads)
        self.denoiser = Denoiser(denoising) if denoising else None
        self._engine: Engine | None = None
        every_us = policy.every if policy.kind == "time" else encoder.geometry.bin_us
        self._state = SessionState(every_us=every_us)
        self._rest_until = self._ahead_from = 0.0
        self._log_time_ns = self._source_ns = 0
        self._stats = SessionStats(correct=0 if classifier else None)

    @property
    def classifier(self) -> Classifier | KernelClassifier | None:
        """The classifier as it is now."""
        return self.learner.classifier if self.learner else self._classifier

    def stats(self) -> SessionStats:
        """What has been done so far, a copy."""
        total = replace(self._stats)
        if self._engine:
            _add_engine(total, self._engine)
        return total

    def snapshot(self) -> SessionSnapshot:
        """Copy the state; learning online is not part of it."""
        engine = self._engine
        return SessionSnapshot(
            replace(self._state),
            replace(self._stats),
            engine.resolution if engine else None,
            engine.snapshot() if engine else None,
        )

    def restore(self, snapshot: SessionSnapshot) -> None:
        """Go on from a snapshot of a session with the same encoder; the policy may be another.

        Raises:
            InputError: it is of another encoder, or of no session at all. This one is no longer of use.
        """
        self._state = snapshot.state.resumed(self._state.every_us)
        has_classifier, self._engine = self._stats.correct is not None, None
        self._stats = replace(
            snapshot.stats, correct=(snapshot.stats.correct or 0) if has_classifier else None
        )
        if snapshot.resolution and snapshot.engine:
            self._engine_for(snapshot.resolution).restore(snapshot.engine)

    def batches(self, item: StreamItem, /) -> Iterator[EmissionBatch]:
        """Take in one item of the stream, and yield the emissions on the way in columns."""
        if self.denoiser:
            item = self.denoiser.process(item)
        if isinstance(item, Watermark):
            self._source_ns = 0
            yield from self._pass_time(item.t_us)
        elif isinstance(item, Label):
            yield from self._finish_sample()
            self._state.open_sample(item)
            self._restart()
        else:
            work = self._process_packet(item)
            yield from self._load.timed(work, item) if self._load and not self._load.is_done else work

    def _process_packet(self, packet: Packet) -> Iterator[EmissionBatch]:
        state = self._state
        if packet.epoch != state.epoch:
            yield from self._enter_epoch(packet.epoch)
        state.lost |= packet.lost > 0
        self._log_time_ns, self._source_ns = packet.log_time_ns, packet.source_ns
        events = packet.events
        if len(events) == 0:
            if packet.until_us is not None:
                yield from self._pass_time(packet.until_us)
            return
        state.touch()
        engine = self._engine_for(packet.resolution)
        latest, first_us = state.place(events, packet.resolution, self._window_us)
        end = len(events)
        if state.sample and state.sample_end_us is not None:
            end = int(np.searchsorted(latest, state.sample_end_us))
            if first_us < state.sample.start_us:
                usable = is_valid(events[:end], packet.resolution)
                early = usable & (events["t"][:end] < state.sample.start_us)
                self._stats.late += int(np.count_nonzero(early))
                kept = np.concatenate([~early, np.ones(len(events) - end, np.bool_)])
                events, latest, end = events[kept], latest[kept], int(np.count_nonzero(kept[:end]))
        yield from self._feed(engine, events[:end], latest[:end])
        if end < len(events):
            yield from self._finish_sample()
            yield from self._feed(engine, events[end:], latest[end:])

    def rest(self) -> None:
        """Look ahead to the next emission while no item waits, for half of the time at most."""
        now = self._clock()
        if self._engine and self.policy.kind != "auto" and now >= self._ahead_from:
            self._engine.prepare(_AHEAD_COLUMNS)
            self._ahead_from = now + 2 * (self._clock() - now)

    def last_batches(self) -> Iterator[EmissionBatch]:
        """End the stream: the open sample has its final emission, and what was collected is learned."""
        self._source_ns = 0
        yield from self._finish_sample()
        if self._state.unread and self._engine:
            yield self._emit(self._engine, self._state.last_us + 1)
        if self.learner:
            self.learner.flush()

    def _enter_epoch(self, epoch: int) -> Iterator[EmissionBatch]:
        if self._state.epoch is None:
            self._state.epoch = epoch
            return
        # A label right before the first packet of a new clock is of that clock.
        if not self._state.is_untouched:
            yield from self._finish_sample()
        self._state.begin_epoch(epoch)
        self._restart()

    def _restart(self) -> None:
        if self._engine:
            self._engine.restart(self._state.origin_us)

    def _pass_time(self, t_us: int) -> Iterator[EmissionBatch]:
        """Emit what decays in silence, at bin boundaries or as the policy says, until the window is empty."""
        state, engine = self._state, self._engine
        if state.sample_end_us is not None and t_us >= state.sample_end_us:
            yield from self._finish_sample()
        if engine is None or state.is_between_samples:
            return
        while (due := state.due_in_silence(t_us, self._window_us)) <= t_us:
            yield self._emit(engine, due)
            state.pass_due(due, in_silence=True)

    def _engine_for(self, resolution: Resolution) -> Engine:
        if self._engine and self._engine.resolution == resolution:
            return self._engine
        engine = self._make_engine(
            self.encoder, resolution, origin_us=self._state.origin_us, look_ahead=self._every_event
        )
        if self._engine:
            _add_engine(self._stats, self._engine)
        self._engine = engine
        return engine

    def _feed(self, engine: Engine, events: Events, latest: NDArray[np.int64]) -> Iterator[EmissionBatch]:
        done = 0
        if self._every_event:
            done = yield from self._trace(engine, events, latest)
        elif self.policy.kind == "time":
            done = yield from self._feed_by_time(engine, events, latest)
        elif self.policy.kind == "events":
            done = yield from self._feed_by_count(engine, events, latest)
        if done < len(events):
            yield from self._feed_at_once(engine, events[done:], latest[done:])

    def _trace(
        self, engine: Engine, events: Events, latest: NDArray[np.int64]
    ) -> Generator[EmissionBatch, None, int]:
        """One emission an event, until all are done or other items wait; returns how many were followed.

        Some events at a time, because that many calls from Python would cost far more.
        """
        start, before = 0, self._stats.events
        current = self.classifier
        classifier = current.linear if current else None
        rows = _TRACED
        if self.keep_features:
            rows = min(rows, max(_TRACED_BYTES // (4 * self.encoder.n_features), 1))
        self._state.forget_due()
        while start < len(events) and not self._is_behind(self._log_time_ns):
            traced = slice(start, min(start + rows, len(events)))
            found = engine.trace(
                events[traced],
                classifier.folded if classifier else None,
                keep_features=self.keep_features,
            )
            times = latest[traced]
            self._state.take(0, int(times[-1]))
            features = found.features if self.keep_features else np.zeros((len(times), 0), np.float32)
            scores = classifier.emitted_after(found.scores) if classifier else found.scores
            yield self._batch(times + 1, before + found.accepted, features, scores)
            self._state.unread = 0
            start = traced.stop
        return start

    def _batch(
        self,
        t_us: NDArray[np.int64],
        n_events: NDArray[np.int64],
        features: NDArray[np.float32],
        scores: NDArray[np.float32],
        *,
        final: bool = False,
    ) -> EmissionBatch:
        t_us, incomplete = self._state.emit(t_us)
        self._stats.emissions += len(t_us)
        self._stats.incomplete += int(np.count_nonzero(incomplete))
        return EmissionBatch(
            t_us=t_us,
            n_events=n_events,
            features=features,
            labels=self._classifier.labels if self._classifier else (),
            scores=scores,
            incomplete=incomplete,
            sample=self._state.sample,
            final=final,
            topic=self._topic,
            source_ns=self._source_ns,
            active_volumes=self._active_volumes(),
        )

    def _active_volumes(self) -> int | None:
        """Counting them is nothing beside an emission, but much beside one event."""
        return self._engine.active_volumes if self._engine and not self._every_event else None

    def _feed_at_once(
        self, engine: Engine, events: Events, latest: NDArray[np.int64]
    ) -> Iterator[EmissionBatch]:
        self._take(engine, events, latest)
        self._state.forget_due()
        now = self._clock()
        if now >= self._rest_until:
            yield self._emit(engine, self._state.last_us + 1)
            spent = self._clock() - now
            self._rest_until = now + spent * (1 + _AUTO_REST)

    def _feed_by_count(
        self, engine: Engine, events: Events, latest: NDArray[np.int64]
    ) -> Generator[EmissionBatch, None, int]:
        """Feed and emit until all are done, or other items wait; returns how many were fed."""
        start = 0
        self._state.forget_due()
        while start < len(events) and not self._is_behind(self._log_time_ns):
            stop = min(start + max(self.policy.every - self._state.unread, 1), len(events))
            self._take(engine, events[start:stop], latest[start:stop])
            start = stop
            if self._state.unread >= self.policy.every:
                yield self._emit(engine, self._state.last_us + 1)
        return start

    def _feed_by_time(
        self, engine: Engine, events: Events, latest: NDArray[np.int64]
    ) -> Generator[EmissionBatch, None, int]:
        """Feed and emit until all are done, or other items wait; returns how many were fed."""
        start = 0
        while start < len(events) and not self._is_behind(self._log_time_ns):
            due = self._state.due(int(latest[start]), self._window_us)
            stop = int(np.searchsorted(latest, due))
            if stop > start:
                self._take(engine, events[start:stop], latest[start:stop])
                start = stop
            else:
                yield self._emit(engine, due)
                self._state.pass_due(due)
        return start

    def _take(self, engine: Engine, events: Events, latest: NDArray[np.int64]) -> None:
        engine.feed(events)
        self._state.take(len(events), int(latest[-1]))

    def _emit(self, engine: Engine, t_us: int, *, final: bool = False) -> EmissionBatch:
        engine.advance(t_us - 1)
        features = engine.features()[np.newaxis]
        self._state.unread = 0
        classifier, n_events = self.classifier, self._stats.events + engine.n_events
        scores = classifier.emitted(features) if classifier else np.zeros((1, 0), np.float32)
        times = np.array([t_us], np.int64)
        return self._batch(times, np.array([n_events], np.int64), features, scores, final=final)

    def _finish_sample(self) -> Iterator[EmissionBatch]:
        sample = self._state.sample
        if sample is None:
            return
        self._stats.samples += 1
        engine = self._engine or self._engine_for(self.encoder.geometry.smallest)
        batch = self._emit(engine, sample.start_us + sample.duration_us, final=True)
        emission = batch[0]
        if emission.correct and self._stats.correct is not None:
            self._stats.correct += 1
        if self.learner:
            if sample.label in self.learner.classifier.labels:
                self.learner.learn_one(emission.features, sample.label)
            else:
                self._stats.unknown_labels += 1
        self._state.close_sample()
        yield batch


def _add_engine(stats: SessionStats, engine: Engine) -> None:
    seen = engine.stats()
    for name in ("events", "late", "rejected", "saturated"):
        setattr(stats, name, getattr(stats, name) + getattr(seen, name))
