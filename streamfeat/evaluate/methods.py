"""From a method's name and a setting to a map from events to features.

Lives here: learning with either formulation, and the filters that those are compared with.
Not here: methods without filters (`surfaces`), and what features are good for (`cell`).
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.encoder import Encoder, FeatureMap
from streamfeat.evaluate.surfaces import AveragedSurfaces, CountImage, SurfaceHistogram
from streamfeat.learn.chunks import ChunkedVolumes
from streamfeat.learn.fit import learn_encoder, prepare
from streamfeat.learn.settings import Setting
from streamfeat.recordings.reader import Recording
from streamfeat.work.workers import THIS_PROCESS, Sums, Workers

__all__ = ["make_features", "random_filters", "spherical_means"]

Report = Callable[[str, int, int, str], None]
"""Called with (step, done, of how many, remark)."""


def make_features(
    method: str,
    recordings: Sequence[Recording],
    setting: Setting,
    report: Report,
    workers: Workers = THIS_PROCESS,
) -> FeatureMap:
    """Learn what a method learns, from samples that are not held out.

    Args:
        method: one of `plan.METHODS`.
        recordings: open recordings.
        setting: of that method, as in `plan.Cell`.
        report: told about progress.
        workers: read and learn filters; the methods without filters are fitted here.

    Raises:
        InputError: there is too little to learn from.
        KeyboardInterrupt: Ctrl-C, at any time.
    """
    if method == "counts":
        return CountImage()
    if method == "hats":
        return AveragedSurfaces.fitted(recordings)
    if method == "hots":
        return SurfaceHistogram.fitted(recordings, seed=setting.seed)
    if method in ("kmeans", "random"):
        return _other_filters(method, recordings, setting, report, workers)
    encoder = learn_encoder(recordings, setting, report=report, workers=workers)
    if encoder.provenance["interrupted"]:  # an encoder of fewer iterations is not what was asked for
        raise KeyboardInterrupt
    return encoder


def _other_filters(
    method: str, recordings: Sequence[Recording], setting: Setting, report: Report, workers: Workers
) -> Encoder:
    """The pipeline of the direct formulation, with filters that solve another problem, or none."""
    material = prepare(recordings, setting, report, workers)
    rng = np.random.default_rng([setting.seed, 1])  # volumes were drawn from the seed alone
    if method == "random":
        return material.encoder(random_filters(setting.filters, material.geometry.entries, rng))
    return material.encoder(spherical_means(material.white, setting.filters, rng, report=report))


def random_filters(n: int, entries: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """`(n, entries)` directions of unit length, each as likely as any other."""
    rows = rng.standard_normal((n, entries))
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)


def spherical_means(
    volumes: ChunkedVolumes,
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
        (totals,) = volumes.total(_nearest_sums, filters)
        totals += filters
        filters = np.asarray(totals / np.linalg.norm(totals, axis=1, keepdims=True), np.float32)
        report("learning", iteration + 1, iterations, "spherical k-means")
    return filters


def _nearest_sums(chunk: NDArray[np.float32], filters: NDArray[np.float32]) -> Sums:
    """The chunk's part of `S X'`."""
    likeness = chunk @ filters.T
    best = np.abs(likeness).argmax(axis=1)
    codes = np.zeros_like(likeness)
    rows = np.arange(len(chunk))
    codes[rows, best] = likeness[rows, best]
    return ((codes.T @ chunk).astype(np.float64),)
