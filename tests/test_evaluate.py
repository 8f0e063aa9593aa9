"""Evaluation: splits, baselines, scores, runs that go on after an interruption, and how all is shown."""

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
import tiny
from typer.testing import CliRunner

from streamfeat import cli
from streamfeat.classify.classifier import Classifier, train_classifier
from streamfeat.classify.online import OnlineClassifier
from streamfeat.errors import InputError
from streamfeat.evaluate import cell as cell_module
from streamfeat.evaluate import published, scores
from streamfeat.evaluate.methods import make_features
from streamfeat.evaluate.page import tiled
from streamfeat.evaluate.plan import METHODS, Cell, Trial, parse_sweep, plan_cells
from streamfeat.evaluate.retina import RetinalWords
from streamfeat.evaluate.run import StateFile, evaluate, state_path
from streamfeat.evaluate.spiking import FirstSpikes, LeakySpikes, gabor_filters
from streamfeat.evaluate.splits import DataSet, Fold
from streamfeat.evaluate.surfaces import AveragedSurfaces, CountImage, SurfaceHistogram, SurfaceLayer
from streamfeat.events import make_events
from streamfeat.learn.chunks import ChunkedVolumes
from streamfeat.learn.initial import random_filters, spherical_means
from streamfeat.learn.volumes import windows_of
from streamfeat.recordings.reader import HELD_OUT_SPLITS, Label, Packet, Sample, open_recording
from streamfeat.report.machine import PeakMemory

QUICK = ["--patch", "4", "--bins", "2", "--filters", "12", "--volumes", "600", "--iterations", "2"]
BASELINES = [
    CountImage(4),
    AveragedSurfaces((12, 16), cell=5, radius=2),
    SurfaceHistogram(
        (
            SurfaceLayer(np.random.default_rng(0).random((6, 50), np.float32), 2, 2e4),
            SurfaceLayer(np.random.default_rng(1).random((5, 150), np.float32), 2, 2e5),
        )
    ),
    RetinalWords(np.random.default_rng(0).random((6, 84), np.float32), remembered=20),
]

needs_bokeh = pytest.mark.skipif(find_spec("bokeh") is None, reason="the extra plot is not installed")


@pytest.fixture(scope="module")
def digits(tmp_path_factory):
    """Simulated digits, the first twelve of them held out."""
    return tiny.write_digits(tmp_path_factory.mktemp("digits") / "digits.mcap", 80, n_held_out=12)


@pytest.fixture(scope="module")
def animals(tmp_path_factory):
    """Samples of three classes that look alike, the first six held out."""
    items = held_out(tiny.labelled_items(30), 6)
    return tiny.write_items(tmp_path_factory.mktemp("animals") / "animals.mcap", items)


@pytest.fixture(scope="module")
def unsplit(tmp_path_factory):
    """Samples of three classes without a held-out split."""
    return tiny.write_items(tmp_path_factory.mktemp("unsplit") / "unsplit.mcap", tiny.labelled_items(18))


def held_out(items, n):
    """The same items with the first samples in a split for tests."""
    first = [item.start_us for item in items if isinstance(item, Label)][:n]
    return [
        replace(item, split="test") if isinstance(item, Label) and item.start_us in first else item
        for item in items
    ]


def invoke(*arguments):
    return CliRunner().invoke(cli.app, ["evaluate", *map(str, arguments)])


def refused(*arguments):
    """The one line that refuses these arguments."""
    error = invoke(*arguments).exception
    assert isinstance(error, InputError), error
    assert "\n" not in str(error)
    return str(error)


# --- splits


def test_a_held_out_split_is_the_one_fold(digits):
    data = DataSet([digits], None, 5, 0)
    assert (data.scored, data.n_folds) == ("the recording's held-out split", 1)
    with data.open(0) as (recording,):
        assert [label.split for label in recording.labels] == ["test"] * 12 + ["train"] * 68


def test_folds_hold_out_each_sample_once_and_every_class_evenly(unsplit):
    data = DataSet([unsplit, unsplit], None, 3, 0)
    assert data.n_folds == 3
    held_out = []
    for fold in range(3):
        with data.open(fold) as recordings:
            every = [sample.label for recording in recordings for sample in recording.samples()]
        test = [i for i, label in enumerate(every) if label.split in HELD_OUT_SPLITS]
        names = [every[i].label for i in test]
        assert [names.count(name) for name in ("cat", "dog", "owl")] == [4, 4, 4]
        held_out += test
    assert sorted(held_out) == list(range(36))


def test_nothing_is_learned_from_what_is_held_out(tmp_path):
    items = held_out(tiny.labelled_items(6), 1)
    large = [replace(item, resolution=(90, 90)) if 0 < i < 3 else item for i, item in enumerate(items)]
    path = tiny.write_items(tmp_path / "large.mcap", large)
    with open_recording(path) as recording:
        assert next(recording.samples()).resolution == (90, 90)
        assert AveragedSurfaces.fitted([recording]).resolution == tiny.RESOLUTION


@pytest.mark.parametrize(
    ("items", "folds", "what"),
    [
        ([tiny.packet(tiny.steady(0, 9, 5))], 5, "has no labelled samples"),
        (tiny.labelled_items(6, names=("cat",)), 5, "all samples are labelled 'cat'"),
        (tiny.labelled_items(6, names=("cat", "")), 2, "3 of 6 samples have no label, the first is sample 1"),
        (tiny.labelled_items(6), 0, "--folds 0 leaves nothing"),
        (
            tiny.labelled_items(6),
            5,
            "bad.mcap: label 'cat' has 2 training samples, 5-fold cross-validation needs 5",
        ),
    ],
)
def test_data_that_cannot_be_split(tmp_path, items, folds, what):
    path = tiny.write_items(tmp_path / "bad.mcap", items)
    assert what in refused(path, "--folds", folds)


def test_only_held_out_samples_are_refused(tmp_path):
    path = tiny.write_digits(tmp_path / "test.mcap", 12, split="test")
    assert "every sample is of a held-out split" in refused(path)


def test_on_train_what_is_held_out_is_not_there(animals, tmp_path):
    data = DataSet([animals], None, 4, 0, "train")
    assert data.n_folds == 4
    assert data.scored == (
        "4 folds, each a block of neighbouring samples of every class of the training samples, without those "
        "held out"
    )
    with open_recording(animals) as recording:
        every = list(recording.samples())
    kept = [sample for sample in every if sample.label.split == "train"]
    assert len(kept) == len(every) - 6
    scored = []
    for fold in range(4):
        with data.open(fold) as (recording,):
            found = list(recording.samples())
            windows = list(windows_of(recording.items(), tiny.GEOMETRY))
            assert len(recording.labels) == len(kept)
        for sample, original in zip(found, kept, strict=True):
            np.testing.assert_array_equal(sample.events, original.events)
        # A window takes in the packets up to the next label: none of a sample that is not there.
        starts = {s.label.start_us for s in found if s.label.split == "train"}
        assert {window.origin_us for window in windows} == starts
        assert all(window.events["t"].max() <= window.last_us for window in windows)
        scored += [s.label.start_us for s in found if s.label.split == "test"]
    assert sorted(scored) == [sample.label.start_us for sample in kept]


def test_of_a_packet_only_the_events_of_a_held_out_sample_are_left_out(tmp_path):
    events = tiny.steady(0, 30_000, 90)
    events["t"][[30, 60]] = 10_000, 20_000  # the first that is left out, and the first that is not
    events.sort(order="t")
    items = [
        Label(0, 10_000, "cat", "train"),
        Label(10_000, 10_000, "dog", "test"),
        tiny.packet(events),
        Label(20_000, 10_000, "dog", "train"),
        tiny.packet(tiny.steady(30_000, 31_000, 5)),
    ]
    path = tiny.write_items(tmp_path / "one.mcap", items)
    with Fold(path, None) as recording:
        packets = [item for item in recording.items() if isinstance(item, Packet)]
    t = events["t"]
    np.testing.assert_array_equal(packets[0].events, events[(t < 10_000) | (t >= 20_000)])


# --- what is planned


def test_cells_are_the_base_and_one_change_at_a_time():
    sweeps = [parse_sweep("bins=2,4"), parse_sweep("max-count=2"), parse_sweep("seed=5")]
    cells = plan_cells(["direct", "hots"], {"filters": 7}, sweeps, 2)
    base = {"filters": 7}
    expected = [
        ("direct", "", base),
        ("hots", "", {}),
        ("direct", "bins", base | {"bins": 2}),
        ("direct", "bins", base | {"bins": 4}),
        ("direct", "max_count", base | {"max_count": 2}),
        ("direct", "seed", base | {"seed": 5}),
        ("hots", "seed", {"seed": 5}),
    ]
    assert cells == [
        Cell(method, Trial(**setting), fold, swept)
        for method, swept, setting in expected
        for fold in range(2)
    ]


def test_what_a_method_does_not_use_makes_no_other_cell():
    base = {"iterations": 3, "rows": "free", "log_det": 0.2, "coherence": 0.3, "patch": 5}
    direct, inverse, kmeans, counts = plan_cells(["direct", "inverse", "kmeans", "counts"], base, [], 1)
    assert direct.setting == Trial(**base)
    assert inverse.setting == Trial(formulation="inverse", iterations=3, coherence=0.3, patch=5)
    assert kmeans.setting == Trial(patch=5)
    training = {"mirror": False, "cuts": "", "shift": 0, "kernel": "auto", "test_mirror": False}
    assert counts.key == {"method": "counts", "setting": training, "fold": 0}


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("bins=2,4,2", [2, 4]),
        ("encoding=soft, split", ["soft", "split"]),
        ("threshold=0.25,.5", [0.25, 0.5]),
        ("window-ms=50,100", [50.0, 100.0]),
        ("log-det=0,0.1", [0.0, 0.1]),
        ("mirror=no,yes", [False, True]),
    ],
)
def test_any_value_of_a_setting_can_be_swept(text, values):
    name, found = parse_sweep(text)
    assert name == text.partition("=")[0].replace("-", "_")
    assert found == values
    cells = plan_cells(["direct"], {"rows": "free"}, [(name, found)], 1)
    assert [getattr(cell.setting, name) for cell in cells[1:]] == values


@pytest.mark.parametrize(
    ("option", "what"),
    [
        (["--method", "magic"], "method 'magic' is unknown; choose from direct"),
        (["--sweep", "depth=1,2"], "'depth' cannot be swept; choose one of encoding, filters"),
        (["--sweep", "formulation=direct"], "'formulation' cannot be swept"),
        (["--sweep", "bins"], "give integers, such as --sweep bins=2,4,7"),
        (["--sweep", "bins=2,0"], "0 bins are not possible"),
        (["--sweep", "bins=2,,3"], "give integers"),
        (["--sweep", "threshold=low"], "give numbers, such as --sweep threshold=0.25,0.5"),
        (["--sweep", "encoding=soft,"], "give names, such as --sweep encoding=soft,split"),
        (["--sweep", "mirror=maybe"], "give yes and no, such as --sweep mirror=yes,no"),
        (["--on", "test"], "--on test is unknown; choose held-out or train"),
        (["--kernel", "cubic"], "kernel is 'cubic', it must be one of auto, linear, rbf"),
        (["--groups", "video"], "--groups video is unknown; choose from block, source, none"),
        (["--sweep", "encoding=loud"], "encoding is 'loud'"),
        (["--method", "counts", "--sweep", "bins=2"], "--sweep bins: none of counts uses it"),
        (["--preset", "best"], "there is no preset 'best'"),
        (["--early-samples", "-1"], "--early-samples -1"),
        (["--seed", "-1"], "seed is -1"),
        (["--report", "page.pdf"], "give a name that ends in .html"),
        (["--method", "kmeans", "--volumes", "100"], "100 volumes are too few"),
    ],
)
def test_options_that_cannot_be(digits, option, what):
    assert what in refused(digits, *option)


# --- baselines


@pytest.mark.parametrize("baseline", BASELINES, ids=lambda b: type(b).__name__)
def test_a_baseline_sees_the_events_of_its_window_in_any_order(baseline):
    events = tiny.steady(1000, 90_000, 300)
    rows = baseline.encode(events[events["t"] <= 50_000], tiny.RESOLUTION, origin_us=1000)
    assert rows.shape == (baseline.n_features,)
    assert rows.dtype == np.float32
    assert rows.any()
    shuffled = np.random.default_rng(1).permutation(events)
    cut = baseline.encode(shuffled, tiny.RESOLUTION, origin_us=1000, t_us=50_000)
    np.testing.assert_allclose(cut, rows, rtol=1e-6)
    none = baseline.encode(events[:0], tiny.RESOLUTION, origin_us=0, t_us=10)
    np.testing.assert_array_equal(none, np.zeros(baseline.n_features))


@pytest.mark.parametrize(
    "baseline", [*BASELINES[1:], FirstSpikes(4), LeakySpikes(4)], ids=lambda b: type(b).__name__
)
def test_coarser_pixels_are_those_of_a_smaller_sensor(baseline):
    height, width = tiny.RESOLUTION
    events = tiny.steady(0, 90_000, 400)
    halved = events.copy()
    halved["x"], halved["y"] = events["x"] // 2, events["y"] // 2
    smaller = -(-height // 2), -(-width // 2)
    coarse = replace(baseline, downsample=2)
    np.testing.assert_array_equal(coarse.encode(events, tiny.RESOLUTION), baseline.encode(halved, smaller))
    assert coarse.fingerprint != baseline.fingerprint
    beyond = events.copy()
    beyond["x"][::2] = width  # beyond the sensor, though not beyond its last coarse pixel
    inside = coarse.encode(beyond[1::2], tiny.RESOLUTION)
    np.testing.assert_array_equal(coarse.encode(beyond, tiny.RESOLUTION), inside)


def test_count_images_count_by_polarity_and_place():
    events = make_events([0, 15, 15], [0, 11, 11], [1, 0, 0], [1, 2, 3])
    image = CountImage(2).encode(events, (12, 16)).reshape(2, 2, 2)
    assert image.tolist() == [[[0, 0], [0, 2]], [[1, 0], [0, 0]]]


def test_averaged_surfaces_of_three_events():
    # Two ON events of one pixel and one beside it, in one cell; an OFF event has no ON past.
    events = make_events([1, 1, 2, 2], [1, 1, 1, 1], [1, 1, 1, 0], [0, 10, 20, 30])
    hats = AveragedSurfaces((4, 4), cell=4, radius=1, tau_us=10.0).encode(events, (4, 4), origin_us=0)
    expected = np.zeros((2, 3, 3))
    expected[1, 1, 1] = np.exp(-1) / 4  # the second sees the first
    expected[1, 1, 0] = (np.exp(-2) + np.exp(-1)) / 4  # the third sees both, one column to the left
    np.testing.assert_allclose(hats.reshape(2, 3, 3), expected, rtol=1e-6)


def test_averaged_surfaces_end_at_their_cell():
    events = make_events([3, 4], [0, 0], [1, 1], [0, 1])
    hats = AveragedSurfaces((4, 8), cell=4, radius=1).encode(events, (4, 8))
    assert not hats.any()


def test_a_histogram_of_surfaces_counts_each_event_in_its_quadrant():
    alone = np.zeros((2, 2, 3, 3), np.float32)
    alone[0, 0, 1, 1] = alone[1, 1, 1, 1] = 1  # an OFF event, an ON event, and nothing else around
    hots = SurfaceHistogram((SurfaceLayer(alone.reshape(2, 18), 1, 2e4),))
    events = make_events([0, 7, 7, 0], [0, 0, 7, 7], [0, 1, 1, 0], [0, 1, 2, 3])
    counts = hots.encode(events, (8, 8)).reshape(2, 2, 2)
    assert counts.tolist() == [[[1, 0], [0, 1]], [[1, 0], [0, 1]]]


def test_a_later_layer_sees_the_answers_of_the_one_before():
    # The first layer turns polarities around, the second tells whether one of its own kind lies to the left.
    alone = np.zeros((2, 2, 1, 1), np.float32)
    alone[0, 1] = alone[1, 0] = 1
    left = np.zeros((3, 2, 3, 3), np.float32)
    left[0, :, 1, 1] = 0.5  # nothing but the event itself, of either kind
    left[1, 0, 1, :2] = left[2, 1, 1, :2] = 1
    layers = SurfaceLayer(alone.reshape(2, 2), 0, 1e3), SurfaceLayer(left.reshape(3, 18), 1, 1e9)
    hots = SurfaceHistogram(layers)
    events = make_events([0, 4, 5, 9, 10], [0, 2, 2, 2, 2], [1, 1, 1, 0, 0], [0, 1, 2, 3, 4])
    columns = [events[name].astype(np.int64) for name in "xypt"]
    assert hots.seen(columns, (4, 12))[2].tolist() == [0, 0, 1, 0, 2]
    assert hots.n_features == 12
    assert hots.encode(events, (4, 12)).reshape(4, 3)[:, :].sum(axis=0).tolist() == [3, 1, 1]


def test_chunks_of_events_change_nothing_in_hots(monkeypatch):
    hots = BASELINES[2]
    events = tiny.steady(0, 50_000, 900)
    whole = hots.encode(events, tiny.RESOLUTION)
    monkeypatch.setattr("streamfeat.evaluate.surfaces._CHUNK", 64)
    np.testing.assert_array_equal(hots.encode(events, tiny.RESOLUTION), whole)
    assert np.count_nonzero(whole) > 4


def test_hots_draws_from_three_layers_and_wants_events(digits, tmp_path):
    with open_recording(digits) as recording:
        hots = SurfaceHistogram.fitted([recording], 200)
    assert [layer.prototypes.shape for layer in hots.layers] == [(4, 50), (8, 324), (16, 2312)]
    assert [(layer.n_polarities, layer.tau_us) for layer in hots.layers] == [(2, 1e4), (4, 1e5), (8, 1e6)]
    few = tiny.write_items(tmp_path / "few.mcap", tiny.labelled_items(1))
    with open_recording(few) as recording, pytest.raises(InputError, match="hots has nothing to learn from"):
        SurfaceHistogram.fitted([recording], 3)


def moving_bar(upright):
    """A bar of 15 pixels that goes 12 pixels to the right, or down, one in a millisecond."""
    along, across = (part.ravel() for part in np.meshgrid(np.arange(10, 25), np.arange(8, 20)))
    x, y = (across, along) if upright else (along, across)
    return make_events(x, y, np.ones(len(x)), (across - 8) * 1000)


def test_gabor_filters_have_no_mean_and_one_length_and_turn():
    filters = gabor_filters(7, 12)
    np.testing.assert_allclose(filters.mean(axis=(0, 1)), 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(filters, axis=(0, 1)), 100)
    np.testing.assert_allclose(filters[:, :, 6], filters[:, :, 0].T, atol=1e-9)  # a quarter turn
    np.testing.assert_allclose(filters[:, :, 2], filters[:, ::-1, 10], atol=1e-9)  # 30 degrees either way


@pytest.mark.parametrize("network", [FirstSpikes(), LeakySpikes()], ids=["hfirst", "gabor-snn"])
def test_spikes_tell_the_orientation_of_a_bar_and_where_it_was(network):
    for upright in (False, True):
        features = network.encode(moving_bar(upright), (32, 32), origin_us=0).reshape(8, 8, 12)
        assert features.sum() > 10
        spikes = features.sum(axis=(0, 1))
        # 0 is along x and 6 along y, one of both by the filter's definition for bars.
        assert spikes[0 if not upright else 6] > 5 * spikes[6 if not upright else 0]
        assert not features[:1].any()
        assert not features[:, :1].any()
    assert network.n_features == features.size
    assert not network.encode(moving_bar(True)[:0], (32, 32)).any()


@pytest.mark.parametrize("network", [FirstSpikes(), LeakySpikes()], ids=["hfirst", "gabor-snn"])
def test_spikes_do_not_depend_on_where_a_batch_ends(network):
    events = tiny.steady(0, 50_000, 4_000, resolution=(20, 30))
    columns = [events[name].astype(np.int64) for name in "xypt"]
    whole, bit_by_bit = network.counter((20, 30)), network.counter((20, 30))
    expected = whole(*columns).copy()
    assert expected.sum() > 20
    for cut in np.array_split(np.arange(len(events)), 37):
        found = bit_by_bit(*(column[cut] for column in columns))
    np.testing.assert_array_equal(found, expected)


def test_surface_prototypes_are_the_same_from_the_same_seed(digits):
    with open_recording(digits) as recording:
        first, again = (SurfaceHistogram.fitted([recording], 200, seed=3) for _ in range(2))
    assert first.fingerprint == again.fingerprint


def test_spherical_means_find_the_directions_of_the_data():
    rng = np.random.default_rng(0)
    directions = np.linalg.qr(rng.standard_normal((20, 4)))[0].T
    x = directions[rng.integers(0, 4, 2000)] * rng.choice([-3, 3], (2000, 1))
    x = x + 0.05 * rng.standard_normal(x.shape)
    found = spherical_means(ChunkedVolumes(x.astype(np.float32)), 12, rng)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-5)
    assert (np.abs(found @ directions.T).max(axis=0) > 0.95).all()


def test_random_filters_are_directions():
    filters = random_filters(50, 30, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(filters, axis=1), 1, rtol=1e-5)
    assert np.abs(filters @ filters.T - np.eye(50)).max() < 0.9


# --- scores


def in_digits(hits):
    """A digit for each sample."""
    return "".join("01"[int(hit)] for hit in hits)


def test_the_interval_of_samples_is_that_of_resampled_samples():
    hits = np.arange(200) < 170
    rng = np.random.default_rng(1)
    means = [rng.choice(hits, 200).mean() for _ in range(4000)]
    np.testing.assert_allclose(
        scores.accuracy_interval(in_digits(hits), np.arange(200)),
        np.percentile(means, (2.5, 97.5)),
        atol=0.006,
    )
    assert scores.accuracy_interval("1111111", np.arange(7)) == (1, 1)


def test_the_interval_of_units_is_that_of_units_drawn_whole():
    rng = np.random.default_rng(2)
    units = np.repeat(np.arange(30), rng.integers(1, 20, 30))
    hits = rng.random(len(units)) < rng.random(30)[units]  # alike within a unit
    parts = [hits[units == unit] for unit in range(30)]
    means = [np.concatenate([parts[i] for i in rng.integers(0, 30, 30)]).mean() for _ in range(4000)]
    found = scores.accuracy_interval(in_digits(hits), units)
    np.testing.assert_allclose(found, np.percentile(means, (2.5, 97.5)), atol=0.012)
    alone = scores.accuracy_interval(in_digits(hits), np.arange(len(hits)))
    assert found[1] - found[0] > 1.5 * (alone[1] - alone[0])


def test_a_paired_interval_is_that_of_resampled_pairs():
    rng = np.random.default_rng(0)
    base = rng.random(300) < 0.8
    hits = np.where(rng.random(300) < 0.1, rng.random(300) < 0.9, base)
    drawn = rng.integers(0, 300, (4000, 300))
    differences = (hits[drawn].astype(int) - base[drawn]).mean(axis=1)
    digits, units = [in_digits(hits), in_digits(base)], np.arange(300)
    expected = np.percentile(differences, (2.5, 97.5))
    np.testing.assert_allclose(scores.paired_interval(*digits, units), expected, atol=0.006)
    assert scores.paired_interval(digits[0], digits[0], units) == (0, 0)
    # Narrower than two intervals of their own: most samples are the same to both.
    alone = scores.accuracy_interval(digits[1], units)
    assert expected[1] - expected[0] < 0.7 * (alone[1] - alone[0])


def test_confusion_has_true_labels_in_rows():
    matrix = scores.confusion(["a", "a", "b", "c"], ["a", "b", "b", "a"], ["a", "b", "c"])
    assert matrix == [[1, 1, 0], [0, 1, 0], [1, 0, 0]]


def test_a_share_is_reached_where_accuracy_stays_above_it():
    points = [{"ms": ms, "accuracy": a} for ms, a in ((1, 0.9), (2, 0.5), (3, 0.75), (4, 0.7), (5, 0.8))]
    assert scores.time_to_share(points, "ms", 0.9) == 5
    assert scores.time_to_share(points, "ms", 0.85) == 3
    assert scores.time_to_share(points, "ms", 0.1) == 1


def some_samples(n=6):
    """Samples of three classes, in memory, events out of order."""
    rng = np.random.default_rng(0)
    made = []
    for i in range(n):
        start = 200_000 * i
        events = rng.permutation(tiny.steady(start, start + 100_000, 60 + 30 * i, seed=i))
        made.append(Sample(Label(start, 100_000, ("cat", "dog", "owl")[i % 3]), events, tiny.RESOLUTION))
    return made


def test_early_decisions_see_what_an_engine_has_seen():
    model = tiny.encoder()
    classifier, samples = tiny.classifier(model), some_samples()
    early = scores.early_decision(model, classifier, samples, 100_000)

    def accuracy(cut):
        return np.mean([cut(s) == s.label.label for s in samples])

    def predict(sample, events, t_us):
        return classifier.predict(
            model.encode(events, sample.resolution, origin_us=sample.label.start_us, t_us=t_us)
        )

    for point in early["time"]:
        ends = {s.label.start_us: s.label.start_us + int(1000 * point["ms"]) for s in samples}

        def in_time(s, ends=ends):
            end = ends[s.label.start_us]
            return predict(s, s.events[s.events["t"] < end], end - 1)

        assert point["accuracy"] == accuracy(in_time)
    for point in early["events"]:

        def in_number(s, n=point["events"]):
            if n >= len(s.events):
                return predict(s, s.events, s.label.start_us + 99_999)
            first = np.sort(s.events, order="t")[:n]
            return predict(s, first, int(first["t"][-1]))

        assert point["accuracy"] == accuracy(in_number)
    assert [point["events"] for point in early["events"]] == [50, 100, 200, 210]
    assert early["time"][-1] == {"ms": 100, "accuracy": early["events"][-1]["accuracy"]}
    # Of folds together it is as if they had been one.
    parts = [
        {"samples": len(some), **scores.early_decision(model, classifier, some, 100_000)}
        for some in (samples[:4], samples[4:])
    ]
    assert scores.joined_decisions(parts) == {"samples": len(samples), **early}


def test_prequential_accuracy_predicts_before_it_learns():
    model = tiny.encoder(k=2)
    rng = np.random.default_rng(0)
    labels = rng.choice(["cat", "dog"], 300).tolist()
    rows = rng.standard_normal((300, model.n_features)).astype(np.float32)
    rows[:, 0] += np.where(np.array(labels) == "cat", 4, -4)
    online = OnlineClassifier(Classifier.untrained(labels, model))
    right = 0
    for row, label in zip(rows, labels, strict=True):
        right += online.predict_one(row) == label
        online.learn_one(row, label)
    result = scores.prequential(model, rows, labels)
    assert result["accuracy"] == pytest.approx(right / 300, abs=1e-4)
    assert 0.8 < result["accuracy"] < 1
    assert result["curve"][-1] == {"samples": 300, "accuracy": result["accuracy"]}
    assert result["label_changes"] == sum(a != b for a, b in itertools.pairwise(labels))


def test_a_sorted_stream_says_that_it_is_easy():
    model = tiny.encoder(k=2)
    rows = np.random.default_rng(0).random((64, model.n_features), np.float32)
    result = scores.prequential(model, rows, ["cat"] * 32 + ["dog"] * 32)
    assert result["label_changes"] == 1


def test_a_baseline_trains_the_same_classifier():
    rows = np.stack([BASELINES[0].encode(s.events, s.resolution) for s in some_samples(30)])
    trained = train_classifier(rows, [s.label.label for s in some_samples(30)], BASELINES[0])
    assert trained.fingerprint == BASELINES[0].fingerprint
    assert len(scores.predict_all(trained, rows)) == 30


def test_peak_memory_is_of_the_block():
    def grown(megabytes):
        with PeakMemory() as memory:
            np.ones(megabytes * 125_000)
        return memory.peak_mb

    if sys.platform != "linux":
        pytest.skip("only Linux forgets an earlier peak")
    assert grown(400) - grown(1) > 300


# --- runs that go on


HEADER = {"format": "test", "version": 1}
CELL = Cell("direct", Trial(), 0)
RESULT = {"hits": "11100", "samples": [4, 5], "confusion": [[1]]}


def keep(path):
    with closing(StateFile(path, HEADER)) as state:
        state.add(CELL, RESULT)


def test_a_cell_is_kept_and_found_again(tmp_path):
    path = tmp_path / "state.part"
    keep(path)
    with closing(StateFile(path, HEADER)) as again:
        assert again.get(replace(CELL, swept="bins")) == RESULT  # the same setting, asked for by a sweep
        assert again.get(replace(CELL, fold=1)) is None
        assert again.get(replace(CELL, setting=Trial(bins=4))) is None


def test_a_line_that_was_being_written_is_dropped(tmp_path):
    path = tmp_path / "state.part"
    keep(path)
    whole = path.read_bytes()
    for cut in range(1, len(whole), 41):
        path.write_bytes(whole[:cut])
        with closing(StateFile(path, HEADER)) as state:
            assert len(state) == 0
            state.add(CELL, RESULT)
        assert path.read_bytes() == whole


def test_the_state_of_another_run_is_refused(tmp_path):
    path = tmp_path / "state.part"
    StateFile(path, HEADER).close()
    with pytest.raises(InputError, match="of a run with other recordings"):
        StateFile(path, {**HEADER, "version": 2})
    path.write_bytes(json.dumps(HEADER).encode() + b'\n{"cell": 1}\n')
    with pytest.raises(InputError, match="line 2 cannot be read"):
        StateFile(path, HEADER)


def test_an_interrupted_run_goes_on(animals, tmp_path):
    output = tmp_path / "result.json"
    arguments = ["evaluate", animals, *QUICK, "--early-samples", "0", "-o", output]
    for method in ("counts", "direct", "inverse", "kmeans", "random", "hats", "hots", "hfirst", "gabor-snn"):
        arguments += ["--method", method]
    command = [sys.executable, "-c", "from streamfeat.cli import main; main()", *map(str, arguments)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, env={**os.environ, "NO_COLOR": "1"})
    state = state_path(output)
    deadline = time.monotonic() + 200
    while not (state.exists() and state.read_bytes().count(b"\n") >= 2):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=100)
    assert process.returncode == 130
    assert f"the same command goes on from {state}" in said.decode()
    assert not output.exists()
    done = [json.loads(line) for line in state.read_bytes().splitlines()[1:]]
    assert 1 <= len(done) < 7

    again = CliRunner().invoke(cli.app, [str(argument) for argument in arguments])
    assert again.exit_code == 0, again.output
    result = json.loads(output.read_bytes())
    assert [row["method"] for row in result["rows"]] == [*arguments[arguments.index("--method") + 1 :: 2]]
    for kept, row in zip(done, result["rows"], strict=False):
        assert kept["cell"]["method"] == row["method"]
        assert kept["result"]["encode_s"] == row["encode_s"]  # not measured anew
    assert not state.exists()


def test_cells_that_differ_in_training_only_share_their_features(animals, monkeypatch):
    made = []

    def make(method, recordings, setting, *rest):
        made.append((method, setting))
        return make_features(method, recordings, setting, *rest)

    monkeypatch.setattr(cell_module, "make_features", make)
    sweeps = [parse_sweep("mirror=no,yes"), parse_sweep("filters=6,12")]
    base = {"patch": 4, "bins": 2, "filters": 12, "volumes": 600, "iterations": 1}
    cells = plan_cells(["counts", "direct"], base, sweeps, 1)
    result = evaluate(DataSet([animals], None, 5, 0), cells, early_samples=0)
    assert [(method, setting.filters) for method, setting in made] == [
        ("counts", 400),
        ("direct", 12),
        ("direct", 6),
    ]
    rows = {(r["method"], r["swept"], r["setting"].get(r["swept"])): r for r in result["rows"]}
    assert len(rows) == 8
    for method in ("counts", "direct"):
        same, mirrored = (rows[method, "mirror", value] for value in (False, True))
        assert same["accuracy"] == rows[method, "", None]["accuracy"]
        assert same["difference"] == {"accuracy": 0, "low": 0, "high": 0}
        assert mirrored["encode_s"] > same["encode_s"]
        assert len(mirrored["hits"]) == 6
        assert mirrored["samples"] == same["samples"]
    assert "prequential" not in rows["direct", "mirror", True]


# --- how it is shown


@needs_bokeh
def test_folds_share_the_features_of_a_method_that_learns_nothing(unsplit, tmp_path, monkeypatch):
    """Encoded once for all folds, variants too, with the results of each fold encoded by itself."""
    encoded = []
    encode = cell_module.encode_recordings

    def counted(*arguments, **options):
        encoded.append(options.get("variant"))
        return encode(*arguments, **options)

    monkeypatch.setattr(cell_module, "encode_recordings", counted)
    tiny.encoder(k=3).save(tmp_path / "model")
    base = {"mirror": True, "model": str(tmp_path / "model")}
    data = DataSet([unsplit, unsplit], None, 3, 0)
    cells = plan_cells(["model", "counts"], base, [("mirror", [False])], 3)
    shared = evaluate(data, cells, early_samples=4)
    assert len(encoded) == 4  # of each method the samples and their mirror images
    monkeypatch.setattr(Cell, "has_features_of_all_folds", False)
    apart = evaluate(data, cells, early_samples=4)
    assert len(encoded) == 4 + 2 * 3 * 2
    for row, other in zip(shared["rows"], apart["rows"], strict=True):
        names = ("method", "swept", "hits", "folds", "confusion", "C", "samples")
        assert [row[name] for name in names] == [other[name] for name in names]
        assert row.get("early") == other.get("early")
        assert row.get("prequential") == other.get("prequential")


def test_all_methods_in_tables_json_and_page(animals, tmp_path):
    output, page = tmp_path / "result.json", tmp_path / "result.html"
    chosen = [method for method in METHODS if method != "est"]  # needs PyTorch: test_spike_tensor
    every = [argument for method in chosen for argument in ("--method", method)]
    run = invoke(
        animals, *QUICK, *every, "--sweep", "filters=12,14", "--sweep", "patch=3", "--sweep", "mirror=yes",
        "--early-samples", "4", "-o", output, "--report", page, "--json",
    )  # fmt: skip
    assert run.exit_code == 0, run.output
    result = json.loads(output.read_bytes())
    assert json.loads(run.stdout) == result
    base = [row for row in result["rows"] if not row["swept"]]
    assert [row["method"] for row in base] == chosen
    for row in result["rows"]:
        assert 0 <= row["low"] <= row["accuracy"] <= row["high"] <= 1
        assert np.trace(row["confusion"]) == round(6 * row["accuracy"])
        assert np.sum(row["confusion"]) == 6
        assert min(row["learn_s"], row["encode_s"], row["train_s"]) >= 0
        assert row["peak_mb"] > 50
        if row["swept"]:
            difference = row["difference"]
            assert difference["low"] <= difference["accuracy"] <= difference["high"]
            (first,) = (r for r in base if r["method"] == row["method"])
            assert difference["accuracy"] == pytest.approx(row["accuracy"] - first["accuracy"], abs=2e-4)
    for row in base[1:]:
        to_first = row["difference"]["accuracy"]
        assert to_first == pytest.approx(row["accuracy"] - base[0]["accuracy"], abs=2e-4)
    assert {row["method"] for row in result["rows"] if row["swept"] == "mirror"} == set(chosen)
    for row in base:
        assert row["early"]["samples"] == 4
        assert row["share_reached"]["ms"] <= 80
        assert row["prequential"]["stream"]["curve"][-1]["samples"] == 30
    same = [row for row in result["rows"] if row["method"] == "direct" and row["setting"]["filters"] == 12]
    assert same[0]["accuracy"] == same[1]["accuracy"]
    assert base[0]["learned"]["shape"] == [2, 4, 4]
    assert len(base[0]["learned"]["objective"]) == 4
    assert base[0]["learned"]["kurtosis"] > 1
    assert 0 < base[0]["learned"]["used"] < 1
    html = page.read_text()
    assert "training was on whole samples (--cuts any decides earlier)" in html
    for title in ("Accuracy", "Sweeps", "Early decision", "Online", "Confusion", "Convergence", "Filters"):
        assert f"<h2>{title}" in html
    assert not re.search(r'<(script|link|img)[^>]+(src|href)="?http', html)  # nothing from elsewhere
    assert "N-Caltech101" in html
    assert "to base" in html

    assert "exists already" in refused(animals, "-o", output)


def test_folds_and_the_papers_figures_in_the_terminal(unsplit):
    run = invoke(
        unsplit, "--patch", "4", "--bins", "2", "--filters", "4", "--volumes", "300", "--iterations", "1",
        "--folds", "2", "--early-samples", "3", "--method", "direct", "--sweep", "bins=2",
    )  # fmt: skip
    assert run.exit_code == 0, run.output
    said = " ".join(run.stdout.split())
    assert "split: 2 folds, each a block of neighbouring samples of every class" in said
    assert "95 % bootstrap interval over runs of neighbouring samples" in said
    assert re.search(r"method fold 1 fold 2 direct [01]\.\d{3} [01]\.\d{3}", said)
    # A table that is too wide is cut between columns, and each part begins with the bins.
    lines = [line.split()[1:] for line in run.stdout.splitlines() if line.startswith("7 ")]
    assert [value for line in lines for value in line] == [
        "0.771",
        "0.784",
    ]  # not measured here: only the paper's direct and inverse


def test_the_papers_tables_meet_in_one_setting():
    middle = [
        published.PAPER_SWEEPS[name][value] for name, value in (("filters", 1700), ("patch", 12), ("bins", 7))
    ]
    assert middle == [{"inverse": 0.784, "direct": 0.771}] * 3


def test_filters_are_drawn_with_their_bins_side_by_side():
    filters = np.zeros((9, 2 * 2 * 3))
    filters[0, 0] = 2.0  # bin 0, first row, first column
    filters[8, -1] = -0.5  # bin 1, last row, last column
    picture = tiled(filters, (2, 2, 3))
    tile = np.full((2, 7), 128.0)
    tile[:, 3] = np.nan  # the gap between bins, the page behind it
    first, last = tile.copy(), tile.copy()
    first[0, 0], last[1, 6] = 255, 1
    np.testing.assert_array_equal(picture[:2, :7], first)
    np.testing.assert_array_equal(picture[4:6, :7], last)
