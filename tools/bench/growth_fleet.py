"""A real listener with several cameras, at the pace of the clock.

Lives here: what `streamfeat listen` takes of the processor beyond its engines, and whether that adds up.
Not here: engines by themselves (`growth`), what follows from it (`fleet_plan`).
"""

import argparse
import contextlib
import socket
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

from streamfeat.live.names import PlainNames
from streamfeat.live.network import open_session
from streamfeat.live.publisher import MessagePublisher
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.packets import PacketWriter
from streamfeat.report.machine import Disturbance
from tools.bench.growth_streams import SLICE_US, Load, Stream
from tools.bench.material import Material
from tools.live_bench.processes import cpu_seconds, finish, listener, wait_for_reader

__all__ = ["PACKETS_PER_S", "measure_fleet"]

PACKETS_PER_S = 1_000_000 // SLICE_US
"""Of one camera, each a slice of its stream."""


def measure_fleet(
    material: Material,
    load: Load,
    counts: tuple[int, ...],
    seconds: float,
    event_ns: float,
    turns: int = 3,
) -> dict[str, Any]:
    """Cores that one listener keeps busy with so many cameras.

    What a packet costs beyond its events is taken from the first number of cameras, and predicts the others.

    Args:
        material: what the cameras see.
        load: one camera.
        counts: of cameras.
        seconds: of each, in each turn.
        event_ns: what an event costs an engine, nanoseconds.
        turns: of which medians are taken.
    """
    stream, port = Stream(material, load, 20_000), _free_port()
    engines = event_ns * load.rate / 1e9
    disturbance = Disturbance()
    runs = [[_listening(stream, load, count, seconds, port) for count in counts] for _ in range(turns)]
    rows = [
        {"cameras": count} | {name: median(run[i][name] for run in runs) for name in runs[0][i]}
        for i, count in enumerate(counts)
    ]
    packet_s = max(rows[0]["cores"] / rows[0]["cameras"] - engines, 0.0) / PACKETS_PER_S
    for row in rows:
        row["predicted_cores"] = row["cameras"] * (engines + packet_s * PACKETS_PER_S)
    return {
        "load": load.name,
        "engine_cores_per_camera": engines,
        "packet_us": 1e6 * packet_s,
        "rows": rows,
        "steal": disturbance.steal_share(),
    }


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def _listening(stream: Stream, load: Load, count: int, seconds: float, port: int) -> dict[str, float]:
    writer = PacketWriter()
    ready = [message for part in stream.slices for message in writer.messages(part, load.resolution)]
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        model = Path(folder) / "model"
        load.encoder().save(model)
        session = stack.enter_context(open_session(port=port))
        arguments = argparse.Namespace(model=model, port=port)
        one, _ = stack.enter_context(listener(arguments, "--emit", load.emit))
        keys = [f"bench/cam{i}/events" for i in range(count)]
        cameras = [
            MessagePublisher(session, PlainNames(key), key, EventPacket.SCHEMA_NAME, block=True)
            for key in keys
        ]
        wait_for_reader(session, keys[0])
        started, before_s, n = time.perf_counter(), 0.0, 0
        begun = started
        while (now := time.perf_counter()) < started + 1 + seconds:
            if not before_s and now > started + 1:  # sessions, engines and caches are there
                begun, before_s = now, cpu_seconds(one.pid)
            if now - started < n / PACKETS_PER_S:
                time.sleep(0.001)
                continue
            turn, i = divmod(n, len(ready))
            shift_ns = turn * stream.period_us * 1000
            packet = ready[i]
            base_ns = packet.time_base + shift_ns
            fresh = EventPacket(
                base_ns, "", *load.resolution, n, base_ns, packet.encoding, False, packet.events
            )
            payload = fresh.to_cdr()
            for camera in cameras:
                camera.put(payload)
            n += 1
        cores = (cpu_seconds(one.pid) - before_s) / (time.perf_counter() - begun)
        for camera in cameras:
            camera.close()
        result = finish(one)
    return {
        "cores": cores,
        "emissions_per_packet": result["emissions"] / max(result["packets"], 1),
        "not_used": result["lost"] + result["dropped"],
    }
