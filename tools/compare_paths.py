"""Replay the labelled samples of a recording through the pipeline, and compare with the offline encoder.

Lives here: a sink that keeps what the pipeline emits at the end of each sample, and the comparison.

    python tools/compare_paths.py ncars.mcap -m model.safetensors -c classifier.safetensors --split validation
"""

import argparse
import asyncio
import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from streamfeat.classifier import Classifier
from streamfeat.emission import Emission, EmitPolicy
from streamfeat.encoder import Encoder
from streamfeat.features import encode_samples
from streamfeat.pipeline import Pipeline
from streamfeat.recording import open_recording
from streamfeat.replay import items_of_split
from streamfeat.session import Session


class KeepFinal:
    """Keeps the features and the prediction at the end of each sample."""

    def __init__(self) -> None:
        self.kept: list[Emission] = []

    def write(self, emissions: Sequence[Emission]) -> None:
        self.kept.extend(e for e in emissions if e.final)

    def close(self, *, failed: bool) -> None:
        """Nothing to finish."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("-m", "--model", type=Path, required=True)
    parser.add_argument("-c", "--classifier", type=Path, required=True)
    parser.add_argument("--split", default=None)
    parser.add_argument("--emit", default="auto")
    arguments = parser.parse_args()
    encoder, classifier = Encoder.load(arguments.model), Classifier.load(arguments.classifier)
    sink = KeepFinal()
    session = Session(encoder, EmitPolicy.parse(arguments.emit), classifier)
    with open_recording(arguments.recording) as recording:
        items = items_of_split(recording.items(), arguments.split)
        asyncio.run(Pipeline(items, session, [sink]).run())
        wanted = (s for s in recording.samples() if arguments.split in (None, s.label.split))
        same = right = offline_right = 0
        difference = 0.0
        pairs = itertools.zip_longest(sink.kept, encode_samples(encoder, wanted))
        for emission, (label, features) in pairs:
            same += emission.features.tobytes() == features.tobytes()
            difference = max(difference, float(np.abs(emission.features - features).max()))
            right += emission.prediction == label.label
            offline_right += classifier.predict(features) == label.label
    n = len(sink.kept)
    print(f"samples {n}, events {session.stats().events:,}, emissions {session.stats().emissions:,}")
    print(f"features with the same bits: {same} of {n}; largest difference {difference:.3g}")
    print(f"accuracy: pipeline {right / n:.4f}, offline {offline_right / n:.4f}")


if __name__ == "__main__":
    main()
