"""Measure the processor time from the start of a command to its first prediction, with kernels in the cache.

python tools/start.py
python tools/start.py --emit event --turns 9

A process of its own for each turn: imports, opening model, classifier and recording, and the first emission.
Printed as JSON: seconds of processor time at each of the three, the least of all turns, for others only add.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_ONCE = """
import os, sys, time
import streamfeat.cli
from streamfeat.cli.blas import spare_blas
spare_blas()
from streamfeat.stream.outputs import Outputs
from streamfeat.stream.replay import ReplayJob
imported = time.process_time()

class First:
    def write(self, emissions):
        assert emissions[0].prediction
        print(imported, opened, time.process_time(), flush=True)
        os._exit(0)

    def close(self, *, failed):
        pass

folder, emit = sys.argv[1:]
names = ("digits_test.mcap", "digits.safetensors", "digits_classifier.safetensors")
job = ReplayJob(*(f"{folder}/{name}" for name in names), emit=emit)
opened = time.process_time()
job.run(Outputs(more=First()))
"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--emit", default="10ms", help="policy (default: %(default)s)")
    parser.add_argument("--turns", type=int, default=5, help="processes (default: %(default)s)")
    arguments = parser.parse_args()
    turns = [_turn(arguments.emit) for _ in range(arguments.turns + 1)][1:]  # the first one may compile
    least = [round(min(column), 3) for column in zip(*turns, strict=True)]
    names = "imported", "opened", "first prediction"
    print(json.dumps({"processor_s": dict(zip(names, least, strict=True)), "load": os.getloadavg()}))


def _turn(emit: str) -> list[float]:
    """Seconds of processor time at each step, in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", _ONCE, str(ROOT / "recordings"), emit],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    return [float(value) for value in done.stdout.split()]


if __name__ == "__main__":
    main()
