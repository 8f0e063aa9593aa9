"""The linear classifier that goes on learning, from one labelled sample to the next.

Lives here: `OnlineClassifier`. Not here: the frozen one that it starts from (`classifier`), and when it
predicts and learns (`stream.session`, `evaluate.scores`).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from streamfeat.classify.classifier import Classifier
from streamfeat.errors import InputError

__all__ = ["OnlineClassifier"]

_REHEARSED = 15
"""Batches of earlier samples that are learned with each new one. N-CARS, general model, 2,500 shuffled
samples, each predicted before it was learned: 0.864 without, 0.886 with 15."""

_MOST_KEPT_BYTES = 1 << 26
_MOST_KEPT = 4096
"""Samples that are kept to be learned again, a fair sample of all; fewer where they take more than 64 MiB."""


class OnlineClassifier:
    """A linear classifier that goes on learning: passive-aggressive steps over scikit-learn's `partial_fit`.

    One step for one sample costs milliseconds in scikit-learn, a batch hardly more: samples are collected
    and learned `batch_size` at a time. Predictions come from the weights of the last batch.

    From nothing (`Classifier.untrained`) it differs in two ways from Crammer et al. (2006). The mean of the
    first batch becomes the centre of the features: what all of them have in common would take most of each
    step. And with each batch earlier samples are learned again (rehearsal, Robins 1995), drawn from a
    reservoir (Vitter 1985). A classifier that was trained has seen more samples than it is shown here, and
    repetitions would take it away from those.

    Args:
        start: where to begin; its normalisation stays as it is, unless it is untrained.
        rate: largest step for one sample (PA-I's C, Crammer et al. 2006).
        batch_size: samples to collect before a step.
        seed: of scikit-learn's shuffling, and of what is rehearsed.
    """

    def __init__(self, start: Classifier, *, rate: float = 0.01, batch_size: int = 16, seed: int = 0) -> None:
        """Start from the weights of `start`."""
        from sklearn.linear_model import SGDClassifier

        self.classifier = start
        self.batch_size = batch_size
        self.learned = 0
        self._from_nothing = not start.weights.any()
        self._pending: list[tuple[NDArray[np.float32], int]] = []
        self._kept: list[tuple[NDArray[np.float32], int]] = []
        self._most_kept = max(batch_size, min(_MOST_KEPT, _MOST_KEPT_BYTES // (4 * len(start.centre))))
        self._rng = np.random.default_rng(seed)
        self._model = SGDClassifier(
            loss="hinge", penalty=None, learning_rate="pa1", eta0=rate, random_state=seed
        )
        # The first call only makes scikit-learn allocate; its weights are replaced at once.
        classes = np.arange(len(start.labels))
        self._model.partial_fit(np.zeros((len(classes), len(start.centre))), classes, classes=classes)
        # Its loops take contiguous rows of float64 only.
        self._model.coef_ = np.ascontiguousarray(start.weights.T, np.float64)
        self._model.intercept_ = start.bias.astype(np.float64)

    def predict_one(self, features: NDArray[np.float32]) -> str:
        """The label for features `(F,)`, before anything is learned from them."""
        return self.classifier.predict(features)

    def learn_one(self, features: NDArray[np.float32], label: str) -> None:
        """Take in one labelled sample.

        Args:
            features: `(F,)` float32; copied.
            label: one of `classifier.labels`.

        Raises:
            InputError: the label is unknown.
        """
        if label not in self.classifier.labels:
            known = ", ".join(self.classifier.labels)
            raise InputError(f"label {label!r} is not one of the classifier's labels: {known}")
        self._pending.append((self.classifier.prepare(features), self.classifier.labels.index(label)))
        if len(self._pending) >= self.batch_size:
            self.flush()

    def flush(self) -> None:
        """Learn what has been collected."""
        if not self._pending:
            return
        if self._from_nothing and self.learned == 0:
            self._centre()
        batch = self._pending
        if self._from_nothing:
            self._keep(batch)
            again = self._rng.integers(0, len(self._kept), _REHEARSED * len(batch))
            batch = [*batch, *(self._kept[i] for i in again)]
        rows, targets = zip(*batch, strict=True)
        self._model.partial_fit(np.stack(rows).astype(np.float64), np.array(targets))
        self.learned += len(self._pending)
        self._pending.clear()
        old = self.classifier
        self.classifier = replace(
            old,
            weights=self._model.coef_.T.astype(np.float32),
            bias=self._model.intercept_.astype(np.float32),
            provenance={**old.provenance, "learned_online": self.learned},
        )

    def _centre(self) -> None:
        """Make the mean of the first samples the centre; weights are zero, so nothing else changes."""
        rows = np.stack([row for row, _ in self._pending])
        mean = rows.mean(axis=0)
        self._pending = [(row - mean, target) for row, target in self._pending]
        old = self.classifier
        self.classifier = replace(old, centre=old.centre + mean * old.scale)

    def _keep(self, batch: list[tuple[NDArray[np.float32], int]]) -> None:
        """Keep a fair sample of all that was learned so far (Vitter 1985, algorithm R)."""
        for seen, one in enumerate(batch, self.learned + 1):
            if len(self._kept) < self._most_kept:
                self._kept.append(one)
            elif (place := int(self._rng.integers(0, seen))) < self._most_kept:
                self._kept[place] = one
