"""Replay a recording through an engine, and plot how the scores of one sample develop.

    python tools/examples/replay_and_plot.py scores.png

Lives here: feeding an engine by hand, and matplotlib (`pip install 'streamfeat[plot]'`).
Not here: the replay that saves you this loop (`streamfeat replay`).
"""

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np

import streamfeat as sf

mpl.use("Agg")
import matplotlib.pyplot as plt

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"
STEP_US = 10_000


def main(picture: str) -> None:
    encoder = sf.Encoder.load(RECORDINGS / "digits.safetensors")
    classifier = sf.Classifier.load(RECORDINGS / "digits_classifier.safetensors")
    with sf.open_recording(RECORDINGS / "digits_test.mcap") as recording:
        sample = next(recording.samples())

    start, events = sample.label.start_us, sample.events
    times = np.arange(start, start + sample.label.duration_us, STEP_US)
    engine = sf.Engine(encoder, sample.resolution, origin_us=start)
    scores = []
    for begin in times:
        engine.feed(events[(events["t"] >= begin) & (events["t"] < begin + STEP_US)])
        engine.advance(begin + STEP_US - 1)
        scores.append(classifier.scores(engine.features()))

    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    for label, line in zip(classifier.labels, np.transpose(scores), strict=True):
        axes.plot(
            (times + STEP_US - start) / 1000, line, label=label, lw=3 if label == sample.label.label else 1
        )
    axes.set(
        xlabel="time since the start of the sample (ms)", ylabel="score", title=f"a {sample.label.label}"
    )
    axes.legend(ncols=2, fontsize="small")
    figure.savefig(picture, dpi=120)
    print(f"{picture}: {len(events):,} events, {len(times)} readings")


if __name__ == "__main__":
    main(sys.argv[1])
