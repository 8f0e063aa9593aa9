"""The event-camera simulation: hand-computed crossings, a slow twin of the pixel, and how samples look."""

import math

import numpy as np
import pytest

from streamfeat.events import EVENT_DTYPE
from streamfeat.simulate.camera import CameraModel, events_from_frames
from streamfeat.simulate.saccades import Saccades, digit_samples, simulate_saccades

IDEAL = {"threshold_mismatch": 0.0, "noise_hz": 0.0}
DOT = np.pad([[1.0]], 3)


def film_events(levels, times, **camera):
    """Events of one row of pixels; `levels` is `(n_frames, n_pixels)`."""
    levels = np.asarray(levels, float)
    model = CameraModel(resolution=(1, levels.shape[1]), **{**IDEAL, **camera})
    return events_from_frames(levels[:, None, :], np.asarray(times), np.random.default_rng(0), model)


def naive_events(levels, times, threshold, refractory_us):
    """The pixel as its circuit works, one event at a time: `(x, p, t)` sorted by pixel and time."""
    found = []
    for x in range(levels.shape[1]):
        now, reference = float(times[0]), levels[0, x]
        for i in range(len(times) - 1):
            start, end = float(times[i]), float(times[i + 1])
            slope = (levels[i + 1, x] - levels[i, x]) / (end - start)
            while now <= end:
                if reference is None:
                    reference = levels[i, x] + slope * (now - start)
                target = reference + math.copysign(threshold, slope)
                crossing = start + (target - levels[i, x]) / slope if slope else math.inf
                if crossing > end:
                    break
                found.append((x, int(slope > 0), crossing))
                now, reference = crossing + refractory_us, None
    return found


def same_pixel_gaps(events):
    pixel = events["y"].astype(int) * 65536 + events["x"]
    order = np.lexsort((events["t"], pixel))
    return np.diff(events["t"][order])[np.diff(pixel[order]) == 0]


def test_ramp_gives_the_times_computed_by_hand():
    # Up and down by 2 in 1,024 us each: a threshold of 0.5 is 256 us, and 120 us of reset follow.
    # The reset after 1,008 ends at 1,128, on the way down; 1,760 + 120 + 256 is after the end.
    events = film_events([[0.0], [2.0], [0.0]], [0, 1024, 2048], threshold=0.5, refractory_us=120)
    assert events["t"].tolist() == [256, 632, 1008, 1384, 1760]
    assert events["p"].tolist() == [1, 1, 1, 0, 0]
    assert events.dtype == EVENT_DTYPE


def test_change_adds_up_over_frames():
    # 0.25, 0.375, then 0.625 at the end: 0.5 is reached half way through the last interval.
    events = film_events([[0.0], [0.25], [0.375], [0.625]], [100, 200, 300, 400], threshold=0.5)
    assert events["t"].tolist() == [350]


def test_a_crossing_on_a_frame_counts_once_and_the_end_is_not_included():
    events = film_events([[0.0], [0.5], [0.5], [1.0]], [0, 64, 128, 192], threshold=0.5, refractory_us=0)
    assert events["t"].tolist() == [64]


def test_change_during_the_refractory_time_is_not_seen():
    # The event at 10 us holds the pixel until 1,010; the rise by 8 in between is part of the new reference.
    levels = [[0.0], [1.0], [9.0], [9.0], [9.25]]
    events = film_events(levels, [0, 20, 500, 1100, 1200], threshold=0.5, refractory_us=1000)
    assert events["t"].tolist() == [10]


@pytest.mark.parametrize("refractory_us", [0, 70, 2500])
@pytest.mark.parametrize("threshold", [0.0625, 0.25])
def test_agrees_with_the_slow_pixel(threshold, refractory_us):
    rng = np.random.default_rng(5)
    times = np.cumsum(rng.integers(1, 1500, 40))
    # Random steps, so that no crossing falls on a frame, where rounding would decide; a third stand still.
    steps = rng.integers(-(2**18), 2**18, (40, 30)) * (rng.random((40, 30)) < 2 / 3)
    levels = np.cumsum(steps, axis=0) / 2**20
    events = film_events(levels, times, threshold=threshold, refractory_us=refractory_us)
    expected = naive_events(levels, times, threshold, refractory_us)
    order = np.lexsort((events["t"], events["x"]))
    assert len(expected) > 30
    assert [(x, p) for x, p, _ in expected] == list(
        zip(events["x"][order].tolist(), events["p"][order].tolist(), strict=True)
    )
    # The slow pixel adds periods one by one, so a time may be rounded across a whole microsecond.
    assert np.abs(np.floor([t for *_, t in expected]) - events["t"][order]).max() <= 1


def test_nothing_moves_nothing_happens():
    still = Saccades(amplitude_px=(0.0, 0.0))
    camera = CameraModel(noise_hz=0.0)
    assert len(simulate_saccades(DOT, np.random.default_rng(0), camera, still)) == 0
    assert len(simulate_saccades(0 * DOT, np.random.default_rng(0), camera)) == 0


def test_a_wide_white_wall_looks_the_same_from_everywhere():
    camera, wall = CameraModel(threshold=0.005, **IDEAL), Saccades(image_px=100.0)
    assert len(simulate_saccades(np.ones((40, 40)), np.random.default_rng(0), camera, wall)) == 0


def test_events_are_sorted_inside_the_sensor_and_of_both_polarities():
    camera = CameraModel(resolution=(20, 40), noise_hz=5.0)
    events = simulate_saccades(DOT, np.random.default_rng(0), camera, Saccades(image_px=60.0))
    assert (np.diff(events["t"]) >= 0).all()
    assert events["t"][0] >= 0
    assert events["t"][-1] < 300_000
    assert events["x"].max() == 39
    assert events["y"].max() == 19
    assert 0.3 < np.mean(events["p"]) < 0.7
    assert set(events["p"].tolist()) == {0, 1}


@pytest.mark.parametrize("refractory_us", [500, 20_000])
def test_no_pixel_fires_in_its_refractory_time(refractory_us):
    camera = CameraModel(threshold=0.05, refractory_us=refractory_us, noise_hz=20.0)
    events = simulate_saccades(DOT, np.random.default_rng(0), camera)
    assert same_pixel_gaps(events).min() >= refractory_us
    # The bound is reached, so it is the refractory time that bounds.
    assert same_pixel_gaps(events).min() < 1.5 * refractory_us


def test_on_events_lead_the_way():
    # A white dot goes down and right, then up and right, then straight to the left.
    events = simulate_saccades(DOT, np.random.default_rng(0), CameraModel(**IDEAL))
    leads = []
    for start in (0, 100_000, 200_000):
        leg = events[(events["t"] >= start) & (events["t"] < start + 100_000)]
        on, off = leg[leg["p"] == 1], leg[leg["p"] == 0]
        leads.append([on[axis].mean() - off[axis].mean() for axis in ("x", "y")])
    (right_1, down_1), (right_2, down_2), (right_3, down_3) = leads
    assert right_1 > 1
    assert down_1 > 1
    assert right_2 > 1
    assert down_2 < -1
    assert right_3 < -1
    assert abs(down_3) < 0.6


def test_path_is_a_closed_triangle_travelled_from_rest_to_rest():
    times, shifts = Saccades(amplitude_px=(2.0, 4.0), step_us=7_000).path()
    assert times[0] == 0
    assert times[-1] == 300_000
    assert np.diff(times).max() == 7_000
    assert shifts[0].tolist() == shifts[-1].tolist() == [-2.0, -4.0]
    corners = Saccades(amplitude_px=(2.0, 4.0)).path()[1][[0, 25, 50, 75]]
    assert corners.tolist() == [[-2, -4], [2, 0], [-2, 4], [-2, -4]]
    speed = np.abs(np.diff(shifts[:, 1]))
    assert speed[0] < 0.05 * speed.max()


def test_higher_thresholds_give_fewer_events():
    counts = [
        len(simulate_saccades(DOT, np.random.default_rng(0), CameraModel(threshold=c, noise_hz=0.0)))
        for c in (0.2, 0.4, 0.8, 100.0)
    ]
    assert counts[0] > 1.5 * counts[1] > 2.25 * counts[2] > 0
    assert counts[3] == 0


def test_mismatch_belongs_to_the_sensor():
    camera = CameraModel(threshold=0.4, threshold_mismatch=0.1)
    off, on = camera.thresholds()
    assert np.std(np.log(on)) == pytest.approx(0.1, rel=0.1)
    assert np.mean(np.log(off)) == pytest.approx(np.log(0.4), abs=0.02)
    assert not np.array_equal(off, on)
    assert np.array_equal(camera.thresholds(), [off, on])
    assert (CameraModel(threshold=0.5, threshold_mismatch=0.0).thresholds() == 0.5).all()


@pytest.mark.parametrize("sign", [-1, 1])
def test_every_pixel_obeys_its_own_thresholds(sign):
    camera = CameraModel(resolution=(1, 64), threshold=0.5, threshold_mismatch=0.3, noise_hz=0.0)
    threshold = camera.thresholds()[(sign + 1) // 2]
    for excess, n_events in ((-(2**-20), 0), (2**-20, 64)):
        frames = sign * np.stack([0 * threshold, threshold + excess])[:, None, :]
        events = events_from_frames(frames, np.array([0, 1000]), np.random.default_rng(0), camera)
        assert len(events) == n_events
        assert (events["p"] == (sign > 0)).all()


def test_noise_is_poisson_at_the_rate_asked_for():
    camera = CameraModel(resolution=(50, 80), noise_hz=10.0, refractory_us=0)
    frames = np.zeros((2, 50, 80))
    events = events_from_frames(frames, np.array([0, 1_000_000]), np.random.default_rng(3), camera)
    assert abs(len(events) - 40_000) < 5 * 200
    assert abs(events["p"].sum() - len(events) / 2) < 5 * 100
    per_pixel = np.bincount(events["y"].astype(int) * 80 + events["x"], minlength=4000)
    # Variance over mean, which is 1 for Poisson counts, has a standard deviation of sqrt(2 / 4000).
    assert per_pixel.var() / per_pixel.mean() == pytest.approx(1, abs=5 * 0.0224)
    assert np.histogram(events["t"], bins=10, range=(0, 1e6))[0] == pytest.approx(4000, abs=5 * 63)


def test_noise_counts_vary_as_poisson_counts_do():
    camera = CameraModel(resolution=(1, 1), noise_hz=20.0, refractory_us=0)
    counts = [
        len(
            events_from_frames(
                np.zeros((2, 1, 1)), np.array([0, 1_000_000]), np.random.default_rng(i), camera
            )
        )
        for i in range(200)
    ]
    # The standard deviation of this ratio is sqrt(2 / 200).
    assert np.var(counts) / np.mean(counts) == pytest.approx(1, abs=0.5)


def test_noise_gives_way_to_signal():
    steep = np.array([0.0, 4.0]).reshape(2, 1, 1)
    times = np.array([0, 100_000])
    quiet = CameraModel(resolution=(1, 1), **IDEAL)
    noisy = CameraModel(resolution=(1, 1), threshold_mismatch=0.0, noise_hz=1000.0)
    signal = events_from_frames(steep, times, np.random.default_rng(0), quiet)
    both = events_from_frames(steep, times, np.random.default_rng(0), noisy)
    assert np.isin(signal["t"], both["t"]).all()
    assert len(both) > len(signal)


def test_seed_decides_everything():
    def run(seed):
        return [sample.events.tobytes() for sample in digit_samples(2, seed)]

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_one_image_has_other_noise_under_another_seed():
    camera, glance = CameraModel(resolution=(5, 5), noise_hz=100.0), Saccades(step_us=100_000)
    first, second = (
        {
            sample.source: sample.events.tobytes()
            for sample in digit_samples(300, seed, "test", camera, glance)
        }
        for seed in (1, 2)
    )
    both = first.keys() & second.keys()
    assert both
    assert all(first[source] != second[source] for source in both)


def test_digits_are_balanced_disjoint_and_independent_of_how_many():
    few = list(digit_samples(3, 7, "test"))
    for short, long in zip(few, digit_samples(10, 7, "test"), strict=False):
        assert short.events.tobytes() == long.events.tobytes()
        assert short[1:] == long[1:]

    # A sensor of one pixel that sees next to nothing makes all 1,797 samples quick.
    blind = CameraModel(resolution=(1, 1), **IDEAL)
    glance = Saccades(step_us=100_000)
    test, train = (
        list(digit_samples(n, 7, split, blind, glance)) for n, split in ((500, "test"), (1297, "train"))
    )
    assert len({sample.source for sample in test + train}) == 1797
    assert {sample.split for sample in train} == {"train"}
    assert [sample.source for sample in few] == [sample.source for sample in test[:3]]
    for chosen in (test[:100], train[:300]):
        labels = [sample.label for sample in chosen]
        assert {labels.count(str(digit)) for digit in range(10)} == {len(chosen) // 10}


def test_a_sample_looks_like_one_of_n_mnist():
    for sample in digit_samples(10, 0):
        events = sample.events
        assert 1500 < len(events) < 4000
        assert 0.45 < events["p"].mean() < 0.55
        assert events["t"][-1] > 280_000
        assert 8 < events["x"].mean() < 26
        assert sample.split == "train"
        # Least motion, hence fewest events, around the corners of the path.
        t = events["t"]
        at_corners = sum(((t > c - 10_000) & (t < c + 10_000)).sum() for c in (100_000, 200_000))
        assert at_corners < 0.1 * len(events)


@pytest.mark.parametrize(
    "make",
    [
        lambda: CameraModel(resolution=(0, 34)),
        lambda: CameraModel(threshold=0.0),
        lambda: CameraModel(black_level=0.0),
        lambda: CameraModel(refractory_us=-1),
        lambda: CameraModel(noise_hz=-1.0),
        lambda: CameraModel(threshold_mismatch=-0.1),
        lambda: Saccades(step_us=0),
        lambda: Saccades(saccade_us=0),
        lambda: Saccades(image_px=0.0),
        lambda: next(digit_samples(1, 0, "validation")),
        lambda: next(digit_samples(501, 0, "test")),
        lambda: next(digit_samples(-1, 0)),
        lambda: simulate_saccades(np.zeros(8), np.random.default_rng(0)),
        lambda: simulate_saccades(np.full((8, 8), np.nan), np.random.default_rng(0)),
        lambda: simulate_saccades(np.full((8, 8), 16.0), np.random.default_rng(0)),
        lambda: film_events([[0.0], [1.0]], [0, 1, 2]),
        lambda: film_events([[0.0]], [0]),
        lambda: film_events([[0.0], [1.0]], [5, 5]),
    ],
)
def test_what_has_no_meaning_is_refused(make):
    with pytest.raises(ValueError, match=r"\w"):
        make()
