"""From a method's name and a setting to a map from events to features.

Lives here: learning with either formulation, and the filters that those are compared with.
Not here: methods without filters (`surfaces`), and what features are good for (`cell`).
"""

from collections.abc import Callable, Iterator, Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from streamfeat.encoder import Encoder, FeatureMap, Formulation
from streamfeat.errors import InputError
from streamfeat.evaluate.plan import Setting
from streamfeat.evaluate.surfaces import AveragedSurfaces, CountImage, SurfaceHistogram
from streamfeat.geometry import Geometry
from streamfeat.learn.chunks import LazyVolumes, chunks
from streamfeat.learn.fit import THRESHOLDS, bin_length, learn_encoder
from streamfeat.learn.volumes import Window, sample_volumes, windows_of
from streamfeat.learn.whitening import VolumeWhitener
from streamfeat.recording import Recording

__all__ = ["make_features", "random_filters", "spherical_means"]

Report = Callable[[str, int, int, str], None]
"""Called with (step, done, of how many, remark)."""

_CHUNK = 4096


def make_features(
    method: str, recordings: Sequence[Recording], setting: Setting, report: Report
) -> FeatureMap:
    """Learn what a method learns, from samples that are not held out.

    Args:
        method: one of `plan.METHODS`.
        recordings: open recordings.
        setting: used by methods with filters.
        report: told about progress.

    Raises:
        InputError: a value of the setting is out of range, or there is too little to learn from.
        KeyboardInterrupt: Ctrl-C, at any time.
    """
    if method == "counts":
        return CountImage()
    if method == "hats":
        return AveragedSurfaces.fitted(recordings)
    if method == "hots":
        return SurfaceHistogram.fitted(recordings, seed=setting.seed)
    bin_us = bin_length(recordings, setting.bins, setting.window_ms)
    geometry = Geometry(
        setting.patch, setting.stride, setting.bins, bin_us, setting.downsample, setting.max_count
    )
    if method in ("kmeans", "random"):
        return _encoder_of(method, recordings, geometry, setting, report)
    encoder = learn_encoder(
        recordings,
        geometry,
        formulation=cast(Formulation, method),
        encoding=setting.encoding,
        n_filters=setting.filters,
        threshold=setting.threshold,
        n_volumes=setting.volumes,
        max_iter=setting.iterations,
        seed=setting.seed,
        report=report,
    )
    if encoder.provenance["interrupted"]:  # an encoder of fewer iterations is not what was asked for
        raise KeyboardInterrupt
    return encoder


def _encoder_of(
    method: str, recordings: Sequence[Recording], geometry: Geometry, setting: Setting, report: Report
) -> Encoder:
    """The pipeline of the direct formulation, with filters that solve another problem, or none."""
    if setting.volumes <= max(setting.filters, geometry.entries):
        raise InputError(
            f"{setting.volumes} volumes are too few for {setting.filters} filters and a covariance of "
            f"{geometry.entries} entries; give more than {max(setting.filters, geometry.entries)}"
        )

    def windows() -> Iterator[Window]:
        seen = 0
        for recording in recordings:
            for window in windows_of(recording.items(), geometry):
                seen += 1
                report("reading windows", seen, 0, recording.path.name)
                yield window

    rng = np.random.default_rng(setting.seed)
    volumes = sample_volumes(windows(), geometry, setting.volumes, rng)
    whitener = VolumeWhitener().fit(volumes.counts)
    if method == "random":
        filters = random_filters(setting.filters, geometry.entries, rng)
    else:
        white = LazyVolumes(volumes.counts, whitener.transform)
        filters = spherical_means(white, setting.filters, rng, report=report)
    return Encoder.build(
        geometry,
        formulation="direct",
        encoding=setting.encoding,
        threshold=THRESHOLDS["direct"] if setting.threshold is None else setting.threshold,
        filters=filters,
        whitening=whitener.whitening_,
        mean=whitener.mean_,
        eps=whitener.eps,
    )


def random_filters(n: int, entries: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """`(n, entries)` directions of unit length, each as likely as any other."""
    rows = rng.standard_normal((n, entries))
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)


def spherical_means(
    volumes: LazyVolumes,
    n: int,
    rng: np.random.Generator,
    *,
    iterations: int = 10,
    report: Report = lambda step, done, total, remark: None,
) -> NDArray[np.float32]:
    """Filters `(n, d)` of unit length by spherical k-means (Coates and Ng 2012, section 2.1).

    Each volume `x` has one code that is not zero, `s_j = d_j' x` for the `j` of the largest `|d_j' x|`; then
    `D := X S' + D` and each column is scaled to unit length. Started, as there, from random directions.

    Args:
        volumes: `(m, d)` whitened volumes.
        n: filters.
        rng: source of every random choice.
        iterations: ten are enough, they say.
        report: told about progress.
    """
    filters = random_filters(n, volumes.shape[1], rng)
    for iteration in range(iterations):
        totals = filters.copy()
        for _, chunk in chunks(volumes, _CHUNK):
            likeness = chunk @ filters.T
            best = np.abs(likeness).argmax(axis=1)
            codes = np.zeros_like(likeness)
            rows = np.arange(len(chunk))
            codes[rows, best] = likeness[rows, best]
            totals += codes.T @ chunk
        filters = totals / np.linalg.norm(totals, axis=1, keepdims=True)
        report("learning", iteration + 1, iterations, "spherical k-means")
    return filters
