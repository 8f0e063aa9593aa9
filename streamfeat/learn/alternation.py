"""The loop that both formulations share: codes, matrix, codes, matrix, until little is gained.

Lives here: `Alternation`, which starts, records, stops, is interrupted and goes on again.
Not here: the half-steps themselves (`transform`, `dictionary`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils import check_random_state

from streamfeat.errors import InputError
from streamfeat.learn.chunks import ChunkedVolumes, checked_volumes
from streamfeat.learn.initial import STARTS, check_usable, random_directions, spherical_means
from streamfeat.learn.omega import condition_number, mutual_coherence
from streamfeat.work.interrupts import aside, promised
from streamfeat.work.workers import one_blas_thread

__all__ = ["Alternation", "Step"]


class Step(NamedTuple):
    """Result of one iteration: the rows learned, and the objective after each of its half-steps."""

    rows: NDArray[np.float32]
    after_codes: float
    after_rows: float


@dataclass(eq=False, repr=False, kw_only=True)
class Alternation(TransformerMixin, BaseEstimator, ABC):  # type: ignore[misc]
    """Alternating minimisation over codes and the `(K, d)` rows of a transform or dictionary.

    The rows are float32 from one iteration to the next, so that learning goes on from saved rows with the
    same bits.

    Args:
        max_iter: iterations at most, each of two half-steps.
        tol: stop when an iteration lowers the objective by less than this share.
        chunk_size: volumes whose codes are held as floats at a time by each thread.
        start: `kmeans`, spherical k-means; or `random`, random volumes, from which both formulations stay in
            poorer minima (on N-CARS two to three points).
        warm_start: start from `components_` of the fit before.
        random_state: seed of the initial rows.
        progress: called with (iteration, objective) after each iteration, whose attributes are there then.
    """

    max_iter: int = 20
    tol: float = 1e-4
    chunk_size: int = 2048
    start: str = "kmeans"
    warm_start: bool = False
    random_state: int | None = None
    progress: Callable[[int, float], None] | None = None

    def fit(self, X: ArrayLike | ChunkedVolumes, y: Any = None) -> Self:
        """Learn from `(n, d)` whitened volumes: an array, a memory map, or `ChunkedVolumes`; not changed.

        What is learned has the same bits on one core, on many, and on the workers of a cluster, as far as
        their processors round alike.

        Ctrl-C ends learning, not the program: what the last whole iteration found is kept, and
        `interrupted_` is true.

        Raises:
            InputError: a parameter is out of range, there are fewer volumes than rows to learn, a value is
                not finite, or all volumes are constant.
        """
        self._check_numbers()
        volumes = checked_volumes(self, X, self.chunk_size)
        self._check(volumes.shape[0])
        with one_blas_thread():
            return self._fit(volumes)

    def _fit(self, volumes: ChunkedVolumes) -> Self:
        """Learn; matrices are small, and threads of BLAS would wait for whatever else runs here."""
        squares = volumes.squared_lengths()
        rows = self._first_rows(volumes, squares)
        objective: list[float] = []
        condition: list[float] = []
        coherence: list[float] = []
        self.interrupted_ = False
        self._keep(rows, objective, condition, coherence)
        steps = self._alternate(volumes, squares, rows)
        try:
            for step in self._interruptible(steps):
                shown = condition_number(step.rows), mutual_coherence(step.rows)
                objective += [step.after_codes, step.after_rows]
                condition.append(shown[0])
                coherence.append(shown[1])
                self._keep(step.rows, objective, condition, coherence)
                if self.progress:
                    self.progress(len(condition), step.after_rows)
                gained = objective[-3] - objective[-1] if len(objective) > 2 else np.inf
                if gained <= self.tol * abs(objective[-1]):
                    break
        except KeyboardInterrupt:
            self.interrupted_ = True
        return self

    def _interruptible(self, steps: Iterator[Step]) -> Iterator[Step]:
        """The steps; from the second on, Ctrl-C comes within a step, and the one before is kept."""
        yield aside(next, steps)
        with promised():
            for _ in range(1, self.max_iter):
                yield aside(next, steps)

    def _keep(
        self,
        rows: NDArray[np.float32],
        objective: list[float],
        condition: list[float],
        coherence: list[float],
    ) -> None:
        """Keep the rows so far as the result; only the next whole iteration replaces it."""
        self.components_ = rows
        self.objective_ = np.array(objective)
        self.condition_ = np.array(condition)
        self.coherence_ = np.array(coherence)
        self.n_iter_ = len(condition)

    def _check_numbers(self) -> None:
        k = self._n_rows
        if k < 1 or self.max_iter < 1 or self.chunk_size < 1:
            raise InputError(
                f"K is {k}, max_iter {self.max_iter} and chunk_size {self.chunk_size}; "
                "each must be at least one"
            )
        if self.start not in STARTS:
            raise InputError(f"start is {self.start!r}, it must be one of {', '.join(STARTS)}")

    def _check(self, n_volumes: int) -> None:
        """Refuse parameters that cannot be used; subclasses check theirs as well."""
        k = self._n_rows
        if n_volumes < max(k, 2):
            raise InputError(
                f"n_samples = {n_volumes} is too few volumes to learn K = {k} from; "
                f"give at least {max(k, 2)}, or lower K"
            )

    def _first_rows(self, volumes: ChunkedVolumes, squares: NDArray[np.float64]) -> NDArray[np.float32]:
        """Initial rows, or those of the fit before."""
        shape = self._n_rows, volumes.shape[1]
        if not (self.warm_start and hasattr(self, "components_")):
            rng = check_random_state(self.random_state)
            if self.start == "random":
                return random_directions(volumes, squares, self._n_rows, rng)
            check_usable(squares)
            return spherical_means(volumes, self._n_rows, np.random.default_rng(rng.randint(2**31)))
        if self.components_.shape != shape:
            raise InputError(
                f"warm_start: components_ have shape {self.components_.shape}, {shape} is to be learned; "
                "keep K and the volumes' length, or set warm_start=False"
            )
        return np.asarray(self.components_, np.float32)

    @property
    @abstractmethod
    def _n_rows(self) -> int:
        """`K`."""

    @abstractmethod
    def _alternate(
        self, volumes: ChunkedVolumes, squares: NDArray[np.float64], rows: NDArray[np.float32]
    ) -> Iterator[Step]:
        """Iterate without end.

        Args:
            volumes: `(n, d)`.
            squares: `(n,)` their squared lengths.
            rows: `(K, d)` to start from.
        """

    def __sklearn_tags__(self) -> Any:
        """Say that codes are float32 whatever goes in."""
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = []
        return tags
