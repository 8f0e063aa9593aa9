"""What `tools/compare_clusters` measures of an engine, where one is installed: its results come back."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MODULES = {"ray": "ray", "dask": "distributed"}


@pytest.fixture(params=MODULES)
def measured(request, tmp_path):
    """Has the tool measure one engine, and gives the one run that it writes down."""
    if not find_spec(MODULES[request.param]):
        pytest.skip(f"{MODULES[request.param]} is not installed")

    def measure(what):
        words = [what, "--engines", request.param, "--samples", "60", "--each", "5"]
        found = subprocess.run(
            [sys.executable, ROOT / "tools" / "compare_clusters", *words, "--json", tmp_path / "out.json"],
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            timeout=300,
        )
        assert found.returncode == 0, found.stderr
        (run,) = json.loads((tmp_path / "out.json").read_text())["runs"]
        assert "failed" not in run, run
        return run

    return measure


def test_a_killed_worker_costs_tasks_and_changes_no_bit(measured):
    run = measured("worker")
    assert run["encode_same"] is True
    assert run["sums_same"] is True
    assert run["encode_again"] >= 0


def test_who_served_the_keys_of_a_killed_process_is_replaced(measured):
    run = measured("serve")
    assert run["hit"] >= 1
    assert run["again_s"] is not None
    assert run["ended"] is True
