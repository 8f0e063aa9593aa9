"""Making and checking the integers of the narrow state: projections and codes of 16 bits.

Lives here: a step for each filter such that no sum can overflow, and the fixed point of codes of 16 bits.
Not here: the wide state (`operator`), and what kernels do with the integers (`kernels.narrow`).
"""

import math

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.geometry import Geometry
from streamfeat.errors import InputError
from streamfeat.kernels.layout import MOST_CODE, Operator

__all__ = ["check_narrow", "narrow_columns", "with_narrow_codes"]

_INT16, _INT32 = 2**15 - 1, 2**31 - 1

COARSEST = 2e-4
"""Standard deviation of a code's error that is allowed, relative to the largest that a code can be. Codes of
real volumes have to be within 2e-3 of the largest of them: at 1.7e-4 (432 entries of N-CARS) they are off by
1.1e-3, at 2.4e-4 (1,008 entries) by 3.6e-3."""

FEWEST_CODES = 1 << 8
"""The largest code has at least so many units."""


def narrow_columns(
    geometry: Geometry, projector: NDArray[np.float64], padded: int
) -> tuple[NDArray[np.int16], NDArray[np.float64]]:
    """Quantise a projector with a step for each filter, so that a projection fits into 16 bits.

    A step is such that `max_count` times the sum of a filter's integers stays below 2^15 after rounding; and
    that the codes of a filter of few large entries are at most twice as long as those of a flat one, for all
    codes share a gain.

    Args:
        geometry: of the local volumes, `d` entries each.
        projector: `(K, d)`, mean removal folded in.
        padded: filters after padding.

    Returns:
        columns `(d, Kp)` and steps `(Kp,)`.

    Raises:
        InputError: the integers would be too coarse, with the arithmetic.
    """
    k, d = projector.shape
    most, room = geometry.max_count, _INT16 - geometry.max_count * d / 2
    sums, lengths = np.abs(projector).sum(axis=1), np.sqrt(np.square(projector).sum(axis=1) * d)
    steps = np.ones(padded)
    if room > 0:
        steps[:k] = np.maximum(sums / room, lengths / (2 * room)) * most
        steps[steps == 0] = 1.0
    # A number that is rounded is off by 1/sqrt(12) of a step: entries, of which `d` are added, and a code and
    # its bound, whose units are up to 8 steps.
    error = steps[:k].max() * math.sqrt(d / 12 + 8**2 / (6 * most**2))
    largest = lengths.max() or 1.0
    if room <= 0 or error > COARSEST * largest:
        raise InputError(
            f"a sum of {d} entries of up to {most} in 16 bits leaves {max(room, 0) / (most * d):.1f} levels "
            f"for an entry of a filter: codes would be off by {error / largest:.1e} of the largest, "
            f"{COARSEST:.0e} is allowed"
        )
    columns = np.zeros((d, padded), np.int16)
    columns[:, :k] = np.rint(projector.T / steps[:k])
    return columns, steps


def check_narrow(geometry: Geometry, operator: Operator) -> None:
    """Refuse steps that are none, and sums that could overflow 16 bits.

    Raises:
        InputError: with the arithmetic.
    """
    steps, padded = operator.steps, operator.columns.shape[1]
    assert steps is not None
    if steps.dtype != np.float64 or steps.shape != (padded,):
        raise InputError(f"steps is {steps.dtype} {steps.shape}, expected float64 ({padded},)")
    if not ((steps > 0).all() and np.isfinite(steps).all()):
        raise InputError("steps must be finite and above zero")
    sums = geometry.max_count * int(np.abs(operator.columns.astype(np.int64)).sum(axis=0).max())
    if sums > _INT16:
        raise InputError(
            f"a projection of the narrow state could reach max_count {geometry.max_count} x "
            f"{sums // geometry.max_count} (the largest sum of a quantised filter) = {sums}, which is not "
            "below 2^15"
        )
    with_narrow_codes(operator, 1)


def largest_code(operator: Operator) -> float:
    """What no code exceeds, in units of the step of its filter; before the threshold.

    With `v = (v - m) + m`: `|Q v| <= |Q| |v - m| + |sum Q| |m|`, and sigma is at least `|v - m| / sqrt(d)`
    and at least the square root of eps. No float is summed, so that every processor finds the same.
    """
    columns, steps = operator.columns.astype(np.int64), operator.steps
    assert steps is not None
    lengths = np.sqrt(np.square(columns).sum(axis=0) * len(columns))
    leak = np.abs(columns.sum(axis=0)) * (operator.max_count / math.sqrt(operator.eps))
    return float((lengths + leak + np.abs(operator.offset / steps)).max())


def with_narrow_codes(operator: Operator, volumes: int) -> Operator:
    """The operator of one sensor, with codes as fine as 16 bits let them be, and their sums 32 bits.

    Args:
        operator: of an encoder in the narrow state.
        volumes: that share a sum at most.

    Raises:
        InputError: the pooled sums could overflow.
    """
    largest, most = largest_code(operator), min(MOST_CODE, _INT32 // volumes)
    if most < FEWEST_CODES:
        raise InputError(
            f"the {volumes} codes of a cell would have at most {most} units each so that an int32 holds "
            f"their sum, {FEWEST_CODES} are needed; raise the stride or the downsample"
        )
    gain = (most - 2) / max(largest, 1.0)
    assert operator.steps is not None
    units = gain / operator.steps
    # A product is rounded down, by half a unit in the mean.
    upper, lower = (
        np.rint((operator.offset + sign * operator.threshold) * units - 0.5) + 2**15 for sign in (1, -1)
    )
    steps = operator.steps / gain
    bounds = [bound.clip(0, 2**16 - 1).astype(np.uint16) for bound in (upper, lower)]
    for bound in bounds:
        bound.flags.writeable = False
    steps.flags.writeable = False
    return operator._replace(gain=gain, steps=steps, upper=bounds[0], lower=bounds[1])
