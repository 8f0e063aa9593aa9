"""Where both learners start from.

Lives here: the initial filters: spherical k-means, random volumes, random directions.
Not here: any objective.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.learn.chunks import ChunkedVolumes, Rows
from streamfeat.work.workers import Sums

__all__ = ["STARTS", "check_usable", "random_directions", "random_filters", "spherical_means"]

STARTS = ("kmeans", "random")
"""Spherical k-means, or random volumes."""

_NOISE = 0.01
"""Length of what is added to a volume of unit length, so that filters span all dimensions: volumes have no
mean and may repeat, and a transform of less than full rank has no log-determinant."""


def random_directions(volumes: Rows, squares: NDArray[np.float64], n: int, rng: Any) -> NDArray[np.float32]:
    """`(n, d)` rows of unit length: distinct volumes, random directions where those run out; a little noise.

    Args:
        volumes: `(samples, d)` whitened volumes.
        squares: `(samples,)` their squared lengths.
        n: rows to make.
        rng: NumPy RandomState.

    Raises:
        InputError: all volumes are zero.
    """
    usable = check_usable(squares)
    picked = rng.permutation(usable)[:n]
    rows = rng.standard_normal((n, volumes.shape[1]))
    rows *= _NOISE / np.linalg.norm(rows, axis=1, keepdims=True)
    rows[: len(picked)] += volumes[picked] / np.sqrt(squares[picked, None])
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)


def check_usable(squares: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of volumes that are not constant, given their squared lengths `(samples,)`.

    Raises:
        InputError: all volumes are zero.
    """
    usable = np.flatnonzero(squares > 1e-12)
    if len(usable) == 0:
        raise InputError(
            f"all {len(squares)} volumes are constant; there is nothing to learn from: "
            "use recordings with events, or a larger patch"
        )
    return usable


def random_filters(n: int, entries: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """`(n, entries)` directions of unit length, each as likely as any other."""
    rows = rng.standard_normal((n, entries))
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)


def spherical_means(
    volumes: ChunkedVolumes,
    n: int,
    rng: np.random.Generator,
    *,
    iterations: int = 10,
    report: Callable[[str, int, int, str], None] = lambda step, done, total, remark: None,
) -> NDArray[np.float32]:
    """Filters `(n, d)` of unit length by spherical k-means (Coates and Ng 2012, section 2.1).

    Each volume `x` has one code that is not zero, `s_j = d_j' x` for the `j` of the largest `|d_j' x|`; then
    `D := X S' + D` and each column is scaled to unit length. Started, as there, from random directions.

    Args:
        volumes: `(m, d)` whitened volumes.
        n: filters.
        rng: source of every random choice.
        iterations: ten are enough, they say.
        report: told about progress.
    """
    filters = random_filters(n, volumes.shape[1], rng)
    for iteration in range(iterations):
        (totals,) = volumes.total(_nearest_sums, filters)
        totals += filters
        filters = np.asarray(totals / np.linalg.norm(totals, axis=1, keepdims=True), np.float32)
        report("learning", iteration + 1, iterations, "spherical k-means")
    return filters


def _nearest_sums(chunk: NDArray[np.float32], filters: NDArray[np.float32]) -> Sums:
    """The chunk's part of `S X'`."""
    likeness = chunk @ filters.T
    best = np.abs(likeness).argmax(axis=1)
    codes = np.zeros_like(likeness)
    rows = np.arange(len(chunk))
    codes[rows, best] = likeness[rows, best]
    return ((codes.T @ chunk).astype(np.float64),)
