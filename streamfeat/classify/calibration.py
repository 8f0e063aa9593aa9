"""Scores as probabilities: one temperature, fitted to scores of samples that were not trained on.

Lives here: fitting it, applying it, and how far off probabilities are. Not here: the scores (`classifier`,
`kernel`).

Guo, Pleiss, Sun and Weinberger (ICML 2017), "On Calibration of Modern Neural Networks", section 4.2:
`p = softmax(s / T)` with the `T` of least log loss on held-out samples. One parameter cannot change which
label has the highest score. We deviate twice. They hold a validation set out; here it is the folds by which
the regularisation is chosen, so that near copies are on one side, and no sample is lost to training. And
targets are not quite zero and one, as in Platt (1999): a few samples without an error make nothing certain.

Folds of blocks can be so unlike each other that the temperature of some is worse for the others than none:
margins of a support vector machine have a scale of their own, 1, which is kept then (`checked_by_folds`).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError

__all__ = [
    "calibration_error",
    "checked_by_folds",
    "checked_temperature",
    "confidence_bins",
    "error_of_bins",
    "fitted_temperature",
    "probabilities",
    "temperature_field",
]

_RANGE = 1e-4, 1e4
_BINS = 10


def fitted_temperature(scores: NDArray[np.floating], targets: NDArray[np.integer]) -> float:
    """The temperature of least log loss.

    Args:
        scores: `(n, C)` of samples that were held out when they were scored.
        targets: `(n,)` columns of the true labels.
    """
    from scipy.optimize import minimize_scalar

    wide = np.asarray(scores, np.float64)
    wide = wide - wide.max(axis=1, keepdims=True)
    n, n_labels = wide.shape
    wanted = np.full((n, n_labels), 1 / (n + 2) / max(n_labels - 1, 1))
    wanted[np.arange(n), targets] = 1 - 1 / (n + 2)
    pull = float(np.mean((wide * wanted).sum(axis=1)))

    def loss(log_t: float) -> float:
        t = np.exp(log_t)
        return float(np.mean(np.log(np.exp(wide / t).sum(axis=1)))) - pull / float(t)

    found = minimize_scalar(loss, bounds=tuple(np.log(_RANGE)), method="bounded", options={"xatol": 1e-4})
    return float(np.exp(found.x))


def checked_by_folds(
    scores: NDArray[np.floating], targets: NDArray[np.integer], parts: NDArray[np.integer]
) -> float:
    """The temperature of least log loss; 1 if temperatures of other folds are worse for a fold, on average.

    On blocks of N-CARS three folds ask for 0.5 to 2.5 for margins whose error of calibration is least at 1.

    Args:
        scores: `(n, C)` of samples that were held out when they were scored.
        targets: `(n,)` columns of the true labels.
        parts: `(n,)` the fold in which each was held out.
    """
    gained = 0.0
    for part in np.unique(parts):
        mine = parts == part
        temperature = fitted_temperature(scores[~mine], targets[~mine])
        gained += _loss(scores[mine], targets[mine], 1.0) - _loss(scores[mine], targets[mine], temperature)
    return fitted_temperature(scores, targets) if gained > 0 else 1.0


def _loss(scores: NDArray[np.floating], targets: NDArray[np.integer], temperature: float) -> float:
    """Mean log loss."""
    wide = np.asarray(scores, np.float64) / temperature
    wide -= wide.max(axis=1, keepdims=True)
    right = wide[np.arange(len(wide)), targets]
    return float(np.mean(np.log(np.exp(wide).sum(axis=1)) - right))


def probabilities(scores: NDArray[np.float32], temperature: float) -> NDArray[np.float32]:
    """`softmax(scores / temperature)`, `(n, C)` float32; each row by itself.

    The highest score has the highest probability, alone if it was alone, however close the next one is.
    """
    best = scores.max(axis=-1, keepdims=True)
    found = np.exp((np.ascontiguousarray(scores, np.float64) - best) / temperature)
    found /= found.sum(axis=-1, keepdims=True)
    rounded = found.astype(np.float32)
    highest = rounded.max(axis=-1, keepdims=True)
    below = np.minimum(rounded, np.nextafter(highest, np.float32(0)))
    return np.asarray(np.where(scores < best, below, rounded), np.float32)


def temperature_field(temperature: float | None) -> dict[str, float]:
    """The field of a classifier's file; files without it have scores and no probabilities."""
    return {} if temperature is None else {"temperature": temperature}


def checked_temperature(path: str | Path, header: Mapping[str, Any]) -> float | None:
    """The temperature that a file has, if it has one.

    Raises:
        InputError: it is no number above zero.
    """
    found = header.get("temperature")
    if found is not None and not (isinstance(found, float) and _RANGE[0] / 2 < found < _RANGE[1] * 2):
        raise InputError(f"{path}: temperature is out of range; train it again")
    return found


def calibration_error(found: NDArray[np.floating], targets: NDArray[np.integer]) -> float:
    """Expected calibration error (Guo et al. 2017, eq. 3): how far confidence is from accuracy, ten bins.

    Args:
        found: `(n, C)` probabilities.
        targets: `(n,)` columns of the true labels.
    """
    return error_of_bins(confidence_bins(found, targets))


def confidence_bins(found: NDArray[np.floating], targets: NDArray[np.integer]) -> NDArray[np.float64]:
    """Of ten bins of confidence `(10, 3)`: samples, the sum of their confidence, and how many are right."""
    confidence, right = found.max(axis=1), found.argmax(axis=1) == targets
    bins = np.minimum((confidence * _BINS).astype(int), _BINS - 1)
    columns = np.ones(len(bins)), confidence, right
    return np.stack([np.bincount(bins, column, _BINS) for column in columns], axis=1)


def error_of_bins(bins: NDArray[np.float64]) -> float:
    """The expected calibration error of `confidence_bins`; those of several folds may be added up."""
    return float(np.abs(bins[:, 1] - bins[:, 2]).sum() / max(bins[:, 0].sum(), 1))
