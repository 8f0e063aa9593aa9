"""The inverse formulation: an overcomplete dictionary.

Lives here: `DictionaryLearner`. Not here: the loop (`alternation`), the lasso itself (`kernels.lasso`).
"""

from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from sklearn.utils.validation import check_is_fitted

from streamfeat.errors import InputError
from streamfeat.kernels.lasso import solve_lasso_rows
from streamfeat.learn.alternation import Alternation, Step
from streamfeat.learn.chunks import ChunkedVolumes, checked_volumes
from streamfeat.learn.omega import Omega
from streamfeat.work.workers import Sums

__all__ = ["DictionaryLearner"]

_UNUSED = 1e-12
"""Mean square of an atom's codes at which no volume uses it."""


@dataclass(slots=True)
class _Sums:
    """Means over volumes: all that the dictionary half-step needs to know of volumes and codes."""

    gram: NDArray[np.float64]  # L L' / n, (K, K)
    cross: NDArray[np.float64]  # L X' / n, (K, d)
    l1: NDArray[np.float64]  # mean of |l_k|, (K,)

    def objective(self, atoms: NDArray[np.float64], penalty: float) -> float:
        """`1/2 |X - D L|^2 - 1/2 |X|^2 + penalty |L|_1`."""
        fit = 0.5 * np.sum((self.gram @ atoms) * atoms) - np.sum(self.cross * atoms)
        return float(fit + penalty * self.l1.sum())

    def scale(self, j: int, factor: float) -> None:
        """Let the codes of atom `j` be that many times what they were."""
        self.gram[j] *= factor
        self.gram[:, j] *= factor
        self.cross[j] *= factor
        self.l1[j] *= factor


@dataclass(eq=False, repr=False)
class DictionaryLearner(Alternation):
    """Learn `D` of `min over D, L of 1/2 |X - D L|_F^2 + lambda0 |L|_1 + lambda1 Omega(D)`, unit atoms.

    Kostadinov and Scaramuzza (ICPR 2020/21), inverse problem formulation, by alternating minimisation; the
    data terms are means over volumes. Codes are lassos, solved to a duality gap from the codes before them.

    The dictionary half-step is the approximate K-SVD of Rubinstein, Zibulevsky and Elad (2008, algorithm 5):
    atom after atom becomes `d_j = E_j l_j / |E_j l_j|`, where `E_j` is what the others leave of the volumes
    and `l_j` the atom's codes, and then the codes are fitted to the new atom. Two deviations: `E_j l_j`
    comes from the sums `L L'` and `L X'`, so that no residual of all volumes is kept; and the codes are only
    rescaled, to the minimum of fit and `lambda0 |l_j|_1`, since the lasso solves them again at once.

    Of `Omega` (`learn.omega.Omega`) the coherence term is taken along in each atom's step, by a quadratic
    that lies above it and touches it at the atom before: `d_j` is the direction of
    `E_j l_j + coherence (s d_j - G_j d_j)`, `G_j` the sum of `d d'` over the other atoms and `s` its largest
    eigenvalue, and is left as it was where that would raise the objective. The other two terms have nothing
    to add: for atoms of unit length `|D|_F^2` is `K`, and both the determinant and the coherence term are
    best where all singular values are equal, a tight frame with condition number one.

    No half-step raises the objective. After an iteration an atom that no volume uses becomes the volume that
    is represented worst, which does not touch fit and codes, but may raise the coherence term.

    State: at most `4 K^2 + 5 K d` float64, for each thread that works `2 K^2 + 2 K d` more and for each of
    `chunk_size` volumes `3 K + d` float32, for each volume 16 bytes and for each code that is not zero 8,
    from which the next lasso starts.

    Args:
        n_atoms: `K`.
        threshold: `lambda0`, above zero.
        coherence: weight of `|D D' - I|_F^2 / 4`.
        gap: relative duality gap of the codes.
        max_iter: iterations at most, each of two half-steps.
        tol: stop when an iteration lowers the objective by less than this share.
        chunk_size: volumes whose codes are held as floats at a time.
        warm_start: start from `components_` of the fit before; codes start from zero.
        random_state: seed of the initial dictionary.
        progress: called with (iteration, objective) after each iteration.

    Attributes:
        components_: `(K, d)` float32, the atoms as rows, `D'`.
        objective_: `(2 n_iter_,)` the objective after each half-step (codes, dictionary) of this fit.
        condition_: `(n_iter_,)` ratio of the largest to the smallest singular value of `D`.
        coherence_: `(n_iter_,)` largest `|cos|` between two atoms.
        replaced_: atoms replaced in this fit.
        unused_: atoms that no volume's code used in the last iteration.
        n_iter_: iterations done in this fit.
        interrupted_: whether Ctrl-C ended it.
    """

    n_atoms: int = 400
    _: KW_ONLY
    threshold: float = 1.0
    coherence: float = 0.1
    gap: float = 1e-3
    tol: float = 1e-3

    def transform(self, X: ArrayLike | ChunkedVolumes) -> NDArray[np.float32]:
        """Lasso codes `(n, K)` of `(n, d)` whitened volumes."""
        check_is_fitted(self)
        volumes = checked_volumes(self, X, self.chunk_size, reset=False)
        atoms = self.components_, _inner_products(self.components_)
        return np.concatenate(volumes.fetch(volumes.each(_exact_codes, *atoms, self.threshold, self.gap)))

    @property
    def _n_rows(self) -> int:
        return self.n_atoms

    def _check(self, n_volumes: int) -> None:
        if not 0 < self.threshold < np.inf:
            raise InputError(f"threshold is {self.threshold}, it must be finite and above zero")
        if not 0 < self.gap < 1:
            raise InputError(f"gap is {self.gap}, it must be between zero and one")
        Omega(coherence=self.coherence)  # refuses a weight that cannot be used
        super()._check(n_volumes)

    def _alternate(
        self, volumes: ChunkedVolumes, squares: NDArray[np.float64], rows: NDArray[np.float32]
    ) -> Iterator[Step]:
        omega = Omega(coherence=self.coherence)
        codes: list[Any] | None = None
        scale = np.ones(len(rows), np.float32)
        n = volumes.shape[0]
        energy = 0.5 * float(squares.mean())
        rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        self.replaced_ = 0
        while True:
            gram = _inner_products(rows)
            solve = _solve if codes else _solve_anew
            codes = volumes.each(solve, rows, gram, scale, self.threshold, self.gap, beside=codes)
            sums = _Sums(*(total / n for total in volumes.total(_code_sums, beside=codes)))
            atoms = rows.astype(np.float64)
            before = energy + sums.objective(atoms, self.threshold) + omega.value(atoms)
            scale = _sweep(atoms, sums, self.threshold, self.coherence).astype(np.float32)
            after = energy + sums.objective(atoms, self.threshold) + omega.value(atoms)
            rows = atoms.astype(np.float32)
            unused = np.flatnonzero(np.diag(sums.gram) <= _UNUSED)
            self.unused_ = len(unused)
            yield Step(rows, before, after)
            if len(unused):
                rows = rows.copy()
                errors = np.concatenate(volumes.fetch(codes, _errors))
                self.replaced_ += _replace(rows, unused, volumes, squares, errors)


@dataclass(frozen=True, slots=True)
class _Codes:
    """Codes of a chunk, from which the next lasso starts, and the squared error of each volume, `(m,)`."""

    codes: Any  # a sparse array (m, K)
    errors: NDArray[np.float64]


def _solve_anew(chunk: NDArray[np.float32], *common: Any) -> _Codes:
    """Solve the lassos of a chunk from zero."""
    return _solve(chunk, None, *common)


def _solve(
    chunk: NDArray[np.float32],
    before: _Codes | None,
    rows: NDArray[np.float32],
    gram: NDArray[np.float32],
    scale: NDArray[np.float32],
    threshold: float,
    gap: float,
) -> _Codes:
    """Solve the lassos of a chunk.

    Args:
        chunk: `(m, d)` volumes.
        before: codes to start from.
        rows: `(K, d)` atoms.
        gram: their inner products.
        scale: `(K,)` what the dictionary half-step did to the codes.
        threshold: lambda0.
        gap: relative duality gap.
    """
    squares = np.square(chunk, dtype=np.float64).sum(axis=1)
    right = chunk @ rows.T
    codes = before.codes.toarray() * scale if before else np.zeros(right.shape, np.float32)
    solve_lasso_rows(right, squares, float(threshold), gram, gap, codes)
    # At the solution l'D'(x - D l) = lambda0 |l|_1.
    fitted = np.einsum("ik,ik->i", codes, right)
    return _Codes(csr_array(codes), squares - fitted - threshold * np.abs(codes).sum(axis=1))


def _exact_codes(
    chunk: NDArray[np.float32],
    rows: NDArray[np.float32],
    gram: NDArray[np.float32],
    threshold: float,
    gap: float,
) -> NDArray[np.float32]:
    """Codes `(m, K)` of which each does not depend on how many are computed with it."""
    codes = np.zeros((len(chunk), len(rows)), np.float32)
    right = (chunk.astype(np.float64) @ rows.T).astype(np.float32)
    squares = np.square(chunk, dtype=np.float64).sum(axis=1)
    solve_lasso_rows(right, squares, float(threshold), gram, gap, codes)
    return codes


def _code_sums(chunk: NDArray[np.float32], found: _Codes) -> Sums:
    """The chunk's part of `L L'`, `L X'` and `|l_k|`."""
    codes = found.codes.toarray()
    sums = codes.T @ codes, codes.T @ chunk
    return *(total.astype(np.float64) for total in sums), np.abs(codes).sum(axis=0, dtype=np.float64)


def _errors(found: _Codes) -> NDArray[np.float64]:
    return found.errors


def _inner_products(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    wide = rows.astype(np.float64)
    return (wide @ wide.T).astype(np.float32)


def _sweep(atoms: NDArray[np.float64], sums: _Sums, penalty: float, coherence: float) -> NDArray[np.float64]:
    """Minimise over one atom and the scale of its codes after the other.

    Args:
        atoms: `(K, d)` of unit length, changed.
        sums: changed, as the codes are scaled.
        penalty: lambda0.
        coherence: weight of the coherence term.

    Returns:
        `(K,)` what the codes of each atom are to be multiplied with, not negative.
    """
    scale = np.ones(len(atoms))
    bound = np.linalg.norm(atoms, 2) ** 2 if coherence else 0.0
    for j in map(int, np.flatnonzero(np.diag(sums.gram) > _UNUSED)):
        use = sums.gram[j, j]
        pull = sums.cross[j] - sums.gram[j] @ atoms + use * atoms[j]
        found = pull
        if coherence:
            cosines = atoms @ atoms[j]
            found = pull + coherence * (bound * atoms[j] - (cosines @ atoms - atoms[j]))
        length = np.linalg.norm(found)
        if length > 0:
            found = found / length
            gained = float(pull @ (found - atoms[j]))
            if coherence:
                old, new = np.delete(cosines, j), np.delete(atoms @ found, j)
                gained += 0.5 * coherence * float(old @ old - new @ new)
            if gained > 0:
                atoms[j] = found
        scale[j] = max(float(pull @ atoms[j]) - penalty * sums.l1[j], 0.0) / use
        sums.scale(j, scale[j])
    return scale


def _replace(
    rows: NDArray[np.float32],
    unused: NDArray[np.int64],
    volumes: ChunkedVolumes,
    squares: NDArray[np.float64],
    errors: NDArray[np.float64],
) -> int:
    """Let unused atoms become the volumes that are represented worst; how many did."""
    worst = np.argsort(errors, kind="stable")[::-1][: len(unused)]
    worst = worst[squares[worst] > 1e-12]
    lengths = np.sqrt(squares[worst, None])
    rows[unused[: len(worst)]] = np.asarray(volumes[worst], np.float32) / lengths
    return len(worst)
