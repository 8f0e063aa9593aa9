"""Sessions: when features are read, and that this never changes what they are."""

from dataclasses import replace

import numpy as np
import pytest
import tiny

from streamfeat.classify.classifier import Classifier
from streamfeat.classify.features import EventFeatures, encode_samples, sample_end
from streamfeat.engine import threads
from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.messages.packets import Watermark
from streamfeat.recordings.reader import Label, Packet, Sample
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session

MODEL = tiny.encoder()
WINDOW = tiny.GEOMETRY.window_us
POLICIES = ["event", "7ev", "1000ev", "10ms", "3333us", "auto"]


def run(items, policy="10ms", model=MODEL, classifier=None, **options):
    session = Session(model, EmitPolicy.parse(policy), classifier, **options)
    emissions = [e for item in items for e in session.process(item)]
    return emissions + list(session.finish()), session


def times(emissions):
    return [e.t_us for e in emissions]


def same(one, two):
    """Whether two lists of emissions are equal, bit for bit."""
    return len(one) == len(two) and all(
        (a.t_us, a.n_events, a.sample, a.final, a.labels) == (b.t_us, b.n_events, b.sample, b.final, b.labels)
        and np.array_equal(a.features, b.features)
        and np.array_equal(a.scores, b.scores)
        for a, b in zip(one, two, strict=True)
    )


def cut(items, rng):
    """The same items with every packet cut at random places, empty packets included."""
    for item in items:
        if isinstance(item, Label):
            yield item
            continue
        places = np.sort(rng.integers(0, len(item.events) + 1, rng.integers(0, 6)))
        for part in np.split(item.events, places):
            yield Packet(item.topic, part, item.resolution, item.log_time_ns, item.seq)


# --- policies


@pytest.mark.parametrize(
    ("text", "kind", "every"),
    [
        ("event", "events", 1),
        ("1000ev", "events", 1000),
        ("10ms", "time", 10_000),
        ("500us", "time", 500),
        ("2s", "time", 2_000_000),
        ("auto", "auto", 1),
        ("bin", "bin", 1),
    ],
)
def test_policies_are_parsed(text, kind, every):
    assert EmitPolicy.parse(text) == EmitPolicy(kind, every)
    assert EmitPolicy.parse(str(EmitPolicy(kind, every))) == EmitPolicy(kind, every)


def test_at_every_bin_is_at_every_multiple_of_its_length():
    items = tiny.labelled_items(3)
    policies = ("bin", f"{tiny.GEOMETRY.bin_us}us")
    bins, times = (run(items, policy)[0] for policy in policies)
    assert [(e.t_us, e.features.tobytes()) for e in bins] == [(e.t_us, e.features.tobytes()) for e in times]
    assert len(bins) == 6
    assert all(e.active_volumes > 0 for e in bins if e.final)


@pytest.mark.parametrize(
    "text", ["", "0ms", "10", "ms", "-1ev", "1.5ms", "10 ms", "10m", "EVENT", "01ms", "1ev\n"]
)
def test_bad_policies_are_refused(text):
    with pytest.raises(InputError, match="--emit"):
        EmitPolicy.parse(text)


def test_every_event():
    emissions, session = run([tiny.packet(tiny.stream([5, 5, 90, 40]))], "event")
    # A reading reflects what came before it; an event from the past does not turn time back.
    assert times(emissions) == [6, 6, 91, 91]
    assert [e.n_events for e in emissions] == [1, 2, 3, 4]
    assert session.stats().emissions == 4


def test_every_so_many_events():
    first, second = tiny.stream([1, 2, 3, 4, 5]), tiny.stream([6, 7, 8])
    emissions, _ = run([tiny.packet(first), tiny.packet(second)], "3ev")
    assert times(emissions) == [4, 7, 9]
    assert [e.n_events for e in emissions] == [3, 6, 8]


def test_every_so_many_microseconds():
    emissions, _ = run([tiny.packet(tiny.stream([3, 9, 10, 35]))], "10us")
    # An event at 10 is not before 10. Silence inside the window is read on: bins roll.
    assert times(emissions) == [10, 20, 30, 36]
    assert [e.n_events for e in emissions] == [2, 3, 3, 4]


def test_times_are_counted_from_the_start_of_a_sample():
    items = [Label(1003, 30, "cat"), tiny.packet(tiny.stream([1004, 1014, 1031]))]
    emissions, _ = run(items, "10us")
    assert times(emissions) == [1013, 1023, 1033]
    assert [e.final for e in emissions] == [False, False, True]


def test_auto_rests_four_times_as_long_as_reading_takes():
    clock = FakeClock()
    session = Session(MODEL, EmitPolicy.parse("auto"), clock=clock)
    reading = session._emit

    def slow_reading(*args, **options):
        clock.now += 1.0
        return reading(*args, **options)

    session._emit = slow_reading
    read_at = []
    for i in range(40):
        clock.now = max(clock.now, 0.5 * i)
        if list(session.process(tiny.packet(tiny.stream([10 * i])))):
            read_at.append(i)
    # A reading at 0 s takes until 1 s; the next is at 5 s, packet 10, and so on.
    assert read_at == [0, 10, 20, 30]
    # The nine events since are read at the end.
    assert times(session.finish()) == [391]


class FakeClock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def test_auto_reads_everything_where_reading_is_free():
    items = [tiny.packet(tiny.stream([i])) for i in range(5)]
    emissions, _ = run(items, "auto")
    assert times(emissions) == [1, 2, 3, 4, 5]


# --- the result does not depend on the policy, nor on packets


@pytest.mark.parametrize("encoding", ["soft", "split", "triangle"])
def test_finals_do_not_depend_on_the_policy_and_equal_the_offline_path(encoding):
    model = tiny.encoder(encoding=encoding)
    # Samples end where a bin does: a microsecond more would be another window.
    items = tiny.labelled_items(4, duration_us=WINDOW)
    samples = [
        Sample(label, np.concatenate([a.events, b.events]), tiny.RESOLUTION)
        for label, a, b in zip(items[::3], items[1::3], items[2::3], strict=True)
    ]
    expected = [
        model.encode(s.events, s.resolution, origin_us=s.label.start_us, t_us=sample_end(s.label))
        for s in samples
    ]
    assert all(features.any() for features in expected)
    for policy in POLICIES:
        emissions, _ = run(items, policy, model)
        finals = [e for e in emissions if e.final]
        assert [e.sample for e in finals] == items[::3]
        for emission, features in zip(finals, expected, strict=True):
            assert np.array_equal(emission.features, features)
            assert emission.t_us == emission.sample.start_us + emission.sample.duration_us
    encoded = list(encode_samples(model, samples, threads=3))
    assert [label for label, _ in encoded] == items[::3]
    assert np.array_equal([features for _, features in encoded], expected)
    assert np.array_equal(EventFeatures(model, threads=2).fit([]).transform(samples), expected)
    assert EventFeatures(model).transform([]).shape == (0, model.n_features)


def test_inverse_finals_agree_within_the_gap():
    model = tiny.encoder("inverse", "soft")
    items = tiny.labelled_items(3)
    finals = [[e for e in run(items, policy, model)[0] if e.final] for policy in POLICIES]
    for other in finals[1:]:
        for a, b in zip(finals[0], other, strict=True):
            assert a.features == pytest.approx(b.features, abs=0.05 * float(np.abs(a.features).max()))


@pytest.mark.parametrize("policy", ["event", "7ev", "100ev", "10ms", "3333us"])
@pytest.mark.parametrize("seed", range(3))
def test_packets_may_be_cut_anywhere(policy, seed):
    rng = np.random.default_rng(seed)
    items = tiny.labelled_items(3)
    # Events that no sample claims, before, between and after, and some out of order.
    free = tiny.steady(0, 120_000, 200, seed=7)
    free["t"] = np.maximum(free["t"] - rng.integers(0, 2, 200) * rng.integers(0, 30_000, 200), 0)
    late = tiny.steady(800_000, 3_000_000, 150, seed=8)
    items = [tiny.packet(free), *items, tiny.packet(late)]
    clf = tiny.classifier(MODEL)
    whole, session = run(items, policy, classifier=clf)
    for _ in range(3):
        pieces, other = run(cut(items, rng), policy, classifier=clf)
        assert same(whole, pieces)
        assert session.stats() == other.stats()


# --- labels


def test_samples_start_empty_and_events_after_the_end_are_not_theirs():
    label = Label(1000, 500, "cat", "train", "x")
    inside, after = tiny.steady(1000, 1500, 50, seed=1), tiny.steady(1500, 1900, 60, seed=2)
    before = tiny.steady(0, 1000, 70, seed=3)
    emissions, _ = run([tiny.packet(before), label, tiny.packet(np.concatenate([inside, after]))], "1000ev")
    final, rest = emissions
    assert (final.final, final.sample, final.t_us, final.n_events) == (True, label, 1500, 120)
    assert np.array_equal(final.features, MODEL.encode(inside, tiny.RESOLUTION, origin_us=1000, t_us=1499))
    assert (rest.final, rest.sample, rest.n_events) == (False, None, 180)


def test_events_before_a_label_do_not_count_towards_its_first_reading():
    items = [
        tiny.packet(tiny.stream([1, 2])),
        Label(100, 50, "cat"),
        tiny.packet(tiny.stream([101, 102, 103])),
    ]
    assert times(run(items, "3ev")[0]) == [104, 150]


def test_a_sample_without_events_has_zero_features():
    items = [Label(0, 100, "cat"), Label(200, 100, "dog"), tiny.packet(tiny.stream([250]))]
    for geometry in (tiny.GEOMETRY, Geometry(patch=4, stride=4, n_bins=2, bin_us=50_000, downsample=3)):
        model = tiny.encoder(geometry=geometry)
        emissions, session = run(items, "auto", model)
        assert not emissions[0].features.any()
        assert emissions[0].features.shape == (model.n_features,)
        assert emissions[0].final
        assert session.stats().samples == 2


def test_a_sample_without_events_after_one_with():
    items = [*tiny.labelled_items(1), Label(900_000, 100, "dog"), Label(990_000, 100, "dog")]
    finals = [e for e in run(items, "1000ev")[0] if e.final]
    assert [bool(e.features.any()) for e in finals] == [True, False, False]


def test_the_last_sample_is_read_at_its_end_though_the_stream_ends_before():
    items = tiny.labelled_items(1)
    emissions, _ = run([items[0], items[1]], "1000ev")
    assert times(emissions) == [items[0].start_us + items[0].duration_us]


def test_a_change_of_resolution_starts_anew_and_keeps_count():
    small = tiny.steady(1_000_000, 1_080_000, 40, seed=4, resolution=(8, 8))
    items = [*tiny.labelled_items(1), Label(1_000_000, 80_000, "dog"), tiny.packet(small, (8, 8))]
    emissions, session = run(items, "1000ev")
    expected = MODEL.encode(small, (8, 8), origin_us=1_000_000, t_us=1_079_999)
    assert np.array_equal(emissions[-1].features, expected)
    assert emissions[-1].n_events == session.stats().events == 340
    # Too small for a volume: what is missing of one never fires.
    emissions, _ = run([*items, tiny.packet(tiny.stream([2_000_000], resolution=(3, 3)), (3, 3))], "event")
    assert emissions[-1].features.shape == expected.shape


# --- silence, and events that make no sense


@pytest.mark.parametrize("policy", ["10ms", "1ms"])
def test_silence_is_not_read_over_and_over(policy):
    hour = 3_600_000_000
    every = EmitPolicy.parse(policy).every
    stream = tiny.stream([5, 4 * hour + 7, 9 * hour])
    for items in (
        [tiny.packet(stream)],
        [tiny.packet(stream[i : i + 1]) for i in range(3)],
        [Label(0, 10 * hour, "cat"), tiny.packet(stream)],
    ):
        emissions, _ = run(items, policy)
        assert len(emissions) <= 3 * (WINDOW // every + 2)
        # Until the window has emptied there is something to tell, and the last reading tells that.
        read = [e for e in emissions if e.t_us < hour]
        assert times(read) == list(range(every, WINDOW + every + 1, every))
        assert read[0].features.any()
        assert not read[-1].features.any()


def test_rejected_events_have_no_say_in_stream_time():
    good = tiny.stream([10, 20, 30, 40])
    bad = make_events([999, 0, 0, 3], [0, 999, 0, 3], [1, 1, 7, 1], [5_000_000, 900, 10**9, 2**62 + 5])
    mixed = np.concatenate([bad[:1], good[:2], bad[1:], good[2:]])
    sample = Label(0, 100, "cat")
    for policy in ("event", "10us", "auto"):
        for head in ([], [sample]):
            emissions, session = run([*head, tiny.packet(mixed)], policy)
            expected, clean = run([*head, tiny.packet(good)], policy)
            assert emissions[-1].t_us == expected[-1].t_us
            assert np.array_equal(emissions[-1].features, expected[-1].features)
            stats = session.stats()
            assert (stats.events, stats.rejected, stats.late) == (4, 4, 0)
            assert clean.stats().rejected == 0


def test_time_that_goes_back_is_late_and_nothing_else():
    ahead = tiny.steady(10 * WINDOW, 11 * WINDOW, 30)
    back = tiny.steady(0, WINDOW, 20)
    for policy in POLICIES:
        emissions, session = run([tiny.packet(ahead), tiny.packet(back)], policy)
        assert session.stats().late == 20
        assert session.stats().events == 30
        assert times(emissions) == sorted(times(emissions))


def test_events_from_before_an_open_sample_do_not_count_for_it():
    """As offline: a sample holds the events from its start on, whatever is in the packets that follow."""
    start = 10 * WINDOW + 7
    inside = tiny.steady(start, start + 1000, 40)
    inside["t"][0] = start
    early = tiny.steady(start - WINDOW // 2, start, 20, seed=3)  # inside the window, had they counted
    early["t"][0] = start - 1
    bad = make_events([999], [0], [1], [start - 5])
    after = tiny.steady(start + WINDOW, start + WINDOW + 10, 5, seed=4)
    rng = np.random.default_rng(0)
    mixed = np.concatenate([early[:10], inside[:20], early[10:], bad, inside[20:]])
    label = Label(start, WINDOW, "cat")
    for policy in POLICIES:
        expected, _ = run([label, tiny.packet(inside), tiny.packet(after)], policy)
        items = [label, tiny.packet(np.concatenate([mixed, after]))]
        for given in (items, list(cut(items, rng))):
            emissions, session = run(given, policy)
            stats = session.stats()
            assert (stats.events, stats.late, stats.rejected) == (45, 20, 1)
            final, wanted = ([e for e in es if e.final] for es in (emissions, expected))
            assert np.array_equal(final[0].features, wanted[0].features)
            offline = MODEL.encode(inside, tiny.RESOLUTION, origin_us=start, t_us=start + WINDOW - 1)
            assert np.array_equal(final[0].features, offline)
    # Once the sample is over, they count again as far as the window goes back.
    _, session = run([label, tiny.packet(inside), tiny.packet(after), tiny.packet(early)])
    assert session.stats().late == 20 - np.count_nonzero(early["t"] >= start)
    _, session = run([tiny.packet(inside), tiny.packet(early)])
    assert session.stats().late == 0


# --- classifiers


def test_scores_and_totals():
    clf = tiny.classifier(MODEL)
    items = tiny.labelled_items(6)
    emissions, session = run(items, "50ev", classifier=clf)
    for e in emissions:
        assert e.labels == clf.labels
        assert np.array_equal(e.scores, clf.scores(e.features))
        assert e.prediction == clf.predict(e.features)
        assert e.correct == (e.prediction == e.sample.label)
    finals = [e for e in emissions if e.final]
    stats = session.stats()
    assert stats.correct == sum(e.correct for e in finals)
    assert (stats.samples, stats.events, stats.emissions) == (6, 1800, len(emissions))
    assert stats.late == stats.rejected == stats.unknown_labels == 0
    assert emissions[-1].n_events == 1800
    assert run(items, "50ev")[1].stats().correct is None


def test_without_a_classifier_nothing_is_predicted():
    for e in run(tiny.labelled_items(1))[0]:
        assert (e.labels, e.scores.shape, e.prediction, e.correct) == ((), (0,), None, None)


def test_a_classifier_of_another_model_is_refused():
    with pytest.raises(InputError, match="another model"):
        run([], classifier=tiny.classifier(tiny.encoder(seed=1)))


def test_learning_online_predicts_first():
    """Equal to the plain loop: predict with what is known, then learn."""
    from streamfeat.classify.online import OnlineClassifier

    names = ("cat", "dog", "owl")
    items = tiny.labelled_items(40, names=names)
    start = Classifier.untrained(names, MODEL)
    emissions, session = run(items, "1000ev", classifier=start, learn_online=True)
    learner = OnlineClassifier(start)
    for e in [e for e in emissions if e.final]:
        assert np.array_equal(e.scores, learner.classifier.scores(e.features))
        learner.learn_one(e.features, e.sample.label)
    learner.flush()
    assert np.array_equal(session.classifier.weights, learner.classifier.weights)
    assert session.classifier.provenance["learned_online"] == 40
    assert start.weights.any() == np.False_


def test_unknown_labels_are_counted_and_not_learned():
    clf = tiny.classifier(MODEL, ("cat", "dog"))
    _, session = run(tiny.labelled_items(6), "1000ev", classifier=clf, learn_online=True)
    assert session.stats().unknown_labels == 2
    assert session.classifier.provenance["learned_online"] == 4


# --- live: silence, loss, clocks that start anew, and being behind


def run_live(items, policy, **options):
    session = Session(MODEL, EmitPolicy.parse(policy), **options)
    return [e for item in items for e in session.process(item)], session


@pytest.mark.parametrize("policy", ["10ms", "7ev", "event", "auto"])
def test_ticks_read_what_decays_and_then_nothing(policy):
    batch = tiny.steady(10_000, 20_000, 50)
    packet = replace(tiny.packet(batch), source_ns=7)
    ticks = [Watermark("", t) for t in range(20_000, 5 * WINDOW, 3_000)]
    emissions, session = run_live([packet, *ticks], policy)
    of_events = len(run_live([packet], policy)[0])
    assert [e.source_ns for e in emissions] == [7] * of_events + [0] * (len(emissions) - of_events)
    every = 10_000 if policy == "10ms" else tiny.GEOMETRY.bin_us
    silent = [e for e in emissions if e.t_us > 20_000]
    assert (
        times(silent)
        == [t for t in range(every, 20_000 + WINDOW + every, every) if t > 20_000][: len(silent)]
    )
    for e in silent:
        expected = MODEL.encode(batch, tiny.RESOLUTION, origin_us=0, t_us=e.t_us - 1)
        assert np.array_equal(e.features, expected)
    assert not silent[-1].features.any()
    assert session.stats().events == 50
    # One tick of hours says the same, and later events are not late.
    far, session = run_live([tiny.packet(batch), Watermark("", 10**12)], policy)
    assert times(far) == times(emissions)
    more = list(session.process(tiny.packet(tiny.steady(WINDOW, WINDOW + 100, 20))))
    assert session.stats().late == 0
    assert times(far + more) == sorted(times(far + more))


def test_a_tick_ends_a_sample():
    label = Label(10_000, 80_000, "cat")
    items = [label, tiny.packet(tiny.steady(10_000, 50_000, 100))]
    emissions, session = run_live([*items, Watermark("", 89_999)], "1000ev")
    assert not any(e.final for e in emissions)
    final = next(iter(session.process(Watermark("", 90_000))))
    assert (final.final, final.t_us) == (True, 90_000)
    assert np.array_equal(
        final.features, run_live([*items, Label(500_000, 1, "x")], "1000ev")[0][-1].features
    )
    assert list(session.process(Watermark("", 10**9))) == []


def test_ticks_before_any_event_say_nothing():
    assert run_live([Watermark("", 10**9)], "10ms")[0] == []


@pytest.mark.parametrize("policy", ["10ms", "7ev", "auto"])
def test_a_loss_marks_readings_until_it_has_left_the_window(policy):
    items = [tiny.packet(tiny.steady(t, t + 10_000, 40, seed=t)) for t in range(0, 500_000, 10_000)]
    items[10] = replace(items[10], lost=3)
    emissions, session = run_live(items, policy)
    first = int(items[10].events["t"][0])
    for e in emissions:
        assert e.incomplete == (int(items[9].events["t"][-1]) < e.t_us <= first + WINDOW) or e.t_us <= first
    assert any(e.incomplete for e in emissions)
    assert session.stats().incomplete == sum(e.incomplete for e in emissions) < len(emissions) / 2


def test_another_epoch_is_an_empty_window():
    before, after = tiny.steady(10**9, 10**9 + 1000, 50), tiny.steady(500, 20_000, 30, seed=1)
    items = [tiny.packet(before), replace(tiny.packet(after), epoch=1)]
    emissions, session = run_live(items, "15ev")
    assert session.stats().late == 0
    assert emissions[-1].t_us == int(after["t"][-1]) + 1
    assert np.array_equal(emissions[-1].features, MODEL.encode(after, tiny.RESOLUTION, origin_us=0))
    assert emissions[-1].incomplete
    assert not emissions[0].incomplete


@pytest.mark.parametrize("policy", ["event", "7ev", "10ms"])
def test_who_is_behind_reads_less_and_loses_nothing(policy):
    items = [tiny.packet(tiny.steady(t, t + 50_000, 400, seed=t)) for t in range(0, 500_000, 50_000)]
    behind = [False]
    clock = iter(range(10**6))
    session = Session(
        MODEL, EmitPolicy.parse(policy), clock=lambda: float(next(clock)), is_behind=lambda _: behind[0]
    )
    counts = []
    for i, item in enumerate(items):
        behind[0] = 2 <= i < 8
        counts.append(len(list(session.process(item))))
    assert max(counts[2:8]) <= 1
    assert min(counts[:2] + counts[8:]) >= 4
    last = [*session.process(tiny.packet(tiny.stream([500_000]))), *session.finish()][-1]
    whole = np.concatenate([*(item.events for item in items), tiny.stream([500_000])])
    assert np.array_equal(last.features, MODEL.encode(whole, tiny.RESOLUTION, origin_us=0))
    assert session.stats().events == 4001
    # It can fall behind in the midst of a packet: it asks before every 256 events.
    calls = iter([False] * 2 + [True] * 10**6)
    session = Session(MODEL, EmitPolicy.parse("event"), is_behind=lambda _: next(calls))
    assert len(list(session.process(tiny.packet(tiny.steady(0, 50_000, 800))))) == 2 * 256 + 1
    assert session.stats().events == 800


@pytest.mark.parametrize("policy", ["event", "1ev", "auto"])
def test_an_event_behind_a_silence_does_not_turn_time_back(policy):
    """Emissions in silence said that time had passed; an event before then comes late, and is used."""
    session = Session(MODEL, EmitPolicy.parse(policy))
    before = [
        e
        for item in (tiny.packet(tiny.stream([0, 10])), Watermark("", 60_000))
        for e in session.process(item)
    ]
    after = list(session.process(tiny.packet(tiny.stream([20_000, 49_998]))))
    assert before[-1].t_us == 50_000
    assert after
    assert [e.t_us for e in after] == [50_000] * len(after)
    assert after[-1].n_events == 4


class Resting:
    """A session whose engine notes what it is asked to prepare, and takes 10 s for it."""

    def __init__(self, policy):
        self.asked, self.clock = [], FakeClock()
        self.session = Session(MODEL, EmitPolicy.parse(policy), clock=self.clock, engine=self.engine)
        list(self.session.process(tiny.packet(tiny.stream([1000]))))

    def engine(self, *arguments, **options):
        rest = self

        class Watched(Engine):
            def prepare(self, columns):
                rest.asked.append(columns)
                rest.clock.now += 10.0
                return super().prepare(columns)

        return Watched(*arguments, **options)


def test_looking_ahead_is_bounded_in_columns():
    """A rest takes a fraction of a millisecond, however large the sensor."""
    resting = Resting("event")
    resting.clock.now += 1.0
    resting.session.rest()
    assert resting.asked == [4096]


def test_looking_ahead_takes_half_of_the_time_at_most():
    resting = Resting("10ms")
    resting.session.rest()
    resting.session.rest()
    resting.clock.now += 9.9
    resting.session.rest()
    assert len(resting.asked) == 1
    resting.clock.now += 0.2
    resting.session.rest()
    assert len(resting.asked) == 2


def test_a_session_that_emits_as_often_as_it_can_does_not_look_ahead():
    resting = Resting("auto")
    resting.clock.now += 100.0
    resting.session.rest()
    assert resting.asked == []


@pytest.mark.parametrize("policy", ["10ms", "auto"])
def test_any_number_of_threads_makes_the_same_emissions(policy, monkeypatch):
    monkeypatch.setattr(threads, "WORTH_A_PART", 1)
    monkeypatch.setattr(threads, "WORTH_COUNTING", 0)
    items = [
        tiny.packet(tiny.steady(start, start + 50_000, 2000, seed=start)) for start in (0, 50_000, 100_000)
    ]
    one, _ = run(items, policy)
    three, session = run(items, policy, threads=3)
    assert session._engine._crew.threads == 3
    assert [e.t_us for e in three] == [e.t_us for e in one]
    for mine, yours in zip(three, one, strict=True):
        np.testing.assert_array_equal(mine.features, yours.features)
