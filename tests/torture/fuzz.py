"""Hostile bytes: every decoder, fed with what nobody has vouched for.

    python tests/torture --only bytes              # a million executions
    python tests/torture --only bytes --scale 10   # ten million

Each target runs in a process of its own, which may die: what it was fed last is in a file. Where atheris is
installed (`pip install 'streamfeat[fuzz]'`), a tenth of the inputs, at most 20,000, is guided by which
branches of streamfeat they reach, and the others are changes of what that found; where it is not, they are
changes of the seeds. Rows say how many were guided. Targets that end in kernels run again with bounds
checked, and again with nothing compiled, and must give the same as ever.

Lives here: executions, their limits, and the rows. Not here: the decoders (`targets`, `file_targets`).
"""

import contextlib
import functools
import importlib.util
import json
import mmap
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import time
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

TESTS = Path(__file__).resolve().parents[1]
ROOT = TESTS.parent
sys.path += [folder for folder in (str(TESTS), str(ROOT)) if folder not in sys.path]

from torture.table import Row, Trials  # noqa: E402

__all__ = ["Watch", "all_targets", "hostile_bytes", "random_inputs"]

MAX_SECONDS = 1.0
"""CPU time that one input may take."""
_HARD_SECONDS = 60.0
_ROOM_BYTES = 4 << 30  # of address space, so that a large claim fails instead of being granted
_SAY_EVERY_S = 30.0
_RESTARTS = 20
_GUIDED_SHARE, _MOST_GUIDED = 0.1, 20_000  # the others change what those have found, three times as fast
_CHECKED = 1_000  # inputs of a target, again with bounds checks, and again without compiling

_MODES: dict[str, dict[str, str]] = {
    "": {},
    "bounds checked": {"NUMBA_BOUNDSCHECK": "1"},
    "not compiled": {"NUMBA_DISABLE_JIT": "1"},
}


def hostile_bytes(trials: Trials) -> Sequence[Row]:
    """Feed every target; one row each, and one for each way to run the kernels."""
    shared = "/dev/shm" if os.access("/dev/shm", os.W_OK) else str(trials.folder)
    guided = importlib.util.find_spec("atheris") is not None
    rows = []
    for name, target in all_targets().items():
        folder = trials.folder / name.replace(" ", "_")
        rows.append(_row(name, "", trials.times(target.runs, 50), guided, folder, trials, shared))
    for mode in _MODES:
        if mode:
            again = []
            for name, target in all_targets().items():
                if target.kernels:
                    folder = trials.folder / name.replace(" ", "_")
                    again.append(_compared(name, mode, trials.times(_CHECKED, 10), folder, trials, shared))
            rows.append(_summed(f"kernels, {mode}", again))
    return rows


def _compared(name: str, mode: str, runs: int, folder: Path, trials: Trials, shared: str) -> Row:
    """The same inputs as ever and in another mode; a different outcome is a failure."""
    plain, other = (folder.with_name(folder.name + suffix) for suffix in (".plain", f".{mode.split()[0]}"))
    if not plain.exists():
        _row(name, "", runs, False, plain, trials, shared)
    row = _row(name, mode, runs, False, other, trials, shared)
    if _status(plain).get("digest") != _status(other).get("digest"):
        return Row(row.fault, row.tried, row.survived - 1, failures=(*row.failures, f"{name}: other results"))
    return row


def _summed(fault: str, rows: Sequence[Row]) -> Row:
    return Row(
        fault,
        sum(row.tried for row in rows),
        sum(row.survived for row in rows),
        seconds=sum(row.seconds for row in rows),
        note=f"{len(rows)} targets",
        failures=tuple(failure for row in rows for failure in row.failures),
    )


def _row(name: str, mode: str, runs: int, guided: bool, folder: Path, trials: Trials, shared: str) -> Row:
    """Run one target to the end, however often its process dies."""
    folder.mkdir()
    started, died, status = time.monotonic(), [], {"done": 0}
    environment = os.environ | _MODES[mode] | {"TMPDIR": shared, "PYTHONPATH": f"{TESTS}{os.pathsep}{ROOT}"}
    if mode:
        environment["NUMBA_CACHE_DIR"] = str(folder.parent / f"numba_{mode.split()[0]}")
    led = min(round(runs * _GUIDED_SHARE), _MOST_GUIDED) if guided else 0
    for restart in range(_RESTARTS):
        how = "guided" if status["done"] < led else "random"
        left = (led or runs) - status["done"] if how == "guided" else runs - status["done"]
        command = [sys.executable, __file__, name, str(left), str(trials.seed + restart), str(folder), how]
        with (folder / "log").open("ab") as log:
            ended = subprocess.run(command, env=environment, stdout=log, stderr=log, check=False).returncode
        part = _status(folder)
        status = {key: part.get(key, 0) + status.get(key, 0) for key in ("done", "refused", "failed")} | {
            key: max(part.get(key, 0), status.get(key, 0)) for key in ("slowest_s", "grown")
        }
        if status["done"] >= runs:
            break
        if not ended:
            continue
        if not part:
            died.append(f"{name}: did not start; see {folder / 'log'}")
            break
        died.append(f"{name}: ended with {ended}: {_keep_last(folder, ended)}; see {folder / 'log'}")
    failures = [f"{name}: {line}" for line in _failures(folder)] + died
    note = (
        f"{led:,} guided; {status['refused']:,} refused, "
        f"at most {status['slowest_s']:.2f} s, {status['grown'] / 2**20:.0f} MiB more"
    )
    trials.say(f"{name} {mode}: {status['done']:,}, {len(failures)} failures; {note}")
    tried = status["done"] + len(died)
    seconds = time.monotonic() - started
    return Row(
        f"bytes: {name}",
        tried,
        status["done"] - status["failed"],
        seconds=seconds,
        note=note,
        failures=tuple(failures),
    )


def _status(folder: Path) -> dict[str, Any]:
    path = folder / "status.json"
    return dict(json.loads(path.read_text())) if path.exists() else {}


def _failures(folder: Path) -> list[str]:
    path = folder / "failures"
    return path.read_text().splitlines() if path.exists() else []


def _keep_last(folder: Path, ended: int) -> Path:
    """Keep the input at which a process died."""
    raw = (folder / "current").read_bytes()
    data = raw[4 : 4 + struct.unpack_from("<I", raw)[0]]
    kept = folder / f"died_{ended}_{zlib.crc32(data):08x}"
    kept.write_bytes(data)
    return kept


# --- in the process of one target


class Watch:
    """Executes a target and notices whatever is not a result or a refusal.

    Args:
        target: to execute.
        folder: for the inputs that fail, and the last one; None to raise what fails instead, and to leave
            time and memory alone.
    """

    def __init__(self, target: Any, folder: Path | None) -> None:
        self.target = target
        self.done = self.refused = self.failed = self.grown = self.digest = 0
        self.slowest_s = 0.0
        self._folder = folder
        self._seen: set[str] = set()
        self._room: mmap.mmap | None = None
        if folder:
            with (folder / "current").open("wb+") as file:
                file.truncate(4 + target.most * 2)
                self._room = mmap.mmap(file.fileno(), 0)
        self._peak = 0
        self._said = time.monotonic()

    def warm_up(self) -> None:
        """Execute the seeds, so that everything is imported and compiled, and bound what may be claimed."""
        from streamfeat.errors import InputError
        from torture.targets import feed_engine, some_events

        feed_engine(some_events())
        for seed in self.target.seeds():
            with contextlib.suppress(InputError):
                self.target.run(seed)
        self._peak = _peak_bytes()
        if self._folder:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + _ROOM_BYTES,) * 2)

    def execute(self, data: bytes) -> None:
        """Once; counts it."""
        if self._room:
            self._room[: 4 + len(data)] = struct.pack("<I", len(data)) + data
            signal.setitimer(signal.ITIMER_PROF, _HARD_SECONDS)
        before = self._peak
        started = time.process_time()
        try:
            outcome = self._outcome(data)
            spent = time.process_time() - started
            if spent > MAX_SECONDS and self._folder:
                spent = self._once_more(data)
            self._peak = _peak_bytes()
            grown = self._peak - before
            if self._folder:
                assert spent <= MAX_SECONDS, f"{spent:.1f} s of CPU"
                assert grown <= self.target.memory, f"{grown >> 20} MiB more"
            self.slowest_s = max(self.slowest_s, spent)
            self.grown += grown
            self.digest = zlib.crc32(outcome, self.digest)
        except Exception as error:
            if self._folder is None:
                raise
            self.failed += 1
            self._note(error, data)
        self.done += 1
        if self._folder and time.monotonic() > self._said + _SAY_EVERY_S:
            self.write_status()

    def _outcome(self, data: bytes) -> bytes:
        from streamfeat.errors import InputError
        from torture.targets import check_line

        try:
            return bytes(self.target.run(data))
        except InputError as error:
            check_line(error)
            self.refused += 1
            return b"refused"

    def _once_more(self, data: bytes) -> float:
        """What took long may have been the compiler."""
        started = time.process_time()
        self._outcome(data)
        return time.process_time() - started

    def _note(self, error: Exception, data: bytes) -> None:
        assert self._folder
        frames = traceback.extract_tb(error.__traceback__)
        mine = [f for f in frames if "streamfeat/" in f.filename or "torture/" in f.filename] or frames
        where = " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in reversed(mine[-3:]))
        what = f"{type(error).__name__} at {where}"
        if what in self._seen:
            return
        self._seen.add(what)
        kept = self._folder / f"failed_{zlib.crc32(data):08x}"
        kept.write_bytes(data)
        with (self._folder / "failures").open("a") as file:
            file.write(f"{what}: {str(error)[:160]!r}: {kept}\n")

    def write_status(self) -> None:
        """For the process that waits."""
        assert self._folder
        names = ("done", "refused", "failed", "slowest_s", "grown", "digest")
        temporary = self._folder / "status.part"
        temporary.write_text(json.dumps({name: getattr(self, name) for name in names}))
        temporary.replace(self._folder / "status.json")
        self._said = time.monotonic()


def all_targets() -> dict[str, Any]:
    """Every target by its name."""
    from torture.file_targets import FILE_TARGETS
    from torture.targets import STREAM_TARGETS

    return {target.name: target for target in (*FILE_TARGETS, *reversed(STREAM_TARGETS))}


def random_inputs(target: Any, runs: int, seed: int, found: Sequence[bytes] = ()) -> Iterator[bytes]:
    """So many inputs for a target: its seeds and those found before, and changes of them."""
    from torture.mutate import mutate

    rng, seeds = random.Random(seed), [*target.seeds(), *found]
    yield from seeds[:runs]
    for _ in range(runs - len(seeds)):
        data = mutate(rng.choice(seeds), seeds, target.words, rng, target.most)
        yield target.mend(data)[: target.most] if rng.random() < 0.9 else data


def _peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _work(name: str, runs: int, seed: int, folder: Path, how: str) -> None:
    os.nice(max(0, 19 - os.nice(0)))
    warnings.simplefilter("error")
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    if os.environ.get("NUMBA_DISABLE_JIT"):
        let_kernels_read_events()
    if how == "guided":
        _work_guided(name, runs, seed, folder)
        return
    target = all_targets()[name]
    watch = Watch(target, folder)
    watch.warm_up()
    found = [path.read_bytes() for path in sorted((folder / "corpus").glob("*"))]
    for data in random_inputs(target, runs, seed, found):
        watch.execute(data)
    watch.write_status()


def let_kernels_read_events() -> None:
    """Compiled kernels read `event.x`; plain Python needs arrays of records for that."""
    from streamfeat.engine import engine
    from streamfeat.events import EVENT_DTYPE
    from streamfeat.messages import codecs

    def reading(kernel: Callable[..., Any], *arguments: Any) -> Any:
        return kernel(
            *(a.view(np.recarray) if getattr(a, "dtype", 0) == EVENT_DTYPE else a for a in arguments)
        )

    for module, names in ((codecs, ("decode_evt3", "decode_libcaer_cmp")), (engine, ("count_events",))):
        for name in names:
            setattr(module, name, functools.partial(reading, getattr(module, name)))


def _work_guided(name: str, runs: int, seed: int, folder: Path) -> None:
    import atheris

    # What numba compiles must stay as it is written.
    kernels = [f"streamfeat.kernels.{path.stem}" for path in (ROOT / "streamfeat/kernels").glob("*.py")]
    compiled = [] if os.environ.get("NUMBA_DISABLE_JIT") else kernels
    instrumented = atheris.instrument_imports(include=["streamfeat", "mcap"], exclude=compiled)
    with warnings.catch_warnings(action="ignore"), instrumented:
        target = all_targets()[name]
    from torture.mutate import mutate

    watch = Watch(target, folder)
    watch.warm_up()
    seeds = list(target.seeds())
    corpus = folder / "corpus"
    corpus.mkdir(exist_ok=True)
    for i, data in enumerate(seeds):
        (corpus / f"seed_{i}").write_bytes(data)

    def one(data: bytes) -> None:
        watch.execute(data)
        if watch.done >= runs:
            watch.write_status()
            os._exit(0)

    def change(data: bytes, most: int, seed: int) -> bytes:
        rng = random.Random(seed)
        if rng.random() < 0.3:
            changed = atheris.Mutate(data, most)
        else:
            changed = mutate(data or rng.choice(seeds), seeds, target.words, rng, most)
        return target.mend(changed)[:most] if rng.random() < 0.9 else changed

    limits = ["-timeout=600", "-rss_limit_mb=0", "-len_control=0", f"-max_len={target.most}"]
    atheris.Setup([__file__, f"-seed={seed}", *limits, str(corpus)], one, custom_mutator=change)
    atheris.Fuzz()


if __name__ == "__main__":
    _work(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]), sys.argv[5])
