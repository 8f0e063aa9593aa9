"""Bags of ROS 2 and ROS 1, and several files, read as one recording: what `rosbags` writes, and what people
make of it.
"""

import sqlite3
from pathlib import Path

import numpy as np
import pytest
import tiny

import streamfeat as sf
from streamfeat.errors import InputError
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.packets import PacketWriter
from streamfeat.recordings.bags import read_metadata

RESOLUTION = tiny.RESOLUTION
TOPIC = "/camera/events"
TYPE = EventPacket.SCHEMA_NAME

rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="rosbags is not installed")
typesys = pytest.importorskip("rosbags.typesys")


def events(n=2_000):
    return tiny.steady(5_000_000, 6_000_000, n)


def packets(n=20, encoding="mono"):
    """`n` packets of the events, as messages, 50 ms apart."""
    writer = PacketWriter(encoding)
    return [m for part in np.array_split(events(), n) for m in writer.messages(part, RESOLUTION)]


def types():
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    store.register(typesys.get_types_from_msg(EventPacket.SCHEMA.partition("=" * 20)[0], TYPE))
    return store


def write_bag(folder, *, storage="mcap", compression=None, messages=None, topic=TOPIC):
    """A rosbag2 folder, by the writer of `rosbags`."""
    plugin = {"mcap": rosbag2.StoragePlugin.MCAP, "sqlite3": rosbag2.StoragePlugin.SQLITE3}[storage]
    writer = rosbag2.Writer(folder, version=9, storage_plugin=plugin)
    if compression:
        mode = {"message": rosbag2.CompressionMode.MESSAGE, "file": rosbag2.CompressionMode.FILE}[compression]
        writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(topic, TYPE, typestore=types())
        for message in messages if messages is not None else packets():
            writer.write(connection, 10**18 + message.stamp_ns, message.to_cdr())
    return folder


def write_split(folder, n=2, **options):
    """A bag of several files: such as `ros2 bag record --max-bag-size` writes."""
    folder.mkdir()
    for i, part in enumerate(np.array_split(np.array(packets(), object), n)):
        one = write_bag(folder / f"part{i}", messages=part, **options)
        (file,) = (f for f in one.iterdir() if f.name != "metadata.yaml")
        file.rename(folder / f"bag_{i}{''.join(file.suffixes)}")
        metadata = (one / "metadata.yaml").read_text()
        (one / "metadata.yaml").unlink()
        one.rmdir()
    names = "\n".join(f"  - bag_{i}.mcap" for i in range(n))
    head, _, rest = metadata.partition("  relative_file_paths:")
    rest = rest[rest.index("  ros_distro") :]
    head = head[: head.index("  files:")] + "  message_count: 20\n"
    text = f"{head}  relative_file_paths:\n{names}\n{rest}".replace(f"count: {20 // n}", "count: 20")
    (folder / "metadata.yaml").write_text(text)
    return folder


def read(path, topic=None):
    with sf.open_recording(path, topic) as recording:
        found = np.concatenate([*recording, np.zeros(0, sf.EVENT_DTYPE)])
        return found, recording


KINDS = {
    "mcap": {},
    "mcap by message": {"compression": "message"},
    "mcap by file": {"compression": "file"},
    "sqlite3": {"storage": "sqlite3"},
    "sqlite3 by message": {"storage": "sqlite3", "compression": "message"},
    "sqlite3 by file": {"storage": "sqlite3", "compression": "file"},
}


@pytest.mark.parametrize("options", KINDS.values(), ids=KINDS)
def test_a_bag_is_a_recording(tmp_path, options):
    found, recording = read(write_bag(tmp_path / "bag", **options))
    np.testing.assert_array_equal(found, events())
    assert (recording.topic, recording.resolution) == (TOPIC, RESOLUTION)
    assert not recording.losses
    assert recording.assumptions == []


@pytest.mark.parametrize("options", KINDS.values(), ids=KINDS)
def test_so_is_its_file_alone(tmp_path, options):
    folder = write_bag(tmp_path / "bag", **options)
    (file,) = (f for f in folder.iterdir() if f.name != "metadata.yaml")
    np.testing.assert_array_equal(read(file)[0], events())


@pytest.mark.parametrize("n", [2, 3, 5])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_split_bag_is_one_recording(tmp_path, n, storage):
    found, recording = read(write_split(tmp_path / "bag", n, storage=storage))
    np.testing.assert_array_equal(found, events())
    assert sum(t.n_messages for t in recording.topics) == 20


@pytest.mark.parametrize("encoding", ["mono", "evt3"])
def test_features_of_a_split_bag_are_those_of_the_one_file(tmp_path, encoding):
    whole, parts = packets(encoding=encoding), []
    write_bag(tmp_path / "whole", messages=whole)
    for i, part in enumerate((whole[:7], whole[7:])):
        folder = write_bag(tmp_path / f"part{i}", messages=part)
        parts.append(next(folder.glob("*.mcap")))
    features = []
    for path in (tmp_path / "whole", parts, parts[::-1]):
        engine = sf.Engine(tiny.encoder(), RESOLUTION)
        found, recording = read(path)
        assert not recording.losses
        for batch in np.array_split(found, 13):
            engine.feed(batch)
        features.append(engine.features())
    assert features[0].any()
    np.testing.assert_array_equal(features[0].view(np.uint32), features[1].view(np.uint32))
    np.testing.assert_array_equal(features[0].view(np.uint32), features[2].view(np.uint32))


class TestSeveralFiles:
    @pytest.fixture
    def files(self, tmp_path):
        found = []
        for i, part in enumerate(np.array_split(np.array(packets(), object), 3)):
            folder = write_bag(tmp_path / f"b{i}", messages=part)
            found.append(next(folder.glob("*.mcap")).rename(tmp_path / f"drive_{i}.mcap"))
        return found

    def test_a_list_a_pattern_and_names_with_commas(self, files, tmp_path):
        ways = [files[::-1], [str(f) for f in files], tmp_path / "drive_*.mcap", ",".join(map(str, files))]
        for way in ways:
            np.testing.assert_array_equal(read(way)[0], events())

    def test_files_whose_times_overlap_are_read_in_order_of_log_time(self, tmp_path):
        all_packets = packets()
        for i in range(2):
            write_bag(tmp_path / f"b{i}", messages=all_packets[i::2])
        found, _ = read([tmp_path / "b0" / "b0.mcap", tmp_path / "b1" / "b1.mcap"])
        np.testing.assert_array_equal(found, events())

    def test_a_pattern_without_files_and_a_list_without_any(self, tmp_path):
        with pytest.raises(InputError, match="no file matches"):
            read(tmp_path / "none_*.mcap")
        with pytest.raises(InputError, match="at least one file"):
            read([])

    def test_pieces_of_work_open_the_same_files(self, files):
        with sf.open_recording(files) as recording:
            (part,) = recording.parts()
            with recording.part(part)() as again:
                np.testing.assert_array_equal(np.concatenate([*again]), events())


class TestBadBags:
    def test_a_cut_middle_file_costs_what_is_cut(self, tmp_path):
        folder = write_split(tmp_path / "bag", 4)
        middle = folder / "bag_1.mcap"
        middle.write_bytes(middle.read_bytes()[: middle.stat().st_size // 2])
        found, recording = read(folder)
        assert set(found["t"]) < set(events()["t"])
        assert {5_000_000 + 10_000, 5_990_000} & set((found["t"] // 10_000 * 10_000).tolist())
        assert len(found) >= 1_500
        assert recording.losses

    @pytest.mark.parametrize("keep", [0, 100, 0.5])
    @pytest.mark.parametrize("options", KINDS.values(), ids=KINDS)
    def test_a_cut_middle_file_is_named_and_counted(self, tmp_path, options, keep):
        folder = write_split(tmp_path / "bag", 4, **options)
        middle = sorted(folder.glob("bag_*"))[1]
        whole = middle.read_bytes()
        middle.write_bytes(whole[: int(keep * len(whole)) if keep < 1 else keep])
        found, recording = read(folder)
        assert 1_500 <= len(found) < 2_000
        np.testing.assert_array_equal(np.unique(found), np.unique(found[np.isin(found["t"], events()["t"])]))
        assert sum(recording.losses.counts.values()) == (2_000 - len(found)) // 100
        first = next(iter(recording.losses.first.values()))
        assert middle.name in first
        assert "streamfeat-" not in first  # where it was unpacked for the while

    def test_a_middle_file_of_rubbish_or_none(self, tmp_path):
        folder = write_split(tmp_path / "bag", 4)
        (folder / "bag_2.mcap").write_bytes(b"")
        found, recording = read(folder)
        assert len(found) == 1_500
        assert recording.losses.counts["unreadable file"] == 1
        assert "bag_2.mcap" in recording.losses.first["unreadable file"]

    def test_a_missing_file_is_named_and_its_messages_are_counted(self, tmp_path):
        folder = write_split(tmp_path / "bag", 4)
        (folder / "bag_3.mcap").unlink()
        found, recording = read(folder)
        assert len(found) == 1_500
        assert recording.losses.counts["missing message"] == 5
        assert recording.assumptions == ["metadata.yaml names bag_3.mcap, which the folder does not hold"]

    def test_stale_names_in_metadata_do_no_harm(self, tmp_path):
        folder = write_bag(tmp_path / "bag")
        (folder / "bag.mcap").rename(folder / "renamed.mcap")
        found, recording = read(folder)
        np.testing.assert_array_equal(found, events())
        assert not recording.losses
        assert "names bag.mcap, which the folder does not hold" in recording.assumptions[0]

    def test_a_broken_metadata_or_none_does_no_harm(self, tmp_path):
        folder = write_split(tmp_path / "bag", 2)
        text = (folder / "metadata.yaml").read_text()
        (folder / "metadata.yaml").write_text(text.replace("  duration", " - [duration", 1))
        np.testing.assert_array_equal(read(folder)[0], events())
        (folder / "metadata.yaml").unlink()
        np.testing.assert_array_equal(read(folder)[0], events())

    def test_a_file_beside_its_compressed_copy_is_read_once(self, tmp_path):
        folder = write_bag(tmp_path / "bag", compression="file")
        plain = write_bag(tmp_path / "plain") / "plain.mcap"
        plain.rename(folder / "bag.mcap")
        np.testing.assert_array_equal(read(folder)[0], events())

    def test_a_file_that_metadata_does_not_name_is_left_out_and_said(self, tmp_path):
        folder = write_split(tmp_path / "bag", 2)
        other = write_bag(tmp_path / "other") / "other.mcap"
        other.rename(folder / "copy.mcap")
        found, recording = read(folder)
        assert len(found) == 2_000
        assert "copy.mcap left out" in recording.assumptions[0]

    def test_a_folder_without_a_bag(self, tmp_path):
        (tmp_path / "metadata.yaml").write_text("relative_file_paths:\n- gone_0.mcap\n")
        with pytest.raises(InputError, match=r"no file in it ends in .*names gone_0\.mcap"):
            read(tmp_path)

    def test_a_database_that_is_none_or_damaged(self, tmp_path):
        rubbish = tmp_path / "a.db3"
        rubbish.write_bytes(b"SQLite format 3\0" + bytes(200))
        with pytest.raises(InputError, match="rosbag2 database"):
            read(rubbish)
        other = tmp_path / "b.db3"
        with sqlite3.connect(other) as database:
            database.execute("CREATE TABLE birds (name TEXT)")
        database.close()
        with pytest.raises(InputError, match="rosbag2 database"):
            read(other)
        folder = write_bag(tmp_path / "bag", storage="sqlite3")
        whole = (folder / "bag.db3").read_bytes()
        (folder / "bag.db3").write_bytes(whole[: len(whole) * 3 // 4])
        try:
            found, recording = read(folder)
        except InputError as error:
            assert "bag.db3" in str(error)  # noqa: PT017
        else:
            assert recording.losses or len(found) == 2_000

    def test_what_unpacks_without_end_is_refused(self, tmp_path):
        zstandard = pytest.importorskip("zstandard")
        bomb = tmp_path / "bag.mcap.zstd"
        bomb.write_bytes(zstandard.ZstdCompressor(19).compress(bytes(200 << 20)))
        with pytest.raises(InputError, match="unpacks to over"):
            read(bomb)

    def test_two_cameras_name_the_topics_and_the_option(self, tmp_path):
        folder = write_split(tmp_path / "bag", 2)
        other = write_bag(tmp_path / "other", topic="/right/events") / "other.mcap"
        both = [folder / "bag_0.mcap", folder / "bag_1.mcap", other]
        with pytest.raises(InputError, match=r"/camera/events, /right/events; choose one with --topic"):
            read(both)
        np.testing.assert_array_equal(read(both, "/right/events")[0], events())


class TestRos1:
    def write(self, path, compression=None, encoding="mono"):
        rosbag1 = pytest.importorskip("rosbags.rosbag1")
        store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
        store.register(typesys.get_types_from_msg(EventPacket.SCHEMA.partition("=" * 20)[0], TYPE))
        header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
        writer = rosbag1.Writer(path)
        if compression:
            writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
        with writer:
            connection = writer.add_connection(TOPIC, TYPE, typestore=store)
            for n, m in enumerate(packets(encoding=encoding)):
                time = stamp(m.stamp_ns // 10**9, m.stamp_ns % 10**9)
                message = store.types[TYPE](
                    header(n, time, ""), m.height, m.width, m.seq, m.time_base, m.encoding, m.is_bigendian,
                    np.frombuffer(m.events, np.uint8),
                )  # fmt: skip
                writer.write(connection, 10**18 + m.stamp_ns, store.serialize_ros1(message, TYPE))
        return path

    def test_a_bag_is_a_recording(self, tmp_path):
        found, recording = read(self.write(tmp_path / "a.bag"))
        np.testing.assert_array_equal(found, events())
        assert not recording.losses

    @pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
    @pytest.mark.parametrize("encoding", ["mono", "evt3"])
    def test_whatever_its_chunks_are_packed_with(self, tmp_path, compression, encoding):
        found, recording = read(self.write(tmp_path / "a.bag", compression, encoding))
        np.testing.assert_array_equal(found, events())
        assert not recording.losses

    def test_a_cut_bag_says_what_mends_it(self, tmp_path):
        path = self.write(tmp_path / "a.bag")
        path.write_bytes(path.read_bytes()[:-100])
        with pytest.raises(InputError, match=r"a\.bag: cannot be opened as a ROS 1 bag: .*reindex"):
            read(path)

    def test_the_missing_extra_is_named(self, tmp_path, monkeypatch):
        path = self.write(tmp_path / "a.bag")
        monkeypatch.setitem(__import__("sys").modules, "rosbags.rosbag1", None)
        with pytest.raises(InputError, match=r"pip install 'streamfeat\[bags\]'"):
            read(path)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("relative_file_paths:\n    - drive/drive_0.db3\n", ("drive_0.db3",)),
        ("relative_file_paths: ['a_0.mcap', \"a_1.mcap\"]\n", ("a_0.mcap", "a_1.mcap")),
        ("path: a.mcap.zstd\nrelative_file_paths:\n- a.mcap.zstd", ("a.mcap.zstd",)),
        ("", ()),
    ],
)
def test_names_in_metadata_of_any_version(text, names):
    assert read_metadata(text).names == names


def test_counts_in_metadata_whichever_order_they_have():
    entry = "  - {first}\n    {second}\n"
    topic = "topic_metadata:\n      name: {}\n      type: a/msg/B"
    text = "  topics_with_message_count:\n" + entry.format(
        first="message_count: 7", second=topic.format("/a")
    )
    text += entry.format(first=topic.format("/b"), second="message_count: 9")
    assert read_metadata(text).counts == {"/a": 7, "/b": 9}


def test_commands_take_a_bag(run, tmp_path):
    folder = write_split(tmp_path / "bag", 2)
    tiny.encoder().save(tmp_path / "model.safetensors")
    whole = write_bag(tmp_path / "whole")
    results = [
        run("replay", path, "-m", tmp_path / "model.safetensors", "--json").json for path in (folder, whole)
    ]
    for result in results:
        assert (result["events"], result["lost"]) == (2_000, 0)
    assert run("info", folder, "--json").json["events"] == 2_000
    assert Path(folder, "metadata.yaml").exists()
