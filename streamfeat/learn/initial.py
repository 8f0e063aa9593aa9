"""Where both learners start from.

Lives here: the initial filters. Not here: any objective.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError

__all__ = ["random_directions"]


def random_directions(white: NDArray[np.float32], n: int, rng: Any) -> NDArray[np.float32]:
    """`(n, d)` rows of unit length: distinct volumes first, random directions where those run out.

    Args:
        white: `(samples, d)` whitened volumes.
        n: rows to make.
        rng: NumPy RandomState.

    Raises:
        InputError: n is below one, or all volumes are zero.
    """
    if n < 1:
        raise InputError(f"{n} filters cannot be learned; ask for at least one")
    lengths = np.linalg.norm(white, axis=1)
    usable = np.flatnonzero(lengths > 1e-6)
    if len(usable) == 0:
        raise InputError("all volumes are constant; there is nothing to learn from")
    picked = rng.permutation(usable)[:n]
    rows = white[picked] / lengths[picked, None]
    if len(rows) < n:
        more = rng.standard_normal((n - len(rows), white.shape[1])).astype(np.float32)
        rows = np.concatenate([rows, more / np.linalg.norm(more, axis=1, keepdims=True)])
    return np.asarray(rows, np.float32)
