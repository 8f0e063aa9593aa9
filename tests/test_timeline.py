"""Recordings as cameras and hosts leave them: restarts, strays, gaps, copies, disorder, other types."""

import hashlib
import struct
from dataclasses import dataclass, replace

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from streams import random_encoder

from streamfeat.engine.geometry import Geometry
from streamfeat.events import make_events
from streamfeat.learn.volumes import windows_of
from streamfeat.messages.cdr import EventArray, EventPacket
from streamfeat.messages.clock import CameraClock
from streamfeat.messages.codecs import encode
from streamfeat.messages.packets import Label, Packet
from streamfeat.messages.timeline import Timeline
from streamfeat.recordings.order import BUFFER_BYTES, in_log_order
from streamfeat.recordings.reader import open_recording
from streamfeat.recordings.records import Block
from streamfeat.recordings.sources import StoredMessage
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.pacing import Pace
from streamfeat.stream.session import Session

HEIGHT, WIDTH = 48, 64
STEP_US = 250
HOST_NS = 1_700_000_000_000_000_000


@dataclass
class Message:
    log_ns: int
    data: bytes
    seq: int


def moving_dot(n, start_us):
    i = np.arange(n)
    return make_events(i % WIDTH, i // 7 % HEIGHT, i % 2, start_us + i * STEP_US)


def messages(events, encoding="mono", *, n=200, host_us=0, seq=0):
    """Packets of n events, each logged when its last event has come."""
    made, after_us = [], 0
    for start in range(0, len(events), n):
        part = events[start : start + n]
        payload, base_ns = encode(part, encoding, after_us)
        after_us = int(part["t"][-1])
        log_ns = HOST_NS + (host_us + (start + len(part)) * STEP_US) * 1000
        data = EventPacket(log_ns, "cam", HEIGHT, WIDTH, seq, base_ns, encoding, False, payload).to_cdr()
        made.append(Message(log_ns, data, seq))
        seq += 1
    return made


def store(path, made, *, schema=EventPacket.SCHEMA_NAME, encoding="cdr", chunk_size=4096, **options):
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size, **options)
        writer.start("ros2")
        text = "ros1msg" if encoding == "ros1" else "ros2msg"
        channel = writer.register_channel("/events", encoding, writer.register_schema(schema, text, b""))
        for message in made:
            writer.add_message(channel, message.log_ns, message.data, message.log_ns, message.seq)
        writer.finish()
    return path


def read(path):
    """Packets, all their events, and the counts."""
    with open_recording(path) as recording:
        packets = [item for item in recording.items() if isinstance(item, Packet)]
        return packets, np.concatenate([packet.events for packet in packets]), dict(recording.counts)


ENCODINGS = pytest.mark.parametrize("encoding", ["mono", "libcaer", "libcaer_cmp", "evt3"])


@ENCODINGS
@pytest.mark.parametrize("again_us", [0, 1_000, 4_000_000])
def test_a_clock_that_starts_anew_costs_nothing(tmp_path, encoding, again_us):
    before, after = moving_dot(4000, 5_000_000), moving_dot(4000, again_us)
    made = messages(before, encoding) + messages(after, encoding, host_us=3_000_000)
    packets, events, counts = read(store(tmp_path / "a.mcap", made))
    np.testing.assert_array_equal(events, np.concatenate([before, after]))
    assert [packet.epoch for packet in packets] == [0] * 20 + [1] * 20
    assert counts == {"restarts": 1}


@ENCODINGS
def test_a_clock_that_starts_anew_every_second(tmp_path, encoding):
    runs = [moving_dot(4000, 1_000) for _ in range(6)]
    made = [m for i, run in enumerate(runs) for m in messages(run, encoding, host_us=1_500_000 * i)]
    packets, events, counts = read(store(tmp_path / "a.mcap", made))
    np.testing.assert_array_equal(events, np.concatenate(runs))
    assert [packet.epoch for packet in packets] == [i for i in range(6) for _ in range(20)]
    assert counts == {"restarts": 5}


def emissions_of(path):
    geometry = Geometry(patch=4, stride=4, n_bins=3, bin_us=100_000)
    encoder = random_encoder(np.random.default_rng(0), geometry, 8)
    session = Session(encoder, EmitPolicy.parse("50ms"))
    with open_recording(path) as recording:
        found = [emission for item in recording.items() for emission in session.process(item)]
    return [*found, *session.finish()], session.stats()


@ENCODINGS
def test_features_after_a_restart_are_those_of_the_rest_alone(tmp_path, encoding):
    after = messages(moving_dot(4000, 1_000), encoding, host_us=3_000_000)
    alone, _ = emissions_of(store(tmp_path / "alone.mcap", after))
    made = messages(moving_dot(4000, 5_000_000), encoding) + after
    both, stats = emissions_of(store(tmp_path / "both.mcap", made))
    assert (stats.events, stats.late) == (8000, 0)
    assert len(alone) > 10
    for one, other in zip(alone, both[-len(alone) :], strict=True):
        assert one.t_us == other.t_us
        np.testing.assert_array_equal(one.features, other.features)


def test_readings_whose_window_lacks_packets_are_incomplete(tmp_path):
    made = messages(moving_dot(8000, 5_000_000))
    found, stats = emissions_of(store(tmp_path / "a.mcap", made[:20] + made[24:]))
    assert 0 < stats.incomplete < len(found)
    assert any(e.incomplete for e in found if e.t_us > 6_200_000)
    assert not any(e.incomplete for e in found if not 6_000_000 <= e.t_us <= 6_600_000)


def test_an_old_packet_first_costs_nothing(tmp_path):
    old, new = moving_dot(100, 3_600_000_000), moving_dot(4000, 1_000)
    made = messages(old, "libcaer", n=100) + messages(new, "libcaer", host_us=1_000_000, seq=1)
    _, events, counts = read(store(tmp_path / "a.mcap", made))
    np.testing.assert_array_equal(events, np.concatenate([old, new]))
    assert counts == {"restarts": 1}


@pytest.mark.parametrize("ahead_us", [4_000_000, -4_000_000, 3_600_000_000, 1 << 50])
@pytest.mark.parametrize("at", [0, 1, 100, 199])
@pytest.mark.parametrize("number", [0, 10, 19])
def test_one_absurd_event_costs_at_most_itself(tmp_path, ahead_us, at, number):
    # Mono has 32 bits of nanoseconds in a packet, so the events go by without a codec in between.
    events = moving_dot(4000, 5_000_000)
    absurd = 200 * number + at
    events["t"][absurd] += ahead_us
    timeline = Timeline("/events")
    found = []
    for i in range(20):
        part = events[200 * i : 200 * (i + 1)]
        log_ns = HOST_NS + 50_000_000 * (i + 1)
        found += timeline.packet(Packet("/events", part, (HEIGHT, WIDTH), log_ns, i))
    found += timeline.finish()
    rest = np.delete(events, absurd)
    together = np.concatenate([packet.events for packet in found])
    assert all(packet.epoch == 0 for packet in found)
    kept = together[np.isin(together["t"], rest["t"])]
    np.testing.assert_array_equal(kept, rest)


@pytest.mark.parametrize("ahead_us", [4_000_000, 3_600_000_000, -4_000_000])
@pytest.mark.parametrize("number", [1, 10, 18])
def test_one_absurd_packet_costs_at_most_itself(tmp_path, ahead_us, number):
    events = moving_dot(4000, 5_000_000)
    made = messages(events)
    moved = events[200 * number : 200 * (number + 1)].copy()
    moved["t"] += ahead_us
    made[number] = replace(messages(moved, seq=number)[0], log_ns=made[number].log_ns)
    packets, found, counts = read(store(tmp_path / "a.mcap", made))
    np.testing.assert_array_equal(found, np.delete(events, slice(200 * number, 200 * (number + 1))))
    assert {packet.epoch for packet in packets} == {0}
    assert counts == {"stray packets": 1}
    assert sum(packet.lost for packet in packets) == 1


def test_a_clock_that_falls_by_decades(tmp_path):
    one, other = moving_dot(4000, HOST_NS // 1000), moving_dot(4000, 1_000)
    made = messages(one) + messages(other, host_us=3_000_000, seq=20)
    _, events, counts = read(store(tmp_path / "a.mcap", made))
    np.testing.assert_array_equal(events, np.concatenate([one, other]))
    assert counts == {"restarts": 1}


@ENCODINGS
@pytest.mark.parametrize("copies", [2, 3, 50])
def test_copies_are_used_once(tmp_path, encoding, copies):
    events = moving_dot(4000, 5_000_000)
    made = [m for m in messages(events, encoding) for _ in range(copies)]
    _, found, counts = read(store(tmp_path / "a.mcap", made))
    np.testing.assert_array_equal(found, events)
    assert counts == {"duplicates": 20 * (copies - 1)}


@ENCODINGS
def test_gaps_are_counted(tmp_path, encoding):
    events = moving_dot(8000, 5_000_000)
    made = messages(events, encoding)
    packets, found, counts = read(store(tmp_path / "a.mcap", made[:8] + made[12:]))
    np.testing.assert_array_equal(found, np.delete(events, slice(1600, 2400)))
    assert counts == {"lost": 4}
    assert [packet.lost for packet in packets if packet.lost] == [4]


# --- order


@ENCODINGS
@pytest.mark.parametrize("chunk_size", [1, 4096, 1 << 20])
@pytest.mark.parametrize("how", ["halves", "backwards", "neighbours", "shuffled"])
def test_messages_are_read_by_log_time(tmp_path, encoding, chunk_size, how):
    events = moving_dot(8000, 5_000_000)
    made = messages(events, encoding)
    mixed = {
        "halves": made[20:] + made[:20],
        "backwards": made[::-1],
        "neighbours": [made[i ^ 1] for i in range(40)],
        "shuffled": [made[i] for i in np.random.default_rng(0).permutation(40)],
    }[how]
    path = store(tmp_path / "a.mcap", mixed, chunk_size=chunk_size)
    _, found, counts = read(path)
    np.testing.assert_array_equal(found, events)
    assert counts == {}
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-50])  # no summary
    np.testing.assert_array_equal(read(cut)[1], events)


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_any_disorder_and_any_copies_give_the_same_events(tmp_path_factory, data):
    encoding = data.draw(st.sampled_from(["mono", "libcaer", "libcaer_cmp", "evt3"]))
    events = moving_dot(data.draw(st.integers(20, 2000)), 5_000_000)
    made = messages(events, encoding, n=data.draw(st.sampled_from([10, 33, 200])))
    mixed = data.draw(st.permutations(made + data.draw(st.lists(st.sampled_from(made), max_size=20))))
    size = data.draw(st.sampled_from([1, 500, 5000, 1 << 20]))
    compression = data.draw(st.sampled_from(list(CompressionType)))
    path = tmp_path_factory.mktemp("any") / "a.mcap"
    _, found, counts = read(store(path, mixed, chunk_size=size, compression=compression))
    np.testing.assert_array_equal(found, events)
    assert counts.get("duplicates", 0) == len(mixed) - len(made)


def test_beyond_the_buffer_messages_are_given_as_they_come():
    stored = [(i, StoredMessage("", "", "cdr", bytes(100), t, 0, 0)) for i, t in enumerate([5, 6, 7, 1, 8])]
    in_reach = [m.log_time_ns for _, m in in_log_order(stored, [Block(0, 1, 8)])]
    beyond = [m.log_time_ns for _, m in in_log_order(stored, [Block(0, 1, 8)], limit_bytes=1300)]
    assert (in_reach, beyond) == ([1, 5, 6, 7, 8], [5, 1, 6, 7, 8])
    assert BUFFER_BYTES == 64 << 20


# --- types


def ros1_header(stamp_ns):
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    return struct.pack("<III", 0, sec, nanosec) + struct.pack("<I", 3) + b"cam"


def ros1_array(message):
    array = EventArray.from_cdr(message.data)
    sec, us = np.divmod(array.events["t"], 1_000_000)
    body = b"".join(
        struct.pack("<HHIIB", e["x"], e["y"], s, u * 1000, e["p"])
        for e, s, u in zip(array.events, sec, us, strict=True)
    )
    sizes = struct.pack("<III", array.height, array.width, len(array.events))
    return replace(message, data=ros1_header(array.stamp_ns) + sizes + body)


def ros1_packet(message):
    packet = EventPacket.from_cdr(message.data)
    about = struct.pack("<IIQQ", packet.height, packet.width, packet.seq, packet.time_base)
    name = struct.pack("<I", len(packet.encoding)) + packet.encoding.encode()
    payload = b"\0" + struct.pack("<I", len(packet.events)) + packet.events
    return replace(message, data=ros1_header(packet.stamp_ns) + about + name + payload)


def arrays(events, n=200):
    return [
        Message(m.log_ns, EventArray(m.log_ns, "cam", HEIGHT, WIDTH, events[i * n : (i + 1) * n]).to_cdr(), 0)
        for i, m in enumerate(messages(events, n=n))
    ]


PACKETS = ["event_camera_msgs", "event_array_msgs"]
ARRAYS = ["dvs_msgs", "prophesee_event_msgs", "dv_ros_msgs"]


@pytest.mark.parametrize("package", PACKETS + ARRAYS)
@pytest.mark.parametrize("layout", ["cdr", "ros1"])
def test_types_under_all_their_names(tmp_path, package, layout):
    events = moving_dot(4000, 5_000_000)
    made = messages(events) if package in PACKETS else arrays(events)
    if layout == "ros1":
        made = [(ros1_packet if package in PACKETS else ros1_array)(message) for message in made]
    kind = "EventPacket" if package == "event_camera_msgs" else "EventArray"
    name = f"{package}/{kind}" if layout == "ros1" else f"{package}/msg/{kind}"
    _, found, counts = read(store(tmp_path / "a.mcap", made, schema=name, encoding=layout))
    np.testing.assert_array_equal(found, events)
    assert counts == {}


@pytest.mark.parametrize(
    "name", ["event_camera_msgs::msg::dds_::EventPacket_", "event_array_msgs::msg::EventArray"]
)
def test_types_as_dds_and_c_plus_plus_write_them(tmp_path, name):
    events = moving_dot(400, 5_000_000)
    _, found, _ = read(store(tmp_path / "a.mcap", messages(events), schema=name))
    np.testing.assert_array_equal(found, events)


@pytest.mark.parametrize("bits", [24, 31, 32])
@pytest.mark.parametrize("encoding", ["mono", "libcaer_cmp"])
def test_a_clock_that_wraps_goes_on(tmp_path, bits, encoding):
    events = moving_dot(4000, (1 << bits) - 500_000)
    parts = np.split(events, 20)
    made = []
    for i, part in enumerate(parts):
        short = part.copy()
        short["t"] -= int(part["t"][0]) >> bits << bits
        made += messages(short, encoding, host_us=i * 50_000, seq=i)
    packets, found, counts = read(store(tmp_path / "a.mcap", made))
    np.testing.assert_array_equal(found, events)
    assert {packet.epoch for packet in packets} == {0}
    assert counts == {"wraps": 1}


@pytest.mark.parametrize("package", ["event_camera_msgs/EventPacket", "dvs_msgs/EventArray"])
def test_a_ros1_message_that_is_cut_short_is_counted(tmp_path, package):
    made = [
        replace(m, data=m.data[: 30 if i == 3 else None])
        for i, m in enumerate(
            map(ros1_packet, messages(moving_dot(4000, 0)))
            if "camera" in package
            else map(ros1_array, arrays(moving_dot(4000, 0)))
        )
    ]
    with open_recording(store(tmp_path / "a.mcap", made, schema=package, encoding="ros1")) as recording:
        assert recording.n_events == 3800
        assert recording.losses.counts == {"bad packet": 1}
        assert "message 4" in recording.losses.first["bad packet"]


def test_messages_compressed_one_by_one(tmp_path):
    events = moving_dot(4000, 5_000_000)
    made = [replace(m, data=zstandard.compress(m.data)) for m in messages(events)]
    np.testing.assert_array_equal(read(store(tmp_path / "a.mcap", made))[1], events)


# --- files cut short


@pytest.mark.parametrize("keep", [0.3, 0.6, 0.9])
def test_whole_messages_of_a_cut_chunk_are_recovered(run, tmp_path, keep):
    events = moving_dot(4000, 5_000_000)
    whole = store(
        tmp_path / "a.mcap", messages(events), chunk_size=1 << 20, compression=CompressionType.NONE
    ).read_bytes()
    cut = tmp_path / "cut.mcap"
    payloads = [whole.find(message.data) + len(message.data) for message in messages(events)]
    cut.write_bytes(whole[: int(payloads[-1] * keep)])
    n = 200 * sum(end <= cut.stat().st_size for end in payloads)
    assert 0 < n < 4000
    said = run("recover", cut, tmp_path / "b.mcap", "--json")
    assert said.status == 0
    np.testing.assert_array_equal(read(tmp_path / "b.mcap")[1], events[:n])
    assert f"the file ends at byte {cut.stat().st_size}" in run("info", cut).err


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_where_nothing_can_be_recovered_the_command_fails(run, tmp_path, compression):
    whole = store(
        tmp_path / "a.mcap", messages(moving_dot(4000, 0)), chunk_size=1 << 20, compression=compression
    )
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:5000])
    said = run("recover", cut, tmp_path / "b.mcap")
    assert said.status == 2
    assert "no whole message could be recovered" in said.err
    assert not (tmp_path / "b.mcap").exists()


# --- what is shown, and what goes on


def test_the_digest_is_of_the_events_alone(run, tmp_path):
    events = moving_dot(4000, 5_000_000)
    wanted = hashlib.sha256(
        b"".join(struct.pack("<HHBq", e["x"], e["y"], e["p"], e["t"]) for e in events)
    ).hexdigest()
    for name, made in {
        "plain": messages(events),
        "other packets": messages(events, "evt3", n=33),
        "copies backwards": messages(events, "libcaer")[::-1] * 2,
    }.items():
        assert run("info", store(tmp_path / f"{name}.mcap", made), "--json").json["digest"] == wanted


def test_info_tells_what_happened(run, tmp_path):
    made = messages(moving_dot(4000, 5_000_000)) + messages(moving_dot(4000, 0), host_us=3_000_000)
    said = run("info", store(tmp_path / "a.mcap", made[:4] + made[5:] + made[30:31]), "--json").json
    assert (said["restarts"], said["lost"], said["duplicates"], said["stray_packets"]) == (1, 1, 1, 0)


def test_a_looped_recording_goes_on_with_its_labels_and_epochs(tmp_path):
    made = messages(moving_dot(400, 5_000_000)) + messages(moving_dot(400, 0), host_us=3_000_000)
    with open_recording(store(tmp_path / "a.mcap", made)) as recording:
        played = [item for item, _ in zip(recording.played(loop=True), range(12), strict=False)]
    assert [packet.epoch for packet in played] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    # one round spans 5.0998 s, and a second of silence follows
    step_us = 5_099_750 + 1_000_000
    starts = [int(packet.events["t"][0]) for packet in played]
    assert starts[4:8] == [start + step_us for start in starts[:4]]


def test_labels_of_a_looped_recording_are_shifted(tmp_path):
    label = Label(5_010_000, 20_000, "car")
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        writer.write_label(label)
        writer.write_events(moving_dot(400, 5_000_000), (HEIGHT, WIDTH))
    with open_recording(tmp_path / "a.mcap") as recording:
        played = [item for item, _ in zip(recording.played(loop=True), range(6), strict=False)]
    shift_us = 99_750 + 1_000_000
    assert [item.start_us for item in played if isinstance(item, Label)] == [
        label.start_us + i * shift_us for i in range(3)
    ]


@pytest.mark.parametrize("again_us", [0, 1 << 50])
def test_a_jump_of_the_clock_neither_waits_nor_bursts(again_us):
    pace, now_s, dues = Pace(2.0), 100.0, []
    for epoch, start_us in enumerate([5_000_000, again_us]):
        for i in range(5):
            t_us = start_us + 100_000 * i
            packet = Packet("", make_events([0], [0], [1], [t_us]), (HEIGHT, WIDTH), 0, 0, epoch=epoch)
            dues.append(pace.due(packet, t_us, now_s))
    assert dues == pytest.approx([100 + i / 20 for i in (0, 1, 2, 3, 4, 4, 5, 6, 7, 8)])


def test_windows_of_learning_begin_anew_with_the_clock(tmp_path):
    geometry = Geometry(patch=4, stride=4, n_bins=2, bin_us=1_000_000)
    made = messages(moving_dot(400, 5_000_000)) + messages(
        moving_dot(400, 5_000_000 - 600_000), host_us=1_000_000
    )
    with open_recording(store(tmp_path / "a.mcap", made)) as recording:
        windows = list(windows_of(recording.items(), geometry))
    assert [(window.origin_us, len(window.events)) for window in windows] == [
        (5_000_000, 400),
        (4_400_000, 400),
    ]


def evt3_at(times):
    """A packet of evt3 with these times in any order: one TIME_HIGH and one TIME_LOW for each."""
    words = []
    for i, t in enumerate(times):
        high, low = (int(t) >> 12) & 0xFFF, int(t) & 0xFFF
        words += [0x8000 | high, 0x6000 | low, i // 7 % HEIGHT, 0x2000 | i % WIDTH]
    return np.array(words, "<u2").tobytes()


@pytest.mark.parametrize("ahead_us", [4_000_000, 9_000_000, 12_000_000, 16_000_000, 3_600_000_000])
@pytest.mark.parametrize("number", [1, 10, 18])
@pytest.mark.parametrize("strays", [slice(0, 1), slice(100, 101), slice(199, 200), slice(0, 200)])
def test_strays_more_than_half_of_evt3s_range_ahead_are_no_wrap(tmp_path, ahead_us, number, strays):
    made = []
    for i, part in enumerate(np.split(moving_dot(4000, 5_000_000), 20)):
        times = part["t"].copy()
        if i == number:
            times[strays] += ahead_us
        log_ns = HOST_NS + i * 50_000_000
        message = EventPacket(log_ns, "cam", HEIGHT, WIDTH, i, 0, "evt3", False, evt3_at(times))
        made.append(Message(log_ns, message.to_cdr(), i))
    _, events, counts = read(store(tmp_path / "a.mcap", made))
    assert len(events) == 4000 - (strays.stop - strays.start)
    assert 5_000_000 <= events["t"].min() < events["t"].max() < 6_000_000
    assert (np.diff(events["t"]) > 0).all()
    n = strays.stop - strays.start
    assert (counts.pop("stray packets", 0), counts.pop("stray events", 0)) == ((1, 0) if n == 200 else (0, n))
    assert counts == {}


class TestInfoOfSeveral:
    def test_recordings_are_rows_of_a_table_and_what_cannot_be_read_a_line(self, run, tmp_path):
        good = [store(tmp_path / f"{n}.mcap", messages(moving_dot(n, 0))) for n in (400, 600)]
        (tmp_path / "bad.mcap").write_bytes(b"")
        said = run("info", *good, tmp_path / "bad.mcap")
        assert said.status == 1
        rows = [line.split() for line in said.out.splitlines()]
        assert [row[0] for row in rows] == ["file", "400.mcap", "600.mcap"]
        assert [row[4] for row in rows[1:]] == ["400", "600"]
        assert "bad.mcap: is empty" in said.err
        data = run("info", *good, "--json").json["recordings"]
        assert [row["events"] for row in data] == [400, 600]
        assert data[0]["digest"] == run("info", good[0], "--json").json["digest"]

    def test_two_cameras_are_two_rows(self, run, tmp_path):
        path = tmp_path / "two.mcap"
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start("ros2")
            for topic, n in (("/left", 400), ("/right", 600)):
                schema = writer.register_schema(EventPacket.SCHEMA_NAME, "ros2msg", b"")
                channel = writer.register_channel(topic, "cdr", schema)
                for m in messages(moving_dot(n, 0)):
                    writer.add_message(channel, m.log_ns, m.data, m.log_ns, m.seq)
            writer.finish()
        said = run("info", path, "--json")
        assert [(row["topic"], row["events"]) for row in said.json["recordings"]] == [
            ("/left", 400),
            ("/right", 600),
        ]
        assert run("info", path, "--topic", "/right", "--json").json["events"] == 600
        refused = run("latency", path, "-m", "none")
        assert refused.status == 2
        listed = run("info", path).out.splitlines()
        assert [line.split()[:2] for line in listed[1:]] == [["two.mcap", "/left"], ["two.mcap", "/right"]]

    @pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
    def test_a_file_cut_in_its_only_chunk_says_at_which_byte(self, run, tmp_path, compression):
        path = store(
            tmp_path / "a.mcap", messages(moving_dot(4000, 0)), chunk_size=1 << 20, compression=compression
        )
        path.write_bytes(path.read_bytes()[:5000])
        said = run("info", path)
        assert said.status == 2
        assert "no topic carries events" in said.err
        assert "the file ends at byte 5000" in said.err


@settings(deadline=None, max_examples=300)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([0, 1, 900, 999_999, 1_000_000, 1_000_001, -1, -400_000, -600_000, 70_000_000]),
            st.sampled_from([0, 1, 500, 1_000_000, 1_000_001, 3_000_000]),
            st.sampled_from([0, 1, 1, 1, 2, -1, -900_000]),
            st.sampled_from([0, 1_000, 2_000_000]),
        ),
        max_size=12,
    )
)
def test_a_packet_that_goes_on_is_placed_as_every_other(steps):
    """The short way and the long one give the same, whatever the times and numbers are."""
    short, long = Timeline("/events"), Timeline("/events")
    quick = _played(short, steps)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(CameraClock, "goes_on", lambda *args: False)
        slow = _played(long, steps)
    assert quick == slow
    assert short.counts == long.counts
    assert short.snapshot(0) == long.snapshot(0)


def _played(timeline, steps):
    """What comes of packets of ten events, from steps of: first time, last time, number, and log time."""
    t_us, seq, log_ns, out = 10_000_000, 5, HOST_NS, []
    for first, span, number, passed_us in steps:
        t_us, seq, log_ns = max(t_us + first, 0), max(seq + number, 0), log_ns + passed_us * 1000
        payload, base_ns = encode(make_events(np.arange(10), 3, 1, [t_us] * 9 + [t_us + span]), "mono")
        packet = EventPacket(log_ns, "cam", HEIGHT, WIDTH, seq, base_ns, "mono", False, payload)
        out += timeline.message(EventPacket.SCHEMA_NAME, packet.to_cdr(), log_ns, seq)
        t_us += span
    out += timeline.finish()
    return [(p.seq, p.log_time_ns, p.lost, p.epoch, p.until_us, p.events.tolist()) for p in out]
