"""Folders to labelled samples to recordings, read back event for event."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from test_event_files import bin40_bytes, dat_bytes, text_bytes

from streamfeat.camera_files.event_files import read_events
from streamfeat.convert.datasets import convert, find_samples
from streamfeat.convert.splits import SamplePath, hold_out_block, parse_hold_out
from streamfeat.denoise.stage import Denoiser, Denoising
from streamfeat.errors import InputError
from streamfeat.events import Events, make_events
from streamfeat.messages.packets import PacketWriter
from streamfeat.recordings.reader import Label, Sample, open_recording
from streamfeat.recordings.writer import RecordingWriter

NCARS_HEADER = b"% Data file containing N9Chronocam7Event2dE events.\n% Version 2\n\x00\x08"


def sample_events(seed: int, n: int = 50, width: int = 30, until: int = 99_999) -> Events:
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, until, n))
    events = make_events(rng.integers(0, width, n), rng.integers(0, 25, n), rng.integers(0, 2, n), t)
    events["x"][0], events["y"][0] = width - 1, 24  # so that the resolution is known
    return events


def put(path: Path, data: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def samples_of(path: Path) -> list[Sample]:
    with open_recording(path) as recording:
        return [*recording.samples()]


@pytest.fixture
def ncars(tmp_path) -> Path:
    """Ten training samples, two test samples; every sample has its own events and width."""
    folder = tmp_path / "N-CARS"
    for i in range(12):
        part = "n-cars_test" if i in (0, 11) else "n-cars_train"
        label = "cars" if i % 2 else "background"
        events = sample_events(i, width=30 + i)
        put(folder / part / label / f"obj_{i:06}_td.dat", dat_bytes(events, NCARS_HEADER))
    return folder


class TestFindSamples:
    def test_ncars(self, ncars):
        samples = find_samples(ncars)
        assert [s.source for s in samples] == sorted(s.source for s in samples)
        assert samples[0] == SamplePath(
            ncars / "n-cars_test/background/obj_000000_td.dat",
            "background",
            "test",
            "n-cars_test/background/obj_000000_td.dat",
        )
        assert [s.split for s in samples] == ["test"] * 2 + ["train"] * 10

    def test_the_inner_folder_keeps_split_and_order(self, ncars):
        inner = find_samples(ncars / "n-cars_train")
        assert [s.path for s in inner] == [s.path for s in find_samples(ncars)[2:]]
        assert {(s.label, s.split) for s in inner} == {("cars", "train"), ("background", "train")}
        assert inner[0].source == "background/obj_000002_td.dat"

    def test_other_layouts(self, tmp_path):
        names = {
            "N-MNIST/Train/7/00001.bin": ("7", "train"),
            "N-MNIST/Test/0/00001.bin": ("0", "test"),
            "Caltech101/Faces_easy/image_0001.bin": ("Faces_easy", ""),
            "mine/validation/left/a.aedat4": ("left", "validation"),
            "mine/my-val/left/b.TXT": ("left", "validation"),
        }
        for name in names:
            put(tmp_path / name, b"-")
        assert {s.source: (s.label, s.split) for s in find_samples(tmp_path)} == names

    def test_what_is_no_sample_is_passed_over(self, tmp_path):
        put(tmp_path / "cars/a.dat", b"-")
        for name in ("README.txt", "train/b.dat", "cars/notes.md", ".cache/cars/a.dat", "cars/.a.dat"):
            put(tmp_path / name, b"-")
        put(tmp_path / "Caltech101_annotations/cars/annotation_0001.bin", b"-")
        assert [s.source for s in find_samples(tmp_path)] == ["cars/a.dat"]

    def test_nothing_found_says_what_is_expected(self, tmp_path):
        with pytest.raises(InputError, match=r"SPLIT/LABEL/FILE .*\.aedat4"):
            find_samples(tmp_path)
        with pytest.raises(InputError, match="is no folder"):
            find_samples(tmp_path / "missing")


class TestConvert:
    def test_event_for_event_with_labels_and_resolution(self, ncars, tmp_path):
        calls = []
        done = convert(ncars, tmp_path / "o.mcap", gap_us=500_000, progress=lambda *call: calls.append(call))
        found = find_samples(ncars)
        read = samples_of(tmp_path / "o.mcap")
        assert len(read) == len(found) == done.samples
        for i, (sample, path) in enumerate(zip(read, found, strict=True)):
            start = 500_000 + i * 600_000
            assert sample.label == Label(start, 100_000, path.label, path.split, path.source)
            source = read_events(path.path)
            shifted = source.events.copy()
            shifted["t"] += start
            np.testing.assert_array_equal(sample.events, shifted)
            assert sample.resolution == source.resolution
        assert {s.resolution for s in read} == {(25, 30 + i) for i in range(12)}
        assert done.events == 12 * 50
        assert done.bytes_in == sum(path.path.stat().st_size for path in found)
        assert done.bytes_out == (tmp_path / "o.mcap").stat().st_size
        assert (done.failed, done.damaged) == ([], [])
        assert calls == [(i, 12) for i in range(1, 13)]

    def test_a_label_comes_before_its_events(self, ncars, tmp_path):
        convert(ncars, tmp_path / "o.mcap")
        with open_recording(tmp_path / "o.mcap") as recording:
            kinds = [isinstance(item, Label) for item in recording.items()]
        assert kinds == [True, False] * 12

    def test_nmnist_has_34_pixels_and_300_ms_or_more(self, tmp_path):
        put(tmp_path / "in/Train/1/a.bin", bin40_bytes(sample_events(1, width=20, until=250_000)))
        long = make_events([1, 2], [1, 2], [0, 1], [7_370, 315_109])
        put(tmp_path / "in/Train/2/b.bin", bin40_bytes(long))
        convert(tmp_path / "in", tmp_path / "o.mcap", gap_us=1000)
        first, second = samples_of(tmp_path / "o.mcap")
        assert (first.label.start_us, first.label.duration_us) == (1000, 300_000)
        assert (second.label.start_us, second.label.duration_us) == (302_000, 315_110)
        assert second.events["t"].tolist() == [302_000 + 7_370, 302_000 + 315_109]
        assert first.resolution == second.resolution == (34, 34)

    def test_elsewhere_a_sample_starts_with_its_first_event(self, tmp_path):
        events = make_events([1, 2], [3, 4], [1, 0], [5_000_000, 5_000_700])
        put(tmp_path / "in/wave/a.txt", b"640 480\n" + text_bytes(events))
        convert(tmp_path / "in", tmp_path / "o.mcap", gap_us=10)
        (sample,) = samples_of(tmp_path / "o.mcap")
        assert (sample.label.start_us, sample.label.duration_us) == (10, 701)
        assert sample.events["t"].tolist() == [10, 710]
        assert sample.resolution == (480, 640)

    def test_every_fifth_is_validation(self, ncars, tmp_path):
        convert(ncars / "n-cars_train", tmp_path / "o.mcap", interleaved=5)
        splits = [sample.label.split for sample in samples_of(tmp_path / "o.mcap")]
        assert splits == (["train"] * 4 + ["validation"]) * 2

    def test_test_samples_are_neither_renamed_nor_counted(self, ncars, tmp_path):
        convert(ncars, tmp_path / "o.mcap", interleaved=5)
        splits = [sample.label.split for sample in samples_of(tmp_path / "o.mcap")]
        assert splits == ["test"] * 2 + (["train"] * 4 + ["validation"]) * 2

    def test_a_block_of_neighbours_of_each_class_is_held_out(self, ncars, tmp_path):
        convert(ncars, tmp_path / "o.mcap", hold_out=(2, 5))
        found = [(s.label.source[-13:-7], s.label.split) for s in samples_of(tmp_path / "o.mcap")]
        assert [n for n, split in found if split == "validation"] == ["000004", "000003"]
        assert [n for n, split in found if split == "test"] == ["000000", "000011"]

    def test_blocks_follow_numbers_and_not_letters(self):
        samples = [SamplePath(Path(f"a/{n}.dat"), "a", "", f"a/{n}.dat") for n in (10, 9, 100, 8)]
        marked = hold_out_block(samples, 1, 2)
        assert {s.path.stem for s in marked if s.split == "validation"} == {"8", "9"}

    def test_every_sample_is_held_out_in_one_block(self, ncars):
        samples = find_samples(ncars / "n-cars_train")
        held_out = [
            s.source for i in range(3) for s in hold_out_block(samples, i + 1, 3) if s.split == "validation"
        ]
        assert sorted(held_out) == [s.source for s in samples]

    def test_noise_is_taken_out_of_each_sample_by_itself(self, ncars, tmp_path):
        done = convert(ncars, tmp_path / "o.mcap", denoising=Denoising(refractory_us=100_000))
        denoiser = Denoiser(Denoising(refractory_us=100_000))
        for sample, path in zip(samples_of(tmp_path / "o.mcap"), find_samples(ncars), strict=True):
            denoiser.restart()
            expected = denoiser.events(read_events(path.path).events, sample.resolution)
            assert (sample.events["t"] - sample.label.start_us).tolist() == expected["t"].tolist()
        assert done.removed == denoiser.removed
        assert done.events == 600 - done.removed["refractory"] < 600

    def test_split_can_be_named(self, ncars, tmp_path):
        convert(ncars, tmp_path / "o.mcap", split="holdout")
        assert {sample.label.split for sample in samples_of(tmp_path / "o.mcap")} == {"holdout"}

    def test_limit_keeps_all_labels_and_the_split_of_each_sample(self, ncars, tmp_path):
        inner = ncars / "n-cars_train"
        convert(inner, tmp_path / "all.mcap", interleaved=2)
        convert(inner, tmp_path / "few.mcap", interleaved=2, limit=4)
        splits = {s.label.source: s.label.split for s in samples_of(tmp_path / "all.mcap")}
        few = samples_of(tmp_path / "few.mcap")
        assert [s.label.label for s in few].count("cars") == 2 == len(few) / 2
        assert all(splits[s.label.source] == s.label.split for s in few)

    def test_bad_samples_are_reported_and_the_others_converted(self, ncars, tmp_path):
        bad = ncars / "n-cars_train/cars/obj_000003_td.dat"
        bad.write_bytes(b"\0" * 30)
        empty = put(ncars / "n-cars_train/cars/obj_000099_td.dat", NCARS_HEADER)
        late = make_events([1], [1], [1], [4_000_000_000])
        far = put(ncars / "n-cars_train/cars/obj_000098_td.dat", dat_bytes(late, NCARS_HEADER))
        cut = ncars / "n-cars_train/cars/obj_000005_td.dat"
        cut.write_bytes(cut.read_bytes()[:-3])
        done = convert(ncars, tmp_path / "o.mcap")
        assert [path for path, _ in done.failed] == [bad, far, empty]
        reasons = [reason for _, reason in done.failed]
        assert "not a known event file" in reasons[0]
        assert "longer than an hour" in reasons[1]
        assert "no events" in reasons[2]
        assert [path for path, _ in done.damaged] == [cut]
        assert "5 bytes at byte" in done.damaged[0][1]
        read = samples_of(tmp_path / "o.mcap")
        assert (done.samples, len(read), done.events) == (11, 11, 11 * 50 - 1)

    def test_events_outside_the_data_set_fail_the_sample(self, tmp_path):
        put(tmp_path / "in/Train/1/a.bin", bin40_bytes(sample_events(1, width=20)))
        put(tmp_path / "in/Train/1/b.bin", bin40_bytes(sample_events(1, width=40)))
        done = convert(tmp_path / "in", tmp_path / "o.mcap")
        assert [(path.name, "40x25" in reason) for path, reason in done.failed] == [("b.bin", True)]

    def test_a_file_too_large_to_hold_is_read_twice_with_the_same_result(self, ncars, tmp_path, monkeypatch):
        convert(ncars, tmp_path / "held.mcap")
        monkeypatch.setattr("streamfeat.convert.datasets._HELD_IN_MEMORY", 0)
        convert(ncars, tmp_path / "twice.mcap")
        assert (tmp_path / "twice.mcap").read_bytes() == (tmp_path / "held.mcap").read_bytes()

    @pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
    def test_an_exception_leaves_no_file(self, ncars, tmp_path, error):
        def stop(done: int, total: int) -> None:
            if done == 5:
                raise error

        out = tmp_path / "out"
        out.mkdir()
        with pytest.raises(error):
            convert(ncars, out / "o.mcap", progress=stop)
        assert [*out.iterdir()] == []

    def test_nothing_readable_is_an_error_and_leaves_no_file(self, tmp_path):
        put(tmp_path / "in/cars/a.dat", b"\0" * 30)
        with pytest.raises(InputError, match="none of the 1 samples"):
            convert(tmp_path / "in", tmp_path / "o.mcap")
        assert [path.name for path in tmp_path.iterdir()] == ["in"]

    def test_an_existing_file_is_only_replaced_when_allowed(self, ncars, tmp_path):
        out = put(tmp_path / "o.mcap", b"precious")
        with pytest.raises(InputError, match="exists already"):
            convert(ncars, out)
        assert out.read_bytes() == b"precious"
        convert(ncars, out, overwrite=True)
        assert len(samples_of(out)) == 12

    @pytest.mark.parametrize(
        "arguments",
        [
            {"gap_us": 0},
            {"limit": 0},
            {"interleaved": 1},
            {"interleaved": 5, "split": "train"},
            {"hold_out": (1, 5), "interleaved": 5},
        ],
    )
    def test_arguments_out_of_range(self, ncars, tmp_path, arguments):
        with pytest.raises(InputError):
            convert(ncars, tmp_path / "o.mcap", **arguments)


@pytest.mark.parametrize("text", ["", "5", "0/5", "6/5", "1/1", "1/5000", "a/b", "1/-5"])
def test_what_is_no_block_names_the_option(text):
    with pytest.raises(InputError, match="--hold-out"):
        parse_hold_out(text)


def test_real_nmnist_event_for_event(shared_data, tmp_path):
    subprocess.run([sys.executable, shared_data / "unpack.py", "nmnist", tmp_path / "in"], check=True)
    done = convert(tmp_path / "in", tmp_path / "o.mcap", limit=50)
    assert (done.samples, done.failed, done.damaged) == (50, [], [])
    for sample in samples_of(tmp_path / "o.mcap"):
        source = read_events(tmp_path / "in" / sample.label.source).events
        assert sample.resolution == (34, 34)
        assert sample.label.split == "train"
        for field in "xyp":
            np.testing.assert_array_equal(sample.events[field], source[field])
        np.testing.assert_array_equal(sample.events["t"] - sample.label.start_us, source["t"])


class TestRecordingsAsSamples:
    """Samples may be MCAP files and bags as well."""

    @pytest.fixture
    def folder(self, tmp_path):
        from test_bags import write_bag

        self.events = {}
        for i, (split, label) in enumerate([("train", "a"), ("train", "b"), ("test", "a")]):
            place = tmp_path / "set" / split / label
            place.mkdir(parents=True)
            for kind in ("one.mcap", "two.dat", "bag"):
                events = sample_events(10 * i + len(kind), width=16)
                events["y"] %= 12
                self.events[f"{split}/{label}/{kind}"] = events
                if kind == "bag":
                    messages = list(PacketWriter().messages(events, (12, 16)))
                    write_bag(place / kind, storage="sqlite3" if i else "mcap", messages=messages)
                elif kind == "one.mcap":
                    with RecordingWriter(place / kind) as writer:
                        writer.write_events(events, (12, 16))
                else:
                    put(place / kind, dat_bytes(events, b"% Width 16\n% Height 12\n% Version 2\n\x00\x08"))
        return tmp_path / "set"

    def test_each_is_one_sample(self, folder, tmp_path):
        done = convert(folder, tmp_path / "o.mcap")
        assert (done.samples, done.failed, done.damaged) == (9, [], [])
        for sample in samples_of(tmp_path / "o.mcap"):
            split, label, _ = sample.label.source.split("/")
            assert (sample.label.split, sample.label.label, sample.resolution) == (split, label, (12, 16))
            wanted = self.events[sample.label.source].copy()
            wanted["t"] += sample.label.start_us - wanted["t"][0]
            np.testing.assert_array_equal(sample.events, wanted)

    def test_one_that_cannot_be_read_is_named(self, folder, tmp_path):
        (folder / "train/a/one.mcap").write_bytes(b"")
        for file in (folder / "train/b/bag").glob("*.db3"):
            file.unlink()
        done = convert(folder, tmp_path / "o.mcap")
        assert done.samples == 7
        assert sorted(str(path.relative_to(folder)) for path, _ in done.failed) == [
            "train/a/one.mcap", "train/b/bag",
        ]  # fmt: skip

    def test_a_clock_that_starts_anew_ends_the_sample_and_is_said(self, folder, tmp_path):
        from test_timeline import messages, moving_dot, store

        made = messages(moving_dot(400, 5_000_000)) + messages(moving_dot(200, 0), host_us=900_000)
        (folder / "train/a/one.mcap").unlink()
        store(folder / "train/a/one.mcap", made)
        done = convert(folder, tmp_path / "o.mcap")
        ((path, why),) = done.damaged
        assert path.name == "one.mcap"
        assert "the 200 events after that are left out" in why
        first = next(s for s in samples_of(tmp_path / "o.mcap") if s.label.source == "train/a/one.mcap")
        assert len(first.events) == 400
