"""Printing: text from outside as text, and standard outputs that are closed, full or of few letters."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import tiny
from rich.table import Table
from rich.text import Text

from streamfeat.cli.consoles import SafeConsole
from streamfeat.errors import printable, printable_lines

ESCAPES = "\x1b[31mred\x1b[0m\x9b2J\u202e\u2028\x07"


def printed(capsys, *objects):
    SafeConsole(highlight=False, force_terminal=True, color_system="standard").print(*objects)
    return capsys.readouterr().out


def test_whatever_is_printed_does_nothing_to_the_terminal(capsys):
    table = Table(title=ESCAPES)
    table.add_column(ESCAPES)
    table.add_row(ESCAPES)
    table.add_row(Text(ESCAPES, style="red"))
    said = printed(capsys, ESCAPES, Text(ESCAPES), table)
    assert "\x1b[31mred" not in said.replace("\x1b[31m\\x1b[31mred", "")
    assert "\\x1b[31mred" in said
    for bad in "\x9b\u202e\u2028\x07":
        assert bad not in said


def test_lines_stay_and_one_line_is_one():
    assert printable_lines("a\nb\x1b") == "a\nb\\x1b"
    assert printable("a\nb\x1b") == "a b\\x1b"
    assert len(printable_lines("\n" * 5000)) == 5000


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("output")
    encoder = tiny.encoder()
    encoder.save(folder / "model")
    tiny.classifier(encoder).save(folder / "classifier")
    tiny.write_items(folder / "samples.mcap", tiny.labelled_items(6))
    return folder


def command(files, *words, **options):
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])} | options.pop("env", {})
    return subprocess.Popen(
        [sys.executable, "-m", "streamfeat", *words], cwd=files, env=environment, text=True, **options
    )


REPLAY = ["replay", "samples.mcap", "-m", "model", "-c", "classifier"]


@pytest.mark.parametrize("words", [[*REPLAY, "-v"], [*REPLAY, "--json-lines", "-"], ["info", "samples.mcap"]])
def test_a_reader_that_goes_away_is_no_error(files, words):
    process = command(files, *words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    said = process.stderr.read()
    process.stderr.close()
    assert (process.wait(300), "Traceback" in said, "Exception ignored" in said) == (1, False, False)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device without room")
@pytest.mark.parametrize("words", [REPLAY, ["info", "samples.mcap", "--json"], ["--help"]])
def test_standard_output_without_room_is_one_line(files, words):
    with Path("/dev/full").open("w") as full:
        process = command(files, *words, stdout=full, stderr=subprocess.PIPE)
        said = process.stderr.read()
        process.stderr.close()
    assert process.wait(300) == 2
    assert said.splitlines()[-1] == "error: standard output cannot be written: No space left on device"
    assert "Traceback" not in said


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device without room")
def test_a_standard_error_without_room_stops_nothing(files):
    with Path("/dev/full").open("w") as full:
        process = command(files, *REPLAY, "-o", "out.mcap", stdout=subprocess.PIPE, stderr=full)
        said = process.stdout.read()
        process.stdout.close()
    assert process.wait(300) == 0
    assert "accuracy" in said
    (files / "out.mcap").unlink()


@pytest.mark.parametrize("encoding", ["latin-1", "ascii"])
def test_letters_that_the_terminal_lacks_are_shown_by_number(files, encoding):
    shutil.copy(files / "samples.mcap", files / "\u65e5\u672c.mcap")
    process = command(
        files, "info", "\u65e5\u672c.mcap", stdout=subprocess.PIPE, env={"PYTHONIOENCODING": encoding}
    )
    said = process.stdout.read()
    process.stdout.close()
    assert process.wait(300) == 0
    assert "\\u65e5\\u672c.mcap" in said


@pytest.mark.skipif(sys.platform == "darwin", reason="names are UTF-8 there")
def test_names_of_files_that_are_no_text_are_shown(files):
    name = b"bad\xff\x1b[31m.mcap"
    shutil.copy(files / "samples.mcap", os.fsencode(files) + b"/" + name)
    process = command(files, "info", name, stdout=subprocess.PIPE)
    said = process.stdout.read()
    process.stdout.close()
    assert process.wait(300) == 0
    assert "bad\\udcff\\x1b[31m.mcap" in said
    assert "\x1b" not in said
