"""Fixtures of the whole suite."""

import json
import os
import signal
import sys
from dataclasses import dataclass
from pathlib import Path

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell starts what it runs in the background so, and every process that a test starts would inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)

if "PYTEST_XDIST_WORKER" in os.environ:
    # Before NumPy is there: each worker has one core, and threads that wait for one another cost seconds.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

# The same examples at every run where nobody is there to look at a new one; no limit on compiling a kernel.
settings.register_profile("default", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("ci" if os.environ.get("CI") else "default")


# Real sessions, processes and clocks, on machines that others share: a failure counts if it comes again.
# All other tests have one try. What was tried again is in the last line of the run.
WITH_CLOCKS = ("test_live_", "test_view_", "test_cluster", "test_pipeline", "test_what_happens", "test_state")


def pytest_collection_modifyitems(items):
    for item in items:
        if item.path.name.startswith(WITH_CLOCKS):
            item.add_marker(pytest.mark.flaky(reruns=2))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings, which are not part of the repository."""
    default = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"
    folder = Path(os.environ.get("STREAMFEAT_DATA", default))
    if not folder.is_dir():
        pytest.skip("no real recordings: set STREAMFEAT_DATA to their folder")
    return folder.resolve()


@dataclass(frozen=True)
class Result:
    """What became of a command: its exit status, what it printed, and what it said besides."""

    status: int
    out: str
    err: str

    @property
    def json(self):
        return json.loads(self.out)


@pytest.fixture
def run(monkeypatch, capfd):
    """Run the command line in this process, through `main`."""
    from streamfeat import cli

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["streamfeat", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as end:
            cli.main()
        said = capfd.readouterr()
        return Result(end.value.code or 0, said.out, said.err)

    return call
