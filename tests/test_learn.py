"""Learning: whitening, fair samples of volumes, and the steps from recordings to an encoder."""

import tracemalloc
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st
from sklearn.utils.estimator_checks import parametrize_with_checks

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.geometry import Geometry
from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.learn.fit import geometry_of, learn_encoder
from streamfeat.learn.settings import DEFAULTS, PRESETS, THRESHOLD, Setting, preset_with
from streamfeat.learn.volumes import Volumes, Window, sample_volumes, windows_of
from streamfeat.learn.whitening import VolumeWhitener
from streamfeat.messages.packets import PacketReader
from streamfeat.recordings.reader import Label, open_recording

D = 12


@parametrize_with_checks([VolumeWhitener()])
def test_the_whitener_is_a_scikit_learn_estimator(estimator, check):
    check(estimator)


# --- whitening


def test_whitening_is_zca():
    rng = np.random.default_rng(0)
    volumes = np.rint(rng.standard_normal((3000, D)) @ rng.standard_normal((D, D))).astype(np.int16)
    whitener = VolumeWhitener(eps=0.01, eps_zca=1e-3, chunk_size=700).fit(volumes)
    white = whitener.transform(volumes)
    v = volumes.astype(np.float64)
    normal = v - v.mean(axis=1, keepdims=True)
    normal /= np.sqrt((normal**2).mean(axis=1, keepdims=True) + 0.01)
    values, vectors = np.linalg.eigh(np.cov(normal.T, bias=True))
    expected = vectors @ np.diag(1 / np.sqrt(values + 1e-3)) @ vectors.T
    assert np.allclose(whitener.mean_, normal.mean(axis=0), atol=1e-6)
    # The direction of the mean has no variance at all: rounding decides there, times 1/sqrt(eps_zca).
    assert np.allclose(whitener.whitening_, expected, atol=1e-3)
    assert np.allclose(white, (normal - normal.mean(axis=0)) @ expected, atol=1e-3)
    covariance = np.cov(white.T.astype(np.float64), bias=True)
    without_mean = np.eye(D) - 1 / D
    assert np.allclose(covariance, without_mean, atol=0.05)


def test_whitening_does_not_touch_its_input():
    volumes = np.arange(180, dtype=np.int16).reshape(15, 12) ** 2 % 7
    before = volumes.copy()
    VolumeWhitener().fit_transform(volumes)
    assert np.array_equal(volumes, before)


def test_whitening_in_one_pass_needs_no_float_copy(tmp_path):
    n, d = 30_000, 60
    path = tmp_path / "counts.npy"
    counts = np.lib.format.open_memmap(path, "w+", np.int8, (n, d))
    counts[:] = np.random.default_rng(0).integers(-2, 3, (n, d))
    mapped = np.load(path, mmap_mode="r")
    tracemalloc.start()
    whitener = VolumeWhitener(chunk_size=1000).fit(mapped)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < n * d * 4 / 4
    assert np.allclose(whitener.whitening_, VolumeWhitener().fit(counts).whitening_, atol=1e-5)


@pytest.mark.parametrize(
    ("volumes", "reason"),
    [
        (
            np.eye(D),
            "n_samples = 12 is too few volumes for the covariance of their 12 entries; give more than 12",
        ),
        (np.full((50, D), 3), "all 50 volumes .* are constant"),
        (np.where(np.eye(50, D) > 0, np.nan, 1), "volume 0 holds NaN or infinity"),
    ],
)
def test_whitening_refuses_what_has_no_covariance(volumes, reason):
    with pytest.raises(InputError, match=reason) as refusal:
        VolumeWhitener().fit(volumes)
    assert "\n" not in str(refusal.value)


# --- volumes

SEED = (7, 0)
POINT = Geometry(patch=1, stride=1, n_bins=1, bin_us=1000, max_count=1000)


def window(value, *, shape=(1, 1), n=1):
    """A window whose every pixel counts `value`, on `n` of its pixels."""
    y, x = np.divmod(np.arange(n), shape[1])
    events = make_events(np.repeat(x, value), np.repeat(y, value), 1, np.zeros(n * value, np.int64))
    return Window(events, shape, 0, 999)


def test_volumes_of_a_known_stream():
    geometry = Geometry(patch=2, stride=1, n_bins=2, bin_us=100, max_count=2)
    events = make_events(
        [0, 1, 1, 1, 1, 0, 0], [0, 0, 1, 1, 1, 1, 1], [1, 0, 1, 1, 1, 0, 1], [*range(0, 140, 20)]
    )
    found = sample_volumes([Window(events, (2, 2), 0, 199)], geometry, 3, SEED)
    # Bin by bin, row by row; three ON events are clipped to two; the last two fall into the second bin.
    expected = [1, -1, 0, 2, 0, 0, 0, 0]
    expected[6] += -1 + 1
    assert found.counts.tolist() == [expected] * 3
    assert found.counts.dtype == np.int8
    assert sample_volumes([window(3)], POINT, 1, SEED).counts.dtype == np.int16
    assert (found.empty_share, found.windows) == (0.0, 1)


def test_windows_have_equal_chances():
    counts = np.zeros(11)
    for seed in range(60):
        found = sample_volumes((window(v) for v in range(1, 11)), POINT, 40, (seed,), per_window=16)
        assert len(found.counts) == 40
        counts += np.bincount(found.counts[:, 0], minlength=11)
    # 2,400 draws, 240 expected of each window; one in 10,000 for a chi square of 33.7 with 9 degrees.
    assert np.square(counts[1:] - 240).sum() / 240 < 33.7


def test_places_have_equal_chances():
    y, x = np.divmod(np.arange(6), 3)
    events = make_events(np.repeat(x, y * 3 + x + 1), np.repeat(y, y * 3 + x + 1), 1, np.zeros(21, np.int64))
    windows = []
    for origin in range(0, 40_000, 1000):
        moved = events.copy()
        moved["t"] += origin
        windows.append(Window(moved, (2, 3), origin, origin + 999))
    found = sample_volumes(windows, POINT, 10_000, SEED, per_window=60)
    counts = np.bincount(found.counts[:, 0], minlength=7)[1:]
    assert counts.sum() == 2400
    assert np.square(counts - 400).sum() / 400 < 25.7


def test_empty_places_are_drawn_again_and_counted():
    windows = [window(v, shape=(4, 4), n=4) for v in range(1, 51)]
    found = sample_volumes(windows, POINT, 10_000, SEED, per_window=8)
    assert found.counts.min() == 1
    assert found.empty_share == pytest.approx(0.75, abs=0.04)


def test_too_small_windows_are_passed_over():
    geometry = Geometry(patch=3, stride=1, n_bins=1, bin_us=1000)
    found = sample_volumes([window(1, shape=(2, 9))], geometry, 5, SEED)
    assert (found.counts.shape, found.windows, found.empty_share) == ((0, 9), 0, 0.0)
    found = sample_volumes([window(1, shape=(9, 9), n=0)], geometry, 5, SEED)
    assert (found.counts.shape, found.windows, found.empty_share) == ((0, 9), 1, 1.0)


@given(st.data())
def test_a_sample_is_the_same_in_however_many_parts(data):
    n = data.draw(st.integers(1, 60))
    windows = [replace(window(v), origin_us=-v, last_us=999 - v) for v in range(1, 20)]
    whole = sample_volumes(windows, POINT, n, SEED, per_window=8)
    cut = sorted(data.draw(st.lists(st.integers(0, 19), max_size=4)))
    parts = [sample_volumes(windows[a:b], POINT, n, SEED, per_window=8) for a, b in pairwise([0, *cut, 19])]
    found = Volumes.none(POINT).with_others(data.draw(st.permutations(parts)), n)
    assert np.array_equal(found.keys, whole.keys)
    assert np.array_equal(found.counts, whole.counts)
    assert (found.drawn, found.empty, found.windows) == (whole.drawn, whole.empty, whole.windows)
    limit = int(whole.keys[-1]) + 1
    below = sample_volumes(windows, POINT, n, SEED, per_window=8, limit=limit)
    assert np.array_equal(below.keys, whole.keys)


def test_windows_of_labelled_items():
    items = tiny.labelled_items(3)
    held_out = Label(5_000_000, 80_000, "cat", "test", "")
    items += [held_out, tiny.packet(tiny.steady(5_000_000, 5_080_000, 20))]
    found = list(windows_of(items, tiny.GEOMETRY))
    labels = [item for item in items[:-2] if isinstance(item, Label)]
    assert [w.origin_us for w in found] == [label.start_us for label in labels]
    assert [w.last_us for w in found] == [label.start_us + label.duration_us - 1 for label in labels]
    assert [len(w.events) for w in found] == [300] * 3
    assert all(w.resolution == tiny.RESOLUTION for w in found)


@pytest.mark.parametrize("split", ["validation", "valid", "val", "test"])
def test_held_out_splits_are_not_looked_at(split):
    items = [Label(0, 1000, "cat", split, ""), tiny.packet(tiny.steady(0, 1000, 20))]
    assert list(windows_of(items, tiny.GEOMETRY)) == []


def test_windows_of_unlabelled_items():
    size = tiny.GEOMETRY.window_us
    events = tiny.steady(7_000, 7_000 + 10 * size, 2000)
    events["t"][1500:] += 5 * size
    expected, rest = [], events["t"]
    while len(rest):
        n = int(np.searchsorted(rest, rest[0] + size))
        expected.append((n, rest[0], rest[0] + size - 1))
        rest = rest[n:]
    assert len(expected) > 9
    for cut in (2000, 130, 1):
        items = [tiny.packet(events[i : i + cut]) for i in range(0, 2000, cut)]
        found = list(windows_of(items, tiny.GEOMETRY))
        assert [(len(w.events), w.origin_us, w.last_us) for w in found] == expected


def test_windows_end_where_the_resolution_changes():
    first, second = tiny.steady(0, 1000, 10), tiny.steady(1000, 2000, 20, resolution=(8, 8))
    found = list(windows_of([tiny.packet(first), tiny.packet(second, (8, 8))], tiny.GEOMETRY))
    assert [(len(w.events), w.resolution) for w in found] == [(10, tiny.RESOLUTION), (20, (8, 8))]


# --- all of it


LEARN = {
    "filters": 7, "patch": 4, "stride": 4, "bins": 2, "window_ms": 100.0, "max_count": 2,
    "volumes": 200, "iterations": 2, "seed": 4,
}  # fmt: skip
"""The geometry is `tiny.GEOMETRY`."""


def learn(recording, resume=None, report=lambda *step: None, **changes):
    return learn_encoder([recording], Setting(**LEARN | changes), resume=resume, report=report)


@pytest.fixture
def recording(tmp_path):
    path = tiny.write_items(tmp_path / "a.mcap", tiny.labelled_items(6))
    with open_recording(path) as recording:
        yield recording


@pytest.mark.parametrize("formulation", ["direct", "inverse"])
def test_learn_encoder(recording, formulation):
    told = []
    model, again = (
        learn(recording, formulation=formulation, report=lambda *step: told.append(step)) for _ in range(2)
    )
    assert (model.n_filters, model.formulation, model.geometry) == (7, formulation, tiny.GEOMETRY)
    assert (model.encoding, model.threshold) == ("split", THRESHOLD)
    np.testing.assert_allclose(np.linalg.norm(model.filters, axis=1), 1, atol=1e-6)
    assert model.fingerprint == again.fingerprint
    assert model.provenance["windows"] == 6
    assert model.provenance["volumes"] == 200
    assert model.provenance["recordings"] == ["a.mcap"]
    assert model.provenance["interrupted"] is False
    figures = [len(model.provenance[name]) for name in ("objective", "condition", "coherence")]
    assert figures == [4, 2, 2]
    assert {step[0] for step in told} == {"reading windows", "whitening", "learning"}
    share = f"{model.provenance['empty_share']:.1%} of places were empty"
    assert share in next(step[3] for step in told if step[0] == "whitening")


@pytest.mark.parametrize(
    ("formulation", "weights"),
    [
        ("direct", {"conditioning": 0.4, "coherence": 0.3, "log_det": 0.2}),
        ("inverse", {"coherence": 0.3}),
    ],
)
def test_weights_of_the_penalty_reach_the_learner(recording, formulation, weights):
    rows = {"rows": "free" if formulation == "direct" else "unit"}
    usual = learn(recording, formulation=formulation, **rows)
    for name, weight in weights.items():
        model = learn(recording, formulation=formulation, **rows, **{name: weight})
        assert model.provenance["weights"] == usual.provenance["weights"] | {name: weight}
        assert model.fingerprint != usual.fingerprint


def interrupt_at(iteration):
    """A report during which Ctrl-C comes."""

    def report(step, done, total, remark):
        if (step, done) == ("learning", iteration):
            raise KeyboardInterrupt

    return report


@pytest.mark.parametrize("formulation", ["direct", "inverse"])
def test_an_interrupted_encoder_is_one_to_go_on_from(recording, tmp_path, formulation):
    five = {"formulation": formulation, "iterations": 5}
    whole = learn(recording, **five)
    part = learn(recording, **five, report=interrupt_at(2))
    assert (part.provenance["interrupted"], part.provenance["iterations"]) == (True, 2)
    part.save(tmp_path / "part")
    part = Encoder.load(tmp_path / "part")
    rest = learn(recording, resume=part, formulation=formulation, iterations=3)
    assert not rest.provenance["interrupted"]
    done = rest.provenance["iterations"]
    assert 2 < done <= 5
    lengths = [len(rest.provenance[name]) for name in ("objective", "condition", "coherence")]
    assert lengths == [2 * done, done, done]
    if formulation == "direct":
        assert rest.fingerprint == whole.fingerprint
        assert rest.provenance == whole.provenance
    else:
        # Codes start from zero again, and are the same within the duality gap.
        assert rest.provenance["objective"][-1] == pytest.approx(whole.provenance["objective"][-1], rel=0.01)


@pytest.mark.parametrize("formulation", ["direct", "inverse"])
def test_what_is_kept_after_each_iteration_is_one_to_go_on_from(recording, formulation):
    """As after Ctrl-C, for those who are not asked before they are killed."""
    kept = []
    setting = Setting(**LEARN | {"formulation": formulation, "iterations": 3})
    whole = learn_encoder([recording], setting, keep=lambda make: kept.append(make()))
    assert [(e.provenance["interrupted"], e.provenance["iterations"]) for e in kept] == [
        (True, n) for n in (1, 2, 3)
    ]
    assert kept[2].fingerprint == whole.fingerprint
    stopped = learn(recording, formulation=formulation, iterations=3, report=interrupt_at(2))
    assert (kept[1].fingerprint, kept[1].provenance) == (stopped.fingerprint, stopped.provenance)
    rest = learn(recording, resume=kept[1], formulation=formulation, iterations=1)
    if formulation == "direct":
        assert (rest.fingerprint, rest.provenance) == (whole.fingerprint, whole.provenance)


def test_an_interruption_before_anything_was_learned_gives_no_encoder(recording):
    def report(step, done, total, remark):
        if step == "reading windows":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learn(recording, report=report)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"stride": 3}, r"has geometry .*stride=4.* not .*stride=3"),
        ({"formulation": "inverse"}, "has formulation direct, not inverse"),
        ({"encoding": "soft"}, "has encoding split, not soft"),
        ({"threshold": 0.7}, "has threshold 1.0, not 0.7"),
        ({"lambda0": 0.7}, "has lambda0 2.0, not 0.7"),
        ({"rows": "free", "lambda0": 2.0}, "has rows unit, not free"),
        ({"filters": 8}, "has filters 7, not 8"),
        ({"volumes": 100}, r"learned from other volumes \(200 of a.mcap, seed 4\)"),
        ({"seed": 5}, "learned from other volumes"),
    ],
)
def test_going_on_from_something_else_is_refused(recording, change, reason):
    with pytest.raises(InputError, match=reason):
        learn(recording, resume=learn(recording), **change)


def test_going_on_from_other_recordings_or_a_model_without_history_is_refused(recording, tmp_path):
    model = learn(recording)
    other = tiny.write_items(tmp_path / "a2.mcap", tiny.labelled_items(5))
    with open_recording(other) as opened, pytest.raises(InputError, match="other volumes"):
        learn(opened, resume=model)
    with pytest.raises(InputError, match="does not say how it was learned"):
        learn(recording, resume=tiny.encoder(k=7), threshold=0.3)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"formulation": "sideways"}, "formulation is 'sideways'"),
        ({"encoding": "loud"}, "encoding is 'loud'"),
        ({"volumes": 1}, "at least two volumes"),
        ({"volumes": 32}, "32 volumes are too few .* a covariance of 32 entries; learn from at least 33"),
        ({"filters": 300}, "200 volumes are too few for 300 filters .* at least 300"),
        ({"iterations": 0}, "one iteration"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**40}, "seed"),
        ({"threshold": float("nan")}, "threshold"),
        ({"threshold": 0.0, "formulation": "inverse"}, "threshold is 0.0"),
        ({"filters": 0}, "one filter"),
        ({"bins": 0}, "0 bins"),
        ({"window_ms": 0.0}, "a window of 0.0 ms"),
        ({"window_ms": float("nan")}, "a window of nan ms"),
        ({"coherence": -1.0}, "coherence is -1.0, it must be finite and not negative"),
        ({"conditioning": 0.1, "formulation": "inverse"}, "conditioning is a weight of the direct"),
        ({"log_det": 0.1, "formulation": "inverse"}, "log_det is a weight of the direct"),
        ({"log_det": 0.1}, "log_det is a weight for filters of any length; give --rows free"),
        ({"rows": "free", "formulation": "inverse"}, "free rows are for the direct formulation"),
        ({"start": "zero"}, "start is 'zero', it must be one of kmeans, random"),
        ({"lambda0": -1.0}, "lambda0 is -1.0"),
    ],
)
def test_bad_settings_are_refused_before_any_work(change, reason):
    with pytest.raises(InputError, match=reason) as refusal:
        Setting(**LEARN | change)
    assert "\n" not in str(refusal.value)


def test_free_filters_are_scaled_and_can_be_gone_on_from(recording):
    free = {"rows": "free", "filters": 7}
    whole = learn(recording, **free, iterations=5)
    np.testing.assert_allclose(np.linalg.norm(whole.filters, axis=1), 1, rtol=1e-6)
    part = learn(recording, **free, iterations=2)
    rest = learn(recording, resume=part, **free, iterations=3)
    assert np.ptp(whole.provenance["lengths"]) > 0.01
    np.testing.assert_allclose(rest.filters, whole.filters, atol=1e-3)


def test_the_two_thresholds_do_two_things(recording):
    usual = learn(recording)
    assert np.array_equal(learn(recording, threshold=0.7).filters, usual.filters)
    assert learn(recording, threshold=0.7).threshold == 0.7
    other = learn(recording, lambda0=0.7)
    assert (other.threshold, other.provenance["lambda0"]) == (usual.threshold, 0.7)
    assert not np.array_equal(other.filters, usual.filters)


def test_a_short_recording_gives_as_many_volumes_as_were_asked_for(tmp_path):
    path = tiny.write_items(tmp_path / "second.mcap", [tiny.packet(tiny.steady(0, 1_000_000, 3000))])
    with open_recording(path) as recording:
        assert learn(recording, volumes=12_500).provenance["volumes"] == 12_500


def test_presets():
    assert Setting(**preset_with("default", {})) == Setting()
    paper = Setting(**preset_with("paper", {"filters": 100, "bins": None}))
    assert (paper.filters, paper.bins, paper.encoding) == (100, 7, "triangle")
    assert all(changes.keys() <= DEFAULTS.keys() for changes in PRESETS.values())
    with pytest.raises(
        InputError, match="there is no preset 'best'; choose from default, fast, accurate, paper"
    ):
        preset_with("best", {})


def test_a_recording_of_too_few_volumes_is_refused(tmp_path):
    path = tiny.write_items(tmp_path / "b.mcap", tiny.labelled_items(1, events=3))
    with open_recording(path) as recording, pytest.raises(InputError, match="too few volumes") as refusal:
        learn(recording, volumes=10_000, filters=9000)
    assert "\n" not in str(refusal.value)


def test_the_window_is_that_of_the_samples_to_learn_from(tmp_path):
    items = tiny.labelled_items(3, duration_us=90_001)
    items += [Label(5_000_000 + i, 10, "cat", "test", "") for i in range(5)]
    with open_recording(tiny.write_items(tmp_path / "a.mcap", items)) as recording:
        assert geometry_of(Setting(), [recording]).bin_us == 30_001
        assert geometry_of(Setting(window_ms=30.0), [recording]).bin_us == 10_000
    assert geometry_of(Setting(bins=4), []).bin_us == 25_000
    assert geometry_of(Setting(**LEARN), []) == tiny.GEOMETRY


def test_a_geometry_has_every_value_of_a_setting_that_it_knows():
    changed = {"patch": 5, "stride": 3, "downsample": 2, "max_count": 9}
    geometry = geometry_of(Setting(**changed), [])
    assert {name: getattr(geometry, name) for name in changed} == changed


@pytest.fixture
def decoded(monkeypatch):
    """The messages of events that are decoded."""
    messages, decode = [], PacketReader.decode
    monkeypatch.setattr(PacketReader, "decode", lambda *given: messages.append(given[2]) or decode(*given))
    return messages


@pytest.mark.parametrize(("window_ms", "opened"), [(None, 2), (100.0, 1)])
@pytest.mark.parametrize("labelled", [True, False])
def test_each_packet_is_decoded_once_also_when_going_on(labelled, window_ms, opened, tmp_path, decoded):
    items = [item for item in tiny.labelled_items(5) if labelled or not isinstance(item, Label)]
    with open_recording(tiny.write_items(tmp_path / "b.mcap", items)) as recording:
        for resume in (None, learn(recording, window_ms=window_ms)):
            decoded.clear()
            learn(recording, window_ms=window_ms, resume=resume)
            assert len(decoded) == 10 + opened  # the first says how large the sensor is


def test_labels_are_known_without_their_events(tmp_path, decoded):
    items = tiny.labelled_items(5)
    with open_recording(tiny.write_items(tmp_path / "b.mcap", items)) as recording:
        decoded.clear()
        assert [*recording.stored_labels()] == [item for item in items if isinstance(item, Label)]
        assert decoded == []
