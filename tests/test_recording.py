"""Recordings: what is written is read back, by others too, and damage costs only what it hits."""

import contextlib
import itertools
import random
import struct
import tracemalloc
import zlib
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.messages.cdr import EventArray, EventPacket, FeaturesMessage, LabelMessage, PredictionMessage
from streamfeat.messages.codecs import PAYLOAD_ENCODINGS, make_decoder
from streamfeat.messages.packets import PacketWriter
from streamfeat.recordings import records as mcap_records
from streamfeat.recordings import unpacking
from streamfeat.recordings.options import ReadOptions
from streamfeat.recordings.reader import WHOLE, Label, Packet, Topic, open_recording
from streamfeat.recordings.samples import complete_samples
from streamfeat.recordings.writer import RecordingWriter, recover

RESOLUTION = (60, 80)
LABEL = Label(1_000, 400_000, "car", "train", "a.dat")


def random_events(n, last_us, seed=0):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, last_us, n))
    return make_events(rng.integers(0, 80, n), rng.integers(0, 60, n), rng.integers(0, 2, n), t)


def write(path, events, labels=(), **options):
    with RecordingWriter(path, **options) as writer:
        for label in labels:
            writer.write_label(label)
        writer.write_events(events, RESOLUTION)
    return path


def read(path):
    with open_recording(path) as recording:
        batches = list(recording)
        return np.concatenate(batches), recording.losses


def write_messages(path, *messages, topic="/events", schema=EventPacket.SCHEMA_NAME, **options):
    """Write messages as they come, whatever they say."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start("ros2")
        for name in topic if isinstance(topic, list) else [topic]:
            channel = writer.register_channel(name, "cdr", writer.register_schema(schema, "ros2idl", b""))
            for i, data in enumerate(messages):
                writer.add_message(channel, i, data, i)
        writer.finish()
    return path


def packet(encoding="mono", payload=bytes(8), height=60, seq=0, is_bigendian=False):
    return EventPacket(0, "", height, 80, seq, 0, encoding, is_bigendian, payload).to_cdr()


# --- a real camera


def test_real_recording(shared_data):
    with open_recording(shared_data / "samples/eventpacket_libcaer_cmp_346x260.mcap") as recording:
        name = "/event_camera/events"
        assert recording.topics == [Topic(name, EventPacket.SCHEMA_NAME, "ros2idl", 100)]
        assert (recording.topic, recording.encoding) == (name, "libcaer_cmp")
        assert recording.resolution == (260, 346)
        assert (recording.n_on, recording.n_off, recording.n_events) == (211_043, 360_223, 571_266)
        assert recording.first_us == 1744227144732712
        assert 985_000 < recording.duration_us < 1_000_000
        assert sum(isinstance(item, Packet) for item in recording.items()) == 100
        assert max(int(batch["x"].max()) for batch in recording) == 345
        assert max(int(batch["y"].max()) for batch in recording) == 259
        assert not recording.losses


# --- what is written is read back


@pytest.mark.parametrize("encoding", PAYLOAD_ENCODINGS)
@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_round_trip(tmp_path, encoding, compression):
    # silences of 3 and 20 s: longer than a packet, and longer than 24 bits of microseconds
    parts = [random_events(9_000, 900_000), random_events(10, 100, seed=1), random_events(10, 100, seed=2)]
    parts[1]["t"] += 4_000_000
    parts[2]["t"] += 24_000_000
    events = np.concatenate(parts)
    path = write(tmp_path / "a.mcap", events, [LABEL], encoding=encoding, compression=compression)
    back, losses = read(path)
    np.testing.assert_array_equal(back, events)
    assert not losses
    with open_recording(path) as recording:
        assert (recording.encoding, recording.resolution) == (encoding, RESOLUTION)
        assert (recording.labels, recording.n_events) == ([LABEL], 9_020)
        items = list(recording.items())
    assert items[0] == LABEL
    assert [item.seq for item in items[1:]] == list(range(4))
    assert all(np.ptp(item.events["t"]) < 1_000_000 for item in items[1:])


def test_packets_come_in_order_of_log_time_and_keep_the_disorder_inside(tmp_path):
    events = make_events([1, 2, 3, 4], 0, 1, [5_000_000, 4_999_000, 12, 9_000_000])
    np.testing.assert_array_equal(read(write(tmp_path / "a.mcap", events))[0], events[[2, 0, 1, 3]])


def test_others_read_all_that_we_write(tmp_path):
    path = tmp_path / "a.mcap"
    events = random_events(100, 1_000)
    with RecordingWriter(path, frame_id="cam") as writer:
        writer.write_label(LABEL)
        writer.write_events(events, RESOLUTION)
        writer.write_features(2_000, 100, [1, 2.5])
        writer.write_prediction(2_000, "b", ["a", "b"], [0.25, 0.75])

    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        by_mcap = {channel.topic: m for _, channel, _, m in reader.iter_decoded_messages()}
    messages = (EventPacket, LabelMessage, FeaturesMessage, PredictionMessage)
    store = get_typestore(Stores.EMPTY)
    for message in messages:
        store.register(get_types_from_msg(message.SCHEMA, message.SCHEMA_NAME))
    with AnyReader([path], default_typestore=store) as bag:
        by_rosbags = {c.topic: bag.deserialize(raw, c.msgtype) for c, _, raw in bag.messages()}

    for found in (by_mcap, by_rosbags):
        assert set(found) == {"/events", "/label", "/features", "/prediction"}
        assert {m.header.frame_id for m in found.values()} == {"cam"}
        ours = found["/events"]
        assert (ours.height, ours.width, ours.encoding) == (*RESOLUTION, "mono")
        decoded = make_decoder("mono").decode(bytes(ours.events), ours.time_base)
        np.testing.assert_array_equal(decoded, events)
        label = found["/label"]
        assert (label.header.stamp.nanosec, label.duration_ns, label.label) == (1_000_000, 400_000_000, "car")
        assert (label.split, label.source) == ("train", "a.dat")
        assert (found["/features"].n_events, list(found["/features"].data)) == (100, [1, 2.5])
        assert (found["/prediction"].label, list(found["/prediction"].labels)) == ("b", ["a", "b"])
        assert list(found["/prediction"].scores) == [0.25, 0.75]


def test_event_array(tmp_path):
    events = random_events(50, 1_000)
    data = EventArray(0, "", *RESOLUTION, events).to_cdr()
    path = write_messages(tmp_path / "a.mcap", data, data, schema=EventArray.SCHEMA_NAME)
    with open_recording(path) as recording:
        assert (recording.encoding, recording.resolution) == ("dvs_msgs", RESOLUTION)
        np.testing.assert_array_equal(np.concatenate(list(recording)), np.concatenate([events, events]))


def test_samples(tmp_path):
    events = [random_events(10_000, 100_000, seed) for seed in range(3)]
    labels = [Label(i * 300_000, 100_000 - 10 * i, f"class {i}") for i in range(3)]
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for i, label in enumerate(labels):
            events[i]["t"] += label.start_us
            writer.write_label(label)
            writer.write_events(events[i], (60 + i, 80 + i))
        writer.write_label(Label(5_000_000, 10, "silent"))
    with open_recording(tmp_path / "a.mcap") as recording:
        samples = list(recording.samples())
    assert [s.label for s in samples] == [*labels, Label(5_000_000, 10, "silent")]
    for i, sample in enumerate(samples[:3]):
        assert sample.resolution == (60 + i, 80 + i)
        end_us = labels[i].start_us + labels[i].duration_us
        np.testing.assert_array_equal(sample.events, events[i][events[i]["t"] < end_us])
    assert len(samples[3].events) == 0


def test_samples_arrive_as_soon_as_the_next_begins(tmp_path, monkeypatch):
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for i in range(3):
            writer.write_label(Label(i * 100, 100, str(i)))
            writer.write_events(make_events([1, 2], 0, 1, [i * 100, i * 100 + 100]), RESOLUTION)
    with open_recording(tmp_path / "a.mcap") as recording:
        items, taken = recording.placed_items(WHOLE), []
        taking = ((at, taken.append(item) or item) for at, item in items)
        monkeypatch.setattr(recording, "placed_items", lambda part: taking)
        sample = next(recording.samples())
    assert (sample.label.label, sample.events["t"].tolist()) == ("0", [0])
    assert [type(item) for item in taken] == [Label, Packet, Label]


def test_lost_packets_do_not_lend_their_state(tmp_path):
    lone_x = struct.pack("<3H", 0x2001, 0x8001, 0x6001)
    start = struct.pack("<4H", 0x8000, 0x6000, 0x0005, 0x2003)
    path = write_messages(tmp_path / "a.mcap", packet("evt3", start, seq=0), packet("evt3", lone_x, seq=2))
    assert read(path)[0].tolist() == [(3, 5, 0, 0)]
    path = write_messages(tmp_path / "a.mcap", packet("evt3", start, seq=0), packet("evt3", lone_x, seq=1))
    assert read(path)[0].tolist() == [(3, 5, 0, 0), (1, 5, 0, 0)]


@pytest.mark.parametrize("gaps_s", [(1, 1, 1), (20, 20, 20), (40, 3, 1), (1, 9, 300), (60, 90, 7)])
def test_lost_evt3_packets_do_not_move_those_that_follow(tmp_path, gaps_s):
    """Its clock wraps every 16.8 s, and the packets that would have shown it are lost."""
    parts, start_us = [], 0
    for i, gap_s in enumerate((0, *gaps_s)):
        parts.append(random_events(30, 500_000, seed=i))
        start_us += gap_s * 1_000_000
        parts[-1]["t"] += start_us
    writer = PacketWriter("evt3")
    packets = [m.to_cdr() for part in parts for m in writer.messages(part, RESOLUTION)]
    assert len(packets) == 4
    for lost in range(1, 4):
        kept = [p for i, p in enumerate(packets) if i != lost]
        events, _ = read(write_messages(tmp_path / "a.mcap", *kept))
        np.testing.assert_array_equal(events, np.concatenate([p for i, p in enumerate(parts) if i != lost]))


# --- writing never harms


def interrupt(writer):
    """Fail inside the block, after some events."""
    with contextlib.suppress(ZeroDivisionError), writer:
        writer.write_events(random_events(10, 10), RESOLUTION)
        writer.flush()
        raise ZeroDivisionError


def test_exception_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"old")
    interrupt(RecordingWriter(path, overwrite=True))
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_existing_file_is_not_replaced_unasked(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"old")
    with pytest.raises(InputError, match="exists already"):
        RecordingWriter(path)
    write(path, random_events(10, 10), overwrite=True)
    assert len(read(path)[0]) == 10


def test_file_that_appears_meanwhile_is_not_replaced(tmp_path):
    path = tmp_path / "a.mcap"
    with pytest.raises(InputError, match="exists already"), RecordingWriter(path):
        path.write_bytes(b"new")
    assert path.read_bytes() == b"new"


def test_interrupted_recording_is_kept_on_request_and_readable(tmp_path):
    path = tmp_path / "a.mcap"
    interrupt(RecordingWriter(path, keep_partial=True))
    part = tmp_path / "a.mcap.part"
    events, losses = read(part)
    assert (len(events), dict(losses.counts)) == (10, {"truncated": 1})
    with pytest.raises(InputError, match=r"a\.mcap\.part: left by a writer that did not finish"):
        RecordingWriter(path)
    recover(part, path)
    assert len(read(path)[0]) == 10
    assert not read(path)[1]


def test_nowhere_to_write(tmp_path):
    with pytest.raises(InputError, match="cannot write there: No such file or directory"):
        RecordingWriter(tmp_path / "absent" / "a.mcap")


@pytest.mark.parametrize(
    ("options", "reason"), [({"encoding": "x"}, "encoding 'x'"), ({"compression": "x"}, "compression 'x'")]
)
def test_unknown_options(tmp_path, options, reason):
    with pytest.raises(InputError, match=reason):
        RecordingWriter(tmp_path / "a.mcap", **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("t_us", [-1, 2**31 * 1_000_000])
def test_time_out_of_range(tmp_path, t_us):
    with pytest.raises(InputError), RecordingWriter(tmp_path / "a.mcap") as writer:
        writer.write_events(make_events([1], [1], [1], [t_us]), RESOLUTION)


# --- input that cannot be read at all


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "cannot be opened: No such file"),
        (b"", "is empty"),
        (b"%evt 3.0\n" * 9, "is not an MCAP recording"),
    ],
)
def test_no_recording(tmp_path, content, reason):
    path = tmp_path / "a.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.mcap: {reason}"):
        open_recording(path)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (packet("evt9"), "unknown event encoding 'evt9'"),
        (packet(is_bigendian=True), "big-endian"),
        (packet(payload=bytes(7)), "7 bytes are not a multiple of 8"),
        (packet(height=0), "height 0 and width 80 is not possible"),
        (packet(height=65_537), "height 65537"),
        (packet(height=60_000), "80x60000 pixels; at most 4194304"),
        (packet()[:50], "cut short"),
    ],
)
def test_bad_packets_are_counted_and_only_bad_packets_are_an_error(tmp_path, message, reason):
    path = write_messages(tmp_path / "a.mcap", packet(), message, packet(seq=2))
    events, losses = read(path)
    assert len(events) == 2
    assert (dict(losses.counts), dict(losses.bytes)) == ({"bad packet": 1}, {"bad packet": len(message)})
    assert reason in losses.first["bad packet"]
    assert "topic '/events', message 2 (byte" in losses.first["bad packet"]
    with pytest.raises(InputError, match=rf"nothing can be read from topic '/events'.*message 1.*{reason}"):
        open_recording(write_messages(tmp_path / "b.mcap", message, message))


def test_bad_label_is_counted(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, random_events(10, 10), [LABEL], compression="none")
    data = path.read_bytes().replace(b"car\0", b"\xff\xff\xff\0")
    path.write_bytes(fix_chunk_crc(data))
    with open_recording(path) as recording:
        assert (recording.labels, recording.n_events) == ([], 10)
        assert recording.losses.counts == {"bad label": 1}


def test_topics(tmp_path):
    path = write_messages(tmp_path / "a.mcap", packet(), topic=["/left", "/right"])
    with pytest.raises(InputError, match=r"/left, /right; choose one with --topic"):
        open_recording(path)
    with open_recording(path, "/right") as recording:
        assert (recording.topic, recording.n_events) == ("/right", 1)
    with pytest.raises(InputError, match="no events on topic /up; --topic can be /left, /right"):
        open_recording(path, "/up")
    with pytest.raises(
        InputError, match=r"no topic carries events; there are /events \(std_msgs/msg/String\)"
    ):
        open_recording(write_messages(tmp_path / "b.mcap", packet(), schema="std_msgs/msg/String"))
    with pytest.raises(InputError, match="it has no messages"):
        open_recording(write_messages(tmp_path / "c.mcap"))


# --- damage


def fix_chunk_crc(data):
    """Make the CRC of the only chunk, which is not compressed, match again."""
    at = data.index(b"\x06", 9)
    (size,) = struct.unpack_from("<Q", data, at + 25)
    content = at + 9 + 40
    crc = struct.pack("<I", zlib.crc32(data[content : content + size]))
    return data[: at + 33] + crc + data[at + 37 :]


@pytest.fixture(scope="module", params=["zstd", "none"])
def chunked(request, tmp_path_factory):
    """A recording of 20 chunks of one packet each: path, bytes, packets, and where its chunks start."""
    path = tmp_path_factory.mktemp("chunked") / "a.mcap"
    events = random_events(20 * 200, 10_000_000)
    with RecordingWriter(path, compression=request.param, chunk_size=1) as writer:
        for i in range(20):
            writer.write_events(events[200 * i : 200 * (i + 1)], RESOLUTION)
    with path.open("rb") as file:
        starts = [c.chunk_start_offset for c in make_reader(file).get_summary().chunk_indexes]
    with open_recording(path) as recording:
        packets = [batch.tobytes() for batch in recording]
    return path.read_bytes(), packets, starts


def read_packets(path, data):
    path.write_bytes(data)
    with open_recording(path) as recording:
        return [batch.tobytes() for batch in recording], recording.losses


def test_damaged_chunk_costs_only_itself(tmp_path, chunked):
    data, packets, starts = chunked
    at = starts[7] + 200
    damaged = data[:at] + bytes([data[at] ^ 255]) + data[at + 1 :]
    found, losses = read_packets(tmp_path / "a.mcap", damaged)
    assert found == packets[:7] + packets[8:]
    assert losses.counts == {"damaged chunk": 1, "missing message": 1}
    assert losses.bytes["damaged chunk"] > 200
    assert f"byte {starts[7]}: " in losses.first["damaged chunk"]


@pytest.mark.parametrize("bit", range(8))
def test_damaged_type_costs_one_chunk_at_most(tmp_path, chunked, bit):
    """Also where it says that the file ends here, or that this can be passed over."""
    data, packets, starts = chunked
    (length,) = struct.unpack_from("<Q", data, starts[7] + 1)
    for at, cost in ((starts[7], 1), (starts[7] + 9 + length, 0)):  # the chunk, and the index behind it
        damaged = data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]
        found, losses = read_packets(tmp_path / "a.mcap", damaged)
        assert found == packets[:7] + packets[7 + cost :]
        assert "bad packet" not in losses.counts
        told = recover(tmp_path / "a.mcap", tmp_path / "b.mcap", overwrite=True)
        assert bool(losses) >= cost
        assert bool(told) >= cost


def test_damaged_first_bytes_cost_nothing(tmp_path, chunked):
    data, packets, _ = chunked
    for at, bit in ((at, bit) for at in range(8) for bit in range(8)):
        damaged = data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]
        if at == 5:  # the version: of another one, nobody knows what it means
            with pytest.raises(InputError, match="is not an MCAP recording"):
                read_packets(tmp_path / "a.mcap", damaged)
        else:
            assert read_packets(tmp_path / "a.mcap", damaged)[0] == packets


def test_recover_tells_of_messages_that_the_summary_has_and_nobody_found(tmp_path, chunked):
    data, packets, starts = chunked
    # All lengths agree, and the chunk says that it is a message index.
    damaged = data[: starts[7]] + b"\x07" + data[starts[7] + 1 :]
    (tmp_path / "a.mcap").write_bytes(damaged)
    losses = recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert losses.counts["missing message"] == 1
    found, _ = read_packets(tmp_path / "c.mcap", (tmp_path / "b.mcap").read_bytes())
    assert found == packets[:7] + packets[8:]


def test_damaged_length_costs_one_chunk(tmp_path, chunked):
    data, packets, starts = chunked
    at = starts[7] + 5
    for value in (b"\x01", b"\xff"):
        found, losses = read_packets(tmp_path / "a.mcap", data[:at] + value + data[at + 1 :])
        assert found == packets[:7] + packets[8:]
        assert losses.counts == {"damaged record": 1, "missing message": 1}
        assert losses.bytes["damaged record"] == starts[8] - starts[7]


def test_damaged_length_that_stays_in_the_file(tmp_path, chunked):
    data, packets, starts = chunked
    (length,) = struct.unpack_from("<Q", data, starts[7] + 1)
    longer = struct.pack("<Q", length + starts[11] - starts[8])
    damaged = data[: starts[7] + 1] + longer + data[starts[7] + 9 :]
    assert read_packets(tmp_path / "a.mcap", damaged)[0] == packets[:7] + packets[8:]


def test_damaged_length_of_a_skipped_record_costs_nothing(tmp_path, chunked):
    data, packets, starts = chunked
    (chunk_length,) = struct.unpack_from("<Q", data, starts[7] + 1)
    at = starts[7] + 9 + chunk_length  # the message index behind chunk 7 shall seem to cover three chunks
    assert data[at] == 7
    damaged = data[: at + 1] + struct.pack("<Q", starts[11] - at) + data[at + 9 :]
    found, losses = read_packets(tmp_path / "a.mcap", damaged)
    assert found == packets
    assert losses.counts == {"damaged record": 1}


def test_damaged_length_of_the_header_costs_nothing(tmp_path, chunked):
    data, packets, starts = chunked
    assert data[8] == 1
    for end in (starts[2], starts[3], starts[3] + 40):  # where a record begins, and where none does
        damaged = data[:9] + struct.pack("<Q", end - 17) + data[17:]
        found, losses = read_packets(tmp_path / "a.mcap", damaged)
        assert found == packets
        assert losses.counts == {"damaged record": 1}


def test_overwritten_block_costs_what_it_covers(tmp_path, chunked):
    data, packets, starts = chunked
    hole = data[: starts[5] - 3] + bytes(starts[8] - starts[5]) + data[starts[8] - 3 :]
    found, losses = read_packets(tmp_path / "a.mcap", hole)
    assert found == packets[:5] + packets[8:]
    assert losses.counts["missing message"] == 3


def test_truncated_anywhere(tmp_path, chunked):
    data, packets, starts = chunked
    ends = [*starts[1:], len(data)]
    for length in random.Random(1).sample(range(starts[1], starts[-1]), 15):
        found, losses = read_packets(tmp_path / "a.mcap", data[:length])
        whole = sum(end <= length for end in ends)
        assert found[:whole] == packets[:whole]
        assert len(found) - whole in (0, 1)
        assert losses.counts == {"truncated": 1}


def test_flipped_byte_anywhere(tmp_path, chunked):
    data, packets, _ = chunked
    rng = random.Random(2)
    for _ in range(60):
        at = rng.randrange(8, len(data))
        damaged = data[:at] + bytes([data[at] ^ rng.randrange(1, 256)]) + data[at + 1 :]
        found, losses = read_packets(tmp_path / "a.mcap", damaged)
        assert len(packets) - len(found) in (0, 1)
        assert set(found) <= set(packets)
        assert len(found) == len(packets) or losses


def test_recording_without_summary(tmp_path, chunked):
    data, packets, _ = chunked
    found, losses = read_packets(tmp_path / "a.mcap", data[:-40])
    assert (found, bool(losses)) == (packets, False)


def test_summary_with_a_wrong_crc_is_not_believed(tmp_path):
    path = write(tmp_path / "a.mcap", random_events(10, 10))
    data = path.read_bytes()
    at = data.rindex(b"/events")
    path.write_bytes(data[:at] + b"/wrong!" + data[at + 7 :])
    with path.open("rb") as file:
        assert mcap_records.read_summary(file) is None
    with open_recording(path) as recording:
        assert recording.topic == "/events"


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_chunk_that_grows_without_end(tmp_path, compression):
    path = tmp_path / "a.mcap"
    bomb = packet(payload=bytes(64 << 20))
    write_messages(path, packet(), bomb, packet(seq=2), compression=compression, chunk_size=1)
    claimed = struct.pack("<Q", len(bomb) + 31)
    path.write_bytes(path.read_bytes().replace(claimed, struct.pack("<Q", 1000), 1))
    tracemalloc.start()
    with open_recording(path) as recording:
        events = np.concatenate(list(recording))
        assert recording.losses.counts["damaged chunk"] == 1
        # lz4 allocates out of sight of tracemalloc, so ask how much there was to look at
        assert "holds 1001" in recording.losses.first["damaged chunk"]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(events) == 2
    assert peak < 8 << 20


def test_claims_beyond_the_limit(tmp_path, monkeypatch):
    path = write_messages(
        tmp_path / "a.mcap", packet(), packet(payload=bytes(80_000), seq=1), packet(seq=2), chunk_size=1
    )
    monkeypatch.setattr(unpacking, "MAX_RECORD_BYTES", 50_000)
    events, losses = read(path)
    assert len(events) == 2
    assert "the limit is 50000" in losses.first["damaged chunk"]


def test_long_recording_takes_little_memory(tmp_path):
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, compression="none") as writer:
        for i in range(30):
            events = random_events(50_000, 900_000, seed=i)
            events["t"] += i * 1_000_000
            writer.write_events(events, RESOLUTION)
    assert path.stat().st_size > 11 << 20
    tracemalloc.start()
    with open_recording(path) as recording:
        assert recording.n_events == 1_500_000
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 << 20


def test_records_that_look_like_chunks_end_the_search(tmp_path, chunked):
    data, packets, starts = chunked
    bait = b"\x06" + struct.pack("<Q", 40) + bytes(40)
    found, losses = read_packets(
        tmp_path / "a.mcap", data[: starts[4]] + b"\0" + bait * 3000 + data[starts[4] :]
    )
    assert found == packets
    assert losses.counts["damaged record"] >= 1


# --- recovery


def test_recover_copies_all_that_can_be_read(tmp_path, chunked):
    data, packets, starts = chunked
    at = starts[7] + 200
    (tmp_path / "a.mcap").write_bytes(data[:at] + b"damage" + data[at + 6 : starts[15] + 99])
    losses = recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert losses.counts == {"damaged chunk": 1, "truncated": 1}
    found, losses = read_packets(tmp_path / "c.mcap", (tmp_path / "b.mcap").read_bytes())
    assert (found, bool(losses)) == (packets[:7] + packets[8:15], False)


def test_recover_of_no_recording(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"text")
    with pytest.raises(InputError, match="is not an MCAP recording"):
        recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_recover_keeps_messages_as_they_are(tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema("a/msg/B", "ros2idl", b"struct B {};")
        with_schema = writer.register_channel("/b", "cdr", schema, {"offered_qos_profiles": "x"})
        without = writer.register_channel("/json", "json", 0)
        writer.add_message(with_schema, 5, b"one", 4, 3)
        writer.add_message(without, 6, b"{}", 5, 4)
        writer.finish()
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:-60])
    recover(tmp_path / "cut.mcap", tmp_path / "b.mcap")
    contents = []
    for each in (path, tmp_path / "b.mcap"):
        with each.open("rb") as file:
            contents.append(list(make_reader(file, validate_crcs=True).iter_messages()))
    assert contents[0] == contents[1]


def test_samples_that_are_open_at_a_time_are_bounded():
    """A recording may claim samples without end: the oldest of 16 is given when one more begins."""
    labels = [Label(i, 1_000_000, str(i)) for i in range(18)]
    taken = []
    items = ((0, taken.append(label) or label) for label in labels)
    first = next(complete_samples(items, 1, RESOLUTION))
    assert first.label == labels[0]
    assert len(taken) == 17


@pytest.mark.parametrize(
    ("damaged", "is_read"), [((0,), True), ((0, 1), False), ((5,), False), ((2, 7), False)]
)
def test_one_byte_of_the_beginning_may_be_damaged_but_the_version(tmp_path, damaged, is_read):
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        writer.write_events(make_events([1, 2], 0, 1, [3, 4]), RESOLUTION)
    data = bytearray(path.read_bytes())
    for at in damaged:
        data[at] ^= 0x55
    path.write_bytes(data)
    if is_read:
        with open_recording(path) as recording:
            assert sum(map(len, recording)) == 2
    else:
        with pytest.raises(InputError, match="not an MCAP recording"):
            open_recording(path)


def test_played_again_labels_move_with_their_events(tmp_path):
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        writer.write_label(Label(100, 50, "a"))
        writer.write_events(make_events([1, 2], 0, 1, [110, 120]), RESOLUTION)
    with open_recording(path) as recording:
        items = list(itertools.islice(recording.played(loop=True), 6))
    starts = [item.start_us for item in items if isinstance(item, Label)]
    events = [int(item.events["t"][0]) for item in items if isinstance(item, Packet)]
    assert starts[0] == 100
    assert starts[1] > events[0]
    assert [event - start for start, event in zip(starts, events, strict=True)] == [10, 10, 10]


def chunks_of(data):
    """Start and end of every chunk of an undamaged file."""
    at = 8
    while data[at] != 2:  # the footer
        (length,) = struct.unpack_from("<Q", data, at + 1)
        if data[at] == 6:
            yield at, at + 9 + length
        at += 9 + length


def file_of_chunks(path, messages):
    """A file of one uncompressed chunk for each message."""
    writer = Writer(str(path), chunk_size=1, compression=CompressionType.NONE)
    writer.start("", "")
    channel = writer.register_channel("/a", "cdr", writer.register_schema("a/A", "ros2msg", b""))
    for i, message in enumerate(messages):
        writer.add_message(channel, i, message, i)
    writer.finish()
    return bytearray(path.read_bytes())


def test_a_chunk_inside_a_good_chunk_is_not_found_when_what_comes_after_is_damaged(tmp_path):
    """Recordings of recorders hold chunks as data: after a good chunk the search goes on behind it."""
    inner = file_of_chunks(tmp_path / "inner.mcap", [b"in the data"])
    ((start, end),) = chunks_of(inner)
    messages = [bytes(inner[start:end]), b"second", b"third"]
    data = file_of_chunks(tmp_path / "outer.mcap", messages)
    first, second, _ = chunks_of(data)
    damaged = tmp_path / "damaged.mcap"
    data[first[1]] = 0  # no type of a record
    damaged.write_bytes(data)
    losses = mcap_records.Losses()
    with mcap_records.open_mcap(damaged) as file:
        found = [r.data for _, r in mcap_records.iter_records(file, losses) if hasattr(r, "log_time")]
    assert list(map(bytes, found)) == messages
    assert losses.counts == {"damaged record": 1}
    assert losses.bytes == {"damaged record": second[0] - first[1]}


def test_options_of_tables_are_checked_and_said_to_be_of_no_use_for_messages(tmp_path):
    path = write_messages(tmp_path / "a.mcap", packet())
    with open_recording(path, options=ReadOptions(resolution=(5, 5))) as recording:
        assert ["the options for them change nothing" in line for line in recording.assumptions] == [True]
    with open_recording(path) as recording:
        assert recording.assumptions == []
    for wrong in ({"time_unit": "fortnight"}, {"columns": "a,b"}):
        with pytest.raises(InputError, match=r"--(time-unit|columns)"):
            open_recording(path, options=ReadOptions(**wrong))


def test_a_second_recording_behind_the_first_is_not_passed_over_in_silence(tmp_path):
    data = write_messages(tmp_path / "a.mcap", packet()).read_bytes()
    for behind, lost in ((b"", {}), (data, {"second recording": 1})):
        (tmp_path / "b.mcap").write_bytes(data + behind)
        with open_recording(tmp_path / "b.mcap") as recording:
            assert (recording.n_events, dict(recording.losses.counts)) == (1, lost)


def test_events_outside_the_sensor_are_counted_before_any_replay(tmp_path):
    events = make_events([1, 70, 70], [1, 50, 2], [1, 0, 1], [10, 20, 30])
    (message,) = PacketWriter("mono").messages(events, (60, 80))
    for sides, outside in (((60, 80), 0), ((20, 80), 1), ((60, 70), 2)):
        data = replace(message, height=sides[0], width=sides[1]).to_cdr()
        with open_recording(write_messages(tmp_path / "a.mcap", data)) as recording:
            assert (recording.n_events, recording.n_outside) == (3, outside)


@pytest.mark.parametrize("encoding", ["mono", "libcaer", "libcaer_cmp"])
def test_a_clock_that_starts_anew_is_written_so_that_it_is_read_so(tmp_path, encoding):
    runs = [make_events(np.arange(900) % 80, np.arange(900) % 60, np.arange(900) % 2, t) for t in (
        5_000_000 + np.arange(900) * 1_000,
        1_000 + np.arange(900) * 1_100,
        2_000 + np.arange(900) * 900,
    )]  # fmt: skip
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, encoding=encoding) as writer:
        for i, run in enumerate(runs):
            writer.write_label(Label(int(run["t"][0]), 100_000, f"run {i}"))
            for batch in np.array_split(run, 9):
                writer.write_events(batch, (60, 80))
    with open_recording(path) as recording:
        items = [item for item in recording.items() if isinstance(item, Label) or len(item.events)]
        assert recording.counts == {"restarts": 2}
    events = np.concatenate([item.events for item in items if isinstance(item, Packet)])
    np.testing.assert_array_equal(events, np.concatenate(runs))
    is_label = [isinstance(item, Label) for item in items]
    n_packets = len(items) - 3
    assert [i for i, label in enumerate(is_label) if label] == [
        0,
        n_packets // 3 + 1,
        2 * (n_packets // 3) + 2,
    ]
