"""The direct formulation: an overcomplete sparsifying transform.

Lives here: `TransformLearner`. Not here: the loop (`alternation`), the penalty's readings (`omega`).
"""

from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular, svd
from sklearn.utils.validation import check_is_fitted

from streamfeat.errors import InputError
from streamfeat.learn.alternation import Alternation, Step
from streamfeat.learn.chunks import ChunkedVolumes, checked_volumes
from streamfeat.learn.omega import Omega
from streamfeat.work.workers import Sums

__all__ = ["TransformLearner"]

GRADIENT_STEPS = 4
"""After the closed form of free rows. On N-CARS volumes four come within 0.1 % of where a hundred steps of
L-BFGS come; each costs two to three products of `(K, d)` with `(d, d)`, little beside a pass over volumes."""


class _Quadratic(NamedTuple):
    """The objective over `A` for fixed codes: `1/2 tr(A S A') - tr(A C') + Omega(A)`."""

    moment: NDArray[np.float64]  # S + conditioning I, S = X X' / n, (d, d)
    cross: NDArray[np.float64]  # C = L X' / n, (K, d)
    penalty: Omega  # but for the conditioning

    def value(self, A: NDArray[np.float64]) -> float:
        fit = 0.5 * np.sum((A @ self.moment) * A) - np.sum(A * self.cross)
        return float(fit) + self.penalty.value(A, self.moment)

    def gradient(self, A: NDArray[np.float64]) -> NDArray[np.float64]:
        return A @ self.moment - self.cross + self.penalty.gradient(A, self.moment)


@dataclass(eq=False, repr=False)
class TransformLearner(Alternation):
    """Learn `A` of `min over A, L of 1/2 |A X - L|_F^2 + lambda0 |L|_1 + lambda1 Omega(A)`.

    Kostadinov and Scaramuzza (ICPR 2020/21), direct problem formulation, by alternating minimisation; the
    data terms are means over volumes, and `Omega` with its two readings is `learn.omega.Omega`.

    Codes are exact: a soft threshold. The transform is updated through the singular value decomposition of
    `L X' S^-T` with `X X' + conditioning I = S S'` (Ravishankar and Bresler 2013, section IV-B, generalised
    to `K != d`), each singular value the root of a scalar equation: exact without the coherence term. With it
    the singular vectors are kept and the equation becomes a quartic (Kostadinov et al. 2018, approximate
    closed form). That candidate alone stalls: its singular vectors are the best only where the penalty is a
    function of `A S` alone, and coherence is one of `A`, so that it may be worse than the transform before
    however far one goes towards it. It is taken only if it is better, and a few gradient steps follow, each
    shortened until the objective falls (Armijo): it never rises, and stays only where the gradient is zero.

    That is with `rows="free"`. With `rows="unit"`, the default, filters keep unit length and `lambda0` is in
    units of theirs: `|A|_F^2` is constant, whitening makes `X X'` the identity (but for what `eps_zca` adds),
    so that `|A X|_F^2` is constant too, and no weight of `Omega` is needed to keep filters from vanishing.
    What is left of it is the sum of `-a_k . c_k`, `C = L X'`, and its closed form is `a_k = c_k / |c_k|`:
    ascent of a convex function on the sphere, so the objective never rises. A determinant pulls filters
    towards an orthonormal basis and away from sparse codes: on N-CARS blocks unit rows were two to four
    points better than free ones, and level with spherical k-means or better.

    State: at most `3 d^2 + 10 K d` float64, for each thread that works `2 K d` more and for each of
    `chunk_size` volumes `3 K + d` float32, and for each volume 8 bytes, its squared length: of the volumes
    only the sums `X X'` and `L X'` over chunks are kept.

    Args:
        n_filters: `K`.
        threshold: `lambda0`, not negative; in units of unit-length filters if `rows` is `unit`.
        rows: `unit` or `free`; the next three weights are for `free` only.
        conditioning: weight of `|A|_F^2 / 2`.
        coherence: weight of `|A'A - I|_F^2 / 4`; at 0.1 digits are recognised less often (cross-validation
            over four seeds 0.881, at 0.02 and at 0 0.893).
        log_det: weight of `-log|det A'A|`, or of `-log|det A X X' A'|` for `K < d`.
        max_iter: iterations at most, each of two half-steps.
        tol: stop when an iteration lowers the objective by less than this share.
        chunk_size: volumes whose codes are held at a time.
        warm_start: start from `components_` of the fit before.
        random_state: seed of the initial transform.
        progress: called with (iteration, objective) after each iteration.

    Attributes:
        components_: `(K, d)` float32, `A`.
        objective_: `(2 n_iter_,)` the objective after each half-step (codes, transform) of this fit.
        condition_: `(n_iter_,)` ratio of the largest to the smallest singular value of `A`.
        coherence_: `(n_iter_,)` largest `|cos|` between two filters.
        unused_: filters that no volume's code used in the last iteration. Many of them, as may be with
            `K > d`, say that the threshold is too high or `log_det` too low: no term of `Omega` asks for more
            than `d` filters.
        n_iter_: iterations done in this fit.
        interrupted_: whether Ctrl-C ended it.
    """

    n_filters: int = 400
    _: KW_ONLY
    threshold: float = 2.0
    rows: str = "unit"
    conditioning: float = 0.1
    coherence: float = 0.02
    log_det: float = 0.1
    max_iter: int = 30

    def transform(self, X: ArrayLike | ChunkedVolumes) -> NDArray[np.float32]:
        """Codes `(n, K)` of `(n, d)` whitened volumes: `sign(z) max(|z| - lambda0, 0)`, `z = A x`."""
        check_is_fitted(self)
        volumes = checked_volumes(self, X, self.chunk_size, reset=False)
        return np.concatenate(volumes.fetch(volumes.each(_codes, self.components_, self.threshold)))

    @property
    def _n_rows(self) -> int:
        return self.n_filters

    def _check(self, n_volumes: int) -> None:
        if not 0 <= self.threshold < np.inf:
            raise InputError(f"threshold is {self.threshold}, it must be finite and not negative")
        if self.rows not in ("unit", "free"):
            raise InputError(f"rows is {self.rows!r}, it must be 'unit' or 'free'")
        Omega(self.conditioning, self.coherence, self.log_det)  # refuses weights that cannot be used
        super()._check(n_volumes)

    def _alternate(
        self, volumes: ChunkedVolumes, squares: NDArray[np.float64], rows: NDArray[np.float32]
    ) -> Iterator[Step]:
        return self._with_unit_rows(volumes, rows) if self.rows == "unit" else self._with_free(volumes, rows)

    def _with_unit_rows(self, volumes: ChunkedVolumes, rows: NDArray[np.float32]) -> Iterator[Step]:
        rows = _unit(rows.astype(np.float64))
        while True:
            cross, constant = self._code(volumes, rows)
            found = _unit(np.where(np.any(cross, axis=1, keepdims=True), cross, rows))
            fits = (float(np.sum(some * cross, dtype=np.float64)) for some in (rows, found))
            before, after = (0.5 * len(rows) + constant - fit for fit in fits)
            # At a maximum the rounding to float32 may weigh more than what was gained.
            if after < before:
                rows = found
            yield Step(rows, before, min(before, after))

    def _with_free(self, volumes: ChunkedVolumes, rows: NDArray[np.float32]) -> Iterator[Step]:
        d = volumes.shape[1]
        # Conditioning is part of the quadratic form; never quite zero, so that the form has an inverse.
        (products,) = volumes.total(_products)
        moment = max(self.conditioning, 1e-6) * np.eye(d) + products / volumes.shape[0]
        penalty = Omega(coherence=self.coherence, log_det=self.log_det)
        while True:
            cross, constant = self._code(volumes, rows)
            problem = _Quadratic(moment, cross, penalty)
            before = problem.value(rows.astype(np.float64))
            found = _update(problem, rows.astype(np.float64), before).astype(np.float32)
            after = problem.value(found.astype(np.float64))
            # At a minimum the rounding to float32 may weigh more than what was gained.
            if after < before:
                rows = found
            yield Step(rows, constant + before, constant + min(before, after))

    def _code(self, volumes: ChunkedVolumes, rows: NDArray[np.float32]) -> tuple[NDArray[np.float64], float]:
        """One pass over the volumes: `L X' / n`, and the part of the objective that `A` does not move."""
        cross, used, parts = volumes.total(_code_sums, rows, self.threshold)
        self.unused_ = int(np.count_nonzero(used == 0))
        return cross / volumes.shape[0], float(parts[0] + self.threshold * parts[1]) / volumes.shape[0]


def _unit(rows: NDArray[np.float64]) -> NDArray[np.float32]:
    """Rows of unit length; those that have it already keep their bits."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    lengths[np.abs(lengths - 1) < 1e-6] = 1
    return np.asarray(rows / lengths, np.float32)


def _codes(chunk: NDArray[np.float32], rows: NDArray[np.float32], threshold: float) -> NDArray[np.float32]:
    """Soft thresholds `(m, K)`."""
    z, level = chunk @ rows.T, np.float32(threshold)
    return np.asarray(z - z.clip(-level, level))


def _products(chunk: NDArray[np.float32]) -> Sums:
    """The chunk's part of `X X'`."""
    return ((chunk.T @ chunk).astype(np.float64),)


def _code_sums(chunk: NDArray[np.float32], rows: NDArray[np.float32], threshold: float) -> Sums:
    """The chunk's part of `L X'`, how many codes of each filter are not zero, and `(|L|^2 / 2, |L|_1)`."""
    codes = _codes(chunk, rows, threshold)
    halves = 0.5 * np.square(codes).sum(dtype=np.float64)
    parts = np.array([halves, np.abs(codes).sum(dtype=np.float64)])
    return (codes.T @ chunk).astype(np.float64), np.count_nonzero(codes, axis=0).astype(np.float64), parts


def _update(problem: _Quadratic, A: NDArray[np.float64], before: float) -> NDArray[np.float64]:
    """The transform half-step: the better of `A` and the closed form, then gradient steps."""
    candidate = _closed_form(problem)
    value = problem.value(candidate)
    if value < before:
        return _descend(problem, candidate, value)
    return _descend(problem, A, before) if before < np.inf else A


def _closed_form(problem: _Quadratic) -> NDArray[np.float64]:
    """Minimise over the singular values of `B = A S`, in the singular basis of `L X' S^-T`."""
    penalty = problem.penalty
    factor = cholesky(problem.moment, lower=True)
    target = solve_triangular(factor, problem.cross.T, lower=True)
    right, sigma, left = svd(target, full_matrices=False)
    back = solve_triangular(factor, right, lower=True, trans="T")
    # A direction of B of length one is as long as this in A.
    shrink = np.square(back).sum(axis=0)
    gamma = _positive_root(sigma, penalty.coherence, shrink, penalty.log_det)
    return np.asarray(((back * gamma) @ left).T)


def _positive_root(
    sigma: NDArray[np.float64], coherence: float, shrink: NDArray[np.float64], log_det: float
) -> NDArray[np.float64]:
    """Minimise `1/2 g^2 - sigma g + coherence/4 (shrink g^2 - 1)^2 - 2 log_det log g` over `g > 0`.

    `g` times the slope is `p(g) = coherence shrink^2 g^4 + (1 - coherence shrink) g^2 - sigma g - 2 log_det`,
    which changes its signs once, so it has one positive root (Descartes), and is convex to the right of it.
    Newton's method from a point to the right falls to the root without overshooting.
    """
    fourth, second = coherence * shrink**2, 1.0 - coherence * shrink
    gamma = (sigma + np.sqrt(sigma**2 + 8.0 * log_det)) / 2.0 + 1.0 / np.sqrt(shrink)
    for _ in range(60):
        value = ((fourth * gamma**2 + second) * gamma - sigma) * gamma - 2.0 * log_det
        slope = (4.0 * fourth * gamma**2 + 2.0 * second) * gamma - sigma
        gamma = gamma - np.where(slope > 0, value / np.where(slope > 0, slope, 1.0), 0.0)
    return np.maximum(gamma, 0.0)


def _descend(problem: _Quadratic, A: NDArray[np.float64], value: float) -> NDArray[np.float64]:
    """A few gradient steps in the metric of the quadratic part; each lowers the objective or is not taken."""
    stiffness = 2.0 * problem.penalty.coherence + problem.penalty.log_det
    metric = cholesky(problem.moment + stiffness * np.eye(A.shape[1]), lower=True)
    length = 1.0
    for _ in range(GRADIENT_STEPS):
        gradient = problem.gradient(A)
        direction = cho_solve((metric, True), gradient.T).T
        slope = float(np.sum(direction * gradient))
        if slope <= 1e-12 * abs(value):
            break
        while (found := problem.value(A - length * direction)) > value - 1e-4 * length * slope:
            length /= 2.0
            if length < 1e-8:
                return A
        A, value, length = A - length * direction, found, 2.0 * length
    return A
