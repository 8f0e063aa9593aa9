"""The bench: its own arithmetic, every part at its smallest, and its page against the results."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
from streams import random_encoder

import streamfeat as sf
from streamfeat.engine.operator import with_fixed_point
from tools.bench import __main__ as program
from tools.bench import floor, material, tables, targets, timing
from tools.bench.direct import measure_floors
from tools.bench.ingest import measure_ingest
from tools.bench.inverse import Problems

ROOT = Path(__file__).resolve().parents[2]
RECORDING = ROOT / "recordings" / "digits_train.mcap"
RESULTS = ROOT / "tools" / "bench" / "results.json"


@pytest.fixture(scope="module")
def digits():
    return material.Material(RECORDING, most=20)


def small_geometry(digits, **changes):
    fields = {"patch": 6, "stride": 3, "n_bins": 3} | changes
    return sf.Geometry(**fields, bin_us=digits.bin_us(3))


def test_a_burst_there_and_back_leaves_an_engine_as_it_was(digits):
    geometry = small_geometry(digits)
    encoder = random_encoder(np.random.default_rng(0), geometry, 20)
    burst = digits.burst(geometry, 100)
    engine = burst.engine(encoder)
    before = engine.features()
    engine.follow(burst.events)
    assert not np.array_equal(engine.features(), before)
    engine.follow(burst.there_and_back[len(burst.events) :])
    assert np.array_equal(engine.features(), before)


@pytest.mark.parametrize("changes", [{}, {"downsample": 2, "stride": 2}, {"stride": 7, "max_count": 3}])
def test_updates_are_what_events_do_to_volumes(digits, changes):
    geometry = small_geometry(digits, **changes)
    burst = digits.burst(geometry, 100)
    updates = material.Updates.of(burst, burst.events, geometry)
    volumes = updates.volumes(geometry, burst.resolution)
    for volume, entry, before, after in updates.rows:
        assert volumes[volume, entry] == before
        volumes[volume, entry] = after
    # The same events in the window of a burst with nothing left to do.
    done = material.Burst(
        burst.resolution, burst.origin_us, np.concatenate([burst.before, burst.events]), burst.events[:1]
    )
    after = material.Updates.of(done, burst.events[:0], geometry)
    assert np.array_equal(after.volumes(geometry, burst.resolution), volumes)


@pytest.mark.skipif(floor.compiler() is None, reason="no C compiler: there is no floor to measure")
@pytest.mark.parametrize("stored", [False, True])
def test_the_floor_has_the_features_of_the_engine(digits, stored):
    geometry = small_geometry(digits)
    encoder = random_encoder(np.random.default_rng(0), geometry, 50)
    burst = digits.burst(geometry, 200)
    updates = material.Updates.of(burst, burst.events, geometry)
    shape = geometry.grid_shape(burst.resolution)
    operator = with_fixed_point(encoder.operator, shape)
    library = floor.compile_floor(floor.BUILDS["C"])
    volumes = updates.volumes(geometry, burst.resolution)
    in_c = floor.Floor(library, operator, volumes, shape, stored=stored)
    engine = burst.engine(encoder)
    for _ in range(2):
        pooled = in_c.pooled[:, : encoder.n_filters].reshape(-1) / operator.unit
        assert np.array_equal(pooled.astype(np.float32), engine.features())
        in_c.moves(updates.rows)()
        engine.follow(burst.events)


def test_a_race_takes_turns_and_counts_a_unit():
    order, now = [], [0]

    def run(name, nanoseconds):
        order.append(name)
        now[0] += nanoseconds

    def contestant(name, nanoseconds, units):
        return timing.Contestant(lambda: run(name, nanoseconds), units, clock=lambda: now[0])

    result = timing.race({"slow": contestant("slow", 1000, 2), "quick": contestant("quick", 100, 1)}, 4)
    assert order[:6] == ["slow", "quick", "slow", "quick", "quick", "slow"]
    assert result.figure("slow") == {"p50": 500, "p10": 500, "p90": 500}
    assert result.ratio("slow", "quick")["p50"] == 5
    assert result.fastest(["slow", "quick"]) == "quick"


def test_rounds_that_the_host_disturbed_are_thrown_away(monkeypatch):
    taken = iter([0, 0, 0, 1, 1, 1, 1, 9, 9, 9])  # seconds by the host before and after each round
    monkeypatch.setattr(timing, "stolen_seconds", lambda: next(taken))
    result = timing.race({"one": timing.Contestant(lambda: None)}, 3)
    assert result.discarded == 2
    assert len(result.nanoseconds["one"]) == 3


def test_the_gap_of_a_solution_is_zero_and_of_anything_else_is_not():
    rng = np.random.default_rng(3)
    atoms, x = np.linalg.qr(rng.normal(size=(6, 6)))[0], rng.normal(size=(2, 6))
    problems = Problems(x, atoms, 0.3)
    solution = np.sign(x @ atoms.T) * np.maximum(np.abs(x @ atoms.T) - 0.3, 0)
    assert problems.gap(solution) == pytest.approx(0, abs=1e-12)
    assert problems.gap(1.1 * solution) > 1e-3


def test_a_target_is_met_missed_or_has_no_figure():
    figures = {"ours_over_floor": {"p50": 1.2, "p10": 1.1, "p90": 1.3}, "bytes": None}
    verdicts = targets.judge({"parts": {"floors": figures, "precision": {"relative": 2.1e-3}}})
    by_figure = {(v.target.part, v.target.bound): v.met for v in verdicts}
    assert by_figure["floors", 2] is True
    assert by_figure["floors", 3.5] is None
    assert by_figure["precision", 2e-3] is False
    assert by_figure["ingest", 5] is None


def test_what_is_missing_is_named_and_the_rest_is_measured(digits, tmp_path, monkeypatch):
    find_spec = importlib.util.find_spec
    without = {"tonic", "eventcv"}
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name in without else find_spec(name)
    )
    monkeypatch.setattr(floor, "compiler", lambda: None)
    setting = material.Setting(digits, True, 20, 3, tmp_path, lambda text: None)
    parts = {"ingest": measure_ingest(setting), "floors": measure_floors(setting)}
    assert parts["ingest"]["missing"] == ["tonic", "eventcv"]
    assert parts["ingest"]["race"]["ns"]["ours"]["p50"] > 0
    assert parts["floors"]["floor"] is None
    assert {v.met for v in targets.judge({"parts": parts})} == {None}
    shown = [tables.TABLES[name](part) for name, part in parts.items()]
    assert "pip install tonic eventcv" in shown[0]
    assert "the same update" not in shown[1]


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Results of every part at its smallest."""
    folder = tmp_path_factory.mktemp("bench")
    path = folder / "results.json"
    arguments = ["--quick", "--filters", "40", "--json", str(path), "--models", str(folder)]
    assert program.main([*arguments, "--recording", str(RECORDING)]) == 0
    return json.loads(path.read_text())


def test_every_part_runs_and_is_shown(quick):
    assert set(quick["parts"]) == set(program.PARTS) == set(quick["runs"])
    assert quick["machine"]["packages"]["numba"] != "missing"
    shown = tables.markdown(quick)
    assert all(target.figure in shown for target in targets.TARGETS)
    assert quick["parts"]["floors"]["floor_equals_ours"] in (True, None)
    assert quick["parts"]["memory"]["one plane"]["allocations_in_1000_events"] == 0
    assert quick["parts"]["memory"]["one plane"]["state_over_least"] >= 1
    assert quick["parts"]["precision"]["relative"] <= 2e-3
    assert len(tables.verdict_lines(quick)) == len(targets.TARGETS)


def test_a_part_that_is_measured_again_leaves_the_others(quick, tmp_path):
    path = tmp_path / "results.json"
    path.write_text(json.dumps(quick))
    assert program.main(["--quick", "--filters", "40", "--json", str(path), "--only", "precision"]) == 0
    again = json.loads(path.read_text())
    assert again["parts"]["floors"] == quick["parts"]["floors"]


def test_what_cannot_be_used_is_one_line(tmp_path, capsys):
    assert program.main(["--only", "flors"]) == 2
    assert program.main(["--recording", str(tmp_path / "none.mcap")]) == 2
    assert program.main(["--readme", "--json", str(tmp_path / "none.json")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 3


def test_the_page_shows_the_results():
    results = json.loads(RESULTS.read_text(encoding="utf-8"))
    assert tables.read_between(ROOT / "tools" / "bench" / "README.md") == tables.markdown(results)


def test_a_readme_without_a_place_is_refused():
    with pytest.raises(ValueError, match="bench:begin"):
        tables.insert("# streamfeat\n", {"parts": {}})
