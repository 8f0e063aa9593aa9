"""From a folder of event files, LABEL/FILE, to a classifier, without the command line.

    python tools/examples/train_on_your_folder.py FOLDER OUT

Lives here: the four steps convert, learn, train, score as calls.
Not here: the same as commands, with more options and progress (`streamfeat convert`, `learn`, `train`).
"""

import sys
from pathlib import Path

import numpy as np

import streamfeat as sf
from streamfeat.classify.classifier import train_classifier
from streamfeat.classify.features import encode_samples
from streamfeat.convert.datasets import convert
from streamfeat.learn.fit import learn_encoder
from streamfeat.learn.settings import Setting

SETTING = Setting(patch=10, stride=4, max_count=2, filters=100, volumes=10_000, iterations=10)


def main(folder: str, out: str, setting: Setting = SETTING) -> float:
    target = Path(out)
    target.mkdir(parents=True, exist_ok=True)

    # Every fifth sample is kept for scoring. What cannot be read is told, and left out.
    done = convert(folder, target / "recording.mcap", hold_out=(1, 5), overwrite=True)
    for path, reason in done.failed:
        print(f"left out: {path}: {reason}")

    with sf.open_recording(target / "recording.mcap") as recording:
        # Held-out samples are not looked at. The window is as long as the median sample.
        encoder = learn_encoder([recording], setting)
        encoded = list(encode_samples(encoder, recording.samples()))

    seen = [(label.label, row) for label, row in encoded if label.split == "train"]
    held_out = [(label.label, row) for label, row in encoded if label.split == "validation"]
    classifier = train_classifier(np.stack([row for _, row in seen]), [name for name, _ in seen], encoder)
    encoder.save(target / "model.safetensors")
    classifier.save(target / "classifier.safetensors")
    right = sum(classifier.predict(row) == name for name, row in held_out)
    print(f"{done.samples} samples, {right} of {len(held_out)} held out are right")
    return right / len(held_out)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
