"""The penalty of both formulations on a matrix, `Omega`, and the two figures that show it.

Lives here: the penalty with its gradient, condition number, mutual coherence.
Not here: the learners that minimise it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky

from streamfeat.errors import InputError

__all__ = ["Omega", "condition_number", "mutual_coherence"]


@dataclass(frozen=True, slots=True)
class Omega:
    """The penalty on a transform or dictionary, for `M` the `(K, d)` filters or atoms as rows.

    Kostadinov and Scaramuzza (ICPR 2020/21) print `Omega(D) = lambda2 |D|_F^2 - lambda3 |D D' - I|_F^2
    - lambda4 log|det D D'|` for a dictionary `D = M'` of shape `(d, K)`. Here it is

        conditioning/2 |M|_F^2 + coherence/4 |M'M - I|_F^2 - log_det log|det M'M|,

    `lambda1` being part of the three weights, in the signs of Kostadinov, Voloshynovskiy and Ferdowsi (2018)
    and, but for coherence, Ravishankar and Bresler (2013). Two readings are needed:

    - *Sign.* The coherence term is added: only then does its minimum mean low coherence.
    - *Which Gram matrix.* `|M'M - I_d|_F^2`, as printed, is that of a tight frame; the inner products between
      filters, which coherence is about, are those of `|M M' - I_K|_F^2`. Both are the sum of
      `(sigma^2 - 1)^2` over the singular values of `M`, and one more for each dimension that is left, so they
      differ by the constant `K - d`: one term serves a transform and a dictionary. The determinant has no
      such luck: that of `M'M` exists for `K >= d` only. For `K < d` it is that of `M S M'`, where `S` is the
      second moment of the volumes. (For `K >= d` that would be the same but for the constant `log|det S|`.
      `M M'` alone rewards filters along the directions in which volumes vary least, which is noise: with
      K = 200 on N-CARS it cost three points of accuracy, 0.90 to 0.87.)

    Args:
        conditioning: weight of `|M|_F^2 / 2`, not negative.
        coherence: weight of `|M'M - I|_F^2 / 4`, not negative.
        log_det: weight of `-log|det M'M|`, or `-log|det M S M'|` for `K < d`, not negative.

    Raises:
        InputError: a weight is negative or not finite.
    """

    conditioning: float = 0.0
    coherence: float = 0.0
    log_det: float = 0.0

    def __post_init__(self) -> None:
        """Check the weights."""
        for name in ("conditioning", "coherence", "log_det"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(f"{name} is {getattr(self, name)}, it must be finite and not negative")

    def value(self, rows: NDArray[np.float64], moment: NDArray[np.float64] | None = None) -> float:
        """The penalty of `(K, d)` rows; infinite where the determinant is zero and has a weight.

        Args:
            rows: `M`.
            moment: `S`, `(d, d)`, of use for the determinant of `K < d` rows only; I if not given.
        """
        gram = _smaller_gram(rows)
        squares = float(np.trace(gram))
        value: float = 0.5 * self.conditioning * squares
        value += 0.25 * self.coherence * (float(np.sum(gram * gram)) - 2 * squares + rows.shape[1])
        if self.log_det:
            tall = len(gram) == rows.shape[1]
            weighted = gram if tall or moment is None else rows @ moment @ rows.T
            try:
                value -= 2 * self.log_det * float(np.log(np.diag(cholesky(weighted))).sum())
            except np.linalg.LinAlgError:
                return float("inf")
        return value

    def gradient(
        self, rows: NDArray[np.float64], moment: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """The gradient `(K, d)` of a finite `value`."""
        gram = _smaller_gram(rows)
        tall = len(gram) == rows.shape[1]
        found = (self.conditioning - self.coherence) * rows
        if self.coherence:
            found += self.coherence * (rows @ gram if tall else gram @ rows)
        if self.log_det and tall:
            found -= 2 * self.log_det * cho_solve((cholesky(gram, lower=True), True), rows.T).T
        elif self.log_det:
            turned = rows if moment is None else rows @ moment
            found -= 2 * self.log_det * cho_solve((cholesky(turned @ rows.T, lower=True), True), turned)
        return found


def _smaller_gram(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """`M'M` or `M M'`, whichever is smaller: their eigenvalues are the same but for zeros."""
    return rows.T @ rows if rows.shape[0] >= rows.shape[1] else rows @ rows.T


def condition_number(rows: NDArray[np.floating]) -> float:
    """Largest singular value of `(K, d)` rows over the smallest.

    Values below `1e-5` of the largest are left out: volumes have no mean, so that there is a direction which
    a dictionary of them does not hold.
    """
    values = np.linalg.eigvalsh(_smaller_gram(rows.astype(np.float64)))
    held = values[values > 1e-10 * max(values[-1], 1e-300)]
    return float(np.sqrt(held[-1] / held[0])) if len(held) else float("inf")


def mutual_coherence(rows: NDArray[np.floating]) -> float:
    """The largest `|cos|` between two of `(K, d)` rows; rows of zeros are left out."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    unit = (rows / np.where(lengths > 1e-12, lengths, np.inf)).astype(np.float64)
    cosines = np.abs(unit @ unit.T)
    np.fill_diagonal(cosines, 0.0)
    return float(cosines.max())
