"""From arrays to pictures.

Lives here: eight-bit pictures of events, bins and volumes; features in as many columns as a plot can have.
Not here: where they are sent (`channels`), in which colours they are drawn (the page, Foxglove).

Signed pictures have 128 for nothing, more for ON and less for OFF; colours are chosen where they are drawn.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from streamfeat.events import EVENT_DTYPE, Events, Resolution

__all__ = [
    "NOTHING",
    "Columns",
    "bins_picture",
    "event_picture",
    "feature_columns",
    "volume_picture",
]

Picture = NDArray[np.uint8]

NOTHING = 128
_REACH = 127
_OLDEST = 32
"""How far an event that is about to fade is from nothing."""
_FAINTEST = 64
"""Of volumes that are not empty, on a scale that ends at 255."""
_LARGEST = 640
"""Pixels along the longer side of a picture; a larger one is shrunk, for 20 a second must fit anywhere."""
_WIDEST = 1600
"""The same for all bins side by side."""
_MOST_COLUMNS, _MOST_CELLS = 512, 4


def event_picture(
    batches: Sequence[Events],
    resolution: Resolution,
    window_us: tuple[int, int],
    now_us: int,
    length_us: int,
) -> Picture:
    """The latest event of each pixel, ON or OFF, fading with its age.

    Args:
        batches: `(n,)` EVENT_DTYPE each, in order of arrival, not changed; any content.
        resolution: `(height, width)` of the sensor.
        window_us: stream times between which events count.
        now_us: stream time, unless an event of the window is later.
        length_us: how long an event is seen.

    Returns:
        `(height, width)` uint8, signed as above; smaller for a large sensor.
    """
    height, width = resolution
    events = np.concatenate(batches) if batches else np.empty(0, EVENT_DTYPE)
    sound = (events["x"] < width) & (events["y"] < height) & (events["p"] >> 1 == 0)
    events = events[sound & (events["t"] >= window_us[0]) & (events["t"] < window_us[1])]
    picture = np.full(resolution, NOTHING, np.uint8)
    if len(events):
        age = max(now_us, int(events["t"].max())) - events["t"]
        events, age = events[age < length_us], age[age < length_us]
        level = _OLDEST + (_REACH - _OLDEST) * (1 - age / length_us)
        # Of several events at a pixel, the last one written stays.
        picture[events["y"], events["x"]] = np.round(NOTHING + np.where(events["p"], level, -level))
    return _shrink(picture, _LARGEST)


def bins_picture(counts: NDArray[np.int32], max_count: int) -> Picture:
    """The bins of a window side by side, the oldest on the left, black columns between them.

    Args:
        counts: `(n_bins, H, W)` int32, not changed.
        max_count: where counts are clipped, the full range of the picture.

    Returns:
        `(h, n_bins * w + (n_bins - 1) * max(1, w // 32))` uint8, signed as above, where `h, w` are `H, W` or
        smaller.
    """
    clipped = counts.clip(-max_count, max_count) / max_count
    tiles = [_shrink(tile, max(_WIDEST // len(counts), 1)) for tile in _signed(clipped)]
    bar = np.zeros((tiles[0].shape[0], _gap_of(tiles[0].shape[1])), np.uint8)
    return np.hstack([part for tile in tiles for part in (bar, tile)][1:])


def _gap_of(width: int) -> int:
    """Columns between two bins that are `width` pixels wide."""
    return max(1, width // 32)


def volume_picture(activity: NDArray[np.int64]) -> Picture:
    """How much is going on in each local volume.

    Args:
        activity: `(rows, columns)` int64 sums of squared entries, not changed.

    Returns:
        `(rows, columns)` uint8: 0 for an empty volume, 64 to 255 for others, by the root of the sum over the
        largest; smaller for a large grid.
    """
    strength = np.sqrt(activity / max(int(activity.max(initial=0)), 1))
    picture = np.where(activity > 0, np.round(_FAINTEST + (255 - _FAINTEST) * strength), 0).astype(np.uint8)
    return _shrink(picture, _LARGEST, nothing=0)


class Columns(NamedTuple):
    """Features of each cell of the grid, row by row, for bars up and down.

    Attributes:
        positive: `(cells, n)` float32, at least 0.
        negative: `(cells, n)` float32, at least 0: sizes of negative parts.
        filters: how many filters share a column, which has the largest of them.
    """

    positive: NDArray[np.float32]
    negative: NDArray[np.float32]
    filters: int


def feature_columns(features: NDArray[np.float32], encoding: str, pooling: int) -> Columns:
    """Features by cell, positive and negative parts apart, in at most 512 columns and 4 x 4 cells.

    Where there are more, neighbours share one, which has the largest of them.

    Args:
        features: `(n_features,)` float32, not changed.
        encoding: soft, split or triangle.
        pooling: cells along each side of the grid.
    """
    cells = features.reshape(pooling, pooling, -1)
    if encoding == "split":
        positive, negative = np.split(cells, 2, axis=2)
    else:
        positive, negative = cells.clip(0), (-cells).clip(0)
    side = min(pooling, _MOST_CELLS)
    filters = -(-positive.shape[2] * side * side // _MOST_COLUMNS)
    up, down = (_largest_of(_cells(part, side), filters) for part in (positive, negative))
    return Columns(up, down, filters)


def _cells(part: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """`(pooling, pooling, K)` as `(side * side, K)`."""
    starts = np.arange(side) * len(part) // side
    for axis in (0, 1):
        part = np.maximum.reduceat(part, starts, axis=axis)
    return part.reshape(side * side, -1)


def _largest_of(rows: NDArray[np.float32], together: int) -> NDArray[np.float32]:
    starts = np.arange(0, rows.shape[1], together)
    return np.maximum.reduceat(rows, starts, axis=1)


def _signed(values: NDArray[np.float64]) -> Picture:
    """Values from -1 to 1 as a picture."""
    return np.round(NOTHING + _REACH * values).astype(np.uint8)


def _shrink(picture: Picture, largest: int, nothing: int = NOTHING) -> Picture:
    """A picture of at most `largest` pixels along a side: of each block, the pixel furthest from nothing."""
    step = -(-max(picture.shape) // largest)
    if step <= 1:
        return picture
    height, width = (-(-side // step) for side in picture.shape)
    padded = np.full((height * step, width * step), nothing, np.uint8)
    padded[: picture.shape[0], : picture.shape[1]] = picture
    blocks = padded.reshape(height, step, width, step).swapaxes(1, 2).reshape(height, width, -1)
    far = np.abs(blocks.astype(np.int16) - nothing).argmax(axis=2)
    return np.take_along_axis(blocks, far[:, :, np.newaxis], axis=2)[:, :, 0]
