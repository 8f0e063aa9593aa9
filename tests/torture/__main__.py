"""Break streamfeat in every way we know, and count what survives.

    python tests/torture                          # everything
    python tests/torture --only damage,kills      # these parts
    python tests/torture --scale 0.01             # a hundredth of the trials: does it run?
    python tests/torture --json out.json          # the rows as JSON, too

The exit status is 1 if anything did not survive.
"""

import argparse
import dataclasses
import json
import sys
import tempfile
import time
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
sys.path += [str(TESTS), str(TESTS.parent)]

from torture.crowd import crowd  # noqa: E402
from torture.damage import damaged_recordings  # noqa: E402
from torture.faults import faults  # noqa: E402
from torture.fuzz import hostile_bytes  # noqa: E402
from torture.hours import hours  # noqa: E402
from torture.interrupts import interrupts  # noqa: E402
from torture.kills import kills  # noqa: E402
from torture.outside import outside  # noqa: E402
from torture.soak import soak  # noqa: E402
from torture.state import state  # noqa: E402
from torture.surroundings import surroundings  # noqa: E402
from torture.table import Part, Row, Trials, markdown  # noqa: E402
from torture.viewers import viewers  # noqa: E402

PARTS: dict[str, tuple[Part, str]] = {
    "bytes": (hostile_bytes, "every decoder, fed with hostile bytes"),
    "damage": (damaged_recordings, "recordings cut short, or with bits flipped"),
    "kills": (kills, "kill -9 at random moments of record, learn, train, convert, evaluate"),
    "state": (state, "kill -9 of a listener that keeps its state"),
    "faults": (faults, "full disks, signals, sinks that raise, tasks that are cancelled"),
    "interrupts": (interrupts, "SIGINT, SIGTERM and SIGHUP in every phase of every command, within a second"),
    "crowd": (crowd, "copies of packets and cameras that come and go, without end"),
    "viewers": (viewers, "what a view sees without end: new cameras, and browsers that come and go"),
    "outside": (outside, "pages of browsers, silent clients, claims of gigabytes, names that do things"),
    "surroundings": (surroundings, "other users, clocks that are set, suspending, 1 % of a core, routers"),
    "hours": (hours, "two hours of listen, record and view: cameras, disks, clocks and browsers"),
    "soak": (soak, "a day of stream time, 500 million events"),
}


def main(arguments: list[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    rows: list[Row] = []
    for name in options.only.split(",") if options.only else PARTS:
        part, _ = PARTS[name]
        with tempfile.TemporaryDirectory(prefix=f"torture_{name}_") as folder:
            print(f"{name}...", file=sys.stderr, flush=True)
            started = time.monotonic()
            rows += part(Trials(options.scale, options.seed, Path(folder), _say))
            print(f"{name}: {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
    print(markdown(rows))
    for row in rows:
        for failure in row.failures:
            print(f"FAILED: {row.fault}: {failure}")
    if options.json:
        options.json.write_text(json.dumps([dataclasses.asdict(row) for row in rows], indent=1) + "\n")
    return int(any(row.survived < row.tried for row in rows))


def _say(line: str) -> None:
    print(f"  {line}", file=sys.stderr, flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python tests/torture",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="parts:\n" + "\n".join(f"  {name:<10} {text}" for name, (_, text) in PARTS.items()),
    )
    parser.add_argument("--only", metavar="PARTS", help="comma-separated parts to run")
    parser.add_argument("--scale", type=float, default=1.0, help="of the number of trials (default: 1)")
    parser.add_argument("--seed", type=int, default=1, help="of everything random (default: 1)")
    parser.add_argument("--json", type=Path, help="write the rows here")
    return parser


if __name__ == "__main__":
    sys.exit(main())
