"""Features as a step of scikit-learn: cloned, searched over, cached, and refused what is not a sample."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import tiny
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.utils.validation import check_is_fitted

import streamfeat as sf
from streamfeat.classify.classifier import normalise_features
from streamfeat.classify.svm import LinearSVM
from streamfeat.errors import InputError

RECORDINGS = Path(__file__).parents[1] / "recordings"


@pytest.fixture(scope="module")
def digits():
    """Labelled samples of the recordings that come with the project, and the model learned from them."""
    samples = {}
    for split in ("train", "test"):
        with sf.open_recording(RECORDINGS / f"digits_{split}.mcap") as recording:
            samples[split] = list(recording.samples())
    return samples["train"], samples["test"], sf.Encoder.load(RECORDINGS / "digits.safetensors")


def test_a_grid_search_over_a_pipeline(digits):
    train, test, encoder = digits
    pipeline = Pipeline(
        [
            ("features", sf.EventFeatures(encoder)),
            ("normalise", FunctionTransformer(normalise_features)),
            ("scale", StandardScaler()),
            ("svm", LinearSVM()),
        ]
    )
    search = GridSearchCV(pipeline, {"svm__C": [1e-7, 1e-3]}, cv=2)
    search.fit(train, [sample.label.label for sample in train])
    assert search.best_params_["svm__C"] == 1e-3
    assert search.score(test, [sample.label.label for sample in test]) > 0.85


def test_encoders_are_searched_over(digits):
    train, _, encoder = digits
    pipeline = Pipeline(
        [("features", sf.EventFeatures(encoder)), ("scale", StandardScaler()), ("svm", LinearSVM(C=1e-3))]
    )
    random = tiny.encoder(k=2, geometry=encoder.geometry)
    search = GridSearchCV(pipeline, {"features__encoder": [random, encoder]}, cv=2)
    search.fit(train[:100], [sample.label.label for sample in train[:100]])
    assert search.best_params_["features__encoder"].fingerprint == encoder.fingerprint


def test_features_are_a_scikit_learn_transformer(digits):
    train, _, encoder = digits
    step = sf.EventFeatures(encoder, threads=1)
    check_is_fitted(step)
    copied = clone(step)
    assert (copied.threads, copied.encoder.fingerprint) == (1, encoder.fingerprint)
    few = step.fit_transform(train[:5])
    assert few.dtype == np.float32
    assert few.shape == (5, encoder.n_features)
    assert np.array_equal(few, copied.transform(iter(train[:5])))


@pytest.mark.parametrize("pooling", [2, 3])
@pytest.mark.parametrize("encoding", ["soft", "split", "triangle"])
def test_features_are_named_by_cell_and_filter(encoding, pooling):
    """Only the last volume of the first row sees events; codes of one sign fall into one half."""
    geometry = dataclasses.replace(tiny.GEOMETRY, pooling=pooling)
    model = tiny.encoder(encoding=encoding, k=3, geometry=geometry)
    names = sf.EventFeatures(model).get_feature_names_out()
    assert len(set(names)) == len(names) == model.n_features
    events = tiny.steady(0, 90_000, 60, resolution=(4, 4))
    events["x"] += 12
    features = model.encode(events, tiny.RESOLUTION)
    assert {name[:9] for name in names[features != 0]} == {f"cell_0_{pooling - 1}_"}
    if encoding == "split":
        engine = sf.Engine(model, tiny.RESOLUTION, origin_us=int(events["t"][0]))
        engine.feed(events)
        code = engine.codes()[0, -1]
        expected = {
            f"cell_0_{pooling - 1}_{k}_{'pos' if code[k] > 0 else 'neg'}" for k in np.flatnonzero(code)
        }
        assert set(names[features != 0]) == expected


def test_features_come_as_a_data_frame(digits):
    pytest.importorskip("pandas", reason="extra export is not installed")
    train, _, encoder = digits
    step = sf.EventFeatures(encoder).set_output(transform="pandas")
    frame = step.fit_transform(train[:3])
    assert list(frame.columns) == list(step.get_feature_names_out())
    np.testing.assert_array_equal(
        frame.to_numpy(), sf.EventFeatures(encoder).transform(train[:3]), strict=True
    )


def test_what_is_not_a_sample_is_refused(digits):
    _, test, encoder = digits
    with pytest.raises(InputError, match="sample 1 is an array of events without a resolution"):
        sf.EventFeatures(encoder).transform([test[0], test[1].events])
    for wrong in ([1, 2], np.zeros((3, 4)), "events", None, (1, 2, 3)):
        with pytest.raises(InputError, match=r"sample 1 is of type [a-zA-Z]+; give labelled samples"):
            sf.EventFeatures(encoder, resolution=(34, 34)).transform([test[0], wrong])


def test_event_arrays_have_the_features_of_the_offline_path(digits):
    _, test, encoder = digits
    arrays = [sample.events for sample in test[:6]]
    expected = [encoder.encode(events, (34, 34)) for events in arrays]
    step = sf.EventFeatures(encoder, resolution=(34, 34))
    assert np.array_equal(step.transform(arrays), expected)
    pairs = [(events, (34, 34)) for events in arrays]
    assert np.array_equal(sf.EventFeatures(encoder).transform(pairs), expected)
    # Of another tool, and beside samples.
    other = np.zeros(len(arrays[0]), [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])
    for name, theirs in (("t", "t"), ("x", "x"), ("y", "y"), ("p", "on")):
        other[theirs] = arrays[0][name]
    mixed = step.transform([other, test[1]])
    assert np.array_equal(mixed[0], expected[0])
    assert np.array_equal(mixed[1], step.transform([test[1]])[0])
    assert step.transform([]).shape == (0, encoder.n_features)
    assert clone(step).resolution == (34, 34)
