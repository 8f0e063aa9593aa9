"""Events and filters as pictures, for notebooks and for files; without a library that plots.

Lives here: `draw`, and the picture that it gives.
Not here: which pixel shows which event (`pictures`), PNG (`streamfeat.report.notebook`).
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.encoder import Encoder
from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution, as_events
from streamfeat.files.atomic import write_atomically
from streamfeat.report.notebook import mosaic, png
from streamfeat.view.pictures import NOTHING, event_picture

__all__ = ["Drawing", "draw"]

_ON, _OFF = (31, 111, 214), (217, 72, 15)
"""As on the page of a view."""
_WIDE = 320
"""Pixels that a small picture is enlarged to."""
_MOST_FILTERS = 100


class Drawing:
    """A picture that notebooks show.

    Attributes:
        pixels: `(height, width, 4)` uint8: red, green, blue, and how much of the background they cover.
    """

    def __init__(self, pixels: NDArray[np.uint8]) -> None:
        """Enlarge a small picture, each pixel to a square."""
        times = max(1, _WIDE // pixels.shape[1])
        self.pixels = pixels.repeat(times, axis=0).repeat(times, axis=1)

    def __repr__(self) -> str:
        """Its size."""
        height, width, _ = self.pixels.shape
        return f"Drawing({width}x{height})"

    def _repr_png_(self) -> bytes:
        return png(self.pixels)

    def save(self, path: str | Path) -> None:
        """Write it as PNG; an earlier file is replaced.

        Raises:
            InputError: it cannot be written.
        """
        write_atomically(Path(path), png(self.pixels))


def draw(what: Events | Encoder, resolution: Resolution | None = None) -> Drawing:
    """Events as a picture, or the filters of an encoder.

    Of events each pixel shows its latest, ON blue and OFF orange, the fainter the older it is. Filters stand
    in a grid, time bins side by side, each with a contrast of its own; grey is zero.

    Example:
        >>> events = sf.make_events(x=[3, 5], y=[2, 2], p=[1, 0], t=[0, 900])
        >>> sf.draw(events, resolution=(8, 8))
        Drawing(320x320)

    Args:
        what: `(n,)` events as `as_events` takes them, not changed; or an encoder.
        resolution: `(height, width)` of the sensor; the smallest that holds all events if not given.

    Returns:
        the picture; a notebook shows it, `save` writes it.

    Raises:
        InputError: these are no events, or the resolution has no pixels.
    """
    if isinstance(what, Encoder):
        g = what.geometry
        filters = what.filters[:_MOST_FILTERS].reshape(-1, *g.volume_shape)
        grey = mosaic(filters.transpose(0, 2, 1, 3).reshape(len(filters), g.sides[0], -1))
        return Drawing(np.dstack([grey, grey, grey, np.full_like(grey, 255)]))
    events = as_events(what)
    if resolution is None:
        resolution = (int(events["y"].max()) + 1, int(events["x"].max()) + 1) if len(events) else (1, 1)
    if min(resolution) < 1:
        raise InputError(f"a resolution of {resolution} has no pixels; give (height, width)")
    first, last = (int(events["t"].min()), int(events["t"].max())) if len(events) else (0, 0)
    signed = event_picture([events], resolution, (first, last + 1), last, last - first + 1)
    pixels = np.zeros((*signed.shape, 4), np.uint8)
    pixels[signed > NOTHING, :3], pixels[signed < NOTHING, :3] = _ON, _OFF
    strength = np.abs(signed.astype(np.int16) - NOTHING)
    pixels[..., 3] = np.minimum(2 * strength, 255)
    return Drawing(pixels)
