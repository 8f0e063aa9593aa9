"""Watching an engine: it computes what it would compute, and shows what it holds."""

import numpy as np
import pytest
import tiny

from streamfeat.engine.engine import Engine
from streamfeat.engine.window import count_window
from streamfeat.view import observe
from streamfeat.view.observe import ObservedEngine, Slot, Throttle, Watch

MODEL = tiny.encoder(k=3)
GEOMETRY = MODEL.geometry


def watched(rate=1e9, look_ahead=False, **options):
    seen = []
    watch = Watch("cam", Throttle(rate, clock=None), seen.append)
    return ObservedEngine(MODEL, tiny.RESOLUTION, watch=watch, look_ahead=look_ahead, **options), seen


@pytest.mark.parametrize("look_ahead", [False, True])
def test_an_observed_engine_has_the_same_features(look_ahead):
    engine, seen = watched(look_ahead=look_ahead)
    other = Engine(MODEL, tiny.RESOLUTION, look_ahead=look_ahead)
    for i in range(4):
        batch = tiny.steady(i * 40_000, (i + 1) * 40_000, 100, seed=i)
        np.testing.assert_array_equal(engine.trace(batch[:30])[0], other.trace(batch[:30])[0])
        for one in (engine, other):
            one.feed(batch[30:])
            one.advance((i + 1) * 40_000)
        np.testing.assert_array_equal(engine.features(), other.features())
    assert engine.stats() == other.stats()
    assert len(seen) == 8


def test_a_sight_holds_the_window():
    engine, seen = watched()
    batch = tiny.steady(0, 330_000, 2_000)
    engine.feed(batch)
    engine.features()
    (sight,) = seen
    assert sight.window_us == (250_000, 350_000)
    assert sight.now_us == batch["t"][-1]
    expected = count_window(GEOMETRY, batch, tiny.RESOLUTION, origin_us=0)
    limit = GEOMETRY.max_count
    np.testing.assert_array_equal(sight.counts.clip(-limit, limit), expected)
    rows, columns = GEOMETRY.grid_shape(tiny.RESOLUTION)
    for row in range(rows):
        for column in range(columns):
            block = expected[:, row * 4 : row * 4 + 4, column * 4 : column * 4 + 4]
            assert sight.activity[row, column] == (block.astype(int) ** 2).sum()
    assert (sight.updates.n, sight.topic) == (1, "cam")
    assert 0 < sight.updates.median_us == sight.updates.max_us


def test_a_new_sample_starts_with_nothing_seen():
    engine, seen = watched()
    engine.feed(tiny.steady(0, 50_000, 100))
    engine.restart(1_000_000)
    engine.features()
    assert seen[0].batches == ()
    assert (seen[0].counts == 0).all()


def test_a_clock_far_ahead_in_a_refused_event_is_not_believed():
    engine, seen = watched()
    batch = tiny.steady(0, 50_000, 10)
    batch["t"][-1], batch["x"][-1] = 1 << 61, 60_000
    engine.feed(batch)
    engine.features()
    assert seen[0].now_us <= seen[0].window_us[1] == 50_000


def test_looks_are_no_more_frequent_than_asked_for():
    engine, seen = watched(rate=20)
    for i in range(100):
        engine.feed(tiny.steady(i * 10_000, (i + 1) * 10_000, 20, seed=i))
        engine.features()
    assert 18 <= len(seen) <= 20
    assert sum(sight.updates.n for sight in seen) <= 100
    assert seen[-1].updates.n == 5


def test_a_throttle_follows_its_clock_and_starts_anew_when_time_goes_back():
    now = [0.0]
    throttle = Throttle(10, clock=lambda: now[0])
    assert [throttle.is_due(0) for now[0] in (0, 0.05, 0.1, 0.19, 0.25, 0.1, 0.15)] == [1, 0, 1, 0, 1, 1, 0]


def test_a_throttle_keeps_its_rate_though_events_come_in_slices():
    """A slice ends 0.03 s after the one before, so that a picture is never due when one ends."""
    now = [0.0]
    throttle = Throttle(10, clock=lambda: now[0])
    assert sum(throttle.is_due(0) for now[0] in np.arange(0, 3, 0.03)) == 30
    # After a pause pictures do not come in a hurry.
    assert [throttle.is_due(0) for now[0] in (9, 9.03, 9.06, 9.12)] == [1, 0, 0, 1]


def test_what_nobody_takes_is_replaced_and_counted():
    slot = Slot()
    engine, _ = watched()
    watch = Watch("cam", Throttle(1e9, clock=None), slot.put)
    engine = ObservedEngine(MODEL, tiny.RESOLUTION, watch=watch)
    for i in range(5):
        engine.feed(tiny.steady(i * 1_000, (i + 1) * 1_000, 20, seed=i))
        engine.features()
    assert slot.skipped == 4
    assert slot.take().stats.events == 100
    assert slot.take() is None


def test_remembered_events_are_bounded(monkeypatch):
    monkeypatch.setattr(observe, "_KEPT_EVENTS", 250)
    engine, seen = watched(rate=1e-9)
    for i in range(50):
        engine.feed(tiny.steady(i * 1_000, (i + 1) * 1_000, 100, seed=i))
    engine.features()
    assert [len(batch) for batch in seen[0].batches] == [100, 100]
    assert seen[0].batches[-1]["t"][-1] >= 49_000
