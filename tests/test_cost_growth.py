"""The model of `tools/cost_growth`: it counts what kernels do, and its tool runs."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live_net import free_port

import streamfeat as sf
from streamfeat.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT))

from tools.bench.material import Material  # noqa: E402
from tools.cost_growth import __main__ as tool  # noqa: E402
from tools.cost_growth.measure import Run  # noqa: E402
from tools.cost_growth.model import Constants, Work, _slices, by_volume, work_of  # noqa: E402
from tools.cost_growth.plan import plan  # noqa: E402
from tools.cost_growth.streams import Setting, Stream  # noqa: E402

RECORDING = ROOT / "recordings" / "digits_test.mcap"
SMALL = Setting("event", filters=8, resolution=(60, 80), rate=20_000)


@pytest.fixture(scope="module")
def material():
    return Material(RECORDING, most=20)


def test_a_stream_has_its_rate_and_goes_on_without_end(material):
    stream = Stream(material, SMALL, 2000)
    rate = len(stream.events) / stream.period_us * 1e6
    assert rate == pytest.approx(SMALL.rate, rel=1e-3)
    engine = sf.Engine(SMALL.encoder(), SMALL.resolution)
    for _ in range(3):
        for part in stream.slices:
            engine.feed(part)
        stream.go_on()
    stats = engine.stats()
    assert (stats.events, stats.late, stats.rejected) == (3 * len(stream.events), 0, 0)


@pytest.mark.parametrize("stride", [3, 4, 12])
@pytest.mark.parametrize("emit", ["event", "10ms"])
def test_what_is_counted_is_what_the_engine_does(material, emit, stride):
    """Codes computed by a real engine, against those that the model counts on the same events."""
    setting = replace(SMALL, emit=emit, stride=stride)
    stream, geometry = Stream(material, setting, 2000), setting.geometry
    run = Run(setting, stream)
    (engine,) = run._engines
    shape = engine.grid_shape
    run.go()
    run.go_on()
    before = engine.stats()
    run.go()
    after = engine.stats()
    codes = changes = 0
    for part in _slices(stream, geometry):
        changes += part.events_changed.sum()
        if emit == "event":
            codes += by_volume(part.events_changed, shape, geometry).sum()
        elif not part.begins_bin:
            codes += np.count_nonzero(by_volume(part.changed, shape, geometry))
        if part.begins_bin:
            filled = part.filled_before if emit == "event" else part.filled
            codes += np.count_nonzero(by_volume(filled, shape, geometry))
    n = len(stream.events)
    assert n - changes == after.saturated - before.saturated
    # A volume that was filled and emptied again within a bin is encoded as well, to nothing.
    assert codes == pytest.approx(after.encoded_volumes - before.encoded_volumes, rel=0.02)


def test_work_grows_as_the_paper_says(material):
    """O(K) bytes, (patch / stride)^2 volumes for an event away from the border, steps whatever K is."""
    one, ten = (work_of(replace(SMALL, filters=k), Stream(material, SMALL, 2000)) for k in (32, 320))
    assert ten.walked == pytest.approx(10 * one.walked)
    assert ten.steps == one.steps
    fine, coarse = (
        work_of(setting, Stream(material, setting, 2000))
        for setting in (replace(SMALL, stride=s, resolution=(240, 240), rate=200_000) for s in (3, 6))
    )
    assert 3 < fine.walked / coarse.walked < 5


def test_constants_come_back_from_times_that_follow_the_model():
    works = [Work(100, 1000), Work(30, 5000), Work(400, 200)]
    truth = Constants(2.0, 0.05)
    found = Constants.fit(works, [truth.predict(work) for work in works])
    assert (found.step_ns, found.byte_ns) == (pytest.approx(2.0), pytest.approx(0.05))


def test_a_plan_adds_up(material):
    constants = Constants(2.0, 0.02)
    setting = replace(SMALL, emit="10ms", rate=100_000)
    found = plan(constants, 500.0, material, setting, cameras=100, cores=8)
    event_ns = constants.predict(work_of(setting, Stream(material, setting, 20_000)))
    load = event_ns * 1e-9 * 100_000 + 100 * 500e-6
    assert found["cores_per_camera"] == pytest.approx(load, abs=1e-4)
    assert (found["machines"] - 1) * 8 * 0.5 < 100 * load <= found["machines"] * 8 * 0.5
    assert found["processes"] == found["machines"] * 8
    heaviest = found["cameras_of_the_heaviest_process"]
    assert 100 / found["processes"] < heaviest < 100
    assert found["its_cores"] == pytest.approx(heaviest * load, abs=1e-3)
    with pytest.raises(InputError, match=r"one camera keeps \d+\.\d+ cores busy"):
        plan(constants, 500.0, material, replace(setting, filters=40_000, stride=1), cameras=1, cores=8)


def test_the_tool_runs(tmp_path, monkeypatch, capsys):
    """As its README section says, but shorter; then a plan from its figures."""
    figures, picture = tmp_path / "growth.json", tmp_path / "growth.svg"

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["cost_growth", "-r", *map(str, (RECORDING, *words))])
        tool.main()
        return capsys.readouterr().out

    said = run("--quick", "--rounds", 1, "--events", 1000, "--port", free_port(), "--json", figures)
    assert said.startswith("| reading | K |")
    report = json.loads(figures.read_text())
    assert len(report["rows"]) == 6
    assert all(row["ns"]["p50"] > 0 and row["predicted_ns"] > 0 for row in report["rows"])
    assert report["processes"]["1"]["events_per_processor_s"] > 0
    (one,) = report["fleet"]["rows"]
    assert (one["cameras"], one["not_used"]) == (1, 0)
    assert one["readings_per_packet"] > 0
    # What so short a run says of this machine is anybody's guess.
    report |= {"constants": {"step_ns": 2.0, "byte_ns": 0.02}, "fleet": {"packet_us": 500.0}}
    figures.write_text(json.dumps(report))
    words = ["--constants", figures, "--plan", "10,0.01,100", "--resolution", "60x80"]
    assert json.loads(run(*words))["cameras"] == 10
    pytest.importorskip("matplotlib", reason="the extra `plot` is not installed")
    run(*words, "--plot", picture)
    assert picture.read_text().startswith("<?xml")
