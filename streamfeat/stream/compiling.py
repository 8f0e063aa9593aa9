"""Compiling the kernels of a session on two cores.

Lives here: `Compilers`, two processes that fill numba's cache, where whoever started them finds the kernels.
Not here: which kernels a session needs (`warming`), where machine code is kept (`kernels.cache`).

numba compiles one kernel at a time in a process, whatever its threads. Kernels fall into two halves of about
the same work: codes of a window, and following the counts. The second half needs the first at its end, and
waits for it.

Each process is a `python -m streamfeat.stream.compiling HALF STATE`: multiprocessing would run a program that
calls `sf.replay` once more. Of several commands that start at once one compiles, and the others wait for it.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np

from streamfeat.engine.encoder import Encoder, Formulation
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.operator import n_features, with_fixed_point
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.engine.state import allocate_state
from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.files.outputs import locked_file
from streamfeat.kernels import cache
from streamfeat.kernels.decode import place_events
from streamfeat.kernels.ingest import count_events
from streamfeat.kernels.update import mark_dirty, read, renew, settle
from streamfeat.work.interrupts import at_leaving

__all__ = ["STATES", "Compilers", "compile_together", "is_compiled", "state_of"]

STATES = "narrow", "wide", "lasso"
"""Kinds of state, which kernels are compiled for: of 16 bits, of 32, and of the inverse formulation."""

_TURN_S = 0.05
_PATIENCE_S = 300
"""After so long a command compiles by itself, and waits for no other: that one may be stopped."""

_FIRST, _ALONE = 0, 1


def state_of(encoder: Encoder) -> str:
    """The kind of state that engines of an encoder have, one of `STATES`."""
    if encoder.is_narrow:
        return "narrow"
    return "lasso" if encoder.operator.inverse else "wide"


def is_compiled(state: str) -> bool:
    """Whether the kernels of a kind of state are in the cache, or nothing can be kept there."""
    mark = _mark(state)
    return mark is None or mark.exists()


class Compilers:
    """Two processes that compile, or those of another command; a context manager, which ends its own.

    On a single core it is none: two would do parts of their work twice. They get no SIGINT from the terminal.

    Args:
        state: the kind to compile for, one of `STATES`.
    """

    def __init__(self, state: str) -> None:
        """Start them, if there is something to compile and no other command does."""
        self._state, self._until_s = state, time.monotonic() + _PATIENCE_S
        self._started: list[subprocess.Popen[bytes]] = []
        self._lock: BinaryIO | None = None
        self._others_compile = False
        self._begin()

    def _begin(self) -> None:
        mark = _mark(self._state)
        self._others_compile = False
        if mark is None or mark.exists() or _cores() < 2 or not sys.executable:
            return
        try:
            self._lock = locked_file(mark.with_suffix(".lock"))
        except InputError:
            self._others_compile = True
            return
        try:
            codes = self._start("codes", stdout=subprocess.PIPE)
            self._start("counts", stdin=codes.stdout)
            assert codes.stdout
            codes.stdout.close()  # the other process holds its end
        except OSError:  # no room for a process: kernels are compiled where they are needed
            self.close()
        except BaseException:
            self.close()
            raise

    def _start(self, half: str, stdin: object = None, stdout: object = None) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-P", "-m", __name__, half, self._state]
        path = os.pathsep.join(place for place in sys.path if place)
        started = subprocess.Popen(  # type: ignore[call-overload]
            command,
            stdin=stdin or subprocess.DEVNULL,
            stdout=stdout or subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": path},
            start_new_session=True,
        )
        self._started.append(started)
        at_leaving(started.kill)
        return started  # type: ignore[no-any-return]

    def __enter__(self) -> Self:
        """Give the object itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End both."""
        self.close()

    def is_alive(self) -> bool:
        """Whether one of them, or of those of another command, still compiles."""
        if self._others_compile:
            self._begin()
            self._others_compile &= time.monotonic() < self._until_s
        return self._others_compile or any(process.poll() is None for process in self._started)

    def wait(self, goes_on: Callable[[], bool] = lambda: True) -> None:
        """Wait until both are done, or something else is."""
        while self.is_alive() and goes_on():
            time.sleep(_TURN_S)

    def close(self) -> None:
        """End both."""
        for process in self._started:
            process.kill()
            process.wait()
        self._started.clear()
        self._others_compile = False
        if self._lock:
            self._lock.close()


def compile_together(state: str) -> None:
    """Fill the cache, in about two thirds of the time that one process takes; nothing where it is filled.

    Args:
        state: see `Compilers`.
    """
    with Compilers(state) as compilers:
        compilers.wait()
    mark = _mark(state)
    if mark and not mark.exists() and _cores() < 2:
        for half in ("codes", "counts"):
            _compile(half, state)
        mark.touch()


def _mark(state: str) -> Path | None:
    """The file that is there once the kernels of a state are; None where nothing can be kept."""
    folder = cache.folder() if hasattr(read, "py_func") else None  # it has none if numba is switched off
    return folder / f"compiled-{state}" if folder else None


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _compile(half: str, state: str, *, told: Callable[[], object] = lambda: None) -> None:
    """Compile one half; `told` is called where the second one needs what the first has compiled."""
    # Kernels are compiled for types, not for values.
    geometry = Geometry(patch=4, n_bins=1, bin_us=1_000)
    formulation: Formulation = "inverse" if state == "lasso" else "direct"
    encoder = random_encoder(0, geometry, 2, formulation, "split", narrow=state == "narrow")
    assert state_of(encoder) == state
    event, resolution = make_events([0], [0], [1], [0]), (4, 4)
    operator = with_fixed_point(encoder.operator, encoder.geometry.grid_shape(resolution))
    arrays = allocate_state(encoder.geometry, operator, resolution, origin_us=0, planes=1, threads=1)
    if half == "codes":
        encoder.encode(event, resolution)
        told()
        return
    count_events(event, operator, arrays)
    place_events(event, *resolution, 0, np.empty(1, np.int64), np.empty(2, np.int64))
    mark_dirty(operator, arrays)
    renew(_FIRST, _ALONE, operator, arrays)
    settle(arrays)
    told()
    read(operator, arrays, np.empty(n_features(encoder.operator), np.float32))


def _main(half: str, state: str) -> None:
    """One of the two processes: the first tells the second by the end of its output."""
    if half == "codes":
        _compile(half, state, told=lambda: os.close(sys.stdout.fileno()))
        return
    _compile(half, state, told=sys.stdin.buffer.read)
    mark = _mark(state)
    if mark:
        mark.touch()


if __name__ == "__main__":
    _main(*sys.argv[1:])
