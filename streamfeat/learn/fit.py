"""From recordings to an encoder: sample, whiten, learn, freeze.

Lives here: the order of the steps and what is written down about them. Not here: the steps.
"""

import datetime
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.geometry import Geometry
from streamfeat.errors import InputError
from streamfeat.events import Resolution
from streamfeat.learn.chunks import ChunkedVolumes
from streamfeat.learn.dictionary import DictionaryLearner
from streamfeat.learn.settings import SENSOR, Setting
from streamfeat.learn.transform import TransformLearner
from streamfeat.learn.volumes import KEYS, Volumes, sample_volumes, windows_of
from streamfeat.learn.whitening import VolumeWhitener
from streamfeat.recordings.reader import HELD_OUT_SPLITS, Label, Losses, Recording
from streamfeat.work.workers import THIS_PROCESS, Workers

__all__ = ["Material", "geometries_of", "geometry_of", "learn_encoder", "learn_scale", "prepare"]

_HISTORY = ("iterations", "objective", "condition", "coherence")
"""Of a model's provenance: what is continued when a model is."""

_WEIGHTS = ("conditioning", "coherence", "log_det")
"""Parameters of learners that weigh the terms of `Omega`."""

_WHOLE = 0.95
"""Share of the labelled samples that a window shall hold whole."""

Report = Callable[[str, int, int, str], None]
"""Called with (step, done, of how many, remark); of how many is 0 where that is unknown."""

Keep = Callable[[Callable[[], Encoder]], None]
"""Called after each iteration with a function that makes the encoder so far."""


def geometry_of(
    setting: Setting, recordings: Sequence[Recording], workers: Workers = THIS_PROCESS
) -> Geometry:
    """The geometry that a setting means for these recordings.

    Args:
        setting: where its `window_ms` is None, 19 of 20 labelled samples that are not held out are no longer
            than the window: of a sample that is a little longer, the whole oldest bin would be out of it.
            100 ms without labels. Where its patch is as large as the sensor, recordings are read for
            the largest.
        recordings: open recordings.
        workers: read labels, where those are needed.

    Raises:
        InputError: a value is out of range, or volumes are too few for a patch as large as the sensor.
    """
    if setting.window_ms is not None:
        window_us = round(setting.window_ms * 1000)
    else:
        labels = [label for found in workers.map(_labels, _openers(recordings)) for label in found]
        durations = [label.duration_us for label in labels if label.split not in HELD_OUT_SPLITS]
        window_us = int(np.quantile(durations or [100_000], _WHOLE, method="higher"))
    given = asdict(setting)
    same = {field.name: given[field.name] for field in fields(Geometry) if field.name in given}
    sensors = workers.map(_largest, _openers(recordings)) if setting.patch == SENSOR else []
    same["patch"] = setting.sides(tuple(np.max([*sensors, (0, 0)], axis=0).tolist()))
    geometry = Geometry(n_bins=setting.bins, bin_us=max(1, -(-window_us // setting.bins)), **same)
    setting.check_volumes(geometry.entries)
    return geometry


@dataclass(frozen=True, slots=True)
class Material:
    """The volumes that filters are learned from, and all of an encoder but its filters."""

    setting: Setting
    geometry: Geometry
    volumes: Volumes
    whitener: VolumeWhitener
    white: ChunkedVolumes
    """Whitened volumes `(n, d)`, made a chunk at a time."""

    def encoder(self, filters: NDArray[np.float32], provenance: Mapping[str, Any] | None = None) -> Encoder:
        """The encoder with these `(K, d)` filters, each scaled to unit length."""
        lengths = np.linalg.norm(filters.astype(np.float64), axis=1, keepdims=True)
        lengths[(np.abs(lengths - 1) < 1e-6) | (lengths < 1e-12)] = 1  # those of unit length keep their bits
        return Encoder.build(
            self.geometry,
            formulation=self.setting.formulation,
            encoding=self.setting.encoding,
            threshold=self.setting.threshold,
            filters=filters / lengths,
            whitening=self.whitener.whitening_,
            mean=self.whitener.mean_,
            eps=self.whitener.eps,
            narrow=True,
            provenance=provenance,
        )


def prepare(
    recordings: Sequence[Recording],
    setting: Setting,
    report: Report,
    workers: Workers = THIS_PROCESS,
    geometry: Geometry | None = None,
) -> Material:
    """Sample volumes and learn their whitening; samples of held-out splits are not looked at.

    Events are read and decoded once, in parts, for a sample of volumes, which is kept as small integers:
    `volumes * d` bytes. No float copy of it is made. Without `window_ms` and `geometry`, labels are read
    first, without decoding events.

    Args:
        recordings: open recordings.
        setting: geometry, number of volumes, seed.
        report: told about progress.
        workers: read and compute; what comes out is the same wherever that is.
        geometry: that of `geometry_of`, where it is known.

    Raises:
        InputError: no usable volume was found, or there are too few.
    """
    geometry = geometry or geometry_of(setting, recordings, workers)
    volumes = _sample(recordings, setting, geometry, report, workers)
    remark = f"{len(volumes.counts):,} volumes, {volumes.empty_share:.1%} of places were empty"
    report("whitening", 0, 1, remark)
    chunked = ChunkedVolumes(volumes.counts, workers=workers)
    whitener = VolumeWhitener().fit(chunked)
    report("whitening", 1, 1, remark)
    return Material(setting, geometry, volumes, whitener, chunked.made(whitener.transform))


def _sample(
    recordings: Sequence[Recording],
    setting: Setting,
    geometry: Geometry,
    report: Report,
    workers: Workers,
) -> Volumes:
    """A sample of all recordings; workers send only volumes whose keys are among the smallest so far."""
    n = setting.volumes
    volumes, waiting = Volumes.none(geometry), list[Volumes]()
    parts = [*_openers(recordings)]
    losses = [Losses() for _ in recordings]

    def pieces() -> Iterator[tuple[Any, ...]]:
        for part in parts:
            yield *part, int(volumes.keys[-1]) if len(volumes.keys) == n else KEYS

    found = workers.map(_sample_part, pieces(), geometry, n, setting.seed, setting.patch == SENSOR)
    for done, (number, more, lost) in enumerate(found, 1):
        losses[number].add_all(lost)
        waiting.append(more)
        if sum(len(one.keys) for one in waiting) > n // 4 or done == len(parts):
            volumes, waiting = volumes.with_others(waiting, n), []
        report("reading windows", done, len(parts), recordings[number].path.name)
    for recording, lost in zip(recordings, losses, strict=True):
        recording.losses = lost
    if len(volumes.keys) == 0:
        raise InputError(
            f"no local volume of {geometry.sides[0]}x{geometry.sides[1]} pixels with an event was found in "
            f"{volumes.windows} windows; check resolution and splits, or give a smaller --patch, or sensor"
        )
    return volumes


def _openers(recordings: Sequence[Recording]) -> Iterator[tuple[Callable[[], Recording], int]]:
    """A function that opens each part, and the number of its recording."""
    for number, recording in enumerate(recordings):
        for part in recording.parts():
            yield recording.part(part), number


def _labels(opener: Callable[[], Recording], number: int) -> list[Label]:
    with opener() as recording:
        return [*recording.stored_labels()]


def _largest(opener: Callable[[], Recording], number: int) -> Resolution:
    """The most rows and the most columns of a sensor in a part of a recording."""
    with opener() as recording:
        found = [item.resolution for item in recording.items() if not isinstance(item, Label)]
    height, width = np.max([*found, (1, 1)], axis=0).tolist()
    return height, width


def _sample_part(
    opener: Callable[[], Recording],
    number: int,
    limit: int,
    geometry: Geometry,
    n: int,
    seed: int,
    padded: bool,
) -> tuple[int, Volumes, Losses]:
    """The number of the recording, the volumes of one part of it, and its losses."""
    with opener() as recording:
        windows = windows_of(recording.items(), geometry)
        volumes = sample_volumes(windows, geometry, n, (seed, number), limit=limit, padded=padded)
        return number, volumes, recording.losses


def geometries_of(
    setting: Setting, recordings: Sequence[Recording], workers: Workers = THIS_PROCESS
) -> list[Geometry]:
    """The geometry of each scale; bins are as long in all as in the first. See `geometry_of`."""
    first, *others = setting.each
    geometry = geometry_of(first, recordings, workers)
    return [
        geometry,
        *(
            replace(
                geometry,
                patch=other.sides((0, 0)),
                stride=other.stride,
                downsample=other.downsample,
                n_bins=other.bins,
                volume_bins=other.volume_bins,
                time_stride=other.time_stride,
            )
            for other in others
        ),
    ]


def learn_encoder(
    recordings: Sequence[Recording],
    setting: Setting,
    *,
    resume: Encoder | None = None,
    report: Report = lambda step, done, total, remark: None,
    keep: Keep = lambda make: None,
    workers: Workers = THIS_PROCESS,
) -> Encoder:
    """Learn an encoder without labels, scale after scale; see `learn_scale`.

    With several scales there is nothing to keep before the last is learned: Ctrl-C ends all, `keep` is not
    called, and `resume` is refused.

    Raises:
        InputError: as for `learn_scale`; or `resume` is given for several scales.
        KeyboardInterrupt: Ctrl-C came before the first iteration was done, or while one of several scales was
            learned.
    """
    geometries = geometries_of(setting, recordings, workers)
    if len(geometries) == 1 and not (resume and resume.further):
        return learn_scale(
            recordings, setting, geometries[0], resume=resume, report=report, keep=keep, workers=workers
        )
    if resume:
        raise InputError(
            "a model of several scales cannot be gone on from; learn it anew, with more iterations"
        )
    learned: list[Encoder] = []
    for one, geometry in zip(setting.each, geometries, strict=True):
        learned.append(learn_scale(recordings, one, geometry, report=report, workers=workers))
        if learned[-1].provenance["interrupted"]:
            raise KeyboardInterrupt
    return Encoder.side_by_side(learned)


def learn_scale(
    recordings: Sequence[Recording],
    setting: Setting,
    geometry: Geometry,
    *,
    resume: Encoder | None = None,
    report: Report = lambda step, done, total, remark: None,
    keep: Keep = lambda make: None,
    workers: Workers = THIS_PROCESS,
) -> Encoder:
    """Learn an encoder of one scale without labels; samples of held-out splits are not looked at.

    Ctrl-C while learning ends it: the encoder is that of the last whole iteration, and is marked
    (`provenance["interrupted"]`).

    Args:
        recordings: open recordings; their events are decoded once.
        setting: of learning; iterations are those beyond `resume`.
        geometry: of the local volumes.
        resume: an encoder to go on from, learned from the same volumes with the same parameters.
        report: told about progress.
        keep: may save the encoder so far, which is marked as interrupted.
        workers: read and compute; what is learned is the same wherever that is.

    Raises:
        InputError: no usable volume was found, there are too few, a parameter is out of range, or `resume`
            was learned from something else.
        KeyboardInterrupt: Ctrl-C came before the first iteration was done.
    """
    learner = _learner(setting)
    weights = {name: getattr(learner, name) for name in _WEIGHTS if hasattr(learner, name)}
    if setting.formulation == "direct" and setting.rows == "unit":
        weights = {}
    if resume:
        _check_resumable(resume, setting, geometry, weights)
    material = prepare(recordings, setting, report, workers, geometry)
    volumes = material.volumes
    volumes_hash = hashlib.sha256(volumes.counts.tobytes()).hexdigest()
    if resume and resume.provenance.get("volumes_sha256") != volumes_hash:
        raise InputError(
            f"the model to go on from was learned from other volumes ({_origin(resume)}); give the "
            "recordings, the number of volumes and the seed that it was learned with, or learn anew"
        )

    def made(*, interrupted: bool = True) -> Encoder:
        provenance: dict[str, Any] = {
            "recordings": [recording.path.name for recording in recordings],
            "windows": volumes.windows,
            "volumes": len(volumes.counts),
            "volumes_sha256": volumes_hash,
            "empty_share": round(volumes.empty_share, 4),
            "seed": setting.seed,
            "lambda0": setting.penalty,
            "start": setting.start,
            "rows": setting.rows,
            "weights": weights,
            "iterations": learner.n_iter_,
            "interrupted": interrupted,
            "objective": _rounded(learner.objective_),
            "condition": _rounded(learner.condition_),
            "coherence": _rounded(learner.coherence_),
            "unused": learner.unused_,
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        }
        if resume:
            for name in _HISTORY:
                provenance[name] = resume.provenance[name] + provenance[name]
        if setting.rows == "free":
            lengths = np.linalg.norm(learner.components_.astype(np.float64), axis=1)
            provenance["lengths"] = [float(length) for length in lengths]
        return material.encoder(learner.components_, provenance)

    def learned(iteration: int, objective: float) -> None:
        report("learning", iteration, setting.iterations, f"objective {objective:.4f}")
        keep(made)

    learner.set_params(progress=learned)
    if resume:
        lengths = np.array(resume.provenance.get("lengths", [1.0]), np.float32)
        learner.set_params(warm_start=True).components_ = resume.filters * lengths[:, np.newaxis]
    learner.fit(material.white)
    if learner.interrupted_ and learner.n_iter_ == 0:
        raise KeyboardInterrupt
    return made(interrupted=learner.interrupted_)


def _learner(setting: Setting) -> TransformLearner | DictionaryLearner:
    kind = TransformLearner if setting.formulation == "direct" else DictionaryLearner
    learner = kind(
        setting.filters,
        threshold=setting.penalty,
        start=setting.start,
        max_iter=setting.iterations,
        random_state=setting.seed,
    )
    learner.set_params(**setting.weights)
    if setting.formulation == "direct":
        learner.set_params(rows=setting.rows)
    return learner


def _rounded(values: NDArray[np.float64]) -> list[float | None]:
    """For JSON, which has no infinity."""
    return [round(float(value), 6) if np.isfinite(value) else None for value in values]


def _check_resumable(
    resume: Encoder, setting: Setting, geometry: Geometry, weights: Mapping[str, float]
) -> None:
    """Refuse to go on from a model that was learned with other parameters."""
    if not resume.provenance.keys() >= {"volumes_sha256", "weights", "lambda0", "rows", *_HISTORY}:
        raise InputError("the model to go on from does not say how it was learned; learn anew")
    asked = {
        "geometry": (resume.geometry, geometry),
        "formulation": (resume.formulation, setting.formulation),
        "encoding": (resume.encoding, setting.encoding),
        "lambda0": (resume.provenance["lambda0"], setting.penalty),
        "threshold": (resume.threshold, setting.threshold),
        "rows": (resume.provenance["rows"], setting.rows),
        "filters": (resume.n_filters, setting.filters),
        "weights": (resume.provenance["weights"], weights),
    }
    for name, (had, wanted) in asked.items():
        if had != wanted:
            raise InputError(
                f"the model to go on from has {name} {had}, not {wanted}; give the same, or learn anew"
            )


def _origin(encoder: Encoder) -> str:
    """The provenance of a model in a few words."""
    known = encoder.provenance
    return f"{known.get('volumes')} of {', '.join(known.get('recordings', []))}, seed {known.get('seed')}"
