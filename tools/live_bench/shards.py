"""What a process pays for the cameras of other shards, whose packets its wildcard brings along."""

import time
from argparse import Namespace
from typing import Any

from streamfeat.live.names import PlainNames
from streamfeat.live.network import open_session
from streamfeat.live.publisher import MessagePublisher
from streamfeat.live.shard import Shard
from streamfeat.messages.cdr import EventPacket
from streamfeat.report.machine import Disturbance
from tools.live_bench.processes import (
    KEY,
    counts,
    cpu_seconds,
    finish,
    listener,
    numbered,
    paced,
    wait_for_reader,
)
from tools.live_bench.rates import PACKET, ready_packets

_RATE = 150
"""Packets a second: what one core can well take in."""


def measure_shards(arguments: Namespace) -> dict[str, Any]:
    """Processor time of a listener for each packet: of a camera that is its own, and of one that is not."""
    of = 2
    mine = next(i for i in range(of) if Shard(i, of).has(KEY))
    disturbance = Disturbance()
    found = {
        name: _listening(arguments, f"{index}/{of}")
        for name, index in (("another's", 1 - mine), ("its own", mine), ("another's, again", 1 - mine))
    }
    return found | {"steal": round(disturbance.steal_share() or 0.0, 3)}


def _listening(arguments: Namespace, shard: str) -> dict[str, Any]:
    step_us = 1_000_000 // _RATE
    ready = ready_packets(arguments.recording, step_us)
    with (
        open_session(port=arguments.port) as session,
        listener(arguments, "--emit", "10ms", "--shard", shard) as (one, metrics),
    ):
        camera = MessagePublisher(session, PlainNames(KEY), KEY, EventPacket.SCHEMA_NAME, block=True)
        wait_for_reader(session, KEY)
        counts(metrics)
        idle_s = cpu_seconds(one.pid)
        time.sleep(arguments.seconds)
        idle_s = cpu_seconds(one.pid) - idle_s
        before_s, n = cpu_seconds(one.pid), 0
        for n in paced(_RATE, arguments.seconds):
            camera.put(numbered(ready[n % len(ready)], n, n * step_us * 1000))
        n += 1
        while sum(counts(metrics).get(name, 0) for name in ("packets", "other_shards_packets")) < n - 1:
            time.sleep(0.1)
        taken_s = cpu_seconds(one.pid) - before_s
        camera.close()
        result = finish(one)
    return {
        "packets": result["packets"],
        "other_shards_packets": result.get("other_shards_packets", 0),
        "bytes_per_packet": len(ready[0].events),
        "events_per_packet": PACKET,
        "idle_core_share": round(idle_s / arguments.seconds, 4),
        "microseconds_per_packet": round(1e6 * (taken_s - idle_s) / n, 1),
    }
