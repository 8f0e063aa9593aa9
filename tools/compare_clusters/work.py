"""What workers run: parts of a recording encoded, chunks of volumes summed, keys served.

Lives here: functions that any process may run which can import this package, and the files they read.
"""

import functools
import os
import time
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from streamfeat.encoder import Encoder
from streamfeat.features import sample_end
from streamfeat.learn.transform import TransformLearner
from streamfeat.learn.volumes import sample_volumes, windows_of
from streamfeat.learn.whitening import VolumeWhitener
from streamfeat.recorder import RecordingWriter
from streamfeat.recording import open_recording

CHUNK = 2048
"""Volumes of a task, as a learner takes them at a time."""
BEAT_S = 0.05
_LOG, _VOLUMES = "ran.txt", "volumes.npy"

Sums = dict[str, np.ndarray]


def split_recording(recording: Path, model: Path, folder: Path, samples: int, each: int) -> None:
    """Write recordings of `each` labelled samples, and a file of volumes: what tasks read."""
    encoder = Encoder.load(model)
    with open_recording(recording) as source:
        first = islice(source.samples(), samples)
        for number in range(-(-samples // each)):
            part = list(islice(first, each))
            if not part:
                break
            with RecordingWriter(folder / f"part{number:04d}.mcap") as out:
                for sample in part:
                    out.write_label(sample.label)
                    out.write_events(sample.events, sample.resolution)
        windows = islice(windows_of(source.items(), encoder.geometry), samples)
        volumes = sample_volumes(windows, encoder.geometry, 64 * samples, (0,))
    np.save(folder / _VOLUMES, volumes.counts)


def parts_of(folder: Path) -> list[Path]:
    return sorted(folder.glob("part*.mcap"))


def n_chunks(folder: Path) -> int:
    return -(-len(np.load(folder / _VOLUMES, mmap_mode="r")) // CHUNK)


@functools.cache
def _loaded(model: Path) -> Encoder:
    return Encoder.load(model)


def nothing(x: int) -> int:
    """The empty task."""
    return x


def ready(model: Path) -> int:
    """Import and load what tasks need, and take long enough that every worker gets one."""
    _loaded(model)
    time.sleep(0.3)
    return os.getpid()


def encode_part(part: Path, model: Path, log: Path) -> Sums:
    """The sums of features over the samples of a part: integers of 2^-16, exact in any order."""
    _note(log, part.name)
    encoder = _loaded(model)
    total = np.zeros(encoder.n_features, np.int64)
    with open_recording(part) as recording:
        for sample in recording.samples():
            label = sample.label
            row = encoder.encode(
                sample.events, sample.resolution, origin_us=label.start_us, t_us=sample_end(label)
            )
            total += np.rint(row.astype(np.float64) * 65536).astype(np.int64)
    return {"features": total}


def sum_chunk(folder: Path, number: int, model: Path, log: Path) -> Sums:
    """`X X'` `(d, d)` and `L X'` `(K, d)`, float64, over one chunk of whitened volumes and their codes."""
    _note(log, f"chunk{number}")
    encoder = _loaded(model)
    whitener = VolumeWhitener(eps=encoder.operator.eps)
    whitener.mean_, whitener.whitening_ = encoder.mean, encoder.whitening
    whitener.n_features_in_ = len(encoder.mean)
    learner = TransformLearner(encoder.n_filters, threshold=encoder.threshold)
    learner.components_, learner.n_features_in_ = encoder.filters, len(encoder.mean)
    counts = np.load(folder / _VOLUMES, mmap_mode="r")[number * CHUNK : (number + 1) * CHUNK]
    white = whitener.transform(counts)
    codes = learner.transform(white)
    return {"moment": (white.T @ white).astype(float), "cross": (codes.T @ white).astype(float)}


def add(one: Sums, other: Sums) -> Sums:
    return {name: value + other[name] for name, value in one.items()}


def tree(submit: Callable[..., Any], leaves: Sequence[Any]) -> Any:
    """Add neighbours until one is left: the order is that of the leaves, whoever is done first."""
    level = list(leaves)
    while len(level) > 1:
        odd = level[-1:] if len(level) % 2 else []
        level = [submit(add, *pair) for pair in zip(level[::2], level[1::2], strict=False)] + odd
    return level[0]


def encode_all(submit: Callable[..., Any], folder: Path, model: Path) -> Any:
    """The whole job on an engine: the handle of the sum over all parts."""
    return tree(submit, [submit(encode_part, part, model, folder / _LOG) for part in parts_of(folder)])


def sum_all(submit: Callable[..., Any], folder: Path, model: Path) -> Any:
    """The same for one pass of learning."""
    return tree(submit, [submit(sum_chunk, folder, i, model, folder / _LOG) for i in range(n_chunks(folder))])


def ran(folder: Path) -> list[tuple[str, int]]:
    """Which tasks have begun, and in which process, in order."""
    path = folder / _LOG
    lines = path.read_text().splitlines() if path.exists() else []
    return [(name, int(pid)) for name, pid in (line.split() for line in lines)]


def forget(folder: Path) -> None:
    (folder / _LOG).unlink(missing_ok=True)


def serve(folder: Path, key: str) -> str:
    """Be the server of a key until the file `end` is there: a beat is a time in a file of this process.

    Files, as they are seen from every network namespace and outlive who wrote them.
    """
    with (folder / f"{key}.{os.getpid()}").open("ab", buffering=0) as out:
        while not (folder / "end").exists():
            out.write(time.monotonic_ns().to_bytes(8, "little"))
            time.sleep(BEAT_S)
    return key


def beats(folder: Path, key: str) -> dict[int, np.ndarray]:
    """Of each process that has served a key, the times of its beats in seconds."""
    return {
        int(path.suffix[1:]): np.frombuffer(path.read_bytes()[: path.stat().st_size // 8 * 8], "<i8") / 1e9
        for path in folder.glob(f"{key}.*")
    }


def _note(log: Path, name: str) -> None:
    with log.open("ab", buffering=0) as out:
        out.write(f"{name} {os.getpid()}\n".encode())
