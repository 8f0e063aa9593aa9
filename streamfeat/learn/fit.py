"""From recordings to an encoder: sample, whiten, learn, freeze.

Lives here: the order of the steps and what is written down about them. Not here: the steps.
"""

import datetime
import hashlib
from collections.abc import Callable, Iterable, Sequence
from statistics import median
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from streamfeat.encoder import Encoder, Encoding, Formulation
from streamfeat.errors import InputError
from streamfeat.geometry import Geometry
from streamfeat.learn.chunks import LazyVolumes
from streamfeat.learn.dictionary import DictionaryLearner
from streamfeat.learn.transform import TransformLearner
from streamfeat.learn.volumes import Window, sample_volumes, windows_of
from streamfeat.learn.whitening import VolumeWhitener
from streamfeat.recording import Recording

__all__ = ["THRESHOLDS", "bin_length", "learn_encoder"]

THRESHOLDS: dict[Formulation, float] = {"direct": 0.5, "inverse": 1.0}
"""Default sparsity penalty of each formulation."""

_HISTORY = ("iterations", "objective", "condition", "coherence")
"""Of a model's provenance: what is continued when a model is."""

Report = Callable[[str, int, int, str], None]
"""Called with (step, done, of how many, remark); of how many is 0 where nobody knows."""


def bin_length(recordings: Sequence[Recording], n_bins: int, window_ms: float | None) -> int:
    """Length of a bin in microseconds, so that `n_bins` cover the window.

    Args:
        recordings: where `window_ms` is None their labels decide: the median sample fills the window.
        n_bins: bins in the window.
        window_ms: length of the window.
    """
    if n_bins < 1:
        raise InputError(f"{n_bins} bins are not possible; give at least one")
    if window_ms is not None:
        if not 0 < window_ms < 1e9:
            raise InputError(f"a window of {window_ms} ms is not possible")
        return max(1, -(-round(window_ms * 1000) // n_bins))
    durations = [label.duration_us for recording in recordings for label in recording.labels]
    return max(1, -(-round(median(durations or [100_000])) // n_bins))


def learn_encoder(
    recordings: Sequence[Recording],
    geometry: Geometry,
    *,
    formulation: Formulation = "direct",
    encoding: Encoding = "split",
    n_filters: int = 400,
    threshold: float | None = None,
    n_volumes: int = 50_000,
    max_iter: int = 20,
    seed: int = 0,
    resume: Encoder | None = None,
    report: Report = lambda step, done, total, remark: None,
) -> Encoder:
    """Learn an encoder without labels; samples of held-out splits are not looked at.

    Recordings are read once, a chunk at a time, for a sample of `n_volumes` volumes, which is kept as small
    integers: `n_volumes * d` bytes. Whitening and learning walk through it in chunks; no float copy of it is
    made. Ctrl-C while learning ends it: the encoder is that of the last whole iteration, and says so
    (`provenance["interrupted"]`).

    Args:
        recordings: open recordings.
        geometry: of the local volumes.
        formulation: which of the paper's problems to solve.
        encoding: what is pooled.
        n_filters: `K`.
        threshold: lambda0, in learning and in use; a default for each formulation if not given.
        n_volumes: local volumes to learn from.
        max_iter: alternations, beyond those of `resume`.
        seed: of every random choice.
        resume: an encoder to go on from, learned from the same volumes with the same parameters.
        report: told about progress.

    Raises:
        InputError: no usable volume was found, there are too few, a parameter is out of range, or `resume`
            was learned from something else.
        KeyboardInterrupt: Ctrl-C came before the first iteration was done.
    """
    penalty = THRESHOLDS.get(formulation, 0.0) if threshold is None else threshold
    _check_parameters(geometry, formulation, encoding, penalty, n_filters, n_volumes, max_iter, seed)
    if resume:
        _check_resumable(resume, geometry, formulation, encoding, penalty, n_filters)

    def windows() -> Iterable[Window]:
        seen = 0
        for recording in recordings:
            for window in windows_of(recording.items(), geometry):
                seen += 1
                report("reading windows", seen, 0, str(recording.path.name))
                yield window

    volumes = sample_volumes(windows(), geometry, n_volumes, np.random.default_rng(seed))
    volumes_hash = hashlib.sha256(volumes.counts.tobytes()).hexdigest()
    if resume and resume.provenance.get("volumes_sha256") != volumes_hash:
        raise InputError(
            f"the model to go on from was learned from other volumes ({_origin(resume)}); give the "
            "recordings, the number of volumes and the seed that it was learned with, or learn anew"
        )
    remark = f"{len(volumes.counts):,} volumes, {volumes.empty_share:.1%} of places were empty"
    report("whitening", 0, 1, remark)
    whitener = VolumeWhitener().fit(volumes.counts)
    report("whitening", 1, 1, remark)

    def learned(iteration: int, objective: float) -> None:
        report("learning", iteration, max_iter, f"objective {objective:.4f}")

    learner: TransformLearner | DictionaryLearner
    if formulation == "direct":
        learner = TransformLearner(n_filters, threshold=penalty)
    else:
        learner = DictionaryLearner(n_filters, threshold=penalty)
    learner.set_params(max_iter=max_iter, random_state=seed, progress=learned)
    if resume:
        learner.set_params(warm_start=True).components_ = resume.filters
    learner.fit(LazyVolumes(volumes.counts, whitener.transform))
    if learner.interrupted_ and learner.n_iter_ == 0:
        raise KeyboardInterrupt
    provenance: dict[str, Any] = {
        "recordings": [recording.path.name for recording in recordings],
        "windows": volumes.windows,
        "volumes": len(volumes.counts),
        "volumes_sha256": volumes_hash,
        "empty_share": round(volumes.empty_share, 4),
        "seed": seed,
        "iterations": learner.n_iter_,
        "interrupted": learner.interrupted_,
        "objective": _rounded(learner.objective_),
        "condition": _rounded(learner.condition_),
        "coherence": _rounded(learner.coherence_),
        "unused": learner.unused_,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
    }
    if resume:
        for name in _HISTORY:
            provenance[name] = resume.provenance[name] + provenance[name]
    return Encoder.build(
        geometry,
        formulation=formulation,
        encoding=encoding,
        threshold=learner.threshold,
        filters=learner.components_,
        whitening=whitener.whitening_,
        mean=whitener.mean_,
        eps=whitener.eps,
        provenance=provenance,
    )


def _rounded(values: NDArray[np.float64]) -> list[float | None]:
    """For JSON, which has no infinity."""
    return [round(float(value), 6) if np.isfinite(value) else None for value in values]


def _check_parameters(
    geometry: Geometry,
    formulation: str,
    encoding: str,
    penalty: float,
    n_filters: int,
    n_volumes: int,
    max_iter: int,
    seed: int,
) -> None:
    """Refuse, before any work, what could not be learned."""
    for name, value, kind in (("formulation", formulation, Formulation), ("encoding", encoding, Encoding)):
        if value not in get_args(kind):
            raise InputError(f"{name} is {value!r}, it must be one of {', '.join(get_args(kind))}")
    if not 0 <= penalty < np.inf or (formulation == "inverse" and penalty == 0):
        raise InputError(f"threshold is {penalty}, it must be finite and above zero")
    if n_volumes < 2 or max_iter < 1 or n_filters < 1:
        raise InputError("at least two volumes, one iteration and one filter are needed to learn")
    if n_volumes < max(n_filters, geometry.entries + 1):
        raise InputError(
            f"{n_volumes} volumes are too few for {n_filters} filters and a covariance of {geometry.entries} "
            f"entries; learn from at least {max(n_filters, geometry.entries + 1)}"
        )
    if not 0 <= seed < 2**32:
        raise InputError(f"seed is {seed}, it must be from 0 to 2^32 - 1")


def _check_resumable(
    resume: Encoder,
    geometry: Geometry,
    formulation: str,
    encoding: str,
    penalty: float,
    n_filters: int,
) -> None:
    """Refuse to go on from a model that was learned with other parameters."""
    asked = {
        "geometry": (resume.geometry, geometry),
        "formulation": (resume.formulation, formulation),
        "encoding": (resume.encoding, encoding),
        "threshold": (resume.threshold, penalty),
        "filters": (resume.n_filters, n_filters),
    }
    for name, (had, wanted) in asked.items():
        if had != wanted:
            raise InputError(
                f"the model to go on from has {name} {had}, not {wanted}; give the same, or learn anew"
            )
    if not resume.provenance.keys() >= {"volumes_sha256", *_HISTORY}:
        raise InputError("the model to go on from does not say how it was learned; learn anew")


def _origin(encoder: Encoder) -> str:
    """What a model says of where it comes from."""
    known = encoder.provenance
    return f"{known.get('volumes')} of {', '.join(known.get('recordings', []))}, seed {known.get('seed')}"
