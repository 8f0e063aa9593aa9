"""How many machines so many cameras need.

Lives here: the arithmetic from the cost of an event to processes and machines.
Not here: what an event costs (`model`).
"""

import math
from typing import Any

from streamfeat.cameras import MAX_CAMERAS
from streamfeat.errors import InputError
from tools.bench.material import Material
from tools.cost_growth.fleet import PACKETS_PER_S
from tools.cost_growth.model import Constants, work_of
from tools.cost_growth.streams import Setting, Stream

__all__ = ["HEADROOM", "plan"]

HEADROOM = 0.5
"""Share of a core that is planned with: the other half is for bursts, restarts and what else runs there."""
PACKET_US = 1000.0
"""Processor time of a packet beyond its events, where it was not measured: receiving, decoding, two threads,
a reading put on the network."""


def plan(
    constants: Constants, packet_us: float, material: Material, setting: Setting, cameras: int, cores: int
) -> dict[str, Any]:
    """Processes of one core each, and machines.

    Args:
        constants: of such a machine.
        packet_us: of it, see `measure_fleet`.
        material: what the cameras see.
        setting: one camera.
        cameras: how many there are.
        cores: of one machine.

    Raises:
        InputError: one camera is more than a core can carry.
    """
    work = work_of(setting, Stream(material, setting, 20_000))
    event_ns = constants.predict(work)
    engine = event_ns * setting.rate / 1e9
    load = engine + PACKETS_PER_S * packet_us / 1e6
    if load > HEADROOM:
        raise InputError(
            f"one camera keeps {load:.2f} cores busy, more than the {HEADROOM:g} that a process plans for: "
            "read less often (--emit auto does by itself), or take a larger stride or fewer filters"
        )
    each = min(int(HEADROOM / load), MAX_CAMERAS)
    processes = math.ceil(cameras / each)
    return {
        "setting": setting.name,
        "cameras": cameras,
        "event_ns": round(event_ns, 1),
        "engine_cores_per_camera": round(engine, 4),
        "cores_per_camera": round(load, 4),
        "cameras_per_process": each,
        "processes": processes,
        "machines": math.ceil(processes / cores),
        "cores_per_machine": cores,
        "planned_share_of_a_core": HEADROOM,
    }
