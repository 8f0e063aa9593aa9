"""Making and checking the integers that an encoder applies online.

Lives here: from learned floats to a `kernels.layout.Operator`, the arithmetic that proves that nothing can
overflow, and the fixed point that codes are pooled in.
Not here: files (`encoder`), and what changes as events come (`state`).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.geometry import Geometry
from streamfeat.engine.narrow import check_narrow, narrow_columns, with_narrow_codes
from streamfeat.errors import InputError
from streamfeat.kernels.layout import FEATURE_ENCODINGS, LANES, SPLIT, TRIANGLE, Operator

__all__ = ["aligned_zeros", "check_operator", "fixed_fields", "n_features", "quantise", "with_fixed_point"]

CACHE_LINE = 64

_INT16, _INT32 = 2**15 - 1, 2**31 - 1

MOST_BITS, FEWEST_BITS = 16, 8
"""Codes are pooled as multiples of `2**-bits`; as fine as the sensor's number of volumes lets them be."""


def fixed_fields(
    geometry: Geometry, formulation: str, encoding: str, threshold: float, filters: NDArray[np.float32]
) -> dict[str, Any]:
    """The fields of an operator that follow exactly from the parameters."""
    kind = FEATURE_ENCODINGS[encoding]
    inverse = formulation == "inverse" and kind != TRIANGLE
    atoms = filters.astype(np.float64)
    return {
        "patch": geometry.sides,
        "stride": geometry.stride,
        "downsample": geometry.downsample,
        "bin_us": geometry.bin_us,
        "max_count": geometry.max_count,
        "pooling": geometry.pooling,
        "n_filters": filters.shape[0],
        "kind": kind,
        "inverse": inverse,
        "unit": 1.0,
        "largest": math.inf,
        "threshold": float(np.float32(threshold)),
        "packed": np.zeros((0, 0, 0), np.int16),
        "gram": (atoms @ atoms.T).astype(np.float32) if inverse else np.zeros((0, 0), np.float32),
    }


def quantise(
    geometry: Geometry,
    fixed: dict[str, Any],
    filters: NDArray[np.float32],
    whitening: NDArray[np.float32],
    mean: NDArray[np.float32],
    eps: float,
    gap: float,
    *,
    narrow: bool = False,
) -> Operator:
    """Fold whitening and mean removal into one matrix of int16.

    There is one scale for all filters; in the narrow state one for each.

    Args:
        geometry: of the local volumes, `d` entries each.
        fixed: as `fixed_fields` gives them.
        filters: `(K, d)`.
        whitening: `(d, d)`.
        mean: `(d,)`.
        eps: added to the variance of a volume.
        gap: relative duality gap of the lasso.
        narrow: for the narrow state.

    Raises:
        InputError: not for the narrow state, with the arithmetic.
    """
    k, d = filters.shape
    padded = -(-k // LANES) * LANES
    white = whitening.astype(np.float64)
    projector = filters.astype(np.float64) @ white
    offset = projector @ mean
    # Mean removal: P (I - 1 1'/d).
    projector -= projector.mean(axis=1, keepdims=True)
    scale, steps = float(np.abs(projector).max()) / _INT16 or 1.0, None
    columns = np.zeros((d, padded), np.int16)
    columns[:, :k] = np.rint(projector.T / scale)
    if narrow:
        if fixed["inverse"] or fixed["kind"] == TRIANGLE:
            raise InputError("codes of the inverse formulation and of the triangle encoding need 32 bits")
        scale = 1.0
        columns, steps = narrow_columns(geometry, projector, padded)
    padded_offset = np.zeros(padded, np.float32)
    padded_offset[:k] = offset
    square_norms = np.zeros(padded, np.float32)
    square_norms[:k] = np.square(filters.astype(np.float64)).sum(axis=1)
    quadratic, linear = np.zeros((0, 0), np.int32), np.zeros(0, np.int32)
    quadratic_scale = linear_scale = 1.0
    reach = 0.0
    if fixed["inverse"] or fixed["kind"] == TRIANGLE:
        centred = white - white.mean(axis=1, keepdims=True)
        form = centred.T @ centred
        form = (form + form.T) / 2
        row = (white @ mean) @ centred
        # The largest scale at which neither an entry nor any sum of them can overflow.
        sum_of_form = float(np.abs(form).sum()) * geometry.max_count**2
        quadratic_scale = max(float(np.abs(form).max()) / _INT32, sum_of_form / 2.0**61, 1e-30)
        linear_scale = max(float(np.abs(row).max()) / _INT32, 1e-30)
        quadratic = np.rint(form / quadratic_scale).astype(np.int32)
        linear = np.rint(row / linear_scale).astype(np.int32)
        # |x| <= |W (I - 1 1'/d)| |v_hat| + |W mu|, and |v_hat| <= sqrt(d).
        stretch = math.sqrt(max(float(np.linalg.eigvalsh(form)[-1]), 0.0))
        reach = stretch * math.sqrt(d) + float(np.linalg.norm(white @ mean))
    return Operator(
        **fixed,
        columns=columns,
        scale=scale,
        eps=float(eps),
        offset=padded_offset,
        quadratic=quadratic,
        quadratic_scale=quadratic_scale,
        linear=linear,
        linear_scale=linear_scale,
        constant=float(np.square(white @ mean).sum()),
        reach=reach,
        square_norms=square_norms,
        gap=float(gap),
        steps=steps,
    )


def aligned_zeros(shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """Zeros that begin with a line of the cache: a vector across two lines takes twice as long to load."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    room = np.zeros(size + CACHE_LINE, np.uint8)
    start = -room.ctypes.data % CACHE_LINE
    array: NDArray[Any] = room[start : start + size].view(dtype).reshape(shape)
    return array


def check_operator(geometry: Geometry, operator: Operator) -> Operator:
    """Refuse an operator whose arrays do not fit, or whose integers could overflow.

    Returns:
        the operator, with `largest` filled in, and the kind of state that it needs.

    Raises:
        InputError: with the arithmetic.
    """
    d, padded = geometry.entries, -(-operator.n_filters // LANES) * LANES
    form = (d, d) if operator.inverse or operator.kind == TRIANGLE else (0, 0)
    expected: dict[str, tuple[type, tuple[int, ...]]] = {
        "columns": (np.int16, (d, padded)),
        "offset": (np.float32, (padded,)),
        "square_norms": (np.float32, (padded,)),
        "quadratic": (np.int32, form),
        "linear": (np.int32, form[:1]),
    }
    for name, (dtype, shape) in expected.items():
        array = getattr(operator, name)
        if array.dtype != dtype or array.shape != shape:
            raise InputError(f"{name} is {array.dtype} {array.shape}, expected {np.dtype(dtype)} {shape}")
    if not (0 < operator.eps < math.inf and operator.scale > 0 and 0 < operator.gap < 1):
        raise InputError("eps, scale and gap must be finite and above zero, and gap below one")
    if (operator.columns < -_INT16).any():
        raise InputError(f"columns must lie between {-_INT16} and {_INT16}, so that all can be negated")
    if operator.columns[:, operator.n_filters :].any():
        raise InputError(f"columns holds more filters than {operator.n_filters}")
    if not (np.isfinite(operator.offset).all() and np.isfinite(operator.square_norms).all()):
        raise InputError("offset and square_norms must be finite")
    if form[0]:
        _check_form(geometry, operator)
    if operator.steps is not None:
        if form[0]:
            raise InputError("only soft codes of the direct formulation have a narrow state")
        check_narrow(geometry, operator)
    magnitude = np.abs(operator.columns.astype(np.int64))
    sums = geometry.max_count * int(magnitude.sum(axis=0).max())
    if sums > _INT32:
        raise InputError(
            f"geometry: a projection could reach max_count {geometry.max_count} x "
            f"{sums // geometry.max_count} (the largest sum of a quantised filter) = {sums}, "
            "which is not below 2^31; lower max_count"
        )
    columns = aligned_zeros(operator.columns.shape, np.int16)
    columns[:] = operator.columns
    packed = operator.packed if form[0] else _in_pairs(columns)
    checked = operator._replace(columns=columns, packed=packed, wide=None)
    if operator.steps is not None:
        return checked
    lasso, wide = (True, None) if operator.inverse else (None, True)
    checked = checked._replace(largest=_largest_code(checked), lasso=lasso, wide=wide)
    _fixed_point_bits(checked, 1)
    return checked


def _in_pairs(columns: NDArray[np.int16]) -> NDArray[np.int16]:
    """Columns `(d, Kp)` as `Operator.packed` holds them; a column of zeros is added to an odd number."""
    (d, width), pairs = columns.shape, -(-len(columns) // 2)
    padded = np.zeros((2 * pairs, width), np.int16)
    padded[:d] = columns
    packed = aligned_zeros((width // LANES, pairs, 2 * LANES), np.int16)
    packed.reshape(-1, pairs, LANES, 2)[:] = padded.reshape(pairs, 2, -1, LANES).transpose(2, 0, 3, 1)
    return packed


def _check_form(geometry: Geometry, operator: Operator) -> None:
    """Refuse a quadratic or linear form that could overflow."""
    total = np.abs(operator.quadratic.astype(np.float64)).sum() * geometry.max_count**2
    if total >= 2.0**62 or not np.array_equal(operator.quadratic, operator.quadratic.T):
        raise InputError(f"quadratic must be symmetric and sum to less than 2^62, it sums to {total:.4g}")
    if not (operator.quadratic_scale > 0 and operator.linear_scale > 0 and operator.constant >= 0):
        raise InputError("the scales and the constant of the quadratic form must not be negative")
    if not 0 < operator.reach < math.inf:
        raise InputError(f"reach is {operator.reach}, it must be finite and above zero")


def _largest_code(operator: Operator) -> float:
    d = operator.columns.shape[0]
    norms = np.sqrt(np.square(operator.columns.astype(np.float64)).sum(axis=0)) * operator.scale
    # Rounding leaves a trace of the mean in each filter; it weighs most in a volume that is nearly constant.
    leak = np.abs(operator.columns.sum(axis=0, dtype=np.int64)) * operator.scale
    z = float(
        norms.max() * math.sqrt(d)
        + leak.max() * operator.max_count / math.sqrt(operator.eps)
        + np.abs(operator.offset).max()
    )
    if operator.inverse:
        # At the solution lambda |l|_1 <= 1/2 |x|^2.
        return max(z, operator.reach**2 / (2 * operator.threshold))
    if operator.kind == TRIANGLE:
        return max(z, math.sqrt(operator.reach**2 + 2 * z + float(operator.square_norms.max())))
    return z


def with_fixed_point(operator: Operator, grid_shape: tuple[int, int], times: int = 1) -> Operator:
    """The operator of one sensor: its grid, and codes in units of the finest fixed point that it allows.

    Args:
        operator: in units of one.
        grid_shape: rows and columns of volumes; those of one cell share a sum.
        times: volumes at each place, one behind the other in time; they share a sum, too.

    Raises:
        InputError: the pooled sums could overflow whatever the fixed point.
    """
    rows, columns = grid_shape
    volumes = -(-rows // operator.pooling) * -(-columns // operator.pooling) * times
    if operator.steps is not None:
        return with_narrow_codes(operator, volumes)._replace(shape=grid_shape)
    unit = 2.0 ** _fixed_point_bits(operator, volumes)
    offset = operator.offset * np.float32(unit)
    offset.flags.writeable = False
    return operator._replace(unit=unit, offset=offset, threshold=operator.threshold * unit, shape=grid_shape)


def n_features(operator: Operator) -> int:
    """Length of the feature vector: `pooling^2` cells of `K` codes, or of `2 K` for `split`."""
    return operator.pooling**2 * operator.n_filters * (2 if operator.kind == SPLIT else 1)


def _fixed_point_bits(operator: Operator, volumes: int) -> int:
    room = _INT32 / (max(operator.largest, 1.0) * volumes)
    bits = math.floor(math.log2(room)) if room > 0 else -1
    if not bits >= FEWEST_BITS:
        raise InputError(
            f"a pooled code could reach {operator.largest:.4g} x {volumes} volumes of a cell, which "
            f"leaves {bits} bits behind the point of an int32, {FEWEST_BITS} are needed; raise the stride, "
            "the downsample, the threshold or eps_zca"
        )
    return min(bits, MOST_BITS)
