"""Which split each sample of a data set is of.

Lives here: splits that folders name, blocks of neighbours that are held out, and taking fewer samples.
Not here: folds of cross-validation (`streamfeat.classify`), and finding the samples (`datasets`).
"""

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

from streamfeat.classify.folds import block_numbers
from streamfeat.errors import InputError
from streamfeat.files.locations import Location

__all__ = ["SamplePath", "chosen", "hold_out_block", "interleave", "parse_hold_out", "split_named", "spread"]

_SPLITS = {
    "train": "train",
    "training": "train",
    "test": "test",
    "testing": "test",
    "val": "validation",
    "valid": "validation",
    "validation": "validation",
}
_MOST_BLOCKS = 1000


@dataclass(frozen=True, slots=True)
class SamplePath:
    """One sample: its file, class, split ("" where no folder names one) and relative path."""

    path: Location
    label: str
    split: str
    source: str


def split_named(folder: str) -> str:
    """The split that the last word of a folder's name stands for, or ""."""
    return _SPLITS.get(re.split(r"[-_ ]", folder.lower())[-1], "")


def parse_hold_out(text: str) -> tuple[int, int]:
    """Read `1/5`: the first of five blocks.

    Raises:
        InputError: it is something else.
    """
    found = re.fullmatch(r"(\d{1,4})/(\d{1,4})", text.strip())
    block, n = (int(found[1]), int(found[2])) if found else (0, 0)
    if not (1 <= block <= n and 2 <= n <= _MOST_BLOCKS):
        raise InputError(f"--hold-out {text!r} is not understood; give 1/5 for the first of five blocks")
    return block, n


def hold_out_block(samples: Sequence[SamplePath], block: int, n: int) -> list[SamplePath]:
    """Mark one block of neighbours of each class as validation, and the others as train.

    The samples of each class, in the order of the numbers in their sources, are cut into `n` blocks of
    neighbours. In data that were cut from video neighbours are near copies of each other, and a sample held
    out from between them would be none. Samples of a test folder stay, and are not counted.
    """
    cut = [i for i, sample in enumerate(samples) if sample.split != "test"]
    blocks = block_numbers([samples[i].label for i in cut], [samples[i].source for i in cut], n)
    marked = list(samples)
    for i, number in zip(cut, blocks, strict=True):
        marked[i] = replace(samples[i], split="validation" if number == block - 1 else "train")
    return marked


def interleave(samples: Sequence[SamplePath], every: int) -> list[SamplePath]:
    """Mark every so-manieth sample that is not of a test folder as validation, and the others as train."""
    marked, seen = [], 0
    for sample in samples:
        if sample.split != "test":
            seen += 1
            sample = replace(sample, split="train" if seen % every else "validation")
        marked.append(sample)
    return marked


def spread(samples: Sequence[SamplePath], limit: int) -> list[SamplePath]:
    """Take the first of each split and label in turns, so that a few samples still hold all of them."""
    groups = defaultdict(list)
    for sample in samples:
        groups[sample.split, sample.label].append(sample)
    order = sorted((turn, i) for i, group in enumerate(groups.values()) for turn in range(len(group)))
    listed = list(groups.values())
    taken = [listed[i][turn] for turn, i in order[:limit]]
    return sorted(taken, key=lambda sample: sample.source)


def chosen(
    samples: list[SamplePath],
    gap_us: int,
    split: str | None,
    hold_out: tuple[int, int] | None,
    interleaved: int | None,
    limit: int | None,
) -> list[SamplePath]:
    """The samples and splits that are asked for; arguments as those of `datasets.convert`.

    Raises:
        InputError: an argument is out of range, or two exclude each other.
    """
    if gap_us <= 0 or (limit is not None and limit <= 0) or (interleaved is not None and interleaved < 2):
        raise InputError("gap_us and limit must be positive, interleaved at least 2")
    if sum(choice is not None for choice in (split, hold_out, interleaved)) > 1:
        raise InputError("--split, --hold-out and --interleaved exclude each other; give one")
    if hold_out is not None:
        samples = hold_out_block(samples, *hold_out)
    elif interleaved is not None:
        samples = interleave(samples, interleaved)
    elif split is not None:
        samples = [replace(sample, split=split) for sample in samples]
    return samples if limit is None else spread(samples, limit)
