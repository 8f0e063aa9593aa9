"""Patches that are no squares, or as large as the sensor: geometry, engine, file, learning, bad input.

Streams on rectangles are in `test_invariants`, whose cases draw them; kernels on them in `test_kernels`.
"""

from dataclasses import replace

import numpy as np
import pytest
import tiny
from streams import EXACT_KINDS, LASSO_KINDS, Case, random_events

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.errors import InputError
from streamfeat.evaluate.plan import parse_sweep
from streamfeat.events import make_events
from streamfeat.learn.fit import geometry_of, learn_encoder
from streamfeat.learn.sensor import load_of
from streamfeat.learn.settings import Setting
from streamfeat.learn.volumes import Window, sample_volumes
from streamfeat.recordings.reader import open_recording

ids = "-".join
WIDE = Geometry(patch=(3, 5), stride=2, n_bins=3, bin_us=1000, downsample=2, max_count=2)


# Geometry


def test_a_square_has_one_spelling():
    assert Geometry(patch=(8, 8)) == Geometry(patch=8) == Geometry(patch=[8, 8])
    assert repr(Geometry(patch=(8, 8))) == repr(Geometry(patch=8))
    assert (WIDE.sides, WIDE.volume_shape, WIDE.entries, WIDE.patch_name) == ((3, 5), (3, 3, 5), 45, "3x5")
    assert WIDE.grid_shape((13, 17)) == (3, 3)
    assert WIDE.smallest == (6, 10)
    assert WIDE.grid_shape(WIDE.smallest) == (1, 1)
    assert not WIDE.has_room((13, 8))


@pytest.mark.parametrize("patch", [(3,), (3, 4, 5), (0, 4), (4, 1025), (4, 2.0), (True, 4), "3x4", ()])
def test_sides_that_make_no_sense_are_refused_in_one_line(patch):
    with pytest.raises(InputError, match="patch is") as refused:
        Geometry(patch=patch)
    assert "\n" not in str(refused.value)


# The engine


@pytest.mark.parametrize("kind", [*EXACT_KINDS, *LASSO_KINDS], ids=ids)
@pytest.mark.parametrize("resolution", [(5, 30), (23, 4), (1, 1)])
def test_what_a_small_sensor_lacks_of_a_rectangle_is_pixels_that_never_fire(kind, resolution):
    small = Case(WIDE, resolution, 33, *kind, 0.1, 3)
    padded = replace(small, resolution=tuple(map(max, resolution, WIDE.smallest)))
    events = random_events(np.random.default_rng(0), WIDE, resolution, 300)
    whole, bit_by_bit, larger = small.engine(), small.engine(look_ahead=True), padded.engine()
    whole.feed(events)
    larger.feed(events[(events["x"] < resolution[1]) & (events["y"] < resolution[0])])
    bit_by_bit.follow(events)
    assert whole.features().any()
    np.testing.assert_array_equal(whole.features(), larger.features())
    if kind in EXACT_KINDS:
        np.testing.assert_array_equal(whole.features(), bit_by_bit.features())
        again = small.engine()
        again.restore(whole.snapshot())
        np.testing.assert_array_equal(again.features(), whole.features())


def test_a_volume_of_the_whole_sensor_sees_every_event():
    case = Case(Geometry(patch=(13, 18), n_bins=2, bin_us=1000), (13, 18), 33, "direct", "soft", 0.0, 3)
    engine = case.engine()
    assert engine.grid_shape == (1, 1)
    events = random_events(np.random.default_rng(0), case.geometry, case.resolution, 200)
    engine.feed(events)
    assert engine.activity().tolist() == [[int(np.square(engine.counts().clip(-1, 1)).sum())]]


def test_rectangles_that_differ_only_in_their_sides_are_different_models(tmp_path):
    wide, tall = random_encoder(0, WIDE, 5), random_encoder(0, replace(WIDE, patch=(5, 3)), 5)
    assert wide.fingerprint != tall.fingerprint
    wide.save(tmp_path / "wide.safetensors")
    text = (tmp_path / "wide.safetensors").read_bytes()
    assert b'\\"version\\": 3' in text or b'\\"version\\":3' in text
    again = Encoder.load(tmp_path / "wide.safetensors")
    assert again.geometry == WIDE
    assert again.fingerprint == wide.fingerprint
    assert "3x3x5" in repr(again)


# Learning

LEARN = {"filters": 6, "stride": 4, "bins": 2, "volumes": 300, "iterations": 2, "max_count": 2}


def test_entries_of_a_rectangle_come_bin_by_bin_and_row_by_row():
    geometry = Geometry(patch=(2, 3), n_bins=2, bin_us=10, max_count=100)
    y, x = np.divmod(np.arange(6), 3)
    events = make_events(
        np.repeat(np.tile(x, 2), range(1, 13)),
        np.repeat(np.tile(y, 2), range(1, 13)),
        np.ones(78, int),
        np.repeat(np.repeat([0, 10], 6), range(1, 13)),
    )
    volumes = sample_volumes([Window(events, (2, 3), 0, 19)], geometry, 4, (0,))
    assert volumes.counts.tolist() == [list(range(1, 13))] * 4


def test_windows_of_smaller_sensors_are_padded_where_that_is_asked_for():
    geometry = Geometry(patch=(2, 3), n_bins=1, bin_us=10)
    window = Window(make_events([0], [0], [1], [0]), (2, 2), 0, 9)
    assert len(sample_volumes([window], geometry, 4, (0,)).counts) == 0
    found = sample_volumes([window], geometry, 4, (0,), padded=True).counts
    assert found.tolist() == [[1, 0, 0, 0, 0, 0]] * 4


@pytest.mark.parametrize(
    ("given", "known", "sides"),
    [(12, 12, (12, 12)), ("12", 12, (12, 12)), ("8X8", 8, (8, 8)), ((4, 6), "4x6", (4, 6)),
     ("4x6", "4x6", (4, 6)), ("Sensor", "sensor", (5, 7))],
)  # fmt: skip
def test_a_patch_of_a_setting_has_one_spelling(given, known, sides):
    setting = Setting(patch=given, downsample=2)
    assert setting.patch == known
    assert setting.sides((9, 13)) == sides


@pytest.mark.parametrize("text", ["0", "-3", "8x", "x8", "8x0", "1x2x3", "1.5", "all", "", "8 x 9", None])
def test_a_patch_that_is_not_understood_is_refused_in_one_line(text):
    with pytest.raises(InputError, match="patch") as refused:
        Setting(patch=text)
    assert "\n" not in str(refused.value)


def test_patches_can_be_swept():
    assert parse_sweep("patch=8,8x16,sensor,8x8") == ("patch", [8, "8x16", "sensor"])
    with pytest.raises(InputError, match="--sweep patch=8,9x: give patches"):
        parse_sweep("patch=8,9x")


def test_a_patch_as_large_as_the_sensor_is_that_of_the_largest(tmp_path):
    """Rows of one sample, columns of another, and of all recordings; each sample has two packets."""
    items = tiny.labelled_items(9, events=60)
    wide = [replace(item, resolution=(12, 20)) if i % 9 in (1, 2) else item for i, item in enumerate(items)]
    tall = [replace(item, resolution=(15, 16)) if i % 9 in (1, 2) else item for i, item in enumerate(items)]
    paths = [tiny.write_items(tmp_path / f"{i}.mcap", found) for i, found in enumerate((wide, tall))]
    setting = Setting(**LEARN | {"patch": "sensor", "downsample": 2, "volumes": 500})
    with open_recording(paths[0]) as one, open_recording(paths[1]) as other:
        assert geometry_of(setting, [one]).sides == (6, 10)
        assert geometry_of(setting, [one, other]).sides == (8, 10)
        with pytest.raises(InputError, match="160 entries; learn from at least 161"):
            geometry_of(replace(setting, volumes=160, filters=6), [other, one])
        encoder = learn_encoder([one, other], setting)
    assert encoder.filters.shape == (6, 2 * 8 * 10)
    assert encoder.provenance["windows"] == 18  # those of smaller sensors, too
    assert load_of(setting, (15, 20), 1e5) < load_of(replace(setting, patch=4), (15, 20), 1e5)


def test_commands_learn_and_use_rectangles_and_whole_sensors(run, tmp_path):
    path = tiny.write_digits(tmp_path / "digits.mcap", 60, n_held_out=20)
    options = [f"--{name.replace('_', '-')}={value}" for name, value in LEARN.items()]
    run("learn", path, *options, "--patch", "4x7", "-o", tmp_path / "model")
    assert Encoder.load(tmp_path / "model").geometry.sides == (4, 7)
    files = ["-m", tmp_path / "model", "-c", tmp_path / "classifier"]
    trained = run("train", path, *files[:2], "-o", files[3], "--kernel=linear", "--mirror", "--json").json
    said = run("replay", path, *files, "--emit", "event", "--split", "test", "--json").json
    assert said["correct"] / 20 == pytest.approx(trained["held_out_accuracy"])
    sweep = ["--patch=4x7", "--sweep", "patch=sensor", "--downsample", "4", "--early-samples", 0]
    result = run("evaluate", path, "--method", "direct", *options, *sweep, "--json").json
    assert [row["setting"]["patch"] for row in result["rows"]] == ["4x7", "sensor"]
    assert result["rows"][0]["learned"]["shape"] == [2, 4, 7]
    assert result["rows"][1]["setting"]["downsample"] == 4


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--patch", "8x"], "patch '8x' is not understood"),
        (["--patch", "sensor"], "3468 entries; learn from at least 3469, or with a higher downsample"),
        (["--patch", "4x64"], "no local volume of 4x64 pixels with an event was found"),
        (["--patch", "4x2000"], "--volumes|volumes are too few"),
    ],
)
def test_patches_that_cannot_be_learned_are_refused_in_one_line(run, tmp_path, options, words):
    path = tiny.write_digits(tmp_path / "digits.mcap", 3)
    more = ["--bins", 3, "--stride", 2, "--volumes", 2000, "--filters", 6, "-o", tmp_path / "new"]
    said = run("learn", path, *options, *more)
    assert said.status == 2
    assert any(word in " ".join(said.err.split()) for word in words.split("|"))
    assert not (tmp_path / "new").exists()
