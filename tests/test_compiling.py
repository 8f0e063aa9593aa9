"""Compiling on two cores: it leaves nothing to compile, ends when it is told, and is not needed twice."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import tiny

import streamfeat
from streamfeat.kernels import cache
from streamfeat.stream import compiling

LEFT = """
import sys

from numba.core import event

compiled = []

class Heard(event.Listener):
    def on_start(self, told):
        compiled.append(told.data["dispatcher"].py_func.__name__)

    def on_end(self, told):
        pass

from streamfeat.engine.geometry import Geometry
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.stream.compiling import compile_together, is_compiled, state_of
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.warming import warm_up

state = sys.argv[1]
assert not is_compiled(state)
compile_together(state)
assert is_compiled(state)
event.register("numba:compile", Heard())
geometry = Geometry(patch=6, n_bins=2, bin_us=5_000)
formulation = "inverse" if state == "lasso" else "direct"
encoding = "triangle" if state == "wide" else "soft"
encoder = random_encoder(0, geometry, 5, formulation, encoding, narrow=state == "narrow")
assert state_of(encoder) == state
warm_up(encoder, EmitPolicy.parse("10ms"))
print(*compiled)
"""


@pytest.fixture
def empty(tmp_path, monkeypatch):
    """A cache without a kernel."""
    monkeypatch.setattr(cache, "folder", lambda: tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))


@pytest.mark.skipif(compiling._cores() < 2, reason="a single core compiles in one process")
@pytest.mark.parametrize("state", ["narrow"])  # as `learn` makes them; the others take a minute more
def test_nothing_is_left_to_compile(tmp_path, state):
    done = subprocess.run(
        [sys.executable, "-c", LEFT, state],
        env=os.environ
        | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(Path(streamfeat.__file__).parent.parent)},
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=390,
        check=False,
    )
    assert (done.returncode, done.stderr, done.stdout) == (0, "", "\n")


@pytest.mark.skipif(compiling._cores() < 2, reason="a single core compiles in one process")
def test_the_processes_end_when_they_are_told(empty):
    with compiling.Compilers("wide") as compilers:
        assert compilers.is_alive()
        processes = list(compilers._started)
        assert len(processes) == 2
        compilers.wait(lambda: False)
        assert compilers.is_alive()
    assert all(process.returncode is not None for process in processes)
    assert not compilers.is_alive()


def test_a_half_does_not_wait_for_one_that_is_gone(empty, monkeypatch):
    """Its input ends with the other process, whatever ended that."""
    monkeypatch.setattr(compiling, "_cores", lambda: 2)
    started = []

    def start(self, half, stdin=None, stdout=None):
        process = subprocess.Popen(
            [
                sys.executable,
                "-c",
                "import sys; sys.stdin.buffer.read()" if stdin else "import os; os.abort()",
            ],
            stdin=stdin or subprocess.DEVNULL,
            stdout=stdout or subprocess.DEVNULL,
        )
        started.append(process)
        self._started.append(process)
        return process

    monkeypatch.setattr(compiling.Compilers, "_start", start)
    compiling.compile_together("wide")
    assert [process.returncode for process in started] == [-6, 0]


def test_of_two_commands_one_compiles_and_the_other_waits_for_it(empty, monkeypatch):
    monkeypatch.setattr(compiling, "_cores", lambda: 2)
    monkeypatch.setattr(
        compiling.Compilers,
        "_start",
        lambda self, half, stdin=None, stdout=None: (
            self._started.append(process := subprocess.Popen(["sleep", "60"], stdin=stdin, stdout=stdout))
            or process
        ),
    )
    with compiling.Compilers("wide") as second:
        second.close()
    with compiling.Compilers("wide") as first:
        second = compiling.Compilers("wide")
        other_state = compiling.Compilers("narrow")
        assert (len(first._started), len(second._started), len(other_state._started)) == (2, 0, 2)
        assert first.is_alive()
        assert second.is_alive()
        other_state.close()
        first.close()  # killed before it was done: whoever waits goes on with it
        assert second.is_alive()
        assert len(second._started) == 2
        third = compiling.Compilers("wide")
        monkeypatch.setattr(third, "_until_s", 0)
        assert not third.is_alive()
        third.close()
        second.close()


@pytest.mark.parametrize("reason", ["compiled", "one core", "no interpreter", "no room for a process"])
def test_no_process_where_it_would_be_of_no_use(empty, monkeypatch, reason):
    def refuse(*arguments, **options):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(compiling, "_cores", lambda: 1 if reason == "one core" else 2)
    if reason == "compiled":
        monkeypatch.setattr(cache, "folder", lambda: None)
    elif reason == "no interpreter":
        monkeypatch.setattr(sys, "executable", "")
    elif reason == "no room for a process":
        monkeypatch.setattr(subprocess, "Popen", refuse)
    with compiling.Compilers("wide") as compilers:
        assert not compilers.is_alive()
        compilers.wait()


@pytest.mark.parametrize("command", ["replay", "train", "latency", "evaluate"])
def test_a_pipe_is_told_why_nothing_comes(run, tmp_path, monkeypatch, command):
    """Once, where kernels are not compiled yet; not where they are, nor where the summary alone is wanted."""
    recording = tiny.write_items(tmp_path / "rec.mcap", tiny.labelled_items(24))
    model = tmp_path / "model"
    tiny.encoder(k=3).save(model)
    line = [command, recording, "-m", model, "--json"]
    line += {
        "train": ["-o", tmp_path / "c", "--overwrite", "--groups", "none"],
        "evaluate": ["--folds", 2],
    }.get(command, [])
    line += {"latency": ["--warm-up", 1, "--limit-events", 9, "--seconds", 1]}.get(command, [])
    monkeypatch.setattr(compiling, "_cores", lambda: 1)  # nothing is started
    told = {}
    for compiled in (True, False):
        monkeypatch.setattr(compiling, "is_compiled", lambda state, compiled=compiled: compiled)
        told[compiled] = run(*line)
        assert told[compiled].status == 0, told[compiled].err
    assert "compiling" not in told[True].err
    assert told[False].err.count("compiling: kernels, once for this version") == 1
    assert "compiling" not in run(*line, "--quiet").err
