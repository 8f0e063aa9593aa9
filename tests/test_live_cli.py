"""The commands for live topics, as processes that are interrupted and killed."""

import json
import signal
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
import tiny
from live_net import attachment, compiled, free_port, plain_publisher, plain_session, running, until
from test_live_listen import CLASSIFIER, MODEL, batches, message

from streamfeat.cli import main
from streamfeat.errors import InputError
from streamfeat.live.listen import ListenJob
from streamfeat.live.names import PlainNames
from streamfeat.live.network import FoundTopic, Network, find_topics, open_session
from streamfeat.live.record import RecordJob
from streamfeat.recordings.reader import open_recording
from streamfeat.recordings.writer import recover

PROGRAM = [sys.executable, "-W", "error", "-c", "from streamfeat.cli import main; main()"]


@contextmanager
def started(*words):
    process = subprocess.Popen(
        [*PROGRAM, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    MODEL.save(folder / "model")
    CLASSIFIER.save(folder / "classifier")
    tiny.write_items(folder / "labelled.mcap", tiny.labelled_items(3))
    return compiled(folder)


@pytest.mark.real_time
def test_listen_ends_well_when_interrupted(files, tmp_path):
    pytest.importorskip("pyarrow", reason="the extra `export` is not installed")
    port, out, table = free_port(), tmp_path / "out.mcap", tmp_path / "out.parquet"
    words = ["cam/*/events", "-m", files / "model", "-c", files / "classifier", "--emit", "10ms"]
    with (
        plain_session(port, listen=True) as net,
        started("listen", *words, "-o", out, "--table", table, "--port", port, "--json") as process,
        plain_publisher(net, "cam/a/events") as camera,
    ):
        for i, events in enumerate(batches(20)):
            camera.put(message(events, i), attachment=attachment(i + 1))
        part = tmp_path / "out.mcap.part"
        until(part.exists)
        # A last packet that is refused says that all others have been taken.
        camera.put(b"", attachment=attachment(21))
        assert "bad packet: cam/a/events" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        text, errors = process.communicate(timeout=60)
    result = json.loads(text)
    assert process.returncode == 0, errors
    assert (result["packets"], result["events"], result["interrupted"]) == (21, 4000, True)
    assert errors == ""
    assert not part.exists()
    from mcap.reader import make_reader

    with out.open("rb") as file:
        counts = make_reader(file).get_summary().statistics.message_count
    assert counts == 2 * result["emissions"]
    from pyarrow.parquet import read_table

    rows = read_table(table)
    assert rows.num_rows == result["emissions"]
    assert set(rows["topic"].to_pylist()) == {"cam/a/events"}
    assert {len(scores) for scores in rows["scores"].to_pylist()} == {3}


@pytest.mark.real_time
def test_record_survives_a_kill_with_all_but_the_last_chunk(files, tmp_path):
    """`kill -9` between two chunks, and in the midst of one: what was made safe is there, in order."""
    port, target = free_port(), tmp_path / "drive.mcap"
    sent = batches(300, events=50)
    with (
        plain_session(port, listen=True) as net,
        started("record", "cam/*/events", "-o", target, "--port", port, "--chunk", "0.1") as process,
        plain_publisher(net, "cam/a/events") as camera,
    ):
        part = tmp_path / "drive.mcap.part"
        sizes = set()
        for i, events in enumerate(sent):
            camera.put(message(events, i), attachment=attachment(i + 1))
            if i in (100, 200):
                # The file grows when a chunk is closed: all that was put 0.1 s before is safe by then.
                before = part.stat().st_size
                until(lambda before=before: part.stat().st_size > before, "a chunk")
                sizes.add(part.stat().st_size)
        process.kill()
        process.wait()
    assert not target.exists()
    with pytest.raises(InputError, match="streamfeat recover"):
        RecordJob(PlainNames("cam/*/events"), target, network=Network(port=port)).run()
    recover(part, target)
    with open_recording(target) as recording:
        got = np.concatenate(list(recording))
    assert np.array_equal(got, np.concatenate(sent)[: len(got)])
    assert len(got) >= 50 * 101
    assert len(sizes) == 2


def saved(part, copy):
    """Whether there is anything to recover."""
    try:
        recover(part, copy, overwrite=True)
    except InputError:
        return False
    with open_recording(copy) as recording:
        return recording.n_events


@pytest.mark.real_time
def test_a_silent_recording_is_safe_too(tmp_path):
    """Chunks are closed by the clock, not by the next message."""
    port, target, copy = free_port(), tmp_path / "drive.mcap", tmp_path / "copy.mcap"
    part = tmp_path / "drive.mcap.part"
    job = RecordJob(PlainNames("cam/*/events"), target, network=Network(port=port), chunk_s=0.05)
    with (
        plain_session(port, listen=True) as net,
        running(job),
        plain_publisher(net, "cam/a/events") as camera,
    ):
        camera.put(message(batches(1)[0]), attachment=attachment(1))
        until(lambda: saved(part, copy), "a chunk")
    for path in (copy, target):
        with open_recording(path) as recording:
            assert (recording.n_events, recording.topic) == (200, "/cam/a/events")


@pytest.mark.real_time
def test_publish_until_interrupted(files):
    port = free_port()
    job = ListenJob(PlainNames("cam/*/events"), files / "model", network=Network(port=port))
    with running(job):
        words = ["publish", files / "labelled.mcap", "cam/a/events", "--loop", "--speed", "5"]
        with started(*words, "--port", port, "--wait", "60", "--json") as publisher:
            until(lambda: job.result()["samples"] > 2 and job._cameras.topics)
            with open_session(port=port) as net:
                expected = [FoundTopic("cam/a/events", "zenoh", -1, 1)]
                until(lambda: find_topics(net, 0.1) == expected)
            publisher.send_signal(signal.SIGINT)
            text, errors = publisher.communicate(timeout=60)
        published = json.loads(text)
        until(lambda: job._cameras.topics == [])
    heard = job.result()
    assert (errors, published["interrupted"]) == ("", True)
    assert heard["packets"] + heard["lost"] == published["packets"]


@pytest.mark.real_time
def test_topics(capsys, monkeypatch):
    port = free_port()
    with plain_session(port, listen=True) as net:
        token = PlainNames("x").token("cam/a/events", bytes(16))
        with net.liveliness().declare_token(token):
            for more, expected in (
                ([], "cam/a/events  zenoh, publishers: 1, nothing was sent meanwhile\n"),
                (
                    ["--json"],
                    '{"topics": [{"name": "cam/a/events", "kind": "zenoh", "domain": -1, '
                    '"publishers": 1, "type": "", "encoding": "", "resolution": null, "rate_hz": 0.0, '
                    '"bytes_per_s": 0.0}]}\n',
                ),
            ):
                words = ["streamfeat", "topics", "--port", str(port), *more]
                monkeypatch.setattr(sys, "argv", words)
                with pytest.raises(SystemExit) as ended:
                    main()
                assert ended.value.code == 0
                assert capsys.readouterr().out == expected


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["listen", "-m", "x"], "give a zenoh key expression, or"),
        (["listen", "a/events", "--ros2", "/a", "-m", "x"], "give a zenoh key expression, or"),
        (["listen", "--ros2", "a", "-m", "x"], "give its full name"),
        (["listen", "a/*", "-m", "x", "--shard", "3/3"], "--shard 3/3: there is no such share"),
        (["listen", "a/*", "-m", "x", "--shard", "x"], "--shard 'x' is not understood; give I/N"),
        (["listen", "a/*", "-m", "x", "--shard", "0/0"], "--shard 0/0: there is no such share"),
        (["record", "a/events", "-o", "out.mcap", "--chunk", "0"], "a chunk of 0.0 s"),
        (["record", "a/events", "-o", "out.mcap", "--compression", "zip"], "unknown compression"),
        (["listen", "a/events", "-m", "none", "--state", "x"], "no such file"),
        (["publish", "one.mcap"], "give each recording a key"),
        (["publish", "one.mcap", "a", "two.mcap", "a"], "a topic of its own"),
        (["publish", "none.mcap", "a/events"], "cannot be opened"),
        (["recover", "none.mcap", "out.mcap"], "cannot be opened"),
    ],
)
def test_what_cannot_be_done_is_one_line(words, reason, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["streamfeat", *words])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    errors = capsys.readouterr().err
    assert reason in errors
    assert errors.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
