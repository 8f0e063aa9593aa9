"""Where local volumes lie in space and time.

Lives here: patch, stride, bins and the grids that follow from them. Not here: what is learned.
"""

from dataclasses import dataclass

from streamfeat.errors import InputError
from streamfeat.events import Resolution

__all__ = ["Geometry"]


@dataclass(frozen=True, slots=True)
class Geometry:
    """Where local volumes lie in space and time.

    Attributes:
        patch: rows and columns of a local volume, in ring pixels.
        stride: ring pixels between neighbouring volumes.
        n_bins: time bins in the window.
        bin_us: microseconds in a bin.
        downsample: sensor pixels along each side of a ring pixel.
        max_count: counts are clipped to `[-max_count, max_count]`.
        pooling: cells along each side of the grid of volumes; codes are summed over each cell. Two is the
            paper's: four quadrants.

    Raises:
        InputError: a value is out of range.
    """

    patch: int = 12
    stride: int = 2
    n_bins: int = 3
    bin_us: int = 33_334
    downsample: int = 1
    max_count: int = 1
    pooling: int = 2

    def __post_init__(self) -> None:
        """Check every value."""
        upper = {
            "patch": 1024,
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

    @property
    def entries(self) -> int:
        """Length `d` of a volume."""
        return self.n_bins * self.patch * self.patch

    @property
    def window_us(self) -> int:
        """The accumulation interval in microseconds."""
        return self.n_bins * self.bin_us

    def ring_shape(self, resolution: Resolution) -> tuple[int, int]:
        """Rows and columns of ring pixels for a sensor of `(height, width)` pixels.

        A sensor smaller than a volume has pixels that never fire to its right and below it.
        """
        height, width = (max(-(-side // self.downsample), self.patch) for side in resolution)
        return height, width

    def has_room(self, resolution: Resolution) -> bool:
        """Whether a sensor of `(height, width)` pixels has a place for a volume without such pixels."""
        return all(-(-side // self.downsample) >= self.patch for side in resolution)

    def grid_shape(self, resolution: Resolution) -> tuple[int, int]:
        """Rows and columns of volumes for a sensor of `(height, width)` pixels; at least one of each."""
        rows, columns = self.ring_shape(resolution)
        return (rows - self.patch) // self.stride + 1, (columns - self.patch) // self.stride + 1
