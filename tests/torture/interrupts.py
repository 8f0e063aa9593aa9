"""SIGINT, SIGTERM and SIGHUP in every phase of every command, and how long until it is heard.

Lives here: the commands, the phase that each is caught in, and what must hold.
Not here: signals of commands that were imported before (`faults`).
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torture.nursery import free_port
from torture.sources import MODEL, ROOT, TRAIN, folder_of_samples
from torture.table import Row, Trials

__all__ = ["interrupts"]

_TIMES = 20
_HEARD_S = 1.0
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_ENDS = {0, 130}
_NEVER = 10**9
_SOLVE = ["--patch", 8, "--filters", 200, "--volumes", 8000, "--iterations", _NEVER, "--preset", "default"]


@dataclass(frozen=True)
class _Phase:
    """A command, and when to interrupt it.

    Attributes:
        name: of the phase.
        words: of the command; `OUT` stands for its output, `CAMERA` for a port.
        moments_s: from the start of the process, the first and the last.
        keeps: the names of files that may be there afterwards.
        is_cold: it finds no compiled kernels.
    """

    name: str
    words: Sequence[object]
    moments_s: tuple[float, float]
    keeps: frozenset[str] = frozenset({"out"})
    is_cold: bool = False


def interrupts(trials: Trials) -> list[Row]:
    """A row for each phase."""
    samples = trials.folder / "samples"
    folder_of_samples(samples, 400, trials.seed)
    return [_row(trials, phase) for phase in _phases(samples)]


def _phases(samples: Path) -> list[_Phase]:
    replay = ["replay", TRAIN, "-m", MODEL, "--speed", 0.1, "--emit", "1000ev", "-q", "-o", "OUT"]
    listen = ["listen", "cam/events", "-m", MODEL, "--port", "PORT", "-q", "-o", "OUT", "--json"]
    return [
        _Phase("imports", ["replay", TRAIN, "-m", MODEL, "-o", "OUT"], (0.1, 0.6)),
        _Phase("compiling", ["replay", TRAIN, "-m", MODEL, "-o", "OUT"], (1, 25), is_cold=True),
        _Phase("compiling alone", ["doctor"], (1, 25), is_cold=True),
        _Phase("learn", ["learn", TRAIN, "-o", "OUT", *_SOLVE], (1, 12), frozenset({"out", "out.part"})),
        _Phase(
            "learn, inverse",
            ["learn", TRAIN, "-o", "OUT", *_SOLVE, "--formulation", "inverse"],
            (1, 12),
            frozenset({"out", "out.part"}),
        ),
        _Phase("train", ["train", TRAIN, "-m", MODEL, "-o", "OUT", "--kernel", "rbf"], (1, 8)),
        _Phase(
            "evaluate",
            ["evaluate", TRAIN, "-o", "OUT", "--folds", 3, *_SOLVE, "-q"],
            (1, 10),
            frozenset({"out", "out.part", "out.state"}),
        ),
        _Phase("convert", ["convert", samples, "OUT"], (0.5, 2)),
        _Phase("latency", ["latency", TRAIN, "-m", MODEL, "--seconds", 60, "-q"], (1, 8)),
        _Phase("replay", replay, (1, 6)),
        _Phase("listen", listen, (1, 6), frozenset({"out", "out.part"})),
        _Phase(
            "record",
            ["record", "cam/events", "-o", "OUT", "--port", "PORT"],
            (1, 4),
            frozenset({"out", "out.part"}),
        ),
        _Phase("view", ["view", TRAIN, "-m", MODEL, "--web-port", 0, "--no-open"], (1, 6)),
        _Phase("topics", ["topics", "--port", "PORT", "--seconds", 60], (0.6, 3)),
        _Phase("demo", ["demo", "--folder", "OUT"], (1, 20)),
    ]


def _row(trials: Trials, phase: _Phase) -> Row:
    began, rng = time.monotonic(), np.random.default_rng(trials.seed)
    failures, took = [], []
    n = trials.times(_TIMES, least=1)
    for i in range(n):
        number = _SIGNALS[i % 3]
        delay = float(rng.uniform(*phase.moments_s))
        problem, seconds = _interrupted(trials.folder / "run", phase, number, delay)
        took.append(seconds)
        if problem:
            failures.append(f"{number.name} after {delay:.2f} s: {problem}")
    worst = f"ended within {np.median(took):.2f} s at the median, {max(took):.2f} s at most"
    trials.say(f"{phase.name}: {n}, {worst}")
    for failure in failures:
        trials.say(f"    {failure}")
    name = f"interrupt: {phase.name}"
    return Row(
        name, n, n - len(failures), seconds=time.monotonic() - began, note=worst, failures=tuple(failures)
    )


def _interrupted(folder: Path, phase: _Phase, number: int, delay: float) -> tuple[str, float]:
    """What is wrong, or '', and the seconds from the signal to the end."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "out").mkdir(parents=True)
    stand_for = {"OUT": folder / "out" / "out", "PORT": free_port()}
    words = [str(stand_for.get(word, word) if isinstance(word, str) else word) for word in phase.words]
    env = os.environ | {"PYTHONPATH": str(ROOT), "NO_COLOR": "1", "OPENBLAS_NUM_THREADS": "1"}
    if phase.is_cold:
        env["NUMBA_CACHE_DIR"] = str(folder / "cache")
    log = folder / "log"
    with log.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "streamfeat", *words],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=env,
            start_new_session=True,
        )
        time.sleep(delay)
        process.send_signal(number)
        sent = time.monotonic()
        try:
            status = process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()
            return "it did not end within 30 s", 30.0
    seconds, said = time.monotonic() - sent, log.read_text()
    left = {path.name for path in (folder / "out").iterdir()} - phase.keeps
    if status not in _ENDS or "Traceback" in said or left or seconds > _HEARD_S:
        return f"status {status}, {seconds:.2f} s, left {sorted(left)}, said {said.strip()[-300:]!r}", seconds
    return "", seconds
