"""A day in the life of a camera: learn from a second of it with defaults, and replay it at its own pace.

    python -m tools.bench.day eventpacket_libcaer_cmp_346x260.mcap

Prints what learning took, and of `replay --speed 1 --emit 10ms` with the learned model: how long it took
against the recording, how late emissions were by the clock, how long `features()` took, and the share of a
processor. `behind` counts emissions that were later than the next one was due. What `view` shows beside this
is `tools/view_rate.py`.

Lives here: the command. Not here: the same every 10 ms without a clock (`goals`).
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import streamfeat as sf
from streamfeat.stream.emission import Emission
from streamfeat.stream.outputs import Outputs
from streamfeat.stream.replay import ReplayJob

__all__ = ["main"]

EMIT_S = 0.01


class TimedEngine(sf.Engine):
    """An engine that notes how long each emission takes: seconds of the clock, and of its thread."""

    taken: list[tuple[float, float]] = []  # noqa: RUF012 - of all engines of this process

    def features(self) -> Any:
        """As `Engine.features`."""
        clock, thread = time.perf_counter(), time.thread_time()
        found = super().features()
        self.taken.append((time.perf_counter() - clock, time.thread_time() - thread))
        return found


class Arrivals:
    """A sink that notes when emissions come, and their stream time."""

    def __init__(self) -> None:
        self.seen: list[tuple[float, float]] = []

    def write(self, emissions: Sequence[Emission], /) -> None:
        """Note some."""
        self.seen += [(time.perf_counter(), emission.t_us / 1e6) for emission in emissions]

    def close(self, *, failed: bool) -> None:
        """Nothing is open."""


def replayed(recording: Path, model: Path, threads: int | None) -> dict[str, Any]:
    """Replay at the recorded pace; figures in milliseconds."""
    TimedEngine.taken.clear()
    arrivals = Arrivals()
    job = ReplayJob(recording, model, emit="10ms", speed=1.0, engine=TimedEngine, threads=threads)
    processor = time.process_time()
    job.run(Outputs(more=arrivals))
    processor = time.process_time() - processor
    clock, stream = np.array(arrivals.seen).T
    late = (clock - clock[0]) - (stream - stream[0])
    late -= late.min()
    taken = 1e3 * np.array(TimedEngine.taken)
    span = float(stream[-1] - stream[0])
    return {
        "emissions": len(stream),
        "stream_s": round(span, 3),
        "clock_s": round(float(clock[-1] - clock[0]), 3),
        "late_ms": _percentiles(1e3 * late),
        "behind": int((late > EMIT_S).sum()),
        "features_ms": _percentiles(taken[:, 0]),
        "features_processor_ms": _percentiles(taken[:, 1]),
        "share_of_a_processor": round(processor / span, 2),
    }


def _percentiles(values: Any) -> dict[str, float]:
    return {f"p{p}": round(float(np.percentile(values, p)), 2) for p in (50, 99)}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench.day",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("-m", "--model", type=Path, help="learned before; else it is learned now")
    parser.add_argument("--threads", type=int)
    options = parser.parse_args(arguments)
    found: dict[str, Any] = {"load": round(os.getloadavg()[0], 1), "cores": os.cpu_count()}
    with tempfile.TemporaryDirectory() as folder:
        model = options.model or Path(folder) / "model.safetensors"
        if options.model is None:
            clock = time.perf_counter()
            command = ["-m", "streamfeat", "learn", str(options.recording), "-o", str(model), "-q"]
            subprocess.run([sys.executable, *command], check=True)
            used = resource.getrusage(resource.RUSAGE_CHILDREN)
            found["learn"] = {
                "clock_s": round(time.perf_counter() - clock, 1),
                "processor_s": round(used.ru_utime + used.ru_stime, 1),
            }
        replayed(options.recording, model, options.threads)  # compiles, and fills caches
        found["replay"] = replayed(options.recording, model, options.threads)
    print(json.dumps(found, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
