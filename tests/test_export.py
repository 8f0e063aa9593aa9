"""Recordings to the files of others, which read the same events; stretches, crops, and what does not fit."""

import numpy as np
import pytest
import tiny

import streamfeat as sf
from streamfeat.convert.export import convert_recording
from streamfeat.convert.outputs import open_output
from streamfeat.convert.selection import Selection
from streamfeat.denoise.stage import Denoiser, Denoising
from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.messages.codecs import EVT3_WRAP_US
from streamfeat.recordings.options import ReadOptions
from streamfeat.recordings.reader import Label

SIZE = tiny.RESOLUTION
FOREIGN = (".raw", ".h5", ".npz", ".csv")


def stream(n=30_000, start_us=1_000):
    """Sorted events with gaps: EVT3 times wrap twice."""
    times = np.sort(np.random.default_rng(1).integers(0, 40_000_000, n)) + start_us
    return tiny.stream(times)


@pytest.fixture
def source(tmp_path):
    return tiny.write_items(tmp_path / "in.mcap", [tiny.packet(part) for part in np.array_split(stream(), 9)])


def read(path, options=ReadOptions()):  # noqa: B008
    with sf.open_recording(path, options=options) as recording:
        return np.concatenate([*recording]), recording.resolution


@pytest.mark.parametrize("ending", [*FOREIGN, ".mcap"])
def test_every_kind_is_read_again_event_for_event(source, tmp_path, ending):
    done = convert_recording(source, tmp_path / f"out{ending}")
    found, resolution = read(tmp_path / f"out{ending}", ReadOptions(resolution=SIZE))
    np.testing.assert_array_equal(found, stream())
    assert resolution == SIZE
    size = (tmp_path / f"out{ending}").stat().st_size
    assert {name: value for name, value in done.result().items() if value} == {
        "events": 30_000,
        "bytes_out": size,
    }


@pytest.mark.parametrize("ending", [".raw", ".h5", ".mcap"])
def test_these_kinds_say_their_resolution(source, tmp_path, ending):
    convert_recording(source, tmp_path / f"out{ending}")
    assert read(tmp_path / f"out{ending}")[1] == SIZE


class TestOthersRead:
    def check(self, found, names="txyp", events=None):
        for name, column in zip(names, found, strict=True):
            mine = (stream() if events is None else events)[name]
            np.testing.assert_array_equal(np.asarray(column).astype(np.int64), mine, err_msg=name)

    @pytest.fixture
    def raw(self, tmp_path):
        """The 24-bit clock turns while events come, in silences of one and of many turns, and on an event."""
        turn = EVT3_WRAP_US
        times = [*stream()["t"], 9 * turn - 1, 9 * turn, 9 * turn + 8192, 10 * turn + 5, 200 * turn + 4097]
        # TIME_LOW is the same before and after a new TIME_HIGH
        events = tiny.stream([*times, 200 * turn + 4096 * 8 + 1, 200 * turn + 4096 * 2048 * 3 + 1])
        path = tmp_path / "out.raw"
        with open_output(path) as output:
            for part in np.array_split(events, 11):
                output.write(part, SIZE)
        return path, events

    def test_expelliarmus_the_raw(self, raw):
        """Not its times: it adds 4096 us at each step back of TIME_LOW, whatever TIME_HIGH says."""
        path, events = raw
        rows = pytest.importorskip("expelliarmus").Wizard("evt3", fpath=path).read()
        self.check((rows[name] for name in "xyp"), "xyp", events)

    def test_faery_the_raw(self, raw):
        path, events = raw
        rows = np.concatenate([*pytest.importorskip("faery").events_stream_from_file(path)])
        self.check((rows[name] for name in ("t", "x", "y", "on")), events=events)

    def test_eventcv_the_raw(self, raw):
        path, events = raw
        x, y, t, p = pytest.importorskip("eventcv").load(str(path), time_unit="microseconds").numpy().T
        self.check((t, x, y, p > 0), events=events)

    def test_evlib_the_raw(self, raw):
        path, events = raw
        rows = pytest.importorskip("evlib").load_events(str(path)).collect()
        t = rows["t"].dt.total_microseconds()
        self.check((t, rows["x"], rows["y"], rows["polarity"] > 0), events=events)

    def test_it_is_read_here_too(self, raw):
        path, events = raw
        np.testing.assert_array_equal(read(path)[0], events)

    def test_h5py_the_table_of_prophesee(self, source, tmp_path):
        h5py = pytest.importorskip("h5py")
        convert_recording(source, tmp_path / "out.h5")
        with h5py.File(tmp_path / "out.h5") as root:
            rows = root["CD/events"][:]
            assert root.attrs["geometry"] == "16x12"
        self.check(rows[name] for name in "txyp")

    def test_numpy_the_columns(self, source, tmp_path):
        convert_recording(source, tmp_path / "out.npz")
        with np.load(tmp_path / "out.npz") as columns:
            self.check(columns[name] for name in "txyp")
            assert columns["resolution"].tolist() == [*SIZE]

    def test_pandas_the_csv(self, source, tmp_path):
        pandas = pytest.importorskip("pandas")
        convert_recording(source, tmp_path / "out.csv")
        table = pandas.read_csv(tmp_path / "out.csv")
        self.check(table[name] for name in ("t_us", "x", "y", "p"))

    def test_faery_the_csv(self, source, tmp_path):
        faery = pytest.importorskip("faery")
        convert_recording(source, tmp_path / "out.csv")
        rows = faery.events_stream_from_file(
            tmp_path / "out.csv",
            dimensions_fallback=(SIZE[1], SIZE[0]),
            csv_properties=faery.CsvProperties.default(),
        )
        found = np.concatenate([*rows])
        self.check(found[name] for name in ("t", "x", "y", "on"))


@pytest.mark.parametrize("ending", [".csv", ".npz"])
def test_a_slow_stream_keeps_its_times(tmp_path, ending):
    events = tiny.steady(0, 20_000_000, 100)  # whole times of five events a second: nanoseconds?
    path = tiny.write_items(tmp_path / "in.mcap", [tiny.packet(events)])
    convert_recording(path, tmp_path / f"out{ending}")
    found, resolution = read(tmp_path / f"out{ending}")
    np.testing.assert_array_equal(found, events)
    assert ending == ".csv" or resolution == tiny.RESOLUTION


class TestSelection:
    @pytest.mark.parametrize("ending", [".npz", ".mcap"])
    def test_a_stretch_counts_from_the_first_event(self, source, tmp_path, ending):
        selection = Selection.parse(2.5, 10.0, None)
        convert_recording(source, tmp_path / f"out{ending}", selection=selection)
        t = stream()["t"] - stream()["t"][0]
        expected = stream()[(t >= 2_500_000) & (t < 10_000_000)]
        np.testing.assert_array_equal(read(tmp_path / f"out{ending}")[0], expected)

    def test_a_crop_has_an_origin_and_a_resolution_of_its_own(self, source, tmp_path):
        convert_recording(source, tmp_path / "out.raw", selection=Selection.parse(None, None, "3,2,8,5"))
        e = stream()
        e = e[(e["x"] >= 3) & (e["x"] < 11) & (e["y"] >= 2) & (e["y"] < 7)].copy()
        e["x"] -= 3
        e["y"] -= 2
        found, resolution = read(tmp_path / "out.raw")
        np.testing.assert_array_equal(found, e)
        assert resolution == (5, 8)

    def test_labels_that_do_not_lie_within_are_left_out_and_counted(self, tmp_path):
        path = tiny.write_items(tmp_path / "in.mcap", tiny.labelled_items(4))
        selection = Selection.parse(0.1, 0.6, None)
        done = convert_recording(path, tmp_path / "out.mcap", selection=selection)
        with sf.open_recording(path) as recording:
            first = recording.first_us
            kept = [
                label for label in recording.labels
                if first + 100_000 <= label.start_us and label.start_us + label.duration_us <= first + 600_000
            ]  # fmt: skip
        with sf.open_recording(tmp_path / "out.mcap") as recording:
            assert recording.labels == kept != []
        assert (done.labels, done.labels_left_out) == (len(kept), 4 - len(kept))

    def test_noise_is_taken_out_and_counted(self, source, tmp_path):
        denoising = Denoising(refractory_us=200_000)
        done = convert_recording(source, tmp_path / "out.npz", reading=ReadOptions(denoising=denoising))
        stage = Denoiser(denoising)
        np.testing.assert_array_equal(read(tmp_path / "out.npz")[0], stage.events(stream(), SIZE))
        assert done.removed == stage.removed
        assert done.removed["refractory"] > 1_000

    @pytest.mark.parametrize(
        ("start", "end", "crop", "reason"),
        [
            (-1.0, None, None, "--start"),
            (2.0, 1.0, None, "not behind"),
            (None, float("nan"), None, "--end"),
            (None, None, "1,2,3", "--crop"),
            (None, None, "0,0,0,4", "--crop"),
        ],
    )
    def test_what_makes_no_sense_names_the_option(self, start, end, crop, reason):
        with pytest.raises(InputError, match=reason):
            Selection.parse(start, end, crop)

    def test_a_crop_beyond_the_sensor_and_a_stretch_of_nothing(self, source, tmp_path):
        for selection, reason in (
            (Selection.parse(None, None, "10,0,10,4"), "beyond a sensor of 16x12"),
            (Selection.parse(100.0, None, None), "none is left"),
        ):
            with pytest.raises(InputError, match=reason):
                convert_recording(source, tmp_path / "out.npz", selection=selection)
        assert [path.name for path in tmp_path.iterdir()] == ["in.mcap"]


class TestWhatDoesNotFit:
    def test_a_little_disorder_is_put_in_order(self, tmp_path):
        events = stream(2_000)
        mixed = events.copy()
        mixed[::20], mixed[1::20] = events[1::20], events[::20]
        path = tiny.write_items(tmp_path / "in.mcap", [tiny.packet(mixed)])
        convert_recording(path, tmp_path / "out.raw")
        np.testing.assert_array_equal(read(tmp_path / "out.raw")[0], np.sort(mixed, order="t", kind="stable"))
        convert_recording(path, tmp_path / "out.npz")
        # So few events a second make a reader take the times for nanoseconds, and say so.
        options = ReadOptions(time_unit="us")
        np.testing.assert_array_equal(read(tmp_path / "out.npz", options)[0], mixed)

    @pytest.mark.parametrize("ending", [".raw", ".h5"])
    def test_a_large_step_back_is_refused_and_leaves_no_file(self, tmp_path, ending):
        def write():
            with open_output(tmp_path / f"out{ending}") as out:
                out.write(tiny.steady(600_000, 900_000, 50), SIZE)
                out.write(tiny.steady(0, 300_000, 50), SIZE)

        with pytest.raises(InputError, match=r"order of time.*write \.mcap"):
            write()
        assert [*tmp_path.iterdir()] == []

    def test_times_that_evt3_cannot_hold_are_moved_and_that_is_said(self, tmp_path):
        events = tiny.steady(1_744_227_144_000_000, 1_744_227_145_000_000, 500)
        path = tiny.write_items(tmp_path / "in.mcap", [tiny.packet(events)])
        done = convert_recording(path, tmp_path / "out.raw")
        found, _ = read(tmp_path / "out.raw")
        np.testing.assert_array_equal(found["t"] + done.subtracted_us, events["t"])
        assert done.subtracted_us % (1 << 24) == 0

    def test_two_sensors_and_labels(self, tmp_path):
        small = make_events([1], [1], [1], [9_000_000])
        items = [Label(0, 1_000, "a"), tiny.packet(tiny.steady(0, 900, 50)), tiny.packet(small, (5, 5))]
        path = tiny.write_items(tmp_path / "in.mcap", items)
        with pytest.raises(InputError, match="16x12 and 5x5"):
            convert_recording(path, tmp_path / "out.npz")
        done = convert_recording(path, tmp_path / "out.npz", selection=Selection.parse(None, 1.0, None))
        assert (done.labels, done.labels_left_out) == (0, 1)

    def test_an_unknown_ending_and_an_existing_file(self, source, tmp_path):
        with pytest.raises(InputError, match=r"end in \.mcap, \.raw"):
            convert_recording(source, tmp_path / "out.avi")
        (tmp_path / "out.csv").write_text("precious")
        with pytest.raises(InputError, match="exists already"):
            convert_recording(source, tmp_path / "out.csv")
        assert (tmp_path / "out.csv").read_text() == "precious"


def test_the_command(run, source, tmp_path):
    result = run(
        "convert", source, tmp_path / "out.raw", "--crop", "0,0,8,8", "--refractory", "100ms", "--json"
    )
    assert result.json["removed"]["refractory"] > 0
    assert run("info", tmp_path / "out.raw", "--json").json["events"] == result.json["events"]
    csv = run("convert", source, tmp_path / "out.csv", "--json")
    assert csv.status == 0
    back = run("convert", tmp_path / "out.csv", tmp_path / "back.mcap", "--resolution", "16x12")
    assert "assumed:" not in back.err
    guessed = run("convert", tmp_path / "out.csv", tmp_path / "guessed.mcap")
    assert "assumed:" in guessed.err
    np.testing.assert_array_equal(read(tmp_path / "back.mcap")[0], stream())
    refused = run("convert", source, tmp_path / "x.mcap", "--hold-out", "1/5")
    assert (refused.status, len(refused.err.splitlines())) == (2, 1)
