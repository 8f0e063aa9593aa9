"""Make the general model that ships with the package, or check that it is the one this makes.

Lives here: the scenes it is learned from, how many, which seed, and its settings.
Not here: the camera (`streamfeat.simulate`), learning (`streamfeat.learn`).

    python tools/make_general_model.py            # simulate, learn, write general.safetensors and SHA256SUMS
    python tools/make_general_model.py --check    # do it again and compare with what is there

The camera moves before the two photographs that come with scikit-learn, and its digits move before the
camera, at many speeds, sizes and contrasts. No event of a real camera is among them. The photographs are JPEG
files: Pillow is needed to read them.
"""

import argparse
import dataclasses
import hashlib
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from sklearn.datasets import load_digits, load_sample_images

from streamfeat.engine.encoder import Encoder
from streamfeat.events import Events
from streamfeat.learn.from_files import learn_encoder
from streamfeat.messages.packets import Label
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.simulate.camera import CameraModel, events_from_frames
from streamfeat.simulate.saccades import Saccades, simulate_saccades

FOLDER = Path(__file__).resolve().parent.parent / "streamfeat" / "shipped"
MODEL, SUMS = "general.safetensors", "SHA256SUMS"

SEED = 2021
N_PHOTOGRAPHS, N_DIGITS = 1_500, 300
WINDOW_US = 100_002  # three bins, as `Geometry` has by default
GAP_US = 1_000_000
PHOTOGRAPH_CAMERA, DIGIT_CAMERA = (64, 64), (48, 48)
SLOWEST, FASTEST = 15.0, 300.0
"""Pixels a second, on the sensor."""

SETTINGS = {"filters": 200, "patch": 8, "threshold": 0.7, "window_ms": 100.0, "volumes": 50_000, "seed": SEED}
"""Small, so that the file is: most of what a patch of 12 has more is its whitening."""

_STEP_PX = 0.5
"""How far the picture moves at most between two rendered frames."""


def photographs() -> list[NDArray[np.float64]]:
    """The photographs as linear light, grey, in three sizes: `(rows, columns)` from 0 to 1."""
    found = []
    for image in load_sample_images().images:
        linear = (image / 255.0) ** 2.2
        grey = linear @ np.array([0.2126, 0.7152, 0.0722])
        found += [gaussian_filter(grey, 0.5 * size)[::size, ::size] for size in (1, 2, 3)]
    return found


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def camera_of(rng: np.random.Generator, resolution: tuple[int, int]) -> CameraModel:
    """A sensor of some sensitivity and some noise."""
    return CameraModel(
        resolution,
        threshold=log_uniform(rng, 0.12, 0.5),
        mismatch_seed=int(rng.integers(1 << 31)),
        noise_hz=log_uniform(rng, 0.2, 3.0),
        black_level=log_uniform(rng, 0.02, 0.1),
    )


def photograph_events(images: list[NDArray[np.float64]], rng: np.random.Generator) -> Events:
    """A window of a camera that moves before a photograph: it shifts, turns and comes nearer."""
    image = images[rng.integers(len(images))]
    camera = camera_of(rng, PHOTOGRAPH_CAMERA)
    rows, columns = camera.resolution
    speed, direction = log_uniform(rng, SLOWEST, FASTEST), rng.uniform(0, 2 * np.pi)
    turning, nearing = rng.normal(0, 0.7, 2)  # radians, and shares of the distance, a second
    seconds = WINDOW_US * 1e-6
    reach = seconds * (speed + 0.5 * np.hypot(rows, columns) * (abs(turning) + abs(nearing)))
    times = np.linspace(0, WINDOW_US, max(4, int(np.ceil(reach / _STEP_PX)) + 1)).astype(np.int64)
    y, x = np.meshgrid(
        np.arange(rows) - (rows - 1) / 2, np.arange(columns) - (columns - 1) / 2, indexing="ij"
    )
    start = rng.uniform(0, image.shape)
    frames = np.empty((len(times), rows, columns))
    for frame, t in zip(frames, times * 1e-6, strict=True):
        angle, scale = turning * t, np.exp(-nearing * t)
        cos, sin = scale * np.cos(angle), scale * np.sin(angle)
        at = np.stack([cos * y - sin * x, sin * y + cos * x])
        at += (start + speed * t * np.array([np.sin(direction), np.cos(direction)]))[:, None, None]
        frame[:] = map_coordinates(image, at, order=1, mode="mirror")
    return events_from_frames(np.log(camera.black_level + frames), times, rng, camera)


def digit_events(images: NDArray[np.float64], rng: np.random.Generator) -> Events:
    """A window of a digit that makes a saccade."""
    image = images[rng.integers(len(images))] / 16.0
    size = log_uniform(rng, 12.0, 40.0)
    reach = rng.uniform(1.5, 0.3 * size, 2)
    saccades = Saccades(
        size, (float(reach[0]), float(reach[1])), saccade_us=int(rng.integers(34_000, 150_000))
    )
    events = simulate_saccades(image, rng, camera_of(rng, DIGIT_CAMERA), saccades)
    start = int(rng.integers(0, max(1, 3 * saccades.saccade_us - WINDOW_US)))
    events = events[(events["t"] >= start) & (events["t"] < start + WINDOW_US)]
    events["t"] -= start
    return events


def scenes(
    n_photographs: int = N_PHOTOGRAPHS, n_digits: int = N_DIGITS
) -> Iterator[tuple[Events, tuple[int, int]]]:
    """The first scenes of each kind: events from time zero, and the resolution."""
    grey, digits = photographs(), load_digits().images
    for i in range(n_photographs):
        yield photograph_events(grey, np.random.default_rng([SEED, 0, i])), PHOTOGRAPH_CAMERA
    for i in range(n_digits):
        yield digit_events(digits, np.random.default_rng([SEED, 1, i])), DIGIT_CAMERA


def first_scenes_sha256() -> str:
    """Of the events of the first three scenes of each kind: simulated in a second."""
    return hashlib.sha256(b"".join(bytes_of(events) for events, _ in scenes(3, 3))).hexdigest()


def bytes_of(events: Events) -> bytes:
    """What there is to compare: between the fields of an event lie bytes that mean nothing."""
    return b"".join(np.ascontiguousarray(events[name]).tobytes() for name in ("t", "x", "y", "p"))


def write_scenes(path: Path) -> str:
    """Write a recording of all scenes, and give the SHA-256 of their events."""
    digest = hashlib.sha256()
    start_us = 1_000_000
    with RecordingWriter(path) as writer:
        for i, (events, resolution) in enumerate(scenes()):
            digest.update(bytes_of(events))
            events["t"] += start_us
            writer.write_label(Label(start_us, WINDOW_US, "scene", "train", f"scene/{i}"))
            writer.write_events(events, resolution)
            start_us += WINDOW_US + GAP_US
    return digest.hexdigest()


def make() -> Encoder:
    """Simulate and learn; the model says what it is made of."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "scenes.mcap"
        sha256 = write_scenes(recording)
        encoder = learn_encoder(recording, **SETTINGS)
    made_of = {
        "made_by": "tools/make_general_model.py",
        "scenes": {
            "photographs": N_PHOTOGRAPHS,
            "digits": N_DIGITS,
            "events_sha256": sha256,
            "first_sha256": first_scenes_sha256(),
            "pixels_a_second": [SLOWEST, FASTEST],
        },
    }
    return dataclasses.replace(encoder, provenance={**encoder.provenance, **made_of})


def sums(folder: Path) -> str:
    return f"{hashlib.sha256((folder / MODEL).read_bytes()).hexdigest()}  {MODEL}\n"


def differences(folder: Path) -> Iterator[str]:
    """What in `folder` is not what this tool makes.

    Filters are compared by their cosines: another BLAS rounds otherwise.
    """
    if (folder / SUMS).read_text() != sums(folder):
        yield f"{SUMS} does not fit the file"
    found, made = Encoder.load(folder / MODEL), make()
    if found.provenance["scenes"] != made.provenance["scenes"]:
        yield f"{MODEL}: was learned from other scenes"
    if (found.geometry, found.threshold) != (made.geometry, made.threshold):
        yield f"{MODEL}: has another geometry or threshold"
    elif (likeness := np.einsum("kd,kd->k", found.filters, made.filters)).min() < 0.99:
        yield f"{MODEL}: {int(np.sum(likeness < 0.99))} filters are others"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=FOLDER, help="where the model is")
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if anything differs")
    arguments = parser.parse_args()
    folder: Path = arguments.folder
    if arguments.check:
        found = list(differences(folder))
        print("\n".join(found) or f"{folder}: as made by this tool")
        return 1 if found else 0
    make().save(folder / MODEL)
    (folder / SUMS).write_text(sums(folder))
    print(f"{MODEL}: {(folder / MODEL).stat().st_size:,} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
