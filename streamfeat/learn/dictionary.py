"""The inverse formulation: an overcomplete dictionary.

Lives here: `DictionaryLearner`. Not here: the lasso itself (`kernels.lasso`), sampling and whitening.
"""

from collections.abc import Callable
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted, validate_data

from streamfeat.errors import InputError
from streamfeat.kernels.lasso import solve_lasso_rows
from streamfeat.learn.initial import random_directions

__all__ = ["DictionaryLearner"]

Progress = Callable[[int, float], None]


class DictionaryLearner(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Learn `D` of `min over D, L of 1/2 |X - D L|_F^2 + lambda0 |L|_1`, atoms of unit length.

    Kostadinov and Scaramuzza (ICPR 2020/21), inverse problem formulation, by alternating minimisation;
    the data terms are means over volumes. Codes are lassos, solved to a duality gap from the codes before
    them. The dictionary is updated one atom at a time from the sums `L L'` and `X L'` (Mairal et al. 2010,
    algorithm 2), and an atom that no volume uses is replaced by the volume that is represented worst.
    The length of atoms stands in for the conditioning term of `Omega`; its coherence and determinant terms
    are not part of this objective.

    Args:
        n_atoms: `K`.
        threshold: `lambda0`, above zero.
        max_iter: alternations.
        tol: stop when the objective falls by less than this share.
        gap: relative duality gap of the codes.
        chunk_size: volumes whose codes are held as floats at a time.
        random_state: seed of the initial dictionary.
        progress: called with (iteration, objective) after each iteration.

    Attributes:
        components_: `(K, d)` float32, the atoms as rows, `D'`.
        objective_: `(2 n_iter_,)` the objective after each half-step (codes, dictionary).
        replaced_: atoms replaced in all.
        n_iter_: iterations done.
    """

    def __init__(
        self,
        n_atoms: int = 400,
        *,
        threshold: float = 1.0,
        max_iter: int = 10,
        tol: float = 1e-3,
        gap: float = 1e-3,
        chunk_size: int = 8192,
        random_state: int | None = None,
        progress: Progress | None = None,
    ) -> None:
        """Keep the parameters."""
        self.n_atoms = n_atoms
        self.threshold = threshold
        self.max_iter = max_iter
        self.tol = tol
        self.gap = gap
        self.chunk_size = chunk_size
        self.random_state = random_state
        self.progress = progress

    def fit(self, X: ArrayLike, y: Any = None) -> Self:
        """Learn from `(n, d)` whitened volumes.

        Raises:
            InputError: threshold is not above zero, or there is only one volume.
        """
        white = validate_data(self, X, dtype=np.float32)
        if not self.threshold > 0:
            raise InputError(f"threshold is {self.threshold}, it must be above zero")
        if len(white) < 2:
            raise InputError(f"{len(white)} sample is too few to learn from")
        atoms = random_directions(white, self.n_atoms, check_random_state(self.random_state))
        codes = np.zeros((len(white), self.n_atoms), np.float32)
        energy = 0.5 * float(np.square(white, dtype=np.float64).sum()) / len(white)
        objective: list[float] = []
        self.replaced_ = 0
        for iteration in range(self.max_iter):
            self._code(white, atoms, codes)
            gram, cross, l1 = self._sums(white, codes)
            objective.append(energy + self._fit(atoms, gram, cross) + self.threshold * l1)
            atoms = self._update_atoms(atoms, gram, cross)
            objective.append(energy + self._fit(atoms, gram, cross) + self.threshold * l1)
            if self.progress:
                self.progress(iteration + 1, objective[-1])
            if len(objective) > 2 and objective[-3] - objective[-1] <= self.tol * abs(objective[-3]):
                break
            self._replace_unused(white, atoms, codes, gram)
        self.components_ = atoms
        self.objective_ = np.array(objective)
        self.n_iter_ = len(objective) // 2
        return self

    def transform(self, X: ArrayLike) -> NDArray[np.float32]:
        """Lasso codes `(n, K)` of `(n, d)` whitened volumes."""
        check_is_fitted(self)
        white = validate_data(self, X, dtype=np.float32, reset=False)
        codes = np.zeros((len(white), self.n_atoms), np.float32)
        self._code(white, self.components_, codes)
        return codes

    def __sklearn_tags__(self) -> Any:
        """Say that codes are float32 whatever goes in."""
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = []
        return tags

    def _code(
        self, white: NDArray[np.float32], atoms: NDArray[np.float32], codes: NDArray[np.float32]
    ) -> None:
        gram = (atoms.astype(np.float64) @ atoms.T.astype(np.float64)).astype(np.float32)
        for start in range(0, len(white), self.chunk_size):
            chunk = white[start : start + self.chunk_size]
            right = chunk @ atoms.T
            squares = np.square(chunk).sum(axis=1, dtype=np.float64)
            part = codes[start : start + self.chunk_size]
            solve_lasso_rows(right, squares, float(self.threshold), gram, self.gap, part)

    def _sums(
        self, white: NDArray[np.float32], codes: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """`L L' / n`, `L X' / n` and the mean l1 norm of the codes."""
        k, d = codes.shape[1], white.shape[1]
        gram, cross, l1 = np.zeros((k, k)), np.zeros((k, d)), 0.0
        for start in range(0, len(white), self.chunk_size):
            part = codes[start : start + self.chunk_size]
            gram += part.T @ part
            cross += part.T @ white[start : start + self.chunk_size]
            l1 += float(np.abs(part).sum(dtype=np.float64))
        return gram / len(white), cross / len(white), l1 / len(white)

    @staticmethod
    def _fit(atoms: NDArray[np.float32], gram: NDArray[np.float64], cross: NDArray[np.float64]) -> float:
        wide = atoms.astype(np.float64)
        return float(0.5 * np.sum((gram @ wide) * wide) - np.sum(cross * wide))

    @staticmethod
    def _update_atoms(
        atoms: NDArray[np.float32], gram: NDArray[np.float64], cross: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Minimise over one atom after the other, each within the unit ball (Mairal 2010, algorithm 2)."""
        wide = atoms.astype(np.float64)
        for j in np.flatnonzero(np.diag(gram) > 1e-12):
            atom = wide[j] + (cross[j] - gram[j] @ wide) / gram[j, j]
            wide[j] = atom / max(np.linalg.norm(atom), 1.0)
        return wide.astype(np.float32)

    def _replace_unused(
        self,
        white: NDArray[np.float32],
        atoms: NDArray[np.float32],
        codes: NDArray[np.float32],
        gram: NDArray[np.float64],
    ) -> None:
        """Let unused atoms become the volumes that are represented worst."""
        unused = np.flatnonzero(np.diag(gram) <= 1e-12)
        if len(unused) == 0:
            return
        looked_at = slice(0, self.chunk_size)
        errors = np.square(white[looked_at] - codes[looked_at] @ atoms).sum(axis=1)
        worst = np.argsort(errors)[::-1][: len(unused)]
        for j, volume in zip(unused, worst, strict=False):
            length = np.linalg.norm(white[volume])
            if length > 1e-6:
                atoms[j] = white[volume] / length
                self.replaced_ += 1
