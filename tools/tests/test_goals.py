"""Goals and profiles: two versions by turns, here both of them this one, and rows that say what they miss."""

from pathlib import Path

import numpy as np
import pytest

from tools.bench import goals
from tools.bench.camera_streams import EMIT_US, CameraStream, sampled
from tools.bench.trees import ROOT, Tree, TreeError, compared, pair

RECORDING = ROOT / "recordings" / "digits_train.mcap"


@pytest.fixture(scope="module")
def tree():
    one = Tree(ROOT)
    yield one
    one.close()


def test_samples_follow_each_other_whole_emissions_apart():
    stream = sampled(CameraStream("digits", "", (34, 34)), Path(), RECORDING, 40)
    assert len(stream.starts) > 1
    assert not (stream.starts % EMIT_US).any()
    assert (np.diff(stream.events["t"]) >= 0).all()
    assert stream.events["t"][0] >= stream.starts[0] == 0


def test_an_emission_in_steps_has_the_features_of_one_that_is_read(tree, tmp_path):
    model, stream = tmp_path / "model", tmp_path / "stream.npz"
    sampled(CameraStream("digits", "", (34, 34)), Path(), RECORDING, 30).save(stream)
    tree.do(do="model", model=model, filters=20, geometry={"patch": 6, "stride": 3})
    task = {"do": "emissions", "model": model, "stream": stream, "resolution": (34, 34)}
    found = compared({"now": tree}, 1, {"now": task, "now, in steps": task | {"steps": True}})
    (whole,), (steps,) = found["now"], found["now, in steps"]
    assert whole["digest"] == steps["digest"]
    assert whole["emissions"] == steps["emissions"] > 0
    assert min(steps[name]["processor"] for name in ("feed", "marking", "renewing", "boundary")) > 0
    assert pair(found, "features.clock", "now", "now").ratio["p50"] == 1


def test_what_a_version_cannot_do_is_a_row_with_the_reason(tree, tmp_path, capsys):
    with pytest.raises(TreeError, match="InputError"):
        tree.do(do="emissions", model=tmp_path / "none", stream=tmp_path / "none", resolution=(1, 1))
    bench = goals.Bench({"before": tree, "now": tree}, tmp_path / "none", RECORDING, tmp_path, 1, 4)
    goals._print_rows(bench, "features")
    assert "left out" in capsys.readouterr().out
