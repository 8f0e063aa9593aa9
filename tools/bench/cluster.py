"""Learning and encoding on workers against this process alone: time, and whether anything differs.

Lives here: the part `cluster`. Rounds of: this process with all its cores, and with one thread; one worker
with one thread; two with one each. Then a worker is killed while it learns, and one while it encodes.
Not here: cameras on workers (`tools/live_bench workers`).
"""

import contextlib
import importlib.util
import os
import resource
import signal
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from streamfeat.classify.features import EncodedSamples, encode_recordings
from streamfeat.engine.encoder import Encoder
from streamfeat.learn import settings as learning
from streamfeat.learn.fit import learn_encoder
from streamfeat.recordings.reader import open_recording
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.report.machine import Disturbance
from streamfeat.work.cluster import Cluster, local
from streamfeat.work.workers import ThreadWorkers, Workers
from tools.bench.material import Setting

__all__ = ["measure_cluster"]

_CORES = os.cpu_count() or 1
_PLACES: dict[str, Callable[[], contextlib.AbstractContextManager[Any]]] = {
    f"this process, {_CORES} threads": lambda: contextlib.nullcontext(ThreadWorkers()),
    "this process, 1 thread": lambda: contextlib.nullcontext(ThreadWorkers(1)),
    "1 worker, 1 thread": lambda: local(1, 1),
    "2 workers, 1 thread each": lambda: local(2, 1),
}


def measure_cluster(setting: Setting) -> dict[str, Any]:
    """Seconds of each place, and whether what was learned and encoded has the same bits."""
    if importlib.util.find_spec("distributed") is None:
        return {"missing": ["distributed"]}
    what = learning.Setting(stride=4, filters=400, patch=12, volumes=50_000, iterations=10)
    if setting.quick:
        what = replace(what, filters=20, volumes=1000, iterations=2)
    disturbance, source = Disturbance(), setting.material.path
    with (
        _first_samples(source, 40 if setting.quick else 8000) as path,
        _first_samples(source, 10 if setting.quick else 100) as warm,
    ):
        found = _rounds_of(path, warm, what, setting.rounds(3) - 1, setting.say)
        here = next(iter(found.values()))[0]
        killed = _killed_runs(path, what, here)
    places = {
        name: {
            "learn_s": round(statistics.median(one.learn_s for one in several), 2),
            "encode_s": round(statistics.median(one.encode_s for one in several), 2),
            "same": all(one.same_as(here) for one in several),
            "most_mb": max(one.most_mb for one in several),
            "difference": max(one.difference(here) for one in several),
        }
        for name, several in found.items()
    }
    return {
        "samples": len(here.samples.labels),
        "places": places,
        "killed": killed,
        "most_mb_here": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        "steal": disturbance.steal_share(),
    }


@dataclass(frozen=True)
class _Found:
    """What one run learned and encoded, and how long it took."""

    learn_s: float
    encode_s: float
    encoder: Encoder
    samples: EncodedSamples
    most_mb: int = 0
    """The most memory that a worker held."""

    def same_as(self, other: "_Found") -> bool:
        return bool(
            self.encoder.fingerprint == other.encoder.fingerprint
            and np.array_equal(self.samples.rows, other.samples.rows)
            and np.array_equal(self.samples.labels, other.samples.labels)
        )

    def difference(self, other: "_Found") -> float:
        """The largest difference of a filter's entry, relative to the largest entry."""
        mine, its = self.encoder.filters, other.encoder.filters
        return float(np.abs(mine - its).max() / np.abs(its).max())


def _run(
    path: Path, setting: learning.Setting, place: Workers, report: Callable[..., None] = lambda *step: None
) -> _Found:
    with open_recording(path) as recording:
        started = time.perf_counter()
        encoder = learn_encoder([recording], setting, report=report, workers=place)
        learned = time.perf_counter()
        samples = encode_recordings(encoder, [recording], report, workers=place)
        return _Found(learned - started, time.perf_counter() - learned, encoder, samples)


@contextlib.contextmanager
def _first_samples(path: Path, n: int) -> Iterator[Path]:
    """A recording of the first samples of another, for as long as the block runs."""
    with tempfile.TemporaryDirectory() as folder:
        few = Path(folder) / "first.mcap"
        with open_recording(path) as source, RecordingWriter(few) as target:
            for _, sample in zip(range(n), source.samples(), strict=False):
                target.write_label(sample.label)
                target.write_events(sample.events, sample.resolution)
        yield few


def _peak_mb(pid: int) -> int:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) // 1024


def _kill_at(
    place: Cluster, step: str, at: Callable[[int, int], bool]
) -> tuple[Callable[..., None], list[int]]:
    """A report that kills one worker when a step has come so far, and the processes that it killed."""
    killed: list[int] = []

    def report(name: str, done: int, total: int, remark: str) -> None:
        if name == step and not killed and at(done, total):
            killed.append(next(iter(place.processes().values())))
            os.kill(killed[0], signal.SIGKILL)

    return report, killed


def _rounds_of(
    path: Path, warm: Path, setting: learning.Setting, n: int, say: Callable[[str], None]
) -> dict[str, list[_Found]]:
    found: dict[str, list[_Found]] = {name: [] for name in _PLACES}
    few = replace(setting, iterations=1, volumes=1000)
    for number in range(n):
        for name, make in _PLACES.items():
            with make() as place:
                _run(warm, few, place)  # kernels are loaded
                one = _run(path, setting, place)
                workers = place.processes().values() if isinstance(place, Cluster) else ()
                found[name].append(replace(one, most_mb=max(map(_peak_mb, workers), default=0)))
            one = found[name][-1]
            say(f"round {number + 1}: {name}: {one.learn_s:.1f} s, {one.encode_s:.1f} s")
    return found


def _killed_runs(path: Path, setting: learning.Setting, expected: _Found) -> dict[str, Any]:
    """A worker killed while it learns, and one while it encodes, as `train` and `evaluate` do."""
    result = {}
    moments: dict[str, Callable[[int, int], bool]] = {
        "learning": lambda done, total: done >= max(1, setting.iterations // 2),
        "encoding": lambda done, total: done >= total // 2,
    }
    for step, at in moments.items():
        with local(2, 1) as place:
            report, killed = _kill_at(place, step, at)
            found = _run(path, setting, place, report)
        result[step] = {
            "killed": len(killed),
            "same": found.same_as(expected),
            "learn_s": round(found.learn_s, 2),
            "encode_s": round(found.encode_s, 2),
        }
    return result
