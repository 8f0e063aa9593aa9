"""The paper's tables by one command: what is run, what an update costs, and how it is shown."""

import pytest
import tiny
from typer.testing import CliRunner

from streamfeat import cli
from streamfeat.cli import evaluating
from streamfeat.evaluate import run as run_module
from streamfeat.evaluate.costs import update_us
from streamfeat.evaluate.page import _sweeps
from streamfeat.evaluate.plan import METHODS, paper_sweeps
from streamfeat.evaluate.published import ACCURACIES, PAPER_SWEEPS
from streamfeat.evaluate.tables import published_table, sweep_tables
from streamfeat.recordings.reader import open_recording


@pytest.fixture(scope="module")
def animals(tmp_path_factory):
    return tiny.write_items(tmp_path_factory.mktemp("paper") / "animals.mcap", tiny.labelled_items(6))


def planned(monkeypatch, *arguments):
    """What a command would run: its cells, and whether updates are timed."""
    found = {}

    def nothing_is_run(data, cells, *, costs, **options):
        found.update(cells=cells, costs=costs)
        raise KeyboardInterrupt

    monkeypatch.setattr(run_module, "evaluate", nothing_is_run)
    monkeypatch.setattr(evaluating, "compile_first", lambda *arguments, **options: None)
    assert CliRunner().invoke(cli.app, ["evaluate", *map(str, arguments)]).exit_code == 130
    return found["cells"], found["costs"]


def test_paper_is_its_preset_with_three_sweeps_of_both_formulations(animals, monkeypatch):
    cells, costs = planned(monkeypatch, animals, "--paper", "--folds", 2, "--volumes", 4_000, "--quiet")
    assert costs
    assert {cell.setting.volumes for cell in cells} == {4_000}
    assert {(cell.setting.encoding, cell.setting.downsample) for cell in cells} == {("triangle", 2)}
    for name, figures in PAPER_SWEEPS.items():
        for method in ("direct", "inverse"):
            swept = [cell.setting for cell in cells if (cell.method, cell.swept) == (method, name)]
            assert [getattr(setting, name) for setting in swept] == [v for v in figures for _ in range(2)]
    # The paper's best setting stands in every sweep, and is run once.
    assert len({str(cell.key) for cell in cells}) == 2 * 2 * 10


def test_paper_keeps_a_preset_that_was_given(animals, monkeypatch):
    cells, _ = planned(monkeypatch, animals, "--paper", "--preset", "fast", "--folds", 2, "--quiet")
    assert {cell.setting.encoding for cell in cells} == {"split"}
    _, costs = planned(monkeypatch, animals, "--method", "counts", "--folds", 2, "--quiet")
    assert not costs


@pytest.mark.parametrize("formulation", ["direct", "inverse"])
def test_an_update_takes_some_time(animals, formulation):
    with open_recording(animals) as recording:
        samples = list(recording.samples())
    encoder = tiny.encoder(formulation)
    assert 0.01 < update_us(encoder, samples) < 100_000
    assert update_us(encoder, samples[:1]) is None  # the first warms up
    assert update_us(encoder, samples, most_seconds=-1) is None


def swept_result():
    """A result with the sweep of filters, figures made up."""
    rows = [
        {
            "method": method,
            "swept": "filters",
            "setting": {"filters": k},
            "accuracy": 0.5,
            "low": 0.4,
            "high": 0.6,
            "difference": {"accuracy": 0.1, "low": 0.0, "high": 0.2},
            "update_us": us,
        }
        for k in PAPER_SWEEPS["filters"]
        for method, us in (("direct", k / 100), ("inverse", 12_345.678))
    ]
    published = {"sweeps": PAPER_SWEEPS, "data": "N-Caltech101", "citation": "theirs"}
    return {"rows": rows, "published": published}


def test_published_accuracies_stand_beside_ours():
    figures = {"accuracy": 0.5, "low": 0.4, "high": 0.6, "swept": ""}
    rows = [{"method": method, **figures} for method in ("direct", "counts", "dart")]
    header, lines = published_table({"rows": rows, "published": {"accuracies": ACCURACIES}})
    assert header[:4] == ("method", "here", "95 % interval", "published, N-Caltech101")
    assert lines == [
        ["direct", "0.500", "0.400-0.600", "0.771", "0.813", "0.968"],
        ["dart", "0.500", "0.400-0.600", "0.703", "", "0.980"],
    ]
    assert set(ACCURACIES) <= set(METHODS)
    both = PAPER_SWEEPS["bins"][7]
    assert {method: ACCURACIES[method]["N-Caltech101"] for method in both} == both


def test_what_an_update_costs_stands_beside_the_papers_figures():
    ((name, (header, lines)),) = sweep_tables(swept_result())
    assert (name, dict(paper_sweeps())[name]) == ("filters", [1000, 1500, 1700, 2000])
    row = dict(zip(header, lines[2], strict=True))
    assert row["filters"] == "1,700"
    assert (row["update of direct, us"], row["update of inverse, us"]) == ("17.00", "12,345.68")
    assert (row["paper's direct"], row["paper's inverse"]) == ("0.771", "0.784")


def test_an_untimed_sweep_has_no_column_of_costs():
    result = swept_result()
    for row in result["rows"]:
        del row["update_us"]
    ((_, (header, _)),) = sweep_tables(result)
    assert not [name for name in header if "update" in name]


def test_costs_are_a_picture_of_their_own():
    pytest.importorskip("bokeh", reason="the extra plot is not installed")
    titles = [part.yaxis[0].axis_label for part in _sweeps(swept_result()) if hasattr(part, "yaxis")]
    assert titles == ["accuracy", "update of one event, us"]
