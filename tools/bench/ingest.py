"""Ingest alone: counting events into the ring, against voxel grids of the same events.

Lives here: the part `ingest`. Not here: emissions.

Each library gets the events as it likes them best, prepared outside the timed run: tonic a structured array
of int64 (it changes polarities in place, so each run has its copy), eventcv its own stream.
"""

import importlib.util
from typing import Any

import numpy as np

import streamfeat as sf
from tools.bench.material import Setting, encoder_of_volumes
from tools.bench.timing import PROCESS, Contestant, race

__all__ = ["measure_ingest"]


def measure_ingest(setting: Setting) -> dict[str, Any]:
    """Nanoseconds an event of `Engine.feed`, tonic's and eventcv's voxel grid."""
    events, resolution = setting.material.stream(10_000 if setting.quick else 200_000)
    geometry = setting.geometry(stride=4)
    encoder = encoder_of_volumes(setting.material, geometry, 32)
    origin = int(events["t"].min())
    engine = sf.Engine(encoder, resolution, origin_us=origin)
    height, width = resolution
    contestants = {
        "ours": Contestant(lambda: engine.feed(events), len(events), lambda: engine.restart(origin))
    }
    missing = []
    if importlib.util.find_spec("tonic"):
        contestants["tonic ToVoxelGrid"] = _tonic(events, (width, height), setting.n_bins)
    else:
        missing.append("tonic")
    if importlib.util.find_spec("eventcv"):
        contestants["eventcv voxel"] = _eventcv(events, origin, (width, height), setting.n_bins)
    else:
        missing.append("eventcv")
    setting.say(f"{len(events):,} events")
    result = race(contestants, setting.rounds(40))
    others = [name for name in contestants if name != "ours"]
    return {
        "events": len(events),
        "resolution": list(resolution),
        "race": result.figures(),
        "over_ours": {name: result.ratio(name, "ours") for name in others},
        "million_events_per_s": {name: round(1e3 / result.figure(name)["p50"], 1) for name in contestants},
        "missing": missing,
    }


def _tonic(events: Any, size: tuple[int, int], n_bins: int) -> Contestant:
    import tonic

    transform = tonic.transforms.ToVoxelGrid((*size, 2), n_bins)
    original = events.astype([(name, "<i8") for name in "xypt"])
    work = original.copy()

    def restore() -> None:
        work[:] = original

    return Contestant(lambda: transform(work), len(events), restore)


def _eventcv(events: Any, origin: int, size: tuple[int, int], n_bins: int) -> Contestant:
    import eventcv

    table = np.stack([events["x"], events["y"], events["t"] - origin, events["p"]], axis=1)
    stream = eventcv.from_numpy(table.astype(np.int64), sensor_size=size, time_unit="us")
    return Contestant(lambda: stream.voxel(bins=n_bins), len(events), clock=PROCESS)
