"""Measure what a packet costs between the inbox and the session, and until its events are counted.

python tools/live_bench/packets.py
python tools/live_bench/packets.py --against ../before    # a work tree of another commit, taking turns

No network and no features: messages of 100 events are parsed, judged, decoded and placed; `counted` ones go
through the job's figures and a session into an engine, too. Processes of both trees take turns; microseconds
of processor time, the median of each tree and their ratio, are printed as JSON.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
CASES = {
    f"{encoding} {how}": (encoding, how)
    for encoding in ("mono", "evt3")
    for how in ("named", "bare", "counted")
}
"""Encoding of the payload, and whether messages name their publisher or not, or are counted in an engine."""
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
        attached = Attachment(i + 1, 5, b"1" * 16).pack() if how != "bare" else b""
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
        process = _counting() if how == "counted" else lambda item: None
        started, n = time.thread_time(), 0
        for item in intake:
            if item is not None:
                process(item)
                n += isinstance(item, Packet)
        rounds.append(1e6 * (time.thread_time() - started) / n)
        assert n == _PACKETS
    return float(np.median(rounds[1:]))


def _counting() -> Callable[[Any], None]:
    """What a job does with an item until its events are counted; nothing is ever emitted."""
    from streamfeat.engine.geometry import Geometry
    from streamfeat.engine.random_encoder import random_encoder
    from streamfeat.live.health import Health
    from streamfeat.live.inbox import Inbox
    from streamfeat.live.intake import Intake
    from streamfeat.live.warnings import Warnings
    from streamfeat.stream.cameras import Cameras
    from streamfeat.stream.emission import EmitPolicy
    from streamfeat.stream.session import Session

    encoder = random_encoder(0, Geometry(patch=12, stride=4, n_bins=3, bin_us=33_334), 32, encoding="split")
    policy, warnings, inbox = EmitPolicy.parse("100000000ev"), Warnings(), Inbox()
    cameras = Cameras(lambda topic: Session(encoder, policy, clock=time.perf_counter, topic=topic))
    health = Health(cameras, Intake(inbox, 100_000, warnings), inbox, warnings)
    made = getattr(health, "batches", health.process)  # versions before batches made emissions one by one

    def process(item: Any) -> None:
        for _ in made(item):
            pass

    return process


if __name__ == "__main__":
    main()
