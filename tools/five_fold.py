"""Five-fold cross-validated accuracy of a labelled recording, by the commands that a user would run.

Lives here: the folds. For each, a recording is written in which one fifth of the samples is held out, then
`streamfeat learn` and `streamfeat train` run on it: nothing is learned from what is scored.

    python tools/five_fold.py nmnist.mcap -- --stride 2 --max-count 2
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from sklearn.model_selection import StratifiedKFold

from streamfeat.recorder import RecordingWriter
from streamfeat.recording import Sample, open_recording

GAP_US = 1_000_000


def write_fold(path: Path, samples: list[Sample], held_out: set[int]) -> None:
    """The same samples one after the other, with `held_out` as the split for validation."""
    start_us = GAP_US
    with RecordingWriter(path) as writer:
        for i, sample in enumerate(samples):
            split = "validation" if i in held_out else "train"
            events = sample.events.copy()
            events["t"] += start_us - sample.label.start_us
            writer.write_label(replace(sample.label, start_us=start_us, split=split))
            writer.write_events(events, sample.resolution)
            start_us += sample.label.duration_us + GAP_US


def run(*arguments: str | Path) -> dict:
    command = [
        sys.executable,
        "-c",
        "from streamfeat.cli import main; main()",
        *map(str, arguments),
        "--json",
    ]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("learn_options", nargs="*", help="options of `streamfeat learn`, after --")
    arguments = parser.parse_args()
    with open_recording(arguments.recording) as recording:
        samples = list(recording.samples())
    labels = [sample.label.label for sample in samples]
    folds = StratifiedKFold(arguments.folds, shuffle=True, random_state=0)
    accuracies = []
    with tempfile.TemporaryDirectory() as name:
        for k, (_, held_out) in enumerate(folds.split(labels, labels)):
            started = time.monotonic()
            path, model, classifier = (Path(name) / f"{k}.{kind}" for kind in ("mcap", "model", "classifier"))
            write_fold(path, samples, set(held_out.tolist()))
            run("learn", path, "-o", model, *arguments.learn_options)
            result = run("train", path, "-m", model, "-o", classifier)
            accuracies.append(result["held_out_accuracy"])
            seconds = time.monotonic() - started
            print(f"fold {k + 1}: {accuracies[-1]:.4f} of {len(held_out)} ({seconds:.0f} s)", flush=True)
    spread = 1.96 * np.std(accuracies, ddof=1) / np.sqrt(len(accuracies))
    print(f"mean {np.mean(accuracies):.4f} +- {spread:.4f} over {len(samples)} samples")


if __name__ == "__main__":
    main()
