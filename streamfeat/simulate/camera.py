"""The camera: a film of log intensity in, events out.

Lives here: `CameraModel`, the sensor's properties, and `EventCamera`, which sees one frame after another.
Not here: what there is to see (`saccades`, `films`), and the loop over pixels (`streamfeat.kernels.pixels`).

The pixel is the idealised one of Lichtsteiner, Posch and Delbruck (2008, "A 128x128 120 dB 15 us latency
asynchronous temporal contrast vision sensor"): it memorises a log intensity, fires when the present one
has moved away from it by a contrast threshold, is held in reset for a refractory time, and memorises anew.
Between two frames log intensity is linear in time, as in ESIM (Rebecq, Gehrig and Scaramuzza 2018, "ESIM: an
open event camera simulator"), which gives each crossing a microsecond time. We deviate from ESIM in two
ways: frames come when they come instead of at adaptive steps; and a pixel takes its new reference where the
refractory time ends, as the circuit does, not where the crossing was. The photoreceptor is a low-pass filter
of first order on log intensity, stepped from frame to frame, as in v2e (Hu, Liu and Delbruck 2021, "v2e: from
video frames to realistic DVS events", section 4), but with one cut-off frequency whatever the intensity.

Left out: leak events, noise that depends on intensity or resets the pixel, arbitration and bus delays, hot
pixels, and lens and motion blur.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from streamfeat.events import Events, Resolution, make_events
from streamfeat.kernels.pixels import fire_pixels

__all__ = ["CameraModel", "EventCamera", "events_from_frames"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

QUANTUM = 2.0**-20
"""Grid of log intensities and thresholds. `exp` and `log` differ in the last bit from machine to machine;
what is rounded to this grid does not, and from there on plain arithmetic gives the same events everywhere."""

_ROOM = 1 << 15
"""Events that a call of the kernel has room for, at first."""


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
        bandwidth_hz: cut-off frequency of the photoreceptor; 0 for one that follows at once.

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
    bandwidth_hz: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values for which the model is undefined."""
        if min(self.resolution) < 1:
            raise ValueError(f"resolution must be at least (1, 1), got {self.resolution}")
        # Written so that NaN is refused too.
        if not (self.threshold > 0 and self.black_level > 0):
            raise ValueError("threshold and black_level must be positive")
        if not min(self.threshold_mismatch, self.refractory_us, self.noise_hz, self.bandwidth_hz) >= 0:
            raise ValueError(
                "threshold_mismatch, refractory_us, noise_hz and bandwidth_hz must not be negative"
            )

    def thresholds(self) -> FloatArray:
        """Thresholds of every pixel, `(2, height * width)` float64, natural-log units: OFF, then ON."""
        height, width = self.resolution
        spread = np.random.default_rng(self.mismatch_seed).standard_normal((2, height * width))
        # Lognormal, so that no draw gives a threshold that is not positive.
        return np.maximum(_on_grid(self.threshold * np.exp(self.threshold_mismatch * spread)), QUANTUM)


class EventCamera:
    """A camera that sees one frame after another and gives its events from time to time.

    Which frames come between two calls of `events` changes the noise that is drawn, and nothing else.

    Args:
        model: the sensor.
        rng: source of the background noise; advanced.
    """

    def __init__(self, model: CameraModel, rng: np.random.Generator) -> None:
        """See nothing yet."""
        self._model, self._rng = model, rng
        self._thresholds = model.thresholds()
        self._reference = np.zeros(self._thresholds.shape[1])
        self._release = np.zeros_like(self._reference)
        self._level = np.zeros_like(self._reference)  # what the photoreceptors tell
        self._now_us: int | None = None
        self._noise_from_us = 0
        self._given_us = 0
        self._room = np.empty((3, _ROOM), np.int64)
        self._trains: list[IntArray] = []  # (pixel, polarity, t), each in rows
        self._held = np.empty((4, 0), np.int64)  # the same and whether it is noise

    def see(self, log_frame: FloatArray, t_us: int) -> None:
        """The next frame; the first one sets every pixel's reference.

        Args:
            log_frame: `(height, width)` float64, natural-log intensity. Unchanged.
            t_us: its time in microseconds, later than the one before.

        Raises:
            ValueError: the frame does not fit the sensor, or its time is not later.
        """
        if log_frame.shape != self._model.resolution:
            raise ValueError(f"a frame of {log_frame.shape} does not fit {self._model.resolution}")
        level = _on_grid(log_frame.reshape(-1))
        if self._now_us is None:
            self._now_us = self._noise_from_us = self._given_us = t_us
            self._level, self._reference = level, level.copy()
            self._release[:] = t_us
            return
        if t_us <= self._now_us:
            raise ValueError(f"frames must come at increasing times; {t_us} us follows {self._now_us} us")
        if self._model.bandwidth_hz:
            share = -math.expm1(-2 * math.pi * self._model.bandwidth_hz * (t_us - self._now_us) * 1e-6)
            level = _on_grid(self._level + round(share / QUANTUM) * QUANTUM * (level - self._level))
        pixel, start, end = 0, float(self._now_us), float(t_us)
        while pixel < len(level):
            pixel, n = fire_pixels(
                self._level,
                level,
                start,
                end,
                self._thresholds,
                float(self._model.refractory_us),
                self._reference,
                self._release,
                pixel,
                *self._room,
            )
            self._trains.append(self._room[:, :n].copy())
            if pixel < len(level) and n == 0:  # one pixel has more events than there is room for
                self._room = np.empty((3, 2 * self._room.shape[1]), np.int64)
        self._level, self._now_us = level, t_us

    def events(self, *, last: bool = False) -> Events:
        """The events that no later frame can change and that were not given before, with noise among them.

        Args:
            last: no frame follows; give all that is left.

        Returns:
            `(n,)` array of `EVENT_DTYPE` sorted by `t`, before the time of the latest frame.
        """
        if self._now_us is None:
            return make_events(*np.zeros((4, 0), np.int64))
        noise = self._background()
        trains = np.concatenate([*self._trains, np.empty((3, 0), np.int64)], axis=1)
        self._trains.clear()
        fresh = np.concatenate([trains, noise], axis=1)
        is_noise = np.arange(fresh.shape[1]) >= trains.shape[1]
        known = np.concatenate([self._held, np.vstack([fresh, is_noise])], axis=1)

        # An event that is still to come may be too close to noise in the last refractory time.
        dead_us = self._model.refractory_us
        until_us = self._now_us - (0 if last else dead_us)
        kept = _outside_refractory(known, self._model.resolution, dead_us)
        kept = kept[(known[2, kept] >= self._given_us) & (known[2, kept] < until_us)]
        kept = kept[np.argsort(self._places(known[:, kept]), kind="stable")]
        self._held = known[:, known[2] >= until_us - dead_us]
        self._given_us = max(self._given_us, until_us)
        width = self._model.resolution[1]
        pixel, polarity, t, _ = known[:, kept]
        return make_events(pixel % width, pixel // width, polarity, t)

    def _places(self, known: IntArray) -> IntArray:
        """The order of events, by time and then by pixel: one number each, which sorts faster than two."""
        places: IntArray = (known[2] - self._noise_from_us) * len(self._level) + known[0]
        return places

    def _background(self) -> IntArray:
        """Pixel, polarity and microsecond of background events: a Poisson process over time and sensor."""
        start_us, end_us = self._noise_from_us, self._now_us or 0
        if end_us == start_us:
            return np.empty((3, 0), np.int64)
        self._noise_from_us = end_us
        n_pixels, rng = len(self._level), self._rng
        n = rng.poisson(self._model.noise_hz * n_pixels * float(end_us - start_us) * 1e-6)
        pixel = rng.integers(0, n_pixels, n)
        return np.stack([pixel, rng.random(n) < 0.5, rng.integers(start_us, end_us, n)])


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
    seeing = EventCamera(camera, rng)
    for frame, t_us in zip(log_frames, times_us.tolist(), strict=True):
        seeing.see(frame, t_us)
    return seeing.events(last=True)


def _outside_refractory(known: IntArray, resolution: Resolution, refractory_us: int) -> IntArray:
    """Indices of what remains once noise too close to another event of its pixel is lost.

    Args:
        known: `(4, n)` pixel, polarity, time and whether it is noise.
        resolution: of the sensor.
        refractory_us: how close is too close.
    """
    pixel, _, t, is_noise = known
    noisy = np.zeros(resolution[0] * resolution[1], np.bool_)
    noisy[pixel[is_noise == 1]] = True
    near = np.flatnonzero(noisy[pixel])
    order = near[np.lexsort((t[near], pixel[near]))]
    too_close = (np.diff(pixel[order]) == 0) & (np.diff(t[order]) < refractory_us)
    crowded = np.append(too_close, False) | np.insert(too_close, 0, False) if len(order) else too_close
    left_out = np.zeros(known.shape[1], np.bool_)
    left_out[order[crowded & (is_noise[order] == 1)]] = True
    return np.flatnonzero(~left_out)


def _on_grid(values: FloatArray) -> FloatArray:
    """Round to multiples of `QUANTUM`."""
    on_grid = values * (1 / QUANTUM)
    np.rint(on_grid, out=on_grid)
    on_grid *= QUANTUM
    return on_grid
