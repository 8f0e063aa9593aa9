"""Classifiers: the linear SVM, files that hold them, training, and learning online."""

import contextlib
import json
import math
import random

import numpy as np
import pytest
import tiny
from safetensors.numpy import load_file, save_file
from scipy.optimize import check_grad, minimize
from sklearn.datasets import make_blobs
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.svm import LinearSVC
from sklearn.utils.estimator_checks import parametrize_with_checks

from streamfeat.classify import online as online_module
from streamfeat.classify import svm as svm_module
from streamfeat.classify.classifier import Classifier, _climb, normalise_features, train_classifier
from streamfeat.classify.online import OnlineClassifier
from streamfeat.classify.svm import LinearSVM
from streamfeat.errors import InputError

# --- the support vector machine


@parametrize_with_checks([LinearSVM()])
def test_svm_is_a_scikit_learn_estimator(estimator, check):
    check(estimator)


def blobs(n_classes, seed=0, dtype=np.float64):
    x, y = make_blobs(150, 6, centers=n_classes, cluster_std=4.0, random_state=seed)
    return ((x - x.mean(0)) / x.std(0)).astype(dtype), y


def svm_objective(weights, bias, x, signs, c):
    return 0.5 * weights @ weights + c * np.square(np.maximum(0, 1 - signs * (x @ weights + bias))).sum()


@pytest.mark.parametrize("c", [1e-3, 0.1, 5.0])
@pytest.mark.parametrize("n_classes", [2, 4])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_svm_solves_the_problem_of_linear_svc(n_classes, c, dtype):
    x, y = blobs(n_classes, dtype=dtype)
    ours = LinearSVM(C=c).fit(x, y)
    # A large intercept scaling all but removes the penalty on the intercept.
    theirs = LinearSVC(C=c, dual=False, intercept_scaling=1e3, tol=1e-8, max_iter=10_000).fit(x, y)
    positive = [1] if n_classes == 2 else range(n_classes)
    assert ours.coef_.shape == theirs.coef_.shape
    for row, name in enumerate(positive):
        signs = np.where(y == name, 1.0, -1.0)
        found, best = (
            svm_objective(m.coef_[row], m.intercept_[row], x.astype(float), signs, c) for m in (ours, theirs)
        )
        assert found <= best * (1 + 1e-4)
        # Nothing is below the minimum either: the two agree.
        assert found >= best * (1 - 1e-3)
    assert np.allclose(ours.decision_function(x), theirs.decision_function(x), atol=0.02)
    assert np.mean(ours.predict(x) == theirs.predict(x)) > 0.99


@pytest.mark.parametrize("n_classes", [2, 3])
def test_svm_gradient(monkeypatch, n_classes):
    x, y = blobs(n_classes)
    caught = []

    def spy(objective, start, **options):
        caught.append((objective, len(start)))
        return minimize(objective, start, **options)

    monkeypatch.setattr(svm_module, "minimize", spy)
    LinearSVM(C=0.3).fit(x, y)
    objective, size = caught[0]
    point = np.random.default_rng(0).standard_normal(size)
    assert check_grad(lambda w: objective(w)[0], lambda w: objective(w)[1], point) < 1e-6


def test_svm_binary_score_is_in_favour_of_the_second_class():
    x = np.array([[-2.0], [-1], [1], [2]])
    model = LinearSVM().fit(x, ["a", "a", "b", "b"])
    assert model.decision_function([[3.0]])[0] > 0
    assert model.predict([[3.0], [-3.0]]).tolist() == ["b", "a"]


# --- features


def test_normalise_features():
    features = np.array([[4.0, -9.0, 0.0], [0.0, 0.0, 0.0]], np.float32)
    rows = normalise_features(features)
    assert np.allclose(rows[0], np.array([2, -3, 0]) / np.sqrt(13))
    assert not rows[1].any()
    assert rows.dtype == np.float32
    assert np.array_equal(normalise_features(features[0]), rows[0])
    assert features[0, 0] == 4.0


# --- files

MODEL = tiny.encoder()


@pytest.mark.parametrize("labels", [("cat", "dog"), ("cat", "dog", "owl"), tuple("abcdefg")])
@pytest.mark.parametrize("order", ["C", "F"])
def test_round_trip(tmp_path, labels, order):
    one = tiny.classifier(MODEL, labels)
    weights = np.asarray(one.weights, order=order)
    one = Classifier(labels, one.centre, one.scale, weights, one.bias, one.fingerprint, {"a": [1]})
    one.save(tmp_path / "clf")
    two = Classifier.load(tmp_path / "clf")
    features = np.random.default_rng(1).standard_normal((20, MODEL.n_features)).astype(np.float32)
    assert np.array_equal(one.weights, two.weights)
    assert np.allclose(one.scores(features), two.scores(features), rtol=1e-5, atol=1e-5)
    assert [one.predict(f) for f in features] == [two.predict(f) for f in features]
    assert len({one.predict(f) for f in features}) > 1
    assert (two.labels, two.fingerprint, two.provenance) == (labels, one.fingerprint, {"a": [1]})
    assert [path.name for path in tmp_path.iterdir()] == ["clf"]


def test_scores():
    clf = tiny.classifier(MODEL, ("cat", "dog"))
    features = np.random.default_rng(0).gamma(1.0, 2.0, MODEL.n_features).astype(np.float32)
    rooted = np.sqrt(features) / np.linalg.norm(np.sqrt(features))
    expected = (rooted - clf.centre) / clf.scale @ clf.weights[:, 0] + clf.bias[0]
    assert np.allclose(clf.scores(features), [-expected, expected], rtol=1e-4)
    assert np.allclose(clf.scores(features[None]), [[-expected, expected]], rtol=1e-4)
    assert clf.predict(features) == ("dog" if expected > 0 else "cat")


def rewrite(source, target, *, arrays=None, header=None, drop=()):
    """A copy of a classifier file with some of it changed."""
    from safetensors import safe_open

    with safe_open(source, framework="numpy") as file:
        meta = json.loads(file.metadata()["streamfeat"]) | (header or {})
    content = {name: a for name, a in (load_file(source) | (arrays or {})).items() if name not in drop}
    meta = {name: value for name, value in meta.items() if name not in drop}
    save_file(content, target, metadata={"streamfeat": json.dumps(meta)})
    return target


N = MODEL.n_features


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"drop": ["weights"]}, "weights is not float32"),
        ({"drop": ["centre"]}, "centre is not float32"),
        ({"drop": ["labels"]}, "labels, fingerprint or provenance"),
        ({"drop": ["fingerprint"]}, "labels, fingerprint or provenance"),
        ({"header": {"labels": ["cat"]}}, "labels, fingerprint or provenance"),
        ({"header": {"labels": [1, 2, 3]}}, "labels, fingerprint or provenance"),
        ({"header": {"labels": ["cat", "cat", "owl"]}}, "labels, fingerprint or provenance"),
        ({"header": {"labels": ["cat", "dog"]}}, "weights is not float32"),
        ({"header": {"provenance": 3}}, "labels, fingerprint or provenance"),
        ({"header": {"version": 2}}, "format version 2"),
        ({"header": {"version": None}}, "format version None"),
        ({"header": {"format": "streamfeat-encoder"}}, "not a streamfeat-classifier file"),
        ({"arrays": {"weights": np.zeros((3, N), np.float32)}}, "weights is not float32"),
        ({"arrays": {"weights": np.zeros((N, 3), np.float64)}}, "weights is not float32"),
        ({"arrays": {"bias": np.zeros((3, 1), np.float32)}}, "bias is not float32"),
        ({"arrays": {"scale": np.ones(N + 1, np.float32)}}, "scale is not float32"),
        ({"arrays": {"scale": np.zeros(N, np.float32)}}, "scale must be above zero"),
        ({"arrays": {"bias": np.full(3, np.nan, np.float32)}}, "bias is not finite"),
        ({"arrays": {"centre": np.full(N, np.inf, np.float32)}}, "centre is not finite"),
    ],
)
def test_unsound_files_are_refused(tmp_path, change, reason):
    tiny.classifier(MODEL).save(tmp_path / "good")
    bad = rewrite(tmp_path / "good", tmp_path / "bad", **change)
    with pytest.raises(InputError, match=reason) as caught:
        Classifier.load(bad)
    assert str(bad) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        Classifier.load(tmp_path / "missing")
    MODEL.save(tmp_path / "model")
    with pytest.raises(InputError, match="not a streamfeat-classifier"):
        Classifier.load(tmp_path / "model")
    with pytest.raises(InputError, match="not a readable"):
        Classifier.load(tmp_path)
    save_file({"a": np.zeros(3, np.float32)}, tmp_path / "foreign")
    with pytest.raises(InputError, match="not a streamfeat-classifier"):
        Classifier.load(tmp_path / "foreign")


def test_truncated_files_are_refused(tmp_path):
    tiny.classifier(MODEL).save(tmp_path / "good")
    data = (tmp_path / "good").read_bytes()
    for size in [*range(0, len(data), 97), len(data) - 1]:
        (tmp_path / "cut").write_bytes(data[:size])
        with pytest.raises(InputError):
            Classifier.load(tmp_path / "cut")


def test_byte_flips_are_refused_or_harmless(tmp_path):
    tiny.classifier(MODEL).save(tmp_path / "good")
    good = (tmp_path / "good").read_bytes()
    rng = random.Random(0)
    refused = 0
    for i in range(400):
        data = bytearray(good)
        # Half of the damage goes to the header, where it means something.
        data[rng.randrange(600 if i % 2 else len(good))] ^= 1 << rng.randrange(8)
        (tmp_path / "bad").write_bytes(data)
        with contextlib.suppress(InputError):
            clf = Classifier.load(tmp_path / "bad")
            assert np.isfinite(clf.weights).all()
            assert clf.weights.shape == (N, 3)
            continue
        refused += 1
    assert refused > 100


def test_a_classifier_of_another_model_is_refused():
    clf = tiny.classifier(MODEL)
    clf.check_fits(MODEL)
    with pytest.raises(InputError, match="there: was trained with another model"):
        clf.check_fits(tiny.encoder(seed=1), path="there")
    with pytest.raises(InputError, match=r"expects 40 features, the model gives 48"):
        clf.check_fits(tiny.encoder(k=6))


# --- training


def toy_features(n, n_classes, seed=0):
    """Features with a pattern for each class, and noise."""
    rng = np.random.default_rng(seed)
    patterns = np.random.default_rng(99).gamma(0.5, 4.0, (n_classes, N))
    labels = [f"class {i % n_classes}" for i in range(n)]
    rows = patterns[np.arange(n) % n_classes] + rng.gamma(1.0, 0.5, (n, N))
    return rows.astype(np.float32), labels


@pytest.mark.parametrize("n_classes", [2, 3])
def test_train_classifier(tmp_path, n_classes):
    features, labels = toy_features(60, n_classes)
    clf = train_classifier(features, labels, MODEL, candidates=(1e-3, 1e-1), provenance={"from": "toys"})
    fresh, expected = toy_features(40, n_classes, seed=1)
    assert [clf.predict(f) for f in fresh] == expected
    prepared = clf.prepare(features)
    assert np.allclose(prepared.mean(axis=0), 0, atol=1e-3)
    assert np.allclose(prepared.std(axis=0), 1, atol=1e-3)
    assert clf.provenance["from"] == "toys"
    assert clf.provenance["C"] in (1e-3, 1e-1)
    assert list(clf.provenance["cross_validation"]) == ["0.001", "0.1"]
    assert clf.provenance["samples"] == 60
    clf.save(tmp_path / "clf")
    assert np.allclose(Classifier.load(tmp_path / "clf").scores(fresh), clf.scores(fresh), atol=1e-4)


def test_cross_validation_is_that_of_a_pipeline():
    features, labels = toy_features(90, 3)
    features += np.random.default_rng(1).gamma(1.0, 6.0, features.shape).astype(np.float32)
    candidates, parts = (1e-4, 1e-2), np.arange(90) // 10 % 3
    trained = train_classifier(features, labels, MODEL, parts=parts, candidates=candidates)
    right = dict.fromkeys(candidates, 0)
    for part in range(3):
        train, test = parts != part, parts == part
        for c in candidates:
            pipeline = make_pipeline(
                FunctionTransformer(normalise_features), StandardScaler(), LinearSVM(C=c)
            )
            pipeline.fit(features[train], np.array(labels)[train])
            right[c] += np.sum(pipeline.predict(features[test]) == np.array(labels)[test])
    found = trained.provenance["cross_validation"]
    assert found == {str(c): pytest.approx(right[c] / 90, abs=0.012) for c in candidates}
    assert min(found.values()) < 1


def test_c_is_looked_for_until_the_best_has_neighbours():
    for best in range(-8, 3):
        tried = []

        def score(c, best=best, tried=tried):
            tried.append(round(math.log10(c)))
            return 0.9 - 0.01 * abs(tried[-1] - best)

        found = {round(math.log10(c)): value for c, value in _climb(score, 1000).items()}
        assert len(tried) == len(found)
        assert max(found, key=found.get) == best
        assert {best - 1, best + 1} <= found.keys()
        # Upwards one after the other, so that each starts from the solution before.
        up = [power for power in tried if power >= -5]
        assert up == list(range(-5, max(up) + 1))


def test_a_hopeless_c_is_the_last():
    tried = []

    def score(c):
        tried.append(c)
        return 0.9 if c < 1e-3 else 0.5

    assert set(_climb(score, 1000)) == set(tried)
    assert max(tried) == pytest.approx(1e-3)


def test_mirror_images_are_on_the_side_of_their_samples():
    # Samples are noise, but each has a twin: whoever has seen the twin knows the label.
    rng = np.random.default_rng(0)
    rows = np.tile(rng.gamma(1.0, 1.0, (150, 400)).astype(np.float32), (2, 1))
    labels = [f"class {i % 2}" for i in range(150)] * 2
    model = tiny.encoder(k=50)

    def accuracy(parts):
        trained = train_classifier(rows, labels, model, parts=parts, candidates=(1e-2,))
        return max(trained.provenance["cross_validation"].values())

    assert accuracy(None) > 0.8
    assert accuracy(np.tile(np.arange(150) // 2 % 3, 2)) < 0.65


def test_svm_warm_start():
    x, y = blobs(3)
    cold = LinearSVM(C=0.3).fit(x, y)
    warm = LinearSVM(C=0.1, warm_start=True).fit(x, y).set_params(C=0.3).fit(x, y)
    assert np.allclose(warm.coef_, cold.coef_, atol=1e-2)
    again = warm.n_iter_, warm.fit(x, y).n_iter_
    assert again[1] <= 2 < again[0]
    assert warm.fit(x[:, :4], y).coef_.shape == (3, 4)  # of another shape: from zero


def test_train_refusals():
    features, labels = toy_features(10, 2)
    with pytest.raises(InputError, match="hold 1 label"):
        train_classifier(features[:5], ["cat"] * 5, MODEL)
    with pytest.raises(InputError, match="'owl' has 2 training samples, 3-fold"):
        train_classifier(features, ["cat"] * 8 + ["owl"] * 2, MODEL)
    for folds in (1, 0, -3):
        with pytest.raises(InputError, match="folds"):
            train_classifier(features, labels, MODEL, folds=folds)
    for missing in ("", None, float("nan")):
        with pytest.raises(InputError, match="2 of 10 training samples have no label, the first is sample 4"):
            train_classifier(features, [*labels[:4], missing, missing, *labels[6:]], MODEL)


# --- learning online


def test_untrained():
    clf = Classifier.untrained(["b", "a", "c", "a"], MODEL)
    assert clf.labels == ("a", "b", "c")
    clf.check_fits(MODEL)
    assert not clf.scores(np.ones(N, np.float32)).any()
    assert Classifier.untrained(["b", "a"], MODEL).weights.shape == (N, 1)
    with pytest.raises(InputError, match="at least two"):
        Classifier.untrained(["a", "a"], MODEL)


@pytest.mark.parametrize("n_classes", [2, 3, 5])
@pytest.mark.parametrize("batch_size", [1, 16])
def test_a_separable_stream_is_learned(n_classes, batch_size):
    features, labels = toy_features(240, n_classes)
    learner = OnlineClassifier(Classifier.untrained(labels, MODEL), batch_size=batch_size)
    right = []
    for row, label in zip(features, labels, strict=True):
        right.append(learner.predict_one(row) == label)
        learner.learn_one(row, label)
    learner.flush()
    assert learner.learned == 240
    # Until the first batch has been learned, every guess is the first label.
    assert right[:batch_size] == [i % n_classes == 0 for i in range(batch_size)]
    assert np.mean(right[-100:]) > 0.97


@pytest.mark.parametrize("n_classes", [2, 4])
def test_batches(n_classes):
    features, labels = toy_features(8, n_classes)
    learner = OnlineClassifier(Classifier.untrained(labels, MODEL), batch_size=3)
    start = learner.classifier
    for i in range(2):
        learner.learn_one(features[i], labels[i])
        assert learner.classifier is start
    learner.learn_one(features[2], labels[2])
    assert learner.classifier is not start
    assert learner.classifier.provenance["learned_online"] == learner.learned == 3
    learner.learn_one(features[3], labels[3])
    learner.flush()
    assert learner.learned == 4
    after = learner.classifier
    learner.flush()
    assert learner.classifier is after


@pytest.mark.parametrize("n_classes", [2, 4])
@pytest.mark.parametrize("batch_size", [1, 5])
def test_one_step_is_passive_aggressive(n_classes, batch_size):
    """PA-I of Crammer et al. (2006): w += min(rate, loss / |x|^2) y x, and as much of y for the bias."""
    features, labels = toy_features(5, n_classes)
    start = tiny.classifier(MODEL, sorted(set(labels)))
    learner = OnlineClassifier(start, rate=0.01, batch_size=batch_size)
    for row, label in zip(features[:batch_size], labels, strict=False):
        learner.learn_one(row, label)
    learner.flush()
    if batch_size > 1:
        return
    x = start.prepare(features[0]).astype(float)
    targets = [-1.0] if n_classes == 2 else [1.0] + [-1.0] * (n_classes - 1)
    for column, y in enumerate(targets):
        w, b = start.weights[:, column].astype(float), float(start.bias[column])
        step = min(0.01, max(0, 1 - y * (w @ x + b)) / (x @ x))
        assert np.allclose(learner.classifier.weights[:, column], w + step * y * x, atol=1e-5)
        assert learner.classifier.bias[column] == pytest.approx(b + step * y, abs=1e-5)


@pytest.mark.parametrize("n_classes", [2, 3])
def test_learning_goes_on_from_a_trained_classifier(tmp_path, n_classes):
    features, labels = toy_features(60, n_classes)
    train_classifier(features, labels, MODEL, candidates=(1e-2,)).save(tmp_path / "clf")
    trained = Classifier.load(tmp_path / "clf")
    learner = OnlineClassifier(trained, batch_size=4)
    fresh, expected = toy_features(30, n_classes, seed=5)
    assert np.array_equal(learner.classifier.scores(fresh), trained.scores(fresh))
    for row, label in zip(fresh, expected, strict=True):
        assert learner.predict_one(row) == label
        learner.learn_one(row, label)
    learner.flush()
    assert learner.classifier.centre is trained.centre
    assert not np.array_equal(learner.classifier.weights, trained.weights)


def test_what_all_features_have_in_common_does_not_hinder_learning_from_nothing():
    """Features of events are positive, and more alike than not."""
    rng = np.random.default_rng(3)
    labels = rng.choice(["a", "b"], 600).tolist()
    rows = (3 + rng.random((600, N))).astype(np.float32)
    rows[:, :4] += np.where(np.array(labels) == "a", 1.0, 0)[:, np.newaxis]
    learner = OnlineClassifier(Classifier.untrained(labels, MODEL))
    right = []
    for row, label in zip(rows, labels, strict=True):
        right.append(learner.predict_one(row) == label)
        learner.learn_one(row, label)
    plain = _perceptron_like(rows, labels)
    assert np.mean(right[100:]) > np.mean(plain[100:]) + 0.3


def _perceptron_like(rows, labels):
    """Right or wrong, of passive-aggressive steps without a centre and without rehearsal."""
    from sklearn.linear_model import SGDClassifier

    model = SGDClassifier(loss="hinge", penalty=None, learning_rate="pa1", eta0=0.01, random_state=0)
    prepared = Classifier.untrained(labels, MODEL).prepare(rows).astype(np.float64)
    right = []
    for start in range(0, len(labels), 16):
        batch = slice(start, start + 16)
        known = model.predict(prepared[batch]) if start else ["a"] * 16
        right += [a == b for a, b in zip(known, labels[batch], strict=False)]
        model.partial_fit(prepared[batch], labels[batch], classes=["a", "b"])
    return right


def test_what_is_kept_to_be_learned_again_is_bounded_and_fair(monkeypatch):
    monkeypatch.setattr(online_module, "_MOST_KEPT", 50)
    features, labels = toy_features(1000, 2)
    learner = OnlineClassifier(Classifier.untrained(labels, MODEL), batch_size=10)
    features[:, -1] = np.arange(1000)
    for row, label in zip(features, labels, strict=True):
        learner.learn_one(row, label)
    assert len(learner._kept) == 50
    # Earlier and later halves are equally likely: 25 of either, give or take three standard deviations.
    size = np.array([row[-1] for row, _ in learner._kept])
    assert 12 <= (size < np.median(learner.classifier.prepare(features)[:, -1])).sum() <= 38


def test_an_unknown_label_is_refused():
    learner = OnlineClassifier(tiny.classifier(MODEL))
    with pytest.raises(InputError, match="'fox' is not one of the classifier's labels: cat, dog, owl"):
        learner.learn_one(np.ones(N, np.float32), "fox")
    learner.flush()
    assert learner.learned == 0


def test_a_tie_goes_to_the_smaller_c():
    """Whatever order they are given in: the stronger regularisation of two that score the same."""
    encoder = tiny.encoder()
    rng = np.random.default_rng(0)
    labels = ["a", "b"] * 12
    rows = rng.standard_normal((24, encoder.n_features)).astype(np.float32)
    rows[::2, :8] += 50
    trained = train_classifier(rows, labels, encoder, candidates=(0.1, 10.0, 1.0), folds=2)
    scores = trained.provenance["cross_validation"]
    assert len(set(scores.values())) == 1
    assert trained.provenance["C"] == 0.1


def test_a_search_for_c_ends_where_larger_ones_are_no_better():
    """Of equal scores the smaller C is the best so far; two in a row that are no better end the climb."""
    asked = []

    def score(c):
        asked.append(round(np.log10(c)))
        return 0.9

    found = _climb(score, 1000)
    assert asked[:3] == [asked[0], asked[0] + 1, asked[0] + 2]
    assert max(asked) == asked[0] + 2
    assert min(found) == 10.0 ** min(asked) < 10.0 ** asked[0]
