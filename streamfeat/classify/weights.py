"""A linear classifier as the kernels read it.

Lives here: standardisation folded into the weights, and their layout in parts.
Not here: the classifier (`classifier`), scores (`engine.trace`), their arithmetic (`kernels.predict`).
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.predict import PARTS, SUMMED, Weights

__all__ = ["folded"]


def folded(
    weights: NDArray[np.float32],
    bias: NDArray[np.float32],
    centre: NDArray[np.float32],
    scale: NDArray[np.float32],
) -> Weights:
    """Weights for features that are not standardised yet: `((u - centre) / scale) @ weights + bias`.

    Args:
        weights: `(F, C)`.
        bias: `(C,)`.
        centre: `(F,)`.
        scale: `(F,)`, above zero.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        weights = weights / scale[:, np.newaxis]
        # A product of matrices would have other last bits on another processor.
        shift = (centre[:, np.newaxis] * weights.astype(np.float64)).sum(axis=0)
        bias = (bias - shift).astype(np.float32)
    n, classes = weights.shape
    size = max(-(-n // PARTS), 1)
    rows = np.zeros((PARTS, classes, -(-size // SUMMED) * SUMMED), np.float32)
    for part, start in enumerate(range(0, n, size)):
        rows[part, :, : len(weights[start : start + size])] = weights[start : start + size].T
    return Weights(rows, bias)
