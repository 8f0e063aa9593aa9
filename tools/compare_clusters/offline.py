"""Sums over parts of a recording: what an engine costs, what two workers gain, what a kill costs.

Lives here: measurements that one child process makes of one engine, from nothing.
"""

import contextlib
import hashlib
import os
import signal
import subprocess
import threading
import time
from argparse import Namespace
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from tools.compare_clusters import nodes, work
from tools.compare_clusters.engines import Engine, started

_EMPTY = 1000
JOBS = {"encode": work.encode_all, "sums": work.sum_all}


def cost(engine: str, arguments: Namespace) -> dict[str, Any]:
    """Start, empty tasks, both jobs, and what stands around idle."""
    before = _pss(os.getpid())
    began = time.perf_counter()
    one = started(engine, arguments.workers)
    try:
        one.results([one.submit(work.nothing, 1)])
        found: dict[str, Any] = {"first_result_s": time.perf_counter() - began}
        _warm(one, arguments)
        if engine != "none":
            found |= {"idle_mb": sum(map(_pss, nodes.family(os.getpid()))) - before, "listens": _listening()}
        one.results([one.submit(work.nothing, i) for i in range(50)])
        began = time.perf_counter()
        one.results([one.submit(work.nothing, i) for i in range(_EMPTY)])
        found["empty_task_ms"] = (time.perf_counter() - began) * 1000 / _EMPTY
        for name in JOBS:
            found |= {f"{name}_{key}": value for key, value in _timed(one, name, arguments).items()}
        return found
    finally:
        one.stop()


def worker_killed(engine: str, arguments: Namespace) -> dict[str, Any]:
    """SIGKILL for the process that has begun the last task, when a third have begun; two workers."""
    one = started(engine, 2)
    try:
        return _disturbed(one, arguments, lambda pid: os.kill(pid, signal.SIGKILL))
    finally:
        one.stop()


def node_killed(engine: str, arguments: Namespace) -> dict[str, Any]:
    """SIGKILL for all processes of one of two nodes, which does not come back: one job, therefore."""
    with nodes.two(engine, Path(arguments.folder)) as two:
        one = started(engine, 2, address=two.address)
        try:
            return _disturbed(one, arguments, lambda pid: two.kill(), ["encode"])
        finally:
            one.stop()


def _disturbed(
    one: Engine, arguments: Namespace, kill: Callable[[int], None], jobs: Iterable[str] = JOBS
) -> dict[str, Any]:
    _warm(one, arguments)
    found: dict[str, Any] = {}
    for name in jobs:
        calm = _timed(one, name, arguments)
        killed = _timed(one, name, arguments, kill)
        found[f"{name}_calm_s"] = calm["s"]
        found[f"{name}_killed_s"] = killed["s"]
        found[f"{name}_again"] = killed["tasks"] - calm["tasks"]
        found[f"{name}_same"] = killed["digest"] == calm["digest"]
        _warm(one, arguments)
    return found


def _timed(
    one: Engine, name: str, arguments: Namespace, kill: Callable[[int], None] | None = None
) -> dict[str, Any]:
    folder = Path(arguments.folder)
    work.forget(folder)
    total = len(work.parts_of(folder)) if name == "encode" else work.n_chunks(folder)
    stopped = threading.Event()

    def watch() -> None:
        while not stopped.wait(0.005):
            begun = work.ran(folder)
            if len(begun) * 3 >= total:
                kill(begun[-1][1])
                return

    watcher = threading.Thread(target=watch) if kill else None
    began, processor = time.perf_counter(), _processor_s()
    if watcher:
        watcher.start()
    try:
        (result,) = one.results([JOBS[name](one.submit, folder, Path(arguments.model))])
        spent = time.perf_counter() - began
        processor = _processor_s() - processor
    finally:
        stopped.set()
        if watcher:
            watcher.join()
    digest = hashlib.sha256(b"".join(result[key].tobytes() for key in sorted(result)))
    return {
        "s": spent,
        "processor_s": processor,
        "tasks": len(work.ran(folder)),
        "digest": digest.hexdigest()[:16],
    }


def _warm(one: Engine, arguments: Namespace) -> None:
    """Every worker has imported and compiled what it needs."""
    folder, model = Path(arguments.folder), Path(arguments.model)
    one.results([one.submit(work.ready, model) for _ in range(4)])
    log, part = folder / "warm.txt", work.parts_of(folder)[0]
    one.results([one.submit(work.encode_part, part, model, log) for _ in range(4)])
    one.results([one.submit(work.sum_chunk, folder, 0, model, log) for _ in range(4)])


def _processor_s() -> float:
    """What this process and all that come from it have used, which no other machine's load changes."""
    total = 0
    for pid in nodes.family(os.getpid()):
        with contextlib.suppress(OSError):
            words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            total += int(words[11]) + int(words[12])
    return total / os.sysconf("SC_CLK_TCK")


def _pss(pid: int) -> float:
    """Its share of memory in MB, where what several map counts once in all."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) for line in lines if line.startswith("Pss:")) * 1024 / 1e6


def _listening() -> dict[str, int]:
    """How many TCP sockets of these processes listen on loopback only, and how many beyond."""
    mine = {f"pid={pid}," for pid in nodes.family(os.getpid())}
    lines = subprocess.run(["ss", "-ltnpH"], capture_output=True, text=True, timeout=20).stdout.splitlines()
    where = [line.split()[3] for line in lines if any(pid in line for pid in mine)]
    inside = sum(address.startswith(("127.", "[::1]")) for address in where)
    return {"loopback": inside, "beyond": len(where) - inside}
