"""From recordings to an encoder: sample, whiten, learn, freeze.

Lives here: the order of the steps and what is written down about them. Not here: the steps.
"""

import datetime
from collections.abc import Callable, Iterable, Sequence
from statistics import median
from typing import Any, get_args

import numpy as np

from streamfeat.encoder import Encoder, Encoding, Formulation
from streamfeat.errors import InputError
from streamfeat.geometry import Geometry
from streamfeat.learn.dictionary import DictionaryLearner
from streamfeat.learn.transform import TransformLearner
from streamfeat.learn.volumes import Window, sample_volumes, windows_of
from streamfeat.learn.whitening import VolumeWhitener
from streamfeat.recording import Recording

__all__ = ["THRESHOLDS", "bin_length", "learn_encoder"]

THRESHOLDS: dict[Formulation, float] = {"direct": 0.5, "inverse": 1.0}
"""Default sparsity penalty of each formulation."""

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
    report: Report = lambda step, done, total, remark: None,
) -> Encoder:
    """Learn an encoder without labels; samples of held-out splits are not looked at.

    Args:
        recordings: open recordings.
        geometry: of the local volumes.
        formulation: which of the paper's problems to solve.
        encoding: what is pooled.
        n_filters: `K`.
        threshold: lambda0, in learning and in use; a default for each formulation if not given.
        n_volumes: local volumes to learn from.
        max_iter: alternations.
        seed: of every random choice.
        report: told about progress.

    Raises:
        InputError: no usable volume was found, or a parameter is out of range.
    """
    for name, value, kind in (("formulation", formulation, Formulation), ("encoding", encoding, Encoding)):
        if value not in get_args(kind):
            raise InputError(f"{name} is {value!r}, it must be one of {', '.join(get_args(kind))}")
    penalty = THRESHOLDS[formulation] if threshold is None else threshold
    if not 0 <= penalty < np.inf or (formulation == "inverse" and penalty == 0):
        raise InputError(f"threshold is {penalty}, it must be finite and above zero")
    if n_volumes < 2 or max_iter < 1 or n_filters < 1:
        raise InputError("at least two volumes, one iteration and one filter are needed to learn")
    if not 0 <= seed < 2**32:
        raise InputError(f"seed is {seed}, it must be from 0 to 2^32 - 1")

    def windows() -> Iterable[Window]:
        seen = 0
        for recording in recordings:
            for window in windows_of(recording.items(), geometry):
                seen += 1
                report("reading windows", seen, 0, str(recording.path.name))
                yield window

    volumes = sample_volumes(windows(), geometry, n_volumes, np.random.default_rng(seed))
    if len(volumes.counts) < 2:
        raise InputError("only one volume with an event was found; record more events")
    report("whitening", 0, 1, f"{len(volumes.counts):,} volumes")
    whitener = VolumeWhitener().fit(volumes.counts)
    white = whitener.transform(volumes.counts)
    report("whitening", 1, 1, f"{len(volumes.counts):,} volumes")

    def learned(iteration: int, objective: float) -> None:
        report("learning", iteration, max_iter, f"objective {objective:.4f}")

    learner: TransformLearner | DictionaryLearner
    if formulation == "direct":
        learner = TransformLearner(
            n_filters, threshold=penalty, max_iter=max_iter, random_state=seed, progress=learned
        )
    else:
        learner = DictionaryLearner(
            n_filters, threshold=penalty, max_iter=max_iter, random_state=seed, progress=learned
        )
    learner.fit(white)
    provenance: dict[str, Any] = {
        "recordings": [recording.path.name for recording in recordings],
        "windows": volumes.windows,
        "volumes": len(volumes.counts),
        "empty_share": round(volumes.empty_share, 4),
        "seed": seed,
        "iterations": learner.n_iter_,
        "objective": [round(float(value), 6) for value in learner.objective_],
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
    }
    return Encoder.build(
        geometry,
        formulation=formulation,
        encoding=encoding,
        threshold=penalty,
        filters=learner.components_,
        whitening=whitener.whitening_,
        mean=whitener.mean_,
        eps=whitener.eps,
        provenance=provenance,
    )
