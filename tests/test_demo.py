"""The demonstration: what it writes, what it refuses, and that what it says to try next can be typed."""

import json
import shlex
from dataclasses import replace

import pytest
import typer
from test_json import check
from typer.testing import CliRunner

from streamfeat import cli
from streamfeat.demo import demo
from streamfeat.recordings.reader import open_recording


@pytest.fixture(autouse=True)
def small(monkeypatch, tmp_path):
    """Fewer digits, fewer filters; in an empty folder."""
    monkeypatch.setattr(demo, "SIZES", {"train": 30, "test": 4})
    few = replace(demo._SETTING, filters=4, volumes=500, iterations=1)
    monkeypatch.setattr(demo, "_SETTING", few)
    monkeypatch.setattr(demo, "_SPEED", 1000.0)
    monkeypatch.chdir(tmp_path)


def run(*arguments):
    return CliRunner().invoke(cli.app, ["demo", *arguments])


def files(folder):
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}


def test_from_nothing_to_predictions_and_what_to_type_next(tmp_path):
    result = run()
    assert result.exit_code == 0
    assert set(files(tmp_path / "streamfeat-demo")) == set(demo.FILES)
    assert "% of 1" in result.stdout  # not a terminal, so lines of samples
    assert "\x1b" not in result.stdout
    with open_recording("streamfeat-demo/test.mcap") as recording:
        assert len(recording.labels) == 4
    commands = [line for line in result.stdout.splitlines() if line.startswith("streamfeat ")]
    assert len(commands) == 3
    group = typer.main.get_command(cli.app)
    for command in commands:
        _, name, *arguments = shlex.split(command)
        group.commands[name].make_context(name, arguments)
    # One of them is run: what they name is there, and fits together.
    replayed = CliRunner().invoke(cli.app, [*shlex.split(commands[0])[1:], "--json"])
    assert json.loads(replayed.stdout)["samples"] == 4


def test_as_json_without_lines():
    result = run("--json", "--folder", "it's/here")
    said = json.loads(result.stdout)
    check("demo", said)
    assert (said["samples"], said["correct"]) == (4, round(said["accuracy"] * 4))
    assert [shlex.split(command)[0] for command in said["next"]] == ["streamfeat"] * 3
    assert "it's/here/test.mcap" in shlex.split(said["next"][0])


def test_nothing_is_replaced_unasked_and_nothing_unsaid(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "model.safetensors").write_bytes(b"mine")
    (folder / "notes").write_bytes(b"mine")
    result = run("--folder", "mine", "-q")
    assert isinstance(result.exception, cli.InputError)
    assert (
        str(result.exception)
        == "mine: holds model.safetensors already; give --overwrite, or another --folder"
    )
    assert set(files(folder)) == {"model.safetensors", "notes"}
    result = run("--folder", "mine", "-q", "--overwrite")
    assert result.exit_code == 0
    assert "replacing model.safetensors in mine" in result.stderr
    assert (folder / "notes").read_bytes() == b"mine"
    assert (folder / "model.safetensors").read_bytes() != b"mine"


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    result = run("--folder", "file/demo")
    assert isinstance(result.exception, cli.InputError)
    assert "cannot be made" in str(result.exception)


def test_an_interruption_says_so(monkeypatch):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "learn_encoder", interrupted)
    result = run("-q")
    assert result.exit_code == 130
    assert "interrupted; streamfeat-demo holds what was done" in result.stderr
