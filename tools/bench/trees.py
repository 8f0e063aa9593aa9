"""Two versions of this project, each in a process of its own, that do the same tasks by turns.

Lives here: starting them, asking them, medians and ratios of one round.
Not here: the tasks (`tree_worker`), what is asked for (`goals`, `profile`).
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tools.bench.timing import summary

__all__ = ["ROOT", "Pair", "Tree", "TreeError", "compared", "pair"]

ROOT = Path(__file__).resolve().parents[2]


class TreeError(Exception):
    """A version could not do a task."""


class Tree:
    """One version: a checkout with a `.venv` of its own, or one that this interpreter can run.

    What LLVM makes of a kernel depends on those that were compiled before it: a cache that tests had filled
    was seen to be a third slower than one that a command had.

    Args:
        root: of the checkout.
        anew: compile its kernels anew, as a command does; else take what its cache holds.
    """

    def __init__(self, root: Path, *, anew: bool = False) -> None:
        """Start its process."""
        own = root / ".venv" / "bin" / "python"
        self._opened = contextlib.ExitStack()
        environment = os.environ | {"PYTHONPATH": str(root), "OPENBLAS_NUM_THREADS": "1"}
        if anew:
            folder = tempfile.TemporaryDirectory(prefix="streamfeat-kernels-")
            environment["NUMBA_CACHE_DIR"] = self._opened.enter_context(folder)
        self._process = subprocess.Popen(
            [
                str(own) if own.exists() else sys.executable,
                "-P",
                str(Path(__file__).with_name("tree_worker.py")),
                *["compile"][:anew],
            ],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def do(self, **task: Any) -> dict[str, Any]:
        """Have a task done; a path or a number for each of its fields.

        Raises:
            TreeError: the version cannot do it; with the reason.
        """
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.write(json.dumps(task, default=str) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise TreeError(f"the process ended with status {self._process.wait()}")
        result: dict[str, Any] = json.loads(line)
        if "error" in result:
            raise TreeError(result["error"])
        return result

    def close(self) -> None:
        """End its process."""
        self._process.communicate()
        self._opened.close()


@dataclass(frozen=True)
class Pair:
    """What one task took in two versions, round by round, seconds.

    Attributes:
        before: `(rounds,)` of the earlier version.
        now: `(rounds,)` of this one.
    """

    before: Any
    now: Any

    @property
    def ratio(self) -> dict[str, float]:
        """How many times as fast this version is: median, 10th and 90th percentile of rounds."""
        return summary(self.before / self.now)


def compared(
    trees: dict[str, Tree], rounds: int, tasks: dict[str, dict[str, Any]]
) -> dict[str, list[dict[str, Any]]]:
    """Results of a task for each version, in rounds whose order turns; one more before is not counted."""
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in tasks}
    for i in range(rounds + 1):
        for name in sorted(tasks, reverse=bool(i % 2)):
            result = trees[name.partition(",")[0]].do(**tasks[name])
            if i:
                found[name].append(result)
    return found


def pair(found: dict[str, list[dict[str, Any]]], what: str, before: str = "before", now: str = "now") -> Pair:
    """The figures `what`, such as `features.processor`, of two of the versions."""
    return Pair(*(np.array([_at(result, what) for result in found[name]]) for name in (before, now)))


def _at(result: dict[str, Any], what: str) -> float:
    value: Any = result
    for key in what.split("."):
        value = value.get(key, 0.0)
    return float(value)
