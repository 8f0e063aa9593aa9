"""The stopwatch: a compiled loop that reads a clock between events.

Lives here: the clock of compiled code, and the loop over events of ours.
Not here: kernels themselves, which know no clock; the loops of others (`others`).

A call from Python costs many times what an update costs, so the loop over events is compiled, and reads
`clock_gettime(CLOCK_MONOTONIC)` after each. What lies between two readings is one update, the cost of
reading the clock once, and two stores; nothing is subtracted. The pointer to the clock is of this
process, so the loop is compiled in each (cached code could not be found again).
"""

import ctypes
import time

import numpy as np
from numba import njit
from numpy.typing import NDArray

from streamfeat.engine.engine import Engine
from streamfeat.events import Events
from streamfeat.kernels.follow import follow
from streamfeat.kernels.layout import BEFORE_TIME, CLOCK_NOW, Operator, State

__all__ = ["clock_cost_ns", "follow_timed", "now", "python_clock_cost_ns"]

_MONOTONIC = time.CLOCK_MONOTONIC
_clock_gettime = ctypes.CDLL(None).clock_gettime
_clock_gettime.argtypes = (ctypes.c_int, ctypes.c_void_p)
_clock_gettime.restype = ctypes.c_int

Stamps = NDArray[np.int64]


def follow_timed(engine: Engine, events: Events) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Do what `engine.follow(events)` does, and tell how long each event took.

    Args:
        engine: left as `follow` leaves it.
        events: `(n,)` EVENT_DTYPE, contiguous and writeable, not changed.

    Returns:
        nanoseconds from handing over an event until the pooled sums that features are read from are
        current, `(n,)` int64; and whether the event began a new bin, `(n,)` bool. The first event of an
        empty engine begins none, for there is nothing yet to move on.
    """
    ns, begins_bin = _followed(engine, events)
    for _, scale in engine._further:  # scale after scale, so an event took what it took in each
        ns = ns + _followed(scale, events)[0]
    return ns, begins_bin


def _followed(engine: Engine, events: Events) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The same for one scale."""
    engine.features()  # brings the engine up to date, as `follow` does once for each call
    stamps, bins = np.empty((2, len(events) + 1), np.int64)
    _walk(
        events,
        engine._operator,
        engine._state,
        np.empty(2, np.int64),
        stamps,
        bins,
    )
    return np.diff(stamps), (np.diff(bins) > 0) & (bins[:-1] > BEFORE_TIME)


def clock_cost_ns(reads: int = 20_000) -> float:
    """Nanoseconds between two readings of the clock with nothing in between: the median."""
    stamps = np.empty(reads + 1, np.int64)
    _tick(np.empty(2, np.int64), stamps)
    return float(np.median(np.diff(stamps)))


def python_clock_cost_ns(reads: int = 20_000) -> float:
    """The same for `time.monotonic_ns`, which is the same clock read from Python."""
    stamps = [time.monotonic_ns() for _ in range(reads + 1)]
    return float(np.median(np.diff(stamps)))


@njit(nogil=True)
def now(timespec: Stamps) -> int:
    """Nanoseconds of the monotonic clock; `timespec` is room for two integers."""
    _clock_gettime(_MONOTONIC, timespec.ctypes)
    return timespec[0] * 1_000_000_000 + timespec[1]  # type: ignore[no-any-return]


@njit(nogil=True)
def _tick(timespec: Stamps, stamps: Stamps) -> None:
    for i in range(stamps.shape[0]):
        stamps[i] = now(timespec)


@njit(nogil=True)
def _walk(
    events: Events,
    operator: Operator,
    state: State,
    timespec: Stamps,
    stamps: Stamps,
    bins: Stamps,
) -> None:
    bins[0] = state.clock[CLOCK_NOW]
    stamps[0] = now(timespec)
    for i in range(events.shape[0]):
        follow(events[i : i + 1], operator, state)
        bins[i + 1] = state.clock[CLOCK_NOW]
        stamps[i + 1] = now(timespec)
