"""Reading a recording, here and in another tree of this project: processor time, interleaved.

    python -m tools.bench.reading REC --against ../streamfeat-before

Two processes read the whole recording in turn, and say how much processor time each pass took; what is
printed is the median of each, and of the ratio of neighbouring passes. Both run in this Python, with the tree
first on its path.

Lives here: the two processes, and the line. Not here: what is measured against nothing (`ingest`).
"""

import argparse
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--against", type=Path, help="root of the other tree; the default is this one")
    parser.add_argument("--runs", type=int, default=21, help="of each (default: %(default)s)")
    args = parser.parse_args()
    trees = {"before": (args.against or ROOT).resolve(), "now": ROOT}
    readers = {name: start(tree, args.recording.resolve()) for name, tree in trees.items()}
    seconds: dict[str, list[float]] = {name: [] for name in readers}
    n_events = 0
    for i in range(args.runs):
        for name in sorted(readers, reverse=bool(i % 2)):
            took, n = ask(readers[name])
            seconds[name].append(took)
            n_events = int(n)
    for reader in readers.values():
        reader.communicate()
    medians = {name: statistics.median(found) for name, found in seconds.items()}
    ratio = statistics.median(
        now / then for now, then in zip(*map(seconds.get, ("now", "before")), strict=True)
    )
    rates = ", ".join(f"{name} {n_events / took / 1e6:.1f}" for name, took in medians.items())
    print(
        f"{args.recording.name}: {n_events:,} events; Mev/s of the processor: {rates}; "
        f"time is {ratio:.2f} times"
    )


def start(tree: Path, recording: Path) -> subprocess.Popen[str]:
    """A process that reads the recording once for each line it is sent."""
    return subprocess.Popen(
        [sys.executable, "-P", __file__, "--serve", str(recording)],
        env=os.environ | {"PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def ask(reader: subprocess.Popen[str]) -> tuple[float, str]:
    """Have it read once: seconds of the processor, and events."""
    assert reader.stdin
    assert reader.stdout
    reader.stdin.write("\n")
    reader.stdin.flush()
    took, n = reader.stdout.readline().split()
    return float(took), n


def serve(recording: str) -> None:
    """Read once for each line of standard input, after one pass that is not measured."""
    from streamfeat import open_recording

    def read() -> int:
        with open_recording(recording) as opened:
            return sum(len(batch) for batch in opened)

    read()
    for _ in sys.stdin:
        started = time.process_time()
        n = read()
        print(time.process_time() - started, n, flush=True)


if __name__ == "__main__":
    serve(sys.argv[2]) if sys.argv[1:2] == ["--serve"] else main()
