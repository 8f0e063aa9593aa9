"""The part `growth` of the bench: its streams are endless, and a plan adds up."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

import streamfeat as sf
from streamfeat.errors import InputError
from tools.bench import __main__ as program
from tools.bench.fleet_plan import PACKET_US, plan
from tools.bench.growth import Run, event_ns
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


@pytest.mark.parametrize("emit", ["event", "10ms"])
def test_a_run_feeds_every_camera_all_events_again_and_again(material, emit):
    load = replace(SMALL, emit=emit, cameras=2)
    run = Run(load, Stream(material, load, 2000))
    for _ in range(2):
        run.go()
        run.go_on()
    tallies = [engine.stats() for engine in run._engines]
    assert [(stats.late, stats.rejected) for stats in tallies] == [(0, 0)] * 2
    assert sum(stats.events for stats in tallies) == 2 * run.n
    assert event_ns(material, load, 1) > 0


def test_a_plan_adds_up():
    load = replace(SMALL, emit="10ms", rate=100_000)
    found = plan(1800.0, load, cameras=100, cores=8)
    cores = 1800e-9 * 100_000 + 100 * PACKET_US / 1e6
    assert found["cores_per_camera"] == pytest.approx(cores, abs=1e-4)
    assert (found["machines"] - 1) * 8 * 0.5 < 100 * cores <= found["machines"] * 8 * 0.5
    assert found["processes"] == found["machines"] * 8
    heaviest = found["cameras_of_the_heaviest_process"]
    assert 100 / found["processes"] < heaviest < 100
    assert found["its_cores"] == pytest.approx(heaviest * cores, abs=1e-3)
    with pytest.raises(InputError, match=r"one camera keeps \d+\.\d+ cores busy"):
        plan(18_000.0, load, cameras=1, cores=8)


def test_a_plan_times_an_event_on_this_machine(capsys):
    words = ["--recording", str(RECORDING), "--plan", "10,0.01,20", "--resolution", "60x80"]
    assert program.main(words) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["cameras"] == 10
    assert found["engine_cores_per_camera"] == pytest.approx(found["event_ns"] * 10_000 / 1e9, abs=1e-3)
