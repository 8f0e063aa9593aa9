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
from streamfeat.classify.classifier import Classifier, normalise_features, train_classifier
from streamfeat.classify.kernel import KernelClassifier, load_classifier, train_kernel_classifier
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
    places = (normalise_features(features) - clf.mean) @ clf.axes
    ridge = KernelRidge(alpha=1e-2, kernel="rbf", gamma=clf.gamma).fit(places, targets)
    expected = ridge.predict((normalise_features(fresh) - clf.mean) @ clf.axes)
    np.testing.assert_allclose(clf.scores(fresh), expected, atol=2e-3)
    # Not more axes than features: distances are those of the normalised features.
    rows = normalise_features(features)
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
    clf.linear.save(tmp_path / "linear")
    assert isinstance(load_classifier(tmp_path / "linear"), Classifier)


@pytest.mark.parametrize(
    ("arrays", "header", "reason"),
    [
        ({"dual": np.zeros((3, 2), np.float32)}, {}, "dual is not float32 of shape"),
        ({"axes": np.zeros((N, 3), np.float32)}, {}, "points is not float32 of shape"),
        ({"points": np.zeros((0, 0), np.float32)}, {}, "points is not float32 of shape"),
        ({"mean": np.full(N, np.nan, np.float32)}, {}, "mean is not finite"),
        ({"bias": np.zeros(7, np.float32)}, {}, "bias is not float32"),
        ({}, {"gamma": -1.0}, "gamma or the number"),
        ({}, {"gamma": "wide"}, "gamma or the number"),
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
    assert "--kernel cubic is unknown" in str(wrong.exception)


def test_one_emission_at_fifteen_thousand_samples_is_quick():
    clf, rng = trained(60), np.random.default_rng(0)
    wide = dataclasses.replace(
        clf,
        axes=rng.standard_normal((N, 256)).astype(np.float32),
        points=rng.standard_normal((15_000, 256)).astype(np.float32),
        dual=rng.standard_normal((15_000, 2)).astype(np.float32),
    )
    row, taken = rings(1)[0][0], []
    for _ in range(30):
        started = time.perf_counter()
        wide.scores(row)
        taken.append(time.perf_counter() - started)
    assert min(taken) < 0.02  # a bound for any machine; figures are in the README of this room
