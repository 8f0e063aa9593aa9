"""`kill -9` at random moments of every command that writes a file which took time to make.

Lives here: what each command was asked to make, and what must be there when it was killed.
"""

import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from streamfeat.classify.classifier import Classifier
from streamfeat.engine.encoder import Encoder
from streamfeat.errors import InputError
from streamfeat.live.network import open_session
from streamfeat.recordings.reader import open_recording
from torture.nursery import Nursery, free_port
from torture.sources import MODEL, ROOT, TRAIN, Camera, digits, folder_of_samples
from torture.table import Row, Trials

__all__ = ["kills"]

_TIMES = 40
_ITERATIONS = 12
_LEARN = [
    "--patch",
    "8",
    "--stride",
    "4",
    "--bins",
    "2",
    "--filters",
    "40",
    "--volumes",
    "4000",
    "--seed",
    "3",
    "--window-ms",
    "100",
    "--preset",
    "default",
    "--json",
]
_EVALUATE = [
    "--patch",
    "8",
    "--stride",
    "6",
    "--filters",
    "20",
    "--volumes",
    "1500",
    "--iterations",
    "2",
    "--early-samples",
    "0",
    "--json",
]
_METHODS = ("counts", "random", "kmeans", "direct")
_CHUNK_S = 0.1


class _WrongError(Exception):
    """What was promised did not hold."""


def _demand(holds: bool, what: str) -> None:
    if not holds:
        raise _WrongError(what)


def kills(trials: Trials) -> list[Row]:
    """A row for each command."""
    with Nursery(ROOT) as nursery:
        files = [make(nursery, trials) for make in (_learn, _train, _convert, _evaluate)]
        rows = [_try(nursery, trials, command) for command in files]
        return [*rows, _record(nursery, trials)]


@dataclass
class _Command:
    """A command that writes one file.

    Attributes:
        name: of the command.
        words: its arguments, without those that name the output.
        output: name of the file.
        is_whole: whether a path holds a complete result.
        go_on: what comes after a kill: given the folder, makes sure that the work can be ended.
        note: on what going on means.
        goes_on: what was done before the kill is not done again.
    """

    name: str
    words: Sequence[object]
    output: str
    is_whole: Callable[[Path], bool]
    go_on: Callable[[Path], None]
    note: str
    goes_on: bool = True


def _try(nursery: Nursery, trials: Trials, command: _Command) -> Row:
    """Kill one command at random moments; half of the times there was an output before."""
    began, rng = time.monotonic(), np.random.default_rng(trials.seed)
    reference = trials.folder / command.name / command.output
    seconds = []
    for i in range(2):
        reference.parent.mkdir(exist_ok=True)
        words = (
            [*command.words, "-o", reference] if command.name != "convert" else [*command.words, reference]
        )
        status, took = nursery.run([command.name, *words, "--overwrite"], reference.parent / f"log{i}")
        if status or not command.is_whole(reference):
            raise RuntimeError((reference.parent / f"log{i}").read_text())
        seconds.append(took)
    before, failures, recoveries, ended = reference.read_bytes(), [], [], 0
    times = trials.times(_TIMES, least=1)
    for i in range(times):
        folder = trials.folder / f"{command.name}_{i}"
        folder.mkdir()
        target, has_before = folder / command.output, bool(i % 2)
        old = b"an earlier result"
        if has_before:
            target.write_bytes(old)
        words = [*command.words, *(["-o"] if command.name != "convert" else []), target]
        delay = float(rng.uniform(0, 1.02 * min(seconds)))
        child = nursery.start(
            [command.name, *words, *(["--overwrite"] if has_before else [])], folder / "log"
        )
        ended += child.kill(delay) != -9
        try:
            now = target.read_bytes() if target.exists() else None
            is_old = now == (old if has_before else None)
            _demand(is_old or now == before or command.is_whole(target), "the output is half written")
            started = time.monotonic()
            if is_old:
                target.unlink(missing_ok=True)
                command.go_on(folder)
                _demand(command.is_whole(target), "the work that went on did not end well")
                recoveries += [time.monotonic() - started] * command.goes_on
        except (_WrongError, InputError, OSError, ValueError) as error:
            failures.append(f"after {delay:.2f} s: {error}")
        shutil.rmtree(folder)
        trials.say(f"{command.name} {i + 1}/{times}")
    recovery = median(recoveries) if recoveries else None
    note = f"{command.note}; {ended} had ended by themselves"
    took = time.monotonic() - began
    name = f"`kill -9` of `{command.name}`"
    tried, survived = times, times - len(failures)
    return Row(name, tried, survived, recovery_s=recovery, seconds=took, note=note, failures=tuple(failures))


def _learn(nursery: Nursery, trials: Trials) -> _Command:
    words: list[object] = [TRAIN, *_LEARN]
    fingerprints: set[str] = set()

    def is_whole(path: Path) -> bool:
        model = Encoder.load(path)
        fingerprints.add(model.fingerprint)
        known = model.provenance
        return (known["iterations"], known["interrupted"], len(fingerprints)) == (_ITERATIONS, False, 1)

    def go_on(folder: Path) -> None:
        """From the iterations that were kept, to the bits of a run that was never killed."""
        part, target = folder / "model.part", folder / "model"
        rest, resume = _ITERATIONS, []
        if part.exists():
            rest -= Encoder.load(part).provenance["iterations"]
            resume = ["--resume", part]
            if rest == 0:
                part.replace(target)
                return
        whole = ["learn", *words, "--iterations", rest, *resume, "-o", target]
        status, _ = nursery.run(whole, folder / "again")
        _demand(status == 0, (folder / "again").read_text()[-300:])
        _demand(not part.exists(), "MODEL.part is still there")
        fingerprints.add(Encoder.load(target).fingerprint)
        _demand(len(fingerprints) == 1, "other filters than without a crash")

    def is_whole_or_kept(path: Path) -> bool:
        model = Encoder.load(path)
        # All iterations had been kept when the kill came.
        if model.provenance["interrupted"] and model.provenance["iterations"] == _ITERATIONS:
            fingerprints.add(model.fingerprint)
            return len(fingerprints) == 1
        return is_whole(path)

    note = "went on with --resume to the same bits"
    return _Command("learn", [*words, "--iterations", _ITERATIONS], "model", is_whole_or_kept, go_on, note)


def _train(nursery: Nursery, trials: Trials) -> _Command:
    words: list[object] = [digits(trials.folder / "some.mcap", 120), "-m", MODEL, "--json"]

    def is_whole(path: Path) -> bool:
        Classifier.load(path).check_fits(Encoder.load(MODEL))
        return True

    def go_on(folder: Path) -> None:
        # Nothing was kept, nothing is in the way: what a second run does was seen for the reference.
        (folder / "clf").write_bytes((trials.folder / "train" / "clf").read_bytes())

    return _Command("train", words, "clf", is_whole, go_on, "from the start again", False)


def _convert(nursery: Nursery, trials: Trials) -> _Command:
    n = 400
    source = folder_of_samples(trials.folder / "data", n, trials.seed)

    def is_whole(path: Path) -> bool:
        with open_recording(path) as recording:
            return (recording.n_events, len(recording.labels), bool(recording.losses)) == (
                1_200_000,
                400,
                False,
            )

    def go_on(folder: Path) -> None:
        """The part that was left is refused in one line, can be saved, and is out of the way then."""
        part, target = folder / "out.mcap.part", folder / "out.mcap"
        if part.exists():
            status, _ = nursery.run(["convert", source, target], folder / "again")
            said = (folder / "again").read_text()
            _demand(status == 2 and "left by a writer that did not finish" in said, said[-300:])
            part.unlink()
        target.write_bytes((trials.folder / "convert" / "out.mcap").read_bytes())

    return _Command(
        "convert", [source], "out.mcap", is_whole, go_on, "from the start again, once PART is gone", False
    )


def _evaluate(nursery: Nursery, trials: Trials) -> _Command:
    methods = [word for method in _METHODS for word in ("--method", method)]
    words: list[object] = [digits(trials.folder / "few.mcap", 60), *_EVALUATE, *methods]
    accuracies: list[list[float]] = []

    def is_whole(path: Path) -> bool:
        rows = json.loads(path.read_bytes())["rows"]
        accuracies.append([row["accuracy"] for row in rows])
        return [row["method"] for row in rows] == list(_METHODS) and accuracies[-1] == accuracies[0]

    def go_on(folder: Path) -> None:
        """The same command does not do again what was done."""
        part, target = folder / "result.json.part", folder / "result.json"
        done = (
            [line for line in part.read_bytes().splitlines(True)[1:] if line.endswith(b"\n")]
            if part.exists()
            else []
        )
        status, _ = nursery.run(["evaluate", *words, "-o", target], folder / "again")
        _demand(status == 0, (folder / "again").read_text()[-300:])
        rows = {row["method"]: row for row in json.loads(target.read_bytes())["rows"]}
        for line in done:
            kept = json.loads(line)
            same = kept["result"]["encode_s"] == rows[kept["cell"]["method"]]["encode_s"]
            _demand(same, "a finished cell was run again")

    return _Command(
        "evaluate", words, "result.json", is_whole, go_on, "the same command goes on, cell by cell"
    )


# --- recording, which writes what others send


def _record(nursery: Nursery, trials: Trials) -> Row:
    began, rng = time.monotonic(), np.random.default_rng(trials.seed)
    failures, recoveries, lost_events, lost_bytes = [], [], 0, 0
    times = trials.times(_TIMES, least=1)
    for i in range(times):
        folder = trials.folder / f"record_{i}"
        folder.mkdir()
        delay = float(rng.uniform(0, 1.5))
        try:
            events, lost, took = _record_once(nursery, folder, delay, has_before=bool(i % 2))
            lost_events, lost_bytes = lost_events + events, lost_bytes + lost
            if took is not None:
                recoveries.append(took)
        except (_WrongError, InputError, OSError) as error:
            failures.append(f"after {delay:.2f} s: {error}")
        shutil.rmtree(folder)
        trials.say(f"record {i + 1}/{times}")
    return Row(
        "`kill -9` of `record`",
        times,
        times - len(failures),
        lost_events,
        lost_bytes,
        median(recoveries) if recoveries else None,
        time.monotonic() - began,
        f"`recover` finds every whole chunk; chunks of {_CHUNK_S} s, 20,000 events/s",
        tuple(failures),
    )


def _record_once(
    nursery: Nursery, folder: Path, delay_s: float, *, has_before: bool
) -> tuple[int, int, float | None]:
    """Record a camera, kill, recover: events and bytes that were put and are not there, and seconds."""
    target, part, copy = folder / "out.mcap", folder / "out.mcap.part", folder / "copy.mcap"
    old = b"an earlier recording"
    if has_before:
        target.write_bytes(old)
    port = free_port()
    words = ["record", "cam/events", "-o", target, "--port", port, "--chunk", _CHUNK_S]
    with open_session(port=port) as session, Camera(session) as camera:
        child = nursery.start([*words, *(["--overwrite"] if has_before else [])], folder / "log")
        limit = time.monotonic() + 60
        while not camera.is_heard and time.monotonic() < limit:
            time.sleep(0.01)
        _demand(camera.is_heard, (folder / "log").read_text()[-300:])
        time.sleep(delay_s)
        put = camera.n_put
        status = child.kill()
    _demand(status == -9, f"it ended with {status}: {(folder / 'log').read_text()[-300:]}")
    _demand(target.read_bytes() == old if has_before else not target.exists(), "the output is not as it was")
    safe = _messages_in_whole_chunks(part)
    started = time.monotonic()
    if safe == 0:
        return put * camera.EVENTS, put * camera.EVENTS * 8, None
    status, _ = nursery.run(["recover", part, copy], folder / "again")
    took = time.monotonic() - started
    _demand(status == 0, (folder / "again").read_text()[-300:])
    with open_recording(copy) as recording:
        got = np.concatenate(list(recording))
    n = len(got) // camera.EVENTS
    _demand(n == safe, f"{n} packets recovered of {safe} in whole chunks")
    # The first may have been put before anybody listened; from there on none may be missing.
    first = int(got["t"][0]) // camera.STEP_US
    expected = np.concatenate([camera.events(i) for i in range(first, first + n)])
    _demand(np.array_equal(got, expected), "other events than were put")
    lost = max(put - first - n, 0) * camera.EVENTS
    return lost, lost * 8, took


def _messages_in_whole_chunks(path: Path) -> int:
    """Counted by another reader, which ends where the first chunk is cut."""
    n = 0
    try:
        with path.open("rb") as file:
            for record in StreamReader(file, emit_chunks=True).records:
                if isinstance(record, Chunk):
                    n += sum(isinstance(one, Message) for one in breakup_chunk(record, validate_crc=True))
    except Exception:
        return n
    return n
