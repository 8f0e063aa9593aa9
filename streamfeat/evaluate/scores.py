"""Scores: accuracy with its interval, confusion, early decision, prequential accuracy.

Lives here: what is computed from features and labels. Not here: where features come from.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.classify.classifier import Classifier
from streamfeat.classify.features import encode_samples
from streamfeat.classify.kernel import KernelClassifier
from streamfeat.classify.online import OnlineClassifier
from streamfeat.engine.encoder import FeatureMap
from streamfeat.recordings.reader import Sample

__all__ = [
    "accuracy_interval",
    "confusion",
    "early_decision",
    "joined_decisions",
    "paired_interval",
    "predict_all",
    "prequential",
    "time_to_share",
]

SHARE = 0.9
"""Of the final accuracy: when it is reached, a decision counts as early."""

_RESAMPLES = 10_000
_TIMES = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 1 / 3, 0.4, 0.5, 0.6, 2 / 3, 0.7, 0.8, 0.9, 1.0)
_FIRST_EVENTS = 50


def accuracy_interval(hits: str, units: NDArray[np.int64], seed: int = 0) -> tuple[float, float]:
    """95 % percentile bootstrap interval of an accuracy (Efron 1979); units are drawn whole.

    Args:
        hits: a digit for each sample, 1 where it was recognised.
        units: `(n,)` of each sample, see `classify.folds.bootstrap_units`.
        seed: of the resampling.
    """
    return _interval(_digits(hits), units, seed)


def paired_interval(hits: str, base: str, units: NDArray[np.int64], seed: int = 0) -> tuple[float, float]:
    """95 % percentile bootstrap interval of a difference in accuracy on the same samples.

    What both have right, or wrong, does not widen it, as in the test of McNemar (1947).

    Args:
        hits: a digit for each sample, 1 where it was recognised.
        base: the same of what it is compared with.
        units: `(n,)` of each sample.
        seed: of the resampling.
    """
    return _interval(_digits(hits) - _digits(base), units, seed)


def _digits(hits: str) -> NDArray[np.int64]:
    return np.frombuffer(hits.encode(), np.uint8).astype(np.int64) - ord("0")


def _interval(values: NDArray[np.int64], units: NDArray[np.int64], seed: int) -> tuple[float, float]:
    """Of the mean of `values`, `(n,)`."""
    number = np.unique(units, return_inverse=True)[1]
    sums, sizes = np.bincount(number, values).astype(np.int64), np.bincount(number)
    # Units of one sum and one size are drawn as one kind: how often is multinomial.
    kinds, counts = np.unique(np.stack([sums, sizes]), axis=1, return_counts=True)
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(len(sums), counts / len(sums), _RESAMPLES)
    means = (drawn @ kinds[0]) / (drawn @ kinds[1])
    low, high = np.percentile(means, (2.5, 97.5))
    return float(low), float(high)


def confusion(true: Sequence[str], predicted: Sequence[str], names: Sequence[str]) -> list[list[int]]:
    """How many samples of each class (row) were taken for each class (column), in the order of `names`."""
    place = {name: i for i, name in enumerate(names)}
    matrix = np.zeros((len(names), len(names)), int)
    np.add.at(matrix, ([place[name] for name in true], [place[name] for name in predicted]), 1)
    return [[int(count) for count in row] for row in matrix]


def predict_all(
    classifier: Classifier | KernelClassifier,
    features: NDArray[np.float32],
    images: NDArray[np.float32] | None = None,
) -> list[str]:
    """The label with the highest score for each row of `(n, F)` features; those of `images` are added."""
    scores = classifier.scores(features)
    if images is not None:
        scores = scores + classifier.scores(images)
    return [classifier.labels[i] for i in scores.argmax(axis=-1)]


def early_decision(
    features: FeatureMap,
    classifier: Classifier | KernelClassifier,
    samples: Sequence[Sample],
    longest_us: int,
) -> dict[str, list[dict[str, float]]]:
    """Accuracy when a sample has been seen for some time only, or some of its events.

    The window ends where the decision is made, as that of a running engine does. A sample that has ended by
    then counts with all that it has.

    Args:
        features: of windows.
        classifier: trained on other samples.
        samples: held-out samples, in memory.
        longest_us: times are shares of it.

    Returns:
        `time`: points `{"ms", "accuracy"}`; `events`: points `{"events", "accuracy"}`. The last is the whole.
    """
    ordered = [
        replace(sample, events=sample.events[np.argsort(sample.events["t"], kind="stable")])
        for sample in samples
    ]
    most = max(len(sample.events) for sample in ordered)
    counts = [_FIRST_EVENTS]
    while counts[-1] < most:
        counts.append(2 * counts[-1])

    def accuracy(cut: list[Sample]) -> float:
        right = 0
        for label, row in encode_samples(features, cut):
            right += classifier.predict(row) == label.label
        return right / len(cut)

    times = [round(share * longest_us) for share in _TIMES]
    return {
        "time": [
            {"ms": t / 1000, "accuracy": accuracy([_first_us(sample, t) for sample in ordered])}
            for t in times
        ],
        "events": [
            {
                "events": min(count, most),
                "accuracy": accuracy([_first_events(sample, count) for sample in ordered]),
            }
            for count in counts
        ],
    }


def joined_decisions(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Early decision on the samples of several folds together.

    Args:
        parts: of each fold, `samples` and what `early_decision` found, at the same times. A fold whose
            samples have fewer events than those of others counts with whole samples beyond.
    """
    n = sum(part["samples"] for part in parts)

    def joined(axis: str, unit: str) -> list[dict[str, float]]:
        found = []
        for i in range(max(len(part[axis]) for part in parts)):
            points = [part[axis][min(i, len(part[axis]) - 1)] for part in parts]
            right = sum(
                round(point["accuracy"] * part["samples"]) for point, part in zip(points, parts, strict=True)
            )
            found.append({unit: max(point[unit] for point in points), "accuracy": right / n})
        return found

    return {"samples": n, "time": joined("time", "ms"), "events": joined("events", "events")}


def _first_us(sample: Sample, t_us: int) -> Sample:
    label = replace(sample.label, duration_us=max(1, min(sample.label.duration_us, t_us)))
    return Sample(label, sample.events[: _before(sample, label.duration_us)], sample.resolution)


def _first_events(sample: Sample, count: int) -> Sample:
    if count >= len(sample.events):
        return sample
    last = int(sample.events["t"][count - 1])
    label = replace(sample.label, duration_us=last + 1 - sample.label.start_us)
    return Sample(label, sample.events[:count], sample.resolution)


def _before(sample: Sample, t_us: int) -> int:
    return int(np.searchsorted(sample.events["t"], sample.label.start_us + t_us))


def time_to_share(points: Sequence[dict[str, float]], axis: str, share: float = SHARE) -> float:
    """The first measured point from which on accuracy is at least a share of the final one."""
    goal = share * points[-1]["accuracy"]
    reached = points[-1][axis]
    for point in reversed(points):
        if point["accuracy"] < goal:
            break
        reached = point[axis]
    return reached


def prequential(features: FeatureMap, rows: NDArray[np.float32], labels: Sequence[str]) -> dict[str, Any]:
    """Accuracy of a classifier that starts from nothing and predicts each sample before it learns it.

    The plain loop: `right += predict_one(x) == y; learn_one(x, y)` (Dawid 1984; Gama et al. 2013).

    Args:
        features: what made the rows.
        rows: `(n, F)` float32 in the order of the stream; not changed.
        labels: `n` names.

    Returns:
        `accuracy`; `curve`, the accuracy so far at some points; `label_changes` between neighbours, few
        of which make the task easy: guessing the label before would be right elsewhere.
    """
    online = OnlineClassifier(Classifier.untrained(labels, features))
    hits = np.zeros(len(labels), bool)
    for i, (row, label) in enumerate(zip(rows, labels, strict=True)):
        hits[i] = online.predict_one(row) == label
        online.learn_one(row, label)
    points = np.unique(np.geomspace(1, len(hits), 40).astype(int))
    so_far = np.cumsum(hits)[points - 1] / points
    return {
        "accuracy": round(float(hits.mean()), 4),
        "label_changes": int(np.sum(np.asarray(labels)[1:] != np.asarray(labels)[:-1])),
        "curve": [
            {"samples": int(n), "accuracy": round(float(a), 4)} for n, a in zip(points, so_far, strict=True)
        ],
    }
