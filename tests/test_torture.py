"""The tool that breaks things, with a trial or two of each kind: it runs, counts, and all survives."""

import json

import pytest
from torture import __main__ as torture
from torture import crowd, kills, outside, soak
from torture.nursery import Nursery
from torture.table import Row, Trials, markdown


@pytest.fixture
def trials(tmp_path):
    return Trials(0.001, 1, tmp_path, lambda line: None)


def survived(rows):
    for row in rows:
        assert row.tried > 0
        assert (row.survived, row.failures) == (row.tried, ())


def test_commands_that_are_killed(trials, monkeypatch):
    """One each of those that are quick; all of them are in the full run."""
    monkeypatch.setattr(kills, "_METHODS", ("counts",))
    with Nursery(kills.ROOT) as nursery:
        commands = [make(nursery, trials) for make in (kills._convert, kills._evaluate)]
        survived([kills._try(nursery, trials, command) for command in commands])


def test_a_short_crowd(trials, monkeypatch):
    monkeypatch.setattr(crowd, "_GROWTH", 256 << 20)
    rows = crowd.crowd(trials)
    survived(rows)
    assert [row.tried for row in rows] == [10_000, 10_000, 400]


def test_trials_from_outside(trials):
    rows = outside.outside(trials)
    survived(rows)
    assert [row.tried for row in rows] == [2, 2, 2, 20, 2]


def test_a_short_soak(trials, monkeypatch):
    # This process holds what all tests before this one left; a run of its own is judged by a few MB.
    monkeypatch.setattr(soak, "_GROWTH", 256 << 20)
    rows = soak.soak(trials)
    survived(rows[:2])
    assert "60 packets" not in markdown(rows)
    assert "1,966,080 events" in rows[0].fault


def test_rows_become_a_table_and_json_and_failures_an_exit_status(monkeypatch, tmp_path, capsys):
    rows = [Row("this", 10, 10, 5, 40, 0.25, 1.0, "a note"), Row("that", 3, 2, failures=("once",))]
    monkeypatch.setattr(torture, "PARTS", {"one": (lambda trials: rows, "of a kind")})
    assert torture.main(["--json", str(tmp_path / "out.json")]) == 1
    said = capsys.readouterr().out
    assert "| this (a note) | 10 | 10 | 5 | 40 | 0.25 s | 1 s |" in said
    assert "FAILED: that: once" in said
    assert [row["survived"] for row in json.loads((tmp_path / "out.json").read_text())] == [10, 2]
