"""Features of spiking networks with fixed filters, for comparison: HFirst and Gabor-SNN.

Lives here: Gabor filters, and both networks as maps from the events of a sample to a feature vector.
Not here: methods of time surfaces (`surfaces`), and the loops over events (`kernels.spiking`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from streamfeat.evaluate.samples import downsampled, until
from streamfeat.events import Events, Resolution
from streamfeat.kernels.layout import BEFORE_TIME
from streamfeat.kernels.spiking import spike_first, spike_leaky

__all__ = ["FirstSpikes", "LeakySpikes", "gabor_filters"]

IntArray = NDArray[np.int64]


def gabor_filters(side: int = 7, n_orientations: int = 12) -> NDArray[np.float64]:
    """Gabor filters, of mean 0 and Euclidean length 100 (mV) each (Orchard et al. 2015, equation 2).

    `exp(-(u^2 + gamma^2 v^2) / (2 sigma^2)) cos(2 pi u / lambda)`, with sigma 2.8, gamma 0.3 and lambda 5 as
    in the code that the authors published.

    Args:
        side: rows and columns, odd.
        n_orientations: evenly over half a turn; the first is a horizontal bar.

    Returns:
        `(side, side, n_orientations)` float64.
    """
    angles = np.pi / 2 + np.pi * np.arange(n_orientations) / n_orientations
    radius = side // 2
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1][:, :, :, None]
    u = x * np.cos(angles) + y * np.sin(angles)
    v = y * np.cos(angles) - x * np.sin(angles)
    filters = np.exp(-(u**2 + 0.3**2 * v**2) / (2 * 2.8**2)) * np.cos(2 * np.pi / 5 * u)
    filters -= filters.mean(axis=(0, 1))
    scaled: NDArray[np.float64] = 100 * filters / np.linalg.norm(filters, axis=(0, 1))
    return scaled


class _GridOfSpikes(ABC):
    """Spikes of each orientation, counted on a grid as large as the sample.

    Args of the constructors of its kinds: rows and columns of the grid, and sensor pixels along each side
    of a pixel of the network.
    """

    grid: int
    downsample: int
    n_orientations: ClassVar[int] = 12
    kernel: ClassVar[Callable[..., None]]

    @property
    def n_features(self) -> int:
        """Each orientation at each place of the grid."""
        return self.grid**2 * self.n_orientations

    @property
    def fingerprint(self) -> str:
        """Everything that decides what features are."""
        return repr(self)

    def encode(
        self, events: Events, resolution: Resolution, *, origin_us: int | None = None, t_us: int | None = None
    ) -> NDArray[np.float32]:
        """Features `(n_features,)` of the events from `origin_us` to `t_us`."""
        events, resolution = downsampled(events, resolution, self.downsample)
        count = self.counter(resolution)
        counts = count(*until(events, resolution, origin_us, t_us))
        rows, columns = (np.arange(n) * self.grid // n for n in counts.shape[:2])
        features = np.zeros((self.grid, self.grid, self.n_orientations), np.float32)
        np.add.at(features, (rows[:, None], columns[None, :]), counts)
        return features.ravel()

    def counter(self, resolution: Resolution) -> Callable[[IntArray, IntArray, IntArray, IntArray], IntArray]:
        """A function that takes the next events (x, y, p, us) and gives the spikes so far, of each cell."""
        clocked, state = self.state(resolution)

        def count(x: IntArray, y: IntArray, p: IntArray, t: IntArray) -> IntArray:
            self.kernel(x, y, p, clocked(t), *state)
            counts: IntArray = state[-1]
            return counts

        return count

    @abstractmethod
    def state(self, resolution: Resolution) -> tuple[Callable[[IntArray], NDArray[Any]], tuple[Any, ...]]:
        """From microseconds to the kernel's time, and all that it takes after the events; counts are last."""


@dataclass(frozen=True, slots=True)
class FirstSpikes(_GridOfSpikes):
    """HFirst (Orchard, Meyer, Etienne-Cummings, Posch, Thakor and Benosman 2015, "HFirst", TPAMI 37).

    Layers S1 and C1 with the parameters of the code that the authors published for N-MNIST: threshold 150 mV,
    leak 25 mV/ms, refractory times of 5 ms, time in whole milliseconds, cells of 4x4 pixels. Deviations: in
    place of S2, a neuron for each class whose weights are the mean spikes of C1 in its samples, and of C2,
    these spikes are counted on a grid over the sample and go to the same classifier as every method's
    features; samples differ in size, and S2 is as large as one of them. Neurons begin rested, where in that
    code they begin in refraction.

    Attributes:
        grid: rows and columns of the grid.
        downsample: sensor pixels along each side of a pixel of all this.
    """

    grid: int = 8
    downsample: int = 1
    kernel: ClassVar[Callable[..., None]] = staticmethod(spike_first)

    def state(self, resolution: Resolution) -> tuple[Callable[[IntArray], NDArray[Any]], tuple[Any, ...]]:
        """See `_GridOfSpikes`."""
        weights = np.rint(gabor_filters(7, self.n_orientations)).astype(np.int32)
        limits = np.array([150, 25, 5, 5, 4], np.int64)
        height, width = resolution
        cells = -(-height // 4), -(-width // 4), self.n_orientations
        potential = np.zeros((2, height, width, self.n_orientations), np.int32)
        updated, fired = np.zeros((2, height, width), np.int64), np.full((2, height, width), BEFORE_TIME)
        pooled, counts = np.full(cells, BEFORE_TIME), np.zeros(cells, np.int64)
        state = weights, limits, potential, updated, fired, pooled, counts
        return lambda t: t // 1000, state


@dataclass(frozen=True, slots=True)
class LeakySpikes(_GridOfSpikes):
    """Gabor-SNN: Gabor filters and leaky integrate-and-fire neurons, as HATS is compared with.

    Sironi et al. (2018, "HATS", CVPR) built a network of their own for comparison, of Gabor filters and leaky
    integrate-and-fire neurons, after Lee et al. (2016) and Bichler et al. (2012, "Extraction of temporally
    correlated features from dynamic vision sensors with spike-timing-dependent plasticity"), whose neurons
    these are. Their code is not published, and its parameters are not known to us: those here are ours, and
    so is the name's only claim, filters and neurons. The filters are those of HFirst, potentials fade to 1/e
    in 10 ms, the threshold is 150 mV, the refractory time 5 ms for the neuron itself, without inhibition of
    others. Spikes are counted on a grid over the sample, without a second layer; the same classifier as every
    method's features.

    Attributes:
        grid: rows and columns of the grid.
        tau_us: time in which a potential fades to 1/e.
        downsample: sensor pixels along each side of a pixel of all this.
    """

    grid: int = 8
    tau_us: float = 10_000.0
    downsample: int = 1
    kernel: ClassVar[Callable[..., None]] = staticmethod(spike_leaky)

    def state(self, resolution: Resolution) -> tuple[Callable[[IntArray], NDArray[Any]], tuple[Any, ...]]:
        """See `_GridOfSpikes`."""
        weights = gabor_filters(7, self.n_orientations)
        height, width = resolution
        neurons = 2, height, width, self.n_orientations
        potential, updated, fired = np.zeros(neurons), np.zeros(neurons[:3]), np.full(neurons, -np.inf)
        counts = np.zeros((-(-height // 4), -(-width // 4), self.n_orientations), np.int64)
        state = weights, 150.0, 5_000 / self.tau_us, 4, potential, updated, fired, counts
        return lambda t: t / self.tau_us, state
