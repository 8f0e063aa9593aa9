"""Trials from outside, each of which went wrong once: other users, other processes, other threads."""

import os
import stat
import subprocess
import sys
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest
import tiny

from streamfeat.convert.datasets import find_samples
from streamfeat.engine.engine import Engine
from streamfeat.errors import InputError
from streamfeat.live.listen import ListenJob
from streamfeat.live.names import PlainNames
from streamfeat.messages.packets import MAX_LABEL_TEXT, Label, Packet
from streamfeat.recordings.reader import open_recording
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.stream.cameras import Cameras
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("attack") / "model"
    tiny.encoder().save(path)
    return path


def permissions(path):
    return stat.S_IMODE(path.stat().st_mode)


# --- what is written


def test_what_live_cameras_saw_is_for_this_user_alone(tmp_path):
    with RecordingWriter(tmp_path / "live.mcap", private=True) as writer:
        assert permissions(tmp_path / "live.mcap.part") == 0o600
        writer.write_events(tiny.stream(range(100)), tiny.RESOLUTION)
    with RecordingWriter(tmp_path / "shared.mcap") as writer:
        writer.write_events(tiny.stream(range(100)), tiny.RESOLUTION)
    assert permissions(tmp_path / "live.mcap") == 0o600
    assert permissions(tmp_path / "shared.mcap") == 0o666 & ~umask()


def umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def listening(model, state):
    return ListenJob(PlainNames("a/*"), model, state=state, publish=False)


def refuses(job, said):
    with pytest.raises(InputError, match=said), job.opened(list):
        pass


def test_a_state_has_one_listener_and_is_for_this_user_alone(model, tmp_path):
    state = tmp_path / "state"
    first, second = listening(model, state), listening(model, state)
    with first.opened(list):
        refuses(second, "another command is writing")
    with second.opened(list):  # the place is free again
        assert permissions(tmp_path / "state.lock") == 0o600
    assert list(tmp_path.iterdir()) == []


def test_a_state_that_cannot_be_written_is_refused_at_the_start(model, tmp_path):
    refuses(listening(model, tmp_path / "nowhere" / "state"), r"nowhere/state: cannot write there")


# --- labels


def test_a_label_that_each_emission_would_repeat_is_bounded(tmp_path):
    """One of 3 MB made 18 GB of JSON lines."""
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        writer.write_label(Label(0, 1_000, "a" * (MAX_LABEL_TEXT + 1)))
        writer.write_label(Label(0, 1_000, "b" * MAX_LABEL_TEXT))
        writer.write_events(tiny.stream(range(100)), tiny.RESOLUTION)
    with open_recording(tmp_path / "a.mcap") as recording:
        assert [label.label[0] for label in recording.labels] == ["b"]
        assert recording.losses.counts["bad label"] == 1


# --- folders


def sample(folder, name="1.mcap"):
    folder.mkdir(parents=True, exist_ok=True)
    with RecordingWriter(folder / name) as writer:
        writer.write_events(tiny.stream(range(100)), tiny.RESOLUTION)


def test_classes_that_are_links_are_classes(tmp_path):
    sample(tmp_path / "set" / "cat")
    sample(tmp_path / "elsewhere")
    (tmp_path / "set" / "dog").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "set" / "dog" / "round").symlink_to(tmp_path / "set")
    found = find_samples(tmp_path / "set", (".mcap",))
    assert {(s.label, s.source) for s in found} >= {("cat", "cat/1.mcap"), ("dog", "dog/1.mcap")}


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="root may enter every folder")
def test_a_class_that_may_not_be_entered_is_said(tmp_path):
    sample(tmp_path / "set" / "cat")
    (tmp_path / "set" / "dog").mkdir(mode=0)
    with pytest.raises(InputError, match=r"dog: cannot be entered"):
        find_samples(tmp_path / "set", (".mcap",))


# --- one camera ends no other


def test_a_camera_for_which_there_is_no_memory_is_refused_alone(model):
    """Twenty of 2048x2048 within 8 GB ended the listener."""
    refused = []

    def session(topic):
        return Session(tiny.encoder(), EmitPolicy.parse("10ms"), topic=topic, engine=engine_of(topic))

    def engine_of(topic):
        def make(*arguments, **options):
            if topic == "large":
                raise MemoryError("Unable to allocate 3 GiB")
            return Engine(*arguments, **options)

        return make

    cameras = Cameras(session, on_refusal=lambda *told: refused.append(told))
    emissions = []
    for i in range(3):
        for topic in ("large", "small"):
            events = tiny.stream(range(i * 20_000, i * 20_000 + 15_000, 100))
            emissions += cameras.process(Packet(topic, events, tiny.RESOLUTION, 0, i))
    assert {emission.topic for emission in emissions} == {"small"}
    assert set(refused) == {("large", "out of memory", "Unable to allocate 3 GiB")}
    assert cameras.topics == ["small"]


# --- pipes as inputs


def test_a_pipe_is_no_recording(run, tmp_path):
    os.mkfifo(tmp_path / "pipe.mcap")
    result = run("info", tmp_path / "pipe.mcap")
    assert result.status == 2
    assert "is a pipe or device, and cannot be read twice" in result.err


# --- threads


def test_an_engine_in_two_threads_is_one_clear_error():
    engine = Engine(tiny.encoder(), tiny.RESOLUTION)
    held = engine._crew.turn.pop()  # as a call in another thread has it
    with pytest.raises(RuntimeError, match="two threads at once"):
        _in_a_thread(engine.feed, tiny.stream(range(100)))
    engine._crew.turn.append(held)
    engine.feed(tiny.stream(range(100)))
    assert engine.n_events == 100


def test_engines_in_threads_of_their_own_have_the_same_bits():
    batches = [tiny.stream(range(i * 1000, i * 1000 + 900, 10)) for i in range(50)]
    alone = _fed(Engine(tiny.encoder(), tiny.RESOLUTION), batches)
    found = [None, None]

    def work(k):
        found[k] = _fed(Engine(tiny.encoder(), tiny.RESOLUTION), batches)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [one.tobytes() for one in found] == [alone.tobytes()] * 2


def _fed(engine, batches):
    return np.array([engine.features() for batch in batches if engine.feed(batch) is None])


def _in_a_thread(function, *arguments):
    raised = []

    def call():
        try:
            function(*arguments)
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=call)
    thread.start()
    thread.join()
    if raised:
        raise raised[0]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a system without fork")
def test_a_process_that_is_forked_after_the_import_computes_the_same():
    program = """
import os, sys
sys.path[:0] = sys.argv[1:]
import tiny
from streamfeat.engine.engine import Engine
def bits():
    engine = Engine(tiny.encoder(), tiny.RESOLUTION, threads=2)
    engine.feed(tiny.stream(range(0, 900, 10)))
    return engine.features().tobytes()
before = bits()
child = os.fork()
if not child:
    os._exit(int(bits() != before))
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    command = [sys.executable, "-W", "ignore", "-c", program, str(ROOT), str(ROOT / "tests")]
    assert subprocess.run(command, check=False, timeout=300).returncode == 0


# --- folders of others


def sample_file(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    events = tiny.stream(range(100))
    np.savez(path, **{name: events[name] for name in "xypt"})


@pytest.mark.parametrize("scheme", ["", "file://", "zip://data::file://"])
def test_names_with_two_colons_are_samples_as_any(scheme, tmp_path, run):
    """A URL has no way to say them: two colons begin what a store is kept in."""
    pytest.importorskip("fsspec", reason="the extra `store` is not installed")
    for name in ("a::b/0.npz", "c/one::two.npz", "c/plain.npz"):
        sample_file(tmp_path / "data" / name)
    with zipfile.ZipFile(tmp_path / "data.zip", "w") as archive:
        for path in sorted((tmp_path / "data").rglob("*.npz")):
            archive.write(path, path.relative_to(tmp_path))
    source = f"{tmp_path}/data.zip" if "zip" in scheme else f"{tmp_path}/data"
    result = run("convert", f"{scheme}{source}", tmp_path / "out.mcap", "--json")
    assert (result.status, result.json["samples"], result.json["failed"]) == (0, 3, 0)
    with open_recording(tmp_path / "out.mcap") as recording:
        assert [label.label for label in recording.labels] == ["a::b", "c", "c"]


def test_a_class_folder_that_is_a_link_to_nothing_is_listed(tmp_path, run):
    for name in ("train/a/0.npz", "train/b/0.npz"):
        sample_file(tmp_path / "data" / name)
    (tmp_path / "data/train/c").symlink_to(tmp_path / "gone")
    (tmp_path / "data/other").symlink_to(tmp_path / "gone")
    result = run("convert", tmp_path / "data", tmp_path / "out.mcap", "--json")
    assert (result.status, result.json["samples"], result.json["failed"]) == (1, 2, 2)
    assert all(f"/{name}'" in str(result.json["faults"]) for name in ("other", "train/c"))


def test_a_folder_that_another_user_keeps_to_himself_is_one_line(tmp_path, run, monkeypatch):
    """Whatever asks first; root may enter all, so the system is made to refuse."""
    real = os.stat

    def stat_of(path, *arguments, **options):
        if str(path).startswith("/closed"):
            raise PermissionError(13, "Permission denied", str(path))
        return real(path, *arguments, **options)

    monkeypatch.setattr(os, "stat", stat_of)
    result = run("record", "a/*", "-o", "/closed/out.mcap")
    assert (result.status, result.out) == (2, "")
    assert result.err == "error: /closed/out.mcap: Permission denied; may this user read and enter it?\n"
