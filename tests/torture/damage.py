"""Damage: a recording cut short, or with a bit that is not what it was.

Which messages are in which chunk is worked out here from the undamaged file, with the `mcap` package alone.
Every damaged copy is then replayed and recovered. What must hold each time:

- both end in order: with a result, or with one line where not one packet is left;
- every message outside the damaged chunk is there, in order, and no message is there that was not written;
- what is missing is reported;
- where nothing is reported, features have the bits of those of the undamaged file; where something is, those
  of samples all of whose messages are outside the damaged chunk do.

Lives here: making the damage, what must be left, and the rows. Not here: reading (`streamfeat`).
"""

import json
import random
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader, breakup_chunk

from streamfeat.errors import InputError
from streamfeat.recordings.reader import Label, Losses, Packet, open_recording
from streamfeat.recordings.writer import RecordingWriter, recover
from streamfeat.stream.emission import Emission
from streamfeat.stream.outputs import Outputs
from streamfeat.stream.replay import ReplayJob
from torture.table import Row, Trials

__all__ = ["Specimen", "damaged_recordings", "make_specimen", "try_damage"]

ROOT = Path(__file__).resolve().parents[2]
MODEL = ROOT / "recordings/digits.safetensors"
_SOURCE = ROOT / "recordings/digits_test.mcap"
_EVENTS_A_PACKET = 250
_CHUNK_BYTES = 2048
_EMIT = "100ms"
_EVT3_SILENCE_US = 19_000_000  # its clock wraps after 17
_CLI_TIMEOUT_S = 300
_VERSION_AT = slice(5, 6)
_FRAME_BYTES = 9
_CHUNK_HEAD_BYTES = _FRAME_BYTES + 8 + 8 + 8 + 4 + 4 + 3 + 8  # with `lz4` as the compression

Key = tuple[str, bytes]
"""A message: topic and bytes."""


@dataclass(frozen=True)
class Chunk:
    """Where one chunk is in the undamaged file, and the numbers of its messages."""

    start: int
    end: int
    messages: range


@dataclass
class Specimen:
    """An undamaged recording and all that is known of it.

    Attributes:
        data: its bytes.
        chunks: in order.
        keys: of every message, in order; no two are the same.
        n_events: of every message.
        frames: bytes of the file that are the head of a record or of a chunk.
        samples: for each start of a sample, the numbers of its messages.
        emissions: of its replay: time, events, features; and those at the end of samples, by their start.
    """

    data: bytes
    chunks: list[Chunk]
    keys: list[Key]
    n_events: list[int]
    frames: list[int]
    samples: dict[int, set[int]]
    emissions: "_Played" = field(repr=False)


@dataclass
class _Played:
    """Emissions of one replay."""

    all: list[tuple[int, int, bytes]] = field(default_factory=list)
    final: dict[int, bytes] = field(default_factory=dict)

    def write(self, emissions: Sequence[Emission]) -> None:
        for emission in emissions:
            features = emission.features.tobytes()
            self.all.append((emission.t_us, emission.n_events, features))
            if emission.final and emission.sample:
                self.final[emission.sample.start_us] = features

    def close(self, *, failed: bool) -> None:
        pass


@dataclass
class _Tally:
    """What one kind of damage has done so far."""

    tried: int = 0
    lost_events: int = 0
    lost_bytes: int = 0
    recovery_s: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)


def damaged_recordings(trials: Trials) -> Sequence[Row]:
    """Truncations, flips anywhere, and flips in the heads of records."""
    rng = random.Random(trials.seed)
    rows = []
    specimens = {kind: make_specimen(trials.folder, kind) for kind in ("libcaer_cmp", "evt3")}
    one = specimens["libcaer_cmp"]
    trials.say(f"{len(one.data):,} bytes, {len(one.chunks)} chunks, {len(one.keys)} messages")
    n, few, cli = trials.times(1000), trials.times(250), trials.times(15)

    def cut() -> bytes:
        return one.data[: rng.randrange(len(one.data))]

    def flip(specimen: Specimen, at: int) -> bytes:
        return flipped(specimen.data, at, rng.randrange(8))

    def anywhere() -> bytes:
        return flip(one, rng.randrange(len(one.data)))

    def in_a_head() -> bytes:
        return flip(one, rng.choice(one.frames))

    for fault, specimen, times, cli_times, damage in (
        ("recording cut short at a random byte", one, n, cli, cut),
        ("recording with one random bit flipped", one, n, cli, anywhere),
        ("recording with a bit flipped in the head of a record", one, n, cli, in_a_head),
        (
            "evt3 recording with a bit flipped",
            specimens["evt3"],
            few,
            0,
            lambda: flip(specimens["evt3"], rng.randrange(len(specimens["evt3"].data))),
        ),
    ):
        rows.append(_row(fault, specimen, times, cli_times, damage, trials))
    return rows


def _row(
    fault: str, specimen: Specimen, times: int, cli_times: int, damage: Callable[[], bytes], trials: Trials
) -> Row:
    started, tally = time.monotonic(), _Tally()
    for i in range(times):
        data = damage()
        tally.tried += 1
        try:
            try_damage(specimen, data, trials.folder, tally)
            if i < cli_times:
                _try_cli(specimen, data, trials.folder)
        except Exception as error:
            kept = trials.folder / f"failed_{len(tally.failures)}.mcap"
            kept.write_bytes(data)
            tally.failures.append(f"{fault}, try {i}: {type(error).__name__}: {error!s:.300}; {kept}")
    trials.say(f"{fault}: {tally.tried}, {len(tally.failures)} failures")
    return Row(
        fault,
        tally.tried,
        tally.tried - len(tally.failures),
        lost_events=tally.lost_events,
        lost_bytes=tally.lost_bytes,
        recovery_s=statistics.median(tally.recovery_s) if tally.recovery_s else None,
        seconds=time.monotonic() - started,
        note=f"{cli_times} of them through the command line" if cli_times else "",
        failures=tuple(tally.failures),
    )


def flipped(data: bytes, at: int, bit: int) -> bytes:
    """The same bytes but for one bit."""
    return data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]


# --- the undamaged file


def make_specimen(folder: Path, encoding: str, n_samples: int = 8) -> Specimen:
    """Labelled digits in many small chunks, several to a sample; in evt3, far apart."""
    path = folder / f"{encoding}.mcap"
    with (
        open_recording(_SOURCE) as source,
        RecordingWriter(path, encoding=encoding, compression="lz4", chunk_size=_CHUNK_BYTES) as out,
    ):
        for number, sample in zip(range(n_samples), source.samples(), strict=False):
            later_us = number * _EVT3_SILENCE_US if encoding == "evt3" else 0
            out.write_label(replace(sample.label, start_us=sample.label.start_us + later_us))
            sample.events["t"] += later_us
            for start in range(0, len(sample.events), _EVENTS_A_PACKET):
                out.write_events(sample.events[start : start + _EVENTS_A_PACKET], sample.resolution)
    data = path.read_bytes()
    chunks, keys = _chunks_of(path)
    with open_recording(path) as recording:
        items = list(recording.items())
    assert len(items) == len(keys) == len(set(keys))
    n_events = [len(item.events) if isinstance(item, Packet) else 0 for item in items]
    played = _Played()
    losses = _replay(path, played)
    assert not losses
    assert len(played.final) == n_samples
    return Specimen(data, chunks, keys, n_events, _frames_of(data, chunks), _samples_of(items), played)


def _chunks_of(path: Path) -> tuple[list[Chunk], list[Key]]:
    """From the chunk index, with the `mcap` package."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary
        indexes = sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
        chunks, keys = [], []
        for index in indexes:
            file.seek(index.chunk_start_offset)
            chunk = next(StreamReader(file, skip_magic=True, emit_chunks=True).records)
            found = [
                (summary.channels[record.channel_id].topic, record.data)
                for record in breakup_chunk(chunk)
                if isinstance(record, Message)
            ]
            end = index.chunk_start_offset + index.chunk_length
            chunks.append(Chunk(index.chunk_start_offset, end, range(len(keys), len(keys) + len(found))))
            keys += found
    return chunks, keys


def _frames_of(data: bytes, chunks: Sequence[Chunk]) -> list[int]:
    """Every byte of the head of a record: type and length, and of a chunk all before its content."""
    starts = {chunk.start for chunk in chunks}
    found, at = list(range(8)), 8
    while at + _FRAME_BYTES <= len(data) - 8:
        found += range(at, at + (_CHUNK_HEAD_BYTES if at in starts else _FRAME_BYTES))
        at += _FRAME_BYTES + int.from_bytes(data[at + 1 : at + 9], "little")
    return [*found, *range(len(data) - 8, len(data))]


def _samples_of(items: Sequence[Packet | Label]) -> dict[int, set[int]]:
    """The messages of each sample: its label, and every packet with an event in it."""
    samples = {}
    for number, label in enumerate(items):
        if isinstance(label, Label):
            end_us = label.start_us + label.duration_us
            samples[label.start_us] = {number} | {
                i
                for i, item in enumerate(items)
                if isinstance(item, Packet)
                and ((item.events["t"] >= label.start_us) & (item.events["t"] < end_us)).any()
            }
    return samples


# --- a damaged copy


def try_damage(specimen: Specimen, data: bytes, folder: Path, tally: _Tally | None = None) -> None:
    """Replay and recover one damaged copy; AssertionError where something promised does not hold."""
    tally = tally or _Tally()
    path = folder / "damaged.mcap"
    path.write_bytes(data)
    whole = _untouched(specimen, data)
    packets_left = any(specimen.n_events[number] for number in whole)
    recovered = _recovered(specimen, path, folder / "recovered.mcap", whole, tally)
    try:
        with open_recording(path) as recording:
            items = list(recording.items())
            losses = recording.losses
    except InputError as error:
        _promise(not packets_left, f"refused, though packets are left: {error}")
        tally.lost_events += sum(specimen.n_events)
        tally.lost_bytes += len(data)
        return
    n_events = sum(len(item.events) for item in items if isinstance(item, Packet))
    assert n_events == sum(specimen.n_events[number] for number in recovered)
    assert len(items) == len(recovered)
    tally.lost_events += sum(specimen.n_events) - n_events
    tally.lost_bytes += sum(losses.bytes.values())
    assert len(items) == len(specimen.keys) or losses, "a loss that is not reported"
    _check_features(specimen, path, whole, losses)


def _promise(holds: bool, otherwise: str) -> None:
    if not holds:
        raise AssertionError(otherwise)


def _untouched(specimen: Specimen, data: bytes) -> list[int]:
    """Messages of the chunks that are whole and the same as before; none of a file of another version."""
    if data[_VERSION_AT] != specimen.data[_VERSION_AT]:
        return []
    return [
        number
        for chunk in specimen.chunks
        if data[chunk.start : chunk.end] == specimen.data[chunk.start : chunk.end]
        for number in chunk.messages
    ]


def _recovered(
    specimen: Specimen, path: Path, target: Path, whole: Sequence[int], tally: _Tally
) -> list[int]:
    """Recover; the numbers of the messages that the `mcap` package finds in the copy."""
    started = time.perf_counter()
    try:
        losses = recover(path, target, overwrite=True)
    except InputError as error:
        _promise(not whole, f"not recovered: {error}")
        return []
    tally.recovery_s.append(time.perf_counter() - started)
    with target.open("rb") as file:
        messages = make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        found = [(channel.topic, message.data) for _, channel, message in messages]
    number_of = {key: number for number, key in enumerate(specimen.keys)}
    assert all(key in number_of for key in found), "a message that was never written"
    numbers = [number_of[key] for key in found]
    assert numbers == sorted(set(numbers)), "messages out of order, or twice"
    missing = set(whole) - set(numbers)
    assert not missing, f"{len(missing)} messages outside the damage are lost"
    assert len(numbers) == len(specimen.keys) or losses, "recover reports no loss"
    return numbers


def _check_features(specimen: Specimen, path: Path, whole: Sequence[int], losses: Losses) -> None:
    played = _Played()
    told = _replay(path, played)
    assert Counter(told.counts) == Counter(losses.counts)
    if not told:
        assert played.all == specimen.emissions.all, "features differ, and nothing is reported"
        return
    intact = set(whole)
    for start_us, messages in specimen.samples.items():
        if messages <= intact:
            same = played.final.get(start_us) == specimen.emissions.final[start_us]
            assert same, f"features of the sample at {start_us} us differ, though it is whole"


def _replay(path: Path, played: _Played) -> Losses:
    job = ReplayJob(path, MODEL, emit=_EMIT)
    job.run(Outputs(more=played))
    return job.losses


# --- through the command line


def _try_cli(specimen: Specimen, data: bytes, folder: Path) -> None:
    """The same two commands as a user gives them: how they end, and what they say."""
    path, target = folder / "damaged.mcap", folder / "recovered_cli.mcap"
    path.write_bytes(data)
    packets_left = any(specimen.n_events[number] for number in _untouched(specimen, data))
    status, result = _command("replay", path, "-m", MODEL, "--emit", _EMIT, "--json")
    assert status == 0 or (status == 2 and not packets_left), f"replay ended with {status}"
    if status == 0:
        assert result["lost"] or result["events"] == sum(specimen.n_events), "a loss that is not reported"
    status, _ = _command("recover", path, target, "--overwrite")
    assert status == 0 or not packets_left, f"recover ended with {status}"
    target.unlink(missing_ok=True)


def _command(*arguments: object) -> tuple[int, dict[str, Any]]:
    done = subprocess.run(
        [sys.executable, "-c", "from streamfeat.cli import main; main()", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=_CLI_TIMEOUT_S,
        check=False,
        cwd=ROOT,
    )
    assert "Traceback" not in done.stderr, done.stderr[-300:]
    lines = list(_json_lines(done.stdout))
    return done.returncode, lines[-1] if lines else {}


def _json_lines(text: str) -> Iterator[dict[str, Any]]:
    for line in text.splitlines():
        if line.startswith("{"):
            yield json.loads(line)
