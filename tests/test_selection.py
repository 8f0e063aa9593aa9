"""Filters chosen by labels: which, from which samples, and what is kept of them."""

import numpy as np
import pytest
import tiny

from streamfeat.classify.classifier import Classifier, train_classifier
from streamfeat.classify.features import encode_recordings
from streamfeat.classify.selection import filter_weights, with_best_filters
from streamfeat.engine.encoder import Encoder
from streamfeat.errors import InputError
from streamfeat.evaluate import cell as cell_module
from streamfeat.evaluate.plan import plan_cells
from streamfeat.evaluate.splits import DataSet
from streamfeat.recordings.reader import open_recording
from streamfeat.work.workers import THIS_PROCESS

MODEL = tiny.encoder(k=8)
LEARN = {"patch": 6, "stride": 6, "bins": 2, "filters": 4, "volumes": 300, "iterations": 2, "max_count": 2}


@pytest.mark.parametrize("encoding", ["soft", "split", "triangle"])
@pytest.mark.parametrize("names", [("a", "b"), ("a", "b", "c")])
def test_a_filter_weighs_what_its_features_weigh(encoding, names):
    model = tiny.encoder(encoding=encoding, k=8)
    classifier = tiny.classifier(model, names)
    found = filter_weights(model, classifier)
    halves = 2 if encoding == "split" else 1
    for k in range(8):
        mine = [
            classifier.weights[(cell * halves + half) * 8 + k] for cell in range(4) for half in range(halves)
        ]
        assert found[k] == pytest.approx(np.square(mine).sum(), rel=1e-6)


def test_filters_that_tell_labels_apart_are_kept():
    rng = np.random.default_rng(0)
    labels = rng.choice(["a", "b"], 200)
    rows = rng.random((200, MODEL.n_features)).astype(np.float32)
    for k in (2, 5):
        rows[labels == "a", k::8] += 1
    trained = train_classifier(rows, labels.tolist(), MODEL)
    kept = with_best_filters(MODEL, trained, 2)
    assert kept.provenance["kept_filters"] == [2, 5]
    np.testing.assert_array_equal(kept.filters, MODEL.filters[[2, 5]])
    assert kept.n_features == MODEL.n_features // 4
    # The same features as before, but for the quantisation, whose step is that of the largest entry.
    events = tiny.stream(range(0, 90_000, 200))
    before = MODEL.encode(events, tiny.RESOLUTION).reshape(-1, 8)[:, [2, 5]].ravel()
    np.testing.assert_allclose(kept.encode(events, tiny.RESOLUTION), before, atol=2e-3, rtol=1e-3)
    assert before.any()


def test_what_cannot_be_chosen_is_refused():
    classifier = tiny.classifier(MODEL)
    for n in (0, 9, -1):
        with pytest.raises(InputError, match=f"{n} of 8 filters cannot be kept; give 1 to 8"):
            with_best_filters(MODEL, classifier, n)
    assert with_best_filters(MODEL, classifier, 8).n_filters == 8
    with pytest.raises(InputError, match="trained with another model"):
        with_best_filters(tiny.encoder(k=8, seed=1), classifier, 2)
    both = Encoder.side_by_side([MODEL, MODEL])
    with pytest.raises(InputError, match="those of one scale"):
        filter_weights(both, Classifier.untrained(["a", "b"], both))
    for options, reason in (
        ({"select": 0}, "select is 0, it must be from 1 to 16"),
        ({"select": 17}, "select is 17"),
        ({"select": 2, "scales": "4@2"}, "those of one scale"),
    ):
        with pytest.raises(InputError, match=reason):
            plan_cells(["direct"], LEARN | options, [], 1)


def test_labels_of_held_out_samples_have_no_say(tmp_path):
    """The same filters are chosen whatever the held-out samples are called."""
    chosen = []
    for name in ("cat", "dog"):
        items = tiny.labelled_items(30, names=("cat", "dog"))
        items = [
            cell_module.replace(item, label=name, split="test")
            if hasattr(item, "label") and item.start_us < 2_000_000
            else item
            for item in items
        ]
        path = tiny.write_items(tmp_path / f"{name}.mcap", items)
        (cell,) = plan_cells(["direct"], LEARN | {"patch": 4, "stride": 4, "select": 3}, [], 1)
        data = DataSet([path], None, 2, 0)
        with data.open(0) as recordings:
            chosen.append(cell_module._features(cell, data, recordings, lambda *said: None, THIS_PROCESS))
    assert chosen[0].n_filters == 4
    assert chosen[0].provenance["of_filters"] == 12
    assert chosen[0].fingerprint == chosen[1].fingerprint


def test_evaluate_learns_many_and_keeps_some(run, tmp_path):
    path = tiny.write_digits(tmp_path / "digits.mcap", 60, n_held_out=20)
    options = [f"--{name.replace('_', '-')}={value}" for name, value in LEARN.items()]
    said = run(
        "evaluate", path, *options, "--method", "direct", "--method", "kmeans", "--select", 3, "--sweep",
        "select=1", "--early-samples", 0, "--json",
    ).json  # fmt: skip
    rows = {(row["method"], row["setting"]["select"]): row for row in said["rows"]}
    assert {row["features"] for row in rows.values()} == {4 * 8}
    assert set(rows) == {("direct", 3), ("direct", 1), ("kmeans", 3), ("kmeans", 1)}


def test_train_writes_the_smaller_model_and_its_classifier(run, tmp_path):
    path = tiny.write_digits(tmp_path / "digits.mcap", 60, n_held_out=20)
    MODEL.save(tmp_path / "model")
    said = run(
        "train", path, "-m", tmp_path / "model", "-o", tmp_path / "clf", "--select", 3, "--selected-model",
        tmp_path / "small", "--mirror", "--kernel", "linear", "--json",
    ).json  # fmt: skip
    assert said["selected_model"] == str(tmp_path / "small")
    small = Encoder.load(tmp_path / "small")
    assert small.n_filters == 3
    classifier = Classifier.load(tmp_path / "clf")
    classifier.check_fits(small)
    with open_recording(path) as recording:
        samples = encode_recordings(small, [recording])
    right = [classifier.predict(row) for row in samples.rows[:20]] == samples.labels[:20]
    assert said["held_out_accuracy"] == pytest.approx(right.mean())
    replayed = run(
        "replay", path, "-m", tmp_path / "small", "-c", tmp_path / "clf", "--split", "test", "--json"
    )
    assert replayed.json["correct"] == right.sum()
    for half in (["--select", 3], ["--selected-model", tmp_path / "other"]):
        refused = run("train", path, "-m", tmp_path / "model", "-o", tmp_path / "c", *half)
        assert refused.status == 2
        assert "--select and --selected-model go together" in " ".join(refused.err.split())
