"""Make the recordings that come with the project, or check that those here are the ones this makes.

Lives here: how many digits, which seed, how they follow each other in time, and the sums of the files.
Not here: the simulation (`streamfeat.simulate`) and the file format (`streamfeat.recordings`).

    python tools/make_recordings.py            # write digits_train.mcap, digits_test.mcap and SHA256SUMS
    python tools/make_recordings.py --models   # and learn a small model and classifier from the first of them
    python tools/make_recordings.py --check    # simulate again and compare with what is there
"""

import argparse
import hashlib
import subprocess
import sys
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

import numpy as np

from streamfeat.events import Events
from streamfeat.recordings.reader import Label, open_recording
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.simulate.camera import CameraModel
from streamfeat.simulate.saccades import digit_samples

FOLDER = Path(__file__).resolve().parent.parent / "recordings"
COUNTS = {"train": 250, "test": 100}
SEED = 2015
START_US = 1_000_000
SAMPLE_US = 300_000
GAP_US = 1_000_000  # silent, and longer than any window in use, so that no sample sees the one before
# Bytes per event of the test recording with zstd: libcaer_cmp 3.9, evt3 4.1, libcaer 4.7, mono 5.5.
ENCODING = "libcaer_cmp"

# Small, so that the model weighs less than a megabyte; digits of 16 pixels want larger counts than N-CARS.
LEARN_OPTIONS = ["--filters", "100", "--stride", "2", "--max-count", "2", "--volumes", "10000"]

MODEL, CLASSIFIER, SUMS = "digits.safetensors", "digits_classifier.safetensors", "SHA256SUMS"


def timed_digits(split: str) -> Iterator[tuple[Label, Events]]:
    """Labels and events of one recording, one sample after the other."""
    start_us = START_US
    for events, label, _, source in digit_samples(COUNTS[split], SEED, split):
        events["t"] += start_us
        yield Label(start_us, SAMPLE_US, label, split, source), events
        start_us += SAMPLE_US + GAP_US


def write_recording(path: Path, split: str) -> None:
    n_events = 0
    with RecordingWriter(path, encoding=ENCODING, overwrite=True) as writer:
        for label, events in timed_digits(split):
            writer.write_label(label)
            writer.write_events(events, CameraModel().resolution)
            n_events += len(events)
    print(f"{path.name}: {COUNTS[split]} samples, {n_events:,} events, {path.stat().st_size:,} bytes")


def learn_models(folder: Path) -> None:
    """Learn a small model and classifier from the training recording, as a user would."""
    command = Path(sys.executable).with_name("streamfeat")
    train, model, classifier = folder / "digits_train.mcap", folder / MODEL, folder / CLASSIFIER
    model.unlink(missing_ok=True)
    classifier.unlink(missing_ok=True)
    subprocess.run([command, "learn", train, "-o", model, *LEARN_OPTIONS], check=True)
    subprocess.run([command, "train", train, "-m", model, "-o", classifier, "--kernel", "linear"], check=True)


def sums(folder: Path) -> str:
    """Lines for `sha256sum --check`, of every file made here."""
    made = sorted([*folder.glob("*.mcap"), *folder.glob("*.safetensors")])
    return "".join(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in made)


def differences(folder: Path) -> Iterator[str]:
    """What in `folder` is not what this tool makes.

    Events are compared, not bytes: another version of the compressor writes another file of the same events.
    """
    if (folder / SUMS).read_text() != sums(folder):
        yield f"{SUMS} does not fit the files"
    for split in COUNTS:
        path = folder / f"digits_{split}.mcap"
        with open_recording(path) as recording:
            for i, (made, found) in enumerate(zip_longest(timed_digits(split), recording.samples())):
                if made is None or found is None:
                    yield f"{path.name}: {'more' if made is None else 'fewer'} than {COUNTS[split]} samples"
                    break
                label, events = made
                if (found.label, found.resolution) != (label, CameraModel().resolution):
                    yield f"{path.name}: sample {i} is labelled {found.label}, not {label}"
                elif not np.array_equal(found.events, events):
                    yield f"{path.name}: sample {i} has other events"
            if recording.losses:
                yield f"{path.name}: damaged"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=FOLDER, help="where the recordings are")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--models", action="store_true", help="also learn a model and a classifier")
    what.add_argument("--check", action="store_true", help="write nothing; exit with 1 if anything differs")
    arguments = parser.parse_args()
    folder: Path = arguments.folder

    if arguments.check:
        found = list(differences(folder))
        print("\n".join(found) or f"{folder}: as made by this tool")
        return 1 if found else 0
    for split in COUNTS:
        write_recording(folder / f"digits_{split}.mcap", split)
    if arguments.models:
        learn_models(folder)
    (folder / SUMS).write_text(sums(folder))
    return 0


if __name__ == "__main__":
    sys.exit(main())
