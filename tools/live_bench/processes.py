"""The camera, the reader and the processes that measurements are made of.

Lives here: what starts, watches and ends the commands under test.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from argparse import Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from streamfeat.events import Events
from streamfeat.messages.cdr import EventPacket, FeaturesMessage
from streamfeat.recordings.reader import open_recording

FRAME = (100, 120)
"""All samples are shown on one sensor of this size."""
KEY = "bench/cam/events"
PROGRAM = [sys.executable, "-c", "from streamfeat.cli import main; main()"]

Process = subprocess.Popen[str]


def camera_packets(recording: Path, seconds: float, slice_us: int = 2_000) -> list[Events]:
    """The events of a recording without the silence between samples, in slices as a driver sends them."""
    slices, shift, total = [], 0, 0
    with open_recording(recording) as rec:
        for sample in rec.samples():
            events = sample.events[np.argsort(sample.events["t"], kind="stable")]
            events = events[(events["x"] < FRAME[1]) & (events["y"] < FRAME[0])].copy()
            events["t"] += shift - sample.label.start_us
            edges = np.arange(shift, shift + sample.label.duration_us + 1, slice_us)
            slices += [part for part in np.split(events, np.searchsorted(events["t"], edges)) if len(part)]
            shift += sample.label.duration_us
            total += sample.label.duration_us
            if total > seconds * 1e6:
                break
    return slices


def numbered(ready: EventPacket, n: int, stamp_ns: int) -> bytes:
    """An encoded packet as the `n`th of a camera at another time, as CDR."""
    return EventPacket(stamp_ns, "", *FRAME, n, stamp_ns, ready.encoding, False, ready.events).to_cdr()


def paced(per_s: float, seconds: float) -> Iterator[int]:
    """Count up at a rate of the clock, for some seconds; what is late follows at once."""
    started, n = time.perf_counter(), 0
    while (passed := time.perf_counter() - started) < seconds:
        if n >= passed * per_s:
            time.sleep(0.0005)
            continue
        yield n
        n += 1


class Reader:
    """Notes when features arrive, and the numbers of events that a plain subscriber sees."""

    def __init__(self, session: zenoh.Session) -> None:
        self.features: list[tuple[float, int, bool]] = []
        self.arrived = threading.Event()
        self._subscriber = session.declare_subscriber("bench/*/features", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        now = time.perf_counter()
        message = FeaturesMessage.from_cdr(sample.payload.to_bytes())
        self.features.append((now, message.stamp_ns // 1000, message.incomplete))
        self.arrived.set()

    def next_after(self, since: float, timeout: float = 30.0) -> float | None:
        """Seconds from `since` to the next features."""
        until = time.perf_counter() + timeout
        while time.perf_counter() < until:
            after = next((t for t, *_ in reversed(self.features) if t > since), None)
            if after is not None:
                return min(t for t, *_ in self.features if t > since) - since
            self.arrived.clear()
            self.arrived.wait(0.05)
        return None


def zenoh_config(mode: str, *, connect: Sequence[str] = (), listen: Sequence[str] = ()) -> str:
    """A configuration whose session keeps trying to connect, and is not found by multicast."""
    return json.dumps(
        {
            "mode": mode,
            "connect": {
                "endpoints": [f"tcp/{address}" for address in connect],
                "timeout_ms": -1,
                "exit_on_failure": False,
                "retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
            },
            "listen": {"endpoints": [f"tcp/{address}" for address in listen]},
            "scouting": {"multicast": {"enabled": False}},
        }
    )


@contextlib.contextmanager
def process(*words: object, prefix: Sequence[str] = ()) -> Iterator[Process]:
    one = subprocess.Popen(
        [*prefix, *map(str, words)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield one
    finally:
        if one.poll() is None:
            one.kill()
        one.communicate()


def streamfeat(*words: object, prefix: Sequence[str] = ()) -> contextlib.AbstractContextManager[Process]:
    """One of our commands, as a process."""
    return process(*PROGRAM, *words, prefix=prefix)


@contextlib.contextmanager
def listener(arguments: Namespace, *more: object) -> Iterator[tuple[Process, int]]:
    metrics = arguments.port + 1
    words = ["listen", "bench/*/events", "-m", arguments.model, "--port", arguments.port, "--json", "-q"]
    with streamfeat(*words, "--metrics", f"127.0.0.1:{metrics}", *more) as one:
        yield one, metrics


def counts(metrics: int) -> dict[str, float]:
    with urllib.request.urlopen(f"http://127.0.0.1:{metrics}/metrics", timeout=10) as page:
        lines = page.read().decode().splitlines()
    pairs = (line.rsplit(" ", 1) for line in lines if not line.startswith("#"))
    return {name.removeprefix("streamfeat_").removesuffix("_total"): float(value) for name, value in pairs}


def cpu_seconds(pid: int) -> float:
    """Processor time that a process has taken so far."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def finish(one: Process) -> dict[str, Any]:
    one.send_signal(signal.SIGINT)
    text, errors = one.communicate(timeout=60)
    if not text:
        raise SystemExit(errors)
    return json.loads(text)


def wait_for_reader(session: zenoh.Session, key: str, timeout: float = 60.0) -> None:
    with session.declare_publisher(key) as probe:
        until = time.monotonic() + timeout
        while not probe.matching_status.matching:
            if time.monotonic() > until:
                raise SystemExit(f"nobody reads {key}")
            time.sleep(0.01)
