"""The direct formulation: an overcomplete sparsifying transform.

Lives here: `TransformLearner`. Not here: sampling and whitening of volumes.
"""

from collections.abc import Callable
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cholesky, solve_triangular, svd
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted, validate_data

from streamfeat.errors import InputError
from streamfeat.learn.initial import random_directions

__all__ = ["TransformLearner"]

Progress = Callable[[int, float], None]


class TransformLearner(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Learn `A` of `min over A, L of 1/2 |A X - L|_F^2 + lambda0 |L|_1 + lambda1 Omega(A)`.

    Kostadinov and Scaramuzza (ICPR 2020/21), direct problem formulation, by alternating minimisation;
    the data terms are means over volumes. `Omega(A) = conditioning/2 |A|_F^2
    + coherence/4 |A'A - I|_F^2 - log_det log|det A'A|`, which reads the printed formula so: the coherence
    term is added, for its minimum to mean low coherence; for `K > d` the determinant that exists is that
    of `A'A`, for `K < d` that of `A A'` (both are the product of the squared singular values); `lambda1`
    is part of the three weights.

    Codes are exact: a soft threshold. The transform is updated through the singular value decomposition
    of `S^-1 X L'` with `X X' + conditioning I = S S'` (Ravishankar and Bresler 2013, section IV-B,
    generalised to `K != d`), each singular value the root of a scalar equation; the coherence term is
    taken along (Kostadinov et al. 2018, approximate closed form) by keeping the singular vectors. For
    `K < d` the determinant is that of `A S` instead, since only for `K >= d` do the two differ by a constant.
    Where an approximation would raise the objective the step is shortened until it does not, so the objective
    never rises.

    Args:
        n_filters: `K`.
        threshold: `lambda0`.
        conditioning: weight of `|A|_F^2 / 2`.
        coherence: weight of `|A'A - I|_F^2 / 4`.
        log_det: weight of `-log|det A'A|`.
        max_iter: alternations.
        tol: stop when the objective falls by less than this share.
        chunk_size: volumes whose codes are held at a time.
        random_state: seed of the initial transform.
        progress: called with (iteration, objective) after each iteration.

    Attributes:
        components_: `(K, d)` float32, `A`.
        objective_: `(2 n_iter_,)` the objective after each half-step (codes, transform).
        condition_: `(n_iter_,)` ratio of the largest to the smallest singular value of `A`.
        n_iter_: iterations done.
    """

    def __init__(
        self,
        n_filters: int = 400,
        *,
        threshold: float = 0.5,
        conditioning: float = 0.1,
        coherence: float = 0.1,
        log_det: float = 0.1,
        max_iter: int = 30,
        tol: float = 1e-4,
        chunk_size: int = 8192,
        random_state: int | None = None,
        progress: Progress | None = None,
    ) -> None:
        """Keep the parameters."""
        self.n_filters = n_filters
        self.threshold = threshold
        self.conditioning = conditioning
        self.coherence = coherence
        self.log_det = log_det
        self.max_iter = max_iter
        self.tol = tol
        self.chunk_size = chunk_size
        self.random_state = random_state
        self.progress = progress

    def fit(self, X: ArrayLike, y: Any = None) -> Self:
        """Learn from `(n, d)` whitened volumes.

        Raises:
            InputError: a weight is negative, or there are fewer volumes than entries.
        """
        white = validate_data(self, X, dtype=np.float32)
        n, d = white.shape
        if not all(w >= 0 for w in (self.threshold, self.conditioning, self.coherence, self.log_det)):
            raise InputError("threshold, conditioning, coherence and log_det must not be negative")
        if n < 2:
            raise InputError(f"{n} sample is too few to learn from; give at least {d} volumes")
        rng = check_random_state(self.random_state)
        transform = random_directions(white, self.n_filters, rng).astype(np.float64)
        second_moment = self._second_moment(white)
        factor = cholesky(second_moment + max(self.conditioning, 1e-6) * np.eye(d), lower=True)
        objective: list[float] = []
        condition: list[float] = []
        for iteration in range(self.max_iter):
            cross, constant = self._code(white, transform)
            objective.append(constant + self._smooth(transform, second_moment, cross))
            candidate = self._solve(factor, cross)
            transform = self._descend(transform, candidate, second_moment, cross)
            objective.append(constant + self._smooth(transform, second_moment, cross))
            singular = np.linalg.svd(transform, compute_uv=False)
            condition.append(float(singular[0] / max(singular[-1], 1e-300)))
            if self.progress:
                self.progress(iteration + 1, objective[-1])
            if len(objective) > 2 and objective[-3] - objective[-1] <= self.tol * abs(objective[-3]):
                break
        self.components_ = transform.astype(np.float32)
        self.objective_ = np.array(objective)
        self.condition_ = np.array(condition)
        self.n_iter_ = len(condition)
        return self

    def transform(self, X: ArrayLike) -> NDArray[np.float32]:
        """Codes `(n, K)` of `(n, d)` whitened volumes: `sign(z) max(|z| - lambda0, 0)`, `z = A x`."""
        check_is_fitted(self)
        white = validate_data(self, X, dtype=np.float32, reset=False)
        z = white @ self.components_.T
        return np.asarray(z - z.clip(-np.float32(self.threshold), np.float32(self.threshold)))

    def __sklearn_tags__(self) -> Any:
        """Say that codes are float32 whatever goes in."""
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = []
        return tags

    def _second_moment(self, white: NDArray[np.float32]) -> NDArray[np.float64]:
        total = np.zeros((white.shape[1],) * 2)
        for start in range(0, len(white), self.chunk_size):
            chunk = white[start : start + self.chunk_size]
            total += chunk.T @ chunk
        return total / len(white)

    def _code(
        self, white: NDArray[np.float32], transform: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float]:
        """One pass over the volumes: `L X' / n`, and the part of the objective that `A` does not move."""
        rows = transform.astype(np.float32)
        level = np.float32(self.threshold)
        cross, constant = np.zeros(transform.shape), 0.0
        for start in range(0, len(white), self.chunk_size):
            chunk = white[start : start + self.chunk_size]
            z = chunk @ rows.T
            codes = z - z.clip(-level, level)
            cross += codes.T @ chunk
            constant += 0.5 * float(np.square(codes).sum(dtype=np.float64))
            constant += self.threshold * float(np.abs(codes).sum(dtype=np.float64))
        return cross / len(white), constant / len(white)

    def _smooth(
        self,
        transform: NDArray[np.float64],
        second_moment: NDArray[np.float64],
        cross: NDArray[np.float64],
    ) -> float:
        """The part of the objective that `A` moves, for fixed codes."""
        squares = np.square(np.linalg.svd(transform, compute_uv=False))
        fit = 0.5 * np.sum((transform @ second_moment) * transform) - np.sum(transform * cross)
        penalty = 0.5 * self.conditioning * squares.sum()
        penalty += 0.25 * self.coherence * np.square(squares - 1).sum()
        if self.log_det:
            penalty -= self.log_det * np.log(squares.clip(min=1e-300)).sum()
        return float(fit + penalty)

    def _solve(self, factor: NDArray[np.float64], cross: NDArray[np.float64]) -> NDArray[np.float64]:
        """Minimise over the singular values of `B = A S`, in the singular basis of `L X' S^-T`."""
        target = solve_triangular(factor, cross.T, lower=True)
        right, sigma, left = svd(target, full_matrices=False)
        # Between A and B singular values differ by the mean scale of S, which whitening keeps near one.
        scale = float(np.mean(np.square(np.diag(factor))))
        gamma = (sigma + np.sqrt(np.square(sigma) + 8.0 * self.log_det)) / 2.0
        # Without the determinant's barrier it can be zero, which must not be divided by.
        gamma = np.maximum(gamma, 1e-100)
        weight = self.coherence / scale
        for _ in range(50):
            slope = gamma - sigma - 2.0 * self.log_det / gamma + weight * gamma * (gamma**2 / scale - 1.0)
            curve = 1.0 + 2.0 * self.log_det / gamma**2 + weight * (3.0 * gamma**2 / scale - 1.0)
            step = slope / np.maximum(curve, 1e-3)
            gamma = np.maximum(gamma - step, gamma / 2.0)
        scaled = (right * gamma) @ left
        return np.asarray(solve_triangular(factor, scaled, lower=True, trans="T").T)

    def _descend(
        self,
        transform: NDArray[np.float64],
        candidate: NDArray[np.float64],
        second_moment: NDArray[np.float64],
        cross: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Go to the candidate, or towards it only as far as the objective does not rise."""
        before = self._smooth(transform, second_moment, cross)
        share = 1.0
        while share > 1e-6:
            mixed = transform + share * (candidate - transform)
            if self._smooth(mixed, second_moment, cross) <= before:
                return mixed
            share /= 2.0
        return transform
