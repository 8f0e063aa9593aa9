"""What streaming may never change: five invariants and the mathematics, on random and on real events."""

import copy
import runpy
from dataclasses import replace

import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_table import assert_certified, assert_pooled, copied
from streams import (
    EXACT_KINDS,
    GAP,
    KINDS,
    LASSO_KINDS,
    Case,
    cases,
    fed_in_every_way,
    mixed_steps,
    random_encoder,
    random_events,
    streams,
)

from streamfeat.camera_files.event_files import open_events
from streamfeat.classify.classifier import Classifier
from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.events import make_events
from streamfeat.kernels.layout import CLOCK_PLANE, CLOCK_TOUCHED
from streamfeat.recordings.reader import open_recording

EXAMPLES = 25
ids = "-".join


pytestmark = pytest.mark.usefixtures("every_update_is_worth_a_thread")


MEANINGFUL = ("counts", "applied", "is_touched", "is_dirty")
PLANES = ("projections", "moments", "atoms", "pooled", "cursors")
"""Fields of a state that outlive a call, of the ring and of its planes; stacks and scratch are the rest."""


def assert_same_state(mine, yours):
    """Both engines' rings, and their planes from the current one on, once the next bin is prepared."""
    for engine in (mine, yours):
        engine.features()
        while not engine.prepare(100):
            pass
    for name in MEANINGFUL + PLANES:
        fields = [getattr(engine._state, name) for engine in (mine, yours)]
        if name in PLANES:
            planes = [engine._state.clock[CLOCK_PLANE] for engine in (mine, yours)]
            fields = [np.roll(field, -plane, axis=0) for field, plane in zip(fields, planes, strict=True)]
        np.testing.assert_array_equal(*fields, err_msg=name)


def now_us(events, case):
    """Time of the latest event that an engine accepts, or None."""
    height, width = case.resolution
    good = (events["x"] < width) & (events["y"] < height) & np.isin(events["p"], (0, 1))
    return int(events["t"][good].max()) if good.any() else None


def lasso_bound(encoder, volumes, unit):
    """How far features of two solutions within the relative gap g may be apart, in any one entry.

    The objective `1/2 |x - D l|^2 + lambda |l|_1` is 1-strongly convex in `D l`, so a code within the gap has
    `1/2 |D (l - l*)|^2 <= g 1/2 |x|^2`: two such codes differ by `|D (l - l')| <= 2 sqrt(g) |x|`, and with
    the smallest eigenvalue m of `D'D` by `|l - l'| <= 2 sqrt(g / m) |x|`. Features add this up over volumes,
    with two units of fixed point for each. Only for independent atoms; others have no unique code.
    """
    smallest = np.linalg.eigvalsh(encoder.operator.gram.astype(np.float64)).min()
    whitening, mean = encoder.whitening.astype(np.float64), encoder.mean.astype(np.float64)
    bound = 0.0
    for v in volumes.reshape(-1, volumes.shape[-1]):
        if v.any():
            x = whitening @ ((v - v.mean()) / np.sqrt(v.var() + encoder.operator.eps) - mean)
            bound += 2 * np.sqrt(encoder.operator.gap / smallest) * np.linalg.norm(x) + 2 / unit
    return 1.01 * bound


def assert_agree(case, engine, features, counts, how):
    """Bit for bit, or as far as the duality gap of the lasso determines the codes."""
    if not case.encoder.operator.inverse:
        np.testing.assert_array_equal(engine.features(), features, err_msg=how, strict=True)
        return
    mine = engine.features()
    operator, unit = engine._operator, engine._operator.unit
    assert_certified(operator, engine._state)
    assert_pooled(operator, engine._state)
    codes = np.trunc(engine.snapshot().atoms.astype(np.float64) * unit) / unit
    np.testing.assert_array_equal(engine.codes().reshape(codes.shape), codes.astype(np.float32))
    expected = naive.features_from(
        codes.reshape(*engine.grid_shape, -1), case.encoding, case.geometry.pooling
    )
    np.testing.assert_array_equal(mine, expected.astype(np.float32), err_msg=how)
    gram = case.encoder.operator.gram.astype(np.float64)
    if np.linalg.eigvalsh(gram).min() > 1e-3:
        bound = lasso_bound(case.encoder, naive.local_volumes(counts, case.geometry), unit)
        np.testing.assert_allclose(mine, features, rtol=1e-6, atol=bound, err_msg=how)


def assert_every_way_agrees(case, events, origin_us, seed):
    t_us = now_us(events, case)
    # Bins count from the origin, so the window is known only with it.
    end = origin_us if t_us is None else t_us
    offline = case.encoder.encode(events, case.resolution, origin_us=origin_us, t_us=end)
    counts = naive.window_counts(events, case.geometry, case.resolution, origin_us, end)
    tallies = set()
    make_engine = lambda **options: case.engine(origin_us, **options)  # noqa: E731
    for how, engine in fed_in_every_way(make_engine, events, np.random.default_rng(seed)):
        assert_agree(case, engine, offline, counts, how)
        stats = engine.stats()
        tallies.add((stats.events, stats.late, stats.rejected, stats.saturated, stats.rolls))
        assert stats.events + stats.late + stats.rejected == len(events)
    assert len(tallies) == 1


def known_case(kind, n_filters=33, threshold=0.1, **geometry):
    fields = {"patch": 3, "stride": 2, "n_bins": 3, "bin_us": 1000, "max_count": 2} | geometry
    return Case(Geometry(**fields), (13, 18), n_filters, *kind, threshold, 3)


# 1 split invariance, 2 batch equivalence, 5 policy invariance


@pytest.mark.parametrize("kind", KINDS, ids=ids)
@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_features_are_those_of_the_window_however_it_is_fed_and_read(kind, data):
    case = data.draw(cases(kind))
    events = data.draw(streams(case))
    assert_every_way_agrees(case, events, data.draw(st.integers(-5000, 5000)), data.draw(st.integers(0, 99)))


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_features_are_those_of_the_window_on_streams_that_cross_many_bins(kind):
    for seed in range(4):
        case = known_case(kind)
        events = random_events(np.random.default_rng(seed), case.geometry, case.resolution, 120)
        assert_every_way_agrees(case, events, 0, seed)


@pytest.mark.parametrize("threads_", [1, 2])
@pytest.mark.parametrize("encoding", ["soft", "split"])
def test_features_are_those_of_the_window_where_volumes_are_full(encoding, threads_):
    """Their projections are a product (`kernels.dense`), those of others are sums of columns."""
    case = replace(known_case(("direct", encoding), n_filters=40, stride=1), threads=threads_)
    events = random_events(np.random.default_rng(5), case.geometry, case.resolution, 700, n_windows=1.3)
    engine = case.engine()
    engine.feed(events)
    engine.features()
    waited = sum(len(set(volumes.tolist())) > 1 for volumes in engine._state.awaiting)
    assert waited == threads_
    assert_every_way_agrees(case, events, 0, 5)


@pytest.mark.parametrize("kind", LASSO_KINDS, ids=ids)
def test_features_of_independent_atoms_agree_within_the_bound_of_the_gap(kind):
    for seed in range(4):
        case = known_case(kind, n_filters=8)
        assert np.linalg.eigvalsh(case.encoder.operator.gram).min() > 1e-3
        events = random_events(np.random.default_rng(seed), case.geometry, case.resolution, 80)
        assert_every_way_agrees(case, events, 0, seed)


def twin_of(engine):
    twin = copy.copy(engine)
    twin._state = copied(engine._state)
    return twin


@pytest.mark.parametrize("look_ahead", [False, True])
@pytest.mark.parametrize("kind", KINDS, ids=ids)
@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_features_are_those_of_the_window_after_every_batch(kind, look_ahead, data):
    case = data.draw(cases(kind))
    events = data.draw(streams(case, 30))
    origin_us = data.draw(st.integers(-5000, 5000))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    engine = case.engine(origin_us, look_ahead=look_ahead)
    for n, told in mixed_steps(engine, events, rng):
        end = origin_us if told is None else told
        offline = case.encoder.encode(events[:n], case.resolution, origin_us=origin_us, t_us=end)
        counts = naive.window_counts(events[:n], case.geometry, case.resolution, origin_us, end)
        # A copy is read: reading the engine itself would spare it all that piles up between readings.
        assert_agree(case, twin_of(engine), offline, counts, f"after {n} events")


@pytest.mark.parametrize("kind", EXACT_KINDS, ids=ids)
@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_a_trace_holds_what_an_emission_after_each_event_would_have_given(kind, data):
    case = data.draw(cases(kind))
    events = data.draw(streams(case, 40))
    engine, scored, read = case.engine(look_ahead=True), case.engine(look_ahead=True), case.engine()
    classifier = Classifier.untrained(["a", "b", "c"], case.encoder)
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    classifier.folded.rows[:] = rng.standard_normal(classifier.folded.rows.shape)
    features, _, accepted = engine.trace(events)
    cut = data.draw(st.integers(0, len(events)))
    parts = [
        scored.trace(part, classifier.folded, keep_features=keep)
        for part, keep in ((events[:cut], False), (events[cut:], True))
    ]
    np.testing.assert_array_equal(parts[1].features, features[cut:])
    scores = np.concatenate([part.scores for part in parts])
    assert features.shape == (len(events), case.encoder.n_features)
    for i in range(len(events)):
        read.feed(events[i : i + 1])
        np.testing.assert_array_equal(features[i], read.features())
        np.testing.assert_array_equal(scores[i], classifier.scores(features[i]))
        assert accepted[i] == read.n_events


@pytest.mark.parametrize("look_ahead", [False, True])
@pytest.mark.parametrize("kind", KINDS, ids=ids)
@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_following_leaves_nothing_to_do_for_an_emission(kind, look_ahead, data):
    case = data.draw(cases(kind))
    events = data.draw(streams(case, 20))
    engine = case.engine(look_ahead=look_ahead)
    for i in range(len(events)):
        engine.follow(events[i : i + 1])
        followed = np.zeros(case.encoder.n_features, np.float32)
        naive.read_features(engine._operator, engine._state, followed)
        encoded = engine.stats().encoded_volumes
        end = now_us(events[: i + 1], case) or 0
        offline = case.encoder.encode(events[: i + 1], case.resolution, origin_us=0, t_us=end)
        counts = naive.window_counts(events[: i + 1], case.geometry, case.resolution, 0, end)
        np.testing.assert_array_equal(engine.features(), followed, strict=True)
        assert engine.stats().encoded_volumes == encoded
        # Last, for it takes a snapshot: with the inverse formulation volumes are encoded for that.
        assert_agree(case, engine, offline, counts, f"after {i + 1} events")


def batches_of(recording, n_events):
    kept, total = [], 0
    for batch in recording:
        kept.append(batch)
        total += len(batch)
        if total >= n_events:
            break
    return np.concatenate(kept)


def assert_real_events_agree(kind, events, resolution, geometry, n_batches=20):
    encoder = random_encoder(np.random.default_rng(1), geometry, 16, *kind)
    origin = int(events["t"][0])
    whole, split = (
        Engine(encoder, resolution, origin_us=origin, look_ahead=ahead) for ahead in (False, True)
    )
    whole.feed(events)
    for i, batch in enumerate(np.array_split(events, n_batches)):
        (split.follow if i % 3 == 0 and len(batch) < 3000 else split.feed)(batch)
        split.prepare(2000)
        seen = events[: sum(map(len, np.array_split(events, n_batches)[: i + 1]))]
        features = split.features()
        if encoder.operator.inverse:
            assert_certified(split._operator, split._state)
        elif i % 5 == 0:
            np.testing.assert_array_equal(features, encoder.encode(seen, resolution, origin_us=origin))
    if encoder.operator.inverse:
        whole.features()
        assert_certified(whole._operator, whole._state)
    else:
        np.testing.assert_array_equal(split.features(), whole.features())
    assert whole.features().any()
    assert whole.stats().events == len(events)


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_a_camera_recording_agrees_with_its_windows(kind, shared_data):
    path = shared_data / "samples" / "eventpacket_libcaer_cmp_346x260.mcap"
    with open_recording(path) as recording:
        events, resolution = batches_of(recording, 60_000), recording.resolution
    geometry = Geometry(patch=8, stride=8, n_bins=3, bin_us=3000, downsample=2, max_count=2)
    assert_real_events_agree(kind, events, resolution, geometry)


@pytest.fixture(scope="module")
def digits(shared_data, tmp_path_factory):
    """Some N-MNIST samples: `[(events), ...]`, 34 x 34 pixels."""
    folder = tmp_path_factory.mktemp("nmnist")
    runpy.run_path(str(shared_data / "unpack.py"))["unpack_nmnist"](folder)
    paths = sorted(folder.rglob("*.bin"))[::200]
    return [np.concatenate(list(open_events(path))) for path in paths]


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_digits_agree_with_their_windows(kind, digits):
    geometry = Geometry(patch=8, stride=2, n_bins=3, bin_us=30_000)
    for events in digits:
        assert_real_events_agree(kind, events, (34, 34), geometry, n_batches=7)


# 3 order


@pytest.mark.parametrize("kind", EXACT_KINDS, ids=ids)
@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_order_inside_the_window_means_nothing(kind, data):
    case = data.draw(cases(kind))
    events = data.draw(streams(case))
    start = data.draw(st.integers(-5, 5)) * case.geometry.bin_us
    events["t"] = start + (events["t"] - start) % case.geometry.window_us
    shuffled = data.draw(st.permutations(range(len(events))))
    # Time is at the end of the window from the start: no order of these events makes one late.
    engines = [case.engine(), case.engine()]
    for engine, batch in zip(engines, (events, events[shuffled]), strict=True):
        engine.advance(start + case.geometry.window_us - 1)
        engine.feed(batch)
        assert engine.stats().late == 0
    np.testing.assert_array_equal(engines[0].features(), engines[1].features(), strict=True)
    np.testing.assert_array_equal(engines[0].codes(), engines[1].codes(), strict=True)


@pytest.mark.parametrize("kind", KINDS, ids=ids)
@pytest.mark.parametrize("n_bins", [1, 3])
def test_late_events_are_counted_and_change_nothing(kind, n_bins):
    case = known_case(kind, n_bins=n_bins)
    events = random_events(np.random.default_rng(4), case.geometry, case.resolution, 80)
    engine = case.engine()
    engine.feed(events)
    last = 20 * case.geometry.window_us
    engine.feed(make_events([3, 4], [5, 6], [1, 0], [last, last]))
    before, state = engine.stats(), engine.snapshot()
    features = engine.features()
    first_of_window = last - (n_bins - 1) * case.geometry.bin_us
    late = make_events([3, 4, 7], [5, 6, 1], [1, 0, 1], [first_of_window - 1, -(10**12), 0])
    engine.feed(late)
    assert engine.stats().late == before.late + 3
    assert engine.stats().events == before.events
    np.testing.assert_array_equal(engine.features(), features)
    np.testing.assert_array_equal(engine.snapshot().counts, state.counts)
    engine.feed(make_events([8], [5], [1], [first_of_window]))
    assert engine.stats().late == before.late + 3
    assert not np.array_equal(engine.features(), features)


# 4 nothing lingers


@pytest.mark.parametrize("kind", KINDS, ids=ids)
@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_after_silence_the_state_is_the_empty_state(kind, data):
    case = data.draw(cases(kind))
    look_ahead = data.draw(st.booleans())
    engine, fresh = (case.engine(look_ahead=look_ahead) for _ in range(2))
    events = data.draw(streams(case))
    for _ in mixed_steps(engine, events, np.random.default_rng(data.draw(st.integers(0, 99)))):
        pass
    if data.draw(st.booleans()):
        engine.features()
        engine.feed(events)
    end = now_us(events, case)
    last = 0 if end is None else end // case.geometry.bin_us
    if data.draw(st.booleans()):  # bins pass one by one, partly prepared
        for i in range(1, case.geometry.n_bins):
            engine.prepare(data.draw(st.sampled_from([1, 100, 10**6])))
            engine.advance((last + i) * case.geometry.bin_us)
    engine.advance((last + case.geometry.n_bins) * case.geometry.bin_us)
    assert not engine.snapshot().counts.any()
    np.testing.assert_array_equal(engine.features(), fresh.features(), strict=True)
    assert_same_state(engine, fresh)
    assert not any(getattr(engine._state, name).any() for name in MEANINGFUL + PLANES[:-1])
    assert engine._state.clock[CLOCK_TOUCHED] == 0
    assert engine.stats().active_volumes == 0


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_one_bin_before_the_silence_is_over_the_last_event_still_counts(kind):
    case = known_case(kind)
    engine = case.engine()
    engine.feed(make_events([8], [5], [1], [0]))
    engine.advance(case.geometry.window_us - 1)
    assert engine.features().any()
    engine.advance(case.geometry.window_us)
    assert not engine.features().any()


@pytest.mark.parametrize("look_ahead", [False, True])
@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_a_long_run_has_no_drift(kind, look_ahead):
    case = known_case(kind, n_filters=12, threshold=0.3)
    rng = np.random.default_rng(9)
    n_windows, window = 300, case.geometry.window_us
    events = random_events(rng, case.geometry, case.resolution, 20 * n_windows, n_windows)
    engine = case.engine(look_ahead=look_ahead)
    for i, batch in enumerate(np.array_split(events, 300)):
        (engine.feed if i % 2 else engine.follow)(batch)
        engine.features()
    assert engine.stats().rolls >= (n_windows - 2) * case.geometry.n_bins
    end = now_us(events, case)
    fresh = case.engine(look_ahead=look_ahead)
    fresh.feed(events[events["t"] > end - window])
    counts = naive.window_counts(events, case.geometry, case.resolution, 0, end)
    assert_agree(case, engine, fresh.features(), counts, "long run")
    assert engine.features().any()
    if not case.encoder.operator.inverse:
        assert_same_state(engine, fresh)


# The mathematics, in float64 and without any quantisation


def window_codes(case, events):
    """Codes of an engine, codes in float64, and the local volumes they are of."""
    end = now_us(events, case)
    engine = case.engine()
    engine.feed(events)
    counts = naive.window_counts(events, case.geometry, case.resolution, 0, 0 if end is None else end)
    return engine, naive.codes_of(counts, case.encoder), naive.local_volumes(counts, case.geometry)


@pytest.mark.parametrize("kind", [k for k in EXACT_KINDS if k[1] != "triangle"], ids=ids)
@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_closed_form_codes_are_as_near_as_quantisation_allows(kind, data):
    """An operator entry is off by half a step at most, so `z` by half a step times `|v|_1 / sigma`."""
    case = data.draw(cases(kind))
    engine, exact, volumes = window_codes(case, data.draw(streams(case)))
    operator = engine._operator
    sigma = np.sqrt(volumes.var(axis=2) + operator.eps)
    step = operator.scale / 2 * np.abs(volumes).sum(axis=2) / sigma
    largest = np.abs(exact).max() + case.threshold + np.abs(operator.offset).max() / operator.unit
    # Three float32 operations, and a fixed point that is cut off.
    bound = 1.001 * step + 4 * 2.0**-24 * largest + 1 / operator.unit
    assert (np.abs(engine.codes() - exact).max(axis=2) <= bound).all()


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_codes_of_real_events_are_right_to_a_ten_thousandth(kind, digits):
    geometry = Geometry(patch=8, stride=4, n_bins=3, bin_us=30_000, max_count=2)
    encoder = random_encoder(np.random.default_rng(2), geometry, 24, *kind, threshold=0.3, gap=1e-10)
    for events in digits:
        end = int(events["t"].max())
        engine = Engine(encoder, (34, 34))
        engine.feed(events)
        codes = naive.codes_of(naive.window_counts(events, geometry, (34, 34), 0, end), encoder)
        largest = np.abs(codes).max()
        assert largest > 0.1
        assert np.abs(engine.codes() - codes).max() <= 1e-4 * largest + 1 / engine._operator.unit
        features = naive.features_from(codes, encoder.encoding, encoder.geometry.pooling)
        offline = encoder.encode(events, (34, 34), origin_us=0)
        np.testing.assert_allclose(offline, features, atol=1e-4 * largest * len(codes) ** 2)
        assert offline.dtype == np.float32


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_without_events_features_are_zero(kind):
    case = known_case(kind)
    nothing = make_events([], [], [], [])
    size = 4 * case.n_filters * (2 if case.encoding == "split" else 1)
    for features in (case.encoder.encode(nothing, case.resolution), case.engine().features()):
        np.testing.assert_array_equal(features, np.zeros(size, np.float32), strict=True)
    assert case.encoder.n_features == size
    assert case.encoder.operator.gap == GAP
