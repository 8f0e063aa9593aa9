"""What `tools/compare_clusters` measures of an engine, where one is installed: keys are served again."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MODULES = {"dask": "distributed", "ray": "ray"}


def test_who_served_the_keys_of_a_killed_process_is_replaced(tmp_path):
    engine = next((name for name, module in MODULES.items() if find_spec(module)), None)
    if engine is None:
        pytest.skip("neither distributed nor ray is installed")
    out = tmp_path / "out.json"
    words = ["serve", "--engines", engine, "--samples", "20", "--json", out]
    found = subprocess.run(
        [sys.executable, ROOT / "tools" / "compare_clusters", *words],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        timeout=300,
    )
    assert found.returncode == 0, found.stderr
    (run,) = json.loads(out.read_text())["runs"]
    assert "failed" not in run, run
    assert run["hit"] >= 1
    assert run["again_s"] is not None
    assert run["ended"] is True
