"""The part `growth` of the bench: its model counts what kernels do, and a plan adds up."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import streamfeat as sf
from streamfeat.errors import InputError
from tools.bench import __main__ as program
from tools.bench.fleet_plan import plan
from tools.bench.growth import Run
from tools.bench.growth_model import Constants, Work, _slices, by_volume, work_of
from tools.bench.growth_streams import Load, Stream
from tools.bench.material import Material

ROOT = Path(__file__).resolve().parents[2]
RECORDING = ROOT / "recordings" / "digits_test.mcap"
SMALL = Load("event", filters=8, resolution=(60, 80), rate=20_000)


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
    load = replace(SMALL, emit=emit, stride=stride)
    stream, geometry = Stream(material, load, 2000), load.geometry
    run = Run(load, stream)
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
        work_of(load, Stream(material, load, 2000))
        for load in (replace(SMALL, stride=s, resolution=(240, 240), rate=200_000) for s in (3, 6))
    )
    assert 3 < fine.walked / coarse.walked < 5


def test_constants_come_back_from_times_that_follow_the_model():
    works = [Work(100, 1000), Work(30, 5000), Work(400, 200)]
    truth = Constants(2.0, 0.05)
    found = Constants.fit(works, [truth.predict(work) for work in works])
    assert (found.step_ns, found.byte_ns) == (pytest.approx(2.0), pytest.approx(0.05))


def test_a_plan_adds_up(material):
    constants = Constants(2.0, 0.02)
    load = replace(SMALL, emit="10ms", rate=100_000)
    found = plan(constants, 500.0, material, load, cameras=100, cores=8)
    event_ns = constants.predict(work_of(load, Stream(material, load, 20_000)))
    cores = event_ns * 1e-9 * 100_000 + 100 * 500e-6
    assert found["cores_per_camera"] == pytest.approx(cores, abs=1e-4)
    assert (found["machines"] - 1) * 8 * 0.5 < 100 * cores <= found["machines"] * 8 * 0.5
    assert found["processes"] == found["machines"] * 8
    heaviest = found["cameras_of_the_heaviest_process"]
    assert 100 / found["processes"] < heaviest < 100
    assert found["its_cores"] == pytest.approx(heaviest * cores, abs=1e-3)
    with pytest.raises(InputError, match=r"one camera keeps \d+\.\d+ cores busy"):
        plan(constants, 500.0, material, replace(load, filters=40_000, stride=1), cameras=1, cores=8)


def test_a_plan_comes_from_the_figures_of_a_run(tmp_path, capsys):
    figures = tmp_path / "results.json"
    words = ["--json", str(figures), "--recording", str(RECORDING), "--plan", "10,0.01,100"]
    assert program.main([*words, "--resolution", "60x80"]) == 2
    assert "--only growth" in capsys.readouterr().err
    growth = {"constants": {"step_ns": 2.0, "byte_ns": 0.02}, "fleet": {"packet_us": 500.0}}
    figures.write_text(json.dumps({"parts": {"growth": growth}}))
    assert program.main([*words, "--resolution", "60x80"]) == 0
    assert json.loads(capsys.readouterr().out)["cameras"] == 10
