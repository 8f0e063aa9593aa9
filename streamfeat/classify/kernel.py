"""From features to labels by Gaussian kernels: more accurate than the linear classifier, dearer each time.

Lives here: the committee of kernel machines that is the classifier, its training, its file.
Not here: one machine (`machine`), the linear classifier that stands beside it (`classifier`), and when to
predict (`stream`).

A prediction takes one product with each training sample, about a millisecond at 15,000, so it is for
emissions, not for single events: `--emit event` and `--learn-online` use the linear classifier in the file.

Several scales have a machine each, whose scores are averaged. One kernel on the features of all of them side
by side is a product of their kernels: it is large only where a sample is like another at every scale at once.
On the block of N-CARS that is least like the others it was worse than any scale alone, the average better.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from streamfeat.classify.calibration import checked_temperature, fitted_temperature, probabilities
from streamfeat.classify.classifier import KERNEL_KIND, KERNEL_VERSION, Classifier
from streamfeat.classify.machine import Cells, KernelMachine, folded_scores, trained_machine
from streamfeat.engine.encoder import Encoder
from streamfeat.errors import InputError
from streamfeat.files.safetensors_file import read_safetensors, write_safetensors
from streamfeat.report.shown import Shown

__all__ = ["KERNEL_SHARE", "MOST_POINTS", "KernelClassifier", "load_classifier", "train_kernel_classifier"]

MOST_POINTS = 32_768
"""Training rows at most: the kernel matrix, float32, takes 4 GiB then while it is factored."""

_ONE_CELL, _COMMITTEE, _WITH_GAINS = 1, 2, KERNEL_VERSION
"""Versions of its file. The first holds one machine whose features are normalised as a whole; machines of the
second have no gains."""

KERNEL_SHARE = "kernel_cross_validation"
"""In the provenance of the linear classifier beside it: how many held-out rows the kernel has right."""

_FOR_TEMPERATURE = 8_192
"""Rows at most that the temperature is fitted to: machines without a fold are needed for it."""

_PARTS = ("gains", "mean", "axes", "points", "dual")


@dataclass(frozen=True, slots=True, repr=False)
class KernelClassifier(Shown):
    """Kernel ridge regression onto the classes by a committee: the mean of the scores of its machines.

    Scores of a row have the same bits whatever rows are scored with it: all products are row by row.

    Attributes:
        linear: the linear classifier of the same samples.
        machines: each takes the features that follow those of the one before.
        temperature: what makes probabilities of its scores; None where it was not fitted.
    """

    linear: Classifier
    machines: tuple[KernelMachine, ...]
    temperature: float | None = None

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the classes."""
        return self.linear.labels

    @property
    def fingerprint(self) -> str:
        """Of the encoder it was trained with."""
        return self.linear.fingerprint

    @property
    def provenance(self) -> Mapping[str, Any]:
        """How it was trained."""
        return self.linear.provenance

    def scores(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Score of every label: `(C,)` for features `(F,)`, `(n, C)` for `(n, F)`."""
        places = _places([machine.cells for machine in self.machines])
        rows = np.reshape(features, (-1, places[-1].stop))
        found = np.zeros((len(rows), len(self.labels)), np.float32)
        for machine, place in zip(self.machines, places, strict=True):
            for row, score in zip(rows, found, strict=True):
                score += machine.scores(row[place])
        if len(self.machines) > 1:
            found /= np.float32(len(self.machines))
        return found.reshape(*features.shape[:-1], len(self.labels))

    def emitted(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """What an emission says of every label: probabilities if there is a temperature, else scores."""
        scores = self.scores(features)
        return scores if self.temperature is None else probabilities(scores, self.temperature)

    def predict(self, features: NDArray[np.float32]) -> str:
        """The label with the highest score for features `(F,)`."""
        return self.labels[int(self.scores(features).argmax())]

    def check_fits(self, encoder: Encoder, *, path: str | Path = "the classifier") -> None:
        """Refuse an encoder other than the one it was trained with; see `Classifier.check_fits`."""
        self.linear.check_fits(encoder, path=path)

    def save(self, path: str | Path) -> None:
        """Write one safetensors file; the file appears whole or not at all."""
        arrays, header = self.linear.parts()
        header |= {"linear_temperature": self.linear.temperature, "temperature": self.temperature}
        for i, machine in enumerate(self.machines):
            arrays |= {f"{name}.{i}": getattr(machine, name) for name in _PARTS}
        header |= {"machines": [{"cells": [*m.cells], "gamma": m.gamma} for m in self.machines]}
        write_safetensors(Path(path), KERNEL_KIND, _WITH_GAINS, arrays, header)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a kernel classifier; every shape, type and range is checked, and nothing in the file is run.

        Raises:
            InputError: the file is missing, cut short, of another version, or not a kernel classifier.
        """
        arrays, header = read_safetensors(Path(path), KERNEL_KIND, _ONE_CELL, _COMMITTEE, _WITH_GAINS)
        of_linear = {**header, "temperature": header.get("linear_temperature")}
        linear = Classifier.from_parts(path, arrays, of_linear)
        n_features, n_labels = len(linear.centre), len(linear.labels)
        if header["version"] == _ONE_CELL:
            described: Any = [{"cells": [n_features], "gamma": header.get("gamma")}]
            arrays = {**arrays, **{f"{name}.0": arrays[name] for name in _PARTS if name in arrays}}
        else:
            described = header.get("machines")
        if not _is_sound(described, n_features):
            raise InputError(
                f"{path}: the cells of its machines are not those of {n_features} features; train it again"
            )
        if header["version"] != _WITH_GAINS:
            ones = {f"gains.{i}": np.ones(sum(one["cells"]), np.float32) for i, one in enumerate(described)}
            arrays = {**arrays, **ones}
        machines = [
            _machine(path, i, tuple(one["cells"]), one.get("gamma"), arrays, n_labels)
            for i, one in enumerate(described)
        ]
        return cls(linear, tuple(machines), checked_temperature(path, header))


def _is_sound(described: Any, n_features: int) -> bool:
    """Whether a file's machines have whole numbers of features in their cells, and together all of them."""
    if not (isinstance(described, list) and described and all(isinstance(one, dict) for one in described)):
        return False
    cells = [n for one in described for n in (one.get("cells") or [0])]
    return all(type(n) is int and n > 0 for n in cells) and sum(cells) == n_features


def _machine(
    path: str | Path,
    number: int,
    cells: Cells,
    gamma: object,
    arrays: Mapping[str, NDArray[Any]],
    n_labels: int,
) -> KernelMachine:
    """One machine of a file, checked."""
    named = {name: arrays.get(f"{name}.{number}", np.zeros(0)) for name in _PARTS}
    n, p = len(np.atleast_2d(named["points"])), np.atleast_2d(named["axes"]).shape[-1]
    shapes = {
        "gains": (sum(cells),),
        "mean": (sum(cells),),
        "axes": (sum(cells), p),
        "points": (n, p),
        "dual": (n, n_labels),
    }
    for name, shape in shapes.items():
        array = named[name]
        if array.dtype != np.float32 or array.shape != shape or 0 in shape:
            raise InputError(f"{path}: {name} is not float32 of shape {shape}; train it again")
        if not (np.abs(array) < 1e15).all():
            raise InputError(f"{path}: {name} is not finite, or too large; train it again")
    if (named["gains"] < 0).any():
        raise InputError(f"{path}: gains must not be below zero; train it again")
    if not isinstance(gamma, float) or not 0 < gamma < 1e15 or n > MOST_POINTS:
        raise InputError(f"{path}: gamma or the number of points is out of range; train it again")
    return KernelMachine(cells, **named, gamma=gamma)


def _places(cells: Sequence[Cells]) -> list[slice]:
    """Where the features of each machine stand."""
    return [slice(a, b) for a, b in pairwise(accumulate(map(sum, cells), initial=0))]


def load_classifier(path: str | Path) -> Classifier | KernelClassifier:
    """Read a classifier of either kind.

    Raises:
        InputError: see `Classifier.load` and `KernelClassifier.load`.
    """
    try:
        return KernelClassifier.load(path)
    except InputError as error:
        if f"not a {KERNEL_KIND} file" not in str(error):
            raise
    return Classifier.load(path)


def train_kernel_classifier(
    features: NDArray[np.float32],
    linear: Classifier,
    labels: NDArray[np.str_],
    parts: NDArray[np.int64] | None = None,
    cells: Sequence[Cells] | None = None,
    report: Callable[[str, int, int, str], None] = lambda step, done, total, remark: None,
) -> KernelClassifier:
    """Train the kernel classifier that stands beside a linear one.

    Saunders, Gammerman and Vovk (1998), eq. 7, with one target of plus or minus one for each label. The width
    is the median squared distance between rows, the ridge 0.01, the dimensions 256; on blocks of N-CARS that
    was two points better than the linear classifier. Features of each cell are scaled to the same length,
    which is worth most where samples are unlike those in training. Before that each feature is multiplied by
    a gain, so that what a linear classifier leans on counts for more: a point and a half.

    Memory: `4 n^2` bytes for the kernel matrix, `8 min(n, F)^2` for the axes, and a few times `4 n F`.

    Args:
        features: `(n, F)` float32, as `Encoder.encode` gives them; not changed.
        linear: trained on the same rows.
        labels: `(n,)` names.
        parts: `(n,)` the fold in which each row is scored for the temperature; without, scores are no
            probabilities.
        cells: of each machine, see `machine.cells_of`; one machine of one cell if not given.
        report: called with (step, done, of how many, remark).

    Raises:
        InputError: there are more rows than the kernel matrix may have, or memory for.
    """
    n = len(features)
    if n > MOST_POINTS:
        raise InputError(
            f"{n:,} training rows are too many for --kernel rbf: their kernel matrix would take "
            f"{4 * n * n / 2**30:.1f} GiB, at most {MOST_POINTS:,} rows are taken; give --kernel linear, or "
            "fewer samples or variants of them"
        )
    try:
        return _trained(features, linear, labels, parts, cells or ((features.shape[1],),), report)
    except MemoryError:
        raise InputError(
            f"not enough memory for --kernel rbf with {n:,} training rows, which takes at least "
            f"{4 * n * n / 2**30:.1f} GiB; give --kernel linear, or fewer samples or variants of them"
        ) from None


def _trained(
    features: NDArray[np.float32],
    linear: Classifier,
    labels: NDArray[np.str_],
    parts: NDArray[np.int64] | None,
    cells: Sequence[Cells],
    report: Callable[[str, int, int, str], None],
) -> KernelClassifier:
    named = labels[:, np.newaxis] == np.array(linear.labels)
    targets = np.where(named, np.float32(1), np.float32(-1))
    some = np.linspace(0, len(labels) - 1, min(len(labels), _FOR_TEMPERATURE)).astype(int)
    held_out = np.zeros((len(some), targets.shape[1]), np.float32)
    machines = []
    for i, (mine, place) in enumerate(zip(cells, _places(cells), strict=True)):
        report("training", i, len(cells), f"Gaussian kernel of {len(labels):,} samples, scale {i + 1}")
        machines.append(trained_machine(features[:, place], mine, targets))
        if parts is not None:
            held_out += folded_scores(features[some][:, place], mine, targets[some], parts[some])
    if parts is None:
        return KernelClassifier(linear, tuple(machines))
    true = named[some].argmax(axis=1)
    right = round(float(np.mean(held_out.argmax(axis=1) == true)), 4)
    linear = replace(linear, provenance={**linear.provenance, KERNEL_SHARE: right})
    return KernelClassifier(linear, tuple(machines), fitted_temperature(held_out / len(machines), true))
