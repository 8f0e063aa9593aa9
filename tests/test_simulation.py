"""From image files and films to recordings of simulated events."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from streamfeat.convert.simulation import MONITOR_CAMERA, Scene, simulate_film, simulate_images
from streamfeat.errors import InputError
from streamfeat.recordings.reader import Label, open_recording
from streamfeat.simulate.camera import CameraModel, EventCamera
from streamfeat.simulate.films import open_film
from streamfeat.simulate.pictures import load_picture
from streamfeat.work.workers import ThreadWorkers

Image = pytest.importorskip("PIL.Image", reason="the extra `simulate` is not installed")

SCENE = Scene(replace(MONITOR_CAMERA, resolution=(40, 50), noise_hz=0.0))
RNG = np.random.default_rng


def blocks(height=40, width=50, seed=0):
    """A picture with edges everywhere, `(height, width)` uint8."""
    coarse = RNG(seed).integers(0, 256, (height // 5, width // 5), dtype=np.uint8)
    return np.repeat(np.repeat(coarse, 5, axis=0), 5, axis=1)


def save(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)
    return path


@pytest.fixture
def folder(tmp_path):
    for i in range(6):
        save(tmp_path / "set" / "ab"[i % 2] / f"image_{i}.png", blocks(seed=i))
    return tmp_path / "set"


def samples_of(path):
    with open_recording(path) as recording:
        return {sample.label.source: sample for sample in recording.samples()}


def simulate_to(path, source, scene=SCENE, **options):
    done = simulate_images(source, path, scene, **options)
    return done, samples_of(path)


def test_each_image_is_a_sample_with_its_label_split_and_source(folder, tmp_path):
    seen = []
    done, samples = simulate_to(
        tmp_path / "out.mcap", folder, interleaved=3, progress=lambda *at: seen.append(at)
    )
    assert (done.samples, done.failed, done.damaged) == (6, [], [])
    assert seen == [(i, 6) for i in range(1, 7)]
    assert list(samples) == [f"{'ab'[i % 2]}/image_{i}.png" for i in (0, 2, 4, 1, 3, 5)]
    assert [s.label.label for s in samples.values()] == [*"aaabbb"]
    assert [s.label.split for s in samples.values()] == ["train", "train", "validation"] * 2
    assert {s.label.duration_us for s in samples.values()} == {300_000}
    starts = [s.label.start_us for s in samples.values()]
    assert starts == [1_000_000 + i * 1_300_000 for i in range(6)]
    for sample in samples.values():
        t = sample.events["t"] - sample.label.start_us
        assert len(t) > 500
        assert t.min() >= 0
        assert t.max() < 300_000
    assert done.events == sum(len(s.events) for s in samples.values())


def test_the_same_bits_on_any_number_of_workers_and_of_any_part(folder, tmp_path):
    scene = Scene(replace(SCENE.camera, noise_hz=5.0), seed=7)
    _, one = simulate_to(tmp_path / "1.mcap", folder, scene, workers=ThreadWorkers(1))
    simulate_images(folder, tmp_path / "3.mcap", scene, workers=ThreadWorkers(3))
    assert (tmp_path / "1.mcap").read_bytes() == (tmp_path / "3.mcap").read_bytes()
    _, part = simulate_to(tmp_path / "part.mcap", folder, scene, limit=2)
    assert len(part) == 2
    for source, sample in part.items():
        mine, whole = sample.events.copy(), one[source].events.copy()
        mine["t"] -= sample.label.start_us
        whole["t"] -= one[source].label.start_us
        np.testing.assert_array_equal(mine, whole)
    _, other = simulate_to(tmp_path / "8.mcap", folder, replace(scene, seed=8))
    assert any(len(other[s].events) != len(one[s].events) for s in one)


def test_the_border_of_an_image_is_never_seen_or_is_black_all_around(tmp_path):
    save(tmp_path / "set" / "a" / "white.png", np.full((28, 28), 255, np.uint8))
    save(tmp_path / "set" / "a" / "grid.png", blocks(30, 60))
    black = Scene(replace(SCENE.camera, resolution=(34, 34)), amplitude_px=3.0, border="black")
    _, samples = simulate_to(tmp_path / "black.mcap", tmp_path / "set", black)
    assert {s.resolution for s in samples.values()} == {(34, 34)}
    edge = samples["a/white.png"].events
    assert len(edge) > 100  # of an image that is 28 pixels of 34, and moves by 3
    assert edge["x"].min() <= 2
    assert edge["x"].max() >= 31
    assert not ((abs(edge["x"].astype(int) - 16) < 9) & (abs(edge["y"].astype(int) - 16) < 9)).any()

    done, samples = simulate_to(tmp_path / "crop.mcap", tmp_path / "set")
    # 30x60 fits into 40x50 as 25x50, of which 7 pixels are lost; the white one shows nothing at all.
    assert [s.resolution for s in samples.values()] == [(18, 43)]
    assert "white.png: is all of one grey" in done.failed[0][1]


def test_around_an_image_all_may_be_as_its_border(tmp_path):
    dark = np.full((28, 28), 255, np.uint8)
    dark[10:18, 10:18] = 0
    save(tmp_path / "set" / "a" / "dark.png", dark)
    save(tmp_path / "set" / "a" / "white.png", np.full((28, 28), 255, np.uint8))
    edge = Scene(replace(SCENE.camera, resolution=(34, 34)), amplitude_px=3.0, border="edge")
    done, samples = simulate_to(tmp_path / "edge.mcap", tmp_path / "set", edge)
    assert "white.png: is all of one grey" in done.failed[0][1]
    (sample,) = samples.values()
    events = sample.events
    assert sample.resolution == (34, 34)
    assert 7 < events["x"].min() < events["x"].max() < 26
    # It goes down first: the lower side darkens where the upper one brightens.
    first = events[events["t"] - events["t"].min() < 90_000]
    assert first["y"][first["p"] == 0].mean() > first["y"][first["p"] == 1].mean() + 3


def test_transparent_is_black_and_16_bits_are_16_bits(tmp_path):
    plain = blocks()
    eight = load_picture(save(tmp_path / "8.png", plain), (40, 50))
    assert eight.shape == (40, 50)
    np.testing.assert_allclose(eight, plain / 255, atol=1e-7)
    sixteen = save(tmp_path / "16.png", plain.astype(np.uint16) * 257 + np.uint16(100 * (plain == 0)))
    found = load_picture(sixteen, (40, 50))
    np.testing.assert_allclose(found, np.where(plain == 0, 100 / 65535, plain / 255), atol=1e-6)
    alpha = np.dstack([plain, plain, plain, np.where(np.arange(50) < 25, 255, 0) + 0 * plain]).astype(
        np.uint8
    )
    seen = load_picture(save(tmp_path / "alpha.png", alpha), (40, 50))
    np.testing.assert_allclose(seen, np.where(np.arange(50) < 25, plain / 255, 0), atol=1e-6)


def test_an_image_is_as_large_as_fits(tmp_path):
    path = save(tmp_path / "small.png", blocks(10, 20))
    assert load_picture(path, (100, 100)).shape == (50, 100)
    assert load_picture(path, (100, 100), enlarge=False).shape == (10, 20)
    assert load_picture(path, (5, 100)).shape == (5, 10)


def hostile(folder):
    """Images that cannot be used, and a word of the reason for each."""
    good = save(folder / "a" / "good.png", blocks()).read_bytes()
    (folder / "a" / "cut.png").write_bytes(good[:-40])
    (folder / "a" / "text.jpg").write_text("no image")
    (folder / "a" / "empty.gif").write_bytes(b"")
    (folder / "a" / "gone.png").symlink_to(folder / "nowhere.png")
    save(folder / "a" / "one.png", np.zeros((1, 1), np.uint8))
    save(folder / "a" / "grey.png", np.full((30, 40), 90, np.uint8))
    save(folder / "a" / "strip.png", np.zeros((2, 90), np.uint8))
    save(folder / "a" / "float.tif", np.zeros((9, 9), np.float32))
    save(folder / "a" / "deep.tif", np.full((9, 9), 70_000, np.int32))
    reasons = {
        "cut": "",
        "text": "no image",
        "empty": "no image",
        "gone": "leads nowhere",
        "one": "one pixel",
        "grey": "one grey",
    }
    return reasons | {"strip": "too narrow", "float": "floating-point", "deep": "16 bits"}


def test_images_that_cannot_be_used_are_counted_and_the_others_are_there(tmp_path, run):
    reasons = hostile(tmp_path / "set")
    result = run("simulate", tmp_path / "set", tmp_path / "out.mcap", "--resolution", "50x40", "--json")
    assert result.status == 1, result.err
    assert (result.json["samples"], result.json["failed"]) == (1, len(reasons))
    told = {
        fault["file"].rpartition("/")[2].partition(".")[0]: fault["reason"] for fault in result.json["faults"]
    }
    assert told.keys() == reasons.keys()
    assert all(reason in told[name] for name, reason in reasons.items())
    assert [line.count(str(tmp_path)) for line in result.err.splitlines() if "/one.png" in line] == [1]
    assert result.err.count("failed:") == len(reasons)
    assert list(samples_of(tmp_path / "out.mcap")) == ["a/good.png"]


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["nowhere"], "does not exist"),
        (["set", "--threshold", "0"], "--threshold"),
        (["set", "--resolution", "50"], "--resolution"),
        (["set", "--resolution", "12x12"], "too small"),
        (["set", "--border", "grey"], "--border"),
        (["set", "--fps", "3"], "--fps"),
        (["set/a", "--interleaved", "5"], "--interleaved"),
        (["set", "--gamma", "nan"], "--gamma"),
        (["set", "--noise-hz", "nan"], "--noise-hz"),
    ],
)
def test_what_makes_no_sense_is_one_line(folder, run, monkeypatch, words, why):
    monkeypatch.chdir(folder.parent)
    result = run("simulate", words[0], "out.mcap", *words[1:])
    assert result.status == 2
    assert why in result.err
    assert result.err.count("\n") == 1
    assert not (folder.parent / "out.mcap").exists()


def test_interrupted_it_leaves_nothing(folder, tmp_path):
    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_images(folder, tmp_path / "out.mcap", SCENE, progress=stop)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_without_the_extra_it_says_how_to_install_it(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(InputError, match=r"streamfeat\[simulate\]"):
        simulate_images(folder, tmp_path / "out.mcap", SCENE)
    monkeypatch.setitem(sys.modules, "av", None)
    (tmp_path / "film.mp4").write_bytes(b"?")
    with pytest.raises(InputError, match=r"streamfeat\[simulate\]"):
        open_film(tmp_path / "film.mp4", None)


# Films.


def square(i):
    """A white square that goes a pixel to the right with each frame."""
    frame = np.zeros((40, 60), np.uint8)
    frame[12:24, 6 + i : 18 + i] = 255
    return frame


def write_video(path, n=30, fps=25):
    av = pytest.importorskip("av", reason="the extra `simulate` is not installed")
    with av.open(path, "w") as container:
        stream = container.add_stream("mpeg4", rate=fps)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 60, 40, "yuv420p", 4_000_000
        for i in range(n):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(square(i), "gray")))
        container.mux(stream.encode())
    return path


@pytest.fixture
def frames(tmp_path):
    for i in range(30):
        save(tmp_path / "frames" / f"f{i}.png", square(i))  # f10 is after f9
    return tmp_path / "frames"


QUIET = Scene(replace(MONITOR_CAMERA, noise_hz=0.0))


def test_a_folder_of_frames_is_a_film_in_natural_order(frames, tmp_path):
    film = open_film(frames, None, fps=25.0)
    assert (film.n_frames, film.resolution, film.duration_us) == (30, (40, 60), 29 * 40_000)
    label = Label(0, 0, "square", "", "frames")
    done = simulate_film(film, tmp_path / "out.mcap", QUIET, label=label)
    (sample,) = samples_of(tmp_path / "out.mcap").values()
    assert sample.label == replace(label, duration_us=29 * 40_000)
    assert len(sample.events) == done.events > 500
    on, off = (sample.events[sample.events["p"] == p] for p in (1, 0))
    # The right edge leads and brightens; each goes 25 pixels a second.
    lead = np.median(on["x"] - on["t"] * 25e-6) - np.median(off["x"] - off["t"] * 25e-6)
    assert lead == pytest.approx(12, abs=2)


def test_a_video_gives_about_what_its_frames_give(frames, tmp_path):
    film = open_film(write_video(tmp_path / "film.mp4"), None)
    assert (film.n_frames, film.resolution, film.duration_us) == (30, (40, 60), 29 * 40_000)
    seen = list(film)
    assert [t for t, _ in seen] == [40_000 * i for i in range(30)]
    assert abs(seen[7][1] - square(7) / 255).max() < 0.2
    done = simulate_film(film, tmp_path / "video.mcap", QUIET)
    still = simulate_film(open_film(frames, None, 25.0), tmp_path / "frames.mcap", QUIET)
    assert done.events == pytest.approx(still.events, rel=0.25)
    assert (done.damaged, still.damaged) == ([], [])


def test_a_film_is_made_smaller_and_not_larger(frames):
    assert open_film(frames, (20, 60)).resolution == (20, 30)
    assert open_film(frames, (400, 600)).resolution == (40, 60)


def test_frames_that_cannot_be_read_are_left_out_and_told(frames, tmp_path, run):
    (frames / "f3.png").write_bytes(b"no image")
    save(frames / "f4.png", square(4)[:20])
    result = run("simulate", frames, tmp_path / "out.mcap", "--json", "--label", "x", "--fps", 100)
    assert result.status == 1
    assert (result.json["samples"], result.json["damaged"]) == (1, 2)
    assert ["f3.png" in f["reason"] or "f4.png" in f["reason"] for f in result.json["faults"]] == [True] * 2
    with open_recording(tmp_path / "out.mcap") as recording:
        assert recording.resolution == (40, 60)


def test_films_without_frames_are_one_line(tmp_path, run):
    av = pytest.importorskip("av", reason="the extra `simulate` is not installed")
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "empty.mp4").write_bytes(b"")
    write_video(tmp_path / "one.mp4", n=1)
    with av.open(tmp_path / "sound.wav", "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        sound.sample_rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode())
    save(tmp_path / "lonely" / "f.png", square(0))
    reasons = {
        "text.mp4": "no video",
        "empty.mp4": "no video",
        "one.mp4": "1 frames",
        "sound.wav": "no video stream",
        "lonely": "needs two",
    }
    for name, why in reasons.items():
        result = run("simulate", tmp_path / name, tmp_path / "out.mcap")
        assert result.status == 2, name
        assert why in result.err, name
        assert result.err.count("\n") == 1
    assert not (tmp_path / "out.mcap").exists()


def test_a_video_that_is_cut_off_gives_what_comes_before(tmp_path):
    path = write_video(tmp_path / "film.mkv")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    film = open_film(path, None)
    done = simulate_film(film, tmp_path / "out.mcap", QUIET)
    assert done.events > 100
    assert 5 < len(list(film)) < 30


@pytest.mark.parametrize("noise_hz", [0.0, 400.0])
def test_events_do_not_depend_on_when_they_are_asked_for(noise_hz):
    model = CameraModel((6, 7), threshold=0.2, refractory_us=3_000, noise_hz=noise_hz, bandwidth_hz=90.0)
    frames = np.cumsum(RNG(3).normal(0, 0.3, (60, 6, 7)), axis=0)

    def film(every):
        seeing, parts = EventCamera(model, RNG(1)), []
        for i, frame in enumerate(frames):
            seeing.see(frame, 1_000 + 2_500 * i)
            if i % every == every - 1:
                parts.append(seeing.events())
        return [*parts, seeing.events(last=True)]

    whole, parts = np.concatenate(film(100)), film(3)
    together = np.concatenate(parts)
    assert len(together) > 300
    assert (np.diff(together["t"]) >= 0).all()
    if noise_hz:  # drawn at other moments, but lost in the same way
        place = together["y"].astype(int) * 7 + together["x"]
        for pixel in range(42):
            assert np.diff(together["t"][place == pixel]).min() >= 2_999  # whole microseconds of two times
    else:
        np.testing.assert_array_equal(together, whole)


def test_slow_photoreceptors_see_a_step_late():
    def first(bandwidth_hz):
        model = CameraModel((1, 1), 0.5, 0.0, noise_hz=0.0, bandwidth_hz=bandwidth_hz)
        seeing = EventCamera(model, RNG(0))
        for i in range(100):
            seeing.see(np.full((1, 1), float(i > 0)), 1_000 * i)
        return seeing.events(last=True)["t"][0]

    # A step of 1 is at half of it after ln 2 / (2 pi f): 11.03 ms at 10 Hz, and rises over one frame.
    assert first(0.0) == 500
    assert first(10.0) == pytest.approx(11_030, abs=600)


def test_a_pixel_with_more_events_than_there_is_room_for_loses_none():
    seeing = EventCamera(CameraModel((1, 3), 2.0**-17, 0.0, refractory_us=0, noise_hz=0.0), RNG(0))
    seeing.see(np.zeros((1, 3)), 0)
    seeing.see(np.array([[0.0, 1.0, -0.5]]), 1_000)
    seeing.see(np.array([[0.25, 1.0, -0.5]]), 2_000)
    events = seeing.events(last=True)
    by_pixel = [np.count_nonzero(events["x"] == x) for x in range(3)]
    assert by_pixel == pytest.approx([2**15, 2**17, 2**16], abs=1)  # one may fall on the last microsecond
    assert (np.diff(events["t"]) >= 0).all()
