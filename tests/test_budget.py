"""What a file may become in memory: one budget, whatever it claims and in however many parts."""

import struct
import time
import tracemalloc

import lz4.frame
import pytest
import tiny
import zstandard
from torture.fuzz import all_targets

from streamfeat.camera_files.event_files import read_events
from streamfeat.errors import InputError
from streamfeat.files.budget import FLOOR_BYTES, RATIO, VARIABLE, Budget, parse_bytes
from streamfeat.recordings.losses import Losses
from streamfeat.recordings.reader import open_recording
from streamfeat.recordings.records import iter_records, open_mcap
from streamfeat.recordings.writer import RecordingWriter

MAGIC = b"\x89MCAP0\r\n"
EVENTS = "event_camera_msgs/msg/EventPacket"


def record(opcode, body):
    return bytes([opcode]) + struct.pack("<Q", len(body)) + body


def text(words):
    return struct.pack("<I", len(words)) + words.encode()


def chunk(data):
    packed = zstandard.ZstdCompressor(level=1).compress(data)
    return record(
        6, struct.pack("<QQQI", 0, 10, len(data), 0) + text("zstd") + struct.pack("<Q", len(packed)) + packed
    )


def schema(number, size):
    head = struct.pack("<H", number) + text(f"a/msg/B{number}") + text("ros2msg")
    return record(3, head + struct.pack("<I", size) + bytes(size))


def header():
    return MAGIC + record(1, text("ros2") + text("x"))


def good_records(tmp_path):
    path = tmp_path / "good.mcap"
    with RecordingWriter(path) as writer:
        writer.write_events(tiny.stream(range(100, 200)), tiny.RESOLUTION)
    data = path.read_bytes()
    return data[len(MAGIC) :]


@pytest.mark.parametrize("compressed", [True, False])
def test_schemas_without_end_are_left_out_and_the_events_are_read(compressed, tmp_path):
    """30 schemas of 255 MB were a file of 249 kB that took 9 GB."""
    wrap = chunk if compressed else bytes
    size, number = (FLOOR_BYTES // 4, 12) if compressed else (FLOOR_BYTES // 2, 3)
    path = tmp_path / "a.mcap"
    schemas = b"".join(wrap(schema(i, size)) for i in range(100, 100 + number))
    path.write_bytes(header() + schemas + good_records(tmp_path))
    tracemalloc.start()
    with open_recording(path) as recording:
        assert recording.n_events == 100
        assert sum(recording.losses.counts.values()) >= number - 4
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 3 * FLOOR_BYTES


@pytest.mark.parametrize("inner", [b"\x90" + bytes(8), b"\x03" + bytes(8)], ids=["private", "damaged"])
def test_empty_records_without_end_take_no_time(inner, tmp_path):
    """29 million of them were 29 kB that took 150 s."""
    path = tmp_path / "a.mcap"
    path.write_bytes(header() + chunk(inner * (2 * FLOOR_BYTES // 9)) + good_records(tmp_path))
    started = time.process_time()
    with open_recording(path) as recording:
        assert recording.n_events == 100
        assert recording.losses.counts["damaged chunk"] == 1
        assert "--unpack" in recording.losses.first["damaged chunk"]
    assert time.process_time() - started < 5


def test_many_chunks_of_little_are_bounded_in_sum(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(header() + chunk(b"\x90" + struct.pack("<Q", 3 << 20) + bytes(3 << 20)) * 60)
    losses = Losses()
    with open_mcap(path) as file:
        assert list(iter_records(file, losses)) == []
    assert losses.counts["damaged chunk"] == 60 - 21


def test_packets_of_aedat4_are_bounded_in_sum(tmp_path, monkeypatch):
    magic = b"\x04\x22\x4d\x18"
    seed = next(seed for seed in all_targets()["camera file AEDAT4"].seeds() if magic in seed)
    start = seed.index(b"</dv>") + 5
    length = struct.unpack_from("<i", seed, start + 4)[0]
    first = seed[start : start + 8 + length]
    unpacked = len(lz4.frame.decompress(first[8:]))
    path = tmp_path / "a.aedat4"
    path.write_bytes(seed[:start] + first * 10)
    whole = read_events(path)
    monkeypatch.setenv(VARIABLE, str(4 * unpacked))
    monkeypatch.setattr("streamfeat.files.budget.RATIO", 0)
    cut = read_events(path)
    assert len(cut.events) == len(whole.events) // 10 * 4
    assert "--unpack" in cut.damage[0]


def test_a_budget_is_a_floor_or_a_multiple_and_can_be_raised(monkeypatch):
    Budget(0).take(FLOOR_BYTES)
    Budget(FLOOR_BYTES).take(FLOOR_BYTES * RATIO)
    with pytest.raises(ValueError, match="--unpack allows more"):
        Budget(0).take(FLOOR_BYTES + 1)
    monkeypatch.setenv(VARIABLE, "4G")
    Budget(0).take(4 << 30)


@pytest.mark.parametrize("text", ["", "many", "-1", "1e9", "4T", "4.5G", "9" * 13, "\u0664"])
def test_a_budget_that_is_none_is_one_line(text):
    with pytest.raises(InputError, match="500M or 4G"):
        parse_bytes(text)


def test_the_option_reaches_the_reader(run, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(header() + chunk(bytes([0x90]) + struct.pack("<Q", FLOOR_BYTES) + bytes(FLOOR_BYTES)))
    refused = run("info", path)
    assert (refused.status, "--unpack allows more" in refused.err) == (2, True)
    allowed = run("--unpack", "200M", "info", path)
    assert (allowed.status, "--unpack" in allowed.err) == (2, False)
