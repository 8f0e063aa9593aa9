"""Full disks, signals at any time, sinks that raise and tasks that are cancelled.

Lives here: bringing these about around real commands and the real pipeline, and what must be left then.
"""

import asyncio
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from streamfeat.engine.encoder import Encoder
from streamfeat.live.network import open_session
from streamfeat.recordings.reader import open_recording
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.session import Session
from streamfeat.stream.sinks import JsonLinesSink, RecordingSink
from torture.nursery import Nursery, free_port
from torture.sources import MODEL, ROOT, Camera, digits, folder_of_samples
from torture.table import Row, Trials

__all__ = ["faults", "small_disk"]

_SIGNALS = 10
"""For each command."""
_BREAKS = 50
_OLD = b"an earlier result"
_LEARN = ["--patch", 8, "--stride", 4, "--bins", 2, "--window-ms", 100]
_LEARN += ["--filters", 40, "--volumes", 2000, "--iterations", 20]
_EVALUATE = ["--filters", 20, "--volumes", 1500, "--iterations", 2, "--early-samples", 0]


def faults(trials: Trials) -> list[Row]:
    """Rows for full disks, signals, sinks and tasks."""
    few = digits(trials.folder / "few.mcap", 60)
    data = folder_of_samples(trials.folder / "data", 60, trials.seed)
    replay: list[object] = ["replay", few, "-m", MODEL, "--emit", "100ev", "-q"]
    commands: dict[str, list[object]] = {
        "replay -o": [*replay, "-o"],
        "replay --json-lines": [*replay, "--json-lines"],
        "convert": ["convert", data, "-q"],
        "learn": ["learn", few, *_LEARN, "-o"],
        "train": ["train", few, "-m", MODEL, "--folds", 2, "-o"],
        "evaluate": ["evaluate", few, *_EVALUATE, "--method", "counts", "--method", "direct", "-o"],
    }
    with Nursery(ROOT) as nursery:
        return [
            _full_disks(nursery, trials, commands | {"replay --table": [*replay, "--table"]}),
            _signals(nursery, trials, commands),
            _breaks(trials, few),
        ]


# --- disks


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Path]:
    """A file system of so many bytes.

    Raises:
        OSError: this user may not mount one.
    """
    folder.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", folder], capture_output=True, check=False
    )
    if done.returncode:
        raise OSError(done.stderr.decode().strip())
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def _full_disks(nursery: Nursery, trials: Trials, commands: dict[str, list[object]]) -> Row:
    began, failures, tried = time.monotonic(), [], 0
    for i, (name, words) in enumerate(commands.items()):
        try:
            with small_disk(trials.folder / f"disk{i}", "12k") as disk:
                target = disk / ("out.parquet" if name == "replay --table" else "out")
                target.write_bytes(_OLD)
                tried += 1
                status, _ = nursery.run([*words, target, "--overwrite"], trials.folder / "log")
                failures += _wrong(name, status, 2, trials.folder / "log", target, disk)
        except OSError as error:
            return Row("full disk", 0, 0, note=f"not tried: {error}")
    for name in ("record", "listen -o"):
        with small_disk(trials.folder / f"disk_{name[:6]}", "64k") as disk:
            tried += 1
            failures += _live_disk(nursery, trials, name, disk)
    what = "full disk, " + ", ".join([*commands, "record", "listen -o"])
    seconds = time.monotonic() - began
    return Row(what, tried, tried - len(failures), seconds=seconds, failures=tuple(failures))


def _wrong(name: str, status: int, wanted: int, log: Path, target: Path, disk: Path) -> list[str]:
    """What is not as promised: one line, the status, the earlier file, nothing half done beside it."""
    said = log.read_text().strip()
    lines = [line for line in said.splitlines() if "error:" in line]
    # From these, work goes on, or is recovered.
    kept = {f"{target.name}.part"} if name in ("record", "listen -o", "evaluate", "learn") else set()
    left = sorted({path.name for path in disk.iterdir()} - {target.name} - kept)
    if (status, len(lines), target.read_bytes(), left) == (wanted, 1, _OLD, []) and "Traceback" not in said:
        return []
    return [f"{name}: status {status}, {left}, said {said[-300:]!r}"]


def _live_disk(nursery: Nursery, trials: Trials, name: str, disk: Path) -> list[str]:
    """A job that runs until its disk is full: it ends in one line, and what was safe is recovered."""
    port, target, copy = free_port(), disk / "out.mcap", trials.folder / "copy.mcap"
    target.write_bytes(_OLD)
    words: list[object] = ["record", "cam/events", "--chunk", 0.1, "--compression", "none"]
    if name == "listen -o":
        words = ["listen", "cam/events", "-m", MODEL, "--emit", "1000ev", "-q"]
    with open_session(port=port) as session, Camera(session):
        log = trials.folder / "log"
        status, _ = nursery.run([*words, "-o", target, "--port", port, "--overwrite"], log)
    failures = _wrong(name, status, 2, log, target, disk)
    if name == "record":
        status, _ = nursery.run(["recover", f"{target}.part", copy, "--overwrite"], log)
        with open_recording(copy) as recording:
            if status or recording.n_events == 0:
                failures.append(f"record: nothing was recovered: {log.read_text()[-300:]}")
    return failures


# --- signals


def _signals(nursery: Nursery, trials: Trials, commands: dict[str, list[object]]) -> Row:
    """SIGINT or SIGTERM at random moments: an end in order, with a whole result or none."""
    began, rng, failures, tried = time.monotonic(), np.random.default_rng(trials.seed), [], 0
    for name, words in commands.items():
        reference = trials.folder / f"whole_{tried}"
        status, seconds = nursery.run([*words, reference], trials.folder / "log")
        if status:
            raise RuntimeError((trials.folder / "log").read_text())
        for i in range(trials.times(_SIGNALS, least=1)):
            folder = trials.folder / f"signal_{tried}"
            folder.mkdir()
            number = (signal.SIGINT, signal.SIGTERM)[i % 2]
            delay = float(rng.uniform(0, seconds))
            target, log = folder / "out", trials.folder / "log"
            child = nursery.start([*words, target], log)
            time.sleep(delay)
            child.send(number)
            status = child.wait()
            kept = {"out", "out.part"} if name == "evaluate" else {"out"}
            left = {path.name for path in folder.iterdir()} - kept
            said = log.read_text()
            tried += 1
            if status not in (0, 130) or "Traceback" in said or left:
                where = f"{name}, {number.name} after {delay:.2f} s"
                failures.append(
                    f"{where}: status {status}, left {sorted(left)}, said {said.strip()[-300:]!r}"
                )
        trials.say(f"signals to {name}")
    seconds, survived = time.monotonic() - began, tried - len(failures)
    name = "SIGINT or SIGTERM at any time, the same commands"
    return Row(name, tried, survived, seconds=seconds, failures=tuple(failures))


# --- the pipeline


class _Breaks:
    """A sink that raises at its so-manieth part, or says that it got there."""

    def __init__(self, at: int, *, raises: bool) -> None:
        self._at, self._raises = at, raises
        self.got_there = threading.Event()
        self.closed: bool | None = None

    def write(self, emissions: Sequence[Emission]) -> None:
        self._at -= 1
        if self._at <= 0:
            self.got_there.set()
            if self._raises:
                raise OSError("it broke")

    def close(self, *, failed: bool) -> None:
        self.closed = failed


def _breaks(trials: Trials, recording: Path) -> Row:
    """Half of the times a sink raises, half of the times the task is cancelled."""
    began, rng, failures = time.monotonic(), np.random.default_rng(trials.seed), []
    encoder, times = Encoder.load(MODEL), trials.times(_BREAKS)
    for i in range(times):
        folder = trials.folder / f"break_{i}"
        folder.mkdir()
        sink = _Breaks(int(rng.integers(1, 30)), raises=bool(i % 2))
        threads = threading.active_count()
        error = asyncio.run(_broken(encoder, recording, sink, folder))
        wanted = OSError if i % 2 else asyncio.CancelledError
        left = [path.name for path in folder.iterdir()]
        if not isinstance(error, wanted) or left or not sink.closed or threading.active_count() > threads:
            failures.append(f"break {i}: {error!r}, left {left}")
    seconds, survived = time.monotonic() - began, times - len(failures)
    name = "a sink that raises, or a task that is cancelled, at a random moment"
    return Row(name, times, survived, seconds=seconds, failures=tuple(failures))


async def _broken(encoder: Encoder, recording: Path, sink: _Breaks, folder: Path) -> BaseException | None:
    session = Session(encoder, EmitPolicy.parse("20ms"))
    with open_recording(recording) as opened:
        files = RecordingSink(RecordingWriter(folder / "out.mcap")), JsonLinesSink(folder / "out.jsonl")
        sinks = [*files, sink]
        task = asyncio.create_task(Pipeline(opened.played(loop=True), session, sinks).run())
        await asyncio.to_thread(sink.got_there.wait, 60)
        if not sink._raises:
            task.cancel()
        try:
            await task
        except (OSError, asyncio.CancelledError) as error:
            return error
    return None
