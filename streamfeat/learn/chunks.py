"""Volumes a chunk at a time, so that no float copy of all of them is made.

Lives here: what the learners accept as volumes, and walking through it wherever work is done.
Not here: which volumes (`volumes`), and what is learned from a chunk.
"""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import validate_data

from streamfeat.errors import InputError
from streamfeat.work.workers import THIS_PROCESS, Sums, Workers

__all__ = ["ChunkedVolumes", "Rows", "checked_volumes"]

_KEPT = 1 << 27
"""Bytes of floats that may be kept rather than made anew on each of a score of passes."""

Make = Callable[[Any], NDArray[np.float32]]


class Rows(Protocol):
    """A matrix with a shape that gives rows for a slice or for indices: an array, a memory map."""

    @property
    def shape(self) -> tuple[int, ...]:
        """`(n, d)`."""

    def __getitem__(self, rows: Any, /) -> Any:
        """Rows `(m, d)`."""


class ChunkedVolumes:
    """Volumes in chunks, each of which is made when a step asks for it, wherever that step is computed.

    So small integers become whitened floats, `size` rows at a time for each thread that works.

    Args:
        source: `(n, d)` of any numeric dtype, in memory or mapped.
        size: rows of a chunk.
        make: from `(m, d)` rows of `source` to `(m, d)` float32, each row by itself; None where they are what
            is to be learned from.
        workers: where steps are computed.
    """

    def __init__(
        self, source: Rows, size: int = 2048, make: Make | None = None, workers: Workers = THIS_PROCESS
    ) -> None:
        """Hand the chunks to the workers."""
        starts = range(0, source.shape[0], size)
        held = [workers.hold((start, source[start : start + size])) for start in starts]
        self._start(source, make, workers, held)

    def _start(self, source: Rows, make: Make | None, workers: Workers, held: list[Any]) -> None:
        self._source, self._make, self._workers, self._held = source, make, workers, held
        self._held_make = workers.hold(make)

    def made(self, make: Make) -> "ChunkedVolumes":
        """The same rows, made otherwise; the workers are not handed them again.

        They are made once where they take no more than 128 MiB, else on every pass; the bits are the same.
        """
        other = ChunkedVolumes.__new__(ChunkedVolumes)
        other._start(self._source, make, self._workers, self._held)
        if 4 * self.shape[0] * self.shape[1] <= _KEPT:
            held = [(one,) for one in self._held]
            other._held = self._workers.each(_with_floats, held, other._held_make)
            other._held_make = self._workers.hold(None)
        return other

    @property
    def shape(self) -> tuple[int, ...]:
        """`(n, d)`."""
        return self._source.shape

    def __getitem__(self, rows: Any) -> NDArray[np.float32]:
        """Make the rows of a slice or of indices, here."""
        return _made(0, self._source[rows], self._make)

    def total(self, step: Callable[..., Sums], *common: Any, beside: list[Any] | None = None) -> Sums:
        """Add up `step(chunk, *common)` over all chunks, `(m, d)` float32, in a fixed order.

        Args:
            step: a function of a module.
            common: the same for all chunks.
            beside: what `each` holds, to be given to `step` behind the chunk.

        Raises:
            InputError: a value is not finite.
        """
        return self._workers.total(self._on(beside), self._tuples(beside), *self._shared(step, common))

    def each(self, step: Callable[..., Any], *common: Any, beside: list[Any] | None = None) -> list[Any]:
        """Hold what `step` gives for each chunk, where it was computed; arguments as for `total`."""
        return self._workers.each(self._on(beside), self._tuples(beside), *self._shared(step, common))

    def fetch(self, held: list[Any], read: Callable[[Any], Any] | None = None) -> list[Any]:
        """The values of `each`, passed through `read` if that is given."""
        return self._workers.fetch(self._workers.each(read, [(one,) for one in held]) if read else held)

    def _tuples(self, beside: list[Any] | None) -> list[tuple[Any, ...]]:
        return list(zip(self._held, beside, strict=True)) if beside else [(one,) for one in self._held]

    def _shared(self, step: Callable[..., Any], common: tuple[Any, ...]) -> list[Any]:
        return [self._held_make, *map(self._workers.hold, (step, *common))]

    @staticmethod
    def _on(beside: list[Any] | None) -> Callable[..., Any]:
        return _on_chunk_beside if beside else _on_chunk

    def squared_lengths(self) -> NDArray[np.float64]:
        """`|x|^2` of each row, `(n,)`."""
        return np.concatenate(self.fetch(self.each(_squared_lengths)))


def checked_volumes(
    estimator: Any, X: "ArrayLike | ChunkedVolumes", size: int, *, reset: bool = True
) -> ChunkedVolumes:
    """`X` as scikit-learn wants it checked, neither copied nor converted where it is an array of numbers.

    Args:
        estimator: keeps the number of features (`reset`), or has it.
        X: `(n, d)`.
        size: rows of a chunk, where `X` is not in chunks yet.
        reset: whether the estimator is being fitted.
    """
    if isinstance(X, ChunkedVolumes):
        validate_data(estimator, X, reset=reset, skip_check_array=True)
        return X
    return ChunkedVolumes(
        validate_data(estimator, X, reset=reset, dtype="numeric", ensure_all_finite=False), size
    )


def _made(start: int, rows: Any, make: Make | None) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):
        chunk = np.asarray(rows if make is None else make(rows), np.float32)
    sound = np.isfinite(chunk).all(axis=1)
    if not sound.all():
        raise InputError(
            f"volume {start + int(sound.argmin())} holds NaN or infinity as a float32; leave it out "
            f"({int((~sound).sum())} such among volumes {start} to {start + len(chunk) - 1})"
        )
    return chunk


def _with_floats(held: tuple[int, Any], make: Make) -> tuple[int, NDArray[np.float32]]:
    return held[0], _made(*held, make)


def _on_chunk(held: tuple[int, Any], make: Make | None, step: Callable[..., Any], *common: Any) -> Any:
    return step(_made(*held, make), *common)


def _on_chunk_beside(
    held: tuple[int, Any], beside: Any, make: Make | None, step: Callable[..., Any], *common: Any
) -> Any:
    return step(_made(*held, make), beside, *common)


def _squared_lengths(chunk: NDArray[np.float32]) -> NDArray[np.float64]:
    lengths: NDArray[np.float64] = np.square(chunk, dtype=np.float64).sum(axis=1)
    return lengths
