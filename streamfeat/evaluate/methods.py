"""From a method's name and a setting to a map from events to features.

Lives here: learning with either formulation, and the filters that those are compared with.
Not here: methods of others (`surfaces`, `spiking`, `retina`, `spike_tensor`), what features are worth
(`cell`).
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from streamfeat.engine.encoder import Encoder, FeatureMap
from streamfeat.engine.geometry import Geometry
from streamfeat.evaluate.plan import Trial
from streamfeat.evaluate.retina import RetinalWords
from streamfeat.evaluate.spiking import FirstSpikes, LeakySpikes
from streamfeat.evaluate.surfaces import AveragedSurfaces, CountImage, SurfaceHistogram
from streamfeat.learn.fit import geometries_of, learn_encoder, prepare
from streamfeat.learn.initial import random_filters, spherical_means
from streamfeat.learn.settings import Setting
from streamfeat.recordings.reader import Recording
from streamfeat.report.pages import require
from streamfeat.shipped.general import GENERAL_MODEL
from streamfeat.work.workers import THIS_PROCESS, Workers

__all__ = ["make_features", "model_path", "needs"]

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
        return FirstSpikes(downsample=setting.downsample)
    if method == "gabor-snn":
        return LeakySpikes(downsample=setting.downsample)
    if method == "hats":
        return AveragedSurfaces.fitted(recordings, setting.downsample)
    if method == "hots":
        return SurfaceHistogram.fitted(recordings, seed=setting.seed, downsample=setting.downsample)
    if method == "dart":
        return RetinalWords.fitted(recordings, seed=setting.seed, downsample=setting.downsample)
    if method == "est":
        return _spike_tensor(recordings, setting, report)
    if method in ("kmeans", "random"):
        return _other_filters(method, recordings, setting, report, workers)
    encoder = learn_encoder(recordings, setting, report=report, workers=workers)
    if encoder.provenance["interrupted"]:  # an encoder of fewer iterations is not what was asked for
        raise KeyboardInterrupt
    return encoder


def needs(methods: Sequence[str]) -> None:
    """Check that the libraries of methods are there, before work is done that would be lost.

    Raises:
        InputError: PyTorch is not installed, and a method is of it.
    """
    if "est" in methods:
        require("torch", extra="deep", what="--method est")


def _spike_tensor(recordings: Sequence[Recording], setting: Trial, report: Report) -> FeatureMap:
    needs(["est"])
    from streamfeat.evaluate.spike_tensor import SpikeTensor  # takes seconds, and PyTorch may not be there

    return SpikeTensor.fitted(recordings, downsample=setting.downsample, seed=setting.seed, report=report)


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
