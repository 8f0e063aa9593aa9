"""Volumes a chunk at a time, so that no float copy of all of them is made.

Lives here: what the learners accept as volumes, and walking through it.
Not here: which volumes (`volumes`), and what is learned from a chunk.
"""

from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import validate_data

from streamfeat.errors import InputError

__all__ = ["LazyVolumes", "Rows", "checked_rows", "chunks", "squared_lengths"]


class Rows(Protocol):
    """What has a shape and gives rows for a slice or for indices: arrays, memory maps, `LazyVolumes`."""

    @property
    def shape(self) -> tuple[int, ...]:
        """`(n, d)`."""

    def __getitem__(self, rows: Any, /) -> Any:
        """Rows `(m, d)`."""


class LazyVolumes:
    """Volumes that are made when a chunk of them is asked for, as small integers become whitened floats.

    Args:
        source: `(n, d)` of any dtype, in memory or mapped.
        make: from `(m, d)` rows of `source` to `(m, d)` float32, each row by itself.
    """

    def __init__(self, source: Rows, make: Callable[[Any], NDArray[np.float32]]) -> None:
        """Keep both."""
        self._source = source
        self._make = make

    @property
    def shape(self) -> tuple[int, ...]:
        """`(n, d)`."""
        return self._source.shape

    def __getitem__(self, rows: Any) -> NDArray[np.float32]:
        """Make the rows of a slice or of indices."""
        return self._make(self._source[rows])


def checked_rows(estimator: Any, X: "ArrayLike | LazyVolumes", *, reset: bool = True) -> Rows:
    """`X` as scikit-learn wants it checked, neither copied nor converted where it is an array of numbers.

    Args:
        estimator: keeps the number of features (`reset`), or has it.
        X: `(n, d)`.
        reset: whether the estimator is being fitted.
    """
    if isinstance(X, LazyVolumes):
        validate_data(estimator, X, reset=reset, skip_check_array=True)
        return X
    found: Rows = validate_data(estimator, X, reset=reset, dtype="numeric", ensure_all_finite=False)
    return found


def chunks(rows: Rows, size: int) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """Walk through rows: where a chunk is, and `(at most size, d)` float32.

    Raises:
        InputError: a value is not finite.
    """
    for start in range(0, rows.shape[0], size):
        where = slice(start, min(start + size, rows.shape[0]))
        with np.errstate(over="ignore"):
            chunk = np.asarray(rows[where], np.float32)
        sound = np.isfinite(chunk).all(axis=1)
        if not sound.all():
            raise InputError(
                f"volume {start + int(sound.argmin())} holds NaN or infinity as a float32; "
                f"leave it out ({int((~sound).sum())} such among volumes {start} to {where.stop - 1})"
            )
        yield where, chunk


def squared_lengths(rows: Rows, size: int) -> NDArray[np.float64]:
    """`|x|^2` of each row, `(n,)`."""
    found = np.empty(rows.shape[0])
    for where, chunk in chunks(rows, size):
        found[where] = np.square(chunk, dtype=np.float64).sum(axis=1)
    return found
