"""The engine's contract: what it takes, what it refuses, what it hands out, and that it allocates nothing."""

import os
import sys
import tracemalloc

import numpy as np
import pytest
from kernel_table import assert_certified
from streams import EXACT_KINDS, KINDS, LASSO_KINDS, Case, random_events

from streamfeat.engine import threads
from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine, EngineStats
from streamfeat.engine.geometry import Geometry
from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE, make_events
from streamfeat.kernels.follow import follow
from streamfeat.kernels.ingest import count_events
from streamfeat.kernels.layout import CLOCK_PLANE, CURSOR_CODED, CURSOR_ENTRY, CURSOR_PROJECTED
from streamfeat.kernels.update import update

ids = "-".join

GEOMETRY = Geometry(patch=4, stride=3, n_bins=3, bin_us=1000, downsample=2, max_count=2)


def known_case(kind=("direct", "soft"), geometry=GEOMETRY, resolution=(31, 42)):
    return Case(geometry, resolution, 33, *kind, 0.1, 3)


def some_events(case, n=300, seed=0):
    return random_events(np.random.default_rng(seed), case.geometry, case.resolution, n)


def one_line(error):
    return "\n" not in str(error.value) and len(str(error.value)) > 10


# What is fed


@pytest.mark.parametrize(
    "batch",
    [
        None,
        [(1, 1, 1, 1)],
        np.zeros(3),
        np.zeros(3, [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<f8")]),
        np.zeros((2, 3), EVENT_DTYPE),
        np.zeros((), EVENT_DTYPE),
    ],
    ids=["none", "list", "floats", "float time", "two-dimensional", "scalar"],
)
def test_what_is_no_batch_is_refused_and_changes_nothing(batch):
    engine = known_case().engine()
    engine.feed(some_events(known_case()))
    features, stats = engine.features(), engine.stats()
    for take in (engine.feed, engine.follow):
        with pytest.raises(InputError) as error:
            take(batch)
        assert one_line(error)
        np.testing.assert_array_equal(engine.features(), features)
        assert engine.stats() == stats


def read_only(events):
    events = events.copy()
    events.flags.writeable = False
    return events


def strided(events):
    return np.repeat(events, 2)[::2]


def backwards(events):
    return events[::-1].copy()[::-1]


def unaligned(events):
    room = bytearray(events.nbytes + 1)
    room[1:] = events.tobytes()
    return np.frombuffer(room, EVENT_DTYPE, offset=1)


@pytest.mark.parametrize(("way", "kernel"), [("feed", count_events), ("follow", follow)])
@pytest.mark.parametrize("form", [read_only, strided, backwards, unaligned])
def test_batches_of_any_memory_layout_mean_the_same(form, way, kernel):
    case = known_case()
    events = some_events(case)
    expected, engine = case.engine(), case.engine()
    getattr(expected, way)(events)
    compiled = len(kernel.signatures)
    batch = form(events)
    getattr(engine, way)(batch)
    assert batch.tolist() == events.tolist()
    assert len(kernel.signatures) == compiled  # or the first such batch would take seconds
    np.testing.assert_array_equal(engine.features(), expected.features(), strict=True)


def test_hostile_values_are_rejected_and_change_nothing():
    case = known_case()
    engine = case.engine()
    engine.feed(make_events([5], [5], [1], [0]))
    features = engine.features()
    height, width = case.resolution
    hostile = [
        (width, 0, 1, 0),
        (0, height, 1, 0),
        (65535, 65535, 1, 0),
        (0, 0, -1, 0),
        (0, 0, 2, 0),
        (0, 0, -32768, 0),
        (0, 0, 1, 2**63 - 1),
        (0, 0, 1, -(2**63)),
        (0, 0, 1, 2**62),
        (0, 0, 1, -(2**62)),
    ]
    engine.feed(np.array(hostile, EVENT_DTYPE))
    assert engine.stats() == EngineStats(1, 0, len(hostile), 0, 0, 1, 1)
    np.testing.assert_array_equal(engine.features(), features)


def test_a_jump_to_the_end_of_time_empties_the_window_and_stays_there():
    case = known_case()
    engine = case.engine()
    engine.feed(some_events(case))
    engine.feed(make_events([5], [5], [1], [2**62 - 1]))
    expected = case.encoder.encode(make_events([5], [5], [1], [2**62 - 1]), case.resolution, origin_us=0)
    np.testing.assert_array_equal(engine.features(), expected)
    with pytest.raises(InputError) as error:
        engine.advance(2**62)
    assert one_line(error)


@pytest.mark.parametrize("origin_us", [2**62, -(2**62), 2**63, -(2**70)])
def test_an_origin_beyond_time_is_refused_and_changes_nothing(origin_us):
    case = known_case()
    with pytest.raises(InputError, match=r"beyond 2\^62") as error:
        case.engine(origin_us=origin_us)
    assert one_line(error)
    engine = case.engine()
    engine.feed(some_events(case))
    features = engine.features()
    assert features.any()
    with pytest.raises(InputError, match=r"beyond 2\^62"):
        engine.restart(origin_us)
    np.testing.assert_array_equal(engine.features(), features)


@pytest.mark.parametrize("origin_us", [2**62 - 1, -(2**62) + 1])
def test_an_origin_at_the_end_of_time_is_an_origin(origin_us):
    case = known_case()
    engine, event = case.engine(origin_us=origin_us), make_events([5], [5], [1], [origin_us])
    engine.follow(event)
    offline = case.encoder.encode(event, case.resolution, origin_us=origin_us)
    np.testing.assert_array_equal(engine.features(), offline)
    assert offline.any()


@pytest.mark.parametrize("kind", [*EXACT_KINDS, *LASSO_KINDS], ids="-".join)
@pytest.mark.parametrize("resolution", [(8, 6), (31, 6), (1, 1)])
def test_what_a_small_sensor_lacks_of_a_volume_is_pixels_that_never_fire(kind, resolution):
    small = known_case(kind, resolution=resolution)
    side = GEOMETRY.patch * GEOMETRY.downsample
    padded = known_case(kind, resolution=tuple(max(length, side) for length in resolution))
    assert not GEOMETRY.has_room(resolution)
    assert GEOMETRY.has_room(padded.resolution)
    events = some_events(small, 400)
    whole, bit_by_bit, larger = small.engine(), small.engine(), padded.engine()
    whole.feed(events)
    larger.feed(events[(events["x"] < resolution[1]) & (events["y"] < resolution[0])])
    for event in events:
        bit_by_bit.follow(event.reshape(1))
    assert whole.features().any()
    np.testing.assert_array_equal(whole.features(), larger.features())
    if kind in EXACT_KINDS:
        np.testing.assert_array_equal(whole.features(), bit_by_bit.features())
        again = small.engine()
        again.restore(whole.snapshot())
        np.testing.assert_array_equal(again.features(), whole.features())


# Stream time


def test_going_back_in_time_does_nothing():
    case = known_case()
    engine = case.engine()
    engine.feed(some_events(case))
    features, stats = engine.features(), engine.stats()
    for t_us in (0, -(10**9), -(2**62) + 1):
        engine.advance(t_us)
    np.testing.assert_array_equal(engine.features(), features)
    assert engine.stats() == stats


def test_time_passes_by_bins_from_the_origin():
    case = known_case()
    engine = case.engine(origin_us=300)
    engine.feed(make_events([5], [5], [1], [299]))  # the last moment of bin -1
    engine.advance(299 + 2000)
    assert engine.features().any()
    engine.advance(300 + 2000)
    assert not engine.features().any()
    assert engine.stats().rolls == 3


def test_offline_windows_end_where_they_are_told():
    case = known_case()
    events = some_events(case)
    engine = case.engine()
    engine.feed(events[events["t"] < 500])
    engine.advance(1700)
    engine.feed(events[(events["t"] >= 500) & (events["t"] < 2000)])
    offline = case.encoder.encode(events[events["t"] < 2000], case.resolution, origin_us=0, t_us=1999)
    np.testing.assert_array_equal(engine.features(), offline)
    # Events after the window are no part of it.
    later = case.encoder.encode(events, case.resolution, origin_us=0, t_us=1999)
    np.testing.assert_array_equal(later, offline)


def test_offline_bins_start_at_the_first_event_if_not_told():
    case = known_case()
    events = some_events(case)
    good = (events["x"] < 42) & (events["y"] < 31) & (events["p"] < 2)
    first = int(events["t"][good].min())
    np.testing.assert_array_equal(
        case.encoder.encode(events, case.resolution),
        case.encoder.encode(events, case.resolution, origin_us=first, t_us=int(events["t"][good].max())),
    )


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_restart_forgets_events_and_keeps_what_was_counted(kind):
    case = known_case(kind)
    engine, fresh = case.engine(), case.engine(origin_us=777)
    events = some_events(case)
    engine.feed(events)
    engine.features()
    engine.feed(events)  # not read: entries are waiting
    counted = engine.stats()
    engine.restart(777)
    assert not engine.features().any()
    assert not engine.codes().any()
    assert engine.stats().events == counted.events
    for e in (engine, fresh):
        e.feed(events)
    np.testing.assert_array_equal(engine.features(), fresh.features(), strict=True)
    np.testing.assert_array_equal(engine.snapshot().counts, fresh.snapshot().counts, strict=True)


# Snapshots


@pytest.mark.parametrize("kind", EXACT_KINDS, ids=ids)
@pytest.mark.parametrize("is_read", [False, True])
def test_a_restored_engine_goes_on_with_the_same_bits(kind, is_read):
    case = known_case(kind)
    engine, other = case.engine(origin_us=5), case.engine()
    first, second = np.split(some_events(case), [-20])  # what is in the window comes from both
    engine.feed(first)
    if is_read:
        features = engine.features()
    other.feed(second)  # something to be forgotten
    other.features()
    snapshot = engine.snapshot()
    engine.feed(second)  # a snapshot is a copy
    other.restore(snapshot)
    if is_read:
        read = case.engine()
        read.restore(snapshot)
        np.testing.assert_array_equal(read.features(), features, strict=True)
    other.feed(second)
    np.testing.assert_array_equal(other.features(), engine.features(), strict=True)
    np.testing.assert_array_equal(other.codes(), engine.codes(), strict=True)
    mine, theirs = other.stats(), engine.stats()
    counted = ("events", "late", "rejected", "saturated", "rolls", "active_volumes")
    assert [getattr(mine, name) for name in counted] == [getattr(theirs, name) for name in counted]


@pytest.mark.parametrize("kind", LASSO_KINDS, ids=ids)
def test_a_restored_engine_goes_on_within_the_gap(kind):
    case = known_case(kind)
    engine, other = case.engine(), case.engine()
    first, second = np.split(some_events(case), [-20])
    engine.feed(first)
    engine.features()
    other.restore(engine.snapshot())
    np.testing.assert_array_equal(other.snapshot().counts, engine.snapshot().counts)
    # The response is computed afresh, which may put a code just outside the gap.
    np.testing.assert_allclose(other.snapshot().atoms, engine.snapshot().atoms, atol=1e-4)
    assert_certified(other._operator, other._state)
    other.feed(second)
    other.features()
    assert_certified(other._operator, other._state)


@pytest.mark.parametrize("kind", LASSO_KINDS, ids=ids)
def test_no_code_of_a_snapshot_outlives_its_volume(kind):
    case = known_case(kind)
    engine, other = case.engine(), case.engine(look_ahead=True)
    engine.feed(some_events(case))
    assert engine.snapshot().atoms.any()
    other.restore(engine.snapshot())
    assert other.stats() == engine.stats()
    end = 10 * case.geometry.window_us
    other.advance(end)
    assert not other.features().any()
    assert not other.snapshot().atoms.any()


def test_a_snapshot_of_an_engine_that_saw_nothing_is_an_empty_engine():
    case = known_case()
    engine = case.engine()
    snapshot = engine.snapshot()
    engine.feed(some_events(case))
    engine.features()
    engine.restore(snapshot)
    assert not engine.features().any()
    assert engine.stats() == case.engine().stats()


@pytest.mark.parametrize(
    "other",
    [
        known_case(resolution=(31, 50)),
        known_case(geometry=Geometry(patch=4, stride=3, n_bins=4, bin_us=1000, downsample=2, max_count=2)),
        known_case(("inverse", "soft")),
        known_case(("direct", "split")),
        Case(GEOMETRY, (31, 42), 33, "direct", "soft", 0.1, 4),
    ],
    ids=["sensor", "bins", "formulation", "encoding", "filters"],
)
def test_a_snapshot_of_another_encoder_or_sensor_is_refused_and_changes_nothing(other):
    engine = known_case().engine()
    engine.feed(some_events(known_case()))
    features = engine.features()
    with pytest.raises(InputError) as error:
        engine.restore(other.engine().snapshot())
    assert one_line(error)
    np.testing.assert_array_equal(engine.features(), features)


# What is read


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_features_are_the_codes_summed_over_quadrants(kind):
    case = known_case(kind)
    engine = case.engine()
    engine.feed(some_events(case))
    codes = engine.codes()
    rows, columns = engine.grid_shape
    assert codes.shape == (rows, columns, 33)
    assert codes.dtype == np.float32
    assert (rows, columns) == (5, 6)
    codes = codes.astype(np.float64)
    if kind[1] == "split":
        codes = np.concatenate([codes.clip(0), (-codes).clip(0)], axis=2)
    # An odd row in the middle belongs to the top.
    quadrants = [codes[:3, :3], codes[:3, 3:], codes[3:, :3], codes[3:, 3:]]
    expected = np.concatenate([q.sum(axis=(0, 1)) for q in quadrants]).astype(np.float32)
    np.testing.assert_array_equal(engine.features(), expected, strict=True)
    assert all(q.any() for q in quadrants)


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_what_is_handed_out_is_a_copy(kind):
    engine = known_case(kind).engine()
    engine.feed(some_events(known_case(kind)))
    handed_out = [engine.features(), engine.codes(), engine.snapshot().counts, engine.snapshot().atoms]
    before = engine.features(), engine.codes()
    for array in handed_out:
        array[:] = 77
    np.testing.assert_array_equal(engine.features(), before[0])
    np.testing.assert_array_equal(engine.codes(), before[1])


def test_stats_count_what_happened():
    case = known_case()
    engine = case.engine()
    assert engine.stats() == EngineStats(0, 0, 0, 0, 0, 0, 0)
    same_pixel = make_events([0] * 3, [0] * 3, [1] * 3, [0] * 3)  # max_count is 2: the third saturates
    engine.feed(same_pixel)
    assert engine.stats() == EngineStats(3, 0, 0, 1, 0, 0, 0)
    engine.features()
    assert engine.stats() == EngineStats(3, 0, 0, 1, 0, 1, 1)
    engine.features()  # nothing is dirty
    assert engine.stats() == EngineStats(3, 0, 0, 1, 0, 1, 1)
    engine.feed(make_events([0], [0], [0], [1]))  # back to two: clipped, it was two
    assert engine.stats().saturated == 2
    engine.feed(make_events([0, 0], [0, 0], [0, 1], [1, 1]))  # down and up: nothing changes in the end
    engine.features()
    assert engine.stats() == EngineStats(6, 0, 0, 2, 0, 1, 1)
    engine.feed(make_events([99, 0, 0], [0, 0, 0], [1, 1, 1], [1, 5000, 1]))
    engine.features()
    assert engine.stats() == EngineStats(7, 1, 1, 2, 5, 1, 2)


def test_saturation_is_remembered_beyond_the_clip():
    """Counts are exact and only what is read is clipped: five ON and three OFF are two ON."""
    case = known_case()
    engine, plain = case.engine(), case.engine()
    engine.feed(make_events([4] * 8, [4] * 8, [1] * 5 + [0] * 3, range(8)))
    plain.feed(make_events([4] * 2, [4] * 2, [1] * 2, [0] * 2))
    np.testing.assert_array_equal(engine.features(), plain.features())


# Looking ahead


def a_full_window(case):
    """An engine that looks ahead, with events in each bin of its window, and the time of the next bin."""
    rng, bin_us = np.random.default_rng(2), case.geometry.bin_us
    engine = case.engine(look_ahead=True)
    height, width = case.resolution
    n = 60 * case.geometry.n_bins
    times = np.sort(rng.integers(0, case.geometry.window_us, n))
    events = make_events(rng.integers(0, width, n), rng.integers(0, height, n), rng.integers(0, 2, n), times)
    engine.feed(events)
    return engine, events, case.geometry.n_bins * bin_us


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_a_boundary_that_was_prepared_encodes_nothing(kind):
    case = known_case(kind)
    prepared, events, boundary = a_full_window(case)
    unprepared, _, _ = a_full_window(case)
    for engine in (prepared, unprepared):
        engine.features()
    calls = 0
    while not prepared.prepare(20):
        calls += 1
    assert calls > 5  # in slices
    before = prepared.stats().encoded_volumes, unprepared.stats().encoded_volumes
    for engine in (prepared, unprepared):
        engine.advance(boundary)
    features = prepared.features()
    assert features.any()
    assert prepared.stats().encoded_volumes == before[0]
    unprepared.features()
    active = unprepared.stats().active_volumes
    assert unprepared.stats().encoded_volumes == before[1] + active
    assert active > 5
    if kind in EXACT_KINDS:
        offline = case.encoder.encode(events, case.resolution, origin_us=0, t_us=boundary)
        np.testing.assert_array_equal(features, offline)
    else:
        assert_certified(prepared._operator, prepared._state)


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_events_after_preparing_are_in_what_was_prepared(kind):
    case = known_case(kind)
    engine, events, boundary = a_full_window(case)
    while not engine.prepare(10**6):
        pass
    more = make_events(
        [5, 20, 30, 5], [5, 20, 9, 5], [1, 0, 1, 1], [boundary - 1, 0, boundary - 1, boundary - 1500]
    )
    engine.feed(more[:2])
    engine.features()
    engine.follow(more[2:])
    before = engine.stats().encoded_volumes
    engine.advance(boundary)
    features = engine.features()
    assert engine.stats().encoded_volumes == before
    if kind in EXACT_KINDS:
        everything = np.concatenate([events, more])
        offline = case.encoder.encode(everything, case.resolution, origin_us=0, t_us=boundary)
        np.testing.assert_array_equal(features, offline)
    else:
        assert_certified(engine._operator, engine._state)


def test_following_prepares_the_boundary_shortly_before_it():
    case = known_case()
    engine, _, boundary = a_full_window(case)
    engine.features()
    bin_us, volumes = case.geometry.bin_us, engine.grid_shape[0] * engine.grid_shape[1]
    start, last = boundary - bin_us, np.zeros(3, int)
    for t in range(start, start + bin_us * 39 // 40, 2):
        engine.follow(make_events([5], [5], [t // 2 % 2], [t]))
        coming = engine._state.cursors[1 - engine._state.clock[CLOCK_PLANE]].copy()
        assert (coming[:CURSOR_ENTRY] - last[:CURSOR_ENTRY]).max() <= 5  # spread out
        elapsed = (t - start + 1) / bin_us
        assert coming[CURSOR_PROJECTED] <= volumes * elapsed / 0.9
        assert coming[CURSOR_CODED] <= volumes * max(8 * elapsed - 6.8, 0)
        last = coming
    engine.follow(make_events([5], [5], [1], [start + bin_us * 39 // 40]))
    assert engine._state.cursors.tolist() == [[volumes, volumes, 0]] * 2
    assert engine.prepare(1)


def test_nothing_is_left_to_prepare_for_an_engine_that_does_not_look_ahead():
    case = known_case()
    engine = case.engine()
    engine.feed(some_events(case))
    assert engine.prepare(1)
    assert not case.engine(look_ahead=True).prepare(0)


@pytest.mark.parametrize("kind", EXACT_KINDS)
def test_idle_time_is_used_for_a_short_update(kind, monkeypatch):
    case = known_case(kind)
    engine, busy, large = case.engine(), case.engine(), case.engine()
    for one in (engine, busy, large):
        one.feed(some_events(case))
    assert engine.prepare(0)
    encoded = engine.stats().encoded_volumes
    assert encoded > 0
    np.testing.assert_array_equal(engine.features(), busy.features(), strict=True)
    assert engine.stats().encoded_volumes == encoded
    monkeypatch.setattr("streamfeat.engine.update.LITTLE", 0)
    assert large.prepare(0)
    assert large.stats().encoded_volumes == 0


@pytest.mark.parametrize("kind", LASSO_KINDS)
def test_idle_time_changes_no_code_of_a_lasso(kind):
    case = known_case(kind)
    engine = case.engine()
    engine.feed(some_events(case))
    assert engine.prepare(10**6)
    assert engine.stats().encoded_volumes == 0


# Memory


@pytest.mark.parametrize("kind", [("direct", "split"), ("inverse", "soft")], ids=ids)
def test_nothing_is_allocated_after_warm_up(kind):
    case = known_case(kind)
    engine = Engine(case.encoder, case.resolution, look_ahead=True)
    batches = [some_events(case, 2000, seed) for seed in range(4)]
    for i, batch in enumerate(batches):
        batch["t"] += i * 2 * case.geometry.window_us

    def work():
        for batch in batches:
            engine.feed(batch)
            engine.advance(int(batch["t"][-1]) + case.geometry.bin_us)
            update(engine._operator, engine._state)
            engine.prepare(1000)
            engine.follow(batch[-20:])

    work()
    addresses = [array.ctypes.data for array in engine._state]
    work()
    tracemalloc.start()
    try:
        for _ in range(10):  # Python keeps some freed objects for later
            work()
        blocks = sys.getallocatedblocks()
        tracemalloc.reset_peak()
        start, _ = tracemalloc.get_traced_memory()
        for _ in range(10):
            work()
        end, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert [array.ctypes.data for array in engine._state] == addresses
    # A batch has 32,000 bytes; what is left are a few Python integers and the call itself.
    assert peak - start < 4096
    assert end - start < 1024
    assert sys.getallocatedblocks() - blocks < 100


@pytest.mark.parametrize("look_ahead", [False, True])
@pytest.mark.parametrize("kind", EXACT_KINDS, ids=ids)
def test_any_number_of_threads_gives_what_one_gives(kind, look_ahead, monkeypatch):
    monkeypatch.setattr(threads, "WORTH_A_PART", 1)
    monkeypatch.setattr(threads, "WORTH_COUNTING", 0)
    case = known_case(kind)
    events = some_events(case)
    one = case.engine(look_ahead=look_ahead)
    others = [Engine(case.encoder, case.resolution, look_ahead=look_ahead, threads=n) for n in (2, 3, 64)]
    for part in np.array_split(events, 7):
        one.feed(part)
        one.prepare(60)
        for engine in others:
            engine.feed(part)
            engine.prepare(60)
            np.testing.assert_array_equal(engine.features(), one.features())
            assert engine.stats() == one.stats()
        one.follow(part[:3])
        for engine in others:
            engine.follow(part[:3])
    assert one.stats().encoded_volumes > 0
    for engine in others:
        engine.restore(one.snapshot())
        np.testing.assert_array_equal(engine.features(), one.features())
        assert engine.stats() == one.stats()


@pytest.mark.parametrize("n", [0, -1, 1000])
def test_a_number_of_threads_that_makes_no_sense_is_refused(n):
    case = known_case()
    with pytest.raises(InputError, match=f"^{n} threads: an engine uses 1 to 256$"):
        Engine(case.encoder, case.resolution, threads=n)


def test_a_small_sensor_pays_nothing_for_threads(monkeypatch):
    """It does all in one call, and starts no thread; the count of volumes decides, not the clock."""
    monkeypatch.setattr(threads.Crew, "share", None)
    case = known_case()
    engine = Engine(case.encoder, case.resolution, threads=2)
    engine.feed(some_events(case))
    assert engine.features().any()
    volumes = engine.grid_shape[0] * engine.grid_shape[1]
    monkeypatch.setattr(threads, "WORTH_A_PART", 64 * volumes // 4)
    monkeypatch.setattr(threads, "WORTH_COUNTING", 64 * volumes)
    engine.restart(0)
    engine.feed(some_events(case))
    with pytest.raises(TypeError):
        engine.features()


def test_cores_but_one_are_used_if_nothing_is_said(monkeypatch):
    for cores, used in ((1, 1), (2, 1), (3, 2), (1000, 256)):
        monkeypatch.setattr(os, "sched_getaffinity", lambda pid, n=cores: set(range(n)), raising=False)
        assert threads.usable_threads() == used


@pytest.mark.parametrize("kind", LASSO_KINDS, ids=ids)
def test_an_engine_that_looked_ahead_goes_on_after_a_snapshot_as_one_that_is_restored(kind):
    """Codes of the plane that looks ahead are where the next ones start: a snapshot forgets them."""
    case = known_case(kind)
    for seed in range(4):
        engine, other = case.engine(look_ahead=True), case.engine(look_ahead=True)
        events = some_events(case, seed=seed)
        first, second = np.split(events, [150])
        for batch in np.array_split(first, 5):
            engine.feed(batch)
            engine.prepare(10**6)
        other.restore(engine.snapshot())
        for batch in np.array_split(second, 5):
            for each in (engine, other):
                each.feed(batch)
                each.prepare(10**6)
            np.testing.assert_array_equal(engine.features(), other.features())
            np.testing.assert_array_equal(engine.codes(), other.codes())


def test_the_grid_of_a_sensor_is_no_part_of_a_fingerprint():
    """Classifiers and checkpoints name encoders by their fingerprint: it may not change with a version."""
    geometry = Geometry(patch=2, stride=1, n_bins=1, bin_us=10)
    encoder = Encoder.build(
        geometry,
        formulation="direct",
        encoding="soft",
        threshold=0.5,
        filters=np.eye(4),
        whitening=np.eye(4),
        mean=np.zeros(4),
    )
    assert encoder.fingerprint == "14986669249bf443458611d0143b0af5e350252030d39e783ad9dca1094ead28"
