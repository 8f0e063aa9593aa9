"""Send predictions wherever you like: a sink is two methods.

    python tools/examples/custom_sink.py changes.csv

Lives here: a sink of your own behind the pipeline that `streamfeat replay` uses.
Not here: the sinks that come with streamfeat (`streamfeat.stream.sinks`).
"""

import asyncio
import csv
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import streamfeat as sf

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"


class ChangesOfMind:
    """Writes a row whenever the prediction changes."""

    def __init__(self, path: str) -> None:
        self.file = Path(path).open("w", newline="")  # noqa: SIM115  (until `close`)
        self.rows = csv.writer(self.file)
        self.rows.writerow(["t_us", "prediction", "sample"])
        self.last = (None, None)
        self.changes = 0

    def write(self, emissions: Sequence[sf.Emission]) -> None:
        """Called with some emissions, in order, from one thread at a time; may take its time."""
        for emission in emissions:
            sample = emission.sample.label if emission.sample else ""
            if (emission.prediction, emission.sample) != self.last:
                self.rows.writerow([emission.t_us, emission.prediction, sample])
                self.changes += 1
            self.last = (emission.prediction, emission.sample)

    def close(self, *, failed: bool) -> None:
        """Called once; `failed` where some part of the pipeline did."""
        self.file.close()


def main(target: str) -> None:
    encoder = sf.Encoder.load(RECORDINGS / "digits.safetensors")
    classifier = sf.Classifier.load(RECORDINGS / "digits_classifier.safetensors")
    session = sf.Session(encoder, sf.EmitPolicy.parse("20ms"), classifier, clock=time.perf_counter)
    sink = ChangesOfMind(target)
    with sf.open_recording(RECORDINGS / "digits_test.mcap") as recording:
        asyncio.run(sf.Pipeline(recording.items(), session, [sink]).run())
    print(f"{target}: {sink.changes} changes in {session.stats().samples} samples")


if __name__ == "__main__":
    main(sys.argv[1])
