"""One Gaussian kernel machine: kernel ridge regression on projected features of some cells.

Lives here: normalising by cells, gains of features, principal axes, the machine and its training.
Not here: the committee of machines that is a classifier, its file and its probabilities (`kernel`).
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.classify.classifier import normalise_features
from streamfeat.engine.encoder import Encoder, FeatureMap

__all__ = ["Cells", "KernelMachine", "cells_of", "folded_scores", "normalise_cells", "trained_machine"]

Cells = tuple[int, ...]
"""How many features each cell has; a machine's features are those of its cells, one behind the other."""

Points = NDArray[np.floating[Any]]
"""`(n, P)` float32, or float64 where that is needed."""

_LEAN = 0.25
"""C of the linear classifier that gains are told from, times the number of rows."""

_DIMENSIONS = 256
_RIDGE_WEIGHT = 1e-2
_EXACT_AXES = 1024
"""Rows, or features, up to which all principal axes are worked out."""

_WIDE = 8192
"""Features beyond which their covariance takes longer to work out than the products of the iteration."""

_MORE_AXES, _ROUNDS = 32, 8
"""Of the subspace iteration: axes beyond those that are kept, and how often the rows are gone through."""

_FOR_MEDIAN = 2048
"""Rows whose distances the width of the kernel is told from."""


def cells_of(features: FeatureMap) -> tuple[Cells, ...]:
    """The cells of each machine of a committee: one for each scale of an encoder; else one, of one cell."""
    if not isinstance(features, Encoder):
        return ((features.n_features,),)
    found = []
    for scale in features.scales:
        n = scale.geometry.pooling**2
        found.append((scale.n_features // n,) * n)
    return tuple(found)


def normalise_cells(features: NDArray[np.float32], cells: Cells) -> NDArray[np.float32]:
    """Signed square root; every cell to the same length, and all together to length one.

    So a cell in which little happens counts as much as any other. A cell without events stays zero.

    Args:
        features: `(n, F)` or `(F,)` float32; not changed.
        cells: features of each cell; they add up to `F`. For one cell it is `normalise_features`.
    """
    if len(cells) == 1:
        return normalise_features(features)
    found = np.empty(features.shape, np.float32)
    used = np.zeros((*features.shape[:-1], 1), np.float32)
    start = 0
    for n in cells:
        mine = normalise_features(features[..., start : start + n])
        used += np.any(mine, axis=-1, keepdims=True)
        found[..., start : start + n] = mine
        start += n
    found /= np.sqrt(np.maximum(used, 1, out=used))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class KernelMachine:
    """`score = k(u) . dual`, `k_i = exp(-gamma |u - p_i|^2)`.

    `u` are the features of some cells, each times its gain, normalised, centred and projected on the
    principal axes of those in training.

    Attributes:
        cells: features of each cell, `F` together.
        gains: `(F,)` float32, not negative.
        mean: `(F,)` float32, of the normalised features.
        axes: `(F, P)` float32, principal axes.
        points: `(n, P)` float32, the projected training rows.
        dual: `(n, C)` float32, what each adds to the score of each label.
        gamma: one over the width of the kernel, squared.
    """

    cells: Cells
    gains: NDArray[np.float32]
    mean: NDArray[np.float32]
    axes: NDArray[np.float32]
    points: NDArray[np.float32]
    dual: NDArray[np.float32]
    gamma: float
    _squares: NDArray[np.float32] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Work out what does not depend on the features."""
        object.__setattr__(self, "_squares", np.einsum("ij,ij->i", self.points, self.points))

    def scores(self, row: NDArray[np.float32]) -> NDArray[np.float32]:
        """Score of every label `(C,)` for the features `(F,)` of one row."""
        place = (normalise_cells(row * self.gains, self.cells) - self.mean) @ self.axes
        distance = self._squares + np.float32(place @ place) - np.float32(2) * (self.points @ place)
        np.maximum(distance, 0, out=distance)
        found: NDArray[np.float32] = np.exp(distance * np.float32(-self.gamma)) @ self.dual
        return found


def trained_machine(
    features: NDArray[np.float32], cells: Cells, targets: NDArray[np.float32]
) -> KernelMachine:
    """Kernel ridge regression onto targets `(n, C)` for features `(n, F)`; see `kernel`."""
    gains = _gains(features, cells, targets)
    rows = normalise_cells(features * gains, cells)
    mean = rows.mean(axis=0, dtype=np.float64).astype(np.float32)
    rows -= mean
    axes = _principal_axes(rows)
    points = np.stack([row @ axes for row in rows])
    gamma = 1.0 / max(_median_distance(points), 1e-12)
    return KernelMachine(cells, gains, mean, axes, points, _dual(points, targets, gamma), gamma)


def folded_scores(
    features: NDArray[np.float32], cells: Cells, targets: NDArray[np.float32], parts: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Scores `(n, C)` that rows get from machines that were trained on the other parts."""
    found = np.empty_like(targets)
    for part in np.unique(parts):
        scored = parts == part
        machine = trained_machine(features[~scored], cells, targets[~scored])
        rows = normalise_cells(features[scored] * machine.gains, cells)
        points = (rows - machine.mean) @ machine.axes
        found[scored] = _kernel(points, machine.points, machine.gamma) @ machine.dual
    return found


def _gains(features: NDArray[np.float32], cells: Cells, targets: NDArray[np.float32]) -> NDArray[np.float32]:
    """What each feature is multiplied by, `(F,)`: the more, the more a linear classifier leans on it.

    A Gaussian kernel takes all directions for equally telling. The square of its weight is what a feature
    counts for in a linear classifier (Guyon, Weston, Barnhill and Vapnik 2002, section 4); features that
    stand at the same place of their cells, those of one filter and sign, have the mean of theirs. Gains are
    one on average, and all one where labels or features tell nothing.
    """
    from streamfeat.classify.svm import LinearSVM

    labels = targets.argmax(axis=1)
    rows = normalise_cells(features, cells)
    spread = rows.std(axis=0)
    rows -= rows.mean(axis=0)
    rows /= np.where(spread > 0, spread, 1)
    if len(np.unique(labels)) < 2 or not spread.any():
        return np.ones(features.shape[1], np.float32)
    squares = np.square(LinearSVM(C=_LEAN / len(rows)).fit(rows, labels).coef_).sum(axis=0)
    if len(set(cells)) == 1:
        squares = np.tile(squares.reshape(len(cells), -1).mean(axis=0), len(cells))
    return np.asarray(squares / squares.mean(), np.float32)


def _median_distance(points: NDArray[np.float32]) -> float:
    """The median squared distance between rows, of at most `_FOR_MEDIAN` of them."""
    some = points[np.linspace(0, len(points) - 1, min(len(points), _FOR_MEDIAN)).astype(int)]
    distances = _distances(some, some)
    return float(np.median(distances[np.triu_indices(len(some), 1)]))


def _kernel(points: Points, others: Points, gamma: float) -> Points:
    """Kernel values `(n, m)` of all pairs, in one array of that size."""
    found = _distances(points, others)
    found *= -gamma
    return np.exp(found, out=found)


def _distances(points: Points, others: Points) -> Points:
    """Squared distances `(n, m)`, in one array of that size."""
    found: Points = points @ others.T
    found *= -2.0
    found += np.einsum("ij,ij->i", others, others)
    found += np.einsum("ij,ij->i", points, points)[:, np.newaxis]
    return np.maximum(found, 0, out=found)


def _dual(points: NDArray[np.float32], targets: NDArray[np.float32], gamma: float) -> NDArray[np.float32]:
    """Dual weights `(n, C)`.

    In float32: the largest eigenvalue of a kernel matrix of 16,000 rows is some thousands, and is rounded by
    less than the ridge. Where rounding leaves no positive definite matrix, the same again in float64.
    """
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    for dtype in (np.float32, np.float64):
        kernel = _kernel(points.astype(dtype), points.astype(dtype), gamma)
        kernel.flat[:: len(kernel) + 1] += _RIDGE_WEIGHT
        try:
            # Read by columns it is the same symmetric matrix, and LAPACK needs no copy of it.
            factor = cho_factor(kernel.T, lower=True, overwrite_a=True, check_finite=False)
        except LinAlgError:
            continue
        return np.ascontiguousarray(cho_solve(factor, targets, check_finite=False), np.float32)
    raise AssertionError("a kernel matrix with a ridge is positive definite")


def _principal_axes(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """The axes `(F, P)` of most variance of centred rows `(n, F)`; no more than the rows span."""
    from scipy.linalg import eigh

    n, width = rows.shape
    if min(n, width) > _EXACT_AXES:
        return _axes_by_iteration(rows)
    wide = rows.astype(np.float64)
    gram = wide @ wide.T if n < width else wide.T @ wide
    first = max(len(gram) - _DIMENSIONS, 0)
    values, vectors = eigh(gram, subset_by_index=(first, len(gram) - 1), overwrite_a=True)
    held = values > 1e-9 * max(values[-1], 1e-300)
    values, vectors = values[held], vectors[:, held]
    axes = wide.T @ (vectors / np.sqrt(values)) if n < width else vectors
    return np.ascontiguousarray(axes, np.float32)


def _axes_by_iteration(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Nearly the same by subspace iteration (Halko, Martinsson and Tropp 2011, algorithm 4.4), seeded.

    All eigenvectors of a covariance of 3,200 features take twenty seconds, of 9,600 minutes.
    """
    width = rows.shape[1]
    covariance = rows.T @ rows if width <= _WIDE else None
    basis = np.random.default_rng(0).standard_normal((width, _DIMENSIONS + _MORE_AXES))
    for _ in range(_ROUNDS):
        narrow = basis.astype(np.float32)
        basis = np.linalg.qr(rows.T @ (rows @ narrow) if covariance is None else covariance @ narrow)[0]
    within = (rows @ basis.astype(np.float32)).astype(np.float64)
    vectors = np.linalg.eigh(within.T @ within)[1][:, -_DIMENSIONS:]
    return np.ascontiguousarray(basis @ vectors, np.float32)
