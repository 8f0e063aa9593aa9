"""Fixtures of the whole suite."""

import gc
import json
import os
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell starts what it runs in the background so, and every process that a test starts would inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)

if "PYTEST_XDIST_WORKER" in os.environ:
    # Before NumPy is there: each worker has one core, and threads that wait for one another cost seconds.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

# New examples at every run, in CI too: a failure prints the blob that brings its example back. No limit on
# compiling a kernel. CI looks at a third as many where a test does not say how many, for time.
settings.register_profile("default", deadline=None, print_blob=True)
settings.register_profile("ci", settings.get_profile("default"), derandomize=False, max_examples=30)
settings.load_profile("ci" if os.environ.get("CI") else "default")


def pytest_collection_finish():
    """What the modules hold is never garbage: not looked at again, at each of thousands of collections."""
    gc.collect()
    gc.freeze()


BEGUN_FIRST = (
    "test_processors",
    "test_bench",
    "test_invariants",
    "test_kernels",
    "test_cluster",
    "test_scales",
)
"""Files that take a minute and more: with two workers, none of them is to be left alone at the end."""


def pytest_collection_modifyitems(items):
    """Begin with what takes long, and try tests of real networks, processes and clocks again."""
    turns = {name: turn for turn, name in enumerate(BEGUN_FIRST)}
    items.sort(key=lambda item: turns.get(item.path.stem, len(turns)))
    for item in items:
        if item.get_closest_marker("real_time"):
            item.add_marker(pytest.mark.flaky(reruns=2))


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item):
    """Fail in CI where a test is skipped for want of an input that `.ci/run` says is there."""
    outcome = yield
    report = outcome.get_result()
    expected = os.environ.get("STREAMFEAT_CI_INPUTS", "").split(",")
    if report.skipped and isinstance(report.longrepr, tuple):
        reason = report.longrepr[2]
        if any(name and name in reason for name in expected):
            report.outcome, report.longrepr = "failed", f"must not be skipped here: {reason}"


def pytest_terminal_summary(terminalreporter):
    """Say which tests needed another try, and how often."""
    again = [report.nodeid for report in terminalreporter.stats.get("rerun", ())]
    if again:
        terminalreporter.section("tried again")
        for nodeid in dict.fromkeys(again):
            terminalreporter.line(f"{again.count(nodeid)}x {nodeid}")
    terminalreporter.line(f"tried again: {len(again)} times, {len(set(again))} tests of real time")


@pytest.fixture(scope="module")
def every_update_is_worth_a_thread():
    """Engines of several threads share the smallest update: all that holds for one is tried with them."""
    from streamfeat.engine import threads

    with pytest.MonkeyPatch.context() as context:
        context.setattr(threads, "WORTH_A_PART", 1)
        context.setattr(threads, "WORTH_COUNTING", 0)
        yield


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
        # Options that hold for what a command opens are handed on in the environment.
        with patch.dict(os.environ), pytest.raises(SystemExit) as end:
            cli.main()
        said = capfd.readouterr()
        return Result(end.value.code or 0, said.out, said.err)

    return call
