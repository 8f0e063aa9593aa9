"""Emissions in columns, and objects of them for readers that ask.

Lives here: `EmissionBatch`, many emissions of one camera with an array for each quantity; `Emitter`, which
makes batches and hands them out one emission at a time as well.
Not here: one emission (`emission`), making batches (`session`), where they go (`sinks`).

Under `--emit event` an object for each emission would cost as much as all of its arithmetic.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from streamfeat.messages.packets import Label
from streamfeat.stream.emission import Emission

__all__ = ["EmissionBatch", "Emitter", "batches_of"]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EmissionBatch(Sequence[Emission]):
    """Emissions of one camera, in order: a sequence of `Emission`, kept as arrays of `n` rows.

    Example:
        >>> batch.t_us[-1], batch.predictions[-1], batch[-1].prediction
        (310000, '7', '7')

    Attributes:
        t_us: `(n,)` int64, see `Emission`, as for all that follow.
        n_events: `(n,)` int64.
        features: `(n, n_features)` float32, or `(n, 0)` where they were not wanted.
        labels: names of the scores.
        scores: `(n, C)` float32.
        incomplete: `(n,)` bool.
        sample: of all rows, as are `final`, `topic`, `source_ns` and `active_volumes`.
        final: of all rows.
        topic: of all rows.
        source_ns: of all rows.
        active_volumes: of all rows.
    """

    t_us: NDArray[np.int64]
    n_events: NDArray[np.int64]
    features: NDArray[np.float32]
    labels: tuple[str, ...]
    scores: NDArray[np.float32]
    incomplete: NDArray[np.bool_]
    sample: Label | None = None
    final: bool = False
    topic: str = ""
    source_ns: int = 0
    active_volumes: int | None = None

    @classmethod
    def of(cls, emission: Emission) -> "EmissionBatch":
        """One emission as a batch of one row."""
        same = {name: getattr(emission, name) for name in _OF_ALL_ROWS}
        return cls(
            t_us=np.array([emission.t_us], np.int64),
            n_events=np.array([emission.n_events], np.int64),
            features=emission.features[np.newaxis],
            scores=emission.scores[np.newaxis],
            incomplete=np.array([emission.incomplete]),
            **same,
        )

    def __len__(self) -> int:
        """Number of emissions."""
        return len(self.t_us)

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays."""
        return sum(getattr(self, name).nbytes for name in _COLUMNS)

    @overload
    def __getitem__(self, index: int) -> Emission: ...

    @overload
    def __getitem__(self, index: slice) -> "EmissionBatch": ...

    def __getitem__(self, index: int | slice) -> "Emission | EmissionBatch":
        """One emission, or a batch of some of them; arrays are views."""
        if isinstance(index, slice):
            return replace(self, **{name: getattr(self, name)[index] for name in _COLUMNS})
        return Emission(
            t_us=int(self.t_us[index]),
            n_events=int(self.n_events[index]),
            features=self.features[index],
            scores=self.scores[index],
            incomplete=bool(self.incomplete[index]),
            **{name: getattr(self, name) for name in _OF_ALL_ROWS},
        )

    def __iter__(self) -> Iterator[Emission]:
        """Every emission as an object."""
        return map(self.__getitem__, range(len(self)))

    @property
    def predictions(self) -> list[str | None]:
        """The label with the highest score of each emission; None for each without a classifier."""
        if not self.labels:
            return [None] * len(self)
        return [self.labels[i] for i in self.scores.argmax(axis=1).tolist()]


def batches_of(emissions: Sequence[Emission]) -> list[EmissionBatch]:
    """Emissions in columns: the batch that they are already, or one for each."""
    if isinstance(emissions, EmissionBatch):
        return [emissions]
    return [EmissionBatch.of(emission) for emission in emissions]


_COLUMNS = "t_us", "n_events", "features", "scores", "incomplete"
_OF_ALL_ROWS = "labels", "sample", "final", "topic", "source_ns", "active_volumes"


class Emitter(ABC):
    """Makes emissions of items: in batches, as a pipeline takes them, or one at a time."""

    @abstractmethod
    def batches(self, item: Any, /) -> Iterator[EmissionBatch]:
        """Take in one item of the stream, and yield the emissions on the way in columns."""

    @abstractmethod
    def last_batches(self) -> Iterator[EmissionBatch]:
        """End the stream, and yield the emissions that are left in columns."""

    def process(self, item: Any, /) -> Iterator[Emission]:
        """Take in one item of the stream, and yield the emissions on the way."""
        for batch in self.batches(item):
            yield from batch

    def finish(self) -> Iterator[Emission]:
        """End the stream, and yield the emissions that are left."""
        for batch in self.last_batches():
            yield from batch
