"""Folds for cross-validation that keep near copies on one side.

Lives here: blocks of neighbouring samples, the fold of each sample, and the units that a bootstrap draws.
Not here: training and scoring.

Samples that were cut from one video are near copies of their neighbours: on N-CARS a nearest neighbour on
12x12 counts is right for 94 % of samples under random folds and for 70 % under blocks, which is also its
accuracy on the official test set. So folds are blocks of neighbours unless something else is asked for.
"""

from collections.abc import Sequence
from typing import Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.files.locations import natural_order

__all__ = ["Groups", "assign_folds", "block_numbers", "bootstrap_units", "check_labels", "groups_named"]

Groups = Literal["block", "source", "none"]
"""Which samples stay together: neighbours in the order of their sources, those of one source, or none."""

_UNITS = 25
"""Runs of neighbours of each class that a bootstrap draws from."""


def groups_named(name: str) -> Groups:
    """The kind of groups that an option names.

    Raises:
        InputError: there is no such kind.
    """
    if name not in get_args(Groups):
        raise InputError(f"--groups {name} is unknown; choose from {', '.join(get_args(Groups))}")
    return cast(Groups, name)


def block_numbers(labels: Sequence[str], sources: Sequence[str], n: int) -> NDArray[np.int64]:
    """The block of each sample: the samples of each class in the order of their sources, cut into `n` runs.

    Args:
        labels: `m` names.
        sources: `m` texts; numbers in them count as numbers, and equal ones keep the order of the samples.
        n: blocks of each class, as even as can be.

    Returns:
        `(m,)` from 0 to `n - 1`; block `i` of every class has the number `i`.
    """
    blocks = np.empty(len(labels), np.int64)
    members: dict[str, list[int]] = {}
    for i, label in enumerate(labels):
        members.setdefault(label, []).append(i)
    for mine in members.values():
        mine.sort(key=lambda i: natural_order(sources[i]))
        blocks[mine] = np.arange(len(mine)) * n // len(mine)
    return blocks


def check_labels(labels: Sequence[str]) -> None:
    """Refuse training samples of which some have no label.

    Raises:
        InputError: it names the first of them.
    """
    missing = [i for i, label in enumerate(labels) if not (isinstance(label, str) and label)]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(labels)} training samples have no label, the first is sample "
            f"{missing[0]}; label them or leave them out"
        )


def assign_folds(
    labels: Sequence[str], sources: Sequence[str], n: int, groups: Groups = "block", seed: int = 0
) -> NDArray[np.int64]:
    """The fold in which each sample is scored; every class is in every fold as evenly as can be.

    `block`: `block_numbers`. `source`: samples of one source stay together, sources are shuffled
    (scikit-learn's `StratifiedGroupKFold`). `none`: samples are shuffled (`StratifiedKFold`).

    Args:
        labels: `m` names.
        sources: `m` texts.
        n: folds, at least two.
        groups: which samples stay together.
        seed: of the shuffling.

    Raises:
        InputError: a label is missing; a class has fewer samples, or sources, than folds; or all samples of a
            class would be in one fold.
    """
    check_labels(labels)
    if n < 2:
        raise InputError(f"cross-validation with {n} folds is not possible; it needs at least two")
    names, targets, counts = np.unique(np.asarray(labels), return_inverse=True, return_counts=True)
    if len(counts) and counts.min() < n:
        raise InputError(
            f"label {str(names[counts.argmin()])!r} has {counts.min()} training samples, "
            f"{n}-fold cross-validation needs {n}; add samples or lower --folds"
        )
    if groups == "block":
        return block_numbers(labels, sources, n)
    folds = np.empty(len(labels), np.int64)
    numbers = np.unique(np.asarray(sources, str), return_inverse=True)[1]
    for fold, test in enumerate(_shuffled(targets, numbers, n, groups, seed)):
        folds[test] = fold
    for target, name in enumerate(names):
        mine = np.unique(folds[targets == target])
        if len(mine) == 1:
            raise InputError(
                f"all samples of label {str(name)!r} would be in one fold, with none left to learn from, "
                "because they share sources; give --groups block or --groups none"
            )
    return folds


def _shuffled(
    targets: NDArray[np.int64], sources: NDArray[np.int64], n: int, groups: Groups, seed: int
) -> list[NDArray[np.int64]]:
    """The samples of each fold."""
    from sklearn.model_selection import StratifiedGroupKFold, StratifiedKFold

    if groups == "none":
        splitter = StratifiedKFold(n, shuffle=True, random_state=seed)
        return [test for _, test in splitter.split(targets, targets)]
    if (n_sources := len(np.unique(sources))) < n:
        raise InputError(
            f"the samples are of {n_sources} source(s), too few for {n} folds; lower --folds, or give "
            "--groups block or --groups none"
        )
    grouped = StratifiedGroupKFold(n, shuffle=True, random_state=seed)
    return [test for _, test in grouped.split(targets, targets, sources)]


def bootstrap_units(labels: Sequence[str], sources: Sequence[str], groups: Groups) -> NDArray[np.int64]:
    """The unit of each sample that a bootstrap draws whole: `(m,)` numbers.

    Runs of neighbours, 25 of each class (`block`); sources; or samples (`none`). Hits of near copies are not
    independent, and an interval over samples would be too narrow.
    """
    if groups == "none":
        return np.arange(len(labels))
    if groups == "source":
        return np.unique(np.asarray(sources, str), return_inverse=True)[1].astype(np.int64)
    classes = np.unique(np.asarray(labels, str), return_inverse=True)[1]
    return np.asarray(classes * _UNITS + block_numbers(labels, sources, _UNITS), np.int64)
