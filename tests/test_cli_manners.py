"""What every command does alike: help, version, completion, and one line for what cannot be."""

import inspect
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import tiny
from typer.main import get_command
from typer.testing import CliRunner

from streamfeat import cli
from streamfeat.cli import program
from streamfeat.cli.program import completing

RECORDINGS = Path(__file__).parents[1] / "recordings"
COMMANDS = sorted(get_command(cli.app).commands)


@pytest.mark.parametrize("command", COMMANDS)
def test_h_is_help_everywhere(command):
    short, long = (CliRunner().invoke(cli.app, [command, flag]) for flag in ("-h", "--help"))
    assert (short.exit_code, short.output) == (0, long.output)
    assert "Usage" in short.output


def test_the_version_is_that_of_the_package(run):
    assert run("--version").out == f"streamfeat {version('streamfeat')}\n"
    result = subprocess.run([sys.executable, "-m", "streamfeat", "--version"], capture_output=True, text=True)
    assert (result.returncode, result.stdout) == (0, f"streamfeat {version('streamfeat')}\n")


def test_a_replay_needs_no_linear_algebra_and_what_does_still_finds_it():
    recording, model = (str(RECORDINGS / name) for name in ("digits_test.mcap", "digits.safetensors"))
    code = f"import sys; sys.argv = ['streamfeat', 'replay', {recording!r}, '-m', {model!r}, '--json']\n"
    code += "from streamfeat import cli\n"
    code += "try: cli.main()\nexcept SystemExit: pass\n"
    code += "print('scipy.linalg' in sys.modules)\n"
    code += "import scipy.linalg.cython_blas, sklearn.svm; print(scipy.linalg.inv([[2.0]])[0, 0])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split()[-2:] == ["False", "0.5"]


def test_help_imports_nothing_that_is_slow():
    code = "import sys; sys.argv = ['streamfeat', '-h']\nfrom streamfeat import cli\n"
    code += "try: cli.main()\nexcept SystemExit: pass\n"
    code += "print([name for name in ('numba', 'zenoh', 'sklearn') if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.splitlines()[-1] == "[]"


COMPLETED = [
    ("replay", "--emit", "1", ["1000ev", "10ms"]),
    ("listen", "--emit", "a", ["auto"]),
    ("view", "--emit", "e", ["event"]),
    ("latency", "--emit", "10m", ["10ms"]),
    ("publish", "--speed", "m", ["max"]),
    ("publish", "--encoding", "lib", ["libcaer_cmp", "libcaer"]),
    ("record", "--compression", "z", ["zstd"]),
    ("learn", "--formulation", "i", ["inverse"]),
    ("learn", "--encoding", "s", ["soft", "split"]),
    ("learn", "--preset", "p", ["paper"]),
]


@pytest.mark.parametrize(("command", "option", "typed", "offered"), COMPLETED)
def test_values_of_options_are_completed(command, option, typed, offered):
    """As a shell asks for it."""
    asked = {"_STREAMFEAT_COMPLETE": "complete_bash", "COMP_CWORD": "3"}
    asked["COMP_WORDS"] = f"streamfeat {command} {option} {typed}"
    code = (
        "import sys; sys.argv = ['streamfeat']; from streamfeat.cli import app; app(prog_name='streamfeat')"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | asked, capture_output=True, text=True
    ).stdout
    assert sorted(said.split()) == sorted(offered)


def test_completion_offers_what_begins_so():
    assert completing("lz4", "zstd", "none")("") == ["lz4", "zstd", "none"]
    assert completing("lz4", "zstd", "none")("z") == ["zstd"]
    assert list(inspect.signature(completing("a")).parameters) == ["incomplete"]


DIGITS, MODEL = RECORDINGS / "digits_test.mcap", RECORDINGS / "digits.safetensors"

REFUSED = [
    (
        ["publish", DIGITS, "/robot/cam1"],
        "'/robot/cam1' is no zenoh key, for those have no slash at either end",
    ),
    (["publish", DIGITS, "robot//cam1"], "empty chunks are forbidden"),
    (["publish", DIGITS, "a/b", "--port", "99999"], "--port 99999: there is no such port"),
    (["publish", DIGITS, "a/b", "--speed", "nan"], "--speed 'nan' is not understood"),
    (["publish", DIGITS, "a/b", "--wait", "nan"], "--wait nan"),
    (["listen", "a/*", "-m", MODEL, "--max-delay", "nan"], "a delay of nan s is not possible"),
    (["listen", "a/*", "-m", MODEL, "--port", "0"], "--port 0: there is no such port"),
    (["listen", "/a/b", "-m", MODEL], "give 'a/b', or --ros2 for a ROS 2 topic"),
    (["record", "a/*", "-o", "OUT", "--port", "-1"], "--port -1: there is no such port"),
    (["record", "a/*", "-o", "OUT", "--chunk", "nan"], "a chunk of nan s is not possible"),
    (["replay", DIGITS, "-m", MODEL, "--speed", "nan"], "--speed 'nan' is not understood"),
    (["replay", DIGITS, "-m", MODEL, "--threads", "0"], "0 threads: an engine uses 1 to 256"),
    (["listen", "a/*", "-m", MODEL, "--threads", "1000"], "1000 threads: an engine uses 1 to 256"),
    (["view", DIGITS, "--no-open", "--threads", "-1"], "-1 threads: an engine uses 1 to 256"),
    (["latency", DIGITS, "-m", MODEL, "--threads", "257"], "257 threads: an engine uses 1 to 256"),
    (["topics", "--seconds", "nan"], "--seconds nan"),
    (["topics", "--port", "65536"], "--port 65536: there is no such port"),
]


@pytest.mark.parametrize(("arguments", "said"), REFUSED, ids=lambda v: "-".join(map(str, v[:1])))
def test_what_cannot_be_is_one_line(run, tmp_path, arguments, said):
    result = run(*(tmp_path / "out.mcap" if one == "OUT" else one for one in arguments))
    assert result.status == 2
    assert result.err.startswith("error: ")
    assert result.err.count("\n") == 1
    assert said in result.err
    assert ".rs" not in result.err  # no place in the sources of zenoh
    assert list(tmp_path.iterdir()) == []


def test_a_tiny_model_is_refused_by_a_classifier_of_another(run, tmp_path):
    tiny.encoder(k=3).save(tmp_path / "model")
    result = run(
        "replay", DIGITS, "-m", tmp_path / "model", "-c", RECORDINGS / "digits_classifier.safetensors"
    )
    assert result.status == 2
    assert "digits_classifier.safetensors: expects" in result.err


def test_a_long_name_above_a_short_table_is_not_broken_into_its_width(capsys):
    program.print_result({"labels": 0}, "a_recording_with_a_long_name.mcap", as_json=False)
    assert capsys.readouterr().out.splitlines()[0] == "a_recording_with_a_long_name.mcap"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["repaly"], "error: no such command 'repaly'. Did you mean 'replay'? (`streamfeat -h` says more)"),
        (["replay"], "error: missing argument 'REC' (`streamfeat replay -h` says more)"),
        (["replay", "x.mcap", "--emmit", "10ms"], "error: no such option: --emmit"),
        (["learn", "x.mcap"], "error: missing option '--output' / '-o' (`streamfeat learn -h` says more)"),
        (["replay", "x.mcap", "--speed"], "error: option '--speed' requires an argument"),
    ],
)
def test_a_command_line_that_makes_no_sense_is_told_in_one_line(run, arguments, said):
    told = run(*arguments)
    assert (told.status, told.out) == (2, "")
    assert told.err.startswith(said)
    assert told.err.count("\n") == 1


def test_without_a_command_there_is_help(run):
    told = run()
    assert "Commands:" in told.out + told.err
    assert "error" not in told.err
