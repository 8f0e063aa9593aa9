"""From features to labels by a Gaussian kernel: more accurate than the linear classifier, dearer each time.

Lives here: kernel ridge regression on projected features, its training, its file.
Not here: the linear classifier that stands beside it (`classifier`), and when to predict (`stream`).

A prediction takes one product with each training sample, about a millisecond at 15,000, so it is for
emissions, not for single events: `--emit event` and `--learn-online` use the linear classifier in the file.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from streamfeat.classify.calibration import checked_temperature, fitted_temperature, probabilities
from streamfeat.classify.classifier import Classifier, normalise_features
from streamfeat.engine.encoder import Encoder
from streamfeat.errors import InputError
from streamfeat.files.safetensors_file import read_safetensors, write_safetensors
from streamfeat.report.shown import Shown

__all__ = ["MOST_POINTS", "KernelClassifier", "load_classifier", "train_kernel_classifier"]

MOST_POINTS = 16_384
"""Training rows at most: the kernel matrix, float64, takes 2 GiB then while it is factored."""

_KERNEL_KIND = "streamfeat-kernel-classifier"
_KERNEL_VERSION = 1

_DIMENSIONS = 256
_RIDGE_WEIGHT = 1e-2
_EXACT_AXES = 4096
"""Rows, or features, up to which all principal axes are worked out."""

_MORE_AXES, _ROUNDS = 32, 8
"""Of the subspace iteration: axes beyond those that are kept, and how often the rows are gone through."""

_FOR_MEDIAN = 2048
"""Rows whose distances the width of the kernel is told from."""


@dataclass(frozen=True, slots=True, repr=False)
class KernelClassifier(Shown):
    """Kernel ridge regression onto the classes: `score = k(u) . dual`, `k_i = exp(-gamma |u - p_i|^2)`.

    `u` are the normalised features, centred and projected on the principal axes of those in training.
    Scores of a row have the same bits whatever rows are scored with it: all products are row by row.

    Attributes:
        linear: the linear classifier of the same samples.
        mean: `(F,)` float32, of the normalised features.
        axes: `(F, P)` float32, principal axes.
        points: `(n, P)` float32, the projected training rows.
        dual: `(n, C)` float32, what each adds to the score of each label.
        gamma: one over the width of the kernel, squared.
        temperature: what makes probabilities of its scores; None where it was not fitted.
    """

    linear: Classifier
    mean: NDArray[np.float32]
    axes: NDArray[np.float32]
    points: NDArray[np.float32]
    dual: NDArray[np.float32]
    gamma: float
    temperature: float | None = None
    _squares: NDArray[np.float32] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Work out what does not depend on the features."""
        object.__setattr__(self, "_squares", np.einsum("ij,ij->i", self.points, self.points))

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
        rows = np.reshape(features, (-1, len(self.mean)))
        found = np.empty((len(rows), len(self.labels)), np.float32)
        for i, row in enumerate(rows):
            place = (normalise_features(row) - self.mean) @ self.axes
            distance = self._squares + np.float32(place @ place) - np.float32(2) * (self.points @ place)
            np.maximum(distance, 0, out=distance)
            found[i] = np.exp(distance * np.float32(-self.gamma)) @ self.dual
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
        arrays |= {name: getattr(self, name) for name in ("mean", "axes", "points", "dual")}
        header = header | {"gamma": self.gamma, "linear_temperature": self.linear.temperature}
        header = header | {"temperature": self.temperature}
        write_safetensors(Path(path), _KERNEL_KIND, _KERNEL_VERSION, arrays, header)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a kernel classifier; every shape, type and range is checked, and nothing in the file is run.

        Raises:
            InputError: the file is missing, cut short, of another version, or not a kernel classifier.
        """
        arrays, header = read_safetensors(Path(path), _KERNEL_KIND, _KERNEL_VERSION)
        of_linear = {**header, "temperature": header.get("linear_temperature")}
        linear = Classifier.from_parts(path, arrays, of_linear)
        n_features, n_labels = len(linear.centre), len(linear.labels)
        axes, points = (np.atleast_2d(arrays.get(name, np.zeros(0))) for name in ("axes", "points"))
        n, p = len(points), axes.shape[-1]
        shapes = {"mean": (n_features,), "axes": (n_features, p), "points": (n, p), "dual": (n, n_labels)}
        for name, shape in shapes.items():
            array = arrays.get(name)
            if array is None or array.dtype != np.float32 or array.shape != shape or 0 in shape:
                raise InputError(f"{path}: {name} is not float32 of shape {shape}; train it again")
            if not (np.abs(array) < 1e15).all():
                raise InputError(f"{path}: {name} is not finite, or too large; train it again")
        gamma = header.get("gamma")
        if not isinstance(gamma, float) or not 0 < gamma < 1e15 or n > MOST_POINTS:
            raise InputError(f"{path}: gamma or the number of points is out of range; train it again")
        temperature = checked_temperature(path, header)
        return cls(linear, **{name: arrays[name] for name in shapes}, gamma=gamma, temperature=temperature)


def load_classifier(path: str | Path) -> Classifier | KernelClassifier:
    """Read a classifier of either kind.

    Raises:
        InputError: see `Classifier.load` and `KernelClassifier.load`.
    """
    try:
        return KernelClassifier.load(path)
    except InputError as error:
        if f"not a {_KERNEL_KIND} file" not in str(error):
            raise
    return Classifier.load(path)


def train_kernel_classifier(
    features: NDArray[np.float32],
    linear: Classifier,
    labels: NDArray[np.str_],
    parts: NDArray[np.int64] | None = None,
) -> KernelClassifier:
    """Train the kernel classifier that stands beside a linear one.

    Saunders, Gammerman and Vovk (1998), eq. 7, with one target of plus or minus one for each label. The width
    is the median squared distance between rows, the ridge 0.01, the dimensions 256; on blocks of N-CARS that
    was two points better than the linear classifier.

    Memory: `8 n^2` bytes for the kernel matrix, `8 min(n, F)^2` for the axes, and a few times `4 n F`; with
    three `parts` `6 n^2` more, and twice the time.

    Args:
        features: `(n, F)` float32, as `Encoder.encode` gives them; not changed.
        linear: trained on the same rows.
        labels: `(n,)` names.
        parts: `(n,)` the fold in which each row is scored for the temperature; without, scores are no
            probabilities.

    Raises:
        InputError: there are more rows than the kernel matrix may have, or memory for.
    """
    n = len(features)
    if n > MOST_POINTS:
        raise InputError(
            f"{n:,} training rows are too many for --kernel rbf: their kernel matrix would take "
            f"{8 * n * n / 2**30:.1f} GiB, at most {MOST_POINTS:,} rows are taken; give --kernel linear, or "
            "fewer samples or variants of them"
        )
    try:
        return _trained(features, linear, labels, parts)
    except MemoryError:
        raise InputError(
            f"not enough memory for --kernel rbf with {n:,} training rows, which takes at least "
            f"{8 * n * n / 2**30:.1f} GiB; give --kernel linear, or fewer samples or variants of them"
        ) from None


def _trained(
    features: NDArray[np.float32],
    linear: Classifier,
    labels: NDArray[np.str_],
    parts: NDArray[np.int64] | None,
) -> KernelClassifier:
    n = len(features)
    rows = normalise_features(features)
    mean = rows.mean(axis=0, dtype=np.float64).astype(np.float32)
    rows -= mean
    axes = _principal_axes(rows)
    points = np.stack([row @ axes for row in rows])
    squares = np.square(points, dtype=np.float64).sum(axis=1)
    some = np.linspace(0, n - 1, min(n, _FOR_MEDIAN)).astype(int)
    distances = _distances(points[some].astype(np.float64), squares[some])
    gamma = 1.0 / max(float(np.median(distances[np.triu_indices(len(some), 1)])), 1e-12)
    kernel = _distances(points.astype(np.float64), squares)
    np.multiply(kernel, -gamma, out=kernel)
    np.exp(kernel, out=kernel)
    targets = np.where(labels[:, np.newaxis] == np.array(linear.labels), 1.0, -1.0)
    temperature = None
    if parts is not None:
        held_out = np.empty_like(targets)
        for part in np.unique(parts):
            seen, scored = np.flatnonzero(parts != part), np.flatnonzero(parts == part)
            held_out[scored] = kernel[np.ix_(scored, seen)] @ _ridge(
                kernel[np.ix_(seen, seen)], targets[seen]
            )
        temperature = fitted_temperature(held_out, targets.argmax(axis=1))
    # Bits of a product depend on how a matrix lies in memory, and files hold rows.
    dual = np.ascontiguousarray(_ridge(kernel, targets), np.float32)
    return KernelClassifier(linear, mean, axes, points, dual, gamma, temperature)


def _ridge(kernel: NDArray[np.float64], targets: NDArray[np.float64]) -> NDArray[np.float64]:
    """Dual weights `(m, C)`; the matrix is overwritten."""
    from scipy.linalg import cho_factor, cho_solve

    kernel.flat[:: len(kernel) + 1] += _RIDGE_WEIGHT
    found = cho_solve(cho_factor(kernel, lower=True, overwrite_a=True, check_finite=False), targets)
    return np.asarray(found)


def _principal_axes(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """The axes `(F, P)` of most variance of centred rows `(n, F)`; no more than the rows span."""
    from scipy.linalg import eigh

    n, width = rows.shape
    if min(n, width) > _EXACT_AXES:
        return _axes_by_iteration(rows)
    wide = rows.astype(np.float64)
    gram = wide @ wide.T if n < width else wide.T @ wide
    first = max(len(gram) - _DIMENSIONS, 0)
    values, vectors = eigh(gram, subset_by_index=(first, len(gram) - 1), overwrite_a=True)
    held = values > 1e-9 * max(values[-1], 1e-300)
    values, vectors = values[held], vectors[:, held]
    axes = wide.T @ (vectors / np.sqrt(values)) if n < width else vectors
    return np.ascontiguousarray(axes, np.float32)


def _axes_by_iteration(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Nearly the same by subspace iteration (Halko, Martinsson and Tropp 2011, algorithm 4.4), seeded.

    Eigenvectors of all of a covariance of 9,600 features would take minutes, and two gigabytes.
    """
    basis = np.random.default_rng(0).standard_normal((rows.shape[1], _DIMENSIONS + _MORE_AXES))
    for _ in range(_ROUNDS):
        basis = np.linalg.qr(rows.T @ (rows @ basis.astype(np.float32)))[0]
    within = (rows @ basis.astype(np.float32)).astype(np.float64)
    vectors = np.linalg.eigh(within.T @ within)[1][:, -_DIMENSIONS:]
    return np.ascontiguousarray(basis @ vectors, np.float32)


def _distances(points: NDArray[np.float64], squares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared distances `(n, n)`, in one array of that size."""
    found: NDArray[np.float64] = points @ points.T
    found *= -2.0
    found += squares
    found += squares[:, np.newaxis]
    return np.maximum(found, 0.0, out=found)
