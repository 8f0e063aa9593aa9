"""What is said of objectives and solutions."""

import json

import numpy as np
import pytest
import tiny

from tools.show_guarantees import largest_rise, main, solutions, table


def test_a_rise_is_found():
    assert largest_rise([10.0, 8.0, 8.0, 5.0]) == 0
    assert largest_rise([10.0, 8.0, 8.4, 5.0]) == pytest.approx(0.05)
    assert largest_rise([10.0]) < 0


def test_codes_that_are_not_the_solution_lie_above_it():
    rng = np.random.default_rng(0)
    atoms = rng.normal(size=(12, 20)).astype(np.float32)
    atoms /= np.linalg.norm(atoms, axis=1, keepdims=True)
    found = solutions(rng.normal(size=(9, 20)).astype(np.float32), atoms, 0.5)
    assert {"scikit-learn lasso_cd", "scikit-learn lasso_lars"} <= set(found)
    for one in found.values():
        assert -1e-5 < one["least"] <= one["most"] < 1e-3
        assert one["codes"] < 0.05


def test_a_recording_keeps_what_is_promised(tmp_path, capsys):
    path = tiny.write_items(tmp_path / "animals.mcap", tiny.labelled_items(6))
    sizes = ["--patch", "3", "--bins", "2", "--filters", "6", "--volumes", "200", "--iterations", "2"]
    assert main([str(path), *sizes, "--json", str(tmp_path / "seen.json")]) == 0
    said = capsys.readouterr().out
    results = json.loads((tmp_path / "seen.json").read_bytes())
    assert [one["formulation"] for one in results] == ["direct", "inverse"]
    assert all(len(one["objective"]) == 4 and one["largest_rise"] < 1e-5 for one in results)
    assert said.count("| animals.mcap | inverse | 6 |") == 1
    assert "scikit-learn lasso_cd" in said
    rising = [dict(results[0], largest_rise=0.25)]
    assert "| 2.5e-01 |" in table(rising)
