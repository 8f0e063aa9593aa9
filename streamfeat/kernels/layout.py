"""What the kernels are given: the frozen operator and the changing state, as tuples of arrays.

Lives here: the two tuples and the meaning of their slots.
Not here: how they are filled (`encoder`, `engine`) or what is done with them (the other kernels).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from streamfeat.events import TIME_LIMIT

SOFT, SPLIT, TRIANGLE = 0, 1, 2
FEATURE_ENCODINGS = {"soft": SOFT, "split": SPLIT, "triangle": TRIANGLE}

QUEUE = 16
"""Volumes that wait at most: their sums of columns stay in the first cache."""

LANES = 32
"""Filters are padded with zeros to a multiple of this, so that no vector loop has a tail."""


class Operator(NamedTuple):
    """The frozen side of an encoder, in the integers that make streaming exact.

    With `d` entries, `bins * rows * columns` of a volume, and `Kp` filters after padding (design: `q = P v`).
    """

    patch: tuple[int, int]
    """Rows and columns of a volume."""
    stride: int
    downsample: int
    bin_us: int
    max_count: int
    pooling: int
    n_filters: int
    kind: int
    """One of SOFT, SPLIT, TRIANGLE."""
    inverse: bool
    """Codes come from the lasso (never for TRIANGLE, which reads distances)."""
    unit: float
    """A code of one in the fixed point that codes are pooled in, a power of two; sums have no order."""
    columns: NDArray[np.int16]
    """`(d, Kp)`: row `i` is what one count at entry `i` adds to the projection of a volume."""
    scale: float
    """`P = scale * columns.T`."""
    eps: float
    """Added to the variance of a volume before the square root."""
    offset: NDArray[np.float32]
    """`(Kp,)`: `P mu`, times `unit`."""
    threshold: float
    """The sparsity penalty lambda0 (float32), times `unit`."""
    quadratic: NDArray[np.int32]
    """`(d, d)`: `v' quadratic v * quadratic_scale / sigma^2` is the part of `|x|^2` quadratic in `v`."""
    quadratic_scale: float
    linear: NDArray[np.int32]
    """`(d,)`: `-2 * linear v * linear_scale / sigma` is the part of `|x|^2` linear in `v`."""
    linear_scale: float
    constant: float
    """`|W mu|^2`, the rest of `|x|^2`."""
    reach: float
    """An upper bound of `|x|`."""
    largest: float
    """What no entry of a code, nor any number on the way to it, exceeds in absolute value."""
    square_norms: NDArray[np.float32]
    """`(Kp,)`: squared length of each filter."""
    gram: NDArray[np.float32]
    """`(K, K)`: inner products of the atoms; empty unless `inverse`."""
    gap: float
    """The lasso stops at this duality gap, relative to `1/2 |x|^2`."""
    packed: NDArray[np.int16]
    """`(Kp / 32, ceil(d / 2), 64)`: for 32 filters and a pair of entries, both numbers of each filter;
    `columns` again, as `dense` reads them. Empty where there is a quadratic form."""
    shape: tuple[int, int] = (0, 0)
    """Rows and columns of the grid of volumes; of the sensor, not of the model, which has none."""
    wide: bool | None = True
    """True in the wide state of codes in closed form, None in the others, as `steps`, `upper` and `lower` are
    but in the narrow one: a kernel is compiled for the kind of state that it is called with, for no other."""
    lasso: bool | None = None
    """True where `inverse` is, or else None."""
    steps: NDArray[np.float64] | None = None
    """`(Kp,)`: `P[k] = steps[k] * columns[:, k]` in the narrow state, where `scale` means nothing; of a
    sensor, what a code of one is worth."""
    upper: NDArray[np.uint16] | None = None
    """`(Kp,)`: positive codes are what is above it, 2^15 standing for zero; narrow state, of a sensor."""
    lower: NDArray[np.uint16] | None = None
    """`(Kp,)`: negative codes are what is below it."""
    gain: float = 0.0
    """Units of a code in a projection that is divided by the deviation; narrow state, of a sensor."""


class State(NamedTuple):
    """Everything that events change. `V` volumes, `T` bins, and one or two planes.

    A plane is the state of all volumes at one bin: projections, moments, lasso codes, pooled sums. The
    plane of the current bin is what is read. A second plane, if there is one, looks ahead: it holds what
    volumes will be after the next bin boundary, so that the boundary only swaps the two. Volumes enter a
    plane in order, first their projections, then their codes; `cursors` says how far it has come. Invariant:
    a row whose sum of squares is zero has moments and projection zero.

    Threads share the volumes of a large emission in contiguous parts, `N` of them. No two write to one row:
    scratch and sums are there once for each part.
    """

    counts: NDArray[np.int32]
    """`(T, H, W)`: signed counts, one slot a bin; bin `b` lives in slot `b % T`."""
    applied: NDArray[np.int16]
    """`(T, H, W)`: the clipped counts that planes stand for."""
    news: NDArray[np.int16]
    """`(T, H, W)`: clipped counts less `applied`, while an update is under way; else zero."""
    touched: NDArray[np.int32]
    """`(T * H * W + 1,)`: flat indices of the entries whose clipped count changed since; a stack, with room
    for one that is written and not kept."""
    is_touched: NDArray[np.uint8]
    """`(T, H, W)`: whether an entry is on that stack."""
    touched_slots: NDArray[np.uint8]
    """`(T,)`: scratch, slots in which an entry is on that stack."""
    ring_rows: NDArray[np.int32]
    """`(height,)`: row of the ring for each row of the sensor; a table, for a division costs more."""
    ring_columns: NDArray[np.int32]
    """`(width,)`: the same for columns."""
    volume_rows: NDArray[np.int32]
    """`(H, 2)`: first and last plus one of the rows of volumes that cover a row of the ring."""
    volume_columns: NDArray[np.int32]
    """`(W, 2)`: the same for columns."""
    clock: NDArray[np.int64]
    """`(7,)`: see the CLOCK_* slots."""
    cursors: NDArray[np.int64]
    """`(planes, 3)`: see the CURSOR_* slots."""
    tally: NDArray[np.int64]
    """`(5,)`: see the TALLY_* slots."""
    encoded: NDArray[np.int64]
    """`(N,)`: volumes encoded so far, a measure of the work done."""
    projections: NDArray[np.int32] | NDArray[np.int16]
    """`(planes, V, Kp)`: `q` of every volume; int16 in the narrow state."""
    moments: NDArray[np.int64]
    """`(planes, V, 4)`: sum of entries, sum of squares, quadratic form, linear form, of every volume."""
    atoms: NDArray[np.float64]
    """`(planes, V, 2, K)`: the last lasso code of every volume, from which the next is started, and its
    response, the Gram matrix times the code."""
    pooled: NDArray[np.int32]
    """`(planes, cells, F)`: fixed-point codes summed over each cell. `F` is Kp, or 2 Kp for SPLIT: sums of
    codes, then of their absolute values (the positive and negative parts are half the sum and difference). In
    the narrow state 2 Kp: sums of positive parts, then of negative ones."""
    partial: NDArray[np.int32]
    """`(N - 1, planes, cells, F)`: what other parts than the first add to `pooled`, until all are done; then
    zero."""
    cells: NDArray[np.int32]
    """`(V,)`: cell of each volume."""
    lines: NDArray[np.int32]
    """`(2, W + 1)`: scratch of the search for volumes that are not empty."""
    crowds: NDArray[np.int32]
    """`(H + 1, columns of the grid)`: scratch of the same, pixels that are not empty in each row of the ring
    between the sides of each volume."""
    dirty: NDArray[np.int32]
    """`(planes * V,)`: volumes to work on, by `plane * V + volume`; a stack."""
    load: NDArray[np.int32]
    """`(V + 1,)`: scratch, work on the volumes that have to enter a plane: on those
    before each on the dirty stack, in entries, and on all."""
    is_dirty: NDArray[np.uint8]
    """`(planes * V,)`: whether a volume is on that stack because entries of it changed."""
    code: NDArray[np.int32]
    """`(N, 2, Kp)`: scratch, fixed-point codes of one volume."""
    sums: NDArray[np.int32] | NDArray[np.int16]
    """`(N, Q + 1, Kp)`: scratch, sums of columns, as wide as projections are; the first row is that of a
    volume which does not wait."""
    queue: NDArray[np.int64]
    """`(N, Q, 3)`: volumes that wait to move together: where the column begins, where the projection does,
    and the gains before and after; narrow state."""
    queued: NDArray[np.int64]
    """`(N, 4)`: see the QUEUED_* slots; no volume waits between two calls."""
    work: NDArray[np.float64]
    """`(N, 5, Kp)`: scratch of the lasso."""
    active: NDArray[np.int64]
    """`(N, Kp)`: scratch of the lasso, indices of atoms."""
    corners: NDArray[np.float32]
    """`(N, K * Kp)`: scratch of the lasso, a part of the Gram matrix; in memory as far as used."""
    values: NDArray[np.int16]
    """`(N, 2, >= d)`: scratch, the entries of one volume and their changes; whole vectors of 64."""
    windows: NDArray[np.int16]
    """`(N, W, >= d)`: scratch, entries of the volumes that wait for the product (`dense`); `W` is zero where
    rows are shared, or there is a form."""
    awaiting: NDArray[np.int32]
    """`(N, W)`: scratch, the volumes that wait for it."""
    entries: NDArray[np.int32]
    """`(N, d + 1)`: scratch, the entries of one volume that change; the last is room for half a pair."""
    changes: NDArray[np.int16]
    """`(N, d + 1)`: scratch, by how much they change."""


CLOCK_NOW, CLOCK_START, CLOCK_TOUCHED, CLOCK_ORIGIN, CLOCK_PLANE, CLOCK_DIRTY, CLOCK_SLOT = range(7)
"""Current bin; when it began, in us; height of the touched stack; time of bin 0 in us; current plane; height
of the dirty stack; slot of the current bin."""

CURSOR_CODED, CURSOR_PROJECTED, CURSOR_ENTRY = range(3)
"""Volumes below the first have a code in the plane, those below the second a projection; of the volume at the
second, the entries below the third are in its projection."""

QUEUED_VOLUMES, QUEUED_PLANE, QUEUED_CELL, QUEUED_SIGN = range(4)
"""How many volumes wait; their plane; their cell; whether their columns are added (1) or subtracted (-1) as
they are, or were summed (0)."""

TALLY_EVENTS, TALLY_LATE, TALLY_REJECTED, TALLY_SATURATED, TALLY_ROLLS = range(5)
"""Accepted; older than the window; outside the sensor or malformed; no change of a clipped count; bins
moved on by."""

MOMENT_SUM, MOMENT_SQUARES, MOMENT_QUADRATIC, MOMENT_LINEAR = range(4)

MOST_CODE = 2**13 - 1
"""No code of the narrow state is larger, nor what it is before the threshold: so a projection times 2^shift
fits into 16 bits."""

BEFORE_TIME = -TIME_LIMIT
"""The current bin of an engine that has seen nothing, and when it began."""
