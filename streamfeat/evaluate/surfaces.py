"""Features of others, for comparison: count images, HATS, HOTS.

Lives here: each of them as a map from the events of a sample to a feature vector, as an encoder is one.
Not here: features made by filters (`methods`), and the loops over events (`kernels.surfaces`).
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.evaluate.samples import centres, downsampled, some_training_samples, training_samples, until
from streamfeat.events import Events, Resolution
from streamfeat.kernels.surfaces import add_memory_surfaces, time_surfaces
from streamfeat.recordings.reader import Recording

__all__ = ["HOTS_LAYERS", "AveragedSurfaces", "CountImage", "SurfaceHistogram", "SurfaceLayer"]

IntArray = NDArray[np.int64]
Columns = tuple[IntArray, IntArray, IntArray, IntArray]

HOTS_LAYERS = ((4, 2, 2, 1e4), (8, 4, 4, 1e5), (16, 8, 8, 1e6))
"""Of each layer: prototypes, polarities that come in, radius in pixels, time constant in microseconds."""

_FITTED_SAMPLES = 1_000
"""Training samples whose surfaces prototypes are learned from: enough for so few prototypes."""

_CHUNK = 4096
"""Events whose surfaces are in memory at a time."""


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


class SurfaceLayer(NamedTuple):
    """One layer of HOTS.

    Attributes:
        prototypes: `(n, P (2 R + 1)^2)` float32, of surfaces of `P` polarities: two of the camera, and in
            later layers the prototypes of the layer before.
        radius: of a surface, `R`, in pixels.
        tau_us: time in which a surface fades to 1/e.
    """

    prototypes: NDArray[np.float32]
    radius: int
    tau_us: float

    @property
    def side(self) -> int:
        """Rows and columns of a surface."""
        return 2 * self.radius + 1

    @property
    def n_polarities(self) -> int:
        """`P`."""
        return int(self.prototypes.shape[1]) // self.side**2

    @property
    def half_squares(self) -> NDArray[np.float32]:
        """`(n,)` half of `|c|^2`: `|s - c|^2` is least where `c.s - |c|^2 / 2` is largest."""
        halves: NDArray[np.float32] = np.square(self.prototypes).sum(axis=1) / np.float32(2)
        return halves

    def blank(self, resolution: Resolution) -> NDArray[np.float64]:
        """`latest` of `time_surfaces` before the first event."""
        rows, columns = resolution[0] + self.side - 1, resolution[1] + self.side - 1
        return np.full((self.n_polarities, rows, columns), -np.inf)

    def surfaces(
        self, columns: Columns, resolution: Resolution
    ) -> Iterator[tuple[slice, NDArray[np.float32]]]:
        """Surfaces `(n, P (2 R + 1)^2)` of a chunk of events at a time, and where these stand."""
        x, y, p, t = columns
        latest = self.blank(resolution)
        for start in range(0, len(t), _CHUNK):
            some = slice(start, start + _CHUNK)
            out = np.empty((len(t[some]), self.n_polarities, self.side, self.side), np.float32)
            time_surfaces(x[some], y[some], p[some], t[some] / self.tau_us, latest, out)
            yield some, out.reshape(len(out), -1)

    def answers(self, columns: Columns, resolution: Resolution) -> IntArray:
        """The prototype nearest to each event's surface, `(n,)` int64: its polarity in the next layer."""
        found = np.zeros(len(columns[3]), np.int64)
        half = self.half_squares
        for some, surfaces in self.surfaces(columns, resolution):
            found[some] = (surfaces @ self.prototypes.T - half).argmax(axis=1)
        return found


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceHistogram:
    """HOTS: layers of time surfaces, and how often each prototype of the last one occurs (Lagorce et al.
    2017, "HOTS: A Hierarchy of Event-Based Time-Surfaces for Pattern Recognition", TPAMI 39).

    The prototype that is nearest to the time surface of an event (equation 3) is the event's polarity in the
    next layer, at the same place and time. Three layers of 4, 8 and 16 prototypes, radii of 2, 4 and 8
    pixels, and time constants of 10, 100 and 1,000 ms: the defaults of the code with which Grimaldi et al.
    (2021) repeat the paper, whose own text was not at hand. Deviations: prototypes by k-means in place of
    online clustering; a histogram for each quadrant, as our codes are pooled, in place of one; and the
    classifier of every method in place of the nearest histogram.

    Attributes:
        layers: from the first to the last.
        downsample: sensor pixels along each side of a pixel of all this.
    """

    layers: tuple[SurfaceLayer, ...]
    downsample: int = 1

    @classmethod
    def fitted(
        cls,
        recordings: Sequence[Recording],
        n_surfaces: int = 10_000,
        seed: int = 0,
        downsample: int = 1,
    ) -> "SurfaceHistogram":
        """Prototypes of the surfaces at random events of random training samples, layer after layer.

        Args:
            recordings: open recordings.
            n_surfaces: that prototypes of a layer are found from, about.
            seed: of samples, events and clusters.
            downsample: sensor pixels along each side of a pixel.

        Raises:
            InputError: there are no events, or too few.
        """
        layers: tuple[SurfaceLayer, ...] = ()
        for n, n_polarities, radius, tau_us in HOTS_LAYERS:
            blank = SurfaceLayer(
                np.zeros((0, n_polarities * (2 * radius + 1) ** 2), np.float32), radius, tau_us
            )
            drawn = [*_drawn_surfaces(recordings, cls(layers, downsample), blank, n_surfaces, seed)]
            surfaces = np.concatenate(drawn) if drawn else blank.prototypes
            if len(surfaces) < n:
                raise InputError("the training samples have too few events; hots has nothing to learn from")
            layers += (SurfaceLayer(centres(surfaces, n, seed), radius, tau_us),)
        return cls(layers, downsample)

    @property
    def n_features(self) -> int:
        """Each prototype of the last layer in four quadrants."""
        return 4 * len(self.layers[-1].prototypes)

    @property
    def fingerprint(self) -> str:
        """Everything that decides what features are."""
        found = hashlib.sha256(repr(self.downsample).encode())
        for layer in self.layers:
            found.update(repr((layer.radius, layer.tau_us)).encode() + layer.prototypes.tobytes())
        return found.hexdigest()

    def encode(
        self, events: Events, resolution: Resolution, *, origin_us: int | None = None, t_us: int | None = None
    ) -> NDArray[np.float32]:
        """Features `(n_features,)` of the events from `origin_us` to `t_us`."""
        events, resolution = downsampled(events, resolution, self.downsample)
        x, y, p, _ = self.seen(until(events, resolution, origin_us, t_us), resolution)
        quadrant = 2 * (2 * y >= resolution[0]) + (2 * x >= resolution[1])
        places = quadrant * len(self.layers[-1].prototypes) + p
        return np.bincount(places, minlength=self.n_features).astype(np.float32)

    def seen(self, columns: Columns, resolution: Resolution) -> Columns:
        """Events as the last layer gives them: the same, but for polarities."""
        x, y, p, t = columns
        for layer in self.layers:
            p = layer.answers((x, y, p, t), resolution)
        return x, y, p, t


def _drawn_surfaces(
    recordings: Sequence[Recording], before: SurfaceHistogram, layer: SurfaceLayer, n: int, seed: int
) -> Iterator[NDArray[np.float32]]:
    """Surfaces of a layer behind others at random events, about `n` in all."""
    rng = np.random.default_rng(seed)
    n_samples, samples = some_training_samples(recordings, _FITTED_SAMPLES, rng)
    each = -(-n // max(n_samples, 1))
    for sample in samples:
        events, resolution = downsampled(sample.events, sample.resolution, before.downsample)
        columns = before.seen(until(events, resolution), resolution)
        picked = np.sort(rng.integers(0, max(len(columns[3]), 1), each))
        for some, surfaces in layer.surfaces(columns, resolution):
            here = picked[(picked >= some.start) & (picked < some.start + len(surfaces))]
            yield surfaces[here - some.start]
