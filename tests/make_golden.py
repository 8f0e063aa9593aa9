"""Make `tests/golden/`: models, a classifier, recordings, a live job's state, and what they must give.

    python tests/make_golden.py tests/golden [--label TEXT]

It uses public names and the command line alone, so that it runs at any commit: check that commit out,
install it, and let its Python run this file. The files in the repository were made at commit 48b5f29, before
the package was divided into rooms. Make them anew only where a format version changes on purpose, and say so
in the commit.
"""

import argparse
import hashlib
import json
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import streamfeat as sf

COMMAND = [sys.executable, "-c", "from streamfeat.cli import main; main()"]

RESOLUTION = (13, 17)
GEOMETRY = {"patch": 4, "stride": 3, "n_bins": 3, "bin_us": 20_000, "max_count": 2}

MODELS = {
    "direct-soft": {},
    "direct-split": {},
    "direct-triangle": {"downsample": 2, "stride": 2},
    "inverse-soft": {},
    "inverse-split": {"patch": 3, "max_count": 1},
}
"""Formulation and encoding of each model, and what its geometry has of its own."""

POLICIES = ("event", "7ev", "10ms")

EVENT_FIELDS = ("t", "x", "y", "p")

ENCODINGS = ("mono", "libcaer_cmp", "libcaer", "evt3")
"""Of the payloads in the recordings."""

SAMPLES, SAMPLE_US, GAP_US, EVENTS = 3, 70_000, 90_000, 160
"""Of the labelled recording."""

LIVE_US, LIVE_EVENTS, LIVE_PACKETS = 4_000_000, 3_000, 100
"""Of the live stream: how long it is, events, and packets; its state is taken after a second or two."""


def model(name: str) -> sf.Encoder:
    """An encoder of random filters."""
    formulation, encoding = name.split("-")
    geometry = sf.Geometry(**(GEOMETRY | MODELS[name]))
    rng = np.random.default_rng(2015)
    d, k = geometry.patch**2 * geometry.n_bins, 4
    filters = rng.standard_normal((k, d))
    whitening = np.eye(d) + 0.05 * rng.standard_normal((d, d))
    return sf.Encoder.build(
        geometry,
        formulation=formulation,
        encoding=encoding,
        threshold=0.3,
        filters=filters / np.linalg.norm(filters, axis=1, keepdims=True),
        whitening=whitening,
        mean=0.1 * rng.standard_normal(d),
        provenance={"made_by": "tests/make_golden.py"},
    )


def classifier(encoder: sf.Encoder) -> sf.Classifier:
    """A classifier of random weights."""
    rng = np.random.default_rng(7)
    n = encoder.n_features
    return sf.Classifier(
        labels=("cat", "dog", "owl"),
        centre=rng.standard_normal(n).astype(np.float32) / 10,
        scale=rng.uniform(0.5, 2, n).astype(np.float32),
        weights=rng.standard_normal((n, 3)).astype(np.float32),
        bias=rng.standard_normal(3).astype(np.float32),
        fingerprint=encoder.fingerprint,
        provenance={"made_by": "tests/make_golden.py"},
    )


def events(start_us: int, stop_us: int, n: int, seed: int) -> np.ndarray:
    """Events around a spot that moves, so that counts reach their bound."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(start_us, stop_us, n))
    along = (t - start_us) / (stop_us - start_us)
    height, width = RESOLUTION
    x = np.clip(np.round(along * (width - 1) + rng.normal(0, 2, n)), 0, width - 1)
    y = np.clip(np.round(height / 2 + rng.normal(0, 2, n)), 0, height - 1)
    return sf.make_events(x.astype(int), y.astype(int), rng.random(n) < 0.7, t)


def digest(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def write_labelled(path: Path, encoding: str) -> None:
    with sf.RecordingWriter(path, encoding=encoding) as writer:
        start = GAP_US
        for i, label in zip(range(SAMPLES), ("cat", "dog", "owl"), strict=True):
            writer.write_label(label_class()(start, SAMPLE_US, label, "train", f"sample {i}"))
            writer.write_events(events(start, start + SAMPLE_US, EVENTS, seed=i), RESOLUTION)
            start += SAMPLE_US + GAP_US


def label_class() -> type:
    """`Label` of the recordings, wherever this commit keeps it."""
    for name in ("recordings.reader", "recording"):
        try:
            return __import__(f"streamfeat.{name}", fromlist=["Label"]).Label
        except ModuleNotFoundError:
            continue
    raise SystemExit("no Label in this version")


def lines_of(recording: Path, *options: object) -> list[dict[str, object]]:
    """The emissions of `streamfeat replay`."""
    command = [*COMMAND, "replay", recording, "-q", "--json-lines", "-", *options]
    out = subprocess.run(list(map(str, command)), check=True, capture_output=True, text=True).stdout
    lines = [json.loads(line) for line in out.splitlines()]
    return [line for line in lines if "features" in line]


def replayed(recording: Path, *options: object) -> dict[str, object]:
    """What `streamfeat replay` emits: times, predictions, and a digest of all features."""
    lines = lines_of(recording, "--features", *options)
    features = np.array([line["features"] for line in lines], np.float32)
    return {
        "emissions": len(lines),
        "t_us": digest(np.array([line["t_us"] for line in lines], np.int64)),
        "features": digest(features),
        "last": features[-1].tolist(),
        "predictions": [line["prediction"] for line in lines if line.get("prediction")][-5:],
    }


def keep_state(folder: Path, whole: Path) -> None:
    """Let `streamfeat listen` hear a camera at its own pace, and end it in the middle with its state kept."""
    port, state = free_port(), folder / "state.safetensors"
    network = ["--port", str(port), "-q", "--json"]
    listen = [*COMMAND, "listen", "cam/*/events", "-m", str(folder / "direct-split.safetensors")]
    listen += ["--emit", "10ms", "--state", str(state), *network]
    publish = [*COMMAND, "publish", str(whole), "cam/a/events", "--wait", "60", *network]
    with (
        subprocess.Popen(listen, stdout=subprocess.DEVNULL) as listener,
        subprocess.Popen(publish, stdout=subprocess.DEVNULL) as publisher,
    ):
        try:
            limit = time.monotonic() + 60
            while not state.exists() or b'"0.counts"' not in state.read_bytes():
                if time.monotonic() > limit:
                    raise SystemExit("no state of a camera came to be")
                time.sleep(0.005)
        finally:
            listener.send_signal(signal.SIGINT)
            listener.wait(30)
            publisher.terminate()


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--label", default="", help="of the commit that runs, for expected.json")
    arguments = parser.parse_args()
    folder = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.*"):
        if re.search(r"\.(safetensors|mcap|json)$", old.name):
            old.unlink()
    expected: dict[str, object] = {"made_at": arguments.label, "recordings": {}, "features": {}}
    for name in MODELS:
        model(name).save(folder / f"{name}.safetensors")
    classifier(model("direct-split")).save(folder / "classifier.safetensors")
    for encoding in ENCODINGS:
        path = folder / f"{encoding}.mcap"
        write_labelled(path, encoding)
        with sf.open_recording(path) as recording:
            fields = np.concatenate(list(recording))
            labels = [
                (one.start_us, one.duration_us, one.label, one.split, one.source) for one in recording.labels
            ]
        of_fields = {field: digest(fields[field].astype(np.int64)) for field in EVENT_FIELDS}
        expected["recordings"][encoding] = of_fields | {"events": len(fields), "labels": labels}
    for name in MODELS:
        for policy in POLICIES:
            options = ["-m", folder / f"{name}.safetensors", "--emit", policy]
            if name == "direct-split":
                options += ["-c", folder / "classifier.safetensors"]
            expected["features"][f"{name}/{policy}"] = replayed(folder / "mono.mcap", *options)
    with sf.RecordingWriter(folder / "whole.mcap") as writer:
        for part in np.array_split(events(10_000, LIVE_US, LIVE_EVENTS, seed=99), LIVE_PACKETS):
            writer.write_events(part, RESOLUTION)
    keep_state(folder, folder / "whole.mcap")
    options = ["-m", folder / "direct-split.safetensors", "--emit", "10ms", "--features"]
    live = lines_of(folder / "whole.mcap", *options)
    expected["live"] = {line["t_us"]: digest(np.array(line["features"], np.float32)) for line in live}
    (folder / "expected.json").write_text(json.dumps(expected) + "\n")


if __name__ == "__main__":
    main()
