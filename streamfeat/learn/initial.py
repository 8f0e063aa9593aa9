"""Where both learners start from.

Lives here: the initial filters. Not here: any objective.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.learn.chunks import Rows

__all__ = ["random_directions"]

_NOISE = 0.01
"""Length of what is added to a volume of unit length, so that filters span all dimensions: volumes have no
mean and may repeat, and a transform of less than full rank has no log-determinant."""


def random_directions(volumes: Rows, squares: NDArray[np.float64], n: int, rng: Any) -> NDArray[np.float32]:
    """`(n, d)` rows of unit length: distinct volumes, random directions where those run out; a little noise.

    Args:
        volumes: `(samples, d)` whitened volumes.
        squares: `(samples,)` their squared lengths.
        n: rows to make.
        rng: NumPy RandomState.

    Raises:
        InputError: all volumes are zero.
    """
    usable = np.flatnonzero(squares > 1e-12)
    if len(usable) == 0:
        raise InputError(
            f"all {len(squares)} volumes are constant; there is nothing to learn from: "
            "use recordings with events, or a larger patch"
        )
    picked = rng.permutation(usable)[:n]
    rows = rng.standard_normal((n, volumes.shape[1]))
    rows *= _NOISE / np.linalg.norm(rows, axis=1, keepdims=True)
    rows[: len(picked)] += volumes[picked] / np.sqrt(squares[picked, None])
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)
