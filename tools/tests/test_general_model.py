"""The tool that makes the general model: the scenes are those that the model that ships was learned from."""

import numpy as np
import pytest

import streamfeat as sf

pytest.importorskip("PIL")
from tools import make_general_model as tool


def test_the_first_scenes_are_those_that_the_model_names():
    assert tool.first_scenes_sha256() == sf.general_encoder().provenance["scenes"]["first_sha256"]


def test_scenes_have_events_of_one_window_and_differ():
    found = list(tool.scenes(2, 2))
    for events, (height, width) in found:
        assert len(events) > 200
        assert (events["t"] >= 0).all()
        assert (events["t"] < tool.WINDOW_US).all()
        assert (np.diff(events["t"]) >= 0).all()
        assert events["x"].max() < width
        assert events["y"].max() < height
    assert len({len(events) for events, _ in found}) == 4


def test_what_was_changed_is_told(tmp_path, monkeypatch):
    encoder = sf.general_encoder()
    encoder.save(tmp_path / tool.MODEL)
    (tmp_path / tool.SUMS).write_text(tool.sums(tmp_path))
    monkeypatch.setattr(tool, "make", lambda: encoder)
    assert list(tool.differences(tmp_path)) == []
    with (tmp_path / tool.SUMS).open("a") as file:
        file.write("more")
    assert "does not fit" in next(tool.differences(tmp_path))
    filters = np.roll(encoder.filters, 1, axis=0)
    other = sf.Encoder.build(
        encoder.geometry,
        formulation="direct",
        encoding="split",
        threshold=encoder.threshold,
        filters=filters,
        whitening=encoder.whitening,
        mean=encoder.mean,
        provenance=encoder.provenance,
    )
    monkeypatch.setattr(tool, "make", lambda: other)
    assert any("filters are others" in line for line in tool.differences(tmp_path))
