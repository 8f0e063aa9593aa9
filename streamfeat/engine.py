"""The engine: all streaming state of one sensor, and the rules for changing it.

Lives here: feeding events, moving stream time, reading features, snapshots. Synchronous and exact.
Not here: clocks, I/O, logging, asyncio, labels, classifiers. Time comes from events and `advance` only.

Feeding touches counts alone, so it never waits for the filters; reading brings projections, codes and
pooled sums up to date with whatever has changed since. What is read depends on the events and on stream
time, never on how often it was read or how the stream was cut into batches.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from streamfeat.encoder import Encoder
from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE, Events, Resolution
from streamfeat.kernels.ingest import advance_to_bin, count_events
from streamfeat.kernels.layout import (
    BEFORE_TIME,
    CLOCK_NOW,
    CLOCK_ORIGIN,
    FIXED_POINT_ONE,
    MOMENT_SQUARES,
)
from streamfeat.kernels.update import encode_volume, update
from streamfeat.state import allocate_state, read_features

__all__ = ["Engine", "EngineStats", "Snapshot"]


@dataclass(frozen=True, slots=True)
class EngineStats:
    """What an engine has seen.

    Attributes:
        events: accepted and counted.
        late: older than the window; they changed nothing.
        rejected: outside the sensor, polarity not 0 or 1, or time beyond 2^62; they changed nothing.
        saturated: accepted, but the clipped count stayed as it was.
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


@dataclass(frozen=True, slots=True)
class Snapshot:
    """All that an engine needs to go on as if nothing had happened.

    Attributes:
        counts: `(T, H, W)` int32, the ring.
        atoms: `(V, K)` float32, lasso codes to start from (inverse formulation; else `(V, 0)`).
        clock: `(2,)` int64, current bin and origin in microseconds.
        tally: `(6,)` int64, what was counted.
    """

    counts: NDArray[np.int32]
    atoms: NDArray[np.float32]
    clock: NDArray[np.int64]
    tally: NDArray[np.int64]


class Engine:
    """Turns a stream of events into features, exactly.

    Args:
        encoder: the frozen encoder.
        resolution: `(height, width)` of the sensor.
        origin_us: stream time at which bin 0 starts.

    Raises:
        InputError: the sensor has no place for a single volume.
    """

    def __init__(self, encoder: Encoder, resolution: Resolution, *, origin_us: int = 0) -> None:
        """Allocate everything; nothing is allocated later but the copies that are handed out."""
        self.encoder = encoder
        self.resolution = resolution
        self.grid_shape = encoder.geometry.grid_shape(resolution)
        self._state = allocate_state(encoder.geometry, encoder.operator, resolution, origin_us=origin_us)
        self._encoded = 0

    def feed(self, batch: Events) -> None:
        """Count the events of a batch. Exact, whatever the order, and cheap.

        Args:
            batch: `(n,)` EVENT_DTYPE, not changed. Any content: what cannot be used is counted in
                `stats()` as `late` or `rejected`.

        Raises:
            InputError: not an array of EVENT_DTYPE.
        """
        if not isinstance(batch, np.ndarray) or batch.dtype != EVENT_DTYPE or batch.ndim != 1:
            raise InputError(f"a batch must be a one-dimensional array of {EVENT_DTYPE}")
        if not (batch.flags.writeable and batch.flags.c_contiguous):
            batch = batch.copy()  # one compiled kernel serves all, and a copy costs about 1 ns an event
        height, width = self.resolution
        count_events(batch, height, width, self.encoder.operator, self._state)

    def advance(self, t_us: int) -> None:
        """Let stream time pass without events. Going back in time does nothing.

        Args:
            t_us: the bin of this time becomes the current one.

        Raises:
            InputError: the time is beyond 2^62 microseconds.
        """
        if not BEFORE_TIME < t_us < -BEFORE_TIME:
            raise InputError(f"a time of {t_us} us is beyond 2^62")
        origin = int(self._state.clock[CLOCK_ORIGIN])
        advance_to_bin((int(t_us) - origin) // self.encoder.geometry.bin_us, self._state)

    def features(self) -> NDArray[np.float32]:
        """The pooled codes of the current window, a copy: `(n_features,)` float32."""
        self._update()
        return read_features(self.encoder.operator, self._state)

    def codes(self) -> NDArray[np.float32]:
        """The code of every local volume, a copy: `(rows, columns, K)` float32, before any split."""
        self._update()
        state, operator = self._state, self.encoder.operator
        rows, columns = self.grid_shape
        codes = np.empty((rows * columns, operator.n_filters), np.float32)
        for volume in range(rows * columns):
            encode_volume(
                state.projections[volume],
                state.moments[volume],
                state.atoms[volume],
                False,
                operator,
                state,
            )
            codes[volume] = state.code[: operator.n_filters] / FIXED_POINT_ONE
        return codes.reshape(rows, columns, operator.n_filters)

    def stats(self) -> EngineStats:
        """Counts since the engine was made (or since the snapshot that was restored)."""
        events, late, rejected, saturated, rolls = (int(value) for value in self._state.tally)
        active = int(np.count_nonzero(self._state.moments[:, MOMENT_SQUARES]))
        return EngineStats(events, late, rejected, saturated, rolls, active, self._encoded)

    def restart(self, origin_us: int) -> None:
        """Forget every event and start bin 0 at `origin_us`; what was counted so far stays counted."""
        state = self._state
        for array in (state.counts, state.applied, state.is_touched, state.projections, state.moments):
            array[:] = 0
        state.atoms[:] = 0
        state.pooled[:] = 0
        state.clock[:] = (BEFORE_TIME, BEFORE_TIME, 0, origin_us)

    def snapshot(self) -> Snapshot:
        """Copy the state. Projections and codes are not part of it: they follow from the counts."""
        state = self._state
        return Snapshot(
            counts=state.counts.copy(),
            atoms=state.atoms.copy(),
            clock=state.clock[[CLOCK_NOW, CLOCK_ORIGIN]],
            tally=np.append(state.tally, self._encoded),
        )

    def restore(self, snapshot: Snapshot) -> None:
        """Go on from a snapshot of an engine with the same encoder and resolution.

        Raises:
            InputError: the snapshot is of another geometry.
        """
        state = self._state
        if snapshot.counts.shape != state.counts.shape or snapshot.atoms.shape != state.atoms.shape:
            raise InputError(
                f"the snapshot holds a ring of {snapshot.counts.shape} and codes of {snapshot.atoms.shape}, "
                f"this engine has {state.counts.shape} and {state.atoms.shape}"
            )
        self.restart(int(snapshot.clock[1]))
        state.counts[:] = snapshot.counts
        state.atoms[:] = snapshot.atoms
        state.clock[CLOCK_NOW] = snapshot.clock[0]
        state.tally[:] = snapshot.tally[:-1]
        self._encoded = int(snapshot.tally[-1])

    def _update(self) -> None:
        if self._state.clock[CLOCK_NOW] > BEFORE_TIME:
            self._encoded += update(self.grid_shape, self.encoder.operator, self._state)
