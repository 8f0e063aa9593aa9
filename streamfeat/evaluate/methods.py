"""From a method's name and a setting to a map from events to features.

Lives here: learning with either formulation, and the filters that those are compared with.
Not here: methods that learn no filters (`surfaces`, `spiking`), and what features are good for (`cell`).
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from streamfeat.engine.encoder import Encoder, FeatureMap
from streamfeat.engine.geometry import Geometry
from streamfeat.evaluate.plan import Trial
from streamfeat.evaluate.spiking import FirstSpikes, LeakySpikes
from streamfeat.evaluate.surfaces import AveragedSurfaces, CountImage, SurfaceHistogram
from streamfeat.learn.fit import geometries_of, learn_encoder, prepare
from streamfeat.learn.initial import random_filters, spherical_means
from streamfeat.learn.settings import Setting
from streamfeat.recordings.reader import Recording
from streamfeat.shipped.general import GENERAL_MODEL
from streamfeat.work.workers import THIS_PROCESS, Workers

__all__ = ["make_features", "model_path"]

_MEANS_ITERATIONS = 20
"""As many passes over the volumes as the direct formulation takes with its start."""

Report = Callable[[str, int, int, str], None]
"""Called with (step, done, of how many, remark)."""


def model_path(trial: Trial) -> Path:
    """The file of the model that the method `model` takes."""
    return Path(trial.model) if trial.model else GENERAL_MODEL


def make_features(
    method: str,
    recordings: Sequence[Recording],
    setting: Trial,
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
    if method == "model":
        return Encoder.load(model_path(setting))
    if method == "counts":
        return CountImage()
    if method == "hfirst":
        return FirstSpikes()
    if method == "gabor-snn":
        return LeakySpikes()
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
    geometries = geometries_of(setting, recordings, workers)
    return Encoder.side_by_side(
        [
            _other_scale(method, recordings, one, geometry, report, workers)
            for one, geometry in zip(setting.each, geometries, strict=True)
        ]
    )


def _other_scale(
    method: str,
    recordings: Sequence[Recording],
    setting: Setting,
    geometry: Geometry,
    report: Report,
    workers: Workers,
) -> Encoder:
    material = prepare(recordings, setting, report, workers, geometry)
    rng = np.random.default_rng([setting.seed, 1])  # volumes were drawn from the seed alone
    if method == "random":
        return material.encoder(random_filters(setting.filters, material.geometry.entries, rng))
    return material.encoder(
        spherical_means(material.white, setting.filters, rng, iterations=_MEANS_ITERATIONS, report=report)
    )
