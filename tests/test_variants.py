"""Variants of training samples: what each is, and that learning and scoring keep them apart."""

import json

import numpy as np
import pytest
import tiny

from streamfeat.classify.features import encode_recordings, training_set
from streamfeat.classify.variants import PLAIN, Variant, parse_cuts, variants_of
from streamfeat.engine.encoder import Encoder
from streamfeat.engine.geometry import Geometry
from streamfeat.errors import InputError
from streamfeat.recordings.reader import Label, Sample, open_recording

MIRRORED = Variant(mirror=True)


def test_a_mirror_image_swaps_left_and_right():
    events = tiny.stream(range(40))
    events["x"][:3] = 0, 15, 16  # the last is outside
    sample = Sample(Label(0, 100, "cat"), events, tiny.RESOLUTION)
    image = MIRRORED.of(sample)
    assert image.events["x"][:2].tolist() == [15, 0]
    assert image.events["x"][2] >= 16
    for name in ("y", "p", "t"):
        np.testing.assert_array_equal(image.events[name], events[name])
    np.testing.assert_array_equal(MIRRORED.of(image).events, events)
    assert events["x"][1] == 15  # the sample itself is as it was


def test_mirror_images_are_those_of_training_samples(tmp_path):
    model = tiny.encoder()
    path = tiny.write_digits(tmp_path / "digits.mcap", 8, n_held_out=3)
    with open_recording(path) as recording:
        every = list(recording.samples())
        samples = encode_recordings(model, [recording])
        images = encode_recordings(model, [recording], variant=MIRRORED)
    assert samples.held_out.tolist() == [True] * 3 + [False] * 5
    seen = every[3:]
    for row, sample in zip(images.rows, map(MIRRORED.of, seen), strict=True):
        expected = model.encode(
            sample.events,
            sample.resolution,
            origin_us=sample.label.start_us,
            t_us=sample.label.start_us + sample.label.duration_us - 1,
        )
        np.testing.assert_array_equal(row, expected)
    rows, labels, numbers = training_set(samples, [images])
    np.testing.assert_array_equal(rows, np.concatenate([samples.rows[3:], images.rows]))
    assert labels == 2 * [sample.label.label for sample in seen]
    assert numbers.tolist() == 2 * [0, 1, 2, 3, 4]
    assert len(training_set(samples)[0]) == 5


def sample(start_us=1000, duration_us=100):
    events = tiny.stream(range(start_us, start_us + duration_us, 10))
    return Sample(Label(start_us, duration_us, "cat"), events, tiny.RESOLUTION)


def test_a_cut_sample_ends_where_its_window_does():
    whole, label = sample(), sample().label
    cut = Variant(cut_us=33).of(whole)
    assert (cut.label.start_us, cut.label.duration_us, cut.label.label) == (1000, 33, label.label)
    assert cut.events["t"].tolist() == [1000, 1010, 1020, 1030]
    for long in (100, 5000):
        same = Variant(cut_us=long).of(whole)
        assert same.label == label
        assert np.array_equal(same.events, whole.events)


def test_a_beginning_is_drawn_for_each_sample_from_its_label_alone():
    begun = Variant(cut_us=-1)
    samples = [sample(start_us=1000 * i, duration_us=1000) for i in range(300)]
    lengths = np.array([begun.of(one).label.duration_us for one in samples])
    assert 100 <= lengths.min() < 110
    assert 970 < lengths.max() <= 1000
    assert abs(np.log10(lengths / 1000).mean() + 0.5) < 3 / np.sqrt(12 * 300)  # a logarithm that is uniform
    np.testing.assert_array_equal(lengths, [begun.of(one).label.duration_us for one in samples])
    for one, length in zip(samples, lengths, strict=True):
        cut, whole = begun.of(one).events["t"], one.events["t"]
        np.testing.assert_array_equal(cut, whole[whole < one.label.start_us + length])
    for other in (Variant(mirror=True, cut_us=-1), Variant(cut_us=-2)):
        others = [other.of(one).label.duration_us for one in samples]
        assert abs(np.corrcoef(lengths, others)[0, 1]) < 0.2
    for short in (1, 2, 3):
        assert 1 <= begun.of(sample(duration_us=short)).label.duration_us <= short


def test_a_moved_sample_loses_what_leaves_the_sensor():
    whole = sample()
    height, width = whole.resolution
    whole.events["x"][:3], whole.events["y"][:3] = (0, width - 1, width), (height - 1, 0, 0)  # one is outside
    before = whole.events.copy()
    right = Variant(shift=(0, 1)).of(whole).events
    assert np.array_equal(whole.events, before)
    kept = before[before["x"] < width - 1]
    assert np.array_equal(right["x"], kept["x"] + 1)
    assert np.array_equal(right["t"], kept["t"])
    up = Variant(shift=(-1, 0)).of(whole).events
    assert np.array_equal(up["y"], before[(before["y"] > 0) & (before["x"] < width)]["y"] - 1)


def test_which_variants_options_ask_for():
    assert variants_of() == ()
    assert PLAIN not in variants_of(mirror=True, cuts=(33_000,), shift=2)
    assert variants_of(mirror=True, cuts=(33_000, 67_000)) == (
        Variant(cut_us=33_000),
        Variant(cut_us=67_000),
        MIRRORED,
        Variant(mirror=True, cut_us=33_000),
        Variant(mirror=True, cut_us=67_000),
    )
    moved = variants_of(shift=3)
    assert [v.shift for v in moved] == [(-3, 0), (3, 0), (0, -3), (0, 3)]
    assert len({str(v) for v in variants_of(mirror=True, cuts=(33_000,), shift=2)}) == 7


@pytest.mark.parametrize(
    ("text", "cuts"),
    [
        ("", ()),
        (" any ", (-1,)),
        ("any+33+any", (-1, -2, 33_000)),
        ("33+67", (33_000, 67_000)),
        ("67, 33.5", (33_500, 67_000)),
        ("5+5", (5_000,)),
    ],
)
def test_cuts_are_milliseconds(text, cuts):
    assert parse_cuts(text) == cuts


@pytest.mark.parametrize(
    "text",
    ["early", "0", "33+", "-3", "nan", "inf", "1e9", "1+2+3+4+5+6+7+8+9", "any+" * 8 + "any", "any time"],
)
def test_cuts_that_make_no_sense_are_refused(text):
    with pytest.raises(InputError, match="not understood; give up to 8 times"):
        parse_cuts(text)


def test_a_shift_out_of_range_is_refused():
    with pytest.raises(InputError, match="a shift of 1025 pixels is not possible"):
        variants_of(shift=1025)


def test_a_mirrored_sample_is_encoded_by_a_grid_that_is_not_symmetric():
    """Of seven columns, with patches of four and a stride of two, the last is in no volume; the first is."""
    geometry = Geometry(patch=4, stride=2, n_bins=1, bin_us=1000, max_count=1)
    some = np.random.default_rng(0)
    encoder = Encoder.build(
        geometry,
        formulation="direct",
        encoding="soft",
        threshold=0.0,
        filters=some.standard_normal((3, 16)),
        whitening=np.eye(16),
        mean=np.zeros(16),
    )
    events = tiny.stream(range(20))
    events["x"], events["y"] = 6, np.arange(20) % 7
    one = Sample(Label(0, 100, "cat"), events, (7, 7))
    assert not encoder.encode(one.events, one.resolution, origin_us=0, t_us=99).any()
    mirrored = MIRRORED.of(one)
    assert encoder.encode(mirrored.events, mirrored.resolution, origin_us=0, t_us=99).any()


def test_train_and_evaluate_take_them(run, tmp_path):
    tiny.write_digits(tmp_path / "train.mcap", 40, n_held_out=10)
    tiny.encoder(k=3).save(tmp_path / "model")
    options = ["--mirror", "--cuts", "20+40", "--shift", "1"]
    train = ["train", tmp_path / "train.mcap", "-m", tmp_path / "model", "-o"]
    said = run(*train, tmp_path / "clf", *options, "--kernel", "rbf", "--json")
    assert (said.status, said.json["samples"]) == (0, 30)
    from streamfeat.classify.kernel import load_classifier

    trained = load_classifier(tmp_path / "clf")
    assert len(trained.machines[0].points) == 30 * 10
    assert trained.provenance["variants"][:2] == ["first 20 ms", "first 40 ms"]
    refused = run(*train, tmp_path / "other", "--cuts", "soon")
    assert (refused.status, "such as 33+67" in refused.err) == (2, True)
    command = ["evaluate", tmp_path / "train.mcap", "--method", "counts", "--early-samples", "0", "--quiet"]
    command += ["--json"]
    swept = ["--sweep", "cuts=20+40,40", "--sweep", "shift=0,1", "--sweep", "mirror=yes"]
    rows = run(*command, *swept).json["rows"]
    assert [row["swept"] for row in rows] == ["", "cuts", "cuts", "shift", "shift", "mirror"]
    alone = run(*command, "--cuts", "20+40").json["rows"][0]
    assert json.dumps(alone["hits"]) == json.dumps(rows[1]["hits"])
