"""The same update in C, compiled here: what an engine could at best take.

Lives here: compiling `floor.c`, its state, and walks over the memory that an update cannot avoid.
Not here: which updates (`material`), and races (`direct`).
"""

import ctypes
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.kernels.layout import Operator

__all__ = ["BUILDS", "Floor", "Walks", "aligned", "compiler", "quadrants"]

BUILDS = {
    "C": ("-O3", "-march=native"),
    "C, 512-bit vectors": ("-O3", "-march=native", "-mprefer-vector-width=512"),
}
"""Compiler options to try, by name; `-ffp-contract=off` is added, for without it the bits would differ."""


def compiler() -> str | None:
    """The C compiler of this machine, or None."""
    return next(
        (path for name in (os.environ.get("CC"), "cc") if name and (path := shutil.which(name))), None
    )


def compile_floor(flags: tuple[str, ...]) -> ctypes.CDLL | None:
    """`floor.c` as a loaded library; None where there is no compiler, or it does not know the options."""
    program = compiler()
    if program is None:
        return None
    source = Path(__file__).with_name("floor.c")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "floor.so"
        command = [program, *flags, "-ffp-contract=off", "-shared", "-fPIC", "-o", target, source, "-lm"]
        if subprocess.run(command, capture_output=True, check=False).returncode:
            return None
        library = ctypes.CDLL(str(target))
    library.read_rows.restype = ctypes.c_uint64
    return library


class _State(ctypes.Structure):
    _fields_ = (
        ("width", ctypes.c_int64),
        ("entries", ctypes.c_int64),
        ("eps", ctypes.c_double),
        ("scale", ctypes.c_double),
        ("threshold", ctypes.c_float),
        *(
            (name, ctypes.c_void_p)
            for name in ("columns", "offset", "projections", "moments", "codes", "pooled")
        ),
    )


def aligned(array: NDArray[Any], stagger: int = 0) -> NDArray[Any]:
    """A copy whose first byte is `stagger` past a page: arrays of one address modulo 4096 slow each other."""
    room = np.empty(array.nbytes + 8192, np.uint8)
    start = -room.ctypes.data % 4096 + stagger
    copy = room[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


def quadrants(shape: tuple[int, int]) -> NDArray[np.int32]:
    """Quadrant of every volume of a grid."""
    rows, columns = (2 * np.arange(side) >= side for side in shape)
    return (2 * rows[:, None] + columns[None, :]).astype(np.int32).reshape(-1)


class Floor:
    """The state of all volumes in C; soft codes of the direct formulation.

    Args:
        library: compiled `floor.c`.
        operator: with the fixed point of the grid.
        volumes: `(V, d)` clipped counts to start from.
        shape: rows and columns of the grid of volumes.
        stored: keep the code of every volume, or compute the old one again from the old projection.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        operator: Operator,
        volumes: NDArray[np.int16],
        shape: tuple[int, int],
        *,
        stored: bool,
    ) -> None:
        self._library = library
        exact = volumes.astype(np.float64)  # products of such integers are exact in float64
        projections = (exact @ operator.columns.astype(np.float64)).astype(np.int32)
        moments = np.stack([volumes.sum(1, dtype=np.int64), np.square(exact).sum(1).astype(np.int64)], 1)
        codes = soft_codes(projections, moments, operator)
        self._quadrants = quadrants(shape)
        self.pooled = aligned(np.zeros((4, len(operator.offset)), np.int32), 1024)
        np.add.at(self.pooled, self._quadrants, codes)
        self._columns, self._offset = aligned(operator.columns), aligned(operator.offset, 512)
        self._projections, self._moments = aligned(projections, 1536), moments
        self._codes = aligned(codes, 2560) if stored else None
        self._state = _State(
            operator.columns.shape[1],
            operator.columns.shape[0],
            operator.eps,
            operator.scale * operator.unit,
            operator.threshold,
            *(
                array.ctypes.data if array is not None else None
                for array in (
                    self._columns,
                    self._offset,
                    self._projections,
                    self._moments,
                    self._codes,
                    self.pooled,
                )
            ),
        )

    def moves(self, rows: NDArray[np.int32]) -> Callable[[], object]:
        """A call that does all updates `(n, 4)` of volume, entry, count before and after."""
        columns = [np.ascontiguousarray(rows[:, i]) for i in range(4)] + [self._quadrants]
        arguments = [ctypes.c_void_p(column.ctypes.data) for column in columns]
        n, state, move_all = ctypes.c_int64(len(rows)), ctypes.byref(self._state), self._library.move_all

        def move() -> None:
            _ = self, columns  # held, for C only knows their addresses
            move_all(state, n, *arguments)

        return move


def soft_codes(
    projections: NDArray[np.int32], moments: NDArray[np.int64], operator: Operator
) -> NDArray[np.int32]:
    """Codes of whole volumes in fixed point, in the float32 arithmetic of the kernels."""
    entries = operator.columns.shape[0]
    mean = moments[:, 0] / entries
    sigma = np.sqrt(moments[:, 1] / entries - mean * mean + operator.eps)
    gain = (operator.scale * operator.unit / sigma).astype(np.float32)[:, None]
    z = projections.astype(np.float32) * gain - operator.offset
    threshold = np.float32(operator.threshold)
    codes = (z - np.clip(z, -threshold, threshold)).astype(np.int32)
    codes[moments[:, 1] == 0] = 0
    return codes


class Walks:
    """Reading or rewriting rows of memory in a given order, and nothing else."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library

    def over(self, array: NDArray[Any], order: NDArray[np.int32], *, write: bool) -> Callable[[], object]:
        """A call that walks over the rows of a copy of `array` in the order given."""
        memory, rows = aligned(array), np.ascontiguousarray(order, np.int32)
        function = self._library.change_rows if write else self._library.read_rows
        arguments = (
            ctypes.c_int64(len(rows)),
            ctypes.c_void_p(rows.ctypes.data),
            ctypes.c_int64(array.nbytes // len(array)),
            ctypes.c_void_p(memory.ctypes.data),
        )

        def walk() -> None:
            _ = memory, rows  # held, for C only knows their addresses
            function(*arguments)

        return walk
