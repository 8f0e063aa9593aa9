"""The inverse formulation's code: a lasso solved again from the code before it.

Lives here: `min over l of 1/2 |x - D l|^2 + lambda0 |l|_1`, given `b = D' x`, `|x|^2` and the Gram
matrix; coordinate descent over the active set (Friedman, Hastie and Tibshirani 2010, covariance
updates), stopped by the duality gap (Fercoq, Gramfort and Salmon 2015, eq. 2 to 4).
Not here: where `b` comes from, and pooling.

The solution depends on where the solver starts, but only within the gap: it is a certificate.
"""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from streamfeat.kernels.compiled import kernel
from streamfeat.kernels.layout import Operator

MAX_ROUNDS = 20_000
"""Rounds, each a look at the gap and at all atoms; reached only where the gap is below float rounding.

Many atoms in few dimensions may take thousands, when codes change hands between nearly equal atoms.
"""

SWEEPS = 3
"""Sweeps over the active set in one round: about as dear as the look at the gap that they save."""


@kernel
def duality_gap(
    residual: NDArray[np.float64],
    right: NDArray[np.float64],
    atoms: NDArray[np.float64],
    square: float,
    penalty: float,
) -> float:
    """Primal less dual objective of the lasso, from inner products alone.

    Args:
        residual: `(K,)` correlations of the residual, `D' (x - D l)`.
        right: `(K,)` correlations `D' x`.
        atoms: `(K,)` the code `l`.
        square: `|x|^2`.
        penalty: lambda0.
    """
    largest, l1, fit, cross = 0.0, 0.0, 0.0, 0.0
    for k in range(right.shape[0]):
        largest = max(largest, abs(residual[k]))
        l1 += abs(atoms[k])
        fit += atoms[k] * right[k]
        cross += atoms[k] * residual[k]
    remainder = max(square - fit - cross, 0.0)
    shrink = min(1.0, penalty / max(largest, 1e-300))
    # 1/2 |r|^2 + lambda |l|_1 less the dual value of the residual, shrunk until it is feasible.
    return 0.5 * (1.0 + shrink * shrink) * remainder + penalty * l1 - shrink * (remainder + cross)


@kernel
def solve_lasso(
    right: NDArray[np.float64],
    square: float,
    penalty: float,
    gram: NDArray[np.float32],
    gap: float,
    start: NDArray[np.float32],
    atoms: NDArray[np.float64],
    residual: NDArray[np.float64],
    active: NDArray[np.int64],
) -> float:
    """Solve the lasso by coordinate descent from a given code.

    Args:
        right: `(K,)` correlations `D' x`.
        square: `|x|^2`.
        penalty: lambda0, above zero.
        gram: `(K, K)` inner products of the atoms.
        gap: stop at this duality gap, relative to `1/2 |x|^2`.
        start: `(K,)` code to start from.
        atoms: `(K,)`, overwritten with the code.
        residual: `(K,)`, overwritten with `D' (x - D l)`.
        active: `(K,)` scratch.

    Returns:
        the duality gap that was reached, relative to `1/2 |x|^2`.
    """
    n_atoms = right.shape[0]
    unit = max(0.5 * square, 1e-300)
    for k in range(n_atoms):
        atoms[k] = start[k]
    # Afresh for each problem: it cannot drift, however long a stream is.
    for k in range(n_atoms):
        residual[k] = right[k]
    for j in range(n_atoms):
        if atoms[j] != 0.0:
            subtract_row(atoms[j], gram[j], residual)
    reached = np.inf
    for _ in range(MAX_ROUNDS):
        reached = duality_gap(residual, right, atoms, square, penalty) / unit
        if reached <= gap:
            break
        n_active = 0
        for k in range(n_atoms):
            if gram[k, k] > 0.0 and (atoms[k] != 0.0 or abs(residual[k]) > penalty):
                active[n_active] = k
                n_active += 1
        for _ in range(SWEEPS):
            descend(active[:n_active], penalty, gram, atoms, residual)
    return reached


@kernel
def subtract_row(step: float, row: NDArray[np.float32], residual: NDArray[np.float64]) -> None:
    """Let one atom move by `step`: `residual -= step * row`, all of it, in one run over memory.

    A gather over the active atoms alone is a tenth of the work and takes longer.
    """
    for k in range(residual.shape[0]):
        residual[k] -= step * row[k]


@kernel
def descend(
    active: NDArray[np.int64],
    penalty: float,
    gram: NDArray[np.float32],
    atoms: NDArray[np.float64],
    residual: NDArray[np.float64],
) -> None:
    """One sweep of coordinate descent over the active atoms.

    Args:
        active: indices of the atoms to move.
        penalty: lambda0.
        gram: `(K, K)` inner products.
        atoms: `(K,)`, changed at the active atoms.
        residual: `(K,)` correlations of the residual, kept current.
    """
    for j in active:
        scale = np.float64(gram[j, j])
        target = residual[j] + scale * atoms[j]
        step = (target - min(max(target, -penalty), penalty)) / scale - atoms[j]
        if step != 0.0:
            atoms[j] += step
            subtract_row(step, gram[j], residual)


@kernel
def lasso_code(
    projection: NDArray[np.int32],
    sigma: float,
    square: float,
    operator: Operator,
    atoms: NDArray[np.float32],
    work: NDArray[np.float64],
    active: NDArray[np.int64],
) -> None:
    """Code of one volume under the inverse formulation, started from the code it had.

    Args:
        projection: `(Kp,)` of the volume.
        sigma: standard deviation of the volume.
        square: `|x|^2` of the whitened volume.
        operator: scale, offset, threshold, Gram matrix and gap.
        atoms: `(K,)` the code before; overwritten with the new one.
        work: `(4, Kp)` scratch.
        active: `(>= K,)` scratch.
    """
    n_atoms = atoms.shape[0]
    right, solution, residual = work[0, :n_atoms], work[1, :n_atoms], work[2, :n_atoms]
    gain = operator.scale / sigma
    for k in range(n_atoms):
        right[k] = projection[k] * gain - np.float64(operator.offset[k]) / operator.unit
    penalty = operator.threshold / operator.unit
    solve_lasso(right, square, penalty, operator.gram, operator.gap, atoms, solution, residual, active)
    for k in range(n_atoms):
        atoms[k] = np.float32(solution[k])


@kernel
def fix_atoms(atoms: NDArray[np.float32], operator: Operator, code: NDArray[np.int32]) -> None:
    """Write a lasso code in fixed point; clipped at `|x|^2 / (2 lambda0)`, which no solution exceeds."""
    unit = operator.unit
    limit = operator.reach * operator.reach * unit / (2.0 * operator.threshold / unit)
    for k in range(atoms.shape[0]):
        code[k] = np.int32(min(max(np.float64(atoms[k]) * unit, -limit), limit))
    code[atoms.shape[0] :] = 0


@njit(cache=True, nogil=True, parallel=True)
def solve_lasso_rows(
    right: NDArray[np.float32],
    squares: NDArray[np.float64],
    penalty: float,
    gram: NDArray[np.float32],
    gap: float,
    codes: NDArray[np.float32],
) -> None:
    """Solve one lasso for each row, each from the code that is there.

    Args:
        right: `(n, K)` correlations, a row for each problem.
        squares: `(n,)` `|x|^2` of each.
        penalty: lambda0.
        gram: `(K, K)` inner products of the atoms.
        gap: relative duality gap.
        codes: `(n, K)`, overwritten.
    """
    n, n_atoms = codes.shape
    blocks = 64
    for block in prange(blocks):
        wide = np.empty((3, n_atoms))
        active = np.empty(n_atoms, np.int64)
        for i in range(n * block // blocks, n * (block + 1) // blocks):
            for k in range(n_atoms):
                wide[0, k] = right[i, k]
            solve_lasso(wide[0], squares[i], penalty, gram, gap, codes[i], wide[1], wide[2], active)
            for k in range(n_atoms):
                codes[i, k] = wide[1, k]
