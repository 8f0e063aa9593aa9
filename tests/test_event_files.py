"""Foreign files: real recordings against known facts, and small files written here, whole and damaged."""

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from streamfeat.camera_files import containers
from streamfeat.camera_files.event_files import FORMATS, open_events, read_events
from streamfeat.camera_files.prophesee import Unwrapped
from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE, Events, make_events

EVENTS = make_events([3, 0, 120, 33], [5, 99, 7, 0], [1, 0, 0, 1], [0, 10, 10, 90_000])
DAT_HEADER = b"% Data file containing Event2d events.\n% Version 2\n% Width 304\n% Height 240\n\x00\x08"


def dat_bytes(events: Events, header: bytes = DAT_HEADER) -> bytes:
    words = np.empty((len(events), 2), "<u4")
    words[:, 0] = events["t"]
    words[:, 1] = events["x"] | events["y"].astype("<u4") << 14 | events["p"].astype("<u4") << 28
    return header + words.tobytes()


def bin40_bytes(events: Events) -> bytes:
    rows = zip(*(events[field].tolist() for field in "xypt"), strict=True)
    return b"".join(struct.pack(">BBBH", x, y, p << 7 | t >> 16, t & 0xFFFF) for x, y, p, t in rows)


def evt2_bytes(events: Events, header: bytes = b"% evt 2.0\n") -> bytes:
    words, high = [], None
    for x, y, p, t in zip(*(events[field].tolist() for field in "xypt"), strict=True):
        if t >> 6 != high:
            high = t >> 6
            words.append(8 << 28 | high & 0xFFFFFFF)
        words.append(p << 28 | (t & 63) << 22 | x << 11 | y)
    return header + struct.pack(f"<{len(words)}I", *words)


def evt3_bytes(events: Events, header: bytes = b"% evt 3.0\n% end\n") -> bytes:
    words = []
    for x, y, p, t in zip(*(events[field].tolist() for field in "xypt"), strict=True):
        words += [0x8000 | t >> 12 & 0xFFF, 0x6000 | t & 0xFFF, y, 0x2000 | p << 11 | x]
    return header + struct.pack(f"<{len(words)}H", *words)


def text_bytes(events: Events) -> bytes:
    rows = zip(*(events[field].tolist() for field in "txyp"), strict=True)
    return "".join(f"{t / 1e6:.6f} {x} {y} {p}\n" for t, x, y, p in rows).encode()


def npz_file(path: Path, **arrays: np.ndarray) -> Path:
    np.savez(path, **arrays)
    return path


def file_of(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("name", "write", "format", "record"),
    [
        ("a.dat", dat_bytes, "dat", 8),
        ("a.bin", bin40_bytes, "bin40", 5),
        ("a.raw", evt2_bytes, "evt2", 4),
        ("a.raw", evt3_bytes, "evt3", 2),
        ("a.txt", text_bytes, "text", None),
    ],
)
class TestFormatsWrittenHere:
    def test_event_for_event(self, tmp_path, name, write, format, record):
        read = read_events(file_of(tmp_path, name, write(EVENTS)))
        assert read.format == format
        np.testing.assert_array_equal(read.events, EVENTS)
        assert read.events.dtype == EVENT_DTYPE
        assert (read.lost_bytes, read.damage) == (0, ())

    def test_resolution_is_the_smallest_when_not_declared(self, tmp_path, name, write, format, record):
        declared = format == "dat"
        read = read_events(file_of(tmp_path, name, write(EVENTS)))
        assert read.resolution == ((240, 304) if declared else (100, 121))

    def test_every_truncation_keeps_the_leading_events(self, tmp_path, name, write, format, record):
        data = write(EVENTS)
        first = len(data) - len(write(EVENTS[1:]))  # bytes that the first event takes beyond a shared header
        for length in range(len(data) - first, len(data)):
            read = read_events(file_of(tmp_path, name, data[:length]))
            n = len(read.events)
            np.testing.assert_array_equal(read.events["t"][: n - 1], EVENTS["t"][: max(0, n - 1)])
            if record:
                start = open_events(tmp_path / name).start
                assert read.lost_bytes == (length - start) % record
                assert bool(read.damage) == bool(read.lost_bytes)
                np.testing.assert_array_equal(read.events, EVENTS[:n])

    def test_a_long_file_is_the_same_in_blocks(self, tmp_path, name, write, format, record, rng):
        n = 260_000  # more than one block in every format
        x, y, p = rng.integers(0, 128, n), rng.integers(0, 100, n), rng.integers(0, 2, n)
        events = make_events(x, y, p, np.sort(rng.integers(0, 300_000, n)))
        batches = [*open_events(file_of(tmp_path, name, write(events)))]
        assert len(batches) > 1
        np.testing.assert_array_equal(np.concatenate(batches), events)

    def test_garbage_is_refused_or_counted_never_a_crash(self, tmp_path, name, write, format, record, rng):
        header = write(EVENTS[:0])
        path = file_of(tmp_path, name, header + rng.bytes(50_001))
        if format in ("bin40", "text"):
            with pytest.raises(InputError) as caught:
                read_events(path)
            assert str(path) in str(caught.value)
            assert "\n" not in str(caught.value)
        else:
            read = read_events(path)
            assert read.lost_bytes == 50_001 % record
            assert set(np.unique(read.events["p"])) <= {0, 1}


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


class TestRecordings:
    def test_evt2(self, shared_data):
        read = read_events(shared_data / "samples/evt2_640x480.raw")
        assert (len(read.events), read.resolution) == (539_481, (480, 640))
        assert np.ptp(read.events["t"]) == 50_000
        assert (np.diff(read.events["t"]) >= 0).all()

    def test_evt3(self, shared_data):
        """Pixels and polarities as decoded elsewhere; times are those that the words themselves state."""
        read = read_events(shared_data / "samples/evt3_1280x720.raw")
        golden = np.load(shared_data / "samples/evt3_1280x720_golden.npz")
        assert (len(read.events), read.resolution) == (219_596, (720, 1280))
        for field in "xyp":
            np.testing.assert_array_equal(read.events[field], golden[field])
        # The reference adds 4096 us wherever TIME_LOW steps back, 11 times, and leaves the TIME_HIGH range.
        shift = golden["t"] - read.events["t"]
        assert set(np.unique(shift)) == {4096 * k for k in range(12)}
        words = np.fromfile(shared_data / "samples/evt3_1280x720.raw", "<u2", offset=166)
        highs = words[words >> 12 == 8] & 0xFFF
        assert int(highs.min()) << 12 <= read.events["t"].min()
        assert read.events["t"].max() < (int(highs.max()) + 1) << 12 < golden["t"].max()

    def test_aedat4(self, shared_data):
        read = read_events(shared_data / "samples/dvs_320x240.aedat4")
        assert (len(read.events), read.resolution) == (111_954, (240, 320))
        assert read.events[0].tolist() == (154, 204, 0, 1_605_537_493_718_345)
        assert read.events[-1].tolist() == (88, 237, 1, 1_605_537_494_308_262)

    def test_aedat4_cut_short(self, shared_data, tmp_path):
        data = (shared_data / "samples/dvs_320x240.aedat4").read_bytes()
        whole = read_events(shared_data / "samples/dvs_320x240.aedat4").events
        read = read_events(file_of(tmp_path, "a.aedat4", data[:600_000]))
        assert len(read.events) == 70_126
        np.testing.assert_array_equal(read.events, whole[:70_126])
        assert "after event 70126" in read.damage[0]
        for length in (14, 200, 2_400):
            with pytest.raises(InputError, match=r"a\.aedat4"):
                read_events(file_of(tmp_path, "a.aedat4", data[:length]))

    def test_damage_to_the_header_of_aedat4_is_one_line(self, shared_data, tmp_path):
        data = bytearray((shared_data / "samples/dvs_320x240.aedat4").read_bytes())
        data[18:22] = b"\xff\xff\xff\x7f"  # the offset of the table
        with pytest.raises(InputError, match="damaged: an offset to byte"):
            read_events(file_of(tmp_path, "a.aedat4", bytes(data)))

    def test_aedat4_is_read_without_its_index(self, shared_data, tmp_path):
        data = bytearray((shared_data / "samples/dvs_320x240.aedat4").read_bytes())
        data[-2000:-1000] = bytes(range(250)) * 4
        read = read_events(file_of(tmp_path, "a.aedat4", bytes(data)))
        assert (len(read.events), read.damage) == (111_954, ())

    def test_ncaltech101(self, shared_data):
        read = read_events(shared_data / "samples/ncaltech101_faces_easy_0001.bin")
        assert (len(read.events), read.resolution) == (67_445, (173, 151))
        assert np.ptp(read.events["t"]) == 299_358


class TestSensorWords:
    def test_bin40_overflow_records_move_time_and_are_no_events(self, tmp_path):
        marker = make_events([9], [240], [0], [8000])
        data = bin40_bytes(np.concatenate([EVENTS[:1], marker, EVENTS[1:3], marker, EVENTS[1:2]]))
        events = read_events(file_of(tmp_path, "a.bin", data)).events
        assert events["t"].tolist() == [0, 8192 + 10, 8192 + 10, 16_384 + 10]
        assert events["y"].tolist() == [5, 99, 7, 99]

    def test_bin40_overflow_adds_up_over_blocks(self, tmp_path):
        marker = make_events([0], [240], [0], [0])
        rest_of_block = make_events(*np.zeros((4, 199_999), int))
        block = bin40_bytes(np.concatenate([marker, rest_of_block]))
        path = file_of(tmp_path, "a.bin", block + block + bin40_bytes(make_events([1], [1], [1], [3])))
        t = read_events(path).events["t"]
        assert (t[0], t[199_998], t[199_999], t[-2], t[-1]) == (8192, 8192, 16_384, 16_384, 16_387)

    def test_evt2_counts_wraps_and_skips_events_before_any_time(self, tmp_path):
        last = (1 << 34) - 64
        events = make_events([1, 2, 3], [4, 5, 6], [1, 0, 1], [last, last + 64, last + 65])
        early = struct.pack("<I", 1 << 28 | 7 << 11 | 7)
        path = file_of(tmp_path, "a.raw", b"% evt 2.0\n" + early + evt2_bytes(events, b""))
        np.testing.assert_array_equal(read_events(path).events, events)

    def test_evt2_ignores_triggers_and_other_words(self, tmp_path):
        data = evt2_bytes(EVENTS) + struct.pack("<3I", 0xA0000001, 0xE0000000, 0xF0000000)
        np.testing.assert_array_equal(read_events(file_of(tmp_path, "a.raw", data)).events, EVENTS)

    @pytest.mark.parametrize(
        "header",
        [
            b"% geometry 640x480\n% evt 3.0\n",
            b"% format EVT3;height=480;width=640\n",
            b"% evt 3.0\n% plugin_name hal_plugin_gen31_fx3\n",
        ],
    )
    def test_resolution_in_the_header(self, tmp_path, header):
        path = file_of(tmp_path, "a.raw", evt3_bytes(EVENTS, header))
        assert open_events(path).resolution == (480, 640)

    def test_events_outside_the_declared_resolution_are_counted(self, tmp_path):
        path = file_of(tmp_path, "a.raw", evt3_bytes(EVENTS, b"% evt 3.0\n% geometry 100x100\n"))
        read = read_events(path)
        np.testing.assert_array_equal(read.events, EVENTS[EVENTS["x"] < 100])
        assert read.damage == ("1 events outside 100x100 left out",)

    @pytest.mark.parametrize(
        ("name", "data", "match"),
        [
            ("a.raw", b"% evt 5.1\n", "EVT5.1"),
            ("a.raw", b"% evt 3.0\n% geometry 0x480\n", "0 x 480"),
            ("a.raw", b"% evt 3.0\n% geometry 99999x480\n", "99999 x 480"),
            ("a.raw", b"% evt 3.0\n% endianness big\n", "big endian"),
            ("a.raw", b"% evt 3.0", "byte 0"),
            ("a.dat", DAT_HEADER[:-1], "byte 76"),
            ("a.dat", DAT_HEADER[:-2] + b"\x0e\x08", "0e 08"),
            ("a.dat", DAT_HEADER.replace(b"Version 2", b"Version 1"), "version 1"),
            ("a.dat", b"", "empty"),
            ("a.raw", b"\0" * 100, "not a known event file"),
            ("a.mcap", b"\x89MCAP0\r\n", "already"),
        ],
    )
    def test_headers_that_cannot_be_used(self, tmp_path, name, data, match):
        with pytest.raises(InputError, match=match) as caught:
            read_events(file_of(tmp_path, name, data))
        assert str(tmp_path / name) in str(caught.value)


class TestTables:
    def test_text_with_resolution_comments_and_microseconds(self, tmp_path):
        data = b"# made by hand\n640 480\n\n10 1 2 1\n% more\n20 3 4 -1\n"
        read = read_events(file_of(tmp_path, "a.txt", data))
        np.testing.assert_array_equal(read.events, make_events([1, 3], [2, 4], [1, 0], [10, 20]))
        assert read.resolution == (480, 640)

    def test_the_first_line_is_skipped_once_not_in_each_block(self, tmp_path):
        path = file_of(tmp_path, "a.txt", b"640 480\n" + b"1000000 100 100 1\n" * 60_000)
        assert sum(map(len, open_events(path))) == 60_000

    def test_csv_with_names_in_any_order(self, tmp_path):
        path = file_of(tmp_path, "a.csv", b"x,y,polarity,timestamp\n1,2,1,10\n3,4,0,20")
        np.testing.assert_array_equal(read_events(path).events, make_events([1, 3], [2, 4], [1, 0], [10, 20]))

    def test_seconds_are_rounded_not_cut(self, tmp_path):
        path = file_of(tmp_path, "a.txt", b"1605537493.718345 1 2 1\n1605537493.718349 1 2 1\n")
        assert read_events(path).events["t"].tolist() == [1_605_537_493_718_345, 1_605_537_493_718_349]

    def test_half_a_last_line_is_lost_and_counted(self, tmp_path):
        read = read_events(file_of(tmp_path, "a.txt", b"10 1 2 1\n20 3 4"))
        assert (len(read.events), read.lost_bytes) == (1, 6)
        assert "byte 9" in read.damage[0]

    @pytest.mark.parametrize(
        ("data", "match"),
        [
            (b"10 1 2 1\n20 3 4 2\n", "event 1: p = 2"),
            (b"10 1 2 1\n-20 3 4 1\n", "event 1: t = -20"),
            (b"10 1 2 1\n20 70000 4 1\n", "event 1: x = 70000"),
            (b"10 1 2 1\n20 3.5 4 1\n", r"event 1: x = 3\.5"),
            (b"0.5 1 2 1\nnan 3 4 1\n", "event 1: t = nan"),
            (b"10 1 2 1\n20 a 4 1\n", "could not convert"),
            (b"10 1 2 1\n20 3\n30 1 2 1\n", "columns"),
            (b"what is this\n", "lack one of"),
            (b"# only a comment\n", "holds no line"),
            (b"1" * 2_100_000, "holds no line"),
        ],
    )
    def test_text_that_is_no_events(self, tmp_path, data, match):
        with pytest.raises(InputError, match=match):
            read_events(file_of(tmp_path, "a.txt", data))

    def test_npz_columns_fields_and_seconds(self, tmp_path):
        columns = {field: EVENTS[field] for field in "xypt"}
        in_seconds = columns | {"t": EVENTS["t"] / 1e6, "p": EVENTS["p"].astype(bool)}
        np.save(tmp_path / "fields.npy", EVENTS)
        paths = [
            npz_file(tmp_path / "a.npz", **columns),
            npz_file(tmp_path / "b.npz", **in_seconds),
            npz_file(tmp_path / "c.npz", events=EVENTS),
            tmp_path / "fields.npy",
        ]
        for path in paths:
            np.testing.assert_array_equal(read_events(path).events, EVENTS)

    def test_npz_is_never_unpickled(self, tmp_path):
        path = npz_file(tmp_path / "a.npz", x=np.array([print], dtype=object))
        with pytest.raises(InputError, match="without pickles"):
            read_events(path)

    def test_npz_lacking_columns_or_bytes(self, tmp_path):
        path = npz_file(tmp_path / "a.npz", x=EVENTS["x"], y=EVENTS["y"], t=EVENTS["t"])
        with pytest.raises(InputError, match=r"needs columns .* holds x \(4,\)"):
            read_events(path)
        path = npz_file(tmp_path / "b.npz", **{field: EVENTS[field] for field in "xypt"})
        data = path.read_bytes()
        for length in range(4, len(data), 37):
            with pytest.raises(InputError, match="NumPy file"):
                read_events(file_of(tmp_path, "c.npz", data[:length]))


class TestHdf5:
    @pytest.fixture
    def h5py(self):
        return pytest.importorskip("h5py")

    def test_event_for_event_and_geometry(self, tmp_path, h5py):
        with h5py.File(tmp_path / "a.h5", "w") as root:
            root["CD/events"] = EVENTS
            root.attrs["geometry"] = "304x240"
        read = read_events(tmp_path / "a.h5")
        np.testing.assert_array_equal(read.events, EVENTS)
        assert (read.resolution, read.format) == ((240, 304), "hdf5")

    def test_a_missing_codec_is_named(self, tmp_path, h5py):
        with h5py.File(tmp_path / "a.h5", "w") as root:
            plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            plist.set_chunk((4,))
            plist.set_filter(0x7ECF, h5py.h5z.FLAG_OPTIONAL)
            space = h5py.h5s.create_simple((4,))
            h5py.h5d.create(
                root.create_group("CD").id, b"events", h5py.h5t.py_create(EVENT_DTYPE), space, plist
            )
        with pytest.raises(InputError, match=r"filter 32463 .*which is not installed; pip install"):
            read_events(tmp_path / "a.h5")

    def test_one_process_opens_a_file_and_reads_it(self, tmp_path, h5py, monkeypatch):
        begun = []
        start = containers.subprocess.Popen
        monkeypatch.setattr(
            containers.subprocess, "Popen", lambda *a, **k: begun.append(start(*a, **k)) or begun[-1]
        )
        events = make_events(np.arange(700_000) % 300, 5, 1, np.arange(700_000))
        paths = [tmp_path / f"{i}.h5" for i in range(6)]
        for path in paths:
            with h5py.File(path, "w") as root:
                root.create_dataset("CD/events", data=events, chunks=(100_000,), compression=1)
        opened = open_events(paths[0])
        for _ in range(3):
            next(iter(opened))
        np.testing.assert_array_equal(np.concatenate([*opened]), events)
        assert len(begun) == 1
        # Read again it begins again, as do those of many files that are open at a time.
        assert sum(map(len, opened)) == len(events)
        assert len(begun) == 2
        many = [open_events(path) for path in paths]
        assert sum(process.poll() is None for process in begun) == 4
        for file in many:
            assert sum(map(len, file)) == len(events)
        assert len(begun) == 2 + 6 + 2
        assert all(process.poll() is not None for process in begun)

    def test_chunks_are_read_whole(self, tmp_path, h5py):
        events = make_events(np.arange(700_000) % 300, 5, 1, np.arange(700_000))
        with h5py.File(tmp_path / "a.h5", "w") as root:
            root.create_dataset("CD/events", data=events, chunks=(300_000,))
        assert [len(batch) for batch in open_events(tmp_path / "a.h5")] == [300_000, 300_000, 100_000]

    def test_a_codec_of_hdf5plugin(self, tmp_path, h5py):
        hdf5plugin = pytest.importorskip("hdf5plugin")
        with h5py.File(tmp_path / "a.h5", "w") as root:
            root.create_dataset("CD/events", data=EVENTS, chunks=(4,), **hdf5plugin.Blosc())
        np.testing.assert_array_equal(read_events(tmp_path / "a.h5").events, EVENTS)

    def test_damage_and_foreign_layouts(self, tmp_path, h5py):
        with h5py.File(tmp_path / "a.h5", "w") as root:
            root["x"] = EVENTS["x"]
        with pytest.raises(InputError, match="no CD/events"):
            read_events(tmp_path / "a.h5")
        data = (tmp_path / "a.h5").read_bytes()
        with pytest.raises(InputError, match="damaged"):
            read_events(file_of(tmp_path, "b.h5", data[:500]))


@pytest.mark.parametrize("compression", [None, ("lz4", 1), ("zstd", 3)])
def test_aedat4_of_another_writer(tmp_path, compression):
    faery = pytest.importorskip("faery")
    theirs = np.zeros(len(EVENTS), faery.EVENTS_DTYPE)
    for mine, field in zip("xypt", ("x", "y", "on", "t"), strict=True):
        theirs[field] = EVENTS[mine]
    stream = faery.events_stream_from_array(theirs, (130, 100))
    stream.to_file(tmp_path / "a.aedat4", compression=compression)
    read = read_events(tmp_path / "a.aedat4")
    np.testing.assert_array_equal(read.events, EVENTS)
    assert (read.resolution, read.damage) == ((100, 130), ())


def test_a_missing_library_names_the_extra(tmp_path, monkeypatch):
    (tmp_path / "h5py.py").write_text("raise ImportError")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    path = file_of(tmp_path, "a.h5", b"\x89HDF\r\n\x1a\n")
    with pytest.raises(InputError, match=r"needs h5py: pip install 'streamfeat\[convert\]'"):
        open_events(path)


def test_a_missing_file_and_an_unknown_format(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        open_events(tmp_path / "a.dat")
    with pytest.raises(InputError, match="known are dat, bin40"):
        open_events(file_of(tmp_path, "a.dat", DAT_HEADER), "tiff")


def test_a_given_format_overrides_the_ending(tmp_path):
    path = file_of(tmp_path, "a.events", bin40_bytes(EVENTS))
    np.testing.assert_array_equal(read_events(path, "bin40").events, EVENTS)


def test_what_is_not_known_lists_what_is(tmp_path):
    with pytest.raises(InputError) as caught:
        read_events(file_of(tmp_path, "a.tiff", b"II*\0"))
    assert all(description in str(caught.value) for description in FORMATS.values())


def test_reading_twice_does_not_count_damage_twice(tmp_path):
    file = open_events(file_of(tmp_path, "a.dat", dat_bytes(EVENTS) + b"abc"))
    for _ in range(2):
        assert sum(map(len, file)) == 4
        assert file.lost_bytes == 3
        assert file.damage == [f"3 bytes at byte {len(dat_bytes(EVENTS))} are not a whole record"]


def test_an_event_from_before_a_wrap_may_come_after_it_and_in_the_next_block():
    turn = 1 << 32
    unwrapped = Unwrapped(32)
    assert unwrapped(np.array([turn - 10, 5, turn - 5, 7])).tolist() == [
        turn - 10,
        turn + 5,
        turn - 5,
        turn + 7,
    ]
    assert unwrapped(np.array([turn - 1, 8])).tolist() == [turn - 1, turn + 8]


def test_nothing_is_from_before_the_first_turn_of_a_clock():
    turn = 1 << 32
    assert Unwrapped(32)(np.array([5, turn - 5, 7])).tolist() == [5, turn - 5, 7]


@pytest.mark.parametrize(
    ("name", "content", "remedy"),
    [
        ("old.dat", b"% Version 1\n% Width 304\n% Height 240\n\x00\x08" + bytes(16), "write it anew with"),
        ("old.es", b"Event Stream\x01\x00\x00\x01" + bytes(16), "rewrite it with the program that made it"),
        ("cut.h5", b"\x89HDF\r\n\x1a\n" + bytes(200), "copy it anew"),
    ],
)
def test_what_cannot_be_read_says_what_to_do(tmp_path, name, content, remedy):
    if name.endswith(".h5"):
        pytest.importorskip("h5py")
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=remedy):
        read_events(path)
