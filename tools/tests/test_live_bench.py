"""What `tools/live_bench` does to real processes, but shorter: they come back, all is accounted for."""

import argparse
from pathlib import Path

import pytest
from live_net import compiled, free_port
from test_live_listen import MODEL

from tools.live_bench import faults

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.real_time


@pytest.fixture(scope="module")
def arguments(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    MODEL.save(folder / "model")
    compiled(folder)
    return argparse.Namespace(
        model=folder / "model", recording=ROOT / "recordings" / "digits_test.mcap", cut=1.0, port=0
    )


@pytest.mark.parametrize("fault", [faults.subscriber_stopped, faults.network_cut])
def test_it_comes_back_by_itself_with_true_counts(arguments, fault):
    arguments.port = free_port()
    result = fault(arguments)
    if "skipped" in result:
        pytest.skip(result["skipped"])
    assert result["recovered_s"] is not None
    assert result["packets"] > 0
    assert result["unaccounted"] == 0
    assert (result["duplicates"], result["foreign"], result["restarts"]) == (0, 0, 0)
