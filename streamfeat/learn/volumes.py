"""Random local volumes of unlabelled recordings.

Lives here: cutting a recording into windows, drawing volumes from them, keeping a fair sample.
Not here: whitening and learning.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution
from streamfeat.geometry import Geometry
from streamfeat.recording import HELD_OUT_SPLITS, Label, Packet
from streamfeat.window import count_window

__all__ = ["Volumes", "Window", "sample_volumes", "windows_of"]


@dataclass(frozen=True, slots=True)
class Window:
    """Events of one accumulation interval: `origin_us` is the start of its first bin."""

    events: Events
    resolution: Resolution
    origin_us: int
    last_us: int


@dataclass(frozen=True, slots=True)
class Volumes:
    """A sample of local volumes.

    Attributes:
        counts: `(n, d)` clipped counts, bin-major; int8, or int16 where `max_count` asks for it.
        empty_share: share of the drawn places whose counts were all zero; they were drawn again.
        windows: how many windows were seen.
    """

    counts: NDArray[np.signedinteger]
    empty_share: float
    windows: int


def windows_of(items: Iterable[Packet | Label], geometry: Geometry) -> Iterator[Window]:
    """Cut the items of a recording into windows.

    A labelled sample gives one window, which ends with the sample; samples of a held-out split
    (validation, test) are passed over. Without labels a window begins with the first event that the one
    before does not reach, wherever packets end.

    Args:
        items: packets and labels in stored order, as `Recording.items` gives them.
        geometry: bins of the window.
    """
    label: Label | None = None
    pending: list[Events] = []
    resolution: Resolution = (0, 0)
    origin = 0

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
            if item.resolution != resolution:
                yield from window()
                resolution = item.resolution
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
    rng: np.random.Generator,
    *,
    per_window: int = 64,
) -> Volumes:
    """Draw local volumes at random places, each not empty, with equal chance for every window.

    From each window `per_window` places are drawn; over all windows a reservoir keeps `n_volumes`
    (Vitter 1985, algorithm R), so recordings may be larger than memory.

    Args:
        windows: any number of windows; those with no place for a volume are passed over.
        geometry: of the volumes.
        n_volumes: how many to keep.
        rng: source of every random choice.
        per_window: places to keep from each window.

    Raises:
        InputError: no volume with an event was found.
    """
    kept = np.empty((n_volumes, geometry.entries), np.min_scalar_type(-geometry.max_count))
    seen = drawn = empty = n_windows = 0
    for window in windows:
        if min(geometry.ring_shape(window.resolution)) < geometry.patch:
            continue
        n_windows += 1
        counts = count_window(geometry, window.events, window.resolution, window.origin_us, window.last_us)
        places = sliding_window_view(counts, (geometry.patch, geometry.patch), axis=(1, 2))
        rows = rng.integers(0, places.shape[1], 4 * per_window)
        columns = rng.integers(0, places.shape[2], 4 * per_window)
        volumes = places[:, rows, columns].transpose(1, 0, 2, 3).reshape(4 * per_window, -1)
        filled = np.flatnonzero(volumes.any(axis=1))
        drawn += len(volumes)
        empty += len(volumes) - len(filled)
        for volume in volumes[filled[:per_window]]:
            slot = seen if seen < n_volumes else int(rng.integers(0, seen + 1))
            if slot < n_volumes:
                kept[slot] = volume
            seen += 1
    if seen == 0:
        raise InputError(
            f"no local volume of {geometry.patch}x{geometry.patch} pixels with an event was found in "
            f"{n_windows} windows; check the recording's resolution and splits"
        )
    return Volumes(kept[: min(seen, n_volumes)], empty / drawn, n_windows)
