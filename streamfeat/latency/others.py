"""Update latency of the methods of others: what one event costs them.

Lives here: for each method a compiled loop that reads the clock after each event, as `stopwatch` has.
Not here: the methods (`streamfeat.evaluate`) and their kernels.

What is timed is all that keeps the numbers current from which features are read: surfaces and the sums of
their cells, neurons and the counts of their spikes, the nearest prototype and its histogram. Scaling at the
time of reading is left out, as a copy of the pooled sums is for an engine. A label starts an empty state.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.evaluate.retina import RetinalWords
from streamfeat.evaluate.spiking import FirstSpikes, LeakySpikes
from streamfeat.evaluate.surfaces import (
    HOTS_LAYERS,
    AveragedSurfaces,
    CountImage,
    SurfaceHistogram,
    SurfaceLayer,
)
from streamfeat.events import Events, Resolution, is_valid
from streamfeat.kernels.retina import describe_events
from streamfeat.kernels.spiking import spike_first, spike_leaky
from streamfeat.kernels.surfaces import add_memory_surfaces, time_surfaces
from streamfeat.latency.stopwatch import Stamps, now
from streamfeat.recordings.reader import Label, Packet

__all__ = ["TIMED", "Live", "Method", "any_layers", "any_words", "walk_method"]

_CHUNK = 256
_WORDS = 500

Columns = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]


class Live(NamedTuple):
    """A method with the state that events change.

    Attributes:
        timed: takes x, y, p and microseconds since the origin of some events, gives nanoseconds of each.
        features: as a sample that ends now has them, flat; of spiking networks before they are put on a grid.
    """

    timed: Callable[[Columns], Stamps]
    features: Callable[[], NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Method:
    """A method under its name in `evaluate`."""

    name: str

    def __post_init__(self) -> None:
        """Refuse what cannot be timed.

        Raises:
            InputError: there is no such method.
        """
        if self.name not in TIMED:
            raise InputError(f"--method {self.name} is unknown; choose from {', '.join(TIMED)}")

    def describe(self) -> dict[str, Any]:
        """Name and meaning, as JSON values."""
        return {"model": self.name, "method": TIMED[self.name][0]}


def walk_method(
    method: Method, items: Iterable[Packet | Label], *, warm_up: int, goes: Callable[[int], bool]
) -> NDArray[np.int64]:
    """Go through a stream event by event; see `update.walk`.

    Args:
        method: whose update it is.
        items: packets and labels in stream order.
        warm_up: events at the start that are not counted.
        goes: told how many events are done, says whether to go on.

    Returns:
        `(n,)` int64, nanoseconds of each event that lies on the sensor.
    """
    found, done = [np.zeros(0, np.int64)], 0
    for live, columns in _steps(method, items):
        took, skip = live.timed(columns), max(warm_up - done, 0)
        done += len(took)
        found.append(took[skip:])
        if not goes(done):
            break
    return np.concatenate(found)


def _steps(method: Method, items: Iterable[Packet | Label]) -> Iterator[tuple[Live, Columns]]:
    """Chunks of events in stream order, each with the state that they change."""
    make = TIMED[method.name][1]
    live: Live | None = None
    resolution: Resolution | None = None
    origin_us = 0
    for item in items:
        if isinstance(item, Label):
            origin_us, live = item.start_us, None
            continue
        if live is None or resolution != item.resolution:
            resolution = item.resolution
            live = make(resolution)
        events: Events = item.events[is_valid(item.events, resolution) & (item.events["t"] >= origin_us)]
        for start in range(0, len(events), _CHUNK):
            part = events[start : start + _CHUNK]
            x, y, p, t = (part[name].astype(np.int64) for name in "xypt")
            yield live, (x, y, p, t - origin_us)


def _hats(resolution: Resolution) -> Live:
    features = AveragedSurfaces(resolution)
    memory, sums = np.zeros((2, *resolution)), np.zeros(features.shape)
    counts = np.zeros(features.shape[:2], np.int64)

    def timed(columns: Columns) -> Stamps:
        x, y, p, t = columns
        return _told(_walk_hats, x, y, p, t / features.tau_us, features.cell, memory, sums, counts)

    return Live(timed, lambda: (sums / np.maximum(counts, 1)[:, :, None, None, None]).ravel())


def any_layers() -> SurfaceHistogram:
    """Prototypes for HOTS: which they are does not change what it costs to find the nearest."""
    rng = np.random.default_rng(0)
    sizes = ((n, n_in * (2 * radius + 1) ** 2, radius, tau_us) for n, n_in, radius, tau_us in HOTS_LAYERS)
    made = (SurfaceLayer(rng.random((n, d), np.float32), radius, tau_us) for n, d, radius, tau_us in sizes)
    return SurfaceHistogram(tuple(made))


def _hots(resolution: Resolution) -> Live:
    layers = any_layers().layers
    surfaces = tuple(np.empty((1, one.n_polarities, one.side, one.side), np.float32) for one in layers)
    counts = np.zeros((4, len(layers[-1].prototypes)), np.int64)
    state = (
        tuple(one.tau_us for one in layers),
        tuple(one.blank(resolution) for one in layers),
        surfaces,
        tuple(surface.reshape(-1) for surface in surfaces),
        tuple(one.prototypes for one in layers),
        tuple(one.half_squares for one in layers),
    )
    return Live(lambda columns: _told(_walk_hots, *columns, *state, *resolution, counts), counts.ravel)


def any_words() -> NDArray[np.float32]:
    """Words for DART, likewise."""
    return np.random.default_rng(0).dirichlet(np.ones(84), _WORDS).astype(np.float32)


def _dart(resolution: Resolution) -> Live:
    features = RetinalWords(any_words())
    half = np.square(features.words).sum(axis=1) / np.float32(2)
    state, descriptor = features.state(resolution), np.empty((1, features.words.shape[1]), np.float32)
    counts = np.zeros((4, _WORDS), np.int64)

    def timed(columns: Columns) -> Stamps:
        of_words = descriptor, descriptor.reshape(-1), features.words, half, *resolution, counts
        return _told(_walk_dart, *columns[:2], *state, *of_words)

    return Live(timed, counts.ravel)


def _spikes(loop: Any, network: FirstSpikes | LeakySpikes) -> Callable[[Resolution], Live]:
    def make(resolution: Resolution) -> Live:
        clocked, state = network.state(resolution)
        return Live(lambda columns: _told(loop, *columns[:3], clocked(columns[3]), *state), state[-1].ravel)

    return make


def _counts(resolution: Resolution) -> Live:
    grid = CountImage().grid
    counts = np.zeros((2, grid, grid), np.int64)
    return Live(lambda columns: _told(_walk_counts, *columns[:3], *resolution, counts), counts.ravel)


def _told(loop: Any, *arguments: Any) -> Stamps:
    """Nanoseconds of each event of a loop."""
    stamps = np.empty(len(arguments[0]) + 1, np.int64)
    loop(*arguments, np.empty(2, np.int64), stamps)
    return np.diff(stamps)


@njit(nogil=True)
def _walk_hats(x, y, p, t, cell, memory, sums, counts, timespec, stamps):  # type: ignore[no-untyped-def]
    stamps[0] = now(timespec)
    for i in range(len(x)):
        j = i + 1
        add_memory_surfaces(x[i:j], y[i:j], p[i:j], t[i:j], cell, memory, sums)
        counts[y[i] // cell, x[i] // cell] += 1
        stamps[j] = now(timespec)


@njit(nogil=True)
def _nearest(flat, prototypes, half):  # type: ignore[no-untyped-def]
    """The prototype with the largest inner product, less half its square."""
    best, most = 0, np.float32(-np.inf)
    for k in range(prototypes.shape[0]):
        likeness = -half[k]
        for d in range(flat.shape[0]):
            likeness += flat[d] * prototypes[k, d]
        if likeness > most:
            best, most = k, likeness
    return best


@njit(nogil=True)
def _walk_hots(  # type: ignore[no-untyped-def]
    x, y, p, t, taus, latest, surfaces, flat, prototypes, half, height, width, counts, timespec, stamps
):
    polarity, time = np.empty(1, np.int64), np.empty(1)
    stamps[0] = now(timespec)
    for i in range(len(x)):
        j = i + 1
        polarity[0] = p[i]
        for k in range(len(latest)):
            time[0] = t[i] / taus[k]
            time_surfaces(x[i:j], y[i:j], polarity, time, latest[k], surfaces[k])
            polarity[0] = _nearest(flat[k], prototypes[k], half[k])
        counts[2 * (2 * y[i] >= height) + (2 * x[i] >= width), polarity[0]] += 1
        stamps[j] = now(timespec)


@njit(nogil=True)
def _walk_dart(  # type: ignore[no-untyped-def]
    x,
    y,
    places,
    recent,
    queue,
    head,
    descriptor,
    flat,
    words,
    half,
    height,
    width,
    counts,
    timespec,
    stamps,
):
    stamps[0] = now(timespec)
    for i in range(len(x)):
        j = i + 1
        describe_events(x[i:j], y[i:j], places, recent, queue, head, descriptor)
        counts[2 * (2 * y[i] >= height) + (2 * x[i] >= width), _nearest(flat, words, half)] += 1
        stamps[j] = now(timespec)


@njit(nogil=True)
def _walk_first(  # type: ignore[no-untyped-def]
    x, y, p, t, weights, limits, potential, updated, fired, pooled, counts, timespec, stamps
):
    stamps[0] = now(timespec)
    for i in range(len(x)):
        j = i + 1
        spike_first(
            x[i:j], y[i:j], p[i:j], t[i:j], weights, limits, potential, updated, fired, pooled, counts
        )
        stamps[j] = now(timespec)


@njit(nogil=True)
def _walk_leaky(  # type: ignore[no-untyped-def]
    x, y, p, t, weights, threshold, dead, cell, potential, updated, fired, counts, timespec, stamps
):
    stamps[0] = now(timespec)
    for i in range(len(x)):
        j = i + 1
        spike_leaky(
            x[i:j], y[i:j], p[i:j], t[i:j], weights, threshold, dead, cell, potential, updated, fired, counts
        )
        stamps[j] = now(timespec)


@njit(nogil=True)
def _walk_counts(x, y, p, height, width, counts, timespec, stamps):  # type: ignore[no-untyped-def]
    stamps[0] = now(timespec)
    grid = counts.shape[1]
    for i in range(len(x)):
        counts[p[i], y[i] * grid // height, x[i] * grid // width] += 1
        stamps[i + 1] = now(timespec)


TIMED: dict[str, tuple[str, Callable[[Resolution], Live]]] = {
    "hats": ("HATS, surfaces of 7x7 summed in cells of 10x10", _hats),
    "hots": ("HOTS, layers of 4, 8 and 16 prototypes of 2x5x5, 4x9x9 and 8x17x17, by plain loops", _hots),
    "dart": (f"DART, {_WORDS} words of 7x12, 2,000 events remembered, by plain loops", _dart),
    "hfirst": ("HFirst, layers S1 and C1, 12 orientations of 7x7", _spikes(_walk_first, FirstSpikes())),
    "gabor-snn": ("Gabor-SNN, 12 orientations of 7x7", _spikes(_walk_leaky, LeakySpikes())),
    "counts": ("count images of 2x16x16", _counts),
}
"""Each method that can be timed: what it is, and what makes its state."""
