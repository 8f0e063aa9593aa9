"""Real zenoh sessions on loopback for the tests of live topics."""

import json
import os
import socket
import struct
import threading
import time
from contextlib import contextmanager

import zenoh

from streamfeat.engine.encoder import Encoder
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.warming import warm_up

PATIENCE_S = float(os.environ.get("LIVE_PATIENCE_S", "120"))
"""Kernels may have to be compiled first, on a machine that has other things to do."""


def free_port():
    """A TCP port that nobody uses at the moment."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def until(condition, what="the condition"):
    """Wait for a state; give up after a time that no healthy run needs, and say what was there instead.

    Args:
        condition: without arguments.
        what: the state in words, or a function that gives them.
    """
    limit = time.monotonic() + PATIENCE_S
    turn = threading.Event()
    while not (value := condition()):
        assert time.monotonic() < limit, f"{what() if callable(what) else what} did not come about"
        turn.wait(0.002)
    return value


@contextmanager
def plain_session(port, listen=False):
    """A zenoh session that knows nothing of streamfeat; connects to a port, or listens there."""
    meeting = [f"tcp/127.0.0.1:{port}"]
    config = {
        "mode": "peer",
        "listen": {"endpoints": meeting if listen else ["tcp/127.0.0.1:0"]},
        "connect": {
            "endpoints": [] if listen else meeting,
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 20, "period_max_ms": 100, "period_increase_factor": 1.5},
        },
        "scouting": {"multicast": {"enabled": False}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        yield session


@contextmanager
def plain_publisher(session, key, **options):
    """A publisher that somebody listens to, which waits rather than drops."""
    options = {"congestion_control": zenoh.CongestionControl.BLOCK} | options
    with session.declare_publisher(key, **options) as publisher:
        until(lambda: publisher.matching_status.matching, f"a subscriber to {key}")
        yield publisher


def until_heard(session, key, *jobs):
    """Wait until jobs hear a key: each refuses the empty message that is put there."""

    def heard():
        session.put(key, b"")
        return all(job.result()["warnings"] for job in jobs)

    until(heard, f"hearing {key}")


def attachment(seq, gid=b"0123456789abcdef", source_ns=0):
    """33 bytes as the design document of rmw_zenoh has them."""
    return struct.pack("<q", seq) + struct.pack("<q", source_ns) + bytes([16]) + gid


def compiled(folder):
    """Compile what listening needs, before anybody waits for anything; processes find it in numba's cache."""
    for emit in ("event", "10ms"):
        warm_up(Encoder.load(folder / "model"), EmitPolicy.parse(emit), decoders=True)
    return folder


class Collector:
    """Keeps what a plain subscriber gets, as (key, payload, attachment, encoding)."""

    def __init__(self, session, expression):
        self.samples = []
        self._subscriber = session.declare_subscriber(
            expression, self._take, allowed_origin=zenoh.Locality.REMOTE
        )

    def _take(self, sample):
        attached = sample.attachment.to_bytes() if sample.attachment else b""
        self.samples.append((str(sample.key_expr), sample.payload.to_bytes(), attached, str(sample.encoding)))

    def of(self, ending):
        """Payloads of keys with this ending."""
        return [payload for key, payload, *_ in list(self.samples) if key.endswith(ending)]


class ListSink:
    """A sink that keeps emissions."""

    def __init__(self):
        self.emissions = []
        self.closed = None

    def write(self, emissions):
        self.emissions += emissions

    def close(self, *, failed):
        self.closed = "failed" if failed else "done"


@contextmanager
def running(job, *arguments):
    """Run a job in a thread while the block runs; stop it then, and raise what it raised."""
    errors = []

    def run():
        try:
            job.run(*arguments)
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run, name="job")
    thread.start()
    try:
        yield job
    finally:
        job.stop()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
        if errors:
            raise errors[0]
