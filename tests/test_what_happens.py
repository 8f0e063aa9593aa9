"""The table of what happens when (`streamfeat/cli/README.md`): each row has its tests."""

import ast
import asyncio
import errno
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import tiny

from streamfeat.errors import InputError
from streamfeat.evaluate.run import StateFile
from streamfeat.recordings.reader import open_recording
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.session import Session
from streamfeat.stream.signals import run_until_interrupted, signals_wait
from streamfeat.stream.sinks import JsonLinesSink, RecordingSink

ROOT = Path(__file__).parents[1]
THIS_PROCESS = "test_what_happens.py"
MODEL = tiny.encoder()

ROWS = {
    "a chunk or packet is damaged, a file is cut off": [
        "test_recording.py::test_damaged_chunk_costs_only_itself",
        "test_recording.py::test_truncated_anywhere",
        "test_recording.py::test_bad_packets_are_counted_and_only_bad_packets_are_an_error",
    ],
    "events lie outside the resolution, or have no polarity": [
        f"{THIS_PROCESS}::test_events_that_change_nothing"
    ],
    "events are older than the window": [f"{THIS_PROCESS}::test_events_that_change_nothing"],
    "files of a data set, images or frames cannot be read": [
        "test_datasets.py::test_bad_samples_are_reported_and_the_others_converted"
    ],
    "a store refuses, or goes away midway": [
        "test_stores.py::test_a_replay_that_a_store_leaves_has_no_output",
        "test_stores.py::test_a_conversion_that_a_store_leaves_writes_nothing",
        "test_stores.py::test_a_server_that_refuses_midway_does_not_end_the_recording",
        "test_stores.py::test_a_server_that_stops_midway_does_not_end_the_recording",
    ],
    "a sink is slow, in a replay": [
        "test_pipeline.py::test_a_slow_sink_fills_bounded_queues_and_loses_nothing"
    ],
    "a sink is slow, of a listener": [
        "test_live_listen.py::test_overload_drops_the_oldest_whole_packets_and_says_so"
    ],
    "a sink raises": [
        "test_pipeline.py::test_a_sink_that_fails_ends_everything",
        "test_pipeline.py::test_a_sink_that_fails_in_the_reader_ends_everything",
    ],
    "the disk is full": [
        f"{THIS_PROCESS}::test_no_room_is_one_line_and_leaves_what_was_there",
        f"{THIS_PROCESS}::test_a_recording_that_has_no_more_room_can_be_recovered",
        "test_state.py::test_a_file_that_cannot_be_written_does_not_end_the_job",
    ],
    "a camera stalls": [
        "test_live_listen.py::test_a_silent_camera_decays_to_nothing",
        "test_pipeline.py::test_a_live_source_that_says_nothing_can_be_left",
    ],
    "the task of a pipeline is cancelled": [
        "test_pipeline.py::test_cancelling_the_task_closes_sinks_as_failed"
    ],
    "Ctrl-C or SIGTERM, anywhere": [
        "test_interrupts.py::test_a_command_ends_though_its_main_thread_is_busy",
        f"{THIS_PROCESS}::test_an_interrupt_while_libraries_are_loaded_or_kernels_compiled_is_heard",
    ],
    "Ctrl-C or SIGTERM, streams": [
        "test_cli.py::test_an_interrupted_replay_keeps_what_it_read",
        "test_live_cli.py::test_listen_ends_well_when_interrupted",
        f"{THIS_PROCESS}::test_a_replay_ends_on_sigterm_as_on_ctrl_c",
    ],
    "Ctrl-C or SIGTERM, `learn` and `evaluate`": [
        "test_cli.py::test_interrupted_learning_writes_the_model_so_far",
        "test_evaluate.py::test_an_interrupted_run_goes_on",
        f"{THIS_PROCESS}::test_sigterm_ends_a_command_as_ctrl_c_does",
    ],
    "Ctrl-C or SIGTERM, `convert`, `simulate` and `train`": [
        f"{THIS_PROCESS}::test_sigterm_ends_a_command_as_ctrl_c_does"
    ],
    "`kill -9`, `record`": ["test_live_cli.py::test_record_survives_a_kill_with_all_but_the_last_chunk"],
    "`kill -9`, `listen --state`": ["test_state.py::test_a_listener_that_is_killed_goes_on_where_it_was"],
    "`kill -9`, `learn` and `evaluate`": [
        "test_learn.py::test_what_is_kept_after_each_iteration_is_one_to_go_on_from",
        "test_torture.py::test_commands_that_are_killed",
    ],
    "`kill -9`, `convert` and `train`": ["test_torture.py::test_commands_that_are_killed"],
    "`kill -9`, a worker of a cluster": [
        "test_cluster.py::test_a_worker_that_dies_while_learning_changes_nothing",
        "test_cluster.py::test_a_worker_that_dies_while_evaluating_changes_nothing",
        "test_live_spread.py::test_cameras_of_a_worker_that_dies_are_served_again",
    ],
}


def table():
    """First cells of the table."""
    text = (ROOT / "streamfeat" / "cli" / "README.md").read_text(encoding="utf-8")
    section = text[text.index("## What happens when") : text.index("## Security\n")]
    rows = re.findall(r"^\| (.*?) \|", section, re.MULTILINE)
    assert rows[0] == "when"
    return rows[1:]


def test_every_row_has_its_tests():
    assert table() == [*ROWS]
    for tests in ROWS.values():
        for one in tests:
            file, name = one.split("::")
            tree = ast.parse((ROOT / "tests" / file).read_text(encoding="utf-8"))
            names = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
            assert name in names, one


def readings(packets):
    session = Session(MODEL, EmitPolicy.parse("10ms"))
    return [e for p in packets for e in session.process(p)] + list(session.finish()), session.stats()


def test_events_that_change_nothing():
    good = [
        tiny.packet(tiny.steady(1_000_000 + i * 50_000, 1_050_000 + i * 50_000, 200, seed=i))
        for i in range(4)
    ]
    bad = tiny.steady(1_150_000, 1_200_000, 60)
    bad["x"][:20], bad["p"][20:40], bad["t"][40:] = 999, 2, 5
    expected, stats = readings(good)
    got, counted = readings([*good, tiny.packet(bad)])
    assert (stats.rejected, stats.late) == (0, 0)
    assert (counted.rejected, counted.late, counted.events) == (40, 20, stats.events)
    assert [e.t_us for e in got] == [e.t_us for e in expected]
    assert all(np.array_equal(a.features, b.features) for a, b in zip(got, expected, strict=True))


# --- no room


@contextmanager
def room_for(n_bytes):
    """As a full disk: no file may be longer, and a write that would make it so fails."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def run(sink):
    packets = [tiny.packet(tiny.steady(i * 50_000, (i + 1) * 50_000, 300, seed=i)) for i in range(20)]
    asyncio.run(Pipeline(packets, Session(MODEL, EmitPolicy.parse("1ms")), [sink]).run())


def to_json(path):
    run(JsonLinesSink(path, features=True))


def to_mcap(path):
    run(RecordingSink(RecordingWriter(path, overwrite=True, chunk_size=1000, compression="none")))


def to_table(path):
    pytest.importorskip("pyarrow")
    from streamfeat.stream.table import TableSink

    run(TableSink(path, MODEL.n_features))


def to_model(path):
    MODEL.save(path)


@pytest.mark.parametrize("write", [to_json, to_mcap, to_table, to_model])
@pytest.mark.parametrize("room", [0, 300, 4096])
def test_no_room_is_one_line_and_leaves_what_was_there(write, room, tmp_path):
    path = tmp_path / "out.arrow"
    path.write_bytes(b"before")
    with room_for(room), pytest.raises(InputError) as error:
        write(path)
    assert "cannot be written: " + os.strerror(errno.EFBIG) in str(error.value)
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == b"before"


def test_a_recording_that_has_no_more_room_can_be_recovered(tmp_path):
    from streamfeat.recordings.writer import recover

    path, copy = tmp_path / "out.mcap", tmp_path / "copy.mcap"
    sent = [tiny.steady(i * 10_000, (i + 1) * 10_000, 100, seed=i) for i in range(50)]

    def record():
        with RecordingWriter(path, keep_partial=True, compression="none") as writer:
            for events in sent:
                writer.write_events(events, tiny.RESOLUTION)
                writer.flush()

    with room_for(20_000), pytest.raises(InputError, match="cannot be written"):
        record()
    recover(tmp_path / "out.mcap.part", copy)
    with open_recording(copy) as recording:
        got = np.concatenate(list(recording))
    assert 10 * 100 < len(got) < 50 * 100
    assert np.array_equal(got, np.concatenate(sent)[: len(got)])


def test_finished_cells_that_find_no_room(tmp_path):
    path = tmp_path / "state"
    with room_for(4), pytest.raises(InputError, match="cannot be written"):
        StateFile(path, {"format": "x"})
    assert list(tmp_path.iterdir()) == []


# --- signals


@pytest.mark.real_time
def test_a_signal_before_anything_runs_waits_until_it_can_be_heard(tmp_path):
    """Between opening an output and writing to it."""
    sink = JsonLinesSink(tmp_path / "out")
    with signals_wait():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
        pipeline = Pipeline([], Session(MODEL, EmitPolicy("auto")), [sink])
        assert run_until_interrupted([pipeline])
    assert (tmp_path / "out").exists()
    with pytest.raises(KeyboardInterrupt), signals_wait():
        signal.raise_signal(signal.SIGINT)


HEARD_S = 2
"""Within a second, on a machine that does nothing else."""


@contextmanager
def started(*words, **environment):
    process = subprocess.Popen(
        [sys.executable, "-W", "error", "-m", "streamfeat", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | environment,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    folder = tmp_path_factory.mktemp("home")
    MODEL.save(folder / "model")
    tiny.write_items(folder / "few.mcap", tiny.labelled_items(12))
    return folder


def wait_for(condition, process):
    limit = time.monotonic() + 120
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < limit
        time.sleep(0.01)


@pytest.mark.real_time
def test_a_replay_ends_on_sigterm_as_on_ctrl_c(home, tmp_path):
    target = tmp_path / "out.jsonl"
    words = ["replay", home / "few.mcap", "-m", home / "model", "--speed", "0.01", "--json-lines", target]
    with started(*words, "--json") as process:
        wait_for((tmp_path / "out.jsonl.part").exists, process)
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=HEARD_S)
    assert (process.returncode, err) == (130, "")
    assert json.loads(out)["interrupted"] is True
    assert list(tmp_path.iterdir()) == [target]


LONG = ["--patch", 8, "--filters", 200, "--volumes", 4000, "--lambda0", 0.1, "--iterations", 10**9]
"""More than a hundred iterations of a tenth of a second, with the digits that ship."""


@pytest.mark.real_time
def test_an_interrupt_while_libraries_are_loaded_or_kernels_compiled_is_heard(home, tmp_path):
    words = ["replay", home / "few.mcap", "-m", home / "model", "-o", tmp_path / "out.mcap"]
    caches = tmp_path / "caches"
    with started(*words, NUMBA_CACHE_DIR=str(caches)) as loading:
        time.sleep(0.3)
        loading.send_signal(signal.SIGINT)
        assert loading.communicate(timeout=HEARD_S) == ("", "")
        assert loading.returncode == 130
    with started(*words, NUMBA_CACHE_DIR=str(caches)) as compiling:
        assert compiling.stderr.readline().startswith("compiling: kernels")
        compiling.send_signal(signal.SIGHUP)
        out, err = compiling.communicate(timeout=HEARD_S)
        assert (compiling.returncode, out) == (130, "")
        assert "Traceback" not in err
    assert not [*tmp_path.glob("out*")]


@pytest.mark.real_time
@pytest.mark.parametrize("command", ["learn", "convert"])
def test_sigterm_ends_a_command_as_ctrl_c_does(command, home, tmp_path):
    """While it is at work, which would take much longer."""
    target = tmp_path / "out"
    if command == "learn":
        words = [ROOT / "recordings/digits_train.mcap", "-o", target, *LONG, "--formulation", "inverse"]
    else:
        for i in range(300):
            (home / f"data/Train/{i % 2}").mkdir(parents=True, exist_ok=True)
            events = tiny.steady(0, 99_000, 3000, seed=i)
            columns = {name: events[name] for name in "xypt"}
            np.savez(home / f"data/Train/{i % 2}/{i}.npz", **columns)
        words = [home / "data", target]
    with started(command, *words) as process:
        wait_for((tmp_path / "out.part").exists, process)
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=HEARD_S)
    assert "Traceback" not in err
    assert process.returncode == 130
    assert [path.name for path in tmp_path.iterdir()] == (["out"] if command == "learn" else [])
