"""DART, for comparison: a bag of words of log-polar descriptors.

Lives here: the log-polar grid, and words as a map from the events of a sample to a feature vector.
Not here: the loop over events (`kernels.retina`), methods of time surfaces (`surfaces`).
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.evaluate.samples import centres, downsampled, some_training_samples, until
from streamfeat.events import Events, Resolution
from streamfeat.kernels.retina import describe_events
from streamfeat.recordings.reader import Recording

__all__ = ["RetinalWords", "log_polar_places"]

_FITTED_SAMPLES = 500
"""Training samples that words are learned from."""

_CHUNK = 8192
"""Events whose descriptors are in memory at a time."""

IntArray = NDArray[np.int64]


def log_polar_places(radius: int, rings: int, wedges: int) -> IntArray:
    """The place of each offset in a grid of wedges and of rings, each as much wider as the one before.

    Returns:
        `(2 R + 1, 2 R + 1)` int64, ring * wedges + wedge; -1 for the centre and beyond the last ring.
    """
    row, column = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    distance = np.hypot(row, column)
    inside = (distance >= 1) & (distance <= radius)
    share = np.log(np.maximum(distance, 1)) / np.log(max(radius, 2))
    ring = np.minimum((share * rings).astype(np.int64), rings - 1)
    turn = np.arctan2(row, column) / (2 * np.pi) % 1.0
    wedge = np.rint(turn * wedges).astype(np.int64) % wedges
    return np.where(inside, ring * wedges + wedge, -1).astype(np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class RetinalWords:
    """DART as a bag of words (Ramesh, Yang, Orchard, Le Thi, Zhang and Xiang 2019, "DART: Distribution Aware
    Retinal Transform for Event-based Cameras", TPAMI, arXiv:1710.10800).

    As its abstract says: a queue of the latest events, a log-polar grid around each new one, the distribution
    of the remembered events over its rings and wedges as the descriptor, and descriptors as the local
    features of a bag-of-words classifier. The text of the paper could not be had while this was written, so
    these are assumptions, not its parameters: 7 rings and 12 wedges between 1 and 16 pixels, a queue of
    2,000 events, both polarities alike, each event in one place of the grid and its own pixel in none,
    descriptors that sum to 1, 500 words by k-means, each descriptor the nearest word's alone. Known
    deviations: a histogram for each quadrant, as our codes are pooled, in place of a spatial pyramid, and
    the linear classifier of every method.

    Attributes:
        words: `(n, rings * wedges)` float32.
        radius: of the grid, in pixels.
        rings: of the grid.
        wedges: of the grid.
        remembered: events in the queue.
        downsample: sensor pixels along each side of a pixel of all this.
    """

    words: NDArray[np.float32]
    radius: int = 16
    rings: int = 7
    wedges: int = 12
    remembered: int = 2_000
    downsample: int = 1

    @classmethod
    def fitted(
        cls,
        recordings: Sequence[Recording],
        n_words: int = 500,
        n_descriptors: int = 50_000,
        seed: int = 0,
        downsample: int = 1,
    ) -> "RetinalWords":
        """Words of the descriptors at random events of random training samples.

        Raises:
            InputError: there is no event.
        """
        rng = np.random.default_rng(seed)
        n_samples, samples = some_training_samples(recordings, _FITTED_SAMPLES, rng)
        each = -(-n_descriptors // max(n_samples, 1))
        blank = cls(np.zeros((0, 0), np.float32), downsample=downsample)
        drawn = []
        for sample in samples:
            events, resolution = downsampled(sample.events, sample.resolution, downsample)
            x, y, _, _ = until(events, resolution)
            picked = np.sort(rng.integers(0, max(len(x), 1), each))
            for start, part in blank.described(x, y, resolution):
                here = picked[(picked >= start) & (picked < start + len(part))]
                drawn.append(part[here - start])
        descriptors = np.concatenate(drawn) if drawn else np.zeros((0, 1), np.float32)
        if not len(descriptors):
            raise InputError("the training samples have no events; dart has nothing to learn from")
        return cls(centres(descriptors, min(n_words, len(descriptors)), seed), downsample=downsample)

    @property
    def n_features(self) -> int:
        """Each word in four quadrants."""
        return 4 * len(self.words)

    @property
    def fingerprint(self) -> str:
        """Everything that decides what features are."""
        numbers = self.radius, self.rings, self.wedges, self.remembered, self.downsample
        return hashlib.sha256(repr(numbers).encode() + self.words.tobytes()).hexdigest()

    def encode(
        self, events: Events, resolution: Resolution, *, origin_us: int | None = None, t_us: int | None = None
    ) -> NDArray[np.float32]:
        """Features `(n_features,)` of the events from `origin_us` to `t_us`."""
        events, resolution = downsampled(events, resolution, self.downsample)
        x, y, _, _ = until(events, resolution, origin_us, t_us)
        quadrant = 2 * (2 * y >= resolution[0]) + (2 * x >= resolution[1])
        counts = np.zeros(self.n_features, np.int64)
        half = np.square(self.words).sum(axis=1) / 2
        for start, part in self.described(x, y, resolution):
            # |s - w|^2 is least where w.s - |w|^2 / 2 is largest.
            nearest = (part @ self.words.T - half).argmax(axis=1)
            places = quadrant[start : start + len(part)] * len(self.words) + nearest
            counts += np.bincount(places, minlength=self.n_features)
        return counts.astype(np.float32)

    def described(
        self, x: IntArray, y: IntArray, resolution: Resolution
    ) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Descriptors `(n, rings * wedges)` of a chunk of events at a time, with the number of its first."""
        state = self.state(resolution)
        for start in range(0, len(x), _CHUNK):
            some = slice(start, start + _CHUNK)
            out = np.empty((len(x[some]), self.rings * self.wedges), np.float32)
            describe_events(x[some], y[some], *state, out)
            yield start, out

    def state(self, resolution: Resolution) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """What `describe_events` takes between the events and what it writes to."""
        places = log_polar_places(self.radius, self.rings, self.wedges)
        height, width = (side + 2 * self.radius for side in resolution)
        recent, queue = np.zeros((height, width), np.int64), np.full(self.remembered, -1, np.int64)
        return places, recent, queue, np.zeros(1, np.int64)
