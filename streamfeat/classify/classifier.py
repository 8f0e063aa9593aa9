"""From features to labels: the frozen linear classifier.

Lives here: normalising pooled features, training with cross-validation, saving, predicting.
Not here: features (`engine`, `encoder`), the one that goes on learning (`online`), when to predict
(`pipeline`), scores of accuracy (`evaluate`).

Predicting is one kernel (`kernels.predict`), the same for one event and for many rows. scikit-learn is
imported where something is learned, for that takes longer than
all else before a first prediction.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from streamfeat.classify.calibration import (
    checked_by_folds,
    checked_temperature,
    probabilities,
    temperature_field,
)
from streamfeat.classify.folds import assign_folds, check_labels
from streamfeat.classify.weights import folded
from streamfeat.engine.encoder import Encoder, FeatureMap
from streamfeat.engine.trace import scores_of
from streamfeat.errors import InputError
from streamfeat.files.safetensors_file import read_safetensors, write_safetensors
from streamfeat.kernels.predict import Weights
from streamfeat.report.shown import Shown

__all__ = ["KERNEL_KIND", "KERNEL_VERSION", "Classifier", "normalise_features", "train_classifier"]

FORMAT_VERSION = 1

_KIND = "streamfeat-classifier"

KERNEL_KIND, KERNEL_VERSION = "streamfeat-kernel-classifier", 3
"""Of files that have a kernel beside the linear classifier, and the latest version of those."""

_POWERS = -9, 3
"""Of ten: the smallest and the largest C that is tried."""

_FIRST_POWER = -5
"""Where the search for C starts."""


def normalise_features(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """Signed square root of pooled features, then unit length (Perronnin et al. 2010, section 3.1 and 3.2).

    Args:
        features: `(n, F)` or `(F,)` float32; not changed.

    Returns:
        same shape; all zero where the features are.
    """
    size = np.abs(features)
    # The squares of the roots add up to the sizes.
    length = np.sqrt(size.sum(axis=-1, keepdims=True))
    roots = np.copysign(np.sqrt(size, out=size), features)
    return np.asarray(roots / np.where(length > 0, length, np.float32(1)), np.float32)


@dataclass(frozen=True, slots=True, repr=False)
class Classifier(Shown):
    """A frozen linear classifier over the features of one encoder.

    Attributes:
        labels: names of the classes.
        centre: `(F,)` float32, mean of the normalised features in training.
        scale: `(F,)` float32, their standard deviation, never zero.
        weights: `(F, C)` float32, or `(F, 1)` for two classes, in favour of the second.
        bias: `(C,)` or `(1,)` float32.
        fingerprint: of the encoder it was trained with.
        provenance: how it was trained (JSON values).
        temperature: what makes probabilities of its scores, see `calibration`; None where it was not fitted.
        folded: weights and bias with the standardisation in them, for kernels.
    """

    labels: tuple[str, ...]
    centre: NDArray[np.float32]
    scale: NDArray[np.float32]
    weights: NDArray[np.float32]
    bias: NDArray[np.float32]
    fingerprint: str
    provenance: Mapping[str, Any] = field(default_factory=dict)
    temperature: float | None = None
    folded: Weights = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Fold standardisation into the weights."""
        object.__setattr__(self, "folded", folded(self.weights, self.bias, self.centre, self.scale))

    @property
    def linear(self) -> "Classifier":
        """The classifier itself, which can learn online and keep pace with single events."""
        return self

    @classmethod
    def untrained(cls, labels: Sequence[str], encoder: FeatureMap) -> Self:
        """A classifier of zeros, for learning online from nothing.

        Raises:
            InputError: there are fewer than two labels.
        """
        names = tuple(sorted(set(labels)))
        if len(names) < 2:
            raise InputError(f"{len(names)} label is not enough to classify; at least two are needed")
        n, columns = encoder.n_features, 1 if len(names) == 2 else len(names)
        return cls(
            labels=names,
            centre=np.zeros(n, np.float32),
            scale=np.full(n, 1 / np.sqrt(n), np.float32),
            weights=np.zeros((n, columns), np.float32),
            bias=np.zeros(columns, np.float32),
            fingerprint=encoder.fingerprint,
        )

    def prepare(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Normalise and standardise features `(F,)` or `(n, F)`, as the weights expect them."""
        return (normalise_features(features) - self.centre) / self.scale

    def scores(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Score of every label: `(C,)` for features `(F,)`, `(n, C)` for `(n, F)`."""
        rows = np.array(features, np.float32, order="C").reshape(-1, len(self.centre))
        found = scores_of(rows, self.folded)
        return _spread(found.reshape(*np.shape(features)[:-1], found.shape[1]))

    def emitted(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """What an emission says of every label: probabilities if there is a temperature, else scores."""
        return self._calibrated(self.scores(features))

    def emitted_after(self, scores: NDArray[np.float32]) -> NDArray[np.float32]:
        """The same from the scores `(n, C)`, or `(n, 1)` for two classes, that kernels made with `folded`."""
        return self._calibrated(_spread(scores))

    def _calibrated(self, scores: NDArray[np.float32]) -> NDArray[np.float32]:
        return scores if self.temperature is None else probabilities(scores, self.temperature)

    def predict(self, features: NDArray[np.float32]) -> str:
        """The label with the highest score for features `(F,)`."""
        return self.labels[int(self.scores(features).argmax())]

    def check_fits(self, encoder: Encoder, *, path: str | Path = "the classifier") -> None:
        """Refuse an encoder other than the one it was trained with.

        Raises:
            InputError: they do not belong together.
        """
        if len(self.centre) != encoder.n_features:
            raise InputError(
                f"{path}: expects {len(self.centre)} features, the model gives {encoder.n_features}; "
                "train it with this model"
            )
        if self.fingerprint != encoder.fingerprint:
            raise InputError(f"{path}: was trained with another model; train it with this one")

    def save(self, path: str | Path) -> None:
        """Write one safetensors file; the file appears whole or not at all."""
        write_safetensors(Path(path), _KIND, FORMAT_VERSION, *self.parts())

    def parts(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """The arrays and the header of its file."""
        arrays = {name: getattr(self, name) for name in ("centre", "scale", "weights", "bias")}
        header = {
            "labels": list(self.labels),
            "fingerprint": self.fingerprint,
            "provenance": dict(self.provenance),
        }
        return arrays, header | temperature_field(self.temperature)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a classifier; every shape, type and range is checked, and nothing in the file is run.

        Of a file with a kernel, as `train` may write it, the linear classifier that is in it as well.

        Raises:
            InputError: the file is missing, cut short, of another version, or not a classifier.
        """
        versions = {FORMAT_VERSION, *range(1, KERNEL_VERSION + 1)}
        arrays, header = read_safetensors(Path(path), (_KIND, KERNEL_KIND), *versions)
        if header["format"] == KERNEL_KIND:
            header = {**header, "temperature": header.get("linear_temperature")}
        elif header["version"] != FORMAT_VERSION:
            raise InputError(
                f"{path}: format version {header['version']}, this streamfeat reads version {FORMAT_VERSION} "
                "of linear classifiers; make the file again"
            )
        return cls.from_parts(path, arrays, header)

    @classmethod
    def from_parts(
        cls, path: str | Path, arrays: Mapping[str, NDArray[Any]], header: Mapping[str, Any]
    ) -> Self:
        """Check what a file holds, as `load` does."""
        fingerprint, provenance = header.get("fingerprint"), header.get("provenance", {})
        labels = header["labels"] if isinstance(header.get("labels"), list) else []
        sound = all(isinstance(name, str) for name in labels) and len(set(labels)) == len(labels) >= 2
        if not (sound and isinstance(fingerprint, str) and isinstance(provenance, dict)):
            raise InputError(f"{path}: labels, fingerprint or provenance are missing; train it again")
        columns = 1 if len(labels) == 2 else len(labels)
        n = arrays["centre"].size if "centre" in arrays else 0
        shapes = {"centre": (n,), "scale": (n,), "weights": (n, columns), "bias": (columns,)}
        for name, shape in shapes.items():
            array = arrays.get(name)
            if array is None or array.dtype != np.float32 or array.shape != shape:
                raise InputError(f"{path}: {name} is not float32 of shape {shape}; train it again")
            if not np.isfinite(array).all():
                raise InputError(f"{path}: {name} is not finite; train it again")
        if n == 0 or not (arrays["scale"] > 0).all():
            raise InputError(f"{path}: scale must be above zero; train it again")
        with np.errstate(over="ignore", invalid="ignore"):
            loaded = cls(
                labels=tuple(labels),
                **{name: arrays[name] for name in shapes},
                fingerprint=fingerprint,
                provenance=provenance,
                temperature=checked_temperature(path, header),
            )
            # No score can be larger than this: normalised features have unit length.
            largest = np.abs(loaded.folded.rows).sum(axis=(0, 2)) + np.abs(loaded.folded.bias)
        if not np.isfinite(largest).all():
            raise InputError(f"{path}: scores would not be finite; train it again")
        return loaded


def train_classifier(
    features: NDArray[np.float32],
    labels: Sequence[str],
    encoder: FeatureMap,
    *,
    parts: NDArray[np.int64] | None = None,
    candidates: Sequence[float] | None = None,
    folds: int = 3,
    seed: int = 0,
    provenance: Mapping[str, Any] | None = None,
    report: Callable[[str, int, int, str], None] = lambda step, done, total, remark: None,
) -> Classifier:
    """Train a linear SVM; its regularisation is chosen by cross-validation.

    Args:
        features: `(n, F)` float32, as `Encoder.encode` gives them; not changed.
        labels: `n` names.
        encoder: that made the features.
        parts: `(n,)` the fold in which each row is scored, from `folds.assign_folds`: those made from one
            sample have the same. Samples are shuffled into stratified folds if not given.
        candidates: values of C to choose from; the scale is that of standardised features. If not given,
            powers of ten, as many as it takes for the best to have neighbours on both sides.
        folds: how many, where `parts` is not given.
        seed: of the shuffling.
        provenance: JSON values kept with the classifier; scores are added.
        report: called with (step, done, of how many, remark); how many values of C it will take is unknown.

    Raises:
        InputError: labels are missing, fewer than two classes, or a class with fewer samples than folds.
    """
    from sklearn.preprocessing import StandardScaler

    from streamfeat.classify.svm import LinearSVM

    check_labels(labels)
    targets = np.asarray(labels)
    if (n_names := len(set(labels))) < 2:
        raise InputError(f"the training samples hold {n_names} label(s); at least two are needed")
    if parts is None:
        parts = assign_folds(labels, [""] * len(labels), folds, "none", seed)
    rows = normalise_features(features)
    sides = [(parts != part, parts == part) for part in np.unique(parts)]
    fitted = [
        (train, test, StandardScaler().fit(rows[train]), LinearSVM(warm_start=True)) for train, test in sides
    ]

    numbers = np.unique(targets, return_inverse=True)[1]
    held_out: dict[float, NDArray[np.float32]] = {}

    def score(c: float) -> float:
        report("training", len(held_out), 0, f"linear, {len(sides)} folds with C = {c:g}")
        found = held_out[c] = np.empty((len(targets), n_names), np.float32)
        for train, test, fold_scaler, svm in fitted:
            svm.set_params(C=c).fit(fold_scaler.transform(rows[train]), targets[train])
            decision = svm.decision_function(fold_scaler.transform(rows[test]))
            found[test] = _spread(decision.reshape(len(decision), -1))
        return float(np.mean(found.argmax(axis=1) == numbers))

    scores = {c: score(c) for c in candidates} if candidates else _climb(score, len(targets))
    best = max(scores, key=lambda c: (scores[c], -c))
    scaler = StandardScaler(copy=False)
    svm = LinearSVM(C=best).fit(scaler.fit_transform(rows), targets)
    return Classifier(
        labels=tuple(str(name) for name in svm.classes_),
        centre=scaler.mean_.astype(np.float32),
        scale=scaler.scale_.astype(np.float32),
        weights=np.ascontiguousarray(svm.coef_.T, np.float32),  # as files hold it, for the bits
        bias=svm.intercept_.astype(np.float32),
        fingerprint=encoder.fingerprint,
        temperature=checked_by_folds(held_out[best], numbers, parts),
        provenance={
            **(provenance or {}),
            "C": best,
            "cross_validation": {str(c): round(scores[c], 4) for c in sorted(scores)},
            "samples": len(labels),
        },
    )


def _climb(score: Callable[[float], float], n: int) -> dict[float, float]:
    """Accuracy for powers of ten as C: up from a small one until it falls, then down if the first was best.

    A large C takes much longer than a small one, and no more than what is needed to see that it is too large
    is spent on it: one that is a standard error below the best is the last, as is the second in a row that is
    not better.

    Args:
        score: cross-validated accuracy for a value of C; called along growing, then falling ones.
        n: samples.
    """
    found: dict[int, float] = {}
    best = _FIRST_POWER
    for power in range(_FIRST_POWER, _POWERS[1] + 1):
        found[power] = score(10.0**power)
        best = max(found, key=lambda p: (found[p], -p))
        error = np.sqrt(found[best] * (1 - found[best]) / n)
        if power - best == 2 or found[power] < found[best] - error:
            break
    while best == min(found) > _POWERS[0]:
        found[best - 1] = score(10.0 ** (best - 1))
        best = max(found, key=lambda p: (found[p], -p))
    return {10.0**power: value for power, value in found.items()}


def _spread(scores: ArrayLike) -> NDArray[np.float32]:
    """One score for each label: the single score of two classes counts for the one, against the other."""
    values = np.asarray(scores, np.float32)
    return np.concatenate([-values, values], axis=-1) if values.shape[-1] == 1 else values
