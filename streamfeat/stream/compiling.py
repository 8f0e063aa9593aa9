"""Compiling the kernels of a session on two cores.

Lives here: `Compilers`, two processes that fill numba's cache, where whoever started them finds the kernels.
Not here: which kernels a session needs (`warming`), where machine code is kept (`kernels.cache`).

numba compiles one kernel at a time in a process, whatever its threads. Kernels fall into two halves of about
the same work: codes of a window, and following the counts. The second half needs the first at its end, and
waits for it.

Each process is a `python -m streamfeat.stream.compiling HALF`: multiprocessing would run a program that calls
`sf.replay` once more.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from streamfeat.engine.geometry import Geometry
from streamfeat.engine.operator import n_features, with_fixed_point
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.engine.state import allocate_state
from streamfeat.events import make_events
from streamfeat.kernels import cache
from streamfeat.kernels.ingest import count_events
from streamfeat.kernels.planes import look_ahead
from streamfeat.kernels.update import mark_dirty, read, renew, settle

__all__ = ["Compilers", "compile_together", "is_compiled"]

_TURN_S = 0.05
_FIRST, _ALONE = 0, 1


def is_compiled() -> bool:
    """Whether the last kernel that the halves compile is in the cache, or nothing can be kept there."""
    source, folder = getattr(read, "py_func", None), cache.folder()
    if source is None or folder is None:  # numba is switched off, or all folders are read-only
        return True
    name = f"{Path(source.__code__.co_filename).stem}.{source.__name__}-*.nbi"
    return any(folder.glob(name))


class Compilers:
    """Two processes that compile; a context manager, which ends them.

    On a single core it is none: two would do parts of their work twice. They get no SIGINT from the terminal.
    """

    def __init__(self) -> None:
        """Start them, if there is something to compile."""
        self._started: list[subprocess.Popen[bytes]] = []
        if is_compiled() or _cores() < 2 or not sys.executable:
            return
        try:
            codes = self._start("codes", stdout=subprocess.PIPE)
            self._start("counts", stdin=codes.stdout)
            assert codes.stdout
            codes.stdout.close()  # the other process holds its end
        except OSError:  # no room for a process: kernels are compiled where they are needed
            self.close()

    def _start(self, half: str, stdin: object = None, stdout: object = None) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-P", "-m", __name__, half]
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
        """Whether one of them still compiles."""
        return any(process.poll() is None for process in self._started)

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


def compile_together() -> None:
    """Fill the cache, in about two thirds of the time that one process takes; nothing where it is filled."""
    with Compilers() as compilers:
        compilers.wait()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _compile(half: str) -> None:
    """Compile one half."""
    # Kernels are compiled for types, not for values.
    encoder = random_encoder(0, Geometry(patch=4, n_bins=1, bin_us=1_000), 2, encoding="split")
    event, resolution = make_events([0], [0], [1], [0]), (4, 4)
    operator = with_fixed_point(encoder.operator, encoder.geometry.grid_shape(resolution))
    state = allocate_state(encoder.geometry, operator, resolution, origin_us=0, planes=1, threads=1)
    if half == "codes":
        encoder.encode(event, resolution)
        os.close(sys.stdout.fileno())  # tells the other process
        look_ahead(0, 0, 0, operator, state)
        return
    count_events(event, operator, state)
    mark_dirty(operator, state)
    renew(_FIRST, _ALONE, operator, state)
    settle(state)
    sys.stdin.buffer.read()  # what codes are made with is in the cache, or the other process is gone
    read(operator, state, np.empty(n_features(encoder.operator), np.float32))


if __name__ == "__main__":
    _compile(sys.argv[1])
