"""Learning and encoding on workers against this process alone: time, and whether anything differs.

    python tools/cluster_bench.py -r ncars.mcap --samples 8000

Rounds of: this process with all its cores, and with one thread; one worker with one thread; two with one
each. Then a worker is killed while it learns, and one while it encodes. N-CARS comes from `streamfeat
convert`; without `-r` the shipped digits are used, which are too few for times that mean much.
"""

import argparse
import contextlib
import json
import os
import resource
import signal
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from streamfeat.classify.features import EncodedSamples, encode_recordings
from streamfeat.engine.encoder import Encoder
from streamfeat.learn.fit import learn_encoder
from streamfeat.learn.settings import Setting
from streamfeat.recordings.reader import open_recording
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.report.machine import Disturbance
from streamfeat.work.cluster import Cluster, local
from streamfeat.work.workers import ThreadWorkers, Workers

CORES = os.cpu_count() or 1
RECORDINGS = Path(__file__).parents[1] / "recordings"

PLACES: dict[str, Callable[[], contextlib.AbstractContextManager[Any]]] = {
    f"this process, {CORES} threads": lambda: contextlib.nullcontext(ThreadWorkers()),
    "this process, 1 thread": lambda: contextlib.nullcontext(ThreadWorkers(1)),
    "1 worker, 1 thread": lambda: local(1, 1),
    "2 workers, 1 thread each": lambda: local(2, 1),
}


@dataclass(frozen=True)
class Found:
    """What one run learned and encoded, and how long it took."""

    learn_s: float
    encode_s: float
    encoder: Encoder
    samples: EncodedSamples
    most_mb: int = 0
    """The most memory that a worker held."""

    def same_as(self, other: "Found") -> bool:
        return bool(
            self.encoder.fingerprint == other.encoder.fingerprint
            and np.array_equal(self.samples.rows, other.samples.rows)
            and np.array_equal(self.samples.labels, other.samples.labels)
        )

    def difference(self, other: "Found") -> float:
        """The largest difference of a filter's entry, relative to the largest entry."""
        mine, its = self.encoder.filters, other.encoder.filters
        return float(np.abs(mine - its).max() / np.abs(its).max())


def run(
    path: Path, setting: Setting, place: Workers, report: Callable[..., None] = lambda *step: None
) -> Found:
    with open_recording(path) as recording:
        started = time.perf_counter()
        encoder = learn_encoder([recording], setting, report=report, workers=place)
        learned = time.perf_counter()
        samples = encode_recordings(encoder, [recording], report, workers=place)
        return Found(learned - started, time.perf_counter() - learned, encoder, samples)


@contextlib.contextmanager
def first_samples(path: Path, n: int) -> Iterator[Path]:
    """A recording of the first samples of another, beside it for as long as the block runs."""
    few = path.with_suffix(f".first{n}")
    try:
        with open_recording(path) as source, RecordingWriter(few, overwrite=True) as target:
            for _, sample in zip(range(n), source.samples(), strict=False):
                target.write_label(sample.label)
                target.write_events(sample.events, sample.resolution)
        yield few
    finally:
        few.unlink(missing_ok=True)


def peak_mb(pid: int) -> int:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) // 1024


def kill_at(
    place: Cluster, step: str, at: Callable[[int, int], bool]
) -> tuple[Callable[..., None], list[int]]:
    """A report that kills one worker when a step has come so far, and the processes that it killed."""
    killed: list[int] = []

    def report(name: str, done: int, total: int, remark: str) -> None:
        if name == step and not killed and at(done, total):
            killed.append(next(iter(place.processes().values())))
            os.kill(killed[0], signal.SIGKILL)

    return report, killed


def rounds_of(path: Path, warm: Path, setting: Setting, n: int) -> dict[str, list[Found]]:
    found: dict[str, list[Found]] = {name: [] for name in PLACES}
    few = replace(setting, iterations=1, volumes=1000)
    for number in range(n):
        for name, make in PLACES.items():
            with make() as place:
                run(warm, few, place)  # kernels are loaded
                one = run(path, setting, place)
                workers = place.processes().values() if isinstance(place, Cluster) else ()
                found[name].append(replace(one, most_mb=max(map(peak_mb, workers), default=0)))
            one = found[name][-1]
            print(f"round {number + 1}: {name}: {one.learn_s:.1f} s, {one.encode_s:.1f} s", file=sys.stderr)
    return found


def killed_runs(path: Path, setting: Setting, expected: Found) -> dict[str, Any]:
    """A worker killed while it learns, and one while it encodes, as `train` and `evaluate` do."""
    result = {}
    moments: dict[str, Callable[[int, int], bool]] = {
        "learning": lambda done, total: done >= max(1, setting.iterations // 2),
        "encoding": lambda done, total: done >= total // 2,
    }
    for step, at in moments.items():
        with local(2, 1) as place:
            report, killed = kill_at(place, step, at)
            found = run(path, setting, place, report)
        result[step] = {
            "killed": len(killed),
            "same": found.same_as(expected),
            "learn_s": round(found.learn_s, 2),
            "encode_s": round(found.encode_s, 2),
        }
    return result


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-r", "--recording", type=Path, default=RECORDINGS / "digits_train.mcap")
    parser.add_argument("--samples", type=int, default=8000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--formulation", default="direct")
    parser.add_argument("--filters", type=int, default=400)
    parser.add_argument("--patch", type=int, default=12)
    parser.add_argument("--volumes", type=int, default=50_000)
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument("--json", action="store_true", help="print figures as JSON")
    given = parser.parse_args()
    names = ("formulation", "filters", "patch", "volumes", "iterations")
    setting = Setting(stride=4, **{name: getattr(given, name) for name in names})
    disturbance = Disturbance()
    with (
        first_samples(given.recording, given.samples) as path,
        first_samples(given.recording, 100) as warm,
    ):
        found = rounds_of(path, warm, setting, given.rounds)
        here = next(iter(found.values()))[0]
        killed = killed_runs(path, setting, here)
    figures: dict[str, Any] = {"samples": len(here.samples.labels), "killed": killed, "places": {}}
    for name, several in found.items():
        figures["places"][name] = {
            "learn_s": round(statistics.median(one.learn_s for one in several), 2),
            "encode_s": round(statistics.median(one.encode_s for one in several), 2),
            "same": all(one.same_as(here) for one in several),
            "most_mb": max(one.most_mb for one in several),
            "difference": max(one.difference(here) for one in several),
        }
    figures["most_mb_here"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    figures["steal"] = disturbance.steal_share()
    if given.json:
        print(json.dumps(figures))
        return
    show(figures, setting)


def show(figures: dict[str, Any], setting: Setting) -> None:
    how = f"K = {setting.filters}, {setting.volumes:,} volumes, {setting.iterations} iterations"
    print(f"{figures['samples']} samples, {how}; steal {figures['steal'] or 0:.1%}; ", end="")
    print(f"this process held {figures['most_mb_here']} MB at most\n")
    print("| where | learn, s | encode, s | most MB of a worker | same bits |")
    print("| --- | ---: | ---: | ---: | --- |")
    for name, row in figures["places"].items():
        times = f"{row['learn_s']:.1f} | {row['encode_s']:.1f}"
        print(f"| {name} | {times} | {row['most_mb'] or ''} | {'yes' if row['same'] else 'NO'} |")
    for step, row in figures["killed"].items():
        times, same = f"{row['learn_s']:.1f} | {row['encode_s']:.1f}", row["same"] and row["killed"]
        print(f"| a worker of two killed while {step} | {times} | | {'yes' if same else 'NO'} |")


if __name__ == "__main__":
    main()
