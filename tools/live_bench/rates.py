"""How many events a second a listener carries, and what becomes of ten times as many."""

import json
import time
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from streamfeat.live.names import Attachment, PlainNames
from streamfeat.live.network import open_session
from streamfeat.live.publisher import MessagePublisher
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.packets import PacketWriter
from tools.live_bench.processes import (
    FRAME,
    KEY,
    Reader,
    camera_packets,
    counts,
    finish,
    listener,
    numbered,
    wait_for_reader,
)

PACKET = 4096
"""Events of a packet."""


def measure_rate(arguments: Namespace) -> dict[str, Any]:
    """The highest rate at which nothing is lost for as long as asked, and ten times that for ten seconds."""
    asked = arguments.first_rate
    while asked < 2e8 and _is_whole(tried := _at_rate(arguments, asked, 3.0)):
        print(json.dumps({"try": tried}), flush=True)
        asked *= 1.5
    # What is carried for seconds need not be carried for a minute.
    while asked > 1e4:
        asked *= 0.6
        long = _at_rate(arguments, asked, arguments.seconds)
        if _is_whole(long):
            ten_times = _at_rate(arguments, asked * 10, min(arguments.seconds, 10))
            return {"highest": long, "ten times": ten_times}
        print(json.dumps({"try": long}), flush=True)
    return {"none": long}


def _at_rate(arguments: Namespace, rate: float, seconds: float, emit: str = "auto") -> dict[str, Any]:
    """Publish packets of 4,096 events at a rate; nothing waits for the listener."""
    size = PACKET
    step_us = max(int(size / rate * 1e6), 1)
    with (
        open_session(port=arguments.port) as session,
        listener(arguments, "--emit", emit) as (one, metrics),
    ):
        reader = Reader(session)
        camera = MessagePublisher(session, PlainNames(KEY), KEY, EventPacket.SCHEMA_NAME)
        wait_for_reader(session, KEY)
        ready = ready_packets(arguments.recording, step_us)
        first = 0
        while not counts(metrics).get("packets"):  # a listener has a subscription before it has its kernels
            camera.put(numbered(ready[first % len(ready)], first, first * step_us * 1000))
            first += 1
            time.sleep(0.02)
        started, n = time.perf_counter(), first
        for n in range(first, first + int(rate / size * seconds)):
            while n - first > (time.perf_counter() - started) * rate / size:
                time.sleep(0.0005)
            camera.put(numbered(ready[n % len(ready)], n, n * step_us * 1000))
        n += 1
        sent_s = time.perf_counter() - started
        # One more that waits for its turn: of what is lost at the very end nothing else would tell.
        attached = Attachment(n + 1, time.time_ns(), camera.gid).pack()
        blocking = zenoh.CongestionControl.BLOCK
        last = numbered(ready[n % len(ready)], n, n * step_us * 1000)
        session.put(KEY, last, congestion_control=blocking, attachment=attached)
        n += 1
        stopped = time.perf_counter()
        wait = time.monotonic() + 30
        while (seen := counts(metrics))['queue_depth{queue="inbox_messages"}'] and time.monotonic() < wait:
            time.sleep(0.05)
        time.sleep(0.3)
        behind_s = max((t for t, *_ in reader.features), default=stopped) - stopped
        camera.close()
        result = finish(one)
    return {
        "asked_events_per_s": round(rate),
        "sent_events_per_s": round((n - first) * size / sent_s),
        "heard_events_per_s": round((result["events"] - first * size) / sent_s),
        "seconds": round(sent_s, 1),
        "sent_packets": n,
        "packets": result["packets"],
        "lost": result["lost"],
        "dropped": result["dropped"],
        "unaccounted": n - sum(result[name] for name in ("packets", "lost", "dropped", "unheard")),
        "unheard": max(result["unheard"] - first, 0),
        "emissions": result["emissions"],
        "incomplete": result["incomplete"],
        "last_features_after_s": round(behind_s, 3),
        "end_to_end_p50_ms": result.get("end_to_end_p50_ms"),
        "end_to_end_p99_ms": result.get("end_to_end_p99_ms"),
        "cameras_seen": int(seen["cameras"]),
    }


def ready_packets(recording: Path, step_us: int) -> list[EventPacket]:
    """Packets, at most 64, encoded: the same pixels again and again, at the times of a rate."""
    rng, writer, ready = np.random.default_rng(0), PacketWriter(), []
    events = np.concatenate(camera_packets(recording, 5))
    for i in range(min(len(events) // PACKET, 64)):
        batch = events[i * PACKET : (i + 1) * PACKET].copy()
        batch["t"] = np.sort(rng.integers(0, step_us, len(batch)))
        ready += writer.messages(batch, FRAME)
    return ready


def _is_whole(tried: dict[str, Any]) -> bool:
    """Whether all that was asked for was sent, and all that was sent was used."""
    missing = tried["lost"] + tried["dropped"] + tried["unaccounted"] + tried["unheard"]
    return not missing and tried["sent_events_per_s"] >= 0.95 * tried["asked_events_per_s"]
