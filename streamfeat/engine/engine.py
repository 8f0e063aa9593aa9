"""The engine: all streaming state of one sensor, and the rules for changing it.

Lives here: feeding events, moving stream time, reading features, snapshots. Synchronous and exact.
Not here: clocks, I/O, logging, asyncio, labels, classifiers. Time comes from events and `advance` only.

Feeding touches counts alone, so it never waits for the filters; reading brings projections, codes and
pooled sums up to date with whatever has changed since. What is read depends on the events and on stream
time, never on how often it was read or how the stream was cut into batches.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.operator import n_features, with_fixed_point
from streamfeat.engine.past import Past
from streamfeat.engine.snapshot import Snapshot, check_further, check_snapshot, checked_time
from streamfeat.engine.state import allocate_state, clear_state, enter_counts
from streamfeat.engine.threads import Crew, one_thread
from streamfeat.engine.trace import Trace, joined, trace_events
from streamfeat.engine.update import is_complete, is_little, is_worth_sharing, update_plane
from streamfeat.events import Events, Resolution, as_events
from streamfeat.kernels.encode import encode_volume
from streamfeat.kernels.follow import follow
from streamfeat.kernels.ingest import advance_to_bin, count_events
from streamfeat.kernels.lasso import CODE
from streamfeat.kernels.layout import (
    CLOCK_NOW,
    CLOCK_ORIGIN,
    CLOCK_PLANE,
    CLOCK_SLOT,
    MOMENT_SQUARES,
    TALLY_EVENTS,
    State,
)
from streamfeat.kernels.planes import look_ahead
from streamfeat.kernels.predict import Weights
from streamfeat.kernels.update import read
from streamfeat.report.shown import Shown

__all__ = ["Engine", "EngineStats"]


@dataclass(frozen=True, slots=True)
class EngineStats:
    """What an engine has seen.

    Attributes:
        events: accepted and counted.
        late: older than the window; they changed nothing.
        rejected: outside the sensor, polarity not 0 or 1, or time beyond 2^62; they changed nothing.
        saturated: accepted, but the clipped count stayed as it was; in the first scale, as all of the above.
        rolls: bins that stream time has moved on by.
        active_volumes: volumes that were not empty when features were last read.
        encoded_volumes: volumes encoded so far, a measure of the work done.
    """

    events: int
    late: int
    rejected: int
    saturated: int
    rolls: int
    active_volumes: int
    encoded_volumes: int


class Engine(Shown):
    """Turns a stream of events into features, exactly.

    Args:
        encoder: the frozen encoder.
        resolution: `(height, width)` of the sensor.
        origin_us: stream time at which bin 0 starts.
        look_ahead: prepare each bin boundary beforehand, in slices: with every event that is followed, and
            in `prepare`. Costs a second copy of the projections; for those who read after single events.
        threads: that share the work of a large emission; features have the same bits for any number.

    Raises:
        InputError: the sensor has so many volumes that sums could overflow; the
            origin is beyond 2^62 microseconds; or threads are not 1 to 256.
    """

    def __init__(
        self,
        encoder: Encoder,
        resolution: Resolution,
        *,
        origin_us: int = 0,
        look_ahead: bool = False,
        threads: int = 1,
    ) -> None:
        """Allocate everything; nothing is allocated later but the copies that are handed out."""
        self.encoder = encoder
        self.resolution = resolution
        self.grid_shape = encoder.geometry.grid_shape(resolution)
        self._crew = Crew(threads)
        geometry, origin = encoder.geometry, checked_time(origin_us)
        operator = with_fixed_point(encoder.operator, self.grid_shape, len(geometry.ages))
        planes = 2 if look_ahead else 1
        self._operator = operator
        self._state = allocate_state(
            geometry.newest, operator, resolution, origin_us=origin, planes=planes, threads=threads
        )
        self._past = Past(geometry, operator, resolution, origin) if len(geometry.ages) > 1 else None
        self._further = [
            (place, Engine(scale, resolution, origin_us=origin_us, look_ahead=look_ahead, threads=threads))
            for place, scale in zip(encoder.places[1:], encoder.further, strict=True)
        ]

    @one_thread
    def feed(self, batch: Events) -> None:
        """Count the events of a batch. Exact, whatever the order, and cheap.

        Args:
            batch: `(n,)` EVENT_DTYPE, not changed; or a structured array of another tool, which is converted
                (see `as_events`). Any content: what cannot be used is counted in `stats()` as `late` or
                `rejected`.

        Raises:
            InputError: not such an array, or one whose polarities mean nobody knows what.
        """
        events = self._checked(batch)
        for run in self._runs(events, singly=False):
            count_events(run, self._operator, self._state)
        for _, scale in self._further:
            scale.feed(events)

    @one_thread
    def follow(self, batch: Events) -> None:
        """Feed a batch event by event, with features brought up to date after each.

        Leaves the engine as `feed` and a reading would. Costs more for many events, and less for one.

        Args:
            batch: as for `feed`.

        Raises:
            InputError: as for `feed`.
        """
        events = self._checked(batch)
        for run in self._runs(events, singly=True):
            self._update()
            follow(run, self._operator, self._state)
        for _, scale in self._further:
            scale.follow(events)

    @one_thread
    def trace(self, batch: Events, weights: Weights | None = None, *, keep_features: bool = True) -> Trace:
        """Feed a batch event by event, and read features and scores after each.

        Args:
            batch: as for `feed`, `n` events.
            weights: of a linear classifier for these features; no scores without.
            keep_features: whether features are wanted, or scores alone: copying them takes time.

        Raises:
            InputError: as for `feed`.
        """
        events = self._checked(batch)
        if not self.encoder.further:
            return self._traced(events, weights, keep_features=keep_features)
        first = self._traced(events, None)
        scales = [(place, scale.trace(events)) for place, scale in self._further]
        return joined(first, scales, self.encoder.n_features, weights, keep_features=keep_features)

    def _traced(self, events: Events, weights: Weights | None, *, keep_features: bool = True) -> Trace:
        """The trace of the first scale."""
        found = []
        for run in self._runs(events, singly=True):
            self._update()
            one = trace_events(run, self._operator, self._state, weights, keep_features=keep_features)
            if self._past and len(run):  # whose volumes see only a part of the events
                one.accepted[:] += self.n_events - one.accepted[-1]
            found.append(one)
        return found[0] if len(found) == 1 else Trace(*map(np.concatenate, zip(*found, strict=True)))

    def _runs(self, events: Events, *, singly: bool) -> Iterator[Events]:
        """The events of a batch; where volumes are shorter than the window, bin by bin (see `Past.cut`)."""
        if self._past is None:
            yield events
            return
        for run in self._past.cut(events, singly=singly):
            self._turn_to(run.bin)
            self._past.count(run)
            yield run.events

    def _turn_to(self, new: int) -> None:
        """Make a bin the current one, if it is later; all events of the bins before are in."""
        if new <= self._state.clock[CLOCK_NOW]:
            return
        if self._past:
            if is_complete(self._operator, self._state):
                update_plane(self._operator, self._state, self._crew)
                self._past.keep(self._state)
            self._past.advance(new)
        advance_to_bin(new, self._operator, self._state)

    @one_thread
    def prepare(self, columns: int) -> bool:
        """Use idle time to look ahead to the next bin boundary; without `look_ahead`, for a short update.

        Not with the inverse formulation, whose codes depend on when they are solved, within their gap.

        Args:
            columns: operator columns that may be added to look ahead, a bound of the work, for each scale.

        Returns:
            whether nothing is left to prepare.
        """
        if len(self._state.cursors) == 1:  # there is no plane that could look ahead
            if not self._operator.inverse and is_little(self._operator, self._state):
                self._update()
            return all(scale.prepare(columns) for _, scale in self._further)
        self._update()
        volumes = self.grid_shape[0] * self.grid_shape[1]
        left = look_ahead(volumes, volumes, columns, self._operator, self._state)
        return bool(left > 0) and all(scale.prepare(columns) for _, scale in self._further)

    def _update(self) -> None:
        """Bring the current plane up to date."""
        update_plane(self._operator, self._state, self._crew)
        if self._past:
            self._past.add(self._state)

    @staticmethod
    def _checked(batch: Events) -> Events:
        events = as_events(batch)
        if not (events.flags.writeable and events.flags.c_contiguous):
            return events.copy()  # one compiled kernel serves all, and a copy costs about 1 ns an event
        return events

    @one_thread
    def advance(self, t_us: int) -> None:
        """Let stream time pass without events. Going back in time does nothing.

        Args:
            t_us: the bin of this time becomes the current one.

        Raises:
            InputError: the time is beyond 2^62 microseconds.
        """
        since = checked_time(t_us) - int(self._state.clock[CLOCK_ORIGIN])
        self._turn_to(since // self._operator.bin_us)
        for _, scale in self._further:
            scale.advance(t_us)

    @one_thread
    def features(self) -> NDArray[np.float32]:
        """The pooled codes of the current window, a copy: `(n_features,)` float32."""
        if self._past or is_worth_sharing(self._operator, self._state, self._crew):
            self._update()
        features = np.zeros(self.encoder.n_features, np.float32)
        read(self._operator, self._state, features[: n_features(self._operator)])
        for place, scale in self._further:
            features[place] = scale.features()
        return features

    @one_thread
    def codes(self) -> NDArray[np.float32]:
        """Codes of the first scale's volumes that end now, `(rows, columns, K)` float32, before any split."""
        self._update()
        state, operator = self._state, self._operator
        plane = state.clock[CLOCK_PLANE]
        rows = zip(state.projections[plane], state.moments[plane], state.atoms[plane], strict=True)
        codes = np.empty((len(state.moments[plane]), operator.n_filters), np.float32)
        worth = 1 / operator.unit if operator.steps is None else operator.steps
        for code, (projection, moments, atoms) in zip(codes, rows, strict=True):
            encode_volume(projection, moments, atoms, False, 0, operator, state)
            code[:] = (state.code[0, 0] * worth)[: operator.n_filters]
        return codes.reshape(*self.grid_shape, operator.n_filters)

    @one_thread
    def counts(self) -> NDArray[np.int32]:
        """The signed counts of the current window in the first scale's ring, a copy: `(n_bins, H, W)` int32,
        the oldest bin first, not clipped.
        """
        return np.roll(self._window.counts, -1 - int(self._window.clock[CLOCK_SLOT]), axis=0)

    @property
    def _window(self) -> State:
        """The state that holds the counts of the whole window, and the tally."""
        return self._past.window if self._past else self._state

    @one_thread
    def activity(self) -> NDArray[np.int64]:
        """The sum of squared entries of each local volume of the first scale that ends with the current bin.

        A copy, `(rows, columns)` int64; 0 is empty.
        """
        self._update()
        squares = self._state.moments[self._state.clock[CLOCK_PLANE], :, MOMENT_SQUARES]
        return squares.reshape(self.grid_shape).copy()

    @property
    def window_us(self) -> tuple[int, int]:
        """Stream time at which the oldest bin starts, and at which the current one ends."""
        now, origin = int(self._state.clock[CLOCK_NOW]), int(self._state.clock[CLOCK_ORIGIN])
        end = origin + (now + 1) * self._operator.bin_us
        return end - self.encoder.geometry.window_us, end

    @property
    def n_events(self) -> int:
        """Events accepted and counted, as in `stats()`."""
        return int(self._window.tally[TALLY_EVENTS])

    @property
    def active_volumes(self) -> int:
        """Volumes of all scales that were not empty when features were last read, as in `stats()`."""
        squares = self._state.moments[self._state.clock[CLOCK_PLANE], :, MOMENT_SQUARES]
        return int(np.count_nonzero(squares)) + sum(scale.active_volumes for _, scale in self._further)

    @property
    def _encoded(self) -> int:
        """Volumes of the first scale encoded so far."""
        return int(self._state.encoded.sum()) + (self._past.encoded if self._past else 0)

    def stats(self) -> EngineStats:
        """Counts since the engine was made (or since the snapshot that was restored)."""
        events, late, rejected, saturated, rolls = (int(value) for value in self._window.tally)
        encoded = self._encoded + sum(scale.stats().encoded_volumes for _, scale in self._further)
        return EngineStats(events, late, rejected, saturated, rolls, self.active_volumes, encoded)

    @one_thread
    def restart(self, origin_us: int) -> None:
        """Forget every event and start bin 0 at `origin_us`; what was counted so far stays counted.

        Raises:
            InputError: the origin is beyond 2^62 microseconds.
        """
        origin = checked_time(origin_us)
        clear_state(self._state, origin)
        if self._past:
            self._past.restart(origin)
        for _, scale in self._further:
            scale.restart(origin)

    @one_thread
    def snapshot(self) -> Snapshot:
        """Copy the state. Projections and codes are not part of it: they follow from the counts.

        With the inverse formulation a code follows from the one before it, too, within its gap. So that an
        engine which goes on and one which is restored have the same bits, this one starts again from the
        codes that it gives away: a bin boundary costs as much.
        """
        state = self._state
        atoms = state.atoms[state.clock[CLOCK_PLANE], :, CODE].copy()
        if self._operator.inverse:
            self._update()
            atoms[:] = state.atoms[state.clock[CLOCK_PLANE], :, CODE]
            state.atoms[np.arange(len(state.atoms)) != state.clock[CLOCK_PLANE]] = 0
            state.cursors[:] = 0
            state.pooled[:] = 0
            if self._past:
                self._past.forget()
            self._update()
        return Snapshot(
            fingerprint=self.encoder.fingerprint,
            counts=self._window.counts.copy(),
            atoms=atoms,
            bin=int(state.clock[CLOCK_NOW]),
            origin_us=int(state.clock[CLOCK_ORIGIN]),
            tally=self._window.tally.copy(),
            encoded=np.array([self._encoded, 0]),
            further=tuple(scale.snapshot() for _, scale in self._further),
        )

    def restore(self, snapshot: Snapshot) -> None:
        """Go on from a snapshot of an engine with the same encoder and resolution.

        Arrays and numbers may come from anywhere: nothing that was not checked gets to a kernel.

        Raises:
            InputError: the snapshot is of another encoder or another resolution, or of no engine at all;
                nothing has changed.
        """
        self._check(snapshot)
        state, operator = self._state, self._operator
        codes = state.atoms[0, :, CODE]  # a restart begins with plane 0
        self.restart(snapshot.origin_us)
        enter_counts(snapshot.counts, snapshot.bin, operator, self._window)
        if self._past:
            enter_counts(self._past.newest_counts(), snapshot.bin, operator, state)
        codes[:] = snapshot.atoms
        # Before time moves on: lasso codes are kept of volumes only that are not empty.
        update_plane(operator, state, self._crew)
        codes[state.moments[0, :, MOMENT_SQUARES] == 0] = 0
        self._window.tally[:] = snapshot.tally
        state.encoded[:] = 0
        state.encoded[0] = snapshot.encoded.sum() - (self._past.encoded if self._past else 0)
        for (_, scale), further in zip(self._further, snapshot.further, strict=True):
            scale.restore(further)

    def _check(self, snapshot: Snapshot) -> None:
        check_snapshot(snapshot, self.encoder.fingerprint, self._operator, self._state, self._window.counts)
        check_further(snapshot, len(self._further))
        for (_, scale), further in zip(self._further, snapshot.further, strict=True):
            scale._check(further)
