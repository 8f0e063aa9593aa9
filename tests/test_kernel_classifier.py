"""The kernel classifier: its mathematics, its bits, its file, and where the linear one stands in for it."""

import dataclasses
import json
import time

import numpy as np
import pytest
import tiny
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from sklearn.kernel_ridge import KernelRidge
from typer.testing import CliRunner

from streamfeat import cli
from streamfeat.classify import kernel as kernel_module
from streamfeat.classify import machine as machine_module
from streamfeat.classify.classifier import Classifier, normalise_features, train_classifier
from streamfeat.classify.kernel import KernelClassifier, load_classifier, train_kernel_classifier
from streamfeat.classify.machine import cells_of, normalise_cells
from streamfeat.classify.training import train
from streamfeat.engine.encoder import Encoder
from streamfeat.errors import InputError
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session

MODEL = tiny.encoder()
N = MODEL.n_features


def rings(n, seed=0):
    """Features whose class is a distance, which no linear classifier tells; and their labels."""
    rng = np.random.default_rng(seed)
    inner = rng.random(n) < 0.5
    directions = rng.standard_normal((n, 2))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    roots = np.full((n, N), 1.0)
    roots[:, :2] += directions * np.where(inner, 0.1, 0.8)[:, None]
    return np.square(roots + 0.01 * rng.standard_normal((n, N))).astype(np.float32), np.where(
        inner, "in", "out"
    )


def trained(n=240):
    features, labels = rings(n)
    linear = train_classifier(features, labels.tolist(), MODEL, candidates=(1e-2,))
    return train_kernel_classifier(features, linear, labels)


def test_it_tells_what_no_linear_classifier_can():
    clf, (fresh, expected) = trained(), rings(200, seed=1)
    assert np.mean([clf.predict(row) == label for row, label in zip(fresh, expected, strict=True)]) > 0.95
    assert (
        np.mean([clf.linear.predict(row) == label for row, label in zip(fresh, expected, strict=True)]) < 0.8
    )


def test_it_is_kernel_ridge_regression():
    features, labels = rings(150)
    clf, fresh = trained(150), rings(20, seed=2)[0]
    targets = np.where(labels[:, None] == np.array(clf.labels), 1.0, -1.0)
    (machine,) = clf.machines
    rows = normalise_features(features * machine.gains)
    places = (rows - machine.mean) @ machine.axes
    ridge = KernelRidge(alpha=1e-2, kernel="rbf", gamma=machine.gamma).fit(places, targets)
    expected = ridge.predict((normalise_features(fresh * machine.gains) - machine.mean) @ machine.axes)
    np.testing.assert_allclose(clf.scores(fresh), expected, atol=2e-3)
    # Not more axes than features: distances are those of the normalised features.
    np.testing.assert_allclose(
        np.linalg.norm(places[0] - places[1]), np.linalg.norm(rows[0] - rows[1]), rtol=1e-4
    )


def test_scores_have_the_same_bits_in_any_batch():
    clf, (fresh, _) = trained(), rings(30, seed=3)
    whole = clf.scores(fresh)
    for cut in (1, 7, 29):
        parts = np.concatenate([clf.scores(fresh[:cut]), clf.scores(fresh[cut:])])
        assert np.array_equal(parts, whole)
    assert np.array_equal(clf.scores(fresh[4]), whole[4])


def test_a_file_holds_both_classifiers(tmp_path):
    clf, (fresh, _) = trained(), rings(10, seed=4)
    clf.save(tmp_path / "clf")
    again = load_classifier(tmp_path / "clf")
    assert isinstance(again, KernelClassifier)
    assert np.array_equal(again.scores(fresh), clf.scores(fresh))
    assert np.array_equal(again.linear.scores(fresh), clf.linear.scores(fresh))
    assert (again.labels, again.fingerprint) == (clf.labels, MODEL.fingerprint)
    again.check_fits(MODEL)
    with pytest.raises(InputError, match="trained with another model"):
        again.check_fits(tiny.encoder(seed=1))
    alone = Classifier.load(tmp_path / "clf")
    assert np.array_equal(alone.emitted(fresh), clf.linear.emitted(fresh))
    clf.linear.save(tmp_path / "linear")
    assert isinstance(load_classifier(tmp_path / "linear"), Classifier)


@pytest.mark.parametrize(
    ("arrays", "header", "reason"),
    [
        ({"dual.0": np.zeros((3, 2), np.float32)}, {}, "dual is not float32 of shape"),
        ({"axes.0": np.zeros((N, 3), np.float32)}, {}, "points is not float32 of shape"),
        ({"points.0": np.zeros((0, 0), np.float32)}, {}, "points is not float32 of shape"),
        ({"mean.0": np.full(N, np.nan, np.float32)}, {}, "mean is not finite"),
        ({"gains.0": np.full(N, -1, np.float32)}, {}, "gains must not be below zero"),
        ({"gains.0": np.ones(1, np.float32)}, {}, "gains is not float32 of shape"),
        ({"bias": np.zeros(7, np.float32)}, {}, "bias is not float32"),
        ({}, {"machines": [{"cells": [N], "gamma": -1.0}]}, "gamma or the number"),
        ({}, {"machines": [{"cells": [N], "gamma": "wide"}]}, "gamma or the number"),
        ({}, {"version": 9}, "format version 9"),
    ],
)
def test_unsound_files_are_refused(tmp_path, arrays, header, reason):
    trained(60).save(tmp_path / "good")
    with safe_open(tmp_path / "good", framework="numpy") as file:
        meta = json.loads(file.metadata()["streamfeat"]) | header
    save_file(
        load_file(tmp_path / "good") | arrays, tmp_path / "bad", metadata={"streamfeat": json.dumps(meta)}
    )
    with pytest.raises(InputError, match=reason) as refusal:
        load_classifier(tmp_path / "bad")
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("version", [1, 2])
def test_a_file_from_before_there_were_gains_has_the_same_scores(tmp_path, version):
    clf, fresh = trained(60), rings(5, seed=4)[0]
    machine = dataclasses.replace(clf.machines[0], gains=np.ones(N, np.float32))
    clf = dataclasses.replace(clf, machines=(machine,))
    clf.save(tmp_path / "now")
    with safe_open(tmp_path / "now", framework="numpy") as file:
        meta = json.loads(file.metadata()["streamfeat"]) | {"version": version}
    arrays = load_file(tmp_path / "now")
    del arrays["gains.0"]
    if version == 1:  # one machine, whose arrays have no number
        arrays = {name.removesuffix(".0"): array for name, array in arrays.items()}
        meta["gamma"] = meta.pop("machines")[0]["gamma"]
    save_file(arrays, tmp_path / "before", metadata={"streamfeat": json.dumps(meta)})
    np.testing.assert_array_equal(load_classifier(tmp_path / "before").emitted(fresh), clf.emitted(fresh))
    np.testing.assert_array_equal(
        Classifier.load(tmp_path / "before").scores(fresh), clf.linear.scores(fresh)
    )


def test_features_that_a_linear_classifier_leans_on_have_gains():
    features, labels = scales(400)
    targets = np.where(labels[:, None] == np.array(["a", "b"]), np.float32(1), np.float32(-1))
    gains = machine_module._gains(features[:, :24], (6,) * 4, targets)
    assert gains.dtype == np.float32
    assert gains.mean() == pytest.approx(1, rel=1e-5)
    # Features at the same place of their cells have the same: the fourth tells, in the first of four cells.
    assert np.array_equal(gains, np.tile(gains[:6], 4))
    assert gains[:6].argmax() == 3
    assert gains[3] > 3
    # In cells of unlike sizes each feature is by itself.
    alone = machine_module._gains(features[:, :24], (5, 19), targets)
    assert (alone.argmax(), alone[9] < alone[3] / 3) == (3, True)
    for rows, which in ((np.ones((6, 4), np.float32), targets[:6]), (features[:6, :4], 0 * targets[:6])):
        assert np.array_equal(machine_module._gains(rows, (2, 2), which), np.ones(4))


def test_files_that_are_no_classifier_are_refused(tmp_path):
    MODEL.save(tmp_path / "model")
    for name, reason in (("missing", "no such file"), ("model", "not a streamfeat-classifier file")):
        with pytest.raises(InputError, match=reason):
            load_classifier(tmp_path / name)


def test_more_rows_than_the_matrix_may_have_are_refused_with_the_arithmetic(monkeypatch):
    features, labels = rings(60)
    linear = train_classifier(features, labels.tolist(), MODEL, candidates=(1e-2,))
    monkeypatch.setattr(kernel_module, "MOST_POINTS", 59)
    with pytest.raises(
        InputError, match=r"60 training rows are too many .* GiB, at most 59 .* --kernel linear"
    ):
        train_kernel_classifier(features, linear, labels)


def test_single_events_and_online_learning_use_the_linear_one():
    clf = trained()
    assert Session(MODEL, EmitPolicy("time", 10_000), clf).classifier is clf
    assert Session(MODEL, EmitPolicy("events", 1), clf).classifier is clf.linear
    assert Session(MODEL, EmitPolicy("time", 10_000), clf, learn_online=True).classifier is clf.linear


def test_train_and_replay_with_a_kernel(tmp_path):
    path = tiny.write_digits(tmp_path / "digits.mcap", 60, n_held_out=10)
    MODEL.save(tmp_path / "model")
    common = [str(path), "-m", str(tmp_path / "model")]
    run = CliRunner().invoke(
        cli.app, ["train", *common, "-o", str(tmp_path / "clf"), "--kernel", "rbf", "--json"]
    )
    assert run.exit_code == 0, run.output
    assert json.loads(run.stdout)["kernel"] == "rbf"
    replayed = CliRunner().invoke(
        cli.app, ["replay", *common, "-c", str(tmp_path / "clf"), "--emit", "20ms", "--json"]
    )
    assert replayed.exit_code == 0, replayed.output
    wrong = CliRunner().invoke(cli.app, ["train", *common, "-o", str(tmp_path / "no"), "--kernel", "cubic"])
    assert "kernel is 'cubic', it must be one of auto, linear, rbf" in str(wrong.exception)


def test_one_emission_at_fifteen_thousand_samples_is_quick():
    clf, rng = trained(60), np.random.default_rng(0)
    machine = dataclasses.replace(
        clf.machines[0],
        axes=rng.standard_normal((N, 256)).astype(np.float32),
        points=rng.standard_normal((15_000, 256)).astype(np.float32),
        dual=rng.standard_normal((15_000, 2)).astype(np.float32),
    )
    wide = dataclasses.replace(clf, machines=(machine,))
    row, taken = rings(1)[0][0], []
    for _ in range(30):
        started = time.perf_counter()
        wide.scores(row)
        taken.append(time.perf_counter() - started)
    assert min(taken) < 0.02  # a bound for any machine; figures are in the README of this room


def scales(n=120, seed=0):
    """Features of two scales of four cells, of which one feature each tells the class; and their labels."""
    rng = np.random.default_rng(seed)
    features = rng.random((n, 40)).astype(np.float32)
    second = rng.random(n) < 0.5
    features[:, [3, 33]] += 0.7 * second[:, None]
    return features, np.where(second, "b", "a")


CELLS = ((6,) * 4, (4,) * 4)


def committee(n=120):
    features, labels = scales(n)
    linear = Classifier.untrained(labels.tolist(), Columns(40))
    return train_kernel_classifier(features, linear, labels, np.arange(n) % 3, CELLS)


@dataclasses.dataclass
class Columns:
    """What features are for a classifier: so many of them."""

    n_features: int
    fingerprint: str = "of nothing"


def test_cells_have_the_same_length_and_empty_ones_stay_empty():
    rows = np.array([[4, 0, 1, 1, 0, 0], [0, 0, 9, 0, 0, 16]], np.float32)
    half, third = np.float32(np.sqrt(1 / 2)), np.float32(np.sqrt(1 / 2) / np.sqrt(2))
    expected = np.array([[half, 0, third, third, 0, 0], [0, 0, half, 0, 0, half]])
    np.testing.assert_allclose(normalise_cells(rows, (2, 2, 2)), expected, rtol=1e-6)
    assert np.array_equal(normalise_cells(rows, (6,)), normalise_features(rows))
    assert not normalise_cells(np.zeros(6, np.float32), (2, 2, 2)).any()


def test_every_scale_has_a_machine_and_their_scores_are_averaged():
    clf, (fresh, _) = committee(), scales(20, seed=1)
    features, labels = scales()
    alone = [
        train_kernel_classifier(
            features[:, place], Classifier.untrained(["a", "b"], Columns(n)), labels, None, [cells]
        )
        for place, n, cells in ((slice(0, 24), 24, CELLS[0]), (slice(24, 40), 16, CELLS[1]))
    ]
    expected = (alone[0].scores(fresh[:, :24]) + alone[1].scores(fresh[:, 24:])) / 2
    np.testing.assert_array_equal(clf.scores(fresh), expected)
    assert np.array_equal(clf.scores(fresh[7]), clf.scores(fresh)[7])
    two = tiny.encoder()
    assert cells_of(Encoder.side_by_side([two, two])) == cells_of(two) * 2
    assert cells_of(two) == ((two.n_features // 4,) * 4,)
    assert cells_of(Columns(9)) == ((9,),)


def test_a_committee_is_saved_and_an_unsound_one_is_refused(tmp_path):
    clf, (fresh, _) = committee(), scales(5, seed=2)
    clf.save(tmp_path / "good")
    assert np.array_equal(load_classifier(tmp_path / "good").emitted(fresh), clf.emitted(fresh))
    assert np.array_equal(Classifier.load(tmp_path / "good").scores(fresh), clf.linear.scores(fresh))
    with safe_open(tmp_path / "good", framework="numpy") as file:
        meta = json.loads(file.metadata()["streamfeat"])
    machines = meta["machines"]
    for wrong in (None, [], 7, machines[:1], [{**machines[0], "cells": [30, -6]}, machines[1]], [{}, {}]):
        save_file(
            load_file(tmp_path / "good"),
            tmp_path / "bad",
            metadata={"streamfeat": json.dumps(meta | {"machines": wrong})},
        )
        with pytest.raises(InputError, match=r"the cells of its machines are not those of 40 features"):
            load_classifier(tmp_path / "bad")


def test_the_better_classifier_is_taken(monkeypatch):
    features, labels = rings(150)
    parts = np.arange(150) % 3
    said = []
    found = train("auto", features, labels.tolist(), MODEL, parts, report=lambda *step: said.append(step))
    assert isinstance(found, KernelClassifier)
    assert {step for step, *_ in said} == {"training"}
    linear, kernel = said[:-1], said[-1]
    assert [done for _, done, _, _ in linear] == list(range(len(linear)))
    assert linear[0][3].startswith("linear, 3 folds with C = ")
    assert kernel[1:] == (0, 1, "Gaussian kernel of 150 samples, scale 1")
    assert isinstance(train("linear", features, labels.tolist(), MODEL, parts), Classifier)
    alone = train("rbf", features, labels.tolist(), MODEL, parts, alone=True)
    assert isinstance(alone, KernelClassifier)
    assert not alone.linear.weights.any()
    monkeypatch.setattr("streamfeat.classify.training.MOST_POINTS", 149)
    assert isinstance(train("auto", features, labels.tolist(), MODEL, parts), Classifier)
    monkeypatch.undo()
    monkeypatch.setattr("streamfeat.classify.kernel.MOST_POINTS", 149)  # as if there were no memory for it
    assert isinstance(train("auto", features, labels.tolist(), MODEL, parts), Classifier)
    monkeypatch.undo()
    # Where a linear classifier is right for all, it is kept: it is the quicker one.
    features[:, 0] = np.where(labels == "in", 50, 0)
    assert isinstance(train("auto", features, labels.tolist(), MODEL, parts), Classifier)


def test_a_matrix_that_float32_cannot_factor_is_factored_in_float64(monkeypatch):
    rng = np.random.default_rng(0)
    points = np.repeat(rng.standard_normal((20, 3)), 20, axis=0).astype(np.float32)
    targets = np.where(points[:, :1] > 0, np.float32(1), np.float32(-1))
    monkeypatch.setattr(machine_module, "_RIDGE_WEIGHT", 1e-9)  # lost beside one in float32
    kernel = np.exp(-((points[:, None].astype(float) - points) ** 2).sum(axis=2))
    dual = machine_module._dual(points, targets, 1.0)
    assert np.isfinite(dual).all()
    assert np.array_equal(np.sign(kernel @ dual), targets)
