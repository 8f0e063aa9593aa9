"""Labels from a topic of the recording, and from a camera file itself."""

import struct

import numpy as np
import pytest
import tiny
from mcap.writer import Writer
from test_timeline import HEIGHT, HOST_NS, STEP_US, WIDTH, messages, moving_dot

from streamfeat.errors import InputError
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.text_messages import parse_text
from streamfeat.recordings.options import ReadOptions
from streamfeat.recordings.reader import open_recording

STRING = "std_msgs/msg/String"


def aligned(data, size):
    return data + bytes(-(len(data) - 4) % size)


def text_cdr(text):
    raw = text.encode() + b"\0"
    return struct.pack("<I", len(raw)) + raw


def header_cdr(stamp_ns):
    return struct.pack("<iI", *divmod(stamp_ns, 10**9)) + text_cdr("cam")


def string(text, stamp_ns=0, ros1=False):
    raw = text.encode()
    return struct.pack("<I", len(raw)) + raw if ros1 else b"\0\1\0\0" + text_cdr(text)


def stamped(text, stamp_ns, ros1=False):
    if ros1:
        head = struct.pack("<III", 7, *divmod(stamp_ns, 10**9)) + struct.pack("<I", 3) + b"cam"
        return head + string(text, ros1=True)
    return aligned(b"\0\1\0\0" + header_cdr(stamp_ns), 4) + text_cdr(text)


def classification(text, stamp_ns, ros1=False):
    data = aligned(b"\0\1\0\0" + header_cdr(stamp_ns), 4) + struct.pack("<I", 2 if text else 0)
    for name, score in ((text, 0.9), ("another", 0.1)) if text else ():
        data = aligned(data, 4) + text_cdr(name)
        data = aligned(data, 8) + struct.pack("<d", score)
    return data


def write(path, texts, *, kind=STRING, make=string, topic="/state", ros1=False, late_ns=0):
    """4,000 events, and texts at times since the first event; all by the clock of the host."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4096)
        writer.start("ros2")
        encoding = "ros1" if ros1 else "cdr"
        channels = [
            writer.register_channel(name, code, writer.register_schema(schema, "", b""))
            for name, schema, code in (
                ("/events", EventPacket.SCHEMA_NAME, "cdr"),
                (topic, kind.replace("/msg", "") if ros1 else kind, encoding),
            )
        ]
        entries = [(m.log_ns, channels[0], m.data, m.seq) for m in messages(moving_dot(4000, 7_000_000))]
        for seq, (us, text) in enumerate(texts):
            stamp_ns = HOST_NS + us * 1000
            data = make(text, stamp_ns, ros1)
            entries.append((stamp_ns + (late_ns if make is not string else 0), channels[1], data, seq))
        for at_ns, channel, data, seq in sorted(entries, key=lambda entry: entry[0]):
            writer.add_message(channel, at_ns, data, at_ns, seq)
        writer.finish()
    return path


TEXTS = [(100_000, "left"), (150_000, "left"), (300_000, "right"), (500_000, ""), (700_000, "left")]
SPANS = [("left", 100_000, 300_000), ("right", 300_000, 500_000), ("left", 700_000, 1_000_001)]
"""The last one holds to the end."""


def check(path, topic="/state"):
    events = moving_dot(4000, 7_000_000)
    with open_recording(path, options=ReadOptions(labels=topic)) as recording:
        samples = list(recording.samples())
        stream = np.concatenate([*recording])
    np.testing.assert_array_equal(stream, events)
    assert [sample.label.label for sample in samples] == [name for name, *_ in SPANS]
    for sample, (_, start, stop) in zip(samples, SPANS, strict=True):
        # A packet is logged with its last event, one step before the next begins.
        t = events["t"] - 7_000_000 + STEP_US
        wanted = events[(t >= start) & (t < stop)]
        np.testing.assert_array_equal(sample.events, wanted)


KINDS = {
    "text": {},
    "text of ROS 1": {"ros1": True},
    "stamped": {"kind": "std_stamped_msgs/msg/StringStamped", "make": stamped, "late_ns": 40_000_000},
    "stamped of ROS 1": {
        "kind": "std_stamped_msgs/msg/StringStamped", "make": stamped, "late_ns": 40_000_000, "ros1": True,
    },
    "classification": {
        "kind": "vision_msgs/msg/Classification", "make": classification, "late_ns": 40_000_000,
    },
}  # fmt: skip


@pytest.mark.parametrize("options", KINDS.values(), ids=KINDS)
def test_a_text_holds_until_the_next_one(tmp_path, options):
    check(write(tmp_path / "a.mcap", TEXTS, **options))


@pytest.mark.parametrize(
    ("name", "code", "value"),
    [("Bool", "?", True), ("Int8", "b", -3), ("UInt16", "H", 60_000), ("Int64", "q", 2**63 - 1)],
)
@pytest.mark.parametrize("layout", ["cdr", "ros1"])
def test_numbers_are_texts(name, code, value, layout):
    data = (b"" if layout == "ros1" else b"\0\1\0\0") + struct.pack(f"<{code}", value)
    wanted = "true" if value is True else str(value)
    assert parse_text(f"std_msgs/msg/{name}", data, layout).text == wanted


@pytest.mark.parametrize(
    ("kind", "layout", "whole"),
    [
        (STRING, "ros1", string("left", ros1=True)),
        (STRING, "cdr", string("left")),
        ("std_msgs/msg/Int64", "ros1", struct.pack("<q", -5)),
        ("std_msgs/msg/Int64", "cdr", b"\0\1\0\0" + struct.pack("<q", -5)),
        ("std_stamped_msgs/msg/StringStamped", "ros1", stamped("left", 5, ros1=True)),
        ("std_stamped_msgs/msg/StringStamped", "cdr", stamped("left", 5)),
        ("vision_msgs/msg/Classification", "cdr", classification("left", 5)),
    ],
)
def test_a_message_cut_short_is_refused(kind, layout, whole):
    assert parse_text(kind, whole, layout).text in ("left", "-5")
    for n in range(len(whole)):
        with pytest.raises(InputError, match=kind):
            parse_text(kind, whole[:n], layout)


def test_bad_messages_are_left_out_and_said(tmp_path):
    def broken(text, stamp_ns, ros1):
        return b"\0\1\0\0\xff\xff\xff\x7f" if text == "bad" else string(text)

    path = write(tmp_path / "a.mcap", [*TEXTS[:2], (200_000, "bad"), *TEXTS[2:]], make=broken)
    check(path)
    with open_recording(path, options=ReadOptions(labels="/state")) as recording:
        assert "1 messages of topic /state are left out" in recording.assumptions[0]


class TestWhatIsWrong:
    def test_no_such_topic_or_file(self, tmp_path):
        path = write(tmp_path / "a.mcap", TEXTS)
        with pytest.raises(InputError, match=r"/stat: labels cannot be read.*can be labels: /state"):
            open_recording(path, options=ReadOptions(labels="/stat"))

    def test_a_topic_of_another_type(self, tmp_path):
        path = write(tmp_path / "a.mcap", TEXTS, kind="sensor_msgs/msg/Imu")
        with pytest.raises(InputError, match=r"topic /state says no label.*Imu.*std_msgs/msg/String"):
            open_recording(path, options=ReadOptions(labels="/state"))

    def test_a_topic_without_texts(self, tmp_path):
        path = write(tmp_path / "a.mcap", [(100_000, "")])
        with pytest.raises(InputError, match="holds no text to label"):
            open_recording(path, options=ReadOptions(labels="/state"))


def test_a_bag_of_sqlite_has_its_labels_too(tmp_path):
    rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="rosbags is not installed")
    from test_bags import TYPE, types

    store = types()
    with rosbag2.Writer(tmp_path / "bag", version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as writer:
        camera = writer.add_connection("/camera/events", TYPE, typestore=store)
        state = writer.add_connection("/state", STRING, typestore=store)
        for m in messages(moving_dot(4000, 7_000_000)):
            writer.write(camera, m.log_ns, m.data)
        for us, text in TEXTS:
            writer.write(state, HOST_NS + us * 1000, string(text))
    check(tmp_path / "bag")


def test_commands_take_them(run, tmp_path):
    texts = [(50_000 * i, ("left", "right")[i % 2]) for i in range(20)]
    path = write(tmp_path / "a.mcap", texts)
    model = tmp_path / "m.safetensors"
    tiny.encoder().save(model)
    clf = tmp_path / "c.safetensors"
    done = run("train", path, "-m", model, "-o", clf, "--labels", "/state", "--groups", "none", "--json")
    assert (done.status, done.json["samples"]) == (0, 20), done.err
    assert run("replay", path, "-m", model, "-c", clf, "--labels", "/state", "--json").json["samples"] == 20
    assert run("info", path, "--labels", "/state", "--json").json["samples"] == 20
    out = run("convert", path, tmp_path / "b.mcap", "--labels", "/state", "--json")
    assert out.status == 0, out.err
    with open_recording(tmp_path / "b.mcap") as written:
        assert [label.label for label in written.labels] == ["left", "right"] * 10
    said = run(
        "evaluate", path, "--labels", "/state", "--method", "counts", "--patch", "4", "--bins", "2",
        "--groups", "none", "--folds", "2", "--early-samples", "0", "--json",
    )  # fmt: skip
    assert said.status == 0, said.err
    assert said.json["labels"] == ["left", "right"]


class TestCameraFiles:
    def save(self, path, **more):
        e = moving_dot(100, 5_000)
        np.savez(path, x=e["x"], y=e["y"], p=e["p"], t=e["t"], **more)
        return path

    def test_a_file_that_says_what_it_shows_is_one_sample(self, tmp_path):
        path = self.save(tmp_path / "a.npz", label=3, resolution=[HEIGHT, WIDTH])
        with open_recording(path) as recording:
            (sample,) = recording.samples()
            assert (sample.label.label, sample.label.source) == ("3", "a.npz")
            np.testing.assert_array_equal(sample.events, moving_dot(100, 5_000))

    @pytest.mark.parametrize(
        ("more", "wanted"),
        [
            ({"class": 2, "subject": 7}, "2"),
            ({"subject": 7}, "7"),
            ({"subject": 7, "trial": 1}, None),
            ({}, None),
        ],
    )
    def test_which_of_several_members_it_is(self, tmp_path, more, wanted):
        with open_recording(self.save(tmp_path / "a.npz", **more)) as recording:
            assert [label.label for label in recording.labels] == ([wanted] if wanted else [])
            assert recording.is_labelled == (wanted is not None)


def test_the_label_files_of_dvs_gesture(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, TEXTS)
    (tmp_path / "l.csv").write_text(
        "class,startTime_usec,endTime_usec\n1,7100000,7300000\n4,7400000,7500000\n"
    )
    with open_recording(path, options=ReadOptions(labels=str(tmp_path / "l.csv"))) as recording:
        assert [(label.label, label.start_us) for label in recording.labels] == [
            ("1", 7_100_000),
            ("4", 7_400_000),
        ]
