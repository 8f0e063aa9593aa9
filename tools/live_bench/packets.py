"""Measure what a packet costs in Python between the inbox and the session.

python tools/live_bench/packets.py
python tools/live_bench/packets.py --against ../before    # a work tree of another commit, taking turns

No network and no features: messages of 100 events are parsed, judged, decoded and placed. Processes of both
trees take turns; the median of each and their ratio are printed as JSON.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
CASES = {f"{encoding} {how}": (encoding, how) for encoding in ("mono", "evt3") for how in ("named", "bare")}
"""Encoding of the payload, and whether messages name their publisher."""
_PACKETS, _EVENTS, _ROUNDS = 2000, 100, 7


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, help="root of another work tree")
    parser.add_argument("--turns", type=int, default=5, help="of each tree (default: %(default)s)")
    parser.add_argument("--once", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.once:
        print(json.dumps({name: _measure(*case) for name, case in CASES.items()}))
        return
    trees = {"here": ROOT} | ({"there": arguments.against.resolve()} if arguments.against else {})
    found = [{name: _turn(tree) for name, tree in trees.items()} for _ in range(arguments.turns)]
    result: dict[str, dict[str, float]] = {}
    for case in CASES:
        microseconds = {name: float(np.median([turn[name][case] for turn in found])) for name in trees}
        result[case] = {name: round(value, 1) for name, value in microseconds.items()}
        if "there" in microseconds:
            result[case]["ratio"] = round(microseconds["here"] / microseconds["there"], 2)
    print(json.dumps({"cores": os.cpu_count(), "us a packet": result}, indent=1))


def _turn(tree: Path) -> dict[str, float]:
    """Microseconds of each case, in a process of its own."""
    command = [sys.executable, str(Path(__file__).resolve()), "--once"]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": str(tree)}, capture_output=True, text=True, check=True
    )
    measured: dict[str, float] = json.loads(done.stdout)
    return measured


def _measure(encoding: str, how: str) -> float:
    """Microseconds a packet, the median of some rounds after the kernels are compiled."""
    from streamfeat.live import intake as module
    from streamfeat.live.inbox import Inbox, RawMessage
    from streamfeat.live.names import Attachment
    from streamfeat.messages.cdr import EventPacket
    from streamfeat.messages.codecs import encode
    from streamfeat.messages.packets import Packet

    rng, messages = np.random.default_rng(0), []
    from streamfeat.events import make_events

    for i in range(_PACKETS):
        t = np.sort(rng.integers(10_000 + i * 1000, 11_000 + i * 1000, _EVENTS))
        x, y, p = (rng.integers(0, most, _EVENTS) for most in (346, 260, 2))
        payload, base_ns = encode(make_events(x, y, p, t), encoding)
        about = int(t[0]) * 1000, "camera", 260, 346, i, base_ns, encoding, False
        attached = Attachment(i + 1, 5, b"1" * 16).pack() if how == "named" else b""
        data = EventPacket(*about, payload).to_cdr()
        now_ns = i * 1_000_000
        messages.append(RawMessage("cam/events", EventPacket.SCHEMA_NAME, data, attached, now_ns, now_ns))
    rounds = []
    for _ in range(_ROUNDS):
        inbox = Inbox()
        for message in messages:
            inbox.put(message)
        inbox.close()
        intake = module.Intake(inbox, 100_000, module.Warnings())
        started = time.perf_counter()
        n = sum(isinstance(item, Packet) for item in intake)
        rounds.append(1e6 * (time.perf_counter() - started) / n)
        assert n == _PACKETS
    return float(np.median(rounds[1:]))


if __name__ == "__main__":
    main()
