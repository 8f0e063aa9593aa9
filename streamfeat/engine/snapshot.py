"""The state of an engine as plain arrays and numbers.

Lives here: `Snapshot`, and the check that one fits an engine.
Not here: taking one and going on from it (`engine`), its place in a file (`live.checkpoint`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.kernels.lasso import CODE
from streamfeat.kernels.layout import BEFORE_TIME, Operator, State

__all__ = ["Snapshot", "check_further", "check_snapshot", "checked_time"]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """All that an engine needs to go on as if nothing had happened.

    Attributes:
        fingerprint: of the encoder.
        counts: `(T, H, W)` int32, the ring; bin `b` lives in slot `b % T`.
        atoms: `(V, K)` float64, lasso codes to start from (inverse formulation; else `(V, 0)`).
        bin: the current one; `BEFORE_TIME` in an engine that has seen nothing.
        origin_us: stream time at which bin 0 starts.
        tally: `(5,)` int64, what was counted.
        encoded: `(2,)` int64, their sum is how many volumes were encoded.
        further: of the further scales.
    """

    fingerprint: str
    counts: NDArray[np.int32]
    atoms: NDArray[np.float64]
    bin: int
    origin_us: int
    tally: NDArray[np.int64]
    encoded: NDArray[np.int64]
    further: tuple["Snapshot", ...] = ()


def checked_time(t_us: int) -> int:
    """A stream time that kernels can calculate with.

    Raises:
        InputError: it is beyond 2^62 microseconds.
    """
    if not BEFORE_TIME < t_us < -BEFORE_TIME:
        raise InputError(f"a time of {t_us} us is beyond 2^62")
    return int(t_us)


def check_snapshot(
    snapshot: Snapshot, fingerprint: str, operator: Operator, state: State, counts: NDArray[np.int32]
) -> None:
    """Check that an engine can go on from a snapshot; it may come from anywhere.

    Args:
        snapshot: any arrays and numbers.
        fingerprint: of the engine's encoder.
        operator: of the engine.
        state: of the engine, not changed.
        counts: of the engine's whole window, not changed.

    Raises:
        InputError: the snapshot is of another encoder or another resolution, or of no engine at all.
    """
    if snapshot.fingerprint != fingerprint:
        raise InputError(
            f"the snapshot is of encoder {snapshot.fingerprint[:12]}, this engine has {fingerprint[:12]}"
        )
    encoded = np.zeros(2, np.int64)
    mine: tuple[NDArray[Any], ...] = (counts, state.atoms[0, :, CODE], state.tally, encoded)
    for name, array in zip(("counts", "atoms", "tally", "encoded"), mine, strict=True):
        given = getattr(snapshot, name)
        if given.dtype != array.dtype or given.shape != array.shape:
            raise InputError(
                f"the snapshot holds {name} of {given.dtype} {given.shape}, this engine has "
                f"{array.dtype} {array.shape}"
            )
    # No solution exceeds half of it; one within the gap may, by a little.
    if not (np.abs(snapshot.atoms) <= 2 * operator.largest).all():
        raise InputError("the snapshot: an entry of a code is no number, or too large")
    if min(snapshot.tally.min(), snapshot.encoded.min()) < 0:
        raise InputError("the snapshot: something was counted less than zero times")
    checked_time(snapshot.origin_us)
    if snapshot.bin != BEFORE_TIME:
        checked_time(snapshot.origin_us + snapshot.bin * operator.bin_us)


def check_further(snapshot: Snapshot, n: int) -> None:
    """Check that the further scales of a snapshot are as many, and at the same time, as the first.

    Raises:
        InputError: they are not.
    """
    if len(snapshot.further) != n:
        raise InputError(f"the snapshot has {len(snapshot.further)} further scales, this engine has {n}")
    for further in snapshot.further:
        if (further.bin, further.origin_us) != (snapshot.bin, snapshot.origin_us):
            raise InputError("the snapshot: its scales are at different times")
