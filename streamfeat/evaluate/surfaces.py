"""Features of others, for comparison: count images, HATS, HOTS.

Lives here: each of them as a map from the events of a sample to a feature vector, as an encoder is one.
Not here: features made by filters (`methods`), and the loops over events (`kernels.surfaces`).
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.evaluate.samples import centres, downsampled, some_training_samples, training_samples, until
from streamfeat.events import Events, Resolution
from streamfeat.kernels.surfaces import add_memory_surfaces, time_surfaces
from streamfeat.recordings.reader import Recording

__all__ = ["AveragedSurfaces", "CountImage", "SurfaceHistogram"]

_FITTED_SAMPLES = 1_000
"""Training samples whose surfaces prototypes are learned from: enough for so few prototypes."""


@dataclass(frozen=True, slots=True)
class CountImage:
    """Events of each polarity, counted on a grid as large as the sample, like the picture of a camera.

    Attributes:
        grid: rows and columns of the grid.
    """

    grid: int = 16

    @property
    def n_features(self) -> int:
        """Both polarities of every place."""
        return 2 * self.grid**2

    @property
    def fingerprint(self) -> str:
        """Everything that decides what features are."""
        return repr(self)

    def encode(
        self, events: Events, resolution: Resolution, *, origin_us: int | None = None, t_us: int | None = None
    ) -> NDArray[np.float32]:
        """Features `(n_features,)` of the events from `origin_us` to `t_us`."""
        x, y, p, _ = until(events, resolution, origin_us, t_us)
        places = (p * self.grid + y * self.grid // resolution[0]) * self.grid + x * self.grid // resolution[1]
        return np.bincount(places, minlength=self.n_features).astype(np.float32)


@dataclass(frozen=True, slots=True)
class AveragedSurfaces:
    """HATS: histograms of averaged time surfaces (Sironi et al. 2018, "HATS", CVPR).

    Parameters are the paper's for N-CARS: cells of 10 pixels, surfaces of 7, `tau` of 10^9 us. Deviations:
    the memory reaches back to the start of the sample (their `Delta t` is 100 ms, the length of an N-CARS
    sample), an event at the same microsecond belongs to the past if it is stored earlier, and in place of
    their normalisation every method's features have ours.

    Attributes:
        resolution: largest `(height, width)` of a training sample, downsampled; what lies beyond is ignored.
        cell: rows and columns of a cell, in pixels.
        radius: of a surface, in pixels.
        tau_us: time in which the past fades to 1/e.
        downsample: sensor pixels along each side of a pixel of all this.
    """

    resolution: Resolution
    cell: int = 10
    radius: int = 3
    tau_us: float = 1e9
    downsample: int = 1

    @classmethod
    def fitted(cls, recordings: Sequence[Recording], downsample: int = 1) -> "AveragedSurfaces":
        """Cells over the largest training sample."""
        largest = np.max([s.resolution for s in training_samples(recordings)], axis=0)
        height, width = (-(-largest // downsample)).tolist()
        return cls((height, width), downsample=downsample)

    @property
    def n_features(self) -> int:
        """Both polarities of a surface for each cell."""
        return int(np.prod(self.shape))

    @property
    def fingerprint(self) -> str:
        """Everything that decides what features are."""
        return repr(self)

    @property
    def shape(self) -> tuple[int, int, int, int, int]:
        """Rows and columns of cells, polarities, rows and columns of a surface."""
        rows, columns = (-(-side // self.cell) for side in self.resolution)
        return rows, columns, 2, 2 * self.radius + 1, 2 * self.radius + 1

    def encode(
        self, events: Events, resolution: Resolution, *, origin_us: int | None = None, t_us: int | None = None
    ) -> NDArray[np.float32]:
        """Features `(n_features,)` of the events from `origin_us` to `t_us`."""
        events, resolution = downsampled(events, resolution, self.downsample)
        inside = min(resolution[0], self.resolution[0]), min(resolution[1], self.resolution[1])
        x, y, p, t = until(events, inside, origin_us, t_us)
        sums = np.zeros(self.shape)
        add_memory_surfaces(x, y, p, t / self.tau_us, self.cell, np.zeros((2, *self.resolution)), sums)
        rows, columns = self.shape[:2]
        cells = np.bincount(y // self.cell * columns + x // self.cell, minlength=rows * columns)
        sums /= np.maximum(cells, 1).reshape(rows, columns, 1, 1, 1)
        return sums.ravel().astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceHistogram:
    """A single layer of HOTS: how often each prototype of time surfaces occurs (Lagorce et al. 2017, TPAMI).

    Deviations: one layer in place of three, with more prototypes; prototypes by k-means in place of their
    online clustering; a histogram for each quadrant, as our codes are pooled, in place of one.

    Attributes:
        prototypes: `(n, 2 (2 R + 1)^2)` float32.
        radius: of a surface, in pixels.
        tau_us: time in which a surface fades to 1/e.
        downsample: sensor pixels along each side of a pixel of all this.
    """

    prototypes: NDArray[np.float32]
    radius: int = 3
    tau_us: float = 20_000.0
    downsample: int = 1

    @classmethod
    def fitted(
        cls,
        recordings: Sequence[Recording],
        n_prototypes: int = 64,
        n_surfaces: int = 50_000,
        seed: int = 0,
        downsample: int = 1,
    ) -> "SurfaceHistogram":
        """Prototypes of the surfaces at random events of random training samples.

        Raises:
            InputError: there is no event.
        """
        rng = np.random.default_rng(seed)
        n_samples, samples = some_training_samples(recordings, _FITTED_SAMPLES, rng)
        each = -(-n_surfaces // max(n_samples, 1))
        blank = cls(np.zeros((0, 0), np.float32))
        drawn = []
        for sample in samples:
            events, resolution = downsampled(sample.events, sample.resolution, downsample)
            surfaces = blank._surfaces(*until(events, resolution), resolution)
            if len(surfaces):
                drawn.append(surfaces[rng.integers(0, len(surfaces), each)])
        if not drawn:
            raise InputError("the training samples have no events; hots has nothing to learn from")
        return cls(centres(np.concatenate(drawn), n_prototypes, seed), downsample=downsample)

    @property
    def n_features(self) -> int:
        """Each prototype in four quadrants."""
        return 4 * len(self.prototypes)

    @property
    def fingerprint(self) -> str:
        """Everything that decides what features are."""
        return hashlib.sha256(
            repr((self.radius, self.tau_us, self.downsample)).encode() + self.prototypes.tobytes()
        ).hexdigest()

    def encode(
        self, events: Events, resolution: Resolution, *, origin_us: int | None = None, t_us: int | None = None
    ) -> NDArray[np.float32]:
        """Features `(n_features,)` of the events from `origin_us` to `t_us`."""
        events, resolution = downsampled(events, resolution, self.downsample)
        x, y, p, t = until(events, resolution, origin_us, t_us)
        surfaces = self._surfaces(x, y, p, t, resolution)
        # |s - c|^2 is least where c.s - |c|^2 / 2 is largest.
        likeness = surfaces @ self.prototypes.T - np.square(self.prototypes).sum(axis=1) / 2
        quadrant = 2 * (2 * y >= resolution[0]) + (2 * x >= resolution[1])
        places = quadrant * len(self.prototypes) + likeness.argmax(axis=1)
        return np.bincount(places, minlength=self.n_features).astype(np.float32)

    def _surfaces(
        self,
        x: NDArray[np.int64],
        y: NDArray[np.int64],
        p: NDArray[np.int64],
        t: NDArray[np.int64],
        resolution: Resolution,
    ) -> NDArray[np.float32]:
        """`(n, 2 (2 R + 1)^2)`."""
        side = 2 * self.radius + 1
        latest = np.full((2, resolution[0] + side - 1, resolution[1] + side - 1), -np.inf)
        out = np.empty((len(t), 2, side, side), np.float32)
        time_surfaces(x, y, p, t / self.tau_us, latest, out)
        return out.reshape(len(t), 2 * side * side)
