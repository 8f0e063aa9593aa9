"""The inverse formulation's code: a lasso solved again from the code before it.

Lives here: `min over l of 1/2 |x - D l|^2 + lambda0 |l|_1`, given `b = D' x`, `|x|^2` and the Gram
matrix `G = D' D`; coordinate descent (Friedman, Hastie and Tibshirani 2010, covariance updates) on a
working set (Massias, Gramfort and Salmon 2018), extrapolated where it creeps, stopped by the duality gap
(Fercoq, Gramfort and Salmon 2015, eq. 2 to 4).
Not here: where `b` comes from, and pooling.

The solution depends on where the solver starts, but only within the gap: it is a certificate.

A step of coordinate descent reads a row of G, and there are hundreds of steps for each event. So the
steps are taken within a copy of the rows and columns of the working set, which is small enough for the
nearest cache, and each atom that has moved reads its whole row once, at the end. What whole rows say is
kept from event to event: the response `G l` of each volume's code. It cannot drift for longer than a
bin, because a volume that enters a plane has its response computed afresh.
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.compiled import allocating, inlined, kernel
from streamfeat.kernels.layout import LANES, Operator

MAX_ROUNDS = 4000
"""Working sets that are tried; reached only where the gap is below float rounding."""

MAX_SWEEPS = 64
"""Sweeps over one working set; where atoms depend on each other more would only creep."""

MARGIN = 0.93
"""Atoms join the working set from this share of the penalty on: fewer rounds, for a larger set."""

SHARE = 0.8
"""Of the gap, to be reached within the working set before all atoms are looked at again."""

CODE, RESPONSE = 0, 1
"""Rows of what is kept of a volume."""


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
def select_atoms(
    right: NDArray[np.float64],
    atoms: NDArray[np.float64],
    response: NDArray[np.float64],
    least: float,
    chosen: NDArray[np.int64],
) -> int:
    """Working set: atoms in use, and those whose correlation with the residual exceeds `least`.

    Args:
        right: `(K,)` correlations `D' x`.
        atoms: `(K,)` the code.
        response: `(K,)` `G l`.
        least: at most the penalty, so that all others are certain to be feasible in the dual.
        chosen: `(>= K,)`, overwritten; begins with the indices.

    Returns:
        how many there are.
    """
    for k in range(right.shape[0]):
        chosen[k] = (abs(right[k] - response[k]) > least) | (atoms[k] != 0.0)
    n = 0
    for k in range(right.shape[0]):
        is_chosen = chosen[k]
        chosen[n] = k  # always, and kept or not: a branch costs more
        n += is_chosen
    return n


@kernel
def copy_corner(gram: NDArray[np.float32], chosen: NDArray[np.int64], corner: NDArray[np.float32]) -> None:
    """Copy the rows and columns of the chosen atoms.

    Args:
        gram: `(K, K)` inner products.
        chosen: `(n,)` indices.
        corner: `(n, m)`, overwritten; zero from column `n` on.
    """
    n = chosen.shape[0]
    for i in range(n):
        row, copy = gram[chosen[i]], corner[i]
        for k in range(n):
            copy[k] = row[np.uint64(chosen[k])]
        copy[n:] = 0


@inlined
def subtract_row(step: float, row: NDArray[np.float32], residual: NDArray[np.float64]) -> None:
    """Let one atom move by `step`: `residual -= step * row`."""
    for k in range(residual.shape[0]):
        residual[k] -= step * row[k]


@kernel
def descend(
    penalty: float, corner: NDArray[np.float32], atoms: NDArray[np.float64], residual: NDArray[np.float64]
) -> None:
    """One sweep of coordinate descent over a working set.

    Args:
        penalty: lambda0.
        corner: `(n, m)` inner products of the working set; zero from column `n` on.
        atoms: `(n,)`, changed; an atom of length zero stays.
        residual: `(m,)` correlations of the residual, kept current; zero from `n` on.
    """
    for j in range(atoms.shape[0]):
        scale = np.float64(corner[j, j])
        if scale > 0.0:
            target = residual[j] + scale * atoms[j]
            step = (target - min(max(target, -penalty), penalty)) / scale - atoms[j]
            if step != 0.0:
                atoms[j] += step
                subtract_row(step, corner[j], residual)


@kernel
def extrapolate(
    penalty: float,
    corner: NDArray[np.float32],
    before: NDArray[np.float64],
    atoms: NDArray[np.float64],
    residual: NDArray[np.float64],
) -> None:
    """Go on in the direction of the last sweeps, to the least objective or to where an atom becomes zero.

    Where a few atoms depend on each other, a weight moves from some to others by the same tiny step in each
    sweep, until one of them is used up: hundreds of thousands of sweeps, or this one line search.

    Args:
        penalty: lambda0.
        corner: `(n, m)` inner products of the working set; zero from column `n` on.
        before: `(n,)` the code some sweeps ago; overwritten.
        atoms: `(n,)`, changed, never for the worse.
        residual: `(m,)` correlations of the residual, kept current; zero from `n` on.
    """
    n = atoms.shape[0]
    direction, slope, furthest, used_up = before, 0.0, np.inf, -1
    for j in range(n):
        step = atoms[j] - before[j]
        direction[j] = step
        slope += step * residual[j]
        slope -= penalty * (abs(step) if atoms[j] == 0.0 else np.sign(atoms[j]) * step)
        if atoms[j] * step < 0.0 and abs(atoms[j]) < furthest * abs(step):
            furthest, used_up = abs(atoms[j] / step), j
    if slope <= 0.0:
        return
    curvature = 0.0
    for j in range(n):
        if direction[j] != 0.0:
            for k in range(n):
                curvature += direction[j] * corner[j, k] * direction[k]
    length = furthest
    if slope < furthest * curvature:
        length, used_up = slope / curvature, -1
    if length == np.inf:
        return
    for j in range(n):
        step = length * direction[j]
        if step != 0.0:
            atoms[j] = 0.0 if j == used_up else atoms[j] + step
            subtract_row(step, corner[j], residual)


@kernel
def add_rows(
    steps: NDArray[np.float64],
    moved: NDArray[np.int64],
    gram: NDArray[np.float32],
    response: NDArray[np.float64],
) -> None:
    """Let several atoms move: `response += steps @ gram[moved]`, four rows in one run over memory.

    Args:
        steps: `(n,)` by how much.
        moved: `(n,)` which.
        gram: `(K, K)` inner products.
        response: `(K,)`, changed.
    """
    n, n_atoms = moved.shape[0], response.shape[0]
    fours = n // 4 * 4
    for i in range(0, fours, 4):
        a, b, c, d = gram[moved[i]], gram[moved[i + 1]], gram[moved[i + 2]], gram[moved[i + 3]]
        of_a, of_b, of_c, of_d = steps[i], steps[i + 1], steps[i + 2], steps[i + 3]
        for k in range(n_atoms):
            response[k] += (of_a * a[k] + of_b * b[k]) + (of_c * c[k] + of_d * d[k])
    for i in range(fours, n):
        subtract_row(-steps[i], gram[moved[i]], response)


@kernel
def respond(
    gram: NDArray[np.float32],
    kept: NDArray[np.float64],
    work: NDArray[np.float64],
    chosen: NDArray[np.int64],
) -> None:
    """Compute the response of a code afresh.

    Args:
        gram: `(K, K)` inner products.
        kept: `(2, K)` code and response; the response is overwritten.
        work: `(>= 1, >= K)` scratch.
        chosen: `(>= K,)` scratch.
    """
    atoms, response, steps = kept[CODE], kept[RESPONSE], work[0]
    n = 0
    for k in range(atoms.shape[0]):
        if atoms[k] != 0.0:
            chosen[n], steps[n] = k, atoms[k]
            n += 1
    response[:] = 0.0
    add_rows(steps[:n], chosen[:n], gram, response)


@kernel
def solve_lasso(
    right: NDArray[np.float64],
    square: float,
    penalty: float,
    gram: NDArray[np.float32],
    gap: float,
    kept: NDArray[np.float64],
    work: NDArray[np.float64],
    chosen: NDArray[np.int64],
    corners: NDArray[np.float32],
) -> float:
    """Solve the lasso from a given code.

    Args:
        right: `(K,)` correlations `D' x`.
        square: `|x|^2`.
        penalty: lambda0, above zero.
        gram: `(K, K)` inner products of the atoms.
        gap: stop at this duality gap, relative to `1/2 |x|^2`.
        kept: `(2, K)` code to start from and its response `G l`; overwritten with the solution's.
        work: `(4, >= Kp)` scratch, `Kp` is `K` rounded up to whole LANES.
        chosen: `(>= K,)` scratch.
        corners: `(K * Kp,)` scratch.

    Returns:
        the duality gap that was reached, relative to `1/2 |x|^2`.
    """
    atoms, response = kept[CODE], kept[RESPONSE]
    unit = max(0.5 * square, 1e-300)
    reached = np.inf
    for _ in range(MAX_ROUNDS):
        n = select_atoms(right, atoms, response, MARGIN * penalty, chosen)
        width = -(-n // LANES) * LANES
        some_right, some, steps, rest = work[0, :n], work[1, :n], work[2, :n], work[3, :width]
        for i in range(n):
            k = chosen[i]
            some_right[i], some[i], rest[i] = right[k], atoms[k], right[k] - response[k]
        rest[n:] = 0.0
        # All others are zero and feasible: the gap of the working set is that of all atoms.
        reached = duality_gap(rest[:n], some_right, some, square, penalty) / unit
        if reached <= gap:
            break
        corner = corners[: n * width].reshape(n, width)
        copy_corner(gram, chosen[:n], corner)
        for sweep in range(MAX_SWEEPS):
            if sweep == MAX_SWEEPS // 2:
                for i in range(n):
                    steps[i] = some[i]
            descend(penalty, corner, some, rest)
            if duality_gap(rest[:n], some_right, some, square, penalty) <= SHARE * gap * unit:
                break
        else:
            extrapolate(penalty, corner, steps, some, rest)
        n_moved = 0
        for i in range(n):
            k = chosen[i]
            if some[i] != atoms[k]:
                chosen[n_moved], steps[n_moved] = k, some[i] - atoms[k]
                atoms[k] = some[i]
                n_moved += 1
        if n_moved == 0:
            break
        add_rows(steps[:n_moved], chosen[:n_moved], gram, response)
    return reached


@kernel
def lasso_code(
    projection: NDArray[np.int32],
    sigma: float,
    square: float,
    operator: Operator,
    kept: NDArray[np.float64],
    work: NDArray[np.float64],
    chosen: NDArray[np.int64],
    corners: NDArray[np.float32],
) -> None:
    """Code of one volume under the inverse formulation, started from the code it had.

    Args:
        projection: `(Kp,)` of the volume.
        sigma: standard deviation of the volume.
        square: `|x|^2` of the whitened volume.
        operator: scale, offset, threshold, Gram matrix and gap.
        kept: `(2, K)` the code before and its response; overwritten with the new ones.
        work: `(5, Kp)` scratch.
        chosen: `(>= K,)` scratch.
        corners: `(K * Kp,)` scratch.
    """
    n_atoms, offset, unit = kept.shape[1], operator.offset, operator.unit
    right = work[0, :n_atoms]
    gain = operator.scale / sigma
    for k in range(n_atoms):
        right[k] = projection[k] * gain - np.float64(offset[k]) / unit
    penalty = operator.threshold / unit
    solve_lasso(right, square, penalty, operator.gram, operator.gap, kept, work[1:], chosen, corners)


@kernel
def fix_atoms(atoms: NDArray[np.float64], operator: Operator, code: NDArray[np.int32]) -> None:
    """Write a lasso code in fixed point; clipped at `|x|^2 / (2 lambda0)`, which no solution exceeds."""
    unit = operator.unit
    limit = operator.reach * operator.reach * unit / (2.0 * operator.threshold / unit)
    for k in range(atoms.shape[0]):
        code[k] = np.int32(min(max(atoms[k] * unit, -limit), limit))
    code[atoms.shape[0] :] = 0


@allocating
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
    n_atoms = codes.shape[1]
    padded = -(-n_atoms // LANES) * LANES
    wide, kept, work = np.empty(n_atoms), np.empty((2, n_atoms)), np.empty((4, padded))
    chosen, corners = np.empty(n_atoms, np.int64), np.empty(n_atoms * padded, np.float32)
    for i in range(codes.shape[0]):
        kept[CODE] = codes[i]
        respond(gram, kept, work, chosen)
        wide[:] = right[i]
        solve_lasso(wide, squares[i], penalty, gram, gap, kept, work, chosen, corners)
        codes[i] = kept[CODE]
