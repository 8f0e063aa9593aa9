"""Cameras on two workers in network namespaces of their own: one dies, and nothing goes uncounted."""

import argparse
from pathlib import Path

import pytest
from live_net import compiled, free_port
from test_live_listen import MODEL

pytest.importorskip("distributed", reason="needs the extra `cluster`")

from tools.live_bench import workers

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.real_time


def test_another_serves_the_cameras_of_a_worker_that_is_killed(tmp_path):
    MODEL.save(tmp_path / "model")
    compiled(tmp_path)
    arguments = argparse.Namespace(
        model=tmp_path / "model",
        recording=ROOT / "recordings" / "digits_test.mcap",
        port=free_port(),
        cases=["state"],
        rounds=1,
    )
    result = workers.measure_workers(arguments)
    if "skipped" in result:
        pytest.skip(result["skipped"])
    (row,) = result["rows"]
    (found,) = row["rounds"]
    assert found["served_again_s"] is not None
    assert (found["unaccounted"], found["served_twice"]) == (0, 0)
    assert found["restarts"] == len(found["of_each"]) > 0
    assert all(one["packets"] > 0 for one in found["counts"].values())
    assert row["does"] in workers.table(result)
