"""What the kernels are given: the frozen operator and the changing state, as tuples of arrays.

Lives here: the two tuples, the meaning of their slots, and the fixed point that codes are pooled in.
Not here: how they are filled (`encoder`, `engine`) or what is done with them (the other kernels).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FIXED_POINT_BITS = 16
FIXED_POINT_ONE = 1 << FIXED_POINT_BITS
"""Codes are pooled as integer multiples of `1 / FIXED_POINT_ONE`, so a sum has no order."""

SOFT, SPLIT, TRIANGLE = 0, 1, 2
ENCODINGS = {"soft": SOFT, "split": SPLIT, "triangle": TRIANGLE}

LARGEST_SQUARE = 1 << 26
"""`|x|^2` and the squared length of a filter stay below this, so that a distance fits the fixed point."""

LANES = 32
"""Filters are padded with zeros to a multiple of this, so that no vector loop has a tail."""


class Operator(NamedTuple):
    """The frozen side of an encoder, in the integers that make streaming exact.

    With `d = n_bins * patch * patch` entries and `Kp` filters after padding (design: `q = P v`).
    """

    patch: int
    stride: int
    downsample: int
    bin_us: int
    max_count: int
    n_filters: int
    kind: int
    """One of SOFT, SPLIT, TRIANGLE."""
    inverse: bool
    """Codes come from the lasso (never for TRIANGLE, which reads distances)."""
    columns: NDArray[np.int16]
    """`(d, Kp)`: row `i` is what one count at entry `i` adds to the projection of a volume."""
    scale: float
    """`P = scale * columns.T`."""
    eps: float
    """Added to the variance of a volume before the square root."""
    offset: NDArray[np.float32]
    """`(Kp,)`: `P mu`, times FIXED_POINT_ONE."""
    threshold: float
    """The sparsity penalty lambda0 (float32), times FIXED_POINT_ONE."""
    quadratic: NDArray[np.int32]
    """`(d, d)`: `v' quadratic v * quadratic_scale / sigma^2` is the part of `|x|^2` quadratic in `v`."""
    quadratic_scale: float
    linear: NDArray[np.int32]
    """`(d,)`: `-2 * linear v * linear_scale / sigma` is the part of `|x|^2` linear in `v`."""
    linear_scale: float
    constant: float
    """`|W mu|^2`, the rest of `|x|^2`."""
    square_norms: NDArray[np.float32]
    """`(Kp,)`: squared length of each filter."""
    gram: NDArray[np.float32]
    """`(K, K)`: inner products of the atoms; empty unless `inverse`."""
    gap: float
    """The lasso stops at this duality gap, relative to `1/2 |x|^2`."""


class State(NamedTuple):
    """Everything that events change. `R, C` rows and columns of volumes, `V = R * C`, `T` bins."""

    counts: NDArray[np.int32]
    """`(T, H, W)`: signed counts, one slot a bin; bin `b` lives in slot `b % T`."""
    applied: NDArray[np.int16]
    """`(T, H, W)`: the clipped counts that projections stand for."""
    touched: NDArray[np.int32]
    """`(T * H * W,)`: flat indices of the entries whose clipped count changed since; a stack."""
    is_touched: NDArray[np.uint8]
    """`(T, H, W)`: whether an entry is on that stack."""
    clock: NDArray[np.int64]
    """`(4,)`: see the CLOCK_* slots."""
    tally: NDArray[np.int64]
    """`(5,)`: see the TALLY_* slots."""
    projections: NDArray[np.int32]
    """`(V, Kp)`: `q` of every volume."""
    moments: NDArray[np.int64]
    """`(V, 4)`: sum of entries, sum of squares, quadratic form, linear form, of every volume."""
    atoms: NDArray[np.float32]
    """`(V, K)`: the last lasso code of every volume, from which the next is started."""
    dirty: NDArray[np.int32]
    """`(V,)`: volumes to encode again; a stack."""
    is_dirty: NDArray[np.uint8]
    """`(V,)`: whether a volume is on that stack."""
    pooled: NDArray[np.int64]
    """`(4, F)`: codes summed over each quadrant, in fixed point; `F` is Kp, or 2 Kp for SPLIT."""
    code: NDArray[np.int32]
    """`(Kp,)`: scratch, the fixed-point code of one volume."""
    work: NDArray[np.float64]
    """`(4, Kp)`: scratch of the lasso."""
    active: NDArray[np.int64]
    """`(Kp,)`: scratch of the lasso, indices of atoms."""
    values: NDArray[np.int16]
    """`(d,)`: scratch, the entries of one volume."""


CLOCK_NOW, CLOCK_PROJECTED, CLOCK_TOUCHED, CLOCK_ORIGIN = range(4)
"""Current bin; the bin that projections stand for; height of the touched stack; time of bin 0 in us."""

TALLY_EVENTS, TALLY_LATE, TALLY_REJECTED, TALLY_SATURATED, TALLY_ROLLS = range(5)
"""Accepted; older than the window; outside the sensor or malformed; no change of a clipped count; bins."""

MOMENT_SUM, MOMENT_SQUARES, MOMENT_QUADRATIC, MOMENT_LINEAR = range(4)

BEFORE_TIME = -(1 << 62)
"""The current bin of an engine that has seen nothing; also bounds the times that are accepted."""
