"""Scores as probabilities: the temperature is the right one, order is kept, files carry it."""

import json
from dataclasses import replace

import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from streamfeat.classify.calibration import (
    calibration_error,
    checked_by_folds,
    fitted_temperature,
    probabilities,
)
from streamfeat.classify.classifier import Classifier, train_classifier
from streamfeat.classify.kernel import load_classifier, train_kernel_classifier
from streamfeat.classify.online import OnlineClassifier
from streamfeat.errors import InputError
from streamfeat.files.safetensors_file import read_safetensors, write_safetensors

MODEL = tiny.encoder()


def drawn(n, temperature, labels=3, seed=0):
    """Scores, and labels that are drawn with the probabilities that they mean."""
    rng = np.random.default_rng(seed)
    scores = rng.normal(0, 2, (n, labels)).astype(np.float32)
    likely = np.exp(scores / temperature)
    likely /= likely.sum(axis=1, keepdims=True)
    return scores, (rng.random((n, 1)) > likely.cumsum(axis=1)).sum(axis=1)


@pytest.mark.parametrize("temperature", [0.3, 1.0, 4.0])
def test_the_temperature_that_labels_were_drawn_with_is_found(temperature):
    scores, targets = drawn(20_000, temperature)
    found = fitted_temperature(scores, targets)
    assert found == pytest.approx(temperature, rel=0.08)
    assert calibration_error(probabilities(scores, found), targets) < 0.02
    assert calibration_error(probabilities(scores, 10 * temperature), targets) > 0.1


def test_a_temperature_that_folds_do_not_agree_on_is_not_used():
    # One fold is hard, as a block of other scenes is: by itself it asks for much more than the others do.
    folds = [drawn(3000, t, labels=2, seed=seed) for seed, t in enumerate((0.7, 0.6, 6.0))]
    scores, targets = (np.concatenate(column) for column in zip(*folds, strict=True))
    parts = np.repeat([0, 1, 2], 3000)
    assert fitted_temperature(scores, targets) > 1.3
    assert checked_by_folds(scores, targets, parts) == 1.0


def test_a_temperature_that_folds_agree_on_is_used():
    folds = [drawn(3000, t, seed=seed) for seed, t in enumerate((3.0, 3.5, 4.0))]
    scores, targets = (np.concatenate(column) for column in zip(*folds, strict=True))
    found = checked_by_folds(scores, targets, np.repeat([0, 1, 2], 3000))
    assert found == fitted_temperature(scores, targets)
    assert 3.0 < found < 4.0


def test_few_samples_without_an_error_make_nothing_certain():
    scores = np.array([[1, -1], [-1, 1], [1, -1], [-1, 1]], np.float32)
    found = probabilities(scores, fitted_temperature(scores, np.array([0, 1, 0, 1])))
    assert (found.max(axis=1) > 0.7).all()
    assert (found.max(axis=1) < 0.9).all()


def test_the_error_of_calibration_is_how_far_confidence_is_from_accuracy():
    found = np.array([[0.95, 0.05], [0.95, 0.05], [0.3, 0.7], [0.3, 0.7]])
    assert calibration_error(found, np.array([0, 0, 1, 0])) == pytest.approx(0.5 * 0.05 + 0.5 * 0.2)


@given(
    arrays(np.float32, (4, 3), elements=st.floats(-100, 100, width=32)),
    st.sampled_from([1e-4, 0.5, 3.0, 1e4]),
)
def test_probabilities_add_up_and_keep_the_order(scores, temperature):
    found = probabilities(scores, temperature)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-5)
    assert np.array_equal(found.argmax(axis=1), scores.argmax(axis=1))
    assert np.array_equal(
        found == found.max(axis=1, keepdims=True), scores == scores.max(axis=1, keepdims=True)
    )
    for i in range(4):  # each row by itself
        assert np.array_equal(probabilities(scores[i : i + 1], temperature)[0], found[i])


def test_the_closest_of_two_scores_is_still_the_highest():
    scores = np.array([[1.0, np.nextafter(np.float32(1), np.float32(2))]], np.float32)
    assert probabilities(scores, 1e4).argmax() == 1


def toys(n=90, seed=0):
    rng = np.random.default_rng(seed)
    labels = np.array(["a", "b", "c"] * (n // 3))
    features = rng.random((n, MODEL.n_features)).astype(np.float32)
    features[np.arange(n), np.unique(labels, return_inverse=True)[1]] += 0.6
    return features, labels


@pytest.fixture(scope="module")
def trained():
    features, labels = toys()
    parts = np.arange(len(labels)) // 3 % 3
    linear = train_classifier(features, labels.tolist(), MODEL, parts=parts)
    return features, labels, linear, train_kernel_classifier(features, linear, labels, parts)


def test_training_calibrates_on_samples_that_were_held_out(trained):
    features, labels, linear, kernel = trained
    fresh, true = toys(600, seed=1)
    for one in (linear, kernel):
        assert one.temperature is not None
        targets = np.searchsorted(one.labels, true)
        error = calibration_error(one.emitted(fresh), targets)
        # Scores of the training samples themselves would make it far too sure.
        seen = fitted_temperature(one.scores(features), np.searchsorted(one.labels, labels))
        assert error < calibration_error(probabilities(one.scores(fresh), seen), targets)
        assert [one.predict(row) for row in fresh] == [
            one.labels[i] for i in one.emitted(fresh).argmax(axis=1)
        ]
    assert train_kernel_classifier(features, linear, labels).temperature is None


def test_the_kernel_is_the_same_with_and_without(trained):
    features, labels, linear, kernel = trained
    (without,), (machine,) = train_kernel_classifier(features, linear, labels).machines, kernel.machines
    assert np.array_equal(without.dual, machine.dual)


def test_files_carry_it_and_old_files_have_scores(trained, tmp_path):
    _, _, linear, kernel = trained
    fresh = toys(9, seed=2)[0]
    for one in (linear, kernel):
        one.save(tmp_path / "clf")
        found = load_classifier(tmp_path / "clf")
        assert np.array_equal(found.emitted(fresh), one.emitted(fresh))
        assert np.array_equal(found.linear.emitted(fresh), linear.emitted(fresh))
    old = replace(linear, temperature=None)
    old.save(tmp_path / "old")
    assert np.array_equal(load_classifier(tmp_path / "old").emitted(fresh), linear.scores(fresh))
    assert b"temperature" not in (tmp_path / "old").read_bytes()


@pytest.mark.parametrize("bad", [0.0, -1.0, 1e9, "warm", True, [1.0]])
def test_a_temperature_out_of_range_is_refused(trained, tmp_path, bad):
    trained[2].save(tmp_path / "clf")
    arrays_, header = read_safetensors(tmp_path / "clf", "streamfeat-classifier", 1)
    header["temperature"] = bad
    write_safetensors(tmp_path / "clf", "streamfeat-classifier", 1, arrays_, header)
    with pytest.raises(InputError, match="temperature is out of range; train it again"):
        Classifier.load(tmp_path / "clf")


def test_one_that_goes_on_learning_keeps_it(trained):
    features, labels, linear, _ = trained
    online = OnlineClassifier(linear, batch_size=4)
    for row, label in zip(features[:8], labels[:8], strict=True):
        online.learn_one(row, str(label))
    assert online.classifier is not linear
    assert online.classifier.temperature == linear.temperature


def test_train_and_replay_carry_probabilities(run, tmp_path):
    tiny.write_digits(tmp_path / "train.mcap", 60, n_held_out=20)
    MODEL.save(tmp_path / "model")
    for kernel in ("linear", "rbf"):
        both = ["-m", tmp_path / "model"]
        said = run(
            "train", tmp_path / "train.mcap", *both, "-o", tmp_path / kernel, "--kernel", kernel, "--json"
        ).json
        assert 0 <= said["held_out_calibration_error"] < 1
        replay = ["replay", tmp_path / "train.mcap", *both, "-c", tmp_path / kernel, "--split", "test"]
        out = run(*replay, "--emit", "50ms", "--json-lines", "-").out
        lines = [json.loads(line) for line in out.splitlines()]
        assert len(lines) > 20
        for line in lines:
            assert sum(line["scores"].values()) == pytest.approx(1, abs=1e-4)
            assert line["prediction"] == max(line["scores"], key=line["scores"].get)
