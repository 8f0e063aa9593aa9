"""Where local volumes lie in space and time.

Lives here: patch, stride, bins and the grids that follow from them. Not here: what is learned.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from streamfeat.errors import InputError
from streamfeat.events import Resolution

__all__ = ["Geometry"]


_MOST_SIDE = 1024

_LATER = ("volume_bins", "time_stride")
"""Fields that the first files do not have; they are not written where they have their defaults."""


@dataclass(frozen=True, slots=True, repr=False)
class Geometry:
    """Where local volumes lie in space and time.

    Attributes:
        patch: ring pixels along each side of a local volume, or `(rows, columns)`; equal ones have one
            spelling, a number.
        stride: ring pixels between neighbouring volumes.
        n_bins: time bins in the window.
        bin_us: microseconds in a bin.
        downsample: sensor pixels along each side of a ring pixel.
        max_count: counts are clipped to `[-max_count, max_count]`.
        pooling: cells along each side of the grid of volumes; codes are summed over each cell. Two is the
            paper's: four quadrants.
        volume_bins: bins of a local volume; None for all of the window. Fewer (3D convolution) make volumes
            lie in time, too: they end with the current bin and every `time_stride` bins before it, as many as
            fit into the window, and their codes are summed over time as over each cell.
        time_stride: bins between volumes at the same place; 1 where `volume_bins` is None.

    Raises:
        InputError: a value is out of range, or a volume does not fit into the window.
    """

    patch: int | tuple[int, int] = 12
    stride: int = 2
    n_bins: int = 3
    bin_us: int = 33_334
    downsample: int = 1
    max_count: int = 1
    pooling: int = 2
    volume_bins: int | None = None
    time_stride: int = 1

    def __post_init__(self) -> None:
        """Check every value."""
        upper = {
            "stride": 1024,
            "n_bins": 1024,
            "bin_us": 2**40,
            "downsample": 1024,
            "max_count": 2**14 - 1,  # or the change of a count would not fit into 16 bits
            "pooling": 64,
        }
        for name, most in upper.items():
            value = getattr(self, name)
            if not (type(value) is int and 1 <= value <= most):
                raise InputError(f"geometry: {name} is {value!r}, it must be an integer from 1 to {most}")
        self._check_patch()
        self._check_time()

    def _check_patch(self) -> None:
        """Check the sides of a volume; those that are equal have one spelling."""
        sides = tuple(self.patch) if isinstance(self.patch, list | tuple) else (self.patch, self.patch)
        if len(sides) != 2 or not all(type(side) is int and 1 <= side <= _MOST_SIDE for side in sides):
            raise InputError(
                f"geometry: patch is {self.patch!r}, it must be an integer from 1 to {_MOST_SIDE}, or two: "
                "rows and columns"
            )
        object.__setattr__(self, "patch", sides[0] if sides[0] == sides[1] else sides)

    def _check_time(self) -> None:
        """Check what volumes are in time; those as long as the window have one spelling."""
        bins = self.n_bins if self.volume_bins is None else self.volume_bins
        if not (type(bins) is int and 1 <= bins <= self.n_bins):
            raise InputError(
                f"geometry: volume_bins is {bins!r}, it must be an integer from 1 to the "
                f"{self.n_bins} bins of the window"
            )
        most = max(self.n_bins - bins, 1)
        if not (type(self.time_stride) is int and 1 <= self.time_stride <= most):
            raise InputError(
                f"geometry: time_stride is {self.time_stride!r}, it must be an integer from 1 to {most}: "
                f"volumes have {bins} of the {self.n_bins} bins of the window"
            )
        if bins == self.n_bins:
            object.__setattr__(self, "volume_bins", None)

    def __repr__(self) -> str:
        """All that a file holds; encoders and their fingerprints are told apart by it."""
        return f"Geometry({', '.join(f'{name}={value!r}' for name, value in self.as_dict().items())})"

    def as_dict(self) -> dict[str, Any]:
        """Names and values as a file holds them."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        defaults = {field.name: field.default for field in fields(self) if field.name in _LATER}
        return {n: value for n, value in values.items() if n not in _LATER or value != defaults[n]}

    @property
    def is_general(self) -> bool:
        """Whether the first files could not hold it."""
        return not (isinstance(self.patch, int) and self.as_dict().keys().isdisjoint(_LATER))

    @property
    def sides(self) -> tuple[int, int]:
        """Rows and columns of a volume."""
        return (self.patch, self.patch) if isinstance(self.patch, int) else self.patch

    @property
    def patch_name(self) -> int | str:
        """12, or `8x16`, as commands take it."""
        return self.patch if isinstance(self.patch, int) else "x".join(map(str, self.patch))

    @property
    def volume_shape(self) -> tuple[int, int, int]:
        """Bins, rows and columns of a volume."""
        return self.depth, *self.sides

    @property
    def depth(self) -> int:
        """Bins of a volume."""
        return self.n_bins if self.volume_bins is None else self.volume_bins

    @property
    def ages(self) -> Sequence[int]:
        """By how many bins the volumes at one place end before the current one; the newest is of age 0."""
        return range(0, self.n_bins - self.depth + 1, self.time_stride)

    @property
    def newest(self) -> "Geometry":
        """That of the volumes which end with the current bin: a window of as many bins as they have."""
        return replace(self, n_bins=self.depth, volume_bins=None, time_stride=1)

    @property
    def whole(self) -> "Geometry":
        """That of volumes as long as the window."""
        return replace(self, volume_bins=None, time_stride=1)

    @property
    def entries(self) -> int:
        """Length `d` of a volume."""
        return math.prod(self.volume_shape)

    @property
    def window_us(self) -> int:
        """The accumulation interval in microseconds."""
        return self.n_bins * self.bin_us

    def ring_shape(self, resolution: Resolution) -> tuple[int, int]:
        """Rows and columns of ring pixels for a sensor of `(height, width)` pixels.

        A sensor smaller than a volume has pixels that never fire to its right and below it.
        """
        (height, width), (rows, columns) = resolution, self.sides
        return max(-(-height // self.downsample), rows), max(-(-width // self.downsample), columns)

    @property
    def smallest(self) -> Resolution:
        """The smallest sensor that has room for a volume."""
        rows, columns = self.sides
        return rows * self.downsample, columns * self.downsample

    def has_room(self, resolution: Resolution) -> bool:
        """Whether a sensor of `(height, width)` pixels has a place for a volume without such pixels."""
        return self.ring_shape(resolution) == tuple(-(-side // self.downsample) for side in resolution)

    def grid_shape(self, resolution: Resolution) -> tuple[int, int]:
        """Rows and columns of volumes for a sensor of `(height, width)` pixels; at least one of each."""
        (rows, columns), (height, width) = self.ring_shape(resolution), self.sides
        return (rows - height) // self.stride + 1, (columns - width) // self.stride + 1
