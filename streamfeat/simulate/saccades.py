"""A small event-camera simulation: still images seen by a camera that makes saccades.

Lives here: the camera model, the saccades, and labelled samples made from scikit-learn's handwritten digits,
so that a demonstration, a test or a benchmark needs no download.
Not here: files (see `recording`), real data sets (see `datasets`), or anything that learns.

The pixel is the idealised one of Lichtsteiner, Posch and Delbruck (2008, "A 128x128 120 dB 15 us latency
asynchronous temporal contrast vision sensor"): it memorises a log intensity, fires when the present one
has moved away from it by a contrast threshold, is held in reset for a refractory time, and memorises anew.
The motion is that of Orchard, Jayawant, Cohen and Thakor (2015, "Converting static image datasets to spiking
neuromorphic datasets using saccades"), the recipe of N-MNIST. Between two rendered frames log intensity
is linear in time, as in ESIM (Rebecq, Gehrig and Scaramuzza 2018, "ESIM: an open event camera simulator"),
which gives each crossing a microsecond time. We deviate from ESIM in two ways: frames come at fixed steps
instead of adaptive ones, since the speed is known in advance; and a pixel takes its new reference where
the refractory time ends, as the circuit does, not where the crossing was.

Left out: leak events, the finite and intensity-dependent bandwidth of the photoreceptor, noise that depends
on intensity or resets the pixel, arbitration and bus delays, hot pixels, and lens and motion blur.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.datasets import load_digits

from streamfeat.events import Events, Resolution, make_events

__all__ = [
    "CameraModel",
    "DigitSample",
    "Saccades",
    "digit_samples",
    "events_from_frames",
    "simulate_saccades",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

N_TEST_DIGITS = 500
"""Images kept for the test split, 50 of each class; the other 1,297 are for training."""

QUANTUM = 2.0**-20
"""Grid of log intensities and thresholds. `exp` and `log` differ in the last bit from machine to machine;
what is rounded to this grid does not, and from there on plain arithmetic gives the same events everywhere."""


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A contrast-detecting sensor.

    Attributes:
        resolution: `(height, width)` in pixels.
        threshold: change of natural-log intensity that makes an event, the same for ON and OFF.
        threshold_mismatch: standard deviation, over pixels and polarities, of the logarithm of the threshold.
        mismatch_seed: the mismatch belongs to the sensor, so it has its own seed: two samples share it.
        refractory_us: microseconds for which a pixel is dead after an event.
        noise_hz: background events per pixel and second, before those in the refractory time are lost.
        black_level: light from a black scene relative to a white one; bounds the contrast.

    Raises:
        ValueError: a value is outside the range that has a meaning.
    """

    resolution: Resolution = (34, 34)
    threshold: float = 0.45
    threshold_mismatch: float = 0.1
    mismatch_seed: int = 0
    refractory_us: int = 1_000
    noise_hz: float = 0.2
    black_level: float = 0.08

    def __post_init__(self) -> None:
        """Refuse values for which the model is undefined."""
        if min(self.resolution) < 1:
            raise ValueError(f"resolution must be at least (1, 1), got {self.resolution}")
        if self.threshold <= 0 or self.black_level <= 0:
            raise ValueError("threshold and black_level must be positive")
        if self.threshold_mismatch < 0 or self.refractory_us < 0 or self.noise_hz < 0:
            raise ValueError("threshold_mismatch, refractory_us and noise_hz must not be negative")

    def thresholds(self) -> FloatArray:
        """Thresholds of every pixel, `(2, height * width)` float64, natural-log units: OFF, then ON."""
        height, width = self.resolution
        spread = np.random.default_rng(self.mismatch_seed).standard_normal((2, height * width))
        # Lognormal, so that no draw gives a threshold that is not positive.
        return np.maximum(_on_grid(self.threshold * np.exp(self.threshold_mismatch * spread)), QUANTUM)


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
) -> Events:
    """Simulate a camera that looks at a still image and makes three saccades.

    Args:
        image: `(rows, cols)` float, linear intensity, 0 (black) to 1 (white); black all around. Unchanged.
        rng: source of the background noise; advanced.
        camera: sensor; None is `CameraModel()`.
        saccades: motion; None is `Saccades()`.

    Returns:
        `(n,)` array of `EVENT_DTYPE` sorted by `t`, with `0 <= t < 300_000` microseconds by default.

    Raises:
        ValueError: `image` is not two-dimensional, or has values outside 0 to 1.
    """
    image = np.asarray(image, np.float64)
    # Written so that NaN is refused too.
    if image.ndim != 2 or not image.size or not (image.min() >= 0 and image.max() <= 1):
        raise ValueError("image must be two-dimensional, with values from 0 to 1")
    camera, saccades = camera or CameraModel(), saccades or Saccades()
    times, shifts = saccades.path()
    scale = saccades.image_px / max(image.shape)
    rows = _spline_weights(camera.resolution[0], image.shape[0], scale, shifts[:, 0])
    cols = _spline_weights(camera.resolution[1], image.shape[1], scale, shifts[:, 1])
    frames = rows @ image @ cols.transpose(0, 2, 1)
    return events_from_frames(np.log(camera.black_level + frames), times, rng, camera)


def events_from_frames(
    log_frames: FloatArray, times_us: IntArray, rng: np.random.Generator, camera: CameraModel
) -> Events:
    """Turn a film of log intensity into events.

    The first frame sets every pixel's reference. Between frames log intensity is linear in time, and an event
    bears the microsecond in which its crossing falls.

    Args:
        log_frames: `(n_frames, height, width)` float64, natural-log intensity. Unchanged.
        times_us: `(n_frames,)` int64, increasing, microseconds. Unchanged.
        rng: source of the background noise; advanced.
        camera: sensor of the same resolution.

    Returns:
        `(n,)` array of `EVENT_DTYPE` sorted by `t`, with `times_us[0] <= t < times_us[-1]`.

    Raises:
        ValueError: the frames do not fit the camera or the times.
    """
    if log_frames.shape != (len(times_us), *camera.resolution) or len(times_us) < 2:
        raise ValueError(
            f"{len(times_us)} times and resolution {camera.resolution} do not fit frames {log_frames.shape}"
        )
    if (np.diff(times_us) <= 0).any():
        raise ValueError("times_us must increase")
    film = _on_grid(log_frames.reshape(len(times_us), -1))
    pixel, polarity, t = _crossings(film, times_us.astype(np.float64), camera)
    noise_pixel, noise_polarity, noise_t = _background(times_us, rng, camera)

    pixel, polarity = np.append(pixel, noise_pixel), np.append(polarity, noise_polarity)
    t = np.append(t, noise_t)
    is_noise = np.arange(len(t)) >= len(t) - len(noise_t)
    kept = _outside_refractory(pixel, t, is_noise, camera.refractory_us)
    kept = kept[t[kept] < times_us[-1]]
    kept = kept[np.lexsort((pixel[kept], t[kept]))]
    width = camera.resolution[1]
    return make_events(pixel[kept] % width, pixel[kept] // width, polarity[kept], t[kept])


def _crossings(
    film: FloatArray, times: FloatArray, camera: CameraModel
) -> tuple[IntArray, NDArray[np.bool_], IntArray]:
    """Pixel, polarity and microsecond of every threshold crossing of a film `(n_frames, n_pixels)`."""
    off, on = camera.thresholds()
    reference = film[0].copy()
    release = np.full(film.shape[1], times[0])  # when each pixel's reset ends, or ended
    trains: list[tuple[IntArray, NDArray[np.bool_], FloatArray, FloatArray, IntArray]] = []
    for before, after, start, end in zip(film[:-1], film[1:], times[:-1], times[1:], strict=True):
        pixel = ((release > start) & (release <= end)).nonzero()[0]
        slope = (after[pixel] - before[pixel]) / (end - start)
        reference[pixel] = before[pixel] + slope * (release[pixel] - start)

        # Few pixels get as far as a threshold in one interval; only those are worth a division.
        change = after - reference
        beyond = (change >= on) | (change <= -off)
        pixel = (beyond & (release <= end) & (after != before)).nonzero()[0]
        slope = (after[pixel] - before[pixel]) / (end - start)
        rising = slope > 0
        step = np.where(rising, on[pixel], -off[pixel])
        first = start + (reference[pixel] + step - before[pixel]) / slope
        # Rounding may put a crossing a hair outside the interval in which it was noticed.
        first = np.minimum(np.maximum(first, start), end)
        # On a straight line a pixel repeats itself: reset, then a full threshold's worth of change.
        period = camera.refractory_us + step / slope
        count = np.floor((end - first) / period).astype(np.int64) + 1
        trains.append((pixel, rising, first, period, count))

        # A release after `end` is dealt with in the interval where it falls.
        ready = first + (count - 1) * period + camera.refractory_us
        release[pixel] = ready
        reference[pixel] = before[pixel] + slope * (ready - start)

    pixel, rising, first, period, count = (np.concatenate(column) for column in zip(*trains, strict=True))
    nth = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    t = np.repeat(first, count) + nth * np.repeat(period, count)
    return np.repeat(pixel, count), np.repeat(rising, count), t.astype(np.int64)


def _background(
    times_us: IntArray, rng: np.random.Generator, camera: CameraModel
) -> tuple[IntArray, NDArray[np.bool_], IntArray]:
    """Pixel, polarity and microsecond of background events: a Poisson process over time and sensor."""
    n_pixels = camera.resolution[0] * camera.resolution[1]
    n = rng.poisson(camera.noise_hz * n_pixels * float(times_us[-1] - times_us[0]) * 1e-6)
    pixel = rng.integers(0, n_pixels, n)
    return pixel, rng.random(n) < 0.5, rng.integers(times_us[0], times_us[-1], n)


def _outside_refractory(
    pixel: IntArray, t: IntArray, is_noise: NDArray[np.bool_], refractory_us: int
) -> IntArray:
    """Indices of what remains once noise too close to another event of its pixel is lost."""
    order = np.lexsort((t, pixel))
    too_close = (np.diff(pixel[order]) == 0) & (np.diff(t[order]) < refractory_us)
    crowded = np.append(too_close, False) | np.insert(too_close, 0, False)
    kept: IntArray = order[~(crowded & is_noise[order])]
    return kept


def _spline_weights(n_pixels: int, n_samples: int, scale: float, shifts: FloatArray) -> FloatArray:
    """Weights `(n_frames, n_pixels, n_samples)` that draw a row of samples on pixels, scaled and shifted.

    Cubic B-splines: smooth, never negative, exact at any sub-pixel shift, and black beyond the border.
    """
    centred = np.arange(n_pixels) - (n_pixels - 1) / 2
    position = (centred - shifts[:, None]) / scale + (n_samples - 1) / 2
    distance = np.abs(position[:, :, None] - np.arange(n_samples))
    tail = np.maximum(2.0 - distance, 0.0)
    core = np.maximum(1.0 - distance, 0.0)
    return (tail * tail * tail - 4.0 * core * core * core) / 6.0


def _class_by_class(labels: IntArray, rng: np.random.Generator) -> IntArray:
    """A random order of all samples in which classes take turns for as long as each has samples left."""
    shuffled = rng.permutation(len(labels))
    turn = np.empty(len(labels), np.int64)
    for label in np.unique(labels):
        members = labels[shuffled] == label
        turn[members] = np.arange(members.sum())
    return shuffled[np.argsort(turn, kind="stable")]


def _on_grid(values: FloatArray) -> FloatArray:
    """Round to multiples of `QUANTUM`."""
    return np.rint(values / QUANTUM) * QUANTUM
