"""Volumes shorter than the window: the invariants, the mathematics, the file, learning, bad input."""

from dataclasses import replace

import naive
import numpy as np
import pytest
import tiny
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import (
    EXACT_KINDS,
    KINDS,
    LASSO_KINDS,
    Case,
    cases,
    fed_in_every_way,
    mixed_steps,
    random_events,
    streams,
)
from test_invariants import lasso_bound, now_us

from streamfeat.classify.classifier import Classifier
from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.learn.fit import learn_encoder
from streamfeat.learn.settings import Setting
from streamfeat.learn.volumes import Window, sample_volumes
from streamfeat.recordings.reader import open_recording

EXAMPLES = 15
ids = "-".join


pytestmark = pytest.mark.usefixtures("every_update_is_worth_a_thread")


@st.composite
def short_cases(draw, kind):
    case = draw(cases(kind))
    n_bins = draw(st.integers(2, 6))
    depth = draw(st.integers(1, n_bins - 1))
    times = {"volume_bins": depth, "time_stride": draw(st.integers(1, n_bins - depth))}
    return replace(case, geometry=replace(case.geometry, n_bins=n_bins, **times))


def known_case(kind, **geometry):
    fields = {"patch": 3, "stride": 2, "n_bins": 5, "bin_us": 1000, "max_count": 2, "volume_bins": 2}
    return Case(Geometry(**fields | geometry), (13, 18), 33, *kind, 0.1, 3)


def ages_apart(case, events, end):
    """Features of the volumes of each age, by an encoder whose window is one volume long: no `Past` there."""
    encoder, bin_us = case.encoder, case.geometry.bin_us
    one = replace(encoder, geometry=case.geometry.newest)
    return [
        one.encode(events, case.resolution, origin_us=0, t_us=end - age * bin_us)
        for age in case.geometry.ages
    ]


# 1 split invariance, 2 batch equivalence, 5 policy invariance


@pytest.mark.parametrize("kind", EXACT_KINDS, ids=ids)
@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_features_are_those_of_the_window_however_it_is_fed_and_read(kind, data):
    case = data.draw(short_cases(kind))
    events = data.draw(streams(case))
    origin_us = data.draw(st.integers(-5000, 5000))
    t_us = now_us(events, case)
    end = origin_us if t_us is None else t_us
    offline = case.encoder.encode(events, case.resolution, origin_us=origin_us, t_us=end)
    whole = Case(case.geometry.whole, case.resolution, 1, *kind, 0.1, 0).engine(origin_us)
    whole.feed(events)
    expected = whole.stats()
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    for how, engine in fed_in_every_way(lambda **options: case.engine(origin_us, **options), events, rng):
        np.testing.assert_array_equal(engine.features(), offline, err_msg=how, strict=True)
        np.testing.assert_array_equal(engine.counts(), whole.counts(), err_msg=how)
        for name in ("events", "late", "rejected", "saturated", "rolls"):
            assert getattr(engine.stats(), name) == getattr(expected, name), (how, name)


@pytest.mark.parametrize("look_ahead", [False, True])
@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_features_are_those_of_the_window_after_every_batch(look_ahead, data):
    case = data.draw(short_cases(("direct", "split")))
    events = data.draw(streams(case, 30))
    engine = case.engine(look_ahead=look_ahead)
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    for n, told in mixed_steps(engine, events, rng):
        end = 0 if told is None else told
        offline = case.encoder.encode(events[:n], case.resolution, origin_us=0, t_us=end)
        np.testing.assert_array_equal(engine.features(), offline, err_msg=f"after {n} events")


@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_a_trace_holds_what_an_emission_after_each_event_would_have_given(data):
    case = data.draw(short_cases(("direct", "soft")))
    events = data.draw(streams(case, 30))
    engine, scored, read = case.engine(look_ahead=True), case.engine(look_ahead=True), case.engine()
    classifier = Classifier.untrained(["a", "b", "c"], case.encoder)
    classifier.folded.rows[:] = np.random.default_rng(0).standard_normal(classifier.folded.rows.shape)
    features, _, accepted = engine.trace(events)
    cut = data.draw(st.integers(0, len(events)))
    parts = [scored.trace(part, classifier.folded) for part in (events[:cut], events[cut:])]
    np.testing.assert_array_equal(np.concatenate([part.features for part in parts]), features)
    np.testing.assert_array_equal(
        np.concatenate([part.scores for part in parts]), classifier.scores(features)
    )
    assert scored.trace(events[:1], keep_features=False).features.shape == (0, case.encoder.n_features)
    for i in range(len(events)):
        read.feed(events[i : i + 1])
        np.testing.assert_array_equal(features[i], read.features())
        assert accepted[i] == read.n_events


@pytest.mark.parametrize("kind", EXACT_KINDS, ids=ids)
@pytest.mark.parametrize("time_stride", [1, 2])
def test_features_are_the_sum_of_those_of_each_age(kind, time_stride):
    case = known_case(kind, time_stride=time_stride)
    events = random_events(np.random.default_rng(7), case.geometry, case.resolution, 150, n_windows=1.2)
    end = now_us(events, case)
    parts = ages_apart(case, events, end)
    assert len(parts) == (4 if time_stride == 1 else 2)
    assert all(part.any() for part in parts)
    # Codes are multiples of 2^-16 for any number of ages here, and float64 adds those exactly.
    expected = np.sum(parts, axis=0, dtype=np.float64).astype(np.float32)
    assert np.abs(expected).max() < 2**8
    offline = case.encoder.encode(events, case.resolution, origin_us=0, t_us=end)
    np.testing.assert_array_equal(offline, expected, strict=True)
    counts = naive.window_counts(events, case.geometry, case.resolution, 0, end)
    codes = naive.features_over_time(counts, case.encoder)
    np.testing.assert_allclose(offline, codes, atol=2e-3 * np.abs(codes).max())


@pytest.mark.parametrize("kind", LASSO_KINDS, ids=ids)
@pytest.mark.parametrize("look_ahead", [False, True])
def test_inverse_features_agree_within_the_bound_of_the_gap(kind, look_ahead):
    case = replace(known_case(kind), n_filters=8)
    events = random_events(np.random.default_rng(8), case.geometry, case.resolution, 90, n_windows=2.0)
    engine = case.engine(look_ahead=look_ahead)
    told = None
    for batch in np.array_split(events, 9):
        (engine.feed if len(batch) % 2 else engine.follow)(batch)
        features = engine.features()
        end = now_us(batch, case)
        told = end if told is None else max(told, end)
        seen = events[: engine.stats().events + engine.stats().late + engine.stats().rejected]
        counts = naive.window_counts(seen, case.geometry, case.resolution, 0, told)
        depth = case.geometry.depth
        volumes = [
            naive.local_volumes(counts[len(counts) - depth - age :][:depth], case.geometry.newest)
            for age in case.geometry.ages
        ]
        bound = lasso_bound(case.encoder, np.array(volumes), engine._operator.unit)
        offline = case.encoder.encode(seen, case.resolution, origin_us=0, t_us=told)
        np.testing.assert_allclose(features, offline, rtol=1e-6, atol=bound)
        np.testing.assert_allclose(features, offline, atol=2e-3 * max(1.0, np.abs(offline).max()))
    assert features.any()


def test_a_camera_recording_agrees_with_its_windows(shared_data):
    from test_invariants import assert_real_events_agree, batches_of, open_recording

    path = shared_data / "samples" / "eventpacket_libcaer_cmp_346x260.mcap"
    with open_recording(path) as recording:
        events, resolution = batches_of(recording, 60_000), recording.resolution
    geometry = Geometry(
        patch=8, stride=8, n_bins=4, bin_us=3000, downsample=2, max_count=2, volume_bins=2, time_stride=2
    )
    assert_real_events_agree(("direct", "split"), events, resolution, geometry)


# 3 order


@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_order_inside_the_window_means_nothing(data):
    case = data.draw(short_cases(("direct", "triangle")))
    events = data.draw(streams(case))
    start = data.draw(st.integers(-5, 5)) * case.geometry.bin_us
    events["t"] = start + (events["t"] - start) % case.geometry.window_us
    shuffled = data.draw(st.permutations(range(len(events))))
    engines = [case.engine(), case.engine()]
    for engine, batch in zip(engines, (events, events[shuffled]), strict=True):
        engine.advance(start + case.geometry.window_us - 1)
        engine.feed(batch)
        assert engine.stats().late == 0
    np.testing.assert_array_equal(engines[0].features(), engines[1].features(), strict=True)


@pytest.mark.parametrize("way", ["feed", "follow"])
@pytest.mark.parametrize("kind", EXACT_KINDS[1:3], ids=ids)
def test_events_older_than_a_volume_count_and_those_older_than_the_window_do_not(way, kind):
    case = known_case(kind)
    last = 20 * case.geometry.window_us
    first_of_window = last - 4 * case.geometry.bin_us
    engine = case.engine()
    getattr(engine, way)(make_events([3, 4], [5, 6], [1, 0], [last - 1, last]))
    features = engine.features()
    getattr(engine, way)(make_events([3, 4, 7], [5, 6, 1], [1, 0, 1], [first_of_window - 1, -(10**12), 0]))
    assert (engine.stats().events, engine.stats().late) == (2, 3)
    np.testing.assert_array_equal(engine.features(), features)
    getattr(engine, way)(make_events([8], [5], [1], [first_of_window]))
    assert (engine.stats().events, engine.stats().late) == (3, 3)
    assert not np.array_equal(engine.features(), features)


# 4 nothing lingers


@pytest.mark.parametrize("kind", KINDS, ids=ids)
@pytest.mark.parametrize("look_ahead", [False, True])
def test_after_silence_the_state_is_the_empty_state(kind, look_ahead):
    case = known_case(kind)
    events = random_events(np.random.default_rng(2), case.geometry, case.resolution, 60)
    engine, fresh = (case.engine(look_ahead=look_ahead) for _ in range(2))
    engine.follow(events)
    last = now_us(events, case) // case.geometry.bin_us
    for i in range(1, case.geometry.n_bins):
        engine.advance((last + i) * case.geometry.bin_us)
        engine.prepare(40)
    assert engine.features().any()  # only the oldest volumes hold the last events
    engine.advance((last + case.geometry.n_bins) * case.geometry.bin_us)
    assert not engine.snapshot().counts.any()
    np.testing.assert_array_equal(engine.features(), fresh.features(), strict=True)
    for state in (engine._state, engine._past.window):
        assert not any(array.any() for array in (state.counts, state.applied, state.pooled, state.atoms))
    engine.restart(7)
    again = case.engine(7)
    for one in (engine, again):
        one.feed(events)
    np.testing.assert_array_equal(engine.features(), again.features())


# Cost


def test_what_was_read_in_each_bin_is_not_encoded_again():
    case = known_case(("direct", "split"))
    rng, bin_us = np.random.default_rng(1), case.geometry.bin_us
    engine = case.engine()
    for i in range(20):
        n = 30
        batch = make_events(
            rng.integers(0, 18, n), rng.integers(0, 13, n), rng.integers(0, 2, n), np.full(n, i * bin_us)
        )
        engine.feed(batch)
        engine.features()
    assert engine._past.encoded == 0
    engine.feed(make_events([3], [3], [1], [18 * bin_us]))
    engine.features()
    assert engine._past.encoded > 0


# Snapshots


@pytest.mark.parametrize("kind", KINDS, ids=ids)
@settings(max_examples=5)
@given(data=st.data())
def test_an_engine_that_is_restored_anywhere_goes_on_with_the_same_bits(kind, data):
    case = data.draw(short_cases(kind))
    events = data.draw(streams(case, 40))
    look_ahead = data.draw(st.booleans())
    engine, other = (case.engine(look_ahead=look_ahead) for _ in range(2))
    cut = data.draw(st.integers(0, len(events)))
    for batch in np.array_split(events[:cut], 3):
        engine.feed(batch)
        engine.features()
    other.restore(engine.snapshot())
    assert other.stats() == replace(
        engine.stats(),
        active_volumes=other.stats().active_volumes,
        encoded_volumes=other.stats().encoded_volumes,
    )
    for batch in (events[:0], *np.array_split(events[cut:], 3)):
        for one in (engine, other):
            one.feed(batch)
        np.testing.assert_array_equal(engine.features(), other.features())
        np.testing.assert_array_equal(engine.counts(), other.counts())


def test_a_snapshot_of_volumes_of_another_length_is_refused():
    short, whole = known_case(("direct", "soft")), known_case(("direct", "soft"), volume_bins=None)
    assert short.encoder.fingerprint != whole.encoder.fingerprint
    with pytest.raises(InputError, match="snapshot"):
        short.engine().restore(whole.engine().snapshot())
    snapshot = short.engine().snapshot()
    assert snapshot.counts.shape[0] == 5
    with pytest.raises(InputError, match="counts"):
        short.engine().restore(replace(snapshot, counts=snapshot.counts[:2].copy()))


def test_one_encoder_may_have_scales_of_long_and_short_volumes():
    short, whole = known_case(("direct", "soft")), known_case(("direct", "split"), volume_bins=None)
    both = Encoder.side_by_side([whole.encoder, short.encoder])
    events = random_events(np.random.default_rng(3), short.geometry, short.resolution, 80)
    engine = Engine(both, short.resolution)
    features, _, accepted = engine.trace(events)
    parts = [case.engine() for case in (whole, short)]
    for part in parts:
        part.feed(events)
    np.testing.assert_array_equal(features[-1], np.concatenate([part.features() for part in parts]))
    assert accepted[-1] == parts[1].n_events


# The model and its file


def test_the_file_of_volumes_as_long_as_the_window_is_as_it_was(tmp_path):
    whole = Geometry(patch=3, n_bins=4)
    assert "volume_bins" not in whole.as_dict()
    assert "volume" not in repr(whole)
    assert whole == Geometry(patch=3, n_bins=4, volume_bins=4, time_stride=1)
    encoder = random_encoder(0, whole, 5)
    encoder.save(tmp_path / "whole.safetensors")
    header = (tmp_path / "whole.safetensors").read_bytes()
    assert b'\\"version\\": 1' in header or b'\\"version\\":1' in header
    short = random_encoder(0, replace(whole, volume_bins=2, time_stride=2), 5, narrow=True)
    short.save(tmp_path / "short.safetensors")
    header = (tmp_path / "short.safetensors").read_bytes()
    assert b'\\"version\\": 3' in header or b'\\"version\\":3' in header
    again = Encoder.load(tmp_path / "short.safetensors")
    assert again.geometry == short.geometry
    assert again.fingerprint == short.fingerprint
    assert again.is_narrow
    assert short.filters.shape == (5, 2 * 9)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"volume_bins": 4}, "volume_bins is 4, it must be an integer from 1 to the 3 bins of the window"),
        ({"volume_bins": 0}, "volume_bins is 0"),
        ({"volume_bins": True}, "volume_bins is True"),
        ({"volume_bins": "2"}, "volume_bins is '2'"),
        ({"volume_bins": 2, "time_stride": 0}, "time_stride is 0"),
        ({"volume_bins": 2, "time_stride": 2}, "from 1 to 1: volumes have 2 of the 3 bins"),
        ({"time_stride": 2}, "time_stride is 2"),
        ({"time_stride": None}, "time_stride is None"),
    ],
)
def test_times_that_do_not_fit_into_the_window_are_refused_in_one_line(values, words):
    with pytest.raises(InputError) as refused:
        Geometry(n_bins=3, **values)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


# Learning and commands

LEARN = {"filters": 6, "patch": 6, "stride": 6, "bins": 3, "volumes": 300, "iterations": 2, "max_count": 2}
SHORT = {"volume_bins": 2, "time_stride": 1}
OPTIONS = [f"--{name.replace('_', '-')}={value}" for name, value in (LEARN | SHORT).items()]


def test_volumes_are_drawn_from_all_of_the_window():
    """Each bin of the window has its own count, so that a volume says when it begins."""
    geometry = Geometry(patch=2, n_bins=4, bin_us=10, max_count=9, volume_bins=2)
    t = np.repeat(np.arange(4) * 10, (1, 2, 3, 4))
    events = np.concatenate(
        [make_events(np.full(10, x), np.full(10, y), np.ones(10, int), t) for x in range(5) for y in range(5)]
    )
    volumes = sample_volumes([Window(events, (5, 5), 0, 39)], geometry, 400, (3,)).counts
    assert volumes.shape == (400, 8)
    begins = volumes[:, 0]
    np.testing.assert_array_equal(volumes, np.repeat(np.stack([begins, begins + 1], axis=1), 4, axis=1))
    assert np.unique(begins).tolist() == [1, 2, 3]


def test_commands_learn_and_use_short_volumes(run, tmp_path):
    path = tiny.write_digits(tmp_path / "digits.mcap", 60, n_held_out=20)
    run("learn", path, *OPTIONS, "-o", tmp_path / "model")
    encoder = Encoder.load(tmp_path / "model")
    assert encoder.geometry.volume_bins == 2
    assert encoder.filters.shape == (6, 2 * 36)
    with open_recording(path) as recording:
        assert learn_encoder([recording], Setting(**LEARN | SHORT)).fingerprint == encoder.fingerprint
    files = ["-m", tmp_path / "model", "-c", tmp_path / "classifier"]
    trained = run("train", path, *files[:2], "-o", files[3], "--json").json
    said = run("replay", path, *files, "--emit", "event", "--split", "test", "--json").json
    assert said["correct"] / 20 == pytest.approx(trained["held_out_accuracy"])
    row = run("evaluate", path, "--method", "direct", *OPTIONS, "--early-samples", 0, "--json").json["rows"][
        0
    ]
    assert row["features"] == encoder.n_features
    assert row["accuracy"] == pytest.approx(trained["held_out_accuracy"])


def test_scales_of_fewer_bins_than_a_volume_are_as_long_as_their_window():
    setting = Setting(bins=5, volume_bins=3, time_stride=2, scales="8+6:3+4:4", volumes=2000)
    assert [(one.bins, one.volume_bins, one.time_stride) for one in setting.each] == [
        (5, 3, 2), (5, 3, 2), (3, None, 1), (4, 3, 1),
    ]  # fmt: skip


@pytest.mark.parametrize("command", ["learn", "evaluate"])
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--volume-bins", "4"], "volume_bins is 4, it must be an integer from 1 to the 3 bins"),
        (["--volume-bins", "0"], "volume_bins is 0"),
        (["--volume-bins", "2", "--time-stride", "2"], "time_stride is 2"),
        (["--time-stride", "0"], "time_stride is 0"),
    ],
)
def test_commands_refuse_times_that_do_not_fit_in_one_line(run, tmp_path, command, options, words):
    output = ["-o", tmp_path / "new"]
    said = run(command, tmp_path / "none.mcap", *options, *output)
    assert said.status == 2
    assert words in " ".join(said.err.split())
    assert not (tmp_path / "new").exists()
