"""The command line in a terminal: help, completion, colour, sixty columns, a few faults among many files."""

import json
import os
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
import tiny
from typer.testing import CliRunner

from streamfeat import cli
from streamfeat.recordings.reader import open_recording

ESCAPE = re.compile(r"\x1b\[([0-9;]*)m")
COMMAND = [
    sys.executable,
    "-c",
    "import sys; sys.argv[0] = 'streamfeat'; from streamfeat.cli import main; main()",
]


def run(*arguments, **options):
    return CliRunner().invoke(cli.app, [*map(str, arguments)], **options)


def in_a_terminal(tmp_path, *arguments, columns=60, **environment):
    """What the command writes to a terminal of so many columns, both outputs together."""
    pty, fcntl, termios = (pytest.importorskip(name) for name in ("pty", "fcntl", "termios"))
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, np.array([40, columns, 0, 0], np.uint16).tobytes())
    kept = {k: v for k, v in os.environ.items() if k not in {"NO_COLOR", "FORCE_COLOR", "COLUMNS", "CI"}}
    environment = kept | {"TERM": "xterm-256color", "COLORTERM": "truecolor"} | environment
    process = subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        stdin=follower,
        stdout=follower,
        stderr=follower,
        env=environment,
        cwd=tmp_path,
    )
    os.close(follower)
    written = b""
    while True:
        try:
            block = os.read(leader, 65536)
        except OSError:  # the other end is closed
            break
        if not block:
            break
        written += block
    os.close(leader)
    return process.wait(60), written.decode()


def sample_folder(folder, n, bad=()):
    """A folder of `n` tiny files in the layout of N-MNIST; those in `bad` cannot be read."""
    for i in range(n):
        path = folder / "Train" / str(i % 2) / f"{i:05}.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        if i in bad:
            path.symlink_to(folder / "nowhere.bin")
        else:
            path.write_bytes(bytes([i % 30, 3, 0x80, 0, i % 200, 5, 5, 0, 1, i % 200]))
    return folder


def test_commands_stand_in_the_order_in_which_they_are_needed():
    names = re.findall(r"^  ([a-z]+)  ", run("--help").stdout, re.MULTILINE)
    assert names[:3] == ["demo", "info", "convert"]
    assert names[-1] == "doctor"
    assert set(names) == {
        command.name or command.callback.__name__ for command in cli.app.registered_commands
    }


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_shown_and_completes(shell, monkeypatch):
    # Whoever tests has no shell above them that could be looked for.
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "true")
    shown = run("--show-completion", shell)
    assert shown.exit_code == 0
    assert "_STREAMFEAT_COMPLETE" in shown.stdout
    environment = {
        "_STREAMFEAT_COMPLETE": f"complete_{shell}",
        "COMP_WORDS": "streamfeat re",
        "COMP_CWORD": "1",
        "_TYPER_COMPLETE_ARGS": "streamfeat re",
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    completed = run(env=environment, prog_name="streamfeat")
    for name in ("replay", "record", "recover"):
        assert name in completed.stdout
    assert "latency" not in completed.stdout


@pytest.mark.parametrize("command", [None, *sorted(c.callback.__name__ for c in cli.app.registered_commands)])
def test_help_fits_into_sixty_columns_and_says_whole_sentences(command):
    arguments = [command, "--help"] if command else ["--help"]
    shown = run(*arguments, terminal_width=60)
    assert shown.exit_code == 0
    assert max(map(len, shown.stdout.splitlines())) <= 60
    assert not re.search(r"[a-z]\.\.\.", shown.stdout)


def test_help_asks_the_terminal_how_wide_it_is(tmp_path):
    status, written = in_a_terminal(tmp_path, "convert", "--help")
    assert status == 0
    assert 50 < max(map(len, written.split("\r\n"))) <= 60


def test_help_waits_neither_for_numba_nor_for_the_markdown_of_rich():
    code = "import sys; from streamfeat.cli import app; app(standalone_mode=False); print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code, "--help"], capture_output=True, text=True, check=True, timeout=60
    )
    loaded = set(done.stdout.splitlines()[-1].split())
    assert "streamfeat.cli" in loaded
    assert not loaded & {"numpy", "numba", "scipy", "zenoh", "asyncio", "rich.markdown", "pygments"}


@pytest.mark.parametrize("no_color", ["", "1"])
def test_colour_is_for_terminals_and_for_who_wants_it(tmp_path, no_color):
    sample_folder(tmp_path / "in", 3, bad=[1])
    environment = {"NO_COLOR": no_color} if no_color else {}
    status, written = in_a_terminal(tmp_path, "convert", "in", "out.mcap", **environment)
    assert status == 1
    assert "00001.bin" in written
    colours = {code for codes in ESCAPE.findall(written) for code in codes.split(";") if code[:1] in "349"}
    colours = {code for code in colours if len(code) == 2}
    assert bool(colours) == (not no_color)


def test_no_line_is_wider_than_a_terminal_of_sixty_columns(tmp_path):
    """But for paths and reasons, which a terminal wraps by itself, so that they can be copied."""
    sample_folder(tmp_path / "in", 3)
    status, written = in_a_terminal(tmp_path, "convert", "in", "out.mcap")
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written)
    assert status == 0
    assert "3/3" in plain
    assert "/s" in plain
    assert max(map(len, re.split(r"[\r\n]+", plain))) <= 60
    assert "3/3" not in in_a_terminal(tmp_path, "convert", "in", "quiet.mcap", "--quiet")[1]


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    """What a replay of two samples needs."""
    folder = tmp_path_factory.mktemp("replay")
    model = tiny.encoder()
    model.save(folder / "model")
    tiny.classifier(model).save(folder / "classifier")
    tiny.write_items(folder / "two.mcap", tiny.labelled_items(2))
    return folder


def test_lines_of_a_replay_stand_above_its_bar(replayed):
    words = ["replay", "two.mcap", "-m", "model", "-c", "classifier", "--verbose", "--speed", "2"]
    status, written = in_a_terminal(replayed, *words)
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written)
    assert status == 0
    lines = re.split(r"[\r\n]+", plain)
    assert max(map(len, lines)) <= 60
    assert sum(" % of " in line for line in lines) == 2
    assert not any(" % of " in line and "replaying" in line for line in lines)
    assert any("replaying" in line and "6/6" in line for line in lines)  # packets and labels


def test_what_goes_to_a_file_while_a_bar_is_shown_is_in_the_file(replayed):
    process = [*COMMAND, "replay", "two.mcap", "-m", "model", "--json-lines", "-", "--emit", "1s"]
    script = f"{shlex.join(process)} > lines"
    leader, follower = pytest.importorskip("pty").openpty()
    with os.fdopen(leader, "rb"), os.fdopen(follower, "wb"):
        done = subprocess.run(
            ["sh", "-c", script], stdin=follower, stderr=follower, cwd=replayed, check=False, timeout=120
        )
    assert done.returncode == 0
    lines = (replayed / "lines").read_text().splitlines()
    assert len([json.loads(line) for line in lines]) >= 2


def test_output_that_is_no_terminal_has_neither_colour_nor_bars(tmp_path):
    sample_folder(tmp_path / "in", 3, bad=[1])
    command = [*COMMAND, "convert", "in", "out.mcap"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    assert "\x1b" not in done.stdout + done.stderr
    assert "converting" not in done.stderr


def test_a_few_unreadable_samples_among_many(tmp_path):
    bad = range(7, 500, 20)
    sample_folder(tmp_path / "in", 500, bad)
    done = run("convert", tmp_path / "in", tmp_path / "out.mcap")
    assert done.exit_code == 1
    with open_recording(tmp_path / "out.mcap") as recording:
        assert len(recording.labels) == 475
        assert not {label.source for label in recording.labels} & {f"Train/1/{i:05}.bin" for i in bad}
    faults = done.stderr.splitlines()
    assert len(faults) == 21
    assert all("No such file" in line and ".bin" in line for line in faults[:20])
    assert faults[-1] == "failed: 5 more; --verbose lists all"
    table = re.sub(r" +", " ", done.stdout)
    assert "samples 475" in table
    assert "failed 25" in table
    again = ["convert", tmp_path / "in", tmp_path / "out.mcap", "--overwrite"]
    assert len(run(*again, "--verbose").stderr.splitlines()) == 25
    said = json.loads(run(*again, "--json").stdout)
    assert (said["samples"], said["failed"], len(said["faults"])) == (475, 25, 25)
    assert {fault["what"] for fault in said["faults"]} == {"failed"}
    assert said["faults"][0]["file"].endswith("Train/1/00007.bin")


def test_one_file_that_cannot_be_read_leaves_no_recording(tmp_path):
    sample_folder(tmp_path / "in", 2, bad=[0, 1])
    done = run("convert", tmp_path / "in", tmp_path / "out.mcap")
    assert isinstance(done.exception, cli.InputError)
    assert "none of the 2 samples can be read" in str(done.exception)
    assert not (tmp_path / "out.mcap").exists()


def test_predicting_does_not_wait_for_scikit_learn():
    code = "import sys, streamfeat.stream.replay, streamfeat.live.listen; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    loaded = set(done.stdout.split())
    assert "streamfeat.classify.classifier" in loaded
    assert not loaded & {"sklearn", "pandas", "bokeh", "pyarrow", "foxglove"}


def test_a_pipe_gets_whole_values_on_one_line_each(tmp_path):
    folder = tmp_path / ("a name that is longer than a line of eighty columns has room for " * 2)
    folder.mkdir()
    path = tiny.write_items(folder / "rec.mcap", tiny.labelled_items(12))
    environment = {k: v for k, v in os.environ.items() if k != "COLUMNS"}
    told = subprocess.run([*COMMAND, "info", path], capture_output=True, text=True, env=environment)
    rows = [line.split(maxsplit=1) for line in told.stdout.splitlines()[1:]]
    assert [row[1].strip() for row in rows if row[0] == "file"] == [str(path)]
    assert "…" not in told.stdout
    names = [row[1].strip() for row in rows if row[0] == "topics"]
    assert len(names) == 1
    assert "messages), " in names[0]
