"""Work in other processes: the same bits, whoever dies, and one clear line for what cannot be."""

import contextlib
import functools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tiny

pytest.importorskip("distributed", reason="needs the extra `cluster`")

import dask
from distributed import get_worker
from hypothesis import given, settings
from hypothesis import strategies as st
from live_net import free_port, until

from streamfeat.classify.features import encode_recordings
from streamfeat.classify.variants import Variant
from streamfeat.convert import datasets
from streamfeat.engine.encoder import Encoder
from streamfeat.errors import InputError
from streamfeat.evaluate.plan import plan_cells
from streamfeat.evaluate.run import evaluate
from streamfeat.evaluate.splits import DataSet
from streamfeat.learn.fit import learn_encoder
from streamfeat.learn.settings import Setting
from streamfeat.recordings.reader import open_recording
from streamfeat.work.cluster import connected, local
from streamfeat.work.services import Services
from streamfeat.work.workers import ThreadWorkers, add_sums

RECORDINGS = Path(__file__).parents[1] / "recordings"
TRAIN = RECORDINGS / "digits_train.mcap"
SMALL = {"filters": 20, "patch": 8, "stride": 4, "volumes": 3000, "iterations": 2, "threshold": 0.5}


@pytest.fixture(scope="module")
def two():
    with local(2, 1) as cluster:
        yield cluster


def learned(workers, formulation="direct", report=lambda *step: None):
    with open_recording(TRAIN) as recording:
        assert len(recording.parts()) > 1
        setting = Setting(formulation=formulation, **SMALL)
        encoder = learn_encoder([recording], setting, report=report, workers=workers)
        samples = encode_recordings(encoder, [recording], variant=Variant(mirror=True), workers=workers)
    return (
        encoder.fingerprint,
        encoder.provenance["objective"],
        samples.rows.tobytes(),
        samples.labels.tolist(),
    )


@functools.cache
def learned_here(formulation):
    return learned(ThreadWorkers(1), formulation)


# --- sums


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=70), st.integers(1, 5))
def test_sums_are_added_as_one_tree(values, threads):
    parts = [(np.array([value]),) for value in values]
    tree = parts
    while len(tree) > 1:
        tree = [add_sums(*tree[i : i + 2]) for i in range(0, len(tree), 2)]
    (found,) = ThreadWorkers(threads).total(
        lambda value: (np.array([value]),), [(value,) for value in values]
    )
    assert found[0] == tree[0][0][0]
    assert found[0] == pytest.approx(sum(values), abs=1e-6)


@pytest.mark.real_time
@settings(max_examples=5)
@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=40))
def test_sums_of_a_cluster_are_the_same_tree(two, values):
    held = [(two.hold(np.array([value])),) for value in values]
    here = ThreadWorkers(1).total(alone, [(np.array([value]),) for value in values])
    assert two.total(alone, held)[0].tolist() == here[0].tolist()


def alone(value):
    return (value,)


# --- the same wherever it is done


@pytest.mark.real_time
@pytest.mark.parametrize("formulation", ["direct", "inverse"])
def test_what_is_learned_has_the_same_bits(two, formulation):
    expected = learned_here(formulation)
    assert learned(ThreadWorkers(3), formulation) == expected
    assert learned(two, formulation) == expected


@pytest.fixture(scope="module")
def animals(tmp_path_factory):
    return tiny.write_items(tmp_path_factory.mktemp("animals") / "a.mcap", tiny.labelled_items(24))


def rows_of(result):
    """But for how long it took."""
    timed = {"learn_s", "encode_s", "train_s", "peak_mb"}
    return [{name: value for name, value in row.items() if name not in timed} for row in result["rows"]]


def evaluated(animals, workers, finished=lambda row: None):
    base = {"patch": 4, "bins": 2, "filters": 12, "volumes": 600, "iterations": 2}
    data = DataSet([animals], None, 3, 0, "train")
    cells = plan_cells(["direct", "kmeans", "counts"], base, [], data.n_folds)
    return rows_of(evaluate(data, cells, early_samples=4, workers=workers, finished=finished))


@pytest.mark.real_time
def test_an_evaluation_is_the_same(two, animals):
    assert evaluated(animals, two) == evaluated(animals, ThreadWorkers(1))


@pytest.mark.real_time
def test_a_conversion_is_the_same(two, tmp_path):
    for name in ("cat", "dog"):
        (tmp_path / "data" / name).mkdir(parents=True)
        for i in range(5):
            events = tiny.steady(0, 50_000, 300, i)
            np.save(tmp_path / "data" / name / f"{i}.npy", events)
    (tmp_path / "data/cat/broken.npy").write_bytes(b"no array")
    one = datasets.convert(tmp_path / "data", tmp_path / "one.mcap")
    other = datasets.convert(tmp_path / "data", tmp_path / "other.mcap", workers=two)
    assert one == other
    assert (one.samples, len(one.failed)) == (10, 1)
    assert (tmp_path / "one.mcap").read_bytes() == (tmp_path / "other.mcap").read_bytes()


# --- whoever dies


@pytest.mark.real_time
def test_a_worker_that_dies_while_learning_changes_nothing(two):
    before = [*two.processes().values()]

    def kill(step, done, total, remark):
        if (step, done) == ("learning", 1) and before:
            os.kill(before.pop(), signal.SIGKILL)

    assert learned(two, "inverse", kill) == learned_here("inverse")
    assert len(before) == 1


@pytest.mark.real_time
def test_a_worker_that_dies_while_evaluating_changes_nothing(two, animals):
    expected = evaluated(animals, ThreadWorkers(1))
    before = [*two.processes().values()]
    alive = len(before)
    found = evaluated(animals, two, lambda row: before and os.kill(before.pop(), signal.SIGKILL))
    assert found == expected
    assert len(before) < alive


def hears_nothing_at_first(service, mark):
    first = not mark.exists()
    mark.touch()
    service.is_unanswered = first
    while not first and service.is_wanted():
        time.sleep(0.05)
    return {"first": first}


@pytest.mark.real_time
def test_an_errand_that_ended_because_the_scheduler_did_not_answer_begins_again(two, tmp_path):
    told, reasons = [], {}
    services = Services(two, lambda name, worker, what: told.append((name, what["first"])))
    services.begin("a", hears_nothing_at_first, tmp_path / "mark")
    until(lambda: reasons.update(services.check()) or reasons, "that it failed")
    assert "the scheduler did not answer worker tcp://127.0.0.1:" in reasons["a"]
    until(lambda: services._futures["a"].status == "pending", "its second beginning")
    assert services.check() == {}
    services.end()
    until(lambda: told == [("a", True), ("a", False)], lambda: f"{told}")


# --- what cannot be


@pytest.mark.real_time
def test_a_scheduler_that_does_not_answer_is_one_line(run, tmp_path, monkeypatch):
    monkeypatch.setattr("streamfeat.work.cluster._PATIENCE_S", 0.5)
    address = f"tcp://127.0.0.1:{free_port()}"
    result = run("learn", TRAIN, "-o", tmp_path / "model", "--cluster", address)
    assert (result.status, result.err.count("\n")) == (2, 1)
    assert f"no scheduler answers at {address}" in result.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--cluster", "nonsense://x"), "no scheduler answers"),
        (("--workers", "0"), "0 workers cannot do anything"),
        (("--workers", "2", "--cluster", "tcp://127.0.0.1:1"), "exclude each other"),
    ],
)
def test_a_cluster_that_cannot_be_is_one_line(run, tmp_path, options, reason):
    result = run("learn", TRAIN, "-o", tmp_path / "model", *options)
    assert (result.status, result.err.count("\n")) == (2, 1)
    assert reason in result.err


@contextlib.contextmanager
def scheduler_and_worker(*folders):
    """A scheduler and a worker, each of which finds packages in its folder first; gives the address.

    Each is a process, as somebody starts it.
    """
    port = free_port()
    address = f"tcp://127.0.0.1:{port}"
    commands = [
        ["scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"],
        ["worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny"],
    ]
    root = str(Path(__file__).parents[1])
    with contextlib.ExitStack() as stack:
        for (kind, *words), folder in zip(commands, folders, strict=True):
            env = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), root])}
            program = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *words]
            process = subprocess.Popen(program, env=env, cwd=folder, stdout=-3, stderr=-3)
            stack.callback(process.wait, 60)
            stack.callback(process.kill)
        yield address


@pytest.mark.real_time
def test_workers_of_another_version_are_refused(tmp_path):
    other = tmp_path / "streamfeat-9.9.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: streamfeat\nVersion: 9.9\n")
    with (
        scheduler_and_worker(RECORDINGS, tmp_path) as address,
        pytest.raises(InputError, match=r"worker tcp://\S+ has streamfeat 9\.9, here it is .*; install"),
        connected(address),
    ):
        pass


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("lacking", "reason"),
    [("scheduler", "a worker or the scheduler lacks a package: "), ("worker", "no worker is left")],
)
def test_one_without_the_package_is_one_line(tmp_path, lacking, reason, monkeypatch):
    monkeypatch.setattr("streamfeat.work.cluster._PATIENCE_S", 5.0)  # Dask ends a worker that cannot unpickle
    (tmp_path / "streamfeat.py").write_text("'''Not the package.'''\n")
    folders = (tmp_path, RECORDINGS) if lacking == "scheduler" else (RECORDINGS, tmp_path)
    with (
        scheduler_and_worker(*folders) as address,
        connected(address) as cluster,
        pytest.raises(InputError, match=reason) as refusal,
    ):
        learned(cluster)
    assert "\n" not in str(refusal.value)


def refuse(piece):
    if piece == 3:
        raise OSError(f"no disk on {get_worker().name}")
    return piece


@pytest.mark.real_time
def test_a_piece_that_cannot_be_read_is_one_line_with_the_worker(two):
    found = two.map(refuse, ((i,) for i in range(9)))
    assert [next(found) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(InputError, match=r"no disk on \S+ \(on worker tcp://127.0.0.1:\d+\)"):
        next(found)


@pytest.mark.real_time
def test_ctrl_c_keeps_what_was_learned_and_ends_quietly(tmp_path):
    small = [str(word) for name, value in SMALL.items() for word in (f"--{name}", value)]
    words = ["learn", str(TRAIN), "-o", str(tmp_path / "model"), "--workers", "2", "--verbose", *small]
    code = "from streamfeat.cli import main; main()"
    command = [sys.executable, "-c", code, *words, "--iterations", "100000"]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=-3, text=True, start_new_session=True
    ) as it:
        next(line for line in it.stderr if line.startswith("learning"))
        os.killpg(it.pid, signal.SIGINT)  # as a terminal does: to all of them
        said = it.stderr.read()
    assert it.returncode == 130
    assert "interrupted after" in said
    assert "Traceback" not in said
    assert Encoder.load(tmp_path / "model").provenance["interrupted"]


def deadly(piece):
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.real_time
def test_work_that_kills_every_worker_is_given_up():
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        local(1, 1) as cluster,
        pytest.raises(InputError, match="work was given up after 1 workers died"),
    ):
        next(cluster.map(deadly, [(0,)]))


def test_the_command_says_where_the_dashboard_is(run, tmp_path):
    small = [word for name, value in SMALL.items() for word in (f"--{name}", value)]
    said = run("learn", TRAIN, "-o", tmp_path / "model", "--workers", "1", "--json", *small)
    assert said.status == 0
    assert "1 workers" in said.err
    assert "dashboard: http://127.0.0.1:" in said.err
    here = run("learn", TRAIN, "-o", tmp_path / "here", "--json", *small)
    assert (tmp_path / "model").read_bytes() == (tmp_path / "here").read_bytes()
    assert json.loads(here.out)["objective"] == json.loads(said.out)["objective"]
