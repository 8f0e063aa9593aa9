"""Samples that a training sample could have been: mirrored, moved, seen for a shorter time.

Lives here: `Variant`, which ones options ask for, what each makes of a sample.
Not here: encoding them (`features`), and whether they are worth it (`evaluate`).

Variants are made of events, not of features, so any geometry will do: a mirrored sample is encoded by the
grid that the model has, wherever its volumes lie.
"""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from streamfeat.errors import InputError
from streamfeat.recordings.reader import Label, Sample

__all__ = ["PLAIN", "Variant", "parse_cuts", "variants_of"]

_ANY = "any"
_LEAST_SHARE = 0.1
_MOST_CUTS = 8
_MOST_SHIFT = 1024


@dataclass(frozen=True, slots=True)
class Variant:
    """How a sample is changed.

    Attributes:
        mirror: columns from right to left.
        shift: `(rows, columns)` by which events move; those that leave the sensor are lost.
        cut_us: the sample is seen for so long only; 0 for all of it. Below zero, for a time that is drawn for
            each sample; -1, -2 and so on are different draws.
    """

    mirror: bool = False
    shift: tuple[int, int] = (0, 0)
    cut_us: int = 0

    def of(self, sample: Sample) -> Sample:
        """The changed sample; the one given is not changed.

        An event outside the sensor stays outside. A sample that is no longer than the cut stays whole.
        """
        label, events = sample.label, sample.events
        cut_us = self._drawn(label) if self.cut_us < 0 else self.cut_us
        if 0 < cut_us < label.duration_us:
            label = replace(label, duration_us=cut_us)
            t = events["t"]
            events = events[(t >= label.start_us) & (t < label.start_us + cut_us)]
        if self.mirror:
            events = events.copy()
            events["x"] = np.uint16(sample.resolution[1] - 1) - events["x"]  # unsigned: it wraps
        if self.shift != (0, 0):
            height, width = sample.resolution
            y = events["y"].astype(np.int64) + self.shift[0]
            x = events["x"].astype(np.int64) + self.shift[1]
            inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
            events = events[inside].copy()
            events["y"], events["x"] = y[inside], x[inside]
        return Sample(label, events, sample.resolution)

    def _drawn(self, label: Label) -> int:
        """Microseconds from a tenth to all of the sample, by its label and this variant alone.

        The logarithm is uniform: what is new in a further millisecond becomes less and less.
        """
        text = f"{label.source} {label.start_us} {self.mirror} {self.cut_us}"
        draw = int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest())
        share: float = _LEAST_SHARE ** (draw / 2**32)
        return max(1, round(label.duration_us * share))

    def __str__(self) -> str:
        """What it is, in words."""
        words = ["mirrored"] if self.mirror else []
        words += [f"moved by {self.shift[0]}, {self.shift[1]}"] if self.shift != (0, 0) else []
        words += [f"first {self.cut_us / 1000:g} ms"] if self.cut_us > 0 else []
        words += [f"beginning {-self.cut_us}"] if self.cut_us < 0 else []
        return ", ".join(words) or "as it is"


PLAIN = Variant()
"""The sample itself."""


def parse_cuts(text: str) -> tuple[int, ...]:
    """Microseconds of cuts such as `33+67`, in milliseconds; each `any` is a draw, -1, -2 and so on.

    Raises:
        InputError: it is something else.
    """
    parts = [part.strip() for part in re.split(r"[+,]", text)] if text.strip() else []
    draws = tuple(range(-1, -1 - parts.count(_ANY), -1))
    try:
        cuts = tuple(sorted({round(1000 * float(part)) for part in parts if part != _ANY}))
    except (ValueError, OverflowError):
        cuts = (0,)
    if len(draws + cuts) > _MOST_CUTS or not all(1000 <= cut < 10**9 for cut in cuts):
        raise InputError(
            f"cuts {text!r} are not understood; give up to {_MOST_CUTS} times of a millisecond or more, "
            "such as 33+67, or any"
        )
    return draws + cuts


def variants_of(*, mirror: bool = False, cuts: Sequence[int] = (), shift: int = 0) -> tuple[Variant, ...]:
    """What is learned from beside the samples themselves.

    Args:
        mirror: mirror images.
        cuts: microseconds after which samples, and their mirror images, are cut.
        shift: pixels by which whole samples are moved to each of the four sides; 0 for none.

    Raises:
        InputError: the shift is out of range.
    """
    if not 0 <= shift <= _MOST_SHIFT:
        raise InputError(f"a shift of {shift} pixels is not possible; give 0 to {_MOST_SHIFT}")
    sides = (False, True) if mirror else (False,)
    found = [Variant(mirror=side, cut_us=cut) for side in sides for cut in (0, *cuts)][1:]
    if shift:
        found += [Variant(shift=by) for by in ((-shift, 0), (shift, 0), (0, -shift), (0, shift))]
    return tuple(found)
