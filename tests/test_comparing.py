"""Comparing in evaluation: an earlier result, mirror images at test, calibration; too little to learn."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import tiny

from streamfeat.classify import machine as machine_module
from streamfeat.classify.calibration import calibration_error, confidence_bins, error_of_bins
from streamfeat.classify.classifier import Classifier
from streamfeat.classify.kernel import train_kernel_classifier
from streamfeat.classify.variants import Variant
from streamfeat.errors import InputError
from streamfeat.evaluate import cell as cell_module
from streamfeat.evaluate import feature_files
from streamfeat.evaluate.scores import predict_all
from streamfeat.recordings.reader import Label

MODEL = tiny.encoder()
MIRRORED = Variant(mirror=True)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    folder = tmp_path_factory.mktemp("comparing")
    tiny.write_digits(folder / "digits.mcap", 60)
    MODEL.save(folder / "model")
    return folder


def evaluated(run, home, *options):
    call = [
        "evaluate",
        home / "digits.mcap",
        "-m",
        home / "model",
        "--folds",
        3,
        "--early-samples",
        0,
        "--json",
    ]
    return run(*call, *options)


# An earlier result


def test_a_result_is_compared_with_an_earlier_one_in_pairs(run, home):
    first = evaluated(run, home, "-o", home / "first.json", "--overwrite").json
    said = evaluated(run, home, "--sweep", "kernel=rbf", "--against", home / "first.json").json
    base, rbf = said["rows"]
    assert base["against"] == {"accuracy": 0, "low": 0, "high": 0}
    # The same pairs of samples as a sweep of one run compares.
    assert rbf["against"] == rbf["difference"]
    assert first["rows"][0]["hits"] == base["hits"]
    text = run(
        "evaluate", home / "digits.mcap", "-m", home / "model", "--folds", 3, "--early-samples", 0, "--quiet",
        "--against", home / "first.json",
    ).out  # fmt: skip
    assert "to the first row of the earlier result" in text


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"recordings": ["other.mcap"]}, "only the same samples are compared in pairs"),
        ({"split": "3 folds of whole sources"}, "only the same samples are compared in pairs"),
        ({"rows": [{"hits": "01"}]}, "2 samples; this is .* 60 samples"),
        ({"rows": [{"hits": "0x"}]}, "not a result of `streamfeat evaluate`"),
        ({"rows": []}, "not a result of `streamfeat evaluate`"),
        ({"rows": 7}, "not a result of `streamfeat evaluate`"),
    ],
)
def test_a_result_of_other_samples_is_refused_in_one_line(run, home, change, reason):
    if not (home / "first.json").exists():
        evaluated(run, home, "-o", home / "first.json")
    earlier = json.loads((home / "first.json").read_text()) | change
    (home / "changed.json").write_text(json.dumps(earlier))
    refused = evaluated(run, home, "--against", home / "changed.json")
    assert refused.status == 2
    assert re.search(reason, " ".join(refused.err.split()))


def test_what_is_no_json_is_refused(run, home):
    (home / "broken.json").write_text("{")
    assert evaluated(run, home, "--against", home / "broken.json").status == 2
    assert evaluated(run, home, "--against", home / "absent.json").status == 2


# Mirror images at test


def test_scores_of_the_mirror_image_are_added():
    classifier = tiny.classifier(MODEL)
    classifier = replace(classifier, bias=np.zeros(3, np.float32))
    rng = np.random.default_rng(0)
    rows, images = rng.random((2, 40, MODEL.n_features)).astype(np.float32)
    alone, both = predict_all(classifier, rows), predict_all(classifier, rows, images)
    wanted = classifier.scores(rows) + classifier.scores(images)
    assert both == [classifier.labels[i] for i in wanted.argmax(axis=1)]
    assert both != alone
    assert predict_all(classifier, rows, rows) == alone


def test_a_sweep_of_mirror_images_at_test_shares_features(run, home):
    said = evaluated(run, home, "--sweep", "test-mirror=yes,no", "--sweep", "mirror=yes").json
    rows = {(row["swept"], row["setting"]["test_mirror"]): row for row in said["rows"]}
    assert rows["test_mirror", False]["hits"] == rows["", False]["hits"]
    assert rows["test_mirror", True]["hits"] != rows["", False]["hits"]
    assert "calibration_error" not in rows["test_mirror", True]
    alone = evaluated(run, home, "--test-mirror").json["rows"][0]
    assert alone["hits"] == rows["test_mirror", True]["hits"]
    # Training on mirror images has the same rows whether or not they are needed at test as well.
    trained = evaluated(run, home, "--mirror").json["rows"][0]
    assert trained["hits"] == rows["mirror", False]["hits"]


def test_a_classifier_serves_all_cells_that_differ_in_what_is_scored(run, home, monkeypatch):
    fitted = []
    train = cell_module.train

    def counted(*arguments, **options):
        fitted.append(len(arguments[1]))
        return train(*arguments, **options)

    monkeypatch.setattr(cell_module, "train", counted)
    rows = evaluated(run, home, "--sweep", "test-mirror=yes,no", "--sweep", "mirror=yes").json["rows"]
    assert sorted(fitted) == 3 * [40] + 3 * [80]
    assert len({row["train_s"] for row in rows if not row["setting"]["mirror"]}) == 1


# Features that are kept


def test_kept_features_are_those_that_would_have_been_encoded(run, home, monkeypatch, tmp_path):
    options = ["--test-mirror", "--features", tmp_path]
    alone = evaluated(run, home, "--test-mirror").json["rows"][0]
    assert evaluated(run, home, *options).json["rows"][0]["hits"] == alone["hits"]
    kept = sorted(tmp_path.iterdir())
    assert len(kept) == 2  # of the samples and of their mirror images
    monkeypatch.setattr(feature_files, "encode_recordings", None)
    assert evaluated(run, home, *options, "--sweep", "mirror=yes").json["rows"][0]["hits"] == alone["hits"]
    # Of other samples, or with another model, nothing fits.
    MODEL.save(tmp_path / "again.model")
    assert evaluated(run, home, "-m", tmp_path / "again.model", *options).status == 0
    tiny.encoder(k=3).save(tmp_path / "other.model")
    with pytest.raises(TypeError):
        evaluated(run, home, "-m", tmp_path / "other.model", *options)
    kept[0].write_bytes(kept[1].read_bytes())
    refused = evaluated(run, home, *options)
    assert (refused.status, "does not hold the features" in " ".join(refused.err.split())) == (2, True)


# Calibration over folds


def test_bins_of_folds_add_up():
    rng = np.random.default_rng(1)
    likely = rng.dirichlet([1, 1, 1], 90)
    targets = rng.integers(0, 3, 90)
    apart = sum(confidence_bins(likely[i::3], targets[i::3]) for i in range(3))
    assert error_of_bins(apart) == pytest.approx(calibration_error(likely, targets))
    assert apart[:, 0].sum() == 90
    assert error_of_bins(np.zeros((10, 3))) == 0


def test_rows_tell_the_error_of_calibration(run, home):
    rows = evaluated(run, home, "--sweep", "kernel=rbf").json["rows"]
    assert all(0 < row["calibration_error"] < 1 for row in rows)


# Too little, or too much


def refusal(run, *arguments):
    result = run(*arguments)
    assert result.status == 2
    text = " ".join(result.err.split())
    assert "Traceback" not in text
    return text


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    """Two samples of one class in each of three sources, and one sample of a second class."""
    items = tiny.labelled_items(7, names=("cat",))
    labels = [i for i, item in enumerate(items) if isinstance(item, Label)]
    for number, i in enumerate(labels):
        name = "dog" if number == 6 else "cat"
        items[i] = replace(items[i], label=name, source=f"video {number // 2}")
    return tiny.write_items(tmp_path_factory.mktemp("odd") / "odd.mcap", items)


def test_a_class_of_one_sample_is_refused_in_one_line(run, odd, home, tmp_path):
    model = ["-m", home / "model"]
    for call in (
        ["train", odd, *model, "-o", tmp_path / "clf"],
        ["train", odd, *model, "-o", tmp_path / "clf", "--kernel", "rbf", "--mirror"],
        ["evaluate", odd, *model, "--folds", 2],
    ):
        assert "label 'dog' has 1 training samples" in refusal(run, *call)


def test_groups_of_one_class_are_refused_or_handled(run, home, tmp_path):
    items = tiny.labelled_items(12, names=("cat", "dog"))
    alike = [replace(i, source=f"video of {i.label}") if isinstance(i, Label) else i for i in items]
    path = tiny.write_items(tmp_path / "alike.mcap", alike)
    model = ["-m", home / "model"]
    text = refusal(run, "train", path, *model, "-o", tmp_path / "clf", "--groups", "source")
    assert "too few for 3 folds" in text
    text = refusal(run, "train", path, *model, "-o", tmp_path / "clf", "--groups", "source", "--folds", 2)
    assert "would be in one fold" in text
    # Blocks are of neighbours of every class, whatever their sources are called.
    assert run("train", path, *model, "-o", tmp_path / "clf", "--quiet").status == 0
    apart = [replace(i, source=f"{i.label} {i.start_us}") if isinstance(i, Label) else i for i in items]
    path = tiny.write_items(tmp_path / "apart.mcap", apart)
    assert run("train", path, *model, "-o", tmp_path / "clf2", "--groups", "source", "--quiet").status == 0


def test_fewer_samples_than_folds_are_refused_in_one_line(run, home):
    text = refusal(run, "evaluate", home / "digits.mcap", "-m", home / "model", "--folds", 40)
    assert "40-fold cross-validation needs 40; add samples or lower --folds" in text


def test_a_kernel_larger_than_memory_is_refused_in_one_line(monkeypatch):
    rng = np.random.default_rng(0)
    rows = rng.random((30, MODEL.n_features)).astype(np.float32)
    labels = np.array(["a", "b"] * 15)
    linear = Classifier.untrained(labels.tolist(), MODEL)

    def no_room(*arguments):
        raise MemoryError

    monkeypatch.setattr(machine_module, "_distances", no_room)
    with pytest.raises(
        InputError, match="not enough memory for --kernel rbf with 30 training rows"
    ) as caught:
        train_kernel_classifier(rows, linear, labels)
    assert "\n" not in str(caught.value)


def test_principal_axes_by_iteration_hold_what_the_exact_ones_hold(monkeypatch):
    rng = np.random.default_rng(5)
    rows = (rng.standard_normal((300, 290)) * np.arange(1, 291) ** -1.0).astype(np.float32)
    rows -= rows.mean(axis=0)
    monkeypatch.setattr(machine_module, "_DIMENSIONS", 20)
    exact = machine_module._principal_axes(rows)
    monkeypatch.setattr(machine_module, "_EXACT_AXES", 100)
    for wide in (290, 289):  # by the covariance, and by the rows
        monkeypatch.setattr(machine_module, "_WIDE", wide)
        near = machine_module._principal_axes(rows)
        assert near.shape == exact.shape == (290, 20)
        np.testing.assert_allclose(near.T @ near, np.eye(20), atol=1e-5)
        assert np.square(rows @ near).sum() > 0.999 * np.square(rows @ exact).sum()
        assert machine_module._principal_axes(rows).tobytes() == near.tobytes()
