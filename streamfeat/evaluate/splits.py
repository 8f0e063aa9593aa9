"""What is learned from and what is scored.

Lives here: labelled recordings whose samples are held out, by their own splits or by folds.
Not here: learning and scoring.
"""

import contextlib
import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from sklearn.model_selection import StratifiedKFold

from streamfeat.errors import InputError
from streamfeat.recording import HELD_OUT_SPLITS, Label, Packet, Recording, open_recording

__all__ = ["DataSet", "Fold"]


class Fold(Recording):
    """A recording that says of its samples which are held out, whatever it was recorded with.

    Args:
        path: the file.
        topic: as for `open_recording`.
        held_out: positions of the labels that are.
    """

    def __init__(self, path: Path, topic: str | None, held_out: frozenset[int]) -> None:
        """Open it."""
        self._held_out = held_out
        super().__init__(path, topic)

    def items(self) -> Iterator[Packet | Label]:
        """As those of the recording, with other splits."""
        position = 0
        for item in super().items():
            if isinstance(item, Label):
                yield replace(item, split="test" if position in self._held_out else "train")
                position += 1
            else:
                yield item


class DataSet:
    """Labelled recordings: with held-out samples there is one fold, without there are `folds`, stratified.

    Args:
        paths: the recordings, which are one data set together.
        topic: as for `open_recording`.
        folds: how many, where no sample is of a held-out split.
        seed: of the folds.

    Attributes:
        labels: of all samples in stored order, of each recording.
        names: the classes, sorted.
        held_out_split: whether the recordings say what is held out.
        n_folds: 1 where they do.

    Raises:
        InputError: a label is missing, there are fewer than two classes, nothing to learn from or nothing to
            score.
    """

    def __init__(self, paths: Sequence[Path], topic: str | None, folds: int, seed: int) -> None:
        """Read the labels."""
        self.paths = list(paths)
        self._topic = topic
        self.labels: list[list[Label]] = []
        for path in self.paths:
            with open_recording(path, topic) as recording:
                self.labels.append(recording.labels)
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
        self.held_out_split = any(held_out)
        if all(held_out):
            raise InputError(
                f"{where}: every sample is of a held-out split; nothing to learn from, add training samples"
            )
        if self.held_out_split:
            self.n_folds = 1
            self._folds: list[list[frozenset[int]]] = []
            return
        if folds < 2:
            raise InputError(
                f"{where}: no sample is of a held-out split ({', '.join(sorted(HELD_OUT_SPLITS))}); "
                f"--folds {folds} leaves nothing to score, give at least 2"
            )
        if min(counts.values()) < folds:
            rarest = min(counts, key=lambda name: counts[name])
            raise InputError(
                f"{where}: label {rarest!r} has {counts[rarest]} samples, fewer than {folds} folds; "
                "add samples or give fewer --folds"
            )
        self.n_folds = folds
        targets = np.array([label.label for label in every])
        cuts = np.cumsum([0, *map(len, self.labels)])
        splitter = StratifiedKFold(folds, shuffle=True, random_state=seed)
        self._folds = [
            [
                frozenset((test[(test >= start) & (test < stop)] - start).tolist())
                for start, stop in itertools.pairwise(cuts)
            ]
            for _, test in splitter.split(targets, targets)
        ]

    @contextlib.contextmanager
    def open(self, fold: int) -> Iterator[list[Recording]]:
        """The recordings with the splits of one fold, closed afterwards."""
        with contextlib.ExitStack() as files:
            if self.held_out_split:
                yield [files.enter_context(open_recording(path, self._topic)) for path in self.paths]
            else:
                yield [
                    files.enter_context(Fold(path, self._topic, held_out))
                    for path, held_out in zip(self.paths, self._folds[fold], strict=True)
                ]


def _check_labels(path: Path, labels: Sequence[Label]) -> None:
    if not labels:
        raise InputError(f"{path}: has no labelled samples; `streamfeat convert` writes labels")
    missing = [i for i, label in enumerate(labels) if not label.label]
    if missing:
        raise InputError(
            f"{path}: {len(missing)} of {len(labels)} samples have no label, the first is sample "
            f"{missing[0]}; label them or leave them out"
        )
