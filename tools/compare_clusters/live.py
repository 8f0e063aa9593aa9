"""Cameras that are served for ever: how soon others take over, and whether two ever serve one.

Lives here: four keys on two workers, one of which is killed, or cut off.
"""

import os
import signal
import time
from argparse import Namespace
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

from tools.compare_clusters import nodes, work
from tools.compare_clusters.engines import Engine, started, until

KEYS = tuple(f"cam{i}" for i in range(4))


def process_killed(engine: str, arguments: Namespace) -> dict[str, Any]:
    """SIGKILL for the process that serves the first key; each of two workers has room for all keys."""
    return _process_killed(started(engine, 2, servers=len(KEYS)), Path(arguments.folder))


def own_process_killed(engine: str, arguments: Namespace) -> dict[str, Any]:
    """The same where each key has a worker of its own, and none is to spare."""
    return _process_killed(started(engine, len(KEYS)), Path(arguments.folder))


def _process_killed(one: Engine, folder: Path) -> dict[str, Any]:
    try:
        handles = _serving(one, folder)
        victim = _servers(folder)[KEYS[0]]
        return _watched(folder, {victim}, lambda: os.kill(victim, signal.SIGKILL)) | _ended(
            folder, one, handles
        )
    finally:
        one.stop()


def node_killed(engine: str, arguments: Namespace) -> dict[str, Any]:
    """SIGKILL for everything of the second node."""
    folder = Path(arguments.folder)
    with nodes.two(engine, folder, len(KEYS)) as two:
        one = started(engine, 2, address=two.address)
        try:
            handles = _serving(one, folder)
            talked = nodes.connections()
            found = _watched(folder, set(two.pids()), two.kill)
            return found | _ended(folder, one, handles) | {"talked": talked}
        finally:
            one.stop()


def node_cut_off(engine: str, arguments: Namespace) -> dict[str, Any]:
    """The second node's link goes down, and comes up 5 s after others serve its keys."""
    folder = Path(arguments.folder)
    with nodes.two(engine, folder, len(KEYS)) as two:
        one = started(engine, 2, address=two.address)
        try:
            handles = _serving(one, folder)
            cut = time.monotonic()
            found = _watched(folder, set(two.pids()), lambda: two.link("down"))
            time.sleep(5)
            two.link("up")
            found["cut_s"] = round(time.monotonic() - cut, 1)
            time.sleep(20)
            found["twice_s"] = round(max(_overlap(folder, key) for key in KEYS), 2)
            return found | _ended(folder, one, handles)
        finally:
            one.stop()


def dask_actor_killed(engine: str, arguments: Namespace) -> dict[str, Any]:
    """The same with an actor of Dask: what becomes of it, in its own words."""
    if engine != "dask":
        raise nodes.NotHereError("Ray's servers are actors already")
    one: Any = started("dask", 2, servers=len(KEYS))
    folder = Path(arguments.folder)
    try:
        actor = one.client.submit(_Server, folder, KEYS[0], actor=True).result(timeout=60)
        running = actor.run()
        until(lambda: work.beats(folder, KEYS[0]), "a beat")
        os.kill(next(iter(work.beats(folder, KEYS[0]))), signal.SIGKILL)
        try:
            running.result(timeout=30)
        except BaseException as error:
            told = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        else:
            told = "nothing"
        return {"told": told, "served_by": len(work.beats(folder, KEYS[0]))}
    finally:
        (folder / "end").touch()
        one.stop()


class _Server:
    def __init__(self, folder: Path, key: str) -> None:
        self._folder, self._key = folder, key

    def run(self) -> str:
        return work.serve(self._folder, self._key)


def _serving(one: Engine, folder: Path) -> list[Any]:
    """Have all keys served, by two processes at least."""
    handles = [one.serve(work.serve, folder, key) for key in KEYS]
    until(lambda: all(work.beats(folder, key) for key in KEYS), "every key to be served")
    time.sleep(1)
    return handles


def _servers(folder: Path) -> dict[str, int]:
    """Who gave the last beat of each key."""
    found = {}
    for key in KEYS:
        of = {pid: times[-1] for pid, times in work.beats(folder, key).items() if len(times)}
        found[key] = max(of, key=of.__getitem__)
    return found


def _watched(folder: Path, victims: set[int], strike: Callable[[], None]) -> dict[str, Any]:
    """Strike, and wait until every key that the victims served has a beat of another."""
    before = _servers(folder)
    hit = [key for key, pid in before.items() if pid in victims]
    began = time.monotonic()
    strike()
    struck = time.monotonic()

    def again(key: str) -> float | None:
        others = [t[t > began] for pid, t in work.beats(folder, key).items() if pid not in victims]
        return min((t[0] for t in others if len(t)), default=None)

    try:
        until(lambda: all(again(key) is not None for key in hit), "every key to be served again")
    except TimeoutError as error:
        return {"hit": len(hit), "again_s": None, "why": str(error)}
    last = max((again(key) for key in hit), default=struck)
    time.sleep(2)
    twice = max(_overlap(folder, key) for key in KEYS)
    return {"hit": len(hit), "again_s": round(last - struck, 3), "twice_s": round(twice, 2)}


def _overlap(folder: Path, key: str) -> float:
    """Seconds in which a key was served by two processes at once."""
    spans = sorted((times[0], times[-1]) for times in work.beats(folder, key).values() if len(times))
    return max([0.0, *(min(a[1], b[1]) - b[0] for a, b in pairwise(spans))])


def _ended(folder: Path, one: Engine, handles: list[Any]) -> dict[str, Any]:
    """Ask all servers to end, and see whether the engine says so of each."""
    (folder / "end").touch()
    try:
        return {"ended": sorted(one.results(handles)) == list(KEYS)}
    except Exception as error:
        return {"ended": f"{type(error).__name__}: {error}".splitlines()[0][:200]}
