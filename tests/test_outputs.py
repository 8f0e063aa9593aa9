"""Outputs: one writer each, whole or not there; devices, pipes and links stay, and so do inputs."""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import tiny
from mcap.reader import make_reader
from typer.testing import CliRunner

from streamfeat import cli
from streamfeat.convert.outputs import open_output
from streamfeat.errors import InputError
from streamfeat.evaluate.run import StateFile
from streamfeat.files import outputs
from streamfeat.files.atomic import refuse_input, write_atomically
from streamfeat.files.outputs import OutputFile
from streamfeat.recordings.reader import open_recording
from streamfeat.recordings.writer import RecordingWriter, recover
from streamfeat.stream.emission import Emission
from streamfeat.stream.sinks import JsonLinesSink

ROOT = Path(__file__).resolve().parents[1]

needs_pipes = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes with names")


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def write(path, data):
    with OutputFile(path) as output:
        output.file.write(data)


def test_an_output_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "out"
    path.write_bytes(b"before")
    with OutputFile(path) as output:
        output.file.write(b"after")
        output.file.flush()
        assert path.read_bytes() == b"before"
        assert names(tmp_path) == ["out", "out.part"]
    assert (names(tmp_path), path.read_bytes()) == (["out"], b"after")
    output.close()
    output.abandon()
    assert path.read_bytes() == b"after"


def test_what_fails_leaves_what_was_there(tmp_path):
    (tmp_path / "out").write_bytes(b"before")
    with pytest.raises(RuntimeError), OutputFile(tmp_path / "out") as output:  # noqa: PT012
        output.file.write(b"half")
        raise RuntimeError
    assert (names(tmp_path), (tmp_path / "out").read_bytes()) == (["out"], b"before")


def test_a_part_may_be_kept(tmp_path):
    output = OutputFile(tmp_path / "out")
    output.file.write(b"half")
    output.abandon(keep=True)
    assert (tmp_path / "out.part").read_bytes() == b"half"


def test_what_a_killed_writer_left_is_overwritten_or_refused(tmp_path):
    path, part = tmp_path / "out", tmp_path / "out.part"
    part.write_bytes(b"long, and left")
    with pytest.raises(InputError, match=r"out\.part: left by a writer that did not finish"):
        OutputFile(path, keep_leftover=True)
    assert part.read_bytes() == b"long, and left"
    write(path, b"new")
    assert (names(tmp_path), path.read_bytes()) == (["out"], b"new")
    part.touch()  # killed before it wrote anything: nothing is lost
    OutputFile(path, keep_leftover=True).abandon()


@pytest.mark.parametrize(
    "begin",
    [OutputFile, JsonLinesSink, lambda path: RecordingWriter(path, overwrite=True)],
    ids=["file", "lines", "recording"],
)
def test_a_second_writer_is_refused_and_the_first_goes_on(begin, tmp_path):
    path = tmp_path / "out"
    with OutputFile(path) as output:
        output.file.write(b"mine")
        with pytest.raises(InputError, match=r"out\.part: another command is writing this output"):
            begin(path)
        output.file.write(b", all of it")
    assert path.read_bytes() == b"mine, all of it"
    output = OutputFile(path)  # the lock is gone
    output.abandon()


def test_a_part_that_its_writer_renames_meanwhile_is_not_taken_for_ours(tmp_path, monkeypatch):
    """Between opening and locking the part, the first writer finishes: ours must be another file."""
    path, first = tmp_path / "out", OutputFile(tmp_path / "out")
    first.file.write(b"first")
    flock = outputs.fcntl.flock

    def finish_before(file, how):
        monkeypatch.setattr(outputs.fcntl, "flock", flock)
        first.close()
        flock(file, how)

    monkeypatch.setattr(outputs.fcntl, "flock", finish_before)
    second = OutputFile(path)
    assert path.read_bytes() == b"first"
    second.file.write(b"second")
    second.close()
    assert path.read_bytes() == b"second"


def test_finished_cells_have_one_writer(tmp_path):
    first = StateFile(tmp_path / "result.part", {"format": "x"})
    with pytest.raises(InputError, match="another command is writing this output"):
        StateFile(tmp_path / "result.part", {"format": "x"})
    first.close()
    StateFile(tmp_path / "result.part", {"format": "x"}).close()


# --- what is no file


@needs_pipes
def test_a_pipe_is_written_into(tmp_path):
    pipe, got = tmp_path / "pipe", []
    os.mkfifo(pipe)
    for writer in (write, lambda path, data: write_atomically(path, data)):
        reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()))
        reader.start()
        writer(pipe, b"through")
        reader.join()
    assert (got, names(tmp_path), pipe.is_fifo()) == ([b"through"] * 2, ["pipe"], True)


@needs_pipes
def test_a_recording_goes_through_a_pipe(tmp_path):
    pipe, got = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()))
    reader.start()
    events = tiny.steady(0, 10_000, 100)
    with RecordingWriter(pipe) as writer:
        writer.write_events(events, tiny.RESOLUTION)
    reader.join()
    (tmp_path / "copy.mcap").write_bytes(got[0])
    with open_recording(tmp_path / "copy.mcap") as recording:
        assert np.array_equal(np.concatenate(list(recording)), events)
        assert not recording.losses


@needs_pipes
def test_a_pipe_that_nobody_reads_is_one_line(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.setattr("streamfeat.files.outputs._WAIT_S", 0.1)
    with pytest.raises(InputError, match="nothing has opened this pipe to read it"):
        OutputFile(tmp_path / "pipe")


@needs_pipes
@pytest.mark.parametrize("name", ["out.csv", "out.raw"])
def test_events_are_converted_into_a_pipe(tmp_path, name):
    os.mkfifo(tmp_path / name)
    got = []
    reader = threading.Thread(target=lambda: got.append((tmp_path / name).read_bytes()))
    reader.start()
    events = tiny.steady(0, 10_000, 100)
    for path in (tmp_path / name, tmp_path / f"file_{name}"):
        with open_output(path) as output:
            output.write(events, tiny.RESOLUTION)
    reader.join()
    assert got == [(tmp_path / f"file_{name}").read_bytes()]


def test_a_device_is_written_into():
    before = Path(os.devnull).stat()
    write(Path(os.devnull), b"nothing stays of it")
    write_atomically(Path(os.devnull), b"nothing stays of it")
    assert os.path.samestat(Path(os.devnull).stat(), before)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no device that is full")
def test_a_device_without_room_is_one_line():
    sink = JsonLinesSink(Path("/dev/full"))
    emission = Emission(1000, 1, np.zeros(3, np.float32), (), np.zeros(0, np.float32), None, False, "", False)
    with pytest.raises(InputError, match="/dev/full: cannot be written: " + os.strerror(errno.ENOSPC)):
        sink.write([emission])
    sink.close(failed=True)


@pytest.mark.skipif(not Path("/dev/stdout").exists(), reason="this system has no name for standard output")
@pytest.mark.parametrize("way", ["/dev/stdout", "/dev/fd/1", "link"])
@pytest.mark.parametrize("to_file", [False, True])
def test_standard_output_is_appended_to_under_its_names(way, to_file, tmp_path):
    (tmp_path / "link").symlink_to("/dev/stdout")
    name = str(tmp_path / way) if way == "link" else way
    code = (
        "import sys; from pathlib import Path; from streamfeat.files.outputs import OutputFile\n"
        "print('before', flush=True)\n"
        f"with OutputFile(Path({name!r})) as output: output.file.write(b'between\\n')\n"
        "print('after')"
    )
    with (tmp_path / "said").open("w+b") as said:
        done = subprocess.run(
            [sys.executable, "-c", code], stdout=said if to_file else subprocess.PIPE, cwd=ROOT, check=True
        )
        said.seek(0)
        assert (said.read() if to_file else done.stdout) == b"before\nbetween\nafter\n"
    assert names(tmp_path) == ["link", "said"]
    assert Path("/dev/stdout").is_symlink()


# --- links, folders, inputs


@pytest.mark.parametrize("writer", [write, write_atomically])
def test_a_link_stays_and_its_file_is_replaced(writer, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "file").write_bytes(b"before")
    (tmp_path / "link").symlink_to("folder/file")
    writer(tmp_path / "link", b"after")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "folder" / "file").read_bytes() == b"after"
    assert names(tmp_path / "folder") == ["file"]


@pytest.mark.parametrize("writer", [write, write_atomically])
@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda path: path.mkdir(), "is a folder; give the name of a file"),
        (lambda path: path.symlink_to("nothing"), "is a link to .*nothing, which is not there"),
        (lambda path: path.symlink_to(path.name), "is a link in a circle"),
    ],
    ids=["folder", "dangling", "circle"],
)
def test_what_can_be_no_output_is_one_line(writer, make, says, tmp_path):
    make(tmp_path / "out")
    with pytest.raises(InputError, match=says) as error:
        writer(tmp_path / "out", b"")
    assert str(error.value).startswith(str(tmp_path / "out"))
    assert names(tmp_path) == ["out"]


def test_an_input_is_no_output_under_any_name(tmp_path):
    path = tmp_path / "in"
    path.write_bytes(b"input")
    (tmp_path / "link").symlink_to("in")
    (tmp_path / "same").hardlink_to(path)
    for output in (path, tmp_path / "link", tmp_path / "same", tmp_path / "." / "in"):
        with pytest.raises(InputError, match="is read by this command"):
            refuse_input(output, [None, "s3://a/b", tmp_path / "none", str(path)])
    refuse_input(tmp_path / "other", [path])
    refuse_input(Path(os.devnull), [os.devnull])


def test_commands_refuse_their_input_as_output(tmp_path):
    recording = tiny.write_items(tmp_path / "in.mcap", tiny.labelled_items(4))
    tiny.encoder().save(tmp_path / "model")
    before = recording.read_bytes()
    commands = [
        ["convert", recording, recording],
        ["recover", recording, recording],
        ["replay", recording, "-m", tmp_path / "model", "-o", recording],
        ["replay", recording, "-m", tmp_path / "model", "--json-lines", tmp_path / "model"],
        ["learn", recording, "-o", recording],
        ["train", recording, "-m", tmp_path / "model", "-o", tmp_path / "model"],
        ["evaluate", recording, "-o", recording],
        ["latency", recording, "-m", tmp_path / "model", "--plot", recording],
    ]
    for words in commands:
        result = CliRunner().invoke(cli.app, [*map(str, words), "--overwrite"])
        assert isinstance(result.exception, InputError), words
        assert "is read by this command" in str(result.exception) or words[0] == "latency"
    assert recording.read_bytes() == before
    with pytest.raises(InputError, match="is read by this command"):
        recover(recording, recording, overwrite=True)


# --- two processes


@pytest.mark.parametrize("option", ["--json-lines", "-o"])
def test_two_commands_with_one_output(option, tmp_path):
    """The second says so in one line with status 2; the output of the first is what it is alone."""
    model = tiny.encoder()
    model.save(tmp_path / "model")
    recording = tiny.write_items(tmp_path / "in.mcap", tiny.labelled_items(6))
    command = [
        sys.executable,
        "-m",
        "streamfeat",
        "replay",
        recording,
        "-m",
        tmp_path / "model",
        "--emit",
        "1ms",
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}

    def start(out, *more):
        return subprocess.Popen(
            [*command, option, tmp_path / out, "--json", *more],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    slow = start("out", "--speed", "0.02")
    part = tmp_path / "out.part"
    while not part.exists() and slow.poll() is None:
        pass
    second = start("out", "--overwrite")
    _, said = second.communicate(timeout=200)
    assert second.returncode == 2
    assert said == f"error: {part}: another command is writing this output; give another name\n"
    slow.send_signal(signal.SIGINT)
    slow.communicate(timeout=200)
    assert slow.returncode == 130
    alone = start("alone")
    alone.communicate(timeout=200)
    assert names(tmp_path) == ["alone", "in.mcap", "model", "out"]
    if option == "--json-lines":
        lines = [(tmp_path / name).read_text().splitlines() for name in ("out", "alone")]
        assert lines[0][:-1] == lines[1][: len(lines[0]) - 1]  # the last one is where it was interrupted
        assert all(json.loads(line) for line in lines[0])
    else:
        with (tmp_path / "out").open("rb") as file:
            assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())
