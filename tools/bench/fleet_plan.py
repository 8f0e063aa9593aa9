"""How many machines so many cameras need.

Lives here: the arithmetic from the cost of an event to processes and machines.
Not here: what an event costs (`growth`).
"""

import math
from typing import Any

from streamfeat.errors import InputError
from streamfeat.live.shard import Shard
from tools.bench.growth_streams import SLICE_US, Load

__all__ = ["HEADROOM", "plan"]

HEADROOM = 0.5
"""Share of a core that is planned with: the other half is for bursts, restarts and what else runs there."""
PACKETS_PER_S = 1_000_000 // SLICE_US
"""Of one camera."""
PACKET_US = 940.0
"""Processor time of a packet beyond its events, see the README: receiving, decoding, two threads, an emission
put on the network."""
OTHERS_US = 200.0
"""Processor time of a packet of 32 kB that is another process's, see `tools/live_bench shards`."""


def plan(event_ns: float, load: Load, cameras: int, cores: int) -> dict[str, Any]:
    """Machines, with a process for each of their cores and `--shard`.

    Shares are even on average only: cameras are given names, to see what the heaviest process would have. A
    process with more than a core of work emits less often than it was asked to, and drops nothing.

    Args:
        event_ns: what an event costs an engine on such a machine.
        load: one camera.
        cameras: how many there are.
        cores: of one machine.

    Raises:
        InputError: one camera is more than a core can carry.
    """
    engine = event_ns * load.rate / 1e9
    busy = engine + PACKETS_PER_S * PACKET_US / 1e6
    if busy > 1:
        raise InputError(
            f"one camera keeps {busy:.2f} cores busy, and a process has one: emit less often (--emit auto "
            "does by itself), or take a larger stride, a smaller sensor (--downsample) or fewer filters"
        )
    machines = math.ceil(cameras * busy / (HEADROOM * cores))
    processes = min(machines * cores, cameras)
    names = [f"robot/cam{i}/events" for i in range(cameras)]
    shares = [sum(map(Shard(i, processes).has, names)) for i in range(processes)]
    others = cameras * (1 - 1 / processes) * PACKETS_PER_S * OTHERS_US / 1e6
    return {
        "load": load.name,
        "cameras": cameras,
        "event_ns": round(event_ns, 1),
        "engine_cores_per_camera": round(engine, 4),
        "cores_per_camera": round(busy, 4),
        "planned_share_of_a_core": HEADROOM,
        "cores_per_machine": cores,
        "machines": machines,
        "processes": processes,
        "cameras_of_the_heaviest_process": max(shares),
        "its_cores": round(max(shares) * busy, 3),
        "more_cores_a_process_without_announced": round(others, 3),
    }
