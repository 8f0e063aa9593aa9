"""Image files as light: what a sensor in front of a monitor would see of them.

Lives here: reading one image of any common kind, and fitting it into a sensor.
Not here: motion (`saccades`), films (`films`).
"""

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.events import Resolution

__all__ = ["IMAGE_ENDINGS", "fitted_size", "load_picture", "on_monitor"]

IMAGE_ENDINGS = (".jpg", ".jpeg", ".png", ".bmp", ".gif", ".pgm", ".ppm", ".tif", ".tiff", ".webp")
"""Endings of files that are images."""

MOST_PIXELS = 1 << 26
"""Of an image: 67 million; a few bytes can promise more than memory holds."""


def load_picture(path: Path, box: Resolution, *, enlarge: bool = True) -> NDArray[np.float64]:
    """Read an image, in grey, as large as fits into a box; its proportions are kept.

    Transparent pixels let black through. Colours are weighted as Rec. 601 has it. Of an image with several
    frames the first is read. 16 bits are 16 bits.

    Args:
        path: the file.
        box: largest `(height, width)`.
        enlarge: make a smaller image as large as fits, too.

    Returns:
        `(rows, columns)` float64, what the file says of each pixel, from 0 (black) to 1 (white).

    Raises:
        InputError: Pillow is not there; the file is no image, damaged, too large, or of one pixel.
    """
    try:
        from PIL import Image
    except ImportError:
        raise InputError(f"{path}: reading images needs Pillow: pip install 'streamfeat[simulate]'") from None
    try:
        with Image.open(path) as image:
            width, height = image.size
            if width * height > MOST_PIXELS:
                raise InputError(
                    f"{path}: is {width}x{height} pixels, more than {MOST_PIXELS:,}; make it smaller"
                )
            if width * height == 1:
                raise InputError(f"{path}: is one pixel; nothing changes where it moves")
            grey = _grey(image, path)
    except Image.DecompressionBombError as error:
        raise InputError(f"{path}: is too large: {error}") from None
    except InputError:  # is a ValueError, and has its line already
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: does not exist, or is a link that leads nowhere") from None
    # What Pillow raises for damaged files of one kind or another.
    except (OSError, ValueError, SyntaxError, EOFError, struct.error, IndexError, KeyError) as error:
        raise InputError(f"{path}: is no image that can be read ({error or type(error).__name__})") from None
    rows, columns = fitted_size((height, width), box, enlarge=enlarge)
    if (rows, columns) != (height, width):
        grey = grey.resize((columns, rows), Image.Resampling.BILINEAR)
    return np.asarray(grey, np.float64).clip(0.0, 1.0)


def fitted_size(size: Resolution, box: Resolution, *, enlarge: bool = True) -> Resolution:
    """The largest `(height, width)` of the same proportions that fits into a box."""
    scale = min(box[0] / size[0], box[1] / size[1])
    scale = scale if enlarge else min(scale, 1.0)
    rows, columns = (max(1, round(side * scale)) for side in size)
    return min(rows, box[0]), min(columns, box[1])


def on_monitor(values: NDArray[np.float64], gamma: float) -> NDArray[np.float64]:
    """Light of each pixel on a monitor, from 0 to 1: its value to the power of gamma."""
    return values if gamma == 1 else values**gamma


def _grey(image: Any, path: Path) -> Any:
    """The image in Pillow's mode F, 0 to 1."""
    from PIL import Image

    if image.mode.startswith("I"):  # 16 bits, in 16 or in 32
        values = np.asarray(image, np.float64)
        if values.min() < 0 or values.max() > 65535:
            raise InputError(
                f"{path}: has values from {values.min():g} to {values.max():g}; 16 bits end at 65535"
            )
        return Image.fromarray((values / 65535).astype(np.float32))
    if image.mode == "F":
        raise InputError(f"{path}: has floating-point values without a scale; save it with 8 or 16 bits")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "black"), image)
    return Image.fromarray(np.asarray(image.convert("L"), np.float32) / np.float32(255))
