"""Folds that keep near copies on one side, and the check that notices when they do not."""

import itertools
import json

import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from streamfeat import cli
from streamfeat.classify.folds import assign_folds, block_numbers, bootstrap_units
from streamfeat.errors import InputError
from streamfeat.evaluate.leakage import check_leakage, neighbour_accuracy
from streamfeat.evaluate.splits import DataSet
from streamfeat.events import make_events
from streamfeat.recordings.reader import HELD_OUT_SPLITS, Label
from streamfeat.work.workers import THIS_PROCESS

# --- blocks


@given(st.data())
def test_blocks_are_contiguous_in_the_order_of_the_numbers(data):
    labels = data.draw(st.lists(st.sampled_from("ab"), min_size=1, max_size=60))
    numbers = data.draw(st.permutations(range(len(labels))))
    n = data.draw(st.integers(1, 7))
    sources = [f"{label}/obj_{number}_td.dat" for label, number in zip(labels, numbers, strict=True)]
    blocks = block_numbers(labels, sources, n)
    for name in set(labels):
        mine = [i for i, label in enumerate(labels) if label == name]
        ordered = [blocks[i] for i in sorted(mine, key=numbers.__getitem__)]
        assert ordered == sorted(ordered)
        sizes = np.bincount(ordered, minlength=n)
        assert sizes.max() - sizes.min() <= 1


def test_numbers_sort_as_numbers_and_equal_sources_keep_their_order():
    sources = ["a10.dat", "a9.dat", "a100.dat", "a1.dat"]
    assert block_numbers("xxxx", sources, 4).tolist() == [2, 1, 3, 0]
    assert block_numbers("xxxx", [""] * 4, 2).tolist() == [0, 0, 1, 1]
    assert block_numbers("xx", ["a" + "9" * 40, "a1"], 2).tolist() == [1, 0]


def test_each_kind_of_groups_keeps_together_what_it_says():
    labels = ["cat", "dog"] * 30
    sources = [f"drive {i // 6}" for i in range(60)]
    for groups in ("block", "source", "none"):
        folds = assign_folds(labels, sources, 3, groups)
        assert np.bincount(folds).tolist() == [20, 20, 20] or groups == "source"
        alike = [len(set(folds[6 * i : 6 * i + 6])) == 1 for i in range(10)]
        assert all(alike) == (groups == "source")
        assert np.array_equal(folds, assign_folds(labels, sources, 3, groups))


@pytest.mark.parametrize(
    ("labels", "sources", "groups", "reason"),
    [
        ("aaab", "1234", "block", "'b' has 1 training samples, 2-fold cross-validation needs 2"),
        ("aabb", "1234", "none", ""),
        ("aabb", "1111", "source", r"of 1 source\(s\), too few for 2 folds"),
        ("aabb", "1122", "source", "all samples of label 'a' would be in one fold"),
    ],
)
def test_samples_that_cannot_be_folded(labels, sources, groups, reason):
    if not reason:
        assert sorted(assign_folds([*labels], [*sources], 2, groups)) == [0, 0, 1, 1]
        return
    with pytest.raises(InputError, match=reason) as refusal:
        assign_folds([*labels], [*sources], 2, groups)
    assert "\n" not in str(refusal.value)


def test_units_are_runs_sources_or_samples():
    labels, sources = ["a"] * 100 + ["b"] * 50, [f"{i // 3}" for i in range(150)]
    runs = bootstrap_units(labels, sources, "block")
    assert np.bincount(runs)[:25].tolist() == [4] * 25
    assert np.bincount(runs)[25:].tolist() == [2] * 25
    assert len(set(bootstrap_units(labels, sources, "source"))) == 50
    assert bootstrap_units(labels, sources, "none").tolist() == list(range(150))


# --- near copies


def write_videos(path, *, copies, n=240, split=lambda i: "train"):
    """Samples of two classes that say nothing of them; each looks like the one before if `copies`."""
    items = []
    for i in range(n):
        label, start = "ab"[i // 6 % 2], 200_000 * (i + 1)
        rng = np.random.default_rng(i // 6 if copies else 1000 + i)
        x, y = rng.integers(0, 24, 5).repeat(12), rng.integers(0, 24, 5).repeat(12)
        items += [
            Label(start, 50_000, label, split(i), f"{label}/obj_{i}_td.dat"),
            tiny.packet(make_events(x, y, 1, start + np.arange(60)), (24, 24)),
        ]
    return tiny.write_items(path, items)


def leakage(path, folds=5, groups="block"):
    return check_leakage(DataSet([path], None, folds, 0, groups=groups), lambda *step: None, THIS_PROCESS)


def test_near_copies_are_noticed(tmp_path):
    path = write_videos(tmp_path / "videos.mcap", copies=True)
    blocks, shuffled = leakage(path), leakage(path, groups="none")
    assert blocks["shuffled"] > 0.95
    assert blocks["blocks"] < 0.8
    assert (blocks["copies"], blocks["leaks"]) == (True, False)
    assert (shuffled["copies"], shuffled["leaks"]) == (True, True)
    assert blocks["scored"] == blocks["blocks"]
    assert not leakage(write_videos(tmp_path / "others.mcap", copies=False), groups="none")["leaks"]


@pytest.mark.parametrize(
    ("split", "leaks"),
    [(lambda i: "test" if i % 5 == 4 else "train", True), (lambda i: "test" if i >= 180 else "train", False)],
)
def test_a_split_of_its_own_is_looked_at_too(tmp_path, split, leaks):
    path = write_videos(tmp_path / "videos.mcap", copies=True, split=split)
    assert leakage(path)["leaks"] == leaks


def test_too_few_samples_for_a_check_are_none(tmp_path):
    assert leakage(tiny.write_items(tmp_path / "few.mcap", tiny.labelled_items(6)), folds=2) is None


def test_a_neighbour_is_looked_for_in_other_folds_only():
    rows = np.eye(4, dtype=np.float32)[[0, 0, 1, 0]] + np.float32(0.1)
    labels = np.array(["a", "a", "b", "b"])
    together, apart = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    found = neighbour_accuracy(rows, labels, [together, apart])
    assert found[0].tolist() == [False, False, False, False]
    assert found[1].tolist() == [True, True, False, False]


def test_a_leaking_split_is_a_warning_in_the_terminal(tmp_path):
    path = write_videos(tmp_path / "videos.mcap", copies=True)
    common = ["evaluate", str(path), "--method", "counts", "--early-samples", "0"]
    leaking = CliRunner().invoke(cli.app, [*common, "--groups", "none"])
    assert "WARNING: Near copies: a nearest neighbour on 12x12 counts" in " ".join(leaking.stdout.split())
    held = CliRunner().invoke(cli.app, common)
    assert "WARNING" not in held.stdout
    assert "are kept on one side" in " ".join(held.stdout.split())


def test_training_folds_are_blocks_unless_told_otherwise(tmp_path):
    path = write_videos(tmp_path / "videos.mcap", copies=True)
    model = tiny.encoder()
    model.save(tmp_path / "model")
    accuracy = {}
    for groups in ("block", "none"):
        arguments = ["train", path, "-m", tmp_path / "model", "-o", tmp_path / groups, "--groups", groups]
        run = CliRunner().invoke(cli.app, [*map(str, arguments), "--json"])
        assert run.exit_code == 0, run.output
        accuracy[groups] = json.loads(run.stdout)["cross_validation"]
    assert accuracy["none"] > accuracy["block"] + 0.1


def test_folds_of_a_data_set_are_blocks_of_its_samples(tmp_path):
    path = write_videos(tmp_path / "videos.mcap", copies=True)
    data = DataSet([path], None, 5, 0)
    tests = []
    for fold in range(5):
        with data.open(fold) as (recording,):
            labels = [s.label for s in recording.samples()]
        tests.append([label for label in labels if label.split in HELD_OUT_SPLITS])
    for name in "ab":
        numbers = [[int(a.source.split("_")[1]) for a in test if a.label == name] for test in tests]
        in_order = [*itertools.chain(*numbers)]
        assert in_order == sorted(in_order)
        assert len(in_order) == 120
    assert len(data.units) == 240
