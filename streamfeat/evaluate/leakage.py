"""Whether folds hold near copies apart.

Lives here: how often a nearest neighbour on small count images is right under shuffled folds, under blocks
and as the data are scored. Not here: how folds are made (`classify.folds`).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.classify.classifier import normalise_features
from streamfeat.classify.features import encode_recordings
from streamfeat.classify.folds import assign_folds, block_numbers
from streamfeat.evaluate.methods import Report
from streamfeat.evaluate.splits import DataSet
from streamfeat.evaluate.surfaces import CountImage
from streamfeat.work.workers import Workers

__all__ = ["check_leakage", "neighbour_accuracy"]

_SIDE = 12
_FOLDS = 5
_MOST = 20_000
"""Samples that are compared with each other; of more, those at the start of each block."""

_LARGE = 0.05
"""Difference in accuracy that means near copies."""

_CHUNK = 1024


def check_leakage(data: DataSet, report: Report, workers: Workers) -> dict[str, Any] | None:
    """Accuracy of a nearest neighbour on 12x12 counts by how samples are held out (JSON values).

    A large difference between shuffled folds and blocks says that neighbours are near copies. Then a figure
    holds for new data only if the data are scored in a way that is nearer to blocks.

    Returns:
        `shuffled`, `blocks` (five folds each), `scored` (as this evaluation does); `copies`, whether
        neighbours are near copies; `leaks`, whether that reaches what is scored. None where a class has
        fewer samples than folds.
    """
    report("looking for near copies", 0, 0, "")
    with data.open(0) as recordings:
        samples = encode_recordings(CountImage(_SIDE), recordings, workers=workers)
    labels, sources = samples.labels.tolist(), samples.sources.tolist()
    kept = _some(labels, sources)
    rows, names = normalise_features(samples.rows[kept]), samples.labels[kept]
    labels, sources = names.tolist(), samples.sources[kept].tolist()
    if np.unique(names, return_counts=True)[1].min() < _FOLDS:
        return None
    # Test rows see training rows only: with folds those of the other folds.
    if data.n_folds == 1:
        scored = np.where(samples.held_out[kept], 1, 0)
    else:
        scored = assign_folds(labels, sources, data.n_folds, data.groups, data.seed)
    ways = {
        "shuffled": assign_folds(labels, sources, _FOLDS, "none", data.seed),
        "blocks": assign_folds(labels, sources, _FOLDS, "block"),
        "scored": scored,
    }
    found = neighbour_accuracy(rows, names, [*ways.values()])
    report("looking for near copies", 1, 1, "")
    result: dict[str, Any] = {
        name: round(float(right.mean()), 4) for name, right in zip(ways, found, strict=True)
    }
    if data.n_folds == 1:
        result["scored"] = round(float(found[-1][scored == 1].mean()), 4)
    result["copies"] = result["shuffled"] - result["blocks"] > _LARGE
    middle = (result["shuffled"] + result["blocks"]) / 2
    result["leaks"] = bool(result["copies"] and result["scored"] > middle)
    return result


def _some(labels: Sequence[str], sources: Sequence[str]) -> NDArray[np.int64]:
    """All samples, or as many as can be compared: the first of each of five blocks."""
    if len(labels) <= _MOST:
        return np.arange(len(labels))
    inside = block_numbers(labels, sources, _FOLDS * 1000) % 1000
    return np.flatnonzero(inside < 1000 * _MOST // len(labels))


def neighbour_accuracy(
    rows: NDArray[np.float32], labels: NDArray[np.str_], ways: Sequence[NDArray[np.int64]]
) -> list[NDArray[np.bool_]]:
    """Whether each sample has the label of its nearest neighbour in another fold.

    Args:
        rows: `(n, F)` of unit length.
        labels: `(n,)` names.
        ways: for each way of holding samples out, `(n,)` folds.

    Returns:
        for each way `(n,)`.
    """
    right = [np.empty(len(rows), np.bool_) for _ in ways]
    for start in range(0, len(rows), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        likeness = rows[chunk] @ rows.T
        for folds, hits in zip(ways, right, strict=True):
            other = np.where(folds[chunk, None] == folds, np.float32(-np.inf), likeness)
            hits[chunk] = labels[other.argmax(axis=1)] == labels[chunk]
    return right
