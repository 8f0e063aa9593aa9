"""Every example is run, as its docstring says, on what comes with the project."""

import asyncio
import importlib
import runpy
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from live_net import PATIENCE_S, free_port, plain_publisher, plain_session

import streamfeat as sf
from streamfeat.messages.packets import PacketWriter
from streamfeat.stream.outputs import Outputs
from streamfeat.stream.replay import ReplayJob

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "tools" / "examples"
RECORDINGS = ROOT / "recordings"


def example(name):
    """What a script defines, without running its last lines."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def needs(name, extra):
    try:
        return importlib.import_module(name)
    except ImportError as error:
        pytest.skip(f"{name} is not installed ({extra}): {error}")


def run_as_said(monkeypatch, name, *arguments):
    """The script as the shell runs it, in this process."""
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")


def test_replay_and_plot(monkeypatch, tmp_path, capsys):
    needs("matplotlib", "extra plot")
    run_as_said(monkeypatch, "replay_and_plot", tmp_path / "scores.png")
    assert (tmp_path / "scores.png").read_bytes().startswith(b"\x89PNG")
    assert "30 readings" in capsys.readouterr().out


def test_a_custom_sink(monkeypatch, tmp_path, capsys):
    run_as_said(monkeypatch, "custom_sink", tmp_path / "changes.csv")
    rows = (tmp_path / "changes.csv").read_text().splitlines()
    assert rows[0] == "t_us,prediction,sample"
    assert f"{len(rows) - 1} changes in 100 samples" in capsys.readouterr().out
    assert {row.split(",")[1] for row in rows[1:]} == set("0123456789")


@pytest.mark.filterwarnings("ignore:Persisting input arguments")  # of joblib, on a slow machine
def test_a_grid_search(capsys):
    score = example("grid_search")["main"](60)
    assert score > 0.3  # ten classes, forty samples to learn from
    assert f"{score:.3f}" in capsys.readouterr().out


def test_training_on_a_folder(tmp_path, capsys):
    """Two classes that differ in where their events are; one of the files is none."""
    for i in range(30):
        label = "left" if i % 2 else "right"
        events = tiny.steady(0, 90_000, 400, seed=i, resolution=(24, 12))
        events["x"] += 12 * (label == "right")
        path = tmp_path / "in" / label / f"{i:02}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, events)
    (tmp_path / "in/left/broken.npy").write_bytes(b"nothing")
    module = example("train_on_your_folder")
    small = replace(module["SETTING"], filters=8, volumes=1000, iterations=2)
    score = module["main"](str(tmp_path / "in"), str(tmp_path / "out"), small)
    said = capsys.readouterr().out
    assert score > 0.6
    assert "left out: " in said
    assert "broken.npy" in said
    assert "30 samples" in said
    model = sf.Encoder.load(tmp_path / "out/model.safetensors")
    assert sf.Classifier.load(tmp_path / "out/classifier.safetensors").fingerprint == model.fingerprint


def test_reading_with_plain_mcap(monkeypatch, tmp_path, capsys):
    needs("mcap_ros2", "extra test")
    job = ReplayJob(
        RECORDINGS / "digits_test.mcap",
        RECORDINGS / "digits.safetensors",
        RECORDINGS / "digits_classifier.safetensors",
        emit="1s",
    )
    job.run(Outputs(recording=tmp_path / "out.mcap"))
    run_as_said(monkeypatch, "read_with_mcap", tmp_path / "out.mcap")
    lines = capsys.readouterr().out.splitlines()
    assert sum(" s  label " in line for line in lines) == 100
    assert sum(line.endswith(" features") for line in lines) == job.result()["emissions"]


def test_live_classification_with_asyncio():
    port, done = free_port(), threading.Event()
    with sf.open_recording(RECORDINGS / "digits_test.mcap") as recording:
        sample = next(recording.samples())

    def publish():
        writer, events = PacketWriter(), sample.events.copy()
        with plain_session(port) as session, plain_publisher(session, "robot/cam0/events") as publisher:
            while not done.wait(0.01):
                for message in writer.messages(events, sample.resolution):
                    publisher.put(message.to_cdr())
                events["t"] += 400_000

    camera = threading.Thread(target=publish)
    camera.start()
    try:
        main = example("live_asyncio")["main"]
        seen = asyncio.run(asyncio.wait_for(main("robot/cam0/events", 8, port), PATIENCE_S))
    finally:
        done.set()
        camera.join()
    assert len(seen) >= 8
    assert set(seen) <= set("0123456789")


def test_a_data_loader_of_torch(capsys):
    needs("torch", "too heavy for CI; pip install torch")
    right = example("torch_dataloader")["main"](2)
    assert right > 0.6
    assert "epoch 1" in capsys.readouterr().out


def test_every_example_is_here():
    names = {path.stem for path in EXAMPLES.glob("*.py")}
    source = Path(__file__).read_text()
    assert [name for name in sorted(names) if f'"{name}"' not in source] == []


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_an_example_says_how_to_run_it_and_is_short(path):
    text = path.read_text()
    assert f"    python tools/examples/{path.name}" in text
    assert len(text.splitlines()) <= 90
