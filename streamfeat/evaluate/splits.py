"""The samples to learn from and those to score.

Lives here: labelled recordings whose samples are held out, by their own splits or by folds.
Not here: learning and scoring.
"""

import contextlib
import hashlib
import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.classify.folds import assign_folds, bootstrap_units, groups_named
from streamfeat.errors import InputError
from streamfeat.files.locations import Location, absolute, size_of
from streamfeat.recordings.options import AS_IT_IS, ReadOptions
from streamfeat.recordings.reader import (
    HELD_OUT_SPLITS,
    WHOLE,
    Label,
    Packet,
    Part,
    Recording,
    open_recording,
)

__all__ = ["DataSet", "Fold"]

_FOLDS_IN_WORDS = {
    "block": "folds, each a block of neighbouring samples of every class",
    "source": "folds of whole sources",
    "none": "stratified folds of shuffled samples",
}


class Fold(Recording):
    """A recording that is told which samples are held out; those it was recorded with as such are not there.

    Args:
        path: the file.
        topic: as for `open_recording`.
        held_out: the labels that are.
        part: as for `Recording`.
        reading: how to read it.
    """

    def __init__(
        self,
        path: Location,
        topic: str | None,
        held_out: frozenset[Label] = frozenset(),
        part: Part = WHOLE,
        reading: ReadOptions = AS_IT_IS,
    ) -> None:
        """Open it."""
        self._held_out, self._reading = held_out, reading
        self._place = absolute(path)
        super().__init__(path, topic, part, reading)

    def part(self, part: Part) -> Callable[[], Recording]:
        """See `Recording`."""
        return partial(Fold, self._place, self.topic, self._held_out, part, self._reading)

    def placed_items(self, part: Part) -> Iterator[tuple[int, Packet | Label]]:
        """As those of the recording, with other splits, and without a held-out label and its events."""
        left_out: Label | None = None
        for at, item in super().placed_items(part):
            if isinstance(item, Label):
                left_out = item if item.split in HELD_OUT_SPLITS else None
                if left_out is None:
                    yield at, replace(item, split="test" if item in self._held_out else "train")
            elif left_out is None:
                yield at, item
            else:
                t = item.events["t"] - left_out.start_us
                outside = (t < 0) | (t >= left_out.duration_us)
                if outside.any():
                    yield at, replace(item, events=item.events[outside])


class DataSet:
    """Labelled recordings, and which of their samples are scored.

    Those of held-out splits are, as they are; where there is none, or `on` says so, folds of the others are
    scored in turn, and held-out samples are not there.

    Args:
        paths: the recordings, which are one data set together.
        topic: as for `open_recording`.
        folds: how many, where no held-out split is scored.
        seed: of folds that are shuffled.
        groups: which samples are never on two sides of a fold, see `classify.folds`.
        on: `held-out`, or `train` for folds of the samples that are not held out.
        reading: how to read the recordings.

    Attributes:
        labels: of all samples in stored order, of each recording.
        names: the classes, sorted.
        groups: as given.
        seed: as given.
        topic: as given.
        scored: what is scored, in words.
        n_folds: 1 where that is a held-out split.
        assumptions: what the recordings leave open, a line each.
        units: the unit of each scored sample that a bootstrap draws whole, in stored order, fold after fold.

    Raises:
        InputError: a label is missing, there are fewer than two classes, nothing to learn from or nothing to
            score, or the samples cannot be cut into such folds.
    """

    def __init__(
        self,
        paths: Sequence[Location],
        topic: str | None,
        folds: int,
        seed: int,
        on: str = "held-out",
        groups: str = "block",
        reading: ReadOptions = AS_IT_IS,
    ) -> None:
        """Read the labels."""
        if on not in ("held-out", "train"):
            raise InputError(f"--on {on} is unknown; choose held-out or train")
        self.groups, self.seed = groups_named(groups), seed
        self.paths = list(paths)
        self.topic, self._reading = topic, reading
        self.labels: list[list[Label]] = []
        self.assumptions: list[str] = []
        for path in self.paths:
            with open_recording(path, topic, reading) as recording:
                self.labels.append(recording.labels)
                self.assumptions += recording.assumptions
            _check_labels(path, self.labels[-1])
        every = [label for labels in self.labels for label in labels]
        counts = Counter(label.label for label in every)
        self.names = sorted(counts)
        where = ", ".join(map(str, self.paths))
        if len(counts) < 2:
            raise InputError(
                f"{where}: all samples are labelled {self.names[0]!r}; at least two classes are needed"
            )
        held_out = [label.split in HELD_OUT_SPLITS for label in every]
        if all(held_out):
            raise InputError(
                f"{where}: every sample is of a held-out split; nothing to learn from, add training samples"
            )
        self._folds: list[list[frozenset[Label]]] = []
        if any(held_out) and on == "held-out":
            self.scored, self.n_folds = "the recording's held-out split", 1
            scored = [label for label in every if label.split in HELD_OUT_SPLITS]
            self.units = bootstrap_units(*_columns(scored), self.groups)
            return
        self.labels = [[a for a in labels if a.split not in HELD_OUT_SPLITS] for labels in self.labels]
        every = [label for labels in self.labels for label in labels]
        counts = Counter(label.label for label in every)
        if folds < 2:
            raise InputError(
                f"{where}: no sample is of a held-out split that is to be scored "
                f"({', '.join(sorted(HELD_OUT_SPLITS))}); --folds {folds} leaves nothing, give at least 2"
            )
        try:
            folded = assign_folds(*_columns(every), folds, self.groups, seed)
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
        self.n_folds = folds
        self.scored = f"{folds} {_FOLDS_IN_WORDS[self.groups]}" + (
            " of the training samples, without those held out" if any(held_out) else ""
        )
        cuts = np.cumsum([0, *map(len, self.labels)])
        tests = [np.flatnonzero(folded == fold) for fold in range(folds)]
        self._folds = [
            [
                frozenset(every[i] for i in test[(test >= start) & (test < stop)])
                for start, stop in itertools.pairwise(cuts)
            ]
            for test in tests
        ]
        self.units = bootstrap_units(*_columns(every), self.groups)[np.concatenate(tests)]

    @property
    def identity(self) -> dict[str, Any]:
        """What tells this data from other data: names and sizes of files, and how they are read."""
        known: dict[str, Any] = {"recordings": [[path.name, _size(path)] for path in self.paths]}
        if self._reading != AS_IT_IS:
            labels = hashlib.sha256(repr(self.labels).encode()).hexdigest()
            known["reading"] = [repr(replace(self._reading, labels=None)), labels]
        return known

    def held_out(self, fold: int) -> NDArray[np.bool_] | None:
        """Which samples one fold holds out, in stored order; None where it is the recordings that say so."""
        if not self._folds:
            return None
        places = zip(self.labels, self._folds[fold], strict=True)
        return np.array([label in held_out for labels, held_out in places for label in labels], bool)

    @contextlib.contextmanager
    def open(self, fold: int | None) -> Iterator[list[Recording]]:
        """The recordings with the splits of one fold, closed afterwards; with None, no fold holds out any."""
        with contextlib.ExitStack() as files:
            if self._folds and fold is None:
                yield [
                    files.enter_context(Fold(path, self.topic, reading=self._reading)) for path in self.paths
                ]
            elif not self._folds:
                yield [
                    files.enter_context(open_recording(path, self.topic, self._reading))
                    for path in self.paths
                ]
            else:
                yield [
                    files.enter_context(Fold(path, self.topic, held_out, reading=self._reading))
                    for path, held_out in zip(self.paths, self._folds[fold or 0], strict=True)
                ]


def _size(path: Location) -> int:
    """Bytes of a file; 0 for what is none, such as a pattern."""
    try:
        return size_of(path)
    except OSError:
        return 0


def _columns(labels: Sequence[Label]) -> tuple[list[str], list[str]]:
    """Their names and their sources."""
    return [label.label for label in labels], [label.source for label in labels]


def _check_labels(path: Location, labels: Sequence[Label]) -> None:
    if not labels:
        raise InputError(
            f"{path}: has no labelled samples; give them with --labels FILE.csv, or write them with "
            "`streamfeat convert`"
        )
    missing = [i for i, label in enumerate(labels) if not label.label]
    if missing:
        raise InputError(
            f"{path}: {len(missing)} of {len(labels)} samples have no label, the first is sample "
            f"{missing[0]}; label them or leave them out"
        )
