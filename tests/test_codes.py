"""How sparse codes are, as an evaluation tells it."""

import numpy as np
import tiny

import streamfeat as sf
from streamfeat.engine.encoder import Encoder
from streamfeat.evaluate.codes import code_statistics


def samples(tmp_path):
    with sf.open_recording(tiny.write_digits(tmp_path / "digits.mcap", 6)) as recording:
        return list(recording.samples())


def with_threshold(model, threshold, filters):
    return Encoder.build(
        model.geometry,
        formulation="direct",
        encoding="split",
        threshold=threshold,
        filters=filters,
        whitening=np.eye(model.geometry.entries),
        mean=np.zeros(model.geometry.entries),
    )


def test_the_share_of_codes_falls_with_the_threshold_and_kurtosis_does_not(tmp_path):
    some, model = samples(tmp_path), tiny.encoder()
    found = [code_statistics(with_threshold(model, t, model.filters), some, 0) for t in (0.0, 0.3, 1e3)]
    assert found[0]["used"] > 0.99
    assert 0.02 < found[1]["used"] < 0.98
    assert found[2]["used"] == 0
    assert len({one["kurtosis"] for one in found}) == 1
    assert code_statistics(with_threshold(model, 0.3, model.filters), some, 0) == found[1]
    assert code_statistics(with_threshold(model, 0.3, model.filters), [], 0) == {}


def test_a_filter_of_one_pixel_answers_more_sparsely_than_one_of_all(tmp_path):
    some, model = samples(tmp_path), tiny.encoder()
    d = model.geometry.entries
    rng = np.random.default_rng(0)
    dense = rng.choice([-1.0, 1.0], (4, d)) / np.sqrt(d)
    one, many = (code_statistics(with_threshold(model, 0.3, f), some, 0) for f in (np.eye(d)[:4], dense))
    assert one["kurtosis"] > many["kurtosis"] + 1
    assert 2 < many["kurtosis"] < 5  # sums of many entries are nearly Gaussian
