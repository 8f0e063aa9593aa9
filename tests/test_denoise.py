"""Noise is taken out the same way however a stream is cut, and what is meant by noise is what goes."""

import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from streamfeat.denoise.stage import Denoiser, Denoising, parse_duration
from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.messages.packets import Label, Packet, Watermark
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session

SIZE = (4, 5)


def events_at(*rows):
    """Events from rows of t, x, y."""
    t, x, y = np.array(rows).T if rows else np.zeros((3, 0), np.int64)
    return make_events(x, y, np.ones(len(t)), t)


def kept(denoising, events):
    return Denoiser(denoising).events(events, SIZE)["t"].tolist()


@st.composite
def noisy(draw):
    n = draw(st.integers(0, 60))
    column = lambda values: draw(arrays(np.int64, n, elements=values))  # noqa: E731
    steps = column(st.sampled_from([0, 1, 5, 90, 400, -30, 100_000, 3_000_000, -3_000_000]))
    return make_events(
        column(st.integers(0, 5)), column(st.integers(0, 4)), column(st.integers(-1, 2)), np.cumsum(steps)
    )


@given(
    noisy(),
    st.lists(st.integers(0, 60)),
    st.sampled_from([0, 3, 20]),
    st.sampled_from([0, 1, 50]),
    st.sampled_from([0, 60, 500]),
)
def test_the_same_events_come_through_however_the_stream_is_cut(events, cuts, hot, refractory, isolated):
    denoising = Denoising(hot, refractory, isolated)
    whole = Denoiser(denoising)
    expected = whole.events(events, SIZE)
    cut = Denoiser(denoising)
    parts = [cut.events(part, SIZE) for part in np.split(events, np.sort(cuts))]
    np.testing.assert_array_equal(np.concatenate([*parts, events[:0]]), expected)
    assert cut.removed == whole.removed
    assert sum(whole.removed.values()) == len(events) - len(expected)


class TestRefractory:
    def test_a_period_runs_from_the_last_event_that_was_kept(self):
        events = events_at((0, 1, 1), (60, 1, 1), (99, 1, 1), (100, 1, 1), (150, 2, 1))
        assert kept(Denoising(refractory_us=100), events) == [0, 100, 150]

    def test_an_event_out_of_order_is_looked_at_as_any_other(self):
        events = events_at((1000, 1, 1), (950, 1, 1), (500, 1, 1), (560, 1, 1))
        assert kept(Denoising(refractory_us=100), events) == [1000, 500]

    def test_one_absurd_time_costs_only_itself(self):
        times = [0, 200, 1 << 60, 400, 600]
        assert kept(Denoising(refractory_us=100), events_at(*((t, 1, 1) for t in times))) == times


class TestIsolated:
    def test_an_event_needs_a_neighbour_shortly_before(self):
        events = events_at((0, 1, 1), (50, 2, 2), (151, 1, 2), (300, 4, 0), (301, 2, 0))
        assert kept(Denoising(isolated_us=100), events) == [50]

    def test_a_pixel_does_not_support_itself(self):
        assert kept(Denoising(isolated_us=100), events_at((0, 1, 1), (1, 1, 1), (2, 1, 1))) == []

    def test_hot_pixels_support_nobody(self):
        # The pixel at 2, 2 fires each 10 ms, ten times what is allowed; a neighbour fires once late on.
        hot = [(10_000 * i, 2, 2) for i in range(400)]
        events = events_at(*hot, (3_991_000, 3, 2))
        assert 3_991_000 in kept(Denoising(isolated_us=5_000), events)
        assert 3_991_000 not in kept(Denoising(hot_rate=10, isolated_us=5_000), events)


class TestHot:
    def test_a_pixel_that_goes_on_and_on_falls_silent_and_others_do_not(self):
        hot = [(1_000 * i, 0, 0) for i in range(3_000)]
        quiet = [(50_000 * i, 1, 0) for i in range(60)]
        events = np.sort(events_at(*hot, *quiet), order="t")
        stage = Denoiser(Denoising(hot_rate=100))
        left = stage.events(events, SIZE)
        assert np.count_nonzero(left["x"] == 1) == 60
        assert 100 <= np.count_nonzero(left["x"] == 0) < 120
        assert stage.removed == {"hot pixels": 3_060 - len(left)}

    def test_a_burst_passes(self):
        assert len(kept(Denoising(hot_rate=100), events_at(*((i, 0, 0) for i in range(100))))) == 100

    def test_it_comes_back_after_two_seconds_of_rest(self):
        events = events_at(*((i, 0, 0) for i in range(5_000)), (2_100_000, 0, 0))
        assert kept(Denoising(hot_rate=100), events)[-1] == 2_100_000


class TestStage:
    def packet(self, *rows, epoch=0, resolution=SIZE):
        return Packet("/events", events_at(*rows), resolution, 0, 7, epoch=epoch)

    def test_what_an_engine_would_reject_is_left_to_it(self):
        events = make_events([5, 1, 1, 1], [0, 4, 1, 1], [1, 1, 2, 1], [0, 0, 0, 1 << 62])
        out = Denoiser(Denoising(100, 100, 100)).events(events, SIZE)
        np.testing.assert_array_equal(out, events)

    def test_labels_epochs_and_resolutions_start_anew(self):
        stage = Denoiser(Denoising(refractory_us=100))
        count = lambda item: len(stage.process(item).events)  # noqa: E731
        assert [count(self.packet((0, 1, 1))), count(self.packet((50, 1, 1)))] == [1, 0]
        stage.process(Label(0, 100, "a"))
        assert [count(self.packet((60, 1, 1))), count(self.packet((70, 1, 1)))] == [1, 0]
        assert count(self.packet((80, 1, 1), epoch=1)) == 1
        assert count(self.packet((90, 1, 1), epoch=1, resolution=(9, 9))) == 1
        assert stage.removed == {"refractory": 2}

    def test_everything_else_passes_as_it_is(self):
        stage = Denoiser(Denoising(refractory_us=100))
        for item in (Watermark("/events", 5), Label(0, 1, "a"), self.packet()):
            assert stage.process(item) is item

    def test_nothing_asked_for_takes_nothing_out(self):
        assert not Denoising()
        assert Denoiser(Denoising()).removed == {}


@pytest.mark.parametrize(
    ("text", "us"), [("500us", 500), ("1ms", 1_000), ("0.2s", 200_000), (".5 ms", 500), ("1s", 1_000_000)]
)
def test_durations(text, us):
    assert parse_duration(text, "--refractory") == us


@pytest.mark.parametrize("text", ["", "1", "-1ms", "0us", "1h", "nan ms", "2e9s", "0.1us"])
def test_what_is_no_duration_names_the_option(text):
    with pytest.raises(InputError, match="--refractory"):
        parse_duration(text, "--refractory")


@pytest.mark.parametrize("rate", [0.5, -3, 2e6, float("nan")])
def test_rates_out_of_range(rate):
    with pytest.raises(InputError, match="events a second"):
        Denoising(hot_rate=rate)


def test_a_session_counts_what_is_left(tmp_path):
    denoising = Denoising(refractory_us=20_000)
    items = [tiny.packet(part) for part in np.array_split(tiny.steady(0, 300_000, 3_000), 7)]
    stage = Denoiser(denoising)
    policy = EmitPolicy.parse("10ms")
    plain, filtered = Session(tiny.encoder(), policy), Session(tiny.encoder(), policy, denoising=denoising)
    for item in items:
        expected = [*plain.process(stage.process(item))]
        found = [*filtered.process(item)]
        assert [e.t_us for e in found] == [e.t_us for e in expected]
        for mine, theirs in zip(found, expected, strict=True):
            np.testing.assert_array_equal(mine.features, theirs.features)
    assert filtered.stats() == plain.stats()
    assert filtered.denoiser.removed == stage.removed
    assert stage.removed["refractory"] > 100


def test_replay_takes_out_what_the_stage_does_and_says_how_much(run, tmp_path):
    events = tiny.steady(0, 300_000, 3_000)
    path = tiny.write_items(tmp_path / "in.mcap", [tiny.packet(part) for part in np.array_split(events, 7)])
    tiny.encoder().save(tmp_path / "m.safetensors")
    result = run("replay", path, "-m", tmp_path / "m.safetensors", "--refractory", "20ms", "--json").json
    stage = Denoiser(Denoising(refractory_us=20_000))
    assert result["events"] == len(stage.events(events, tiny.RESOLUTION))
    assert result["removed"]["refractory"] == stage.removed["refractory"]
