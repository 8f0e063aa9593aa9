"""Models, recordings, a classifier and a state of commit 48b5f29 still give the bits that they gave there.

`tests/make_golden.py` made them, and says how. Times and features are compared whole, by their digests.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from make_golden import EVENT_FIELDS, MODELS, POLICIES, digest

import streamfeat as sf
from streamfeat.errors import InputError
from streamfeat.files.safetensors_file import read_safetensors, write_safetensors
from streamfeat.live.checkpoint import read_state
from streamfeat.live.inbox import Inbox
from streamfeat.live.intake import Intake
from streamfeat.live.warnings import Warnings
from streamfeat.messages.packets import Packet
from streamfeat.stream.cameras import Cameras
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session

GOLDEN = Path(__file__).parent / "golden"
EXPECTED = json.loads((GOLDEN / "expected.json").read_text())
TOPIC = "cam/a/events"


def of_model(name):
    return GOLDEN / f"{name}.safetensors"


@pytest.mark.parametrize("encoding", EXPECTED["recordings"])
def test_a_recording_of_before_has_the_same_events_and_labels(encoding):
    expected = EXPECTED["recordings"][encoding]
    with sf.open_recording(GOLDEN / f"{encoding}.mcap") as recording:
        events = np.concatenate(list(recording))
        labels = [
            [one.start_us, one.duration_us, one.label, one.split, one.source] for one in recording.labels
        ]
    assert len(events) == expected["events"]
    assert labels == expected["labels"]
    for field in EVENT_FIELDS:
        assert digest(events[field].astype(np.int64)) == expected[field], field


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("name", MODELS)
def test_a_model_of_before_gives_the_same_features_at_the_same_times(name, policy, run):
    expected = EXPECTED["features"][f"{name}/{policy}"]
    options = ["-m", of_model(name), "--emit", policy]
    if name == "direct-split":
        options += ["-c", GOLDEN / "classifier.safetensors"]
    result = run("replay", GOLDEN / "mono.mcap", "-q", "--json-lines", "-", "--features", *options)
    assert result.status == 0, result.err
    lines = [line for line in map(json.loads, result.out.splitlines()) if "features" in line]
    features = np.array([line["features"] for line in lines], np.float32)
    assert len(lines) == expected["emissions"]
    np.testing.assert_array_equal(features[-1], np.array(expected["last"], np.float32))
    assert digest(features) == expected["features"]
    assert digest(np.array([line["t_us"] for line in lines], np.int64)) == expected["t_us"]
    assert [line["prediction"] for line in lines if line.get("prediction")][-5:] == expected["predictions"]


def resumed(path):
    """The cameras of a job that goes on from a state file, and stream time there."""
    encoder = sf.Encoder.load(of_model("direct-split"))
    cameras = Cameras(lambda topic: Session(encoder, EmitPolicy.parse("10ms"), topic=topic))
    intake = Intake(Inbox(), encoder.geometry.window_us, Warnings())
    read_state(path, encoder.fingerprint, intake, cameras)
    return cameras


def test_a_job_goes_on_from_a_state_of_before_with_the_bits_of_one_that_never_stopped():
    cameras = resumed(GOLDEN / "state.safetensors")
    (snapshot,) = cameras.snapshots().values()
    last_us = snapshot.state.last_us
    assert 0 < last_us < 2_000_000
    seen = {}
    with sf.open_recording(GOLDEN / "whole.mcap") as recording:
        for batch in recording:
            rest = batch[batch["t"] > last_us]
            if len(rest):
                for emission in cameras.process(Packet(TOPIC, rest, recording.resolution, 0, 0)):
                    seen[str(emission.t_us)] = digest(emission.features)
    seen |= {str(emission.t_us): digest(emission.features) for emission in cameras.finish()}
    expected = {t_us: bits for t_us, bits in EXPECTED["live"].items() if int(t_us) > last_us}
    assert len(expected) > 200
    assert seen == expected


@pytest.mark.parametrize(
    ("name", "kind", "load"),
    [
        ("direct-split", "streamfeat-encoder", sf.Encoder.load),
        ("classifier", "streamfeat-classifier", sf.Classifier.load),
        ("state", "state", resumed),
    ],
)
def test_a_file_of_another_format_version_is_refused_in_one_line(name, kind, load, tmp_path):
    arrays, header = read_safetensors(of_model(name), kind, 1)
    path = tmp_path / "old.safetensors"
    about = {key: value for key, value in header.items() if key not in ("format", "version")}
    write_safetensors(path, kind, 0, arrays, about)
    with pytest.raises(InputError, match="format version 0") as error:
        load(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "load"),
    [("classifier", sf.Encoder.load), ("direct-split", sf.Classifier.load), ("direct-split", resumed)],
)
def test_a_file_of_another_kind_is_refused_in_one_line(name, load):
    with pytest.raises(InputError, match=r"but not a .* file") as error:
        load(of_model(name))
    assert "\n" not in str(error.value)
