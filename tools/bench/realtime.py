"""Emissions every 10 ms of stream time: this version against another one that is installed beside it.

Lives here: `python tools/bench/realtime.py OTHER`, where OTHER is the folder of a checkout that has its own
`.venv`, or shares this interpreter. Both versions run by turns, each in a process of its own.
Not here: single events (`direct`, `inverse`), whole jobs (`replays`).

The streams are camera samples repeated in time; the model is random, K = 400, of the default geometry.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

STREAMS = {
    "346x260 stride 4": ("eventpacket_libcaer_cmp_346x260.mcap", 4, (260, 346)),
    "346x260 stride 2": ("eventpacket_libcaer_cmp_346x260.mcap", 2, (260, 346)),
    "640x480 stride 4": ("evt2_640x480.raw", 4, (480, 640)),
    "1280x720 stride 4": ("evt3_1280x720.raw", 4, (720, 1280)),
    "crop of 100x80 stride 2": ("eventpacket_libcaer_cmp_346x260.mcap", 2, (80, 100)),
}
"""Sample, stride and `(height, width)` of each stream; events outside are left out."""

EMIT_US, N_FILTERS = 10_000, 400

WARM = 6
"""Emissions that are not counted: their window is not full."""


def main() -> None:
    """Measure, print a row for each stream; the feature bits have to be the same."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("other", type=Path, help="checkout of the version to compare with")
    parser.add_argument("--samples", type=Path, required=True, help="folder of the camera samples")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--emissions", type=int, default=24, help="of each stream, per round")
    parser.add_argument("--threads", type=int, default=1, help="of this version")
    parser.add_argument("--only", default="", help="streams whose name contains this")
    options = parser.parse_args()
    here = Path(__file__).parents[2]
    with tempfile.TemporaryDirectory() as folder:
        for name, (sample, stride, resolution) in STREAMS.items():
            if options.only not in name:
                continue
            path = Path(folder) / "events.npy"
            np.save(path, _repeated(options.samples / sample, resolution, options.emissions))
            runs: dict[str, list[dict[str, Any]]] = {"this": [], "other": []}
            for _ in range(options.rounds):
                for who, root in (("this", here), ("other", options.other)):
                    threads = options.threads if who == "this" else 0
                    runs[who].append(_run(root, path, stride, resolution, threads))
            _print_row(name, runs)


def _print_row(name: str, runs: dict[str, list[dict[str, Any]]]) -> None:
    bits = {run["digest"] for results in runs.values() for run in results}
    row = [f"{name:24}"]
    for field, what in (("cpu_ms", "processor"), ("ms", "clock")):
        this, other = ([run[field] for run in runs[who]] for who in ("this", "other"))
        ratios = np.divide(other, this)
        row.append(
            f"{what}: {np.median(this):.2f} ms against {np.median(other):.2f} ms, "
            f"{np.median(ratios):.2f}x ({ratios.min():.2f} to {ratios.max():.2f})"
        )
    print("; ".join([*row, f"bits {'the same' if len(bits) == 1 else 'DIFFER'}"]), flush=True)


def _repeated(path: Path, resolution: tuple[int, int], emissions: int) -> Any:
    """Events of a sample, again and again, until there are enough for so many emissions."""
    sys.path.insert(0, str(Path(__file__).parents[2]))
    from streamfeat.recordings.reader import open_recording

    with open_recording(path) as recording:
        events = np.concatenate(list(recording))
    height, width = resolution
    events = events[(events["x"] < width) & (events["y"] < height)]
    events["t"] -= events["t"][0]
    span, wanted = int(events["t"].max()) + 1, emissions * EMIT_US
    rounds = []
    for i in range(-(-wanted // span)):
        again = events.copy()
        again["t"] += i * span
        rounds.append(again)
    together = np.concatenate(rounds)
    return together[together["t"] < wanted]


def _run(root: Path, path: Path, stride: int, resolution: tuple[int, int], threads: int) -> dict[str, Any]:
    own = root / ".venv" / "bin" / "python"
    command = [str(own) if own.exists() else sys.executable, __file__]
    task = json.dumps([str(path), stride, resolution, threads])
    environment = os.environ | {"PYTHONPATH": str(root), "REALTIME_TASK": task, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, cwd=root)
    if done.returncode:
        raise SystemExit(done.stderr)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def work(path: str, stride: int, resolution: tuple[int, int], threads: int) -> dict[str, Any]:
    """Emit every 10 ms; mean milliseconds that `features()` takes, of the clock and of the processor."""
    import streamfeat as sf

    geometry, rng = sf.Geometry(stride=stride), np.random.default_rng(0)
    filters = rng.standard_normal((N_FILTERS, geometry.entries)).astype(np.float32)
    encoder = sf.Encoder.build(
        geometry,
        formulation="direct",
        encoding="split",
        threshold=1.0,
        filters=filters / np.linalg.norm(filters, axis=1, keepdims=True),
        whitening=np.eye(geometry.entries, dtype=np.float32),
        mean=np.zeros(geometry.entries, np.float32),
    )
    events = np.load(path)
    options: dict[str, Any] = {"threads": threads} if threads else {}
    warm = sf.Engine(encoder, resolution, **options)
    warm.feed(events[:1000])
    warm.features()
    engine, digest, spent = sf.Engine(encoder, resolution, **options), hashlib.sha256(), []
    last = int(events["t"][-1])
    for start in range(0, last, EMIT_US):
        first, stop = np.searchsorted(events["t"], [start, start + EMIT_US])
        engine.feed(events[first:stop])
        engine.advance(start + EMIT_US - 1)
        started = time.perf_counter(), time.process_time()
        features = engine.features()
        spent.append((time.perf_counter() - started[0], time.process_time() - started[1]))
        digest.update(features.tobytes())
    clock, processor = 1000 * np.mean(spent[WARM:], axis=0)
    return {"ms": float(clock), "cpu_ms": float(processor), "digest": digest.hexdigest()}


if __name__ == "__main__":
    if task := os.environ.get("REALTIME_TASK"):
        sys.path[:] = [os.environ["PYTHONPATH"], *(p for p in sys.path if p != str(Path(__file__).parent))]
        print(json.dumps(work(*json.loads(task))))
    else:
        main()
