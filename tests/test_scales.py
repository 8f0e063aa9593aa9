"""Several scales in one engine: the invariants, the file, snapshots, small sensors, commands."""

import asyncio
import json
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest
import test_state
import tiny
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import EXACT_KINDS, LASSO_KINDS, Case, cases, fed_in_every_way, mixed_steps, streams

from streamfeat.classify.classifier import Classifier
from streamfeat.classify.features import EventFeatures
from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.errors import InputError
from streamfeat.files.safetensors_file import read_safetensors, write_safetensors
from streamfeat.learn.fit import learn_encoder
from streamfeat.learn.settings import PRESETS, Setting
from streamfeat.recordings.reader import open_recording
from streamfeat.stream.replay import replay

EXAMPLES = 25
ids = "-".join


pytestmark = pytest.mark.usefixtures("every_update_is_worth_a_thread")


@dataclass(frozen=True)
class ScaledCase(Case):
    """A case with further scales."""

    further: tuple[Geometry, ...] = ()
    kinds: tuple[tuple[str, str], ...] = ()

    @cached_property
    def encoder(self):
        first = random_encoder(
            self.seed,
            self.geometry,
            self.n_filters,
            self.formulation,
            self.encoding,
            threshold=self.threshold,
        )
        others = [
            random_encoder(self.seed + i, geometry, 7 + i, *kind, threshold=self.threshold)
            for i, (geometry, kind) in enumerate(zip(self.further, self.kinds, strict=True), 1)
        ]
        return Encoder.side_by_side([first, *others])


@st.composite
def scaled_cases(draw, kind, kinds=EXACT_KINDS):
    case = draw(cases(kind))
    n = draw(st.integers(1, 3))
    further = [
        replace(
            case.geometry,
            patch=draw(st.integers(1, 5)),
            stride=draw(st.integers(1, 4)),
            downsample=draw(st.integers(1, 4)),
            max_count=draw(st.sampled_from([1, 3])),
            n_bins=draw(st.integers(1, case.geometry.n_bins)),
        )
        for _ in range(n)
    ]
    fields = {name: getattr(case, name) for name in Case.__dataclass_fields__}
    return ScaledCase(
        **fields, further=tuple(further), kinds=tuple(draw(st.sampled_from(kinds)) for _ in range(n))
    )


def latest(events, case):
    height, width = case.resolution
    good = (events["x"] < width) & (events["y"] < height) & np.isin(events["p"], (0, 1))
    return int(events["t"][good].max()) if good.any() else None


# 1 split invariance, 2 batch equivalence, 5 policy invariance


@pytest.mark.parametrize("kind", EXACT_KINDS, ids=ids)
@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_features_are_those_of_each_scale_however_it_is_fed_and_read(kind, data):
    case = data.draw(scaled_cases(kind))
    events = data.draw(streams(case))
    origin_us = data.draw(st.integers(-5000, 5000))
    t_us = latest(events, case)
    end = origin_us if t_us is None else t_us
    where = {"origin_us": origin_us, "t_us": end}
    offline = case.encoder.encode(events, case.resolution, **where)
    # By encoders of one scale, which know nothing of others.
    apart = [one.encode(events, case.resolution, **where) for one in case.encoder.scales]
    np.testing.assert_array_equal(offline, np.concatenate(apart), strict=True)
    alone = Engine(case.encoder.scales[0], case.resolution, origin_us=origin_us)
    alone.feed(events)
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    for how, engine in fed_in_every_way(lambda **options: case.engine(origin_us, **options), events, rng):
        np.testing.assert_array_equal(engine.features(), offline, err_msg=how, strict=True)
        mine, first = engine.stats(), alone.stats()
        for name in ("events", "late", "rejected", "saturated", "rolls"):
            assert getattr(mine, name) == getattr(first, name), (how, name)


@pytest.mark.parametrize("kind", LASSO_KINDS, ids=ids)
@settings(max_examples=10)
@given(data=st.data())
def test_an_inverse_scale_has_the_bits_that_it_has_alone(kind, data):
    case = data.draw(scaled_cases(("direct", "split"), (kind,)))
    events = data.draw(streams(case))
    engine = case.engine()
    alone = [Engine(one, case.resolution, threads=case.threads) for one in case.encoder.scales]
    for batch in np.array_split(events, 3):
        engine.feed(batch)
        features = engine.features()
        for place, one in zip(case.encoder.places, alone, strict=True):
            one.feed(batch)
            np.testing.assert_array_equal(features[place], one.features())


@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_features_are_those_of_the_window_after_every_batch(data):
    case = data.draw(scaled_cases(("direct", "split")))
    events = data.draw(streams(case, 30))
    engine = case.engine(look_ahead=data.draw(st.booleans()))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    for n, told in mixed_steps(engine, events, rng):
        offline = case.encoder.encode(
            events[:n], case.resolution, origin_us=0, t_us=0 if told is None else told
        )
        np.testing.assert_array_equal(engine.features(), offline, err_msg=f"after {n} events")


@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_a_trace_holds_what_an_emission_after_each_event_would_have_given(data):
    case = data.draw(scaled_cases(("direct", "soft")))
    events = data.draw(streams(case, 30))
    engine, read = case.engine(look_ahead=True), case.engine()
    features, _, accepted = engine.trace(events)
    assert features.shape == (len(events), case.encoder.n_features)
    classifier = Classifier.untrained(["a", "b", "c"], case.encoder)
    classifier.folded.rows[:] = np.random.default_rng(0).standard_normal(classifier.folded.rows.shape)
    scored = case.engine(look_ahead=True).trace(events, classifier.folded, keep_features=False)
    np.testing.assert_array_equal(scored.scores, classifier.scores(features))
    assert scored.features.shape == (0, case.encoder.n_features)
    for i in range(len(events)):
        read.feed(events[i : i + 1])
        np.testing.assert_array_equal(features[i], read.features())
        assert accepted[i] == read.n_events


# 3 order, 4 nothing lingers


@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_order_does_not_matter_and_nothing_lingers(data):
    case = data.draw(scaled_cases(("direct", "triangle")))
    events = data.draw(streams(case))
    in_window = events[np.abs(events["t"]) < case.geometry.bin_us]
    one, other = case.engine(), case.engine()
    for engine in (one, other):
        engine.advance(0)
    one.feed(in_window)
    other.feed(in_window[::-1].copy())
    # Late ones depend on what moved time, so only those of the bin of 0 and after it are compared.
    if (in_window["t"] >= 0).all():
        np.testing.assert_array_equal(one.features(), other.features())
    one.advance(one.window_us[1] + case.geometry.window_us)
    assert not one.features().any()
    assert one.stats().active_volumes == 0
    one.restart(7)
    fresh = case.engine(7)
    for engine in (one, fresh):
        engine.feed(events)
    np.testing.assert_array_equal(one.features(), fresh.features())


# Snapshots


@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_an_engine_that_is_restored_anywhere_goes_on_with_the_same_bits(data):
    kind = data.draw(st.sampled_from([("direct", "split"), ("inverse", "soft")]))
    case = data.draw(scaled_cases(kind, [*EXACT_KINDS, *LASSO_KINDS]))
    events = data.draw(streams(case))
    place = data.draw(st.integers(0, len(events)))
    engine, other = case.engine(5), case.engine()
    engine.feed(events[:place])
    other.feed(events)
    other.restore(engine.snapshot())
    for batch in np.array_split(events[place:], 2):
        for one in (engine, other):
            one.feed(batch)
        assert engine.features().tobytes() == other.features().tobytes()
    mine, theirs = engine.stats(), other.stats()
    assert replace(mine, encoded_volumes=0) == replace(theirs, encoded_volumes=0)


GEOMETRY = Geometry(patch=4, stride=2, n_bins=3, bin_us=1000)
SMALL = replace(GEOMETRY, patch=3, downsample=2)
BOTH = Encoder.side_by_side([tiny.encoder(geometry=GEOMETRY), tiny.encoder(geometry=SMALL, k=6, seed=1)])


def test_a_snapshot_of_other_scales_is_refused_and_changes_nothing():
    engine = Engine(BOTH, (12, 16))
    engine.feed(tiny.stream(range(0, 3000, 50)))
    before, good = engine.features(), engine.snapshot()
    (further,) = good.further
    for bad, reason in (
        (replace(good, further=()), "0 further scales, this engine has 1"),
        (replace(good, further=(further, further)), "2 further scales"),
        (replace(good, further=(replace(further, bin=further.bin + 1),)), "at different times"),
        (replace(good, further=(replace(further, fingerprint="a" * 64),)), "of encoder aaaa"),
        (replace(good, further=(replace(further, counts=good.counts),)), "holds counts"),
    ):
        with pytest.raises(InputError, match=reason):
            engine.restore(bad)
        assert engine.features().tobytes() == before.tobytes()
    engine.restore(good)
    assert engine.features().tobytes() == before.tobytes()


@pytest.mark.parametrize("resolution", [(5, 16), (3, 16), (1, 1)])
def test_a_sensor_smaller_than_a_volume_has_features_of_every_scale(resolution):
    events = tiny.stream(range(0, 3000, 50), resolution=resolution)
    engine = Engine(BOTH, resolution)
    engine.feed(events)
    features = engine.features()
    np.testing.assert_array_equal(features, BOTH.encode(events, resolution, origin_us=0))
    assert all(features[place].any() for place in BOTH.places)


# The encoder and its file


def test_scales_that_do_not_go_together_are_refused():
    one = tiny.encoder(geometry=GEOMETRY)
    longer = tiny.encoder(geometry=replace(GEOMETRY, n_bins=4))
    slower = tiny.encoder(geometry=replace(GEOMETRY, bin_us=1001))
    for scales, reason in (
        ([], "0 scales are not possible"),
        ([one] * 9, "9 scales are not possible"),
        ([one, longer], "put the scale with the longest window first"),
        ([one, slower], "take 1001 us, those of the first 1000 us"),
        ([one, BOTH], "cannot have several scales itself"),
    ):
        with pytest.raises(InputError, match=reason):
            Encoder.side_by_side(scales)
    alone = Encoder.side_by_side([one])
    assert alone.fingerprint == one.fingerprint
    assert alone.scales == (alone,)


def test_a_file_carries_every_scale(tmp_path):
    BOTH.save(tmp_path / "both")
    found = Encoder.load(tmp_path / "both")
    assert found.fingerprint == BOTH.fingerprint
    assert len(found.scales) == 2
    events = tiny.stream(range(0, 3000, 50))
    assert found.encode(events, (12, 16)).tobytes() == BOTH.encode(events, (12, 16)).tobytes()
    first = BOTH.scales[0]
    assert first.fingerprint not in (BOTH.fingerprint, BOTH.scales[1].fingerprint)
    first.save(tmp_path / "one")
    # The file of one scale is what it was.
    assert read_safetensors(tmp_path / "one", "streamfeat-encoder", 1, 2)[1]["format"] == "streamfeat-encoder"


def test_a_damaged_file_of_scales_is_refused_in_one_line(tmp_path):
    BOTH.save(tmp_path / "both")
    arrays, header = read_safetensors(tmp_path / "both", "streamfeat-scales", 1, 2)
    scales = header["scales"]
    for bad_arrays, bad_header in (
        (arrays, {"scales": None}),
        (arrays, {"scales": scales[:1]}),
        (arrays, {"scales": scales * 5}),
        (arrays, {"scales": [scales[0], 7]}),
        (arrays, {}),
        ({k: v for k, v in arrays.items() if k != "1.columns"}, {"scales": scales}),
        (arrays, {"scales": scales[::-1]}),
        ({k: v * np.nan if k == "1.filters" else v for k, v in arrays.items()}, {"scales": scales}),
    ):
        write_safetensors(tmp_path / "bad", "streamfeat-scales", 2, bad_arrays, bad_header)
        with pytest.raises(InputError) as caught:
            Encoder.load(tmp_path / "bad")
        assert "not a usable model" in str(caught.value)
        assert "\n" not in str(caught.value)


def test_features_of_scales_have_names_of_their_own():
    names = EventFeatures(BOTH).get_feature_names_out()
    assert len(set(names)) == len(names) == BOTH.n_features
    assert names[0] == "cell_0_0_0_pos"
    assert names[BOTH.places[1].start] == "scale_2_cell_0_0_0_pos"


# Settings and learning


def test_scales_are_read_from_their_text():
    setting = Setting(scales="8@2 + 10/4@3:2", volumes=2000)
    first, second, third = setting.each
    assert (first.patch, first.scales) == (12, "none")
    assert (second.patch, second.stride, second.downsample, second.bins) == (8, 2, 2, 3)
    assert (third.patch, third.stride, third.downsample, third.bins) == (10, 4, 3, 2)
    assert [one.patch for one in Setting(**PRESETS["accurate"]).each] == [12, 8, 12]
    for text in ("8x2", "", "8@", "8+", "+", "a", "8@2@3", "8:4", "99999"):
        with pytest.raises(InputError, match="scale"):
            Setting(scales=text, volumes=2000)


LEARN = {"filters": 6, "patch": 6, "stride": 6, "bins": 2, "volumes": 300, "iterations": 2, "max_count": 2}


def test_each_scale_is_learned_as_if_it_was_alone(tmp_path):
    path = tiny.write_digits(tmp_path / "digits.mcap", 20)
    with open_recording(path) as recording:
        both = learn_encoder([recording], Setting(**LEARN, scales="5/3@2"))
        second = learn_encoder([recording], Setting(**LEARN | {"patch": 5, "stride": 3, "downsample": 2}))
        assert [one.geometry.patch for one in both.scales] == [6, 5]
        assert both.scales[1].fingerprint == second.fingerprint
        with pytest.raises(InputError, match="several scales cannot be gone on from"):
            learn_encoder([recording], Setting(**LEARN), resume=both)


def test_ctrl_c_while_scales_are_learned_ends_all(tmp_path):
    path = tiny.write_digits(tmp_path / "digits.mcap", 20)

    def interrupt(step, done, total, remark):
        if step == "learning" and done == 2:
            raise KeyboardInterrupt

    with open_recording(path) as recording, pytest.raises(KeyboardInterrupt):
        learn_encoder([recording], Setting(**LEARN | {"iterations": 5}, scales="5/3@2"), report=interrupt)


# Commands

OPTIONS = [f"--{name.replace('_', '-')}={value}" for name, value in LEARN.items()]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scales")
    tiny.write_digits(folder / "digits.mcap", 60, n_held_out=20)
    with open_recording(folder / "digits.mcap") as recording:
        learn_encoder([recording], Setting(**LEARN, scales="5/3@2+4@3")).save(folder / "model")
    return folder


def test_learn_writes_all_scales_and_says_so(run, home):
    said = run(
        "learn", home / "digits.mcap", *OPTIONS, "--scales", "5/3@2+4@3", "-o", home / "m", "--json"
    ).json
    assert said["scales"] == 3
    assert said["features"] == 3 * 6 * 8
    assert Encoder.load(home / "m").fingerprint == Encoder.load(home / "model").fingerprint


@pytest.mark.parametrize("emit", ["event", "1000ev", "10ms"])
@pytest.mark.parametrize("kernel", ["linear", "rbf"])
def test_a_stream_is_classified_as_its_windows_are(run, home, emit, kernel):
    files = ["-m", home / "model", "-c", home / kernel]
    if not (home / kernel).exists():
        run("train", home / "digits.mcap", *files[:2], "-o", home / kernel, "--kernel", kernel)
    said = run("replay", home / "digits.mcap", *files, "--emit", emit, "--split", "test", "--json").json
    assert said["samples"] == 20
    if emit != "event" or kernel == "linear":
        trained = run(
            "train", home / "digits.mcap", *files[:2], "-o", home / "again", "--overwrite", "--json",
            "--kernel", kernel,
        ).json  # fmt: skip
        assert said["correct"] / 20 == pytest.approx(trained["held_out_accuracy"])


def test_the_features_of_a_stream_are_those_of_its_samples(home):
    encoder = Encoder.load(home / "model")
    with open_recording(home / "digits.mcap") as recording:
        wanted = EventFeatures(encoder).transform(recording.samples())
    stream = replay(home / "digits.mcap", home / "model", emit="50ms")

    async def collected():
        return [emission.features async for emission in stream if emission.final]

    found = np.stack(asyncio.run(collected()))
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("policy", ["event", "10ms"])
def test_the_state_of_a_listener_carries_every_scale(policy, tmp_path_factory, monkeypatch):
    coarse = replace(tiny.GEOMETRY, patch=3, downsample=2)
    scales = [tiny.encoder(), tiny.encoder(encoding="soft", geometry=coarse)]
    monkeypatch.setattr(test_state, "MODEL", Encoder.side_by_side(scales))
    check = test_state.test_sessions_that_are_restored_anywhere_go_on_with_the_same_bits.hypothesis.inner_test
    for seed in range(12):
        check(policy, seed, tmp_path_factory)


def test_latency_measures_all_scales_together(run, home):
    said = run(
        "latency", home / "digits.mcap", "-m", home / "model", "--emit", "event", "--seconds", 0.1,
        "--limit-events", 300, "--warm-up", 50, "--json",
    ).json  # fmt: skip
    assert said["models"][0]["scales"] == 3
    assert any(row["what"] == "update" for row in said["rows"])


def test_evaluate_compares_one_scale_with_several(run, home):
    said = run(
        "evaluate", home / "digits.mcap", *OPTIONS, "--preset", "accurate", "--scales", "5@2",
        "--method", "direct", "--method", "kmeans", "--sweep", "scales=none,4@2", "--sweep", "mirror=no",
        "--early-samples", 0, "--json",
    ).json  # fmt: skip
    rows = {(row["method"], row["swept"], row["setting"]["scales"]): row for row in said["rows"]}
    assert rows["direct", "", "5@2"]["setting"]["kernel"] == "rbf"
    assert rows["direct", "", "5@2"]["setting"]["mirror"] is True
    assert rows["direct", "mirror", "5@2"]["setting"]["mirror"] is False
    assert rows["direct", "", "5@2"]["features"] == 2 * rows["direct", "scales", "none"]["features"]
    assert rows["kmeans", "scales", "4@2"]["features"] == rows["kmeans", "", "5@2"]["features"]
    plain = run(
        "evaluate", home / "digits.mcap", *OPTIONS, "--preset", "accurate", "--kernel", "linear", "--method",
        "direct", "--scales", "none", "--early-samples", 0, "--json",
    ).json  # fmt: skip
    assert plain["rows"][0]["setting"]["kernel"] == "linear"
    assert json.dumps(plain["rows"][0]["setting"]["mirror"]) == "true"
