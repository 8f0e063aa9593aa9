"""From features to the scores of a linear classifier, part by part: only what changed is summed again.

Lives here: signed square roots, their products with weights, and the order in which products are summed.
Not here: what the classifier is and what becomes of its scores (`classify`), when to predict (`trace`).

Floats that are summed have an order, or the bits of a score would depend on how it was come by. Features are
cut into PARTS equal parts, whatever they are features of. Within a part products are summed as `sum_products`
does, in lanes of vectors that are the same on every processor; then the parts are added up, the first one
first. So a score after an event, where the other parts are those of the event before, has the bits of a score
from the whole feature vector.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.compiled import inlined, kernel
from streamfeat.kernels.vectors import sum_products

PARTS = 16
"""Parts of a feature vector: four for each quadrant of a grid of volumes."""

SUMMED = 32
"""Products that `sum_products` takes at a time: rows of weights are padded with zeros to a multiple of it."""


class Weights(NamedTuple):
    """A linear classifier for features normalised by signed square roots and length (see `classifier`)."""

    rows: NDArray[np.float32]
    """`(PARTS, C, L)`: weights of one part, class by class; zeros where a part is shorter than `L`."""
    bias: NDArray[np.float32]
    """`(C,)`."""


@inlined
def part_of(feature: int, n_features: int) -> int:
    """The part that a feature is in."""
    return feature // -(-n_features // PARTS)


@kernel
def sum_part(
    part: int,
    features: NDArray[np.float32],
    weights: Weights,
    roots: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> None:
    """Sum the products of one part for each class, and the squares of its roots.

    Args:
        part: which.
        features: `(F,)`; not changed.
        weights: of the classifier; not changed.
        roots: `(L,)` scratch, signed square roots of the part's features.
        sums: `(PARTS, C + 1)`, row `part` is overwritten; the last number is the sum of squares.
    """
    rows, classes, length = weights.rows.reshape(-1), weights.rows.shape[1], weights.rows.shape[2]
    size = -(-features.shape[0] // PARTS)
    start = min(part * size, features.shape[0])
    n = min(size, features.shape[0] - start)
    for i in range(n):
        feature = features[start + i]
        roots[i] = np.copysign(np.sqrt(abs(feature)), feature)
    roots[n:] = 0
    for c in range(classes):
        sums[part, c] = sum_products(roots, 0, rows, (part * classes + c) * length, length)
    sums[part, classes] = sum_products(roots, 0, roots, 0, length)


@inlined
def score_parts(sums: NDArray[np.float32], bias: NDArray[np.float32], scores: NDArray[np.float32]) -> None:
    """From the sums of all parts to scores: products over the length of the vector of roots, and the bias.

    Args:
        sums: `(PARTS, C + 1)`, as `sum_part` leaves them; not changed.
        bias: `(C,)`; not changed.
        scores: `(C,)`, overwritten.
    """
    classes, square = bias.shape[0], np.float32(0)
    scores[:] = 0
    for part in range(PARTS):
        square += sums[part, classes]
        for c in range(classes):
            scores[c] += sums[part, c]
    length = np.sqrt(square) if square > 0 else np.float32(1)
    for c in range(classes):
        scores[c] = scores[c] / length + bias[c]


@kernel
def predict(
    features: NDArray[np.float32],
    weights: Weights,
    roots: NDArray[np.float32],
    sums: NDArray[np.float32],
    scores: NDArray[np.float32],
) -> None:
    """Scores of whole feature vectors, each by itself.

    Args:
        features: `(n, F)`; not changed.
        weights: of the classifier; not changed.
        roots: `(L,)` scratch.
        sums: `(PARTS, C + 1)` scratch.
        scores: `(n, C)`, overwritten.
    """
    for i in range(features.shape[0]):
        for part in range(PARTS):
            sum_part(part, features[i], weights, roots, sums)
        score_parts(sums, weights.bias, scores[i])
