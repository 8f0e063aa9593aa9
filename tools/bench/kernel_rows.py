"""Every compiled kernel against its slow twin, from the table that the tests use.

Lives here: the part `kernels`. Not here: the table (`tests/kernel_table.py`).

The arguments are the tests' own, small and random, so a kernel that does little shows what calling it from
Python costs, some 10 microseconds for one that takes an operator and a state.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np

from tools.bench.material import Setting
from tools.bench.timing import Contestant, race

__all__ = ["measure_kernels"]


def measure_kernels(setting: Setting) -> dict[str, Any]:
    """Median nanoseconds a call of each kernel and its twin, and their ratio."""
    sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
    from kernel_table import KERNELS, copied

    figures = {}
    setting.say(f"{len(KERNELS)} kernels")
    for row in KERNELS:
        originals = [row.make(np.random.default_rng([seed, 7])) for seed in range(1 if setting.quick else 4)]
        contestants = {
            name: _repeated(function, originals, copied, repeats)
            for name, function, repeats in (("kernel", row.call, 5), ("twin", row.twin, 1))
        }
        result = race(contestants, setting.rounds(5))
        figures[row.name] = {
            "kernel_ns": result.figure("kernel")["p50"],
            "twin_ns": result.figure("twin")["p50"],
            "twin_over_kernel": result.ratio("twin", "kernel")["p50"],
        }
    return figures


def _repeated(function: Any, originals: list[Any], copied: Any, repeats: int) -> Contestant:
    """Calls with fresh copies of the same arguments, made when nobody looks at the clock."""
    ready: list[Any] = []

    def prepare() -> None:
        ready[:] = [tuple(copied(a) for a in arguments) for arguments in originals for _ in range(repeats)]

    def call() -> None:
        for arguments in ready:
            function(*arguments)

    prepare()
    return Contestant(call, len(ready), prepare)
