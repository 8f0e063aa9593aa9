"""Random local volumes of unlabelled recordings.

Lives here: cutting a recording into windows, drawing volumes from them, keeping a fair sample.
Not here: whitening and learning.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from streamfeat.engine.geometry import Geometry
from streamfeat.engine.window import count_window
from streamfeat.events import Events, Resolution
from streamfeat.recordings.reader import HELD_OUT_SPLITS, Label, Packet

__all__ = ["KEYS", "Volumes", "Window", "sample_volumes", "windows_of"]

KEYS = 1 << 63
"""Keys are below."""

_PER_WINDOW = 4096
"""Volumes that one window gives at most: enough to learn from a recording of a second."""

_TRIES = 4
"""Places that are drawn for a volume until one is not empty."""

_SHOWN = 64
"""First tries of each window that the share of empty places is told from."""


@dataclass(frozen=True, slots=True)
class Window:
    """Events of one accumulation interval: `origin_us` is the start of its first bin."""

    events: Events
    resolution: Resolution
    origin_us: int
    last_us: int


@dataclass(frozen=True, slots=True)
class Volumes:
    """Local volumes drawn from some windows, each with a random key.

    Those of the smallest keys are a fair sample, in however many parts and wherever windows are read
    (bottom-k sampling, Cohen and Kaplan 2007).

    Attributes:
        keys: `(n,)` ascending.
        counts: `(n, d)` clipped counts, bin-major; int8, or int16 where `max_count` asks for it.
        drawn: places that were looked at to tell how many are empty, some of each window.
        empty: of them, those whose counts were all zero.
        windows: how many windows were seen.
    """

    keys: NDArray[np.int64]
    counts: NDArray[np.signedinteger]
    drawn: int
    empty: int
    windows: int

    @classmethod
    def none(cls, geometry: Geometry) -> Self:
        """No volume of no window."""
        counts = np.empty((0, geometry.entries), np.min_scalar_type(-geometry.max_count))
        return cls(np.empty(0, np.int64), counts, 0, 0, 0)

    def with_others(self, others: Sequence["Volumes"], n: int) -> "Volumes":
        """All together, but no more than `n`."""
        parts = [self, *others]
        keys = np.concatenate([part.keys for part in parts])
        least = np.argsort(keys, kind="stable")[:n]
        counts = np.concatenate([part.counts for part in parts])[least]
        sums = (sum(getattr(part, name) for part in parts) for name in ("drawn", "empty", "windows"))
        return Volumes(keys[least], counts, *sums)

    @property
    def empty_share(self) -> float:
        """Share of the drawn places whose counts were all zero."""
        return self.empty / max(self.drawn, 1)


def windows_of(items: Iterable[Packet | Label], geometry: Geometry) -> Iterator[Window]:
    """Cut the items of a recording into windows.

    A labelled sample gives one window, which ends with the sample; samples of a held-out split
    (validation, test) are passed over. Without labels a window begins with the first event that the one
    before does not reach, wherever packets end. Where the camera's clock starts anew, so does a window.

    Args:
        items: packets and labels in stored order, as `Recording.items` gives them.
        geometry: bins of the window.
    """
    label: Label | None = None
    pending: list[Events] = []
    resolution: Resolution = (0, 0)
    origin = epoch = 0

    def window() -> Iterator[Window]:
        if pending and not (label and label.split in HELD_OUT_SPLITS):
            last = label.start_us + label.duration_us - 1 if label else origin + geometry.window_us - 1
            yield Window(np.concatenate(pending), resolution, origin, last)
        pending.clear()

    for item in items:
        if isinstance(item, Label):
            yield from window()
            label, origin = item, item.start_us
        elif len(item.events):
            if (item.resolution, item.epoch) != (resolution, epoch):
                yield from window()
                resolution, epoch = item.resolution, item.epoch
            rest = item.events
            while label is None and len(rest):
                first = int(rest["t"][0])
                if not (pending and origin <= first < origin + geometry.window_us):
                    yield from window()
                    origin = first
                latest = np.maximum.accumulate(rest["t"])
                end = int(np.searchsorted(latest, origin + geometry.window_us))
                pending.append(rest[:end])
                rest = rest[end:]
            if len(rest):
                pending.append(rest)
    yield from window()


def sample_volumes(
    windows: Iterable[Window],
    geometry: Geometry,
    n_volumes: int,
    seed: Sequence[int],
    *,
    limit: int = KEYS,
    per_window: int = _PER_WINDOW,
    padded: bool = False,
) -> Volumes:
    """Draw local volumes at random places, each not empty, with equal chance for every window.

    From each window at most `per_window` places are kept, and only those looked at whose keys are small
    enough to be kept. What is drawn from a window depends on `seed`, on when it
    begins and on how many events it has, and on nothing that was read before.

    Args:
        windows: any number of windows.
        geometry: of the volumes.
        n_volumes: keep no more than those of the smallest keys; memory is for four times as many.
        seed: not negative; the seed, and what tells recordings apart.
        limit: keep only keys below.
        per_window: places to keep from each window.
        padded: whether a sensor that is smaller than a volume has one, with pixels that never fire; its
            windows are passed over otherwise.
    """
    kept = Volumes.none(geometry)
    waiting: list[Volumes] = []
    n_waiting = 0
    for window in windows:
        if not (padded or geometry.has_room(window.resolution)):
            continue
        one = _draw_from(window, geometry, seed, limit, per_window)
        waiting.append(one)
        n_waiting += len(one.keys) + 1
        if n_waiting > max(n_volumes, 4 * per_window):
            kept, waiting, n_waiting = kept.with_others(waiting, n_volumes), [], 0
            if len(kept.keys) == n_volumes:
                limit = min(limit, int(kept.keys[-1]))
    return kept.with_others(waiting, n_volumes)


def _draw_from(
    window: Window, geometry: Geometry, seed: Sequence[int], limit: int, per_window: int
) -> Volumes:
    origin = window.origin_us % (1 << 64)  # a generator's seed is not negative
    rng = np.random.default_rng([*seed, origin, len(window.events)])
    counts = count_window(geometry, window.events, window.resolution, window.origin_us, window.last_us)
    places = sliding_window_view(counts, geometry.volume_shape)
    keys = rng.integers(0, KEYS, per_window)
    tries = (_TRIES, per_window)
    rows, columns = rng.integers(0, places.shape[1], tries), rng.integers(0, places.shape[2], tries)
    # A window of one volume takes no number from the generator.
    bins = rng.integers(0, places.shape[0], tries) if places.shape[0] > 1 else np.zeros(tries, np.int64)

    def cut(tried: int, wanted: NDArray[np.int64]) -> NDArray[Any]:
        found: NDArray[Any] = places[bins[tried, wanted], rows[tried, wanted], columns[tried, wanted]]
        return found.reshape(len(wanted), geometry.entries)

    shown = np.arange(min(per_window, _SHOWN))
    n_empty = int(np.count_nonzero(~cut(0, shown).any(axis=1)))
    below = np.flatnonzero(keys < limit)
    volumes = cut(0, below)
    for tried in range(1, _TRIES):
        empty = np.flatnonzero(~volumes.any(axis=1))
        volumes[empty] = cut(tried, below[empty])
    filled = volumes.any(axis=1)
    kind = np.min_scalar_type(-geometry.max_count)
    return Volumes(keys[below[filled]], volumes[filled].astype(kind), len(shown), n_empty, 1)
