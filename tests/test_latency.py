"""Latency: what is timed, what is left out, and every way to ask for it."""

import json
import os
import re
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import tiny
from hdrh.histogram import HdrHistogram
from mcap.writer import Writer
from typer.testing import CliRunner

from streamfeat import cli
from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.errors import InputError
from streamfeat.evaluate.retina import RetinalWords
from streamfeat.evaluate.spiking import FirstSpikes, LeakySpikes
from streamfeat.evaluate.surfaces import AveragedSurfaces, CountImage
from streamfeat.events import make_events
from streamfeat.latency.end_to_end import measure_end_to_end, without_silence
from streamfeat.latency.histogram import PERCENTILES, Latencies, RecentLatencies
from streamfeat.latency.measure import LatencyReport
from streamfeat.latency.others import TIMED, Method, any_layers, any_words, walk_method
from streamfeat.latency.stopwatch import clock_cost_ns, follow_timed, python_clock_cost_ns
from streamfeat.latency.text import spell
from streamfeat.latency.update import call_each, feed_and_read, walk
from streamfeat.messages.cdr import EventPacket
from streamfeat.recordings.reader import Label, Packet, open_recording
from streamfeat.report.machine import Disturbance, describe_machine
from streamfeat.report.pages import Section, Table, write_report
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session

RECORDINGS = Path(__file__).parents[1] / "recordings"
DIGITS, DIGITS_MODEL = RECORDINGS / "digits_test.mcap", RECORDINGS / "digits.safetensors"
MODEL = tiny.encoder(k=3)
QUICK = ["--seconds", "0.2", "--limit-events", "3000", "--warm-up", "500", "--speed", "50"]

needs_bokeh = pytest.mark.skipif(find_spec("bokeh") is None, reason="the extra plot is not installed")
needs_matplotlib = pytest.mark.skipif(
    find_spec("matplotlib") is None, reason="the extra plot is not installed"
)


def digits(n_samples):
    """The first samples of a real recording, as items."""
    items, labels = [], 0
    with open_recording(DIGITS) as recording:
        for item in recording.items():
            labels += isinstance(item, Label)
            if labels > n_samples:
                return items
            items.append(item)
    raise AssertionError("too few samples")


def n_events(items):
    return sum(len(item.events) for item in items if isinstance(item, Packet))


# --- histograms


def test_percentiles_are_those_of_numpy():
    ns = np.random.default_rng(0).lognormal(10, 0.5, 200_000).astype(np.int64)
    latencies = Latencies(ns)
    figures = latencies.figures()
    for percent in PERCENTILES:
        # The histogram keeps three digits, and the two may take neighbours where a rank is no integer.
        assert latencies.percentile(percent) == pytest.approx(np.percentile(ns, percent), rel=2e-3)
        assert figures[f"p{percent:g}_ns"] == latencies.percentile(percent)
    assert figures["n"] == 200_000
    assert figures["mean_ns"] == pytest.approx(ns.mean(), rel=1e-3)
    assert figures["max_ns"] == pytest.approx(ns.max(), rel=1e-3)
    assert figures["p99_to_p50"] == pytest.approx(figures["p99_ns"] / figures["p50_ns"], abs=0.01)
    assert figures["p99.9_to_p50"] == pytest.approx(figures["p99.9_ns"] / figures["p50_ns"], abs=0.01)


def test_weights_count_a_value_several_times():
    values, weights = np.array([10, 2000, 30]), np.array([5, 1, 3])
    assert Latencies(values, weights).figures() == Latencies(np.repeat(values, weights)).figures()


def test_a_percentile_that_n_cannot_tell_is_left_out():
    ns = np.arange(1, 1001)
    assert [Latencies(ns[:999]).percentile(p) for p in (99.0, 99.9)] == [989, None]
    assert Latencies(ns).percentile(99.9) == 999
    assert set(Latencies(ns[:0]).figures().values()) == {0, None}


def test_values_beyond_the_range_count_as_its_ends():
    figures = Latencies(np.array([-5, 0, 10**15])).figures()
    assert figures["n"] == 3
    assert figures["max_ns"] == pytest.approx(60e9, rel=1e-3)


def test_encoded_histograms_can_be_merged():
    ns = np.random.default_rng(1).integers(1, 10**7, 5000)
    parts = [Latencies(part).encode() for part in (ns[:2000], ns[2000:])]
    merged = HdrHistogram(1, 60 * 10**9, 3)
    for part in parts:
        merged.decode_and_add(part)
    assert merged.get_total_count() == 5000
    assert merged.get_value_at_percentile(99) == Latencies(ns).percentile(99)
    assert Latencies.decode(parts[0]).figures() == Latencies(ns[:2000]).figures()


def test_the_curve_goes_through_the_percentiles():
    ns = np.random.default_rng(2).integers(1, 10**6, 20_000)
    latencies = Latencies(ns)
    beyond, values = latencies.curve()
    assert beyond[0] == 1
    assert (np.diff(beyond) > 0).all()
    assert (np.diff(values) > 0).all()
    for percent in PERCENTILES:
        step = np.searchsorted(beyond, 100 / (100 - percent), side="right") - 1
        assert values[step] == pytest.approx(latencies.percentile(percent), rel=2e-3)


# --- updates


@pytest.mark.parametrize("look_ahead", [True, False])
def test_a_walk_leaves_features_like_a_plain_engine(look_ahead):
    items = digits(2)
    encoder = Encoder.load(DIGITS_MODEL)
    plain = None
    for item in items:
        if isinstance(item, Label):
            if plain:
                plain.restart(item.start_us)
            origin = item.start_us
        else:
            plain = plain or Engine(encoder, item.resolution, origin_us=origin)
            plain.feed(item.events)
    for way in (walk, call_each):
        found = way(encoder, items, look_ahead=look_ahead, warm_up=100)
        assert np.array_equal(found.features, plain.features())
        assert len(found.ns) == n_events(items) - 100
        assert (found.ns > 0).all()


def test_the_share_of_boundary_events_is_that_counted_by_hand():
    items = digits(3)
    encoder = Encoder.load(DIGITS_MODEL)
    expected, origin = [], None
    for item in items:
        if isinstance(item, Label):
            origin, now = item.start_us, None
            continue
        for t in item.events["t"].tolist():
            bin_index = (t - origin) // encoder.geometry.bin_us
            expected.append(now is not None and bin_index > now)
            now = bin_index if now is None else max(now, bin_index)
    found = walk(encoder, items, look_ahead=True, warm_up=0)
    assert found.begins_bin.tolist() == expected
    assert 5 < sum(expected) < 40
    assert np.array_equal(walk(encoder, items, look_ahead=True, warm_up=777).begins_bin, expected[777:])


def test_a_boundary_is_no_event_that_is_late_or_rejected():
    bin_us = MODEL.geometry.bin_us
    t = [10, 20, bin_us, 30, 5 * bin_us, 5 * bin_us + 1, 40, 6 * bin_us]
    events = make_events([1] * 8, [1] * 7 + [999], [1] * 8, t)
    _, begins = follow_timed(Engine(MODEL, tiny.RESOLUTION), events)
    assert np.flatnonzero(begins).tolist() == [2, 4]


def test_another_resolution_starts_another_engine():
    small, large = tiny.steady(0, 9_000, 50), tiny.steady(9_000, 18_000, 50, resolution=(20, 30))
    items = [tiny.packet(small), tiny.packet(large, (20, 30))]
    found = walk(MODEL, items, look_ahead=True, warm_up=0)
    plain = Engine(MODEL, (20, 30))
    plain.feed(large)
    assert np.array_equal(found.features, plain.features())
    assert found.t_us.tolist() == [*small["t"], *large["t"]]


def test_a_walk_ends_when_it_is_told_to():
    asked = []

    def goes(done):
        asked.append(done)
        return done < 600

    found = walk(MODEL, [tiny.packet(tiny.steady(0, 90_000, 5000))], look_ahead=True, warm_up=100, goes=goes)
    assert len(found.ns) == asked[-1] - 100
    assert 600 <= asked[-1] < 1200


@pytest.mark.parametrize("emit", ["1000ev", "10ms", "auto"])
def test_a_policy_is_fed_and_read_as_a_session_does(emit):
    items = digits(2)
    encoder = Encoder.load(DIGITS_MODEL)
    found = feed_and_read(encoder, items, EmitPolicy.parse(emit), warm_up=0)
    assert found.batch_events.sum() == n_events(items)
    assert (found.batch_ns > 0).all()
    assert (found.emission_ns > 0).all()
    if emit != "auto":  # which depends on the clock
        session = Session(encoder, EmitPolicy.parse(emit))
        assert len(found.emission_ns) == sum(len(list(session.process(item))) for item in items)
    later = feed_and_read(encoder, items, EmitPolicy.parse(emit), warm_up=n_events(items) - 10)
    assert 10 <= later.batch_events.sum() < n_events(items)


def test_the_clock_has_a_cost():
    assert 1 < clock_cost_ns() < 100_000
    assert 1 < python_clock_cost_ns() < 100_000


# --- end to end


@pytest.mark.parametrize("emit", ["event", "20ms", "100ev", "auto"])
def test_a_hop_counts_each_emission_once(emit):
    items = tiny.labelled_items(3)
    took = measure_end_to_end(
        MODEL, items, EmitPolicy.parse(emit), speed=20.0, look_ahead=True, warm_up=items[:2]
    )
    session = Session(MODEL, EmitPolicy.parse(emit))
    # Nothing comes after the last sample to end it, so its final emission is not part of the stream.
    expected = sum(
        len(list(session.process(item))) for item in without_silence(items, MODEL.geometry.window_us)
    )
    if emit == "auto":
        assert 2 <= len(took) <= 40
    else:
        assert len(took) == expected
    assert (took > 0).all()
    assert (took < 10e9).all()


def test_a_hop_says_how_far_it_falls_behind():
    # One second of the stream in a millisecond: everything is due at once, and the last emission waits
    # for all others.
    items = [tiny.packet(tiny.steady(0, 1_000_000, 20_000))]
    took = measure_end_to_end(MODEL, items, EmitPolicy.parse("event"), speed=1000.0, look_ahead=True)
    assert len(took) == 20_000
    assert took[-1000:].mean() > 2 * took[:1000].mean()


def test_a_hop_that_is_stopped_leaves_out_what_was_not_due():
    asked = []

    def goes():
        asked.append(1)
        return len(asked) < 4

    items = [tiny.packet(tiny.steady(start, start + 1_000, 10)) for start in range(0, 60_000_000, 100_000)]
    took = measure_end_to_end(MODEL, items, EmitPolicy.parse("event"), speed=1.0, look_ahead=True, goes=goes)
    assert 10 <= len(took) < 100
    assert (took > 0).all()


def test_silence_between_samples_is_cut_and_nothing_else_changes():
    items = tiny.labelled_items(4, gap_us=5_000_000)
    cut = list(without_silence(items, 100_000))
    labels = [item for item in cut if isinstance(item, Label)]
    assert np.diff([label.start_us for label in labels]).tolist() == [180_000] * 3
    for before, after in zip(items, cut, strict=True):
        if isinstance(before, Packet):
            shift = before.events["t"] - after.events["t"]
            assert len(set(shift.tolist())) == 1
            assert np.array_equal(before.events[["x", "y", "p"]], after.events[["x", "y", "p"]])
    policy = EmitPolicy.parse("1000ev")
    pairs = [
        [e for item in some for e in session.process(item)]
        for some, session in ((items, Session(MODEL, policy)), (cut, Session(MODEL, policy)))
    ]
    for one, two in zip(*pairs, strict=True):
        assert np.array_equal(one.features, two.features)


# --- words


@pytest.mark.parametrize(
    ("ns", "text"),
    [
        (None, "-"),
        (7, "0.007"),
        (999, "0.999"),
        (1234, "1.23"),
        (12_345, "12.3"),
        (123_456, "123"),
        (9_999_000, "9,999"),
        (10_000_000, "10.0ms"),
        (543_210_000, "543ms"),
        (10_460_594_000, "10.5s"),
    ],
)
def test_times_are_short(ns, text):
    assert spell(ns) == text


def test_the_machine_is_described():
    machine = describe_machine()
    assert machine["cores"] >= 1
    assert all(machine[name] for name in ("cpu", "system", "python", "numba", "numpy", "streamfeat"))
    disturbance = Disturbance()
    assert disturbance.steal_share() is None or 0 <= disturbance.steal_share() <= 1
    assert disturbance.preemptions() >= 0


# --- the command


@pytest.fixture
def run(monkeypatch, capfd):
    """Run the command in this process, through `main`: exit status, standard output and error."""

    def call(*arguments):
        monkeypatch.setenv("COLUMNS", "120")
        monkeypatch.setattr(sys, "argv", ["streamfeat", "latency", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as end:
            cli.main()
        captured = capfd.readouterr()
        return end.value.code or 0, captured.out, captured.err

    return call


def write_empty(path):
    """A recording of one packet without events."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema(EventPacket.SCHEMA_NAME, "ros2msg", b"")
        channel = writer.register_channel("/events", "cdr", schema)
        writer.add_message(channel, 0, EventPacket(0, "", 12, 16, 0, 0, "mono", False, b"").to_cdr(), 0)
        writer.finish()


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Tiny models and recordings, good and bad."""
    home = tmp_path_factory.mktemp("latency")
    for formulation in ("direct", "inverse"):
        tiny.encoder(formulation, "soft", k=3).save(home / f"{formulation}.safetensors")
    tiny.write_digits(home / "digits.mcap", 8, n_held_out=2)
    tiny.write_items(home / "short.mcap", [tiny.packet(tiny.steady(0, 90_000, 300))])
    write_empty(home / "empty.mcap")
    (home / "mine.html").write_text("mine")
    (home / "folder.png").mkdir()
    return home


def test_help_shows_an_example():
    result = CliRunner().invoke(cli.app, ["latency", "--help"])
    assert result.exit_code == 0
    assert "Example: streamfeat latency " in result.stdout


def test_a_row_for_each_model_policy_and_part(run, home):
    models = ["-m", home / "direct.safetensors", "-m", home / "inverse.safetensors"]
    emits = ["--emit", "event", "--emit", "10ms", "--emit", "auto"]
    status, out, _ = run(home / "digits.mcap", *models, *emits, *QUICK, "--json")
    said = json.loads(out)
    parts = {"event": ["update", "bin boundary", "from Python", "end to end"]}
    expected = [
        (model, emit, what)
        for model in ("direct", "inverse")
        for emit in ("event", "10ms", "auto")
        for what in parts.get(emit, ["ingest", "emission", "end to end"])
    ]
    assert [(row["model"], row["emit"], row["what"]) for row in said["rows"]] == expected
    assert (status, said["interrupted"], said["warm_up_events"]) == (0, False, 500)
    assert [model["formulation"] for model in said["models"]] == ["direct", "inverse"]
    assert said["clock_ns"] > 0
    for row in said["rows"]:
        assert row["n"] > 0
        decoded = HdrHistogram.decode(row["histogram"])
        assert decoded.get_total_count() == row["n"]
        assert decoded.get_max_value() == row["max_ns"]
        for percent in PERCENTILES:
            if row[f"p{percent:g}_ns"] is not None:
                assert decoded.get_value_at_percentile(percent) == row[f"p{percent:g}_ns"]
        if row["what"] == "update":
            boundary = next(
                r for r in said["rows"] if (r["model"], r["what"]) == (row["model"], "bin boundary")
            )
            assert row["boundary_share"] == pytest.approx(boundary["n"] / row["n"], abs=1e-6)


@pytest.mark.parametrize("steal", [None, 0.05, 0.31])
def test_a_real_recording_with_its_model(run, monkeypatch, steal):
    monkeypatch.setattr(Disturbance, "steal_share", lambda self: steal)
    status, out, err = run(DIGITS, "-m", DIGITS_MODEL, "--emit", "event", *QUICK)
    assert status == 0
    assert err.startswith("steal: 31 % of the processor time") if steal == 0.31 else err == ""
    assert out.startswith("digits: direct, split, K = 100")
    assert re.search(r"event +update +[1-9][\d,]* ", out)
    assert "the first 500 events of each measurement" in " ".join(out.split())
    assert "% of events began a bin, with look-ahead" in out
    assert "Reading the clock costs" in out


def test_one_split_without_look_ahead(run, home):
    arguments = [
        "--split",
        "test",
        "--emit",
        "event",
        "--no-look-ahead",
        *QUICK,
        "--warm-up",
        "0",
        "--seconds",
        "1",
    ]
    words = [home / "digits.mcap", "-m", home / "direct.safetensors", *arguments, "--json", "--verbose"]
    status, out, err = run(*words)
    assert "compiling 1/1" in err  # steps are lines, and not among the JSON
    said = json.loads(out)
    with open_recording(home / "digits.mcap") as recording:
        events = sum(len(sample.events) for sample in recording.samples() if sample.label.split == "test")
    assert (status, said["look_ahead"]) == (0, False)
    assert said["rows"][0]["n"] == min(events, 3000)


OTHERS = {
    "hats": lambda columns, events, resolution: AveragedSurfaces(resolution).encode(events, resolution),
    "hots": lambda columns, events, resolution: any_layers().encode(events, resolution),
    "dart": lambda columns, events, resolution: RetinalWords(any_words()).encode(events, resolution),
    "hfirst": lambda columns, events, resolution: FirstSpikes().counter(resolution)(*columns).ravel(),
    "gabor-snn": lambda columns, events, resolution: LeakySpikes().counter(resolution)(*columns).ravel(),
    "counts": lambda columns, events, resolution: CountImage().encode(events, resolution),
}


@pytest.mark.parametrize("name", TIMED)
def test_what_is_timed_of_a_method_is_what_its_features_are_made_of(name):
    events, resolution = tiny.steady(0, 40_000, 4_000, resolution=(20, 30)), (20, 30)
    live = TIMED[name][1](resolution)
    columns = [events[field].astype(np.int64) for field in "xypt"]
    columns[3] -= columns[3].min()
    took = [live.timed([column[part] for column in columns]) for part in np.array_split(np.arange(4_000), 4)]
    assert sum(map(len, took)) == 4_000
    assert min(part.min() for part in took) > 0
    expected = OTHERS[name](columns, events, resolution)
    assert expected.any()
    np.testing.assert_allclose(live.features(), expected, rtol=1e-6)


def test_a_method_is_walked_sample_by_sample_and_warms_up():
    items = [*tiny.labelled_items(2), Label(5_000_000, 90_000, "cat")]
    asked = []
    took = walk_method(Method("counts"), items, warm_up=100, goes=lambda done: asked.append(done) or True)
    assert len(took) == n_events(items) - 100
    assert asked[-1] == n_events(items)
    with pytest.raises(InputError, match="choose from hats, hots"):
        Method("sift")


def test_updates_of_others_stand_beside_ours(run, home):
    words = [home / "digits.mcap", "-m", home / "direct.safetensors", "--emit", "10ms", "--method", "counts"]
    status, out, err = run(*words, *QUICK, "--json", "--method", "hfirst")
    said = json.loads(out)
    assert status == 0, err
    rows = [(row["model"], row["emit"], row["what"]) for row in said["rows"]]
    assert rows[-2:] == [("counts", "event", "update"), ("hfirst", "event", "update")]
    assert [model["model"] for model in said["models"]] == ["direct", "counts", "hfirst"]
    assert all(row["n"] > 0 and row["histogram"] for row in said["rows"][-2:])
    assert "HFirst, layers S1 and C1" in run(*words, *QUICK, "--method", "hfirst")[1]


REFUSALS = {
    "shorter than its warm-up": (["short.mcap"], "300 events are not more than the warm-up of 500"),
    "without events": (["empty.mcap"], "has no events"),
    "unknown policy": (["digits.mcap", "--emit", "often"], "--emit 'often' is not understood"),
    "unknown suffix": (
        ["digits.mcap", "--plot", "{home}/out.pdf"],
        "out.pdf: --plot can draw .html and .png",
    ),
    "missing folder": (["digits.mcap", "--plot", "{home}/no/out.png"], "there is no folder"),
    "folder": (["digits.mcap", "--plot", "{home}/folder.png", "--overwrite"], "is a folder"),
    "existing picture": (["digits.mcap", "--plot", "{home}/mine.html"], "exists already"),
    "unknown split": (["digits.mcap", "--split", "moon"], "no samples of split 'moon'"),
    "missing recording": (["missing.mcap"], "cannot be opened"),
    "missing model": (["digits.mcap", "-m", "{home}/missing"], "no such file"),
    "no time": (["digits.mcap", "--seconds", "0"], "--seconds 0 is not possible"),
    "no pace": (["digits.mcap", "--speed", "nan"], "--speed nan is not possible"),
    "no events to count": (["digits.mcap", "--limit-events", "0"], "--limit-events 0"),
    "less than no warm-up": (["digits.mcap", "--warm-up", "-1"], "--warm-up -1"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_refusals(run, home, name):
    (recording, *more), reason = REFUSALS[name]
    before = sorted(path.name for path in home.iterdir())
    arguments = [home / recording, "-m", home / "direct.safetensors", *QUICK]
    status, out, err = run(*arguments, *(part.format(home=home) for part in more))
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert err.startswith("error: ")
    assert reason in err
    assert sorted(path.name for path in home.iterdir()) == before


@pytest.mark.parametrize(("suffix", "library"), [("html", "bokeh"), ("png", "matplotlib")])
def test_a_missing_extra_is_said_before_anything_is_measured(run, home, monkeypatch, suffix, library):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    arguments = ["-m", home / "direct.safetensors", "--plot", home / f"out.{suffix}"]
    status, out, err = run(home / "missing.mcap", *arguments)
    assert (status, out) == (2, "")
    assert library in err
    assert "pip install 'streamfeat[plot]'" in err


def test_an_interrupted_measurement_shows_what_it_has(home):
    code = "from streamfeat.cli import main; main()"
    arguments = ["latency", home / "digits.mcap", "-m", home / "direct.safetensors", "--warm-up", "100"]
    arguments += ["--emit", "10ms", "--emit", "event", "--seconds", "300", "--speed", "0.01", "--json"]
    notice = "import streamfeat.latency.measure as m; inner = m.measure_end_to_end\n"
    notice += "m.measure_end_to_end = lambda *a, **k: (print('hop', flush=True), inner(*a, **k))[1]\n"
    with subprocess.Popen(
        [sys.executable, "-c", notice + code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ,
    ) as process:
        assert process.stdout.readline() == "hop\n"
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "")
    said = json.loads(out)
    assert said["interrupted"]
    assert [(row["emit"], row["what"]) for row in said["rows"]][:2] == [
        ("10ms", "ingest"),
        ("10ms", "emission"),
    ]
    assert {row["emit"] for row in said["rows"]} == {"10ms"}
    assert all(row["n"] for row in said["rows"])


# --- pictures


@pytest.fixture(scope="module")
def report(home):
    models = [home / "direct.safetensors", home / "inverse.safetensors"]
    found = LatencyReport(
        home / "digits.mcap",
        models,
        ["event", "10ms"],
        warm_up=500,
        limit_events=3000,
        seconds=0.2,
        speed=50.0,
    )
    found.compile()
    found.run(lambda step, done, total, remark: None, lambda: False)
    return found


@needs_bokeh
def test_a_page_needs_nothing_else(report, tmp_path):
    from streamfeat.latency.picture import draw

    path = tmp_path / "out.html"
    path.write_text("old")
    draw(path, report)
    page = path.read_text()
    assert len(page) < 5_000_000
    assert page.count("<h2>") == 3
    assert "direct, event, update" in page
    assert "inverse, 10ms, end to end" in page
    assert not re.search(r'<(script|link|img)[^>]+(src|href)="?http', page)
    assert page.count("Bokeh = factory()") <= 1
    assert list(tmp_path.iterdir()) == [path]


@needs_matplotlib
def test_a_picture_is_drawn(report, tmp_path):
    from matplotlib.image import imread

    from streamfeat.latency.picture import draw

    path = tmp_path / "out.png"
    draw(path, report)
    picture = imread(path)
    # One panel for the curves, one for each model.
    assert picture.shape[:2] == (1320, 1320)
    assert picture[..., :3].std() > 0.05
    assert list(tmp_path.iterdir()) == [path]


@needs_bokeh
def test_text_in_a_page_is_text(tmp_path):
    path = tmp_path / "page.html"
    table = Table(["<name>", "n"], [["a & b", "1"]], [False, True])
    write_report(path, "<title>", [Section("<section>", ["<b>bold</b>", table])])
    page = path.read_text()
    for text in ("&lt;title&gt;", "&lt;section&gt;", "&lt;b&gt;bold&lt;/b&gt;", "&lt;name&gt;", "a &amp; b"):
        assert text in page
    assert '<td class="number">1</td>' in page
    assert len(page) < 10_000  # without figures there is nothing to draw with


@needs_bokeh
def test_a_page_is_not_replaced_by_half_of_one(tmp_path):
    path = tmp_path / "page.html"
    path.write_text("old")
    with pytest.raises(ValueError, match="zip"):
        write_report(path, "title", [Section("section", [Table(["one", "two"], [["only one"]])])])
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(InputError, match="cannot write there"):
        write_report(tmp_path / "no" / "page.html", "title", [])


def test_recent_latencies_are_those_of_the_latest_values():
    recent = RecentLatencies()
    assert recent.percentiles(50, 99) == []
    for i in range(1000):
        recent.add(1_000 * (i + 1))
    (first, half), (second, most) = recent.percentiles(50, 99)
    assert (first, second) == ("p50", "p99")
    assert half == pytest.approx(500e-6, rel=2e-3)
    assert most == pytest.approx(990e-6, rel=2e-3)
    for _ in range(140_000):
        recent.add(5e9)
    assert recent.percentiles(1)[0][1] == pytest.approx(5.0, rel=1e-3)  # the thousand are forgotten
    recent.add(-1)
    recent.add(1e18)
    assert recent.percentiles(100)[0][1] == pytest.approx(60.0, rel=1e-3)
