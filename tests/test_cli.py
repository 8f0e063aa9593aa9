"""The command line, end to end: what it prints, writes and refuses."""

import itertools
import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import tiny
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from safetensors import safe_open
from safetensors.numpy import save_file
from typer.testing import CliRunner

from streamfeat import cli
from streamfeat.classify.classifier import Classifier
from streamfeat.classify.features import sample_end
from streamfeat.engine.encoder import Encoder
from streamfeat.events import make_events
from streamfeat.learn import alternation, volumes
from streamfeat.messages.cdr import EventPacket
from streamfeat.recordings.reader import Label, open_recording
from streamfeat.recordings.writer import RecordingWriter

LEARN = ["--filters", "6", "--patch", "6", "--stride", "7", "--bins", "2", "--volumes", "300"]
LEARN += ["--iterations", "2"]
COMMANDS = ["info", "convert", "learn", "train", "replay"]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with recordings, and a model and a classifier for each formulation."""
    home = tmp_path_factory.mktemp("home")
    tiny.write_digits(home / "train.mcap", 40, n_held_out=10)
    tiny.write_digits(home / "test.mcap", 10, split="test")
    runner = CliRunner()
    for formulation in ("direct", "inverse"):
        model, clf = str(home / formulation), str(home / f"{formulation}.clf")
        learn = ["learn", str(home / "train.mcap"), "-o", model, "--formulation", formulation, *LEARN]
        assert runner.invoke(cli.app, learn).exit_code == 0
        train = ["train", str(home / "train.mcap"), "-m", model, "-o", clf]
        assert runner.invoke(cli.app, train).exit_code == 0
    return home


def snapshot(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


# --- what works


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_an_example(command):
    result = CliRunner().invoke(cli.app, [command, "--help"])
    assert result.exit_code == 0
    assert f"Example: streamfeat {command} " in result.stdout


def test_info_of_a_real_recording(run, shared_data):
    result = run("info", shared_data / "samples/eventpacket_libcaer_cmp_346x260.mcap", "--json")
    said = result.json
    assert (said["resolution"], said["on"], said["off"]) == ([260, 346], 211_043, 360_223)
    assert (said["events"], said["encoding"], said["integrity"]) == (571_266, "libcaer_cmp", "intact")
    assert said["first_us"] == 1744227144732712
    assert (result.status, result.err) == (0, "")


def test_info_of_a_labelled_recording(run, home):
    said = run("info", home / "train.mcap", "--json").json
    assert (said["samples"], said["splits"], said["labels"]) == (
        40,
        ["test", "train"],
        [*"0123456789"],
    )
    table = run("info", home / "train.mcap").out
    assert f"{said['events']:,}" in table
    assert "34x34" in table


def nmnist_folder(folder):
    """Two digits in the layout of N-MNIST: 40 bits an event."""
    for i in range(8):
        events = tiny.steady(0, 90_000, 150, seed=i, resolution=(34, 34))
        data = np.zeros((150, 5), np.uint8)
        data[:, 0], data[:, 1] = events["x"], events["y"]
        for byte, shift in ((2, 16), (3, 8), (4, 0)):
            data[:, byte] = events["t"] >> shift & 0xFF
        data[:, 2] |= (events["p"] << 7).astype(np.uint8)
        path = folder / "Train" / str(i % 2) / f"{i:05}.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.tobytes())
    return folder


def test_from_a_data_set_to_predictions(run, tmp_path):
    source, recording = nmnist_folder(tmp_path / "digits"), tmp_path / "digits.mcap"
    said = run("convert", source, recording, "--json").json
    assert (said["samples"], said["events"], said["failed"], said["damaged"]) == (8, 1200, 0, 0)
    assert run("learn", recording, "-o", tmp_path / "model", *LEARN).status == 0
    assert (
        run("train", recording, "-m", tmp_path / "model", "-o", tmp_path / "clf", "--json").json["samples"]
        == 8
    )
    said = run("replay", recording, "-m", tmp_path / "model", "-c", tmp_path / "clf", "--json").json
    assert (said["samples"], said["events"], said["lost"]) == (8, 1200, 0)
    assert said["accuracy"] == said["correct"] / 8


def test_learning_goes_on_from_a_model(run, home, tmp_path):
    model, whole = tmp_path / "model", tmp_path / "whole"
    learn = ["learn", home / "train.mcap", *LEARN]
    assert run(*learn, "-o", whole, "--iterations", "4").status == 0
    assert run(*learn, "-o", model).status == 0
    assert run(*learn, "-o", model).status == 2
    said = run(*learn, "-o", model, "--resume", model, "--json").json
    assert said["iterations"] == 4
    assert Encoder.load(model).fingerprint == Encoder.load(whole).fingerprint


def test_options_override_the_preset(run, home, tmp_path):
    learn = ["learn", home / "train.mcap", "-o", tmp_path / "model", *LEARN, "--preset", "paper"]
    assert run(*learn, "--rows", "free", "--coherence", "0.3", "--iterations", "1").status == 0
    model = Encoder.load(tmp_path / "model")
    assert (model.encoding, model.geometry.downsample, model.geometry.max_count) == ("triangle", 2, 127)
    assert (model.n_filters, model.geometry.patch, model.geometry.n_bins) == (6, 6, 2)
    assert model.provenance["weights"]["coherence"] == 0.3


def test_training_on_mirror_images_is_said_in_the_classifier(run, home, tmp_path):
    train = ["train", home / "train.mcap", "-m", home / "direct"]
    plain = run(*train, "-o", tmp_path / "plain", "--json").json
    both = run(*train, "-o", tmp_path / "both", "--mirror", "--json").json
    assert both["samples"] == plain["samples"]
    plain, both = (Classifier.load(tmp_path / name) for name in ("plain", "both"))
    assert (plain.provenance["variants"], both.provenance["variants"]) == ([], ["mirrored"])
    assert both.provenance["samples"] == 2 * plain.provenance["samples"]
    assert not np.array_equal(plain.weights, both.weights)


def test_the_other_log_determinant_is_remarked_upon(run, home, tmp_path):
    learn = ["learn", home / "train.mcap", "-o", tmp_path / "model", *LEARN, "--overwrite"]
    free = [*learn, "--rows", "free"]
    assert run(*free, "--json").json["log_determinant"] == "A XX' A'"
    assert "XX'" not in run(*free).out
    others = ((*free, "--filters", "72"), learn, (*learn, "--formulation", "inverse"))
    assert all(run(*other, "--json").json["log_determinant"] is None for other in others)


@pytest.mark.parametrize("formulation", ["direct", "inverse"])
def test_learn_and_train(run, home, tmp_path, formulation):
    said = run(
        "learn", home / "train.mcap", "-o", tmp_path / "m", "--formulation", formulation, *LEARN, "--json"
    ).json
    assert (said["filters"], said["features"], said["formulation"]) == (6, 48, formulation)
    model = Encoder.load(tmp_path / "m")
    assert model.fingerprint == Encoder.load(home / formulation).fingerprint
    assert model.geometry.bin_us == 50_000
    # Thirty of forty samples are not held out.
    assert model.provenance["windows"] == 30
    said = run("train", home / "train.mcap", "-m", tmp_path / "m", "-o", tmp_path / "c", "--json").json
    assert (said["samples"], said["held_out_samples"]) == (30, 10)
    assert 0 <= said["held_out_accuracy"] <= 1
    assert Classifier.load(tmp_path / "c").fingerprint == model.fingerprint


def offline(model, path, split=None):
    with open_recording(path) as recording:
        return [
            (
                s.label,
                model.encode(s.events, s.resolution, origin_us=s.label.start_us, t_us=sample_end(s.label)),
            )
            for s in recording.samples()
            if split in (None, s.label.split)
        ]


@pytest.mark.parametrize("formulation", ["direct", "inverse"])
def test_replay_into_a_recording(run, home, tmp_path, formulation):
    target, lines = tmp_path / "out.mcap", tmp_path / "out.jsonl"
    model, clf = Encoder.load(home / formulation), Classifier.load(home / f"{formulation}.clf")
    arguments = ["-m", home / formulation, "-c", home / f"{formulation}.clf", "--emit", "20ms"]
    said = run(
        "replay", home / "test.mcap", *arguments, "-o", target, "--json-lines", lines, "--features", "--json"
    ).json
    with target.open("rb") as file:
        messages = [
            (channel.topic, message.log_time // 1000, ros)
            for _, channel, message, ros in make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
        ]
    features = [(t, ros) for topic, t, ros in messages if topic == "/features"]
    predictions = [ros for topic, _, ros in messages if topic == "/prediction"]
    records = [json.loads(line) for line in lines.read_text().splitlines()]
    assert len(features) == len(predictions) == len(records) == said["emissions"]
    for (t, feature), prediction, record in zip(features, predictions, records, strict=True):
        assert (t, feature.n_events, prediction.label) == (
            record["t_us"],
            record["n_events"],
            record["prediction"],
        )
        assert np.array_equal(np.float32(feature.data), np.float32(record["features"]))
        assert list(prediction.labels) == list(clf.labels)
        assert prediction.label == clf.labels[int(np.argmax(prediction.scores))]
    finals = [record for record in records if record.get("sample", {}).get("final")]
    expected = offline(model, home / "test.mcap")
    assert len(finals) == said["samples"] == 10
    for record, (label, encoded) in zip(finals, expected, strict=True):
        assert record["sample"]["label"] == label.label
        tolerance = 0 if formulation == "direct" else 0.02 * float(encoded.max())
        assert np.allclose(record["features"], encoded, rtol=0, atol=tolerance)
        assert record["prediction"] == clf.predict(np.array(record["features"], np.float32))
    right = sum(record["prediction"] == record["sample"]["label"] for record in finals)
    assert (said["correct"], said["accuracy"]) == (right, right / 10)


@pytest.mark.parametrize("emit", ["event", "500ev", "10ms", "auto"])
def test_emission_policies_agree_on_what_counts(run, home, tmp_path, emit):
    lines = tmp_path / "out.jsonl"
    arguments = ["-m", home / "direct", "--emit", emit, "--json-lines", lines, "--features", "--json"]
    said = run("replay", home / "test.mcap", *arguments).json
    records = [json.loads(line) for line in lines.read_text().splitlines()]
    finals = [r["features"] for r in records if r["sample"]["final"]]
    expected = offline(Encoder.load(home / "direct"), home / "test.mcap")
    assert np.array_equal(np.array(finals, np.float32), [encoded for _, encoded in expected])
    assert said["accuracy"] is None
    if emit == "event":
        assert said["emissions"] == said["events"] + 10


def test_json_lines_on_standard_output(run, home):
    result = run("replay", home / "test.mcap", "-m", home / "direct", "--emit", "1s", "--json-lines", "-")
    records = [json.loads(line) for line in result.out.splitlines()]
    assert len(records) == 10
    assert result.status == 0


def test_the_terminal_shows_samples_and_a_summary(run, home):
    arguments = ["-m", home / "direct", "-c", home / "direct.clf", "--emit", "1s"]
    result = run("replay", home / "test.mcap", *arguments)
    assert "% of" in result.out
    assert "accuracy" in result.out
    assert "% of" not in run("replay", home / "test.mcap", *arguments, "-q").out
    lines = run("replay", home / "test.mcap", *arguments, "--verbose").out.splitlines()
    assert [f"% of {i}" in line for i, line in enumerate(lines[:10], 1)] == [True] * 10
    assert not any("more than a reader" in line for line in lines)


def test_steps_are_lines_if_asked_for_and_silent_otherwise(run, home, tmp_path):
    again = ["--overwrite", *LEARN]
    learn = ["learn", home / "train.mcap", "-o", tmp_path / "model", *again]
    train = ["train", home / "train.mcap", "-m", home / "direct", "-o", tmp_path / "clf", "--overwrite"]
    evaluate = ["evaluate", home / "train.mcap", "--method", "counts", "--early-samples", "0"]
    for command, step in ((learn, "learning 1/"), (train, "encoding 1/1"), (evaluate, "cells 1/1")):
        assert step in run(*command, "--verbose").err
        assert run(*command, "-q").err == ""
        assert run(*command, "-q", "-v").err == ""
    assert "cells" not in run(*evaluate).err
    assert "counts: " in run(*evaluate).err


def test_a_split_and_a_speed(run, home):
    said = run("replay", home / "train.mcap", "-m", home / "direct", "--split", "test", "--json").json
    assert said["samples"] == 10
    said = run(
        "replay", home / "train.mcap", "-m", home / "direct", "--split", "test", "--speed", "1e6", "--json"
    ).json
    assert (said["samples"], said["interrupted"]) == (10, False)


@pytest.mark.parametrize("start", [[], ["-c", "direct.clf"]])
def test_learning_online(run, home, start):
    arguments = ["-m", home / "direct", "--learn-online", "--emit", "1s", "--json"]
    arguments += [home / part if part.endswith(".clf") else part for part in start]
    said = run("replay", home / "train.mcap", *arguments).json
    assert said["samples"] == 40
    assert 0 <= said["accuracy"] <= 1


def test_overwrite(run, home, tmp_path):
    target = tmp_path / "out.mcap"
    target.write_bytes(b"mine")
    arguments = ["replay", home / "test.mcap", "-m", home / "direct", "-o", target, "-q"]
    assert run(*arguments).status == 2
    assert target.read_bytes() == b"mine"
    assert run(*arguments, "--overwrite").status == 0
    with target.open("rb") as file:
        assert make_reader(file).get_summary() is not None


# --- what is refused


def write_messages(path, *messages, topics=("/events",), schema=EventPacket.SCHEMA_NAME):
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        for name in topics:
            channel = writer.register_channel(name, "cdr", writer.register_schema(schema, "ros2msg", b""))
            for i, data in enumerate(messages):
                writer.add_message(channel, i, data, i)
        writer.finish()
    return path


def event_packet(encoding="mono", payload=bytes(8)):
    return EventPacket(0, "", 34, 34, 0, 0, encoding, False, payload).to_cdr()


def changed_model(source, target, *, version=1, arrays=None):
    with safe_open(source, framework="numpy") as file:
        header = json.loads(file.metadata()["streamfeat"]) | {"version": version}
        content = {name: file.get_tensor(name) for name in file.keys()} | (arrays or {})  # noqa: SIM118
    save_file(content, target, metadata={"streamfeat": json.dumps(header)})


@pytest.fixture(scope="module")
def bad(home, tmp_path_factory):
    """A folder of files that cannot be used."""
    bad = tmp_path_factory.mktemp("bad")
    good = (home / "test.mcap").read_bytes()
    (bad / "empty").write_bytes(b"")
    (bad / "cut").write_bytes(good[:60])
    (bad / "text").write_bytes(b"not an MCAP file at all, but longer than its magic")
    write_messages(bad / "no_events", b"\0" * 20, schema="std_msgs/msg/String")
    write_messages(bad / "two_topics", event_packet(), topics=("/left", "/right"))
    write_messages(bad / "bad_length", event_packet(payload=bytes(7)))
    write_messages(bad / "unknown_encoding", event_packet("morse"))
    changed_model(home / "direct", bad / "new_model", version=4)
    changed_model(home / "direct", bad / "odd_model", arrays={"mean": np.zeros(7, np.float32)})
    (bad / "cut_model").write_bytes((home / "direct").read_bytes()[:-10])
    tiny.write_items(bad / "unlabelled.mcap", [tiny.packet(tiny.steady(0, 90_000, 900))])
    tiny.write_items(bad / "partly_labelled.mcap", tiny.labelled_items(6, names=("cat", "", "dog")))
    tiny.write_items(bad / "one_class.mcap", tiny.labelled_items(4, names=("cat",)))
    tiny.write_items(bad / "few.mcap", tiny.labelled_items(4, names=("cat", "dog", "cat", "cat")))
    items = [
        Label(i.start_us, i.duration_us, i.label, "test") if isinstance(i, Label) else i
        for i in tiny.labelled_items(2)
    ]
    tiny.write_items(bad / "held_out.mcap", items)
    tiny.write_items(bad / "silent.mcap", [tiny.packet(make_events([0], [0], [1], [0]), (8, 8))])
    (bad / "folder").mkdir()
    (bad / "existing").write_bytes(b"mine")
    (bad / "data").mkdir()
    nmnist_folder(bad / "data")
    return bad


REPLAY = ["replay", "{home}/test.mcap", "-m", "{home}/direct"]
NEW = ["learn", "{home}/train.mcap", "-o", "{bad}/new", *LEARN]
TRAIN = ["-m", "{home}/direct", "-o", "{bad}/new"]

REFUSALS = {
    "missing": (["info", "{bad}/missing"], "missing: cannot be opened"),
    "folder": (["info", "{bad}/folder"], "folder"),
    "empty": (["info", "{bad}/empty"], "is empty"),
    "truncated": (["info", "{bad}/cut"], "cut: "),
    "no mcap": (["info", "{bad}/text"], "not a known event file"),
    "no event topic": (["info", "{bad}/no_events"], "no topic carries"),
    "two event topics": (
        ["replay", "{bad}/two_topics", "-m", "{home}/direct"],
        "/left, /right; choose one with --topic",
    ),
    "wrong topic": (["info", "{bad}/two_topics", "--topic", "/up"], "no events on topic /up;"),
    "packet length": (["info", "{bad}/bad_length"], "message 1"),
    "unknown encoding": (["info", "{bad}/unknown_encoding"], "morse"),
    "replay of a missing file": (["replay", "{bad}/missing", "-m", "{home}/direct"], "cannot be opened"),
    "missing model": (["replay", "{home}/test.mcap", "-m", "{bad}/missing"], "no such file"),
    "model of another version": (["replay", "{home}/test.mcap", "-m", "{bad}/new_model"], "format version 4"),
    "model of wrong shape": (["replay", "{home}/test.mcap", "-m", "{bad}/odd_model"], "mean has shape (7,)"),
    "model cut short": (["replay", "{home}/test.mcap", "-m", "{bad}/cut_model"], "not a readable"),
    "model that is a classifier": (["replay", "{home}/test.mcap", "-m", "{home}/direct.clf"], "encoder file"),
    "classifier that is a model": ([*REPLAY, "-c", "{home}/direct"], "classifier file"),
    "classifier of another model": (
        [*REPLAY, "-c", "{home}/inverse.clf"],
        "inverse.clf: was trained with another",
    ),
    "existing output": ([*REPLAY, "-o", "{bad}/existing"], "exists already"),
    "existing lines": ([*REPLAY, "--json-lines", "{bad}/existing"], "exists already"),
    "existing model": (["learn", "{home}/train.mcap", "-o", "{bad}/existing"], "exists already"),
    "existing classifier": (
        ["train", "{home}/train.mcap", "-m", "{home}/direct", "-o", "{bad}/existing"],
        "exists",
    ),
    "existing recording": (["convert", "{bad}/data", "{bad}/existing"], "exists already"),
    "output in no folder": ([*REPLAY, "-o", "{bad}/no/out.mcap"], "there is no folder"),
    "output is a folder": ([*REPLAY, "-o", "{bad}/folder", "--overwrite"], "is a folder"),
    "emit": ([*REPLAY, "--emit", "often"], "--emit 'often'"),
    "speed": ([*REPLAY, "--speed", "-1"], "--speed '-1'"),
    "split": ([*REPLAY, "--split", "moon"], "no samples of split 'moon'"),
    "nothing to learn online": (
        ["replay", "{bad}/unlabelled.mcap", "-m", "{home}/direct", "--learn-online"],
        "label",
    ),
    "formulation": ([*NEW, "--formulation", "sideways"], "formulation is 'sideways'"),
    "pooling": ([*NEW, "--encoding", "loud"], "encoding is 'loud'"),
    "no bins": ([*NEW, "--bins", "0"], "bins"),
    "no window": ([*NEW, "--window-ms", "0"], "window"),
    "patch": ([*NEW, "--patch", "0"], "patch"),
    "seed": ([*NEW, "--seed", "-1"], "seed"),
    "threshold": ([*NEW, "--threshold", "nan"], "threshold"),
    "too few volumes": ([*NEW, "--volumes", "1"], "two volumes"),
    "too few volumes found": (
        ["learn", "{bad}/silent.mcap", "-o", "{bad}/new", "--patch", "8"],
        "volumes are constant; there is nothing to learn from",
    ),
    "too few volumes for K": ([*NEW, "--filters", "301"], "too few for 301 filters"),
    "too few volumes for d": (
        [*NEW, "--volumes", "72"],
        "a covariance of 72 entries; learn from at least 73",
    ),
    "constant volumes": (
        [*NEW, "--patch", "1", "--bins", "1", "--filters", "1"],
        "are constant; there is no covariance to learn",
    ),
    "preset": (
        [*NEW, "--preset", "best"],
        "there is no preset 'best'; choose from default, fast, accurate, paper",
    ),
    "weight of the other formulation": (
        [*NEW, "--formulation", "inverse", "--log-det", "0.1"],
        "log_det is a weight of the direct formulation",
    ),
    "resume nothing": ([*NEW, "--resume", "{bad}/missing"], "no such file"),
    "resume with another K": ([*NEW, "--resume", "{home}/direct", "--filters", "7"], "filters 6, not 7"),
    "resume with another seed": ([*NEW, "--resume", "{home}/direct", "--seed", "9"], "from other volumes"),
    "nothing but held out": (["learn", "{bad}/held_out.mcap", "-o", "{bad}/new"], "no local volume"),
    "payload": (["convert", "{bad}/data", "{bad}/new", "--encoding", "morse"], "morse"),
    "compression": (["convert", "{bad}/data", "{bad}/new", "--compression", "rar"], "rar"),
    "no data set": (["convert", "{bad}/missing", "{bad}/new"], "missing"),
    "gap": (["convert", "{bad}/data", "{bad}/new", "--gap-ms", "nan"], "gap"),
    "no gap": (["convert", "{bad}/data", "{bad}/new", "--gap-ms", "0"], "gap"),
    "no labels": (["train", "{bad}/unlabelled.mcap", *TRAIN], "no labelled samples"),
    "no labels in one of two": (
        ["train", "{home}/train.mcap", "{bad}/unlabelled.mcap", *TRAIN],
        "unlabelled.mcap: has no labelled samples",
    ),
    "labels missing in part": (
        ["train", "{bad}/partly_labelled.mcap", *TRAIN],
        "2 of 6 training samples have no label",
    ),
    "one class": (["train", "{bad}/one_class.mcap", *TRAIN], "1 label"),
    "class too small": (["train", "{bad}/few.mcap", *TRAIN], "'dog' has 1 training samples"),
    "all held out": (["train", "{bad}/held_out.mcap", *TRAIN], "held-out"),
    "folds": (["train", "{home}/train.mcap", *TRAIN, "--folds", "1"], "folds"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_refusals(run, home, bad, name):
    arguments, reason = REFUSALS[name]
    before = snapshot(home), snapshot(bad)
    result = run(*(part.format(home=home, bad=bad) for part in arguments))
    lines = result.err.splitlines()
    assert len(lines) == 1, result.err
    assert lines[0].startswith("error: ")
    assert reason in lines[0]
    assert result.status == 2
    assert result.out == ""
    assert (snapshot(home), snapshot(bad)) == before


def test_too_little_memory_is_one_line(run, home, tmp_path, monkeypatch):
    def load(path):
        raise MemoryError("Unable to allocate 8.00 PiB")

    monkeypatch.setattr("streamfeat.engine.encoder.Encoder.load", load)
    result = run("train", home / "train.mcap", "-m", home / "direct", "-o", tmp_path / "clf")
    assert (result.status, result.err) == (
        2,
        "error: out of memory, ask for less: Unable to allocate 8.00 PiB\n",
    )


def test_markup_and_line_breaks_in_names_are_printed_as_they_are(run, tmp_path):
    result = run("info", tmp_path / "[red]:smile:\nnext")
    assert result.err.count("\n") == 1
    assert "[red]:smile: next" in result.err


# --- what is damaged


def test_events_that_cannot_be_are_counted(run, home, tmp_path):
    good = tiny.steady(1_000_000, 1_100_000, 500, resolution=(34, 34))
    outside = make_events([200, 3], [3, 99], [1, 0], [1_050_000, 1_050_001])
    back = tiny.steady(0, 1_000, 40, resolution=(34, 34))
    items = [tiny.packet(part, (34, 34)) for part in (good[:250], outside, good[250:], back)]
    path = tiny.write_items(tmp_path / "odd.mcap", items)
    said = run("replay", path, "-m", home / "direct", "--json").json
    assert (said["events"], said["rejected"], said["late"]) == (540, 2, 0)


def test_a_resolution_that_changes_midway_is_told(run, tmp_path):
    sizes = [(34, 34), (34, 34), (20, 40), (34, 34), (12, 16), (30, 31), (30, 32)]
    parts = [
        tiny.packet(tiny.steady(i * 10_000, (i + 1) * 10_000, 20, i, size), size)
        for i, size in enumerate(sizes, 1)
    ]
    one, several = tmp_path / "one.mcap", tmp_path / "several.mcap"
    tiny.write_items(one, parts[:2])
    tiny.write_items(several, parts)
    assert run("info", one, "--json").json["other_resolutions"] == []
    assert "also" not in run("info", one).out
    said = run("info", several, "--json").json
    assert said["resolution"] == [34, 34]
    assert said["other_resolutions"][0] == {"resolution": [20, 40], "packets": 1}
    assert [other["resolution"] for other in said["other_resolutions"][1:]] == [[12, 16], [30, 31], [30, 32]]
    table = " ".join(run("info", several).out.split())
    assert "40x20 (1 packets), 16x12 (1 packets), 31x30 (1 packets) and 1 others" in table


def test_a_damaged_chunk_costs_only_itself(run, home, tmp_path):
    path = tmp_path / "damaged.mcap"
    with RecordingWriter(path, chunk_size=4096, compression="none") as writer:
        for i in range(40):
            writer.write_events(tiny.steady(i * 10_000, (i + 1) * 10_000, 200, i, (34, 34)), (34, 34))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    result = run("replay", path, "-m", home / "direct", "--json")
    assert result.status == 0
    assert result.json["lost"] > 0
    assert 8000 - 3 * 600 < result.json["events"] < 8000
    assert "lost:" in result.err
    result = run("replay", path, "-m", home / "direct", "--json-lines", "-", "--emit", "1s")
    assert "lost:" in result.err
    assert run("info", path, "--json").json["integrity"] == "damaged"


# --- interruption


def start(*arguments):
    code = "from streamfeat.cli import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"COLUMNS": "200"},
    )


def test_an_interrupted_replay_keeps_what_it_read(home, tmp_path):
    target = tmp_path / "out.mcap"
    arguments = ["-m", home / "direct", "-c", home / "direct.clf", "--emit", "20ms", "--speed", "0.2"]
    with start("replay", home / "test.mcap", *arguments, "-o", target) as process:
        assert "% of 1" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=10)
    assert (process.returncode, err) == (130, "")
    table = out[out.index("replayed") :].splitlines()
    summary = dict(line.strip().split(maxsplit=1) for line in table[1:])
    assert summary["interrupted"] == "yes"
    assert 0 < int(summary["samples"]) < 10
    with target.open("rb") as file:
        counts = make_reader(file).get_summary().statistics.message_count
    assert counts > 0
    assert list(tmp_path.iterdir()) == [target]


def send_ctrl_c(monkeypatch, module, name, call):
    """Let Ctrl-C come when a function of a module is called for the so-manieth time."""
    real, calls = getattr(module, name), itertools.count(1)

    def called(*arguments):
        if next(calls) == call:
            signal.raise_signal(signal.SIGINT)
        return real(*arguments)

    monkeypatch.setattr(module, name, called)


@pytest.mark.parametrize("formulation", ["direct", "inverse"])
def test_interrupted_learning_writes_the_model_so_far(run, home, tmp_path, monkeypatch, formulation):
    model = tmp_path / "model"
    learn = ["learn", home / "train.mcap", "-o", model, *LEARN, "--formulation", formulation]
    learn += ["--iterations", "50", "--json"]
    with monkeypatch.context() as during:
        send_ctrl_c(during, alternation, "condition_number", 3)
        result = run(*learn)
    assert result.status == 130
    assert f"interrupted after 2 iterations; the same command with --resume {model}" in result.err
    assert result.json["iterations"] == 2
    assert Encoder.load(model).provenance["interrupted"] is True
    assert list(tmp_path.iterdir()) == [model]
    said = run(*learn, "--resume", model)
    assert said.status == 0
    assert said.json["iterations"] > 2


def test_learning_interrupted_before_its_first_iteration_writes_nothing(run, home, tmp_path, monkeypatch):
    for module, name in ((alternation, "condition_number"), (volumes, "count_window")):
        with monkeypatch.context() as during:
            send_ctrl_c(during, module, name, 1)
            result = run("learn", home / "train.mcap", "-o", tmp_path / "model", *LEARN)
        assert (result.status, result.out) == (130, "")
        assert result.err.splitlines() == ["interrupted before an iteration was done; nothing was written"]
        assert list(tmp_path.iterdir()) == []
