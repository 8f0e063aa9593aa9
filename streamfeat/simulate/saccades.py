"""Still images seen by a camera that makes saccades.

Lives here: the motion, drawing an image where it takes it, and labelled samples made from scikit-learn's
handwritten digits, so that a demonstration, a test or a benchmark needs no download.
Not here: the camera (`camera`), image files (`pictures`), or anything that learns.

The motion is that of Orchard, Jayawant, Cohen and Thakor (2015, "Converting static image datasets to spiking
neuromorphic datasets using saccades"), the recipe of N-MNIST and N-Caltech101: three saccades of 100 ms along
an isosceles triangle. Frames come at fixed steps, since the speed is known in advance.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.datasets import load_digits

from streamfeat.events import Events
from streamfeat.kernels.pixels import draw_picture
from streamfeat.simulate.camera import CameraModel, EventCamera

__all__ = ["DigitSample", "Saccades", "digit_samples", "simulate_saccades"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

N_TEST_DIGITS = 500
"""Images kept for the test split, 50 of each class; the other 1,297 are for training."""


@dataclass(frozen=True, slots=True)
class Saccades:
    """Three saccades along an isosceles triangle, each smooth from rest to rest.

    The image goes from top left to bottom middle, to top right, and straight back to the left: the directions
    and sizes seen in N-MNIST. Its speed is that of a minimum-jerk movement.

    Attributes:
        image_px: longer side of the image on the sensor, in pixels.
        amplitude_px: largest `(vertical, horizontal)` displacement from the centre, in pixels.
        saccade_us: microseconds for one saccade.
        step_us: microseconds between rendered frames; log intensity is linear in between. By default the
            image moves by at most 0.6 pixels in a step.

    Raises:
        ValueError: a length of space or time is not positive.
    """

    image_px: float = 16.0
    amplitude_px: tuple[float, float] = (2.4, 4.0)
    saccade_us: int = 100_000
    step_us: int = 4_000

    def __post_init__(self) -> None:
        """Refuse values for which there is no motion to render."""
        if self.image_px <= 0 or self.saccade_us <= 0 or self.step_us <= 0:
            raise ValueError("image_px, saccade_us and step_us must be positive")

    def path(self) -> tuple[IntArray, FloatArray]:
        """Where the image is at each frame.

        Returns:
            Times `(n_frames,)` int64 in microseconds, from 0 to `3 * saccade_us`, and displacements
            `(n_frames, 2)` float64 in pixels, `(vertical, horizontal)`.
        """
        duration_us = 3 * self.saccade_us
        times = np.append(np.arange(0, duration_us, self.step_us, dtype=np.int64), duration_us)
        corners = np.array([[-1.0, -1.0], [1.0, 0.0], [-1.0, 1.0], [-1.0, -1.0]]) * self.amplitude_px
        leg = np.minimum(times // self.saccade_us, 2)
        u = times / self.saccade_us - leg
        travelled = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u)
        return times, corners[leg] + travelled[:, None] * (corners[leg + 1] - corners[leg])


class DigitSample(NamedTuple):
    """The events of one digit: `(n,)` `EVENT_DTYPE` sorted by time, and what is known of it."""

    events: Events
    label: str
    split: str
    source: str


def digit_samples(
    n: int,
    seed: int,
    split: str = "train",
    camera: CameraModel | None = None,
    saccades: Saccades | None = None,
) -> Iterator[DigitSample]:
    """Simulate handwritten digits: the 1,797 images of 8x8 pixels that come with scikit-learn.

    No image is in both splits of one seed. Classes take turns, so any `n` is balanced to within one sample
    a class. A sample depends on `seed` and its image only, not on `n` or on the samples before it.

    Args:
        n: number of samples; at most 500 for test and 1,297 for train.
        seed: seeds both the choice of images and their noise.
        split: `"train"` or `"test"`.
        camera: sensor; None is `CameraModel()`.
        saccades: motion; None is `Saccades()`.

    Yields:
        Samples whose `label` is "0" to "9" and whose `source` names the image by its index.

    Raises:
        ValueError: unknown `split`, or `n` is more than the split has.
    """
    digits = load_digits()
    order = _class_by_class(digits.target, np.random.default_rng(seed))
    pools = {"train": order[N_TEST_DIGITS:], "test": order[:N_TEST_DIGITS]}
    if split not in pools:
        raise ValueError(f"split must be 'train' or 'test', got {split!r}")
    if not 0 <= n <= len(pools[split]):
        raise ValueError(f"split {split!r} has {len(pools[split])} digits, got n={n}")
    for index in pools[split][:n].tolist():
        events = simulate_saccades(
            digits.images[index] / 16.0, np.random.default_rng([seed, index]), camera, saccades
        )
        yield DigitSample(events, str(digits.target[index]), split, f"sklearn.load_digits/{index}")


def simulate_saccades(
    image: FloatArray,
    rng: np.random.Generator,
    camera: CameraModel | None = None,
    saccades: Saccades | None = None,
    *,
    goes_on: bool = False,
) -> Events:
    """Simulate a camera that looks at a still image and makes three saccades.

    Args:
        image: `(rows, cols)` float, linear intensity, 0 (black) to 1 (white). Unchanged.
        rng: source of the background noise; advanced.
        camera: sensor; None is `CameraModel()`.
        saccades: motion; None is `Saccades()`.
        goes_on: beyond its border the image goes on as it is at the border; without, all is black there.

    Returns:
        `(n,)` array of `EVENT_DTYPE` sorted by `t`, with `0 <= t < 300_000` microseconds by default.

    Raises:
        ValueError: `image` is not two-dimensional, or has values outside 0 to 1.
    """
    image = np.ascontiguousarray(image, np.float64)
    # Written so that NaN is refused too.
    if image.ndim != 2 or not image.size or not (image.min() >= 0 and image.max() <= 1):
        raise ValueError("image must be two-dimensional, with values from 0 to 1")
    camera, saccades = camera or CameraModel(), saccades or Saccades()
    times, shifts = saccades.path()
    scale = saccades.image_px / max(image.shape)
    rows = _spline(camera.resolution[0], image.shape[0], scale, shifts[:, 0], goes_on)
    columns = _spline(camera.resolution[1], image.shape[1], scale, shifts[:, 1], goes_on)
    seeing = EventCamera(camera, rng)
    scratch, frame = np.empty(image.shape[1]), np.empty(camera.resolution)
    for t_us, (row, row_weights), (column, column_weights) in zip(
        times.tolist(), zip(*rows, strict=True), zip(*columns, strict=True), strict=True
    ):
        draw_picture(image, row, row_weights, column, column_weights, scratch, frame)
        frame += camera.black_level
        seeing.see(np.log(frame, out=frame), t_us)
    return seeing.events(last=True)


def _spline(
    n_pixels: int, n_samples: int, scale: float, shifts: FloatArray, goes_on: bool
) -> tuple[IntArray, FloatArray]:
    """Samples and weights, each `(n_frames, n_pixels, 4)`, that draw a row of samples, scaled and shifted.

    Cubic B-splines: smooth, never negative, exact at any sub-pixel shift; beyond the border black, or the
    outermost sample again and again.
    """
    centred = np.arange(n_pixels) - (n_pixels - 1) / 2
    position = (centred - shifts[:, None]) / scale + (n_samples - 1) / 2
    sample = np.floor(position).astype(np.int64)[:, :, None] + np.arange(-1, 3)
    distance = np.abs(position[:, :, None] - sample)
    tail = np.maximum(2.0 - distance, 0.0)
    core = np.maximum(1.0 - distance, 0.0)
    weights = (tail * tail * tail - 4.0 * core * core * core) / 6.0
    inside = sample.clip(0, n_samples - 1)
    return inside, weights if goes_on else np.where(sample == inside, weights, 0.0)


def _class_by_class(labels: IntArray, rng: np.random.Generator) -> IntArray:
    """A random order of all samples in which classes take turns for as long as each has samples left."""
    shuffled = rng.permutation(len(labels))
    turn = np.empty(len(labels), np.int64)
    for label in np.unique(labels):
        members = labels[shuffled] == label
        turn[members] = np.arange(members.sum())
    return shuffled[np.argsort(turn, kind="stable")]
