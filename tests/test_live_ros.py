"""ROS 2 without ROS: a plain zenoh session speaks what the design document of rmw_zenoh says, to the byte."""

import struct
import subprocess
import sys
import threading

import numpy as np
import pytest
import tiny
from live_net import Collector, ListSink, compiled, free_port, plain_session, running, until
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory  # an independent reader of CDR

from streamfeat.events import make_events
from streamfeat.live.listen import ListenJob
from streamfeat.live.names import PlainNames, RosNames
from streamfeat.live.network import FoundTopic, Network, find_topics
from streamfeat.live.publish import PublishJob
from streamfeat.live.survey import hear_topics
from streamfeat.stream.outputs import Outputs

pytestmark = pytest.mark.real_time

MODEL = tiny.encoder(k=3)
HASH = "RIHS01_d6fa176260b1f37e5a40845305315e150a0f18191241eb64f407442aa29844aa"
TYPE = "event_camera_msgs::msg::dds_::EventPacket_"
KEY = f"0/event_camera/events/{TYPE}/{HASH}"
"""`<domain_id>/<fully_qualified_name>/<type_name>/<type_hash>`"""
ZID = "8b20917502ee955ac4476e0266340d5c"
TOKEN = f"@ros2_lv/0/{ZID}/0/10/MP/%/%/driver/%event_camera%events/{TYPE}/{HASH}/2::,10:,:,:,,"
"""`@ros2_lv/<domain>/<session>/<node>/<entity>/MP/<enclave>/<namespace>/<node>/<topic>/<type>/<hash>/<qos>`"""


def attachment(seq, source_ns):
    """Sequence number and timestamp as 8 little-endian bytes each, the length of the GID, the GID."""
    return seq.to_bytes(8, "little") + source_ns.to_bytes(8, "little") + b"\x10" + bytes(range(16))


def cdr(events, seq, time_base_ns):
    """An EventPacket of 16x12 pixels, encoding mono, laid out by the rules of CDR."""
    words = b"".join(
        struct.pack("<IHH", (int(t) * 1000 - time_base_ns), x, y | p << 15)
        for x, y, p, t in events[["x", "y", "p", "t"]].tolist()
    )
    body = struct.pack("<iI", 7, 500) + struct.pack("<I", 4) + b"cam\0"  # 16 bytes
    body += struct.pack("<II", 12, 16)  # height, width
    body += struct.pack("<QQ", seq, time_base_ns)
    body += struct.pack("<I", 5) + b"mono\0" + b"\0"  # 50 bytes, then two to align
    body += b"\0\0" + struct.pack("<I", len(words)) + words
    return b"\x00\x01\x00\x00" + body


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    MODEL.save(folder / "model")
    return compiled(folder) / "model"


def test_listening_to_a_ros_camera(model):
    port, sink = free_port(), ListSink()
    job = ListenJob(
        RosNames("/event_camera/events"),
        model,
        emit="50ms",
        network=Network(port=port),
        silence_s=1e9,
        patience_s=1e9,
    )
    sent = [tiny.steady(i * 10_000, (i + 1) * 10_000, 100, seed=i) for i in range(12)]
    with plain_session(port, listen=True) as net:
        # As rmw_zenoh does: the topic of the features with `*` for the hash.
        out = Collector(net, "0/event_camera/features/streamfeat_msgs::msg::dds_::Features_/*")
        token = net.liveliness().declare_token(TOKEN)
        with running(job, Outputs(more=sink)), net.declare_publisher(KEY) as camera:
            until(lambda: camera.matching_status.matching)
            for i, events in enumerate(sent):
                camera.put(cdr(events, i, i * 10_000_000), attachment=attachment(i + 1, 10**18 + i))
            until(lambda: job.result()["events"] == 1200 and len(out.samples) == 2)
            # Nodes, publishers and subscriptions of ours are in the ROS graph.
            seen = [str(reply.ok.key_expr).split("/") for reply in net.liveliness().get("@ros2_lv/0/**")]
            ours = sorted(chunks[5:] for chunks in seen if chunks[2] != ZID)
            zids = {chunks[2] for chunks in seen if chunks[2] != ZID}
            expected = [FoundTopic("/event_camera/events", "ros2", 0, 1)]
            until(lambda: find_topics(net, 0.05) == expected)
            token.undeclare()
            until(lambda: job._cameras.topics == [])
    assert zids != set()
    assert ["MS", "%", "%", "streamfeat_listener", "%event_camera%events", TYPE, HASH, "::,10:,:,:,,"] in ours
    features = ["%event_camera%features", "streamfeat_msgs::msg::dds_::Features_"]
    assert any(chunks[0] == "MP" and chunks[4:6] == features for chunks in ours)
    assert [chunks[0] for chunks in ours].count("NN") == 2
    everything = np.concatenate(sent)
    assert [e.t_us for e in sink.emissions[:2]] == [50_000, 100_000]
    for e, (key, _, attached, _) in zip(sink.emissions[:2], out.samples[:2], strict=True):
        before = everything[everything["t"] < e.t_us]
        expected = MODEL.encode(before, tiny.RESOLUTION, origin_us=0, t_us=e.t_us - 1)
        assert np.array_equal(e.features, expected)
        assert key.split("/")[-1].startswith("RIHS01_")
        assert len(attached) == 33
        assert attached[16] == 16
    assert [int.from_bytes(sample[2][:8], "little") for sample in out.samples[:2]] == [1, 2]
    assert sink.emissions[0].source_ns == 10**18 + 5


def test_publishing_as_a_ros_camera(tmp_path):
    port = free_port()
    events = make_events([1, 2, 15], [3, 4, 11], [1, 0, 1], [1_000_000, 1_000_010, 1_000_500])
    recording = tiny.write_items(tmp_path / "r.mcap", [tiny.packet(events)])
    names = RosNames("/event_camera/events", 3)
    job = PublishJob(
        [(recording, "/event_camera/events")], names, speed=None, network=Network(port=port), wait_s=30
    )
    key = f"3/event_camera/events/{TYPE}/{HASH}"
    with plain_session(port, listen=True) as net:
        tokens = []
        watch = net.liveliness().declare_subscriber(
            "@ros2_lv/3/**", lambda sample: tokens.append((str(sample.kind), str(sample.key_expr)))
        )
        got = Collector(net, f"3/event_camera/events/{TYPE}/*")
        job.run()
        until(lambda: got.samples and len(tokens) == 4)
        watch.undeclare()
    ((where, payload, attached, _),) = got.samples
    assert where == key
    text = (
        "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
        "bool is_bigendian\nuint8[] events\n"
        "===\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
        "===\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
    )
    schema = Schema(1, text.replace("===", "=" * 80).encode(), "ros2msg", "event_camera_msgs/msg/EventPacket")
    decoded = DecoderFactory().decoder_for("cdr", schema)(payload)
    assert (decoded.height, decoded.width, decoded.seq, decoded.encoding) == (12, 16, 0, "mono")
    assert decoded.header.stamp.sec == 1
    words = [struct.unpack("<IHH", bytes(decoded.events[i : i + 8])) for i in range(0, 24, 8)]
    assert [(x, y & 0x7FFF, y >> 15) for _, x, y in words] == [(1, 3, 1), (2, 4, 0), (15, 11, 1)]
    assert [decoded.time_base + dt for dt, *_ in words] == [10**9, 10**9 + 10_000, 10**9 + 500_000]
    seq, source_ns, length = struct.unpack_from("<qqB", attached)
    assert (len(attached), seq, length) == (33, 1, 16)
    assert source_ns > 10**18
    came = [name.split("/")[5] for kind, name in tokens if kind.endswith("PUT")]
    left = [name.split("/")[5] for kind, name in tokens if kind.endswith("DELETE")]
    assert sorted(came) == sorted(left) == ["MP", "NN"]
    publisher = next(name for _, name in tokens if "/MP/" in name).split("/")
    assert len(publisher) == 13
    assert publisher[8:12] == ["streamfeat", "%event_camera%events", TYPE, HASH]


def test_other_domains_and_other_types_are_not_heard(model):
    port = free_port()
    job = ListenJob(RosNames("/event_camera/events", 5), model, network=Network(port=port))
    events = tiny.steady(0, 1000, 10)
    with (
        plain_session(port, listen=True) as net,
        running(job),
        net.declare_publisher(KEY.replace("0/", "5/", 1)) as camera,
    ):
        until(lambda: camera.matching_status.matching)
        net.put(KEY, cdr(events, 0, 0), attachment=attachment(1, 1))
        net.put(KEY.replace("0/", "5/", 1).replace("EventPacket_", "Other_"), b"x")
        camera.put(cdr(events, 0, 0), attachment=attachment(1, 1))
        until(lambda: job.result()["packets"] == 1)
    assert job.result()["events"] == 10
    assert job.result()["warnings"] == {}


def test_topics_of_both_kinds_are_found():
    port = free_port()
    gid = "ab" * 16
    with plain_session(port, listen=True) as net:
        with plain_session(port) as other:
            tokens = [
                other.liveliness().declare_token(token)
                for token in (
                    TOKEN,
                    TOKEN.replace("/10/MP", "/11/MP"),
                    TOKEN.replace("EventPacket_", "Imu_"),
                    TOKEN.replace("/MP/", "/MS/"),
                    TOKEN.replace("@ros2_lv/0/", "@ros2_lv/7/"),
                    f"{PlainNames('x').token('robot/cam0/events', bytes.fromhex(gid))}",
                )
            ]
            found = until(lambda: len(topics := find_topics(net, 0.05)) == 3 and topics)
            assert found == [
                FoundTopic("/event_camera/events", "ros2", 0, 2),
                FoundTopic("/event_camera/events", "ros2", 7, 1),
                FoundTopic("robot/cam0/events", "zenoh", -1, 1),
            ]
            assert len(tokens) == 6
        # Whoever published them has left, and its tokens with it.
        until(lambda: find_topics(net, 0.05) == [])


NO_HASH = "TypeHashNotSupported"
"""What rmw_zenoh writes in ROS 2 Humble, which has no type hashes (ros2/rmw_zenoh, pull request 388)."""


def test_a_camera_of_humble_is_heard(model):
    port = free_port()
    job = ListenJob(RosNames("/event_camera/events"), model, network=Network(port=port))
    with plain_session(port, listen=True) as net:
        token = net.liveliness().declare_token(TOKEN.replace(HASH, NO_HASH))
        with running(job), net.declare_publisher(KEY.replace(HASH, NO_HASH)) as camera:
            until(lambda: camera.matching_status.matching)
            camera.put(cdr(tiny.steady(0, 1000, 10), 0, 0), attachment=attachment(1, 1))
            until(lambda: job.result()["events"] == 10)
            until(lambda: find_topics(net, 0.05) == [FoundTopic("/event_camera/events", "ros2", 0, 1)])
        token.undeclare()


@pytest.mark.parametrize(("has_hashes", "last"), [(True, HASH), (False, NO_HASH)])
def test_publishing_to_each_distribution(tmp_path, has_hashes, last):
    """A subscription of Humble has the key without a hash, to the letter."""
    port = free_port()
    recording = tiny.write_items(tmp_path / "r.mcap", [tiny.packet(tiny.steady(0, 1000, 10))])
    names = RosNames("/event_camera/events", 0, has_hashes)
    job = PublishJob(
        [(recording, "/event_camera/events")], names, speed=None, network=Network(port=port), wait_s=30
    )
    with plain_session(port, listen=True) as net:
        tokens = []
        watch = net.liveliness().declare_subscriber("@ros2_lv/0/**", lambda s: tokens.append(str(s.key_expr)))
        got = Collector(net, f"0/event_camera/events/{TYPE}/{last}")
        job.run()
        until(lambda: len(got.samples) == 1)
        until(lambda: any(f"/{TYPE}/{last}/" in token for token in tokens))
        watch.undeclare()


def test_results_go_where_humble_listens(model):
    port = free_port()
    names = RosNames("/event_camera/events", 0, has_hashes=False)
    job = ListenJob(names, model, emit="10ms", network=Network(port=port))
    with plain_session(port, listen=True) as net:
        out = Collector(net, f"0/event_camera/features/streamfeat_msgs::msg::dds_::Features_/{NO_HASH}")
        with running(job), net.declare_publisher(KEY.replace(HASH, NO_HASH)) as camera:
            until(lambda: camera.matching_status.matching)
            camera.put(cdr(tiny.steady(0, 50_000, 100), 0, 0), attachment=attachment(1, 1))
            until(lambda: out.samples)


def test_what_topics_carry():
    port = free_port()
    plain = "robot/cam0/events"
    with plain_session(port, listen=True) as net, plain_session(port) as other:
        announced = TOKEN.replace(HASH, NO_HASH), PlainNames("x").token(plain, bytes(16))
        tokens = [other.liveliness().declare_token(token) for token in announced]
        found = until(lambda: len(topics := find_topics(net, 0.05)) == 2 and topics)
        with running(_Sender(other, (KEY.replace(HASH, NO_HASH), plain))):
            heard = until(lambda: all((h := hear_topics(net, found, 0.2))[i].rate_hz for i in (0, 1)) and h)
    assert len(tokens) == 2
    for topic in heard:
        about = topic.type, topic.encoding, topic.resolution
        assert about == ("event_camera_msgs/msg/EventPacket", "mono", (12, 16))
        assert topic.bytes_per_s == pytest.approx(topic.rate_hz * len(cdr(tiny.steady(0, 1000, 10), 0, 0)))


class _Sender:
    """Puts a packet on each key, again and again, until it is stopped."""

    def __init__(self, session, keys):
        self._session, self._keys, self._is_on = session, keys, True

    def run(self):
        data = cdr(tiny.steady(0, 1000, 10), 0, 0)
        while self._is_on:
            for key in self._keys:
                self._session.put(key, data)
            threading.Event().wait(0.005)

    def stop(self):
        self._is_on = False


MALFORMED = {
    "a domain of 5,000 digits": TOKEN.replace("_lv/0/", f"_lv/{'7' * 5000}/"),
    "a domain that is no number": TOKEN.replace("_lv/0/", "_lv/x/"),
    "a topic without a name": TOKEN.replace("%event_camera%events", "%"),
    "too few parts": "@ros2_lv/0/x/MP",
    "wildcards in its name": TOKEN.replace("%event_camera%events", "%@x"),
}


def test_a_malformed_token_ends_nothing():
    port = free_port()
    newline = TOKEN.replace("%event_camera%events", "%event\ncamera%\x1b[31mevents")
    with plain_session(port, listen=True) as net, plain_session(port) as other:
        announced = *MALFORMED.values(), newline, TOKEN
        tokens = [other.liveliness().declare_token(token) for token in announced]
        found = until(lambda: len(topics := find_topics(net, 0.1)) >= 2 and topics)
        names = [topic.name for topic in found]
        assert "/event_camera/events" in names
        assert "/event\ncamera/\x1b[31mevents" in names
        assert {topic.domain for topic in found} == {0}
        assert len(hear_topics(net, found, 0.01)) == len(found)
        said = run_topics(port)
    assert len(said.splitlines()) == len(found) < len(tokens)
    assert "\x1b" not in said


def run_topics(port):
    words = [sys.executable, "-m", "streamfeat", "topics", "--port", str(port), "--seconds", "0.3"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True)
    assert done.stderr == ""
    return done.stdout
