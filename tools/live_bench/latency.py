"""From a packet's put to the features that it completes, and to its echo from a bare callback."""

import sys
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from streamfeat.engine.encoder import Encoder
from streamfeat.events import Events
from streamfeat.live.names import Attachment, PlainNames
from streamfeat.live.network import open_session
from streamfeat.live.publisher import MessagePublisher
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.packets import Packet, PacketWriter
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session
from tools.live_bench.processes import (
    FRAME,
    KEY,
    Reader,
    camera_packets,
    finish,
    listener,
    process,
    wait_for_reader,
    zenoh_config,
)

_ECHO = """
import sys, zenoh
from zenoh.handlers import Callback
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
publisher = session.declare_publisher("bench/echo/out", express=True)
answer = lambda sample: publisher.put(sample.payload, attachment=sample.attachment)
subscriber = session.declare_subscriber("bench/echo/in", Callback(answer, indirect=False))
sys.stdin.read()
"""


def measure_latency(arguments: Namespace) -> dict[str, Any]:
    """From a packet's put to the features that it completes, and to its echo from a bare callback."""
    slices = camera_packets(arguments.recording, min(arguments.seconds, 30))
    packets = _encoded(slices)
    alone = _emission_seconds(arguments.model, slices)[5:]
    meeting = zenoh_config("peer", connect=[f"127.0.0.1:{arguments.port}"], listen=["127.0.0.1:0"])
    with (
        open_session(port=arguments.port) as session,
        listener(arguments, "--emit", "10ms") as (one, _),
        process(sys.executable, "-c", _ECHO, meeting),
    ):
        reader = Reader(session)
        echoes: list[tuple[float, int]] = []

        def note(sample: zenoh.Sample) -> None:
            attached = Attachment.unpack(sample.attachment.to_bytes())
            echoes.append((time.perf_counter(), attached.seq if attached else 0))

        watch = session.declare_subscriber("bench/echo/out", note)
        camera = MessagePublisher(session, PlainNames(KEY), KEY, EventPacket.SCHEMA_NAME)
        bare = session.declare_publisher("bench/echo/in", express=True)
        for key in (KEY, "bench/echo/in"):
            wait_for_reader(session, key)
        echoed_at: list[float] = []

        def put(data: bytes) -> None:
            camera.put(data)
            # Not at once: the two would measure how they wait for each other.
            time.sleep(0.0007)
            echoed_at.append(time.perf_counter())
            bare.put(data, attachment=Attachment(len(echoed_at), 0, bytes(16)).pack())

        when = _put_at_pace(packets, put)
        time.sleep(1)
        watch.undeclare()
        camera.close()
        result = finish(one)
    ends = np.array([last for last, *_ in packets])
    # The packet that completes an emission is the first whose events reach beyond it.
    seen = [
        arrived - when[index]
        for arrived, t_us, _ in reader.features
        if (index := int(np.searchsorted(ends, t_us))) < len(ends)
    ]
    echo = [arrived - echoed_at[seq - 1] for arrived, seq in echoes]
    return {
        "packets": len(packets),
        "events_per_packet": round(float(np.mean([n for _, n, _ in packets]))),
        "emissions": len(seen),
        "emission_alone_p50_ms": _share(alone, 50),
        "emission_alone_p99_ms": _share(alone, 99),
        "features_p50_ms": _share(seen, 50),
        "features_p99_ms": _share(seen, 99),
        "echo_p50_ms": _share(echo, 50),
        "echo_p99_ms": _share(echo, 99),
        "p50_ratio_beyond_the_emission": round((_share(seen, 50) - _share(alone, 50)) / _share(echo, 50), 2),
        "lost": result["lost"],
        "dropped": result["dropped"],
    }


def _encoded(slices: list[Events]) -> list[tuple[int, int, bytes]]:
    """Each packet as (time of its last event, number of events, CDR)."""
    writer = PacketWriter()
    return [
        (int(part["t"][-1]), len(part), message.to_cdr())
        for part in slices
        for message in writer.messages(part, FRAME)
    ]


def _put_at_pace(packets: list[tuple[int, int, bytes]], put: Callable[[bytes], None]) -> list[float]:
    """Put packets at the pace of their events; gives when each was put."""
    started, first, when = time.perf_counter(), packets[0][0], []
    for last_us, _, data in packets:
        wait = started + (last_us - first) / 1e6 - time.perf_counter()
        if wait > 0:
            time.sleep(wait)
        when.append(time.perf_counter())
        put(data)
    return when


def _emission_seconds(model: Path, slices: list[Events]) -> list[float]:
    """What the packets that bring an emission cost by themselves: no network, no pipeline."""
    session = Session(Encoder.load(model), EmitPolicy.parse("10ms"))
    spent = []
    for part in slices:
        started = time.perf_counter()
        emissions = len(list(session.process(Packet("", part, FRAME, 0, 0))))
        if emissions:
            spent.append(time.perf_counter() - started)
    return spent


def _share(values: Sequence[float], percent: float) -> float:
    """A percentile of seconds, in milliseconds."""
    return round(1e3 * float(np.percentile(values, percent)), 3) if len(values) else float("nan")
