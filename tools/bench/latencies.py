"""The latency of single events, bin boundaries included, as `streamfeat latency` measures it.

Lives here: the part `latency`. Not here: the measurement, which is the program's own.

Events come in recorded order, as fast as they follow each other; end to end through the pipeline is the
command's matter. The same stream is gone through several times, and what counts is each event's median over
the runs: a bin boundary costs the same event its time in every run, another program that takes the core
seldom hits the same event twice. The figures of all runs as they came stand beside it.
"""

import importlib.util
from typing import Any

import numpy as np

import streamfeat as sf
from streamfeat.recordings.reader import Packet
from tools.bench.material import Setting, encoder_of_volumes

__all__ = ["measure_latency"]


def measure_latency(setting: Setting) -> dict[str, Any]:
    """Percentiles of single updates, stride 4, with and without looking ahead."""
    if importlib.util.find_spec("streamfeat.latency") is None:
        return {"missing": ["streamfeat.latency"]}
    from streamfeat.latency.histogram import Latencies
    from streamfeat.latency.update import walk

    warm_up, most, runs = (100, 500, 2) if setting.quick else (5000, 30_000, 7)
    encoder = encoder_of_volumes(setting.material, setting.geometry(stride=4), setting.n_filters)
    items = _first_items(setting, encoder.geometry, warm_up + most)
    taken: dict[str, list[Any]] = {"looking ahead": [], "one plane": []}
    setting.say(f"{runs} runs of {most:,} events each way")
    for _ in range(runs):
        for name, walks in taken.items():
            walks.append(walk(encoder, items, look_ahead=name == "looking ahead", warm_up=warm_up))
    figures: dict[str, Any] = {}
    for name, walks in taken.items():
        begins = walks[0].begins_bin
        ns = np.stack([walked.ns for walked in walks])
        middle = np.median(ns, axis=0).astype(np.int64)
        figures[name] = {
            "update": Latencies(middle).figures() | {"boundary_share": float(begins.mean())},
            "boundaries": Latencies(middle[begins]).figures(),
            "as they came": Latencies(ns.reshape(-1)).figures(),
        }
    return figures


def _first_items(setting: Setting, geometry: sf.Geometry, events: int) -> list[Any]:
    """Packets and labels of the recording's beginning whose sensors have room for a volume."""
    items: list[Any] = []
    with sf.open_recording(setting.material.path) as recording:
        for item in recording.items():
            if isinstance(item, Packet):
                if min(geometry.ring_shape(item.resolution)) < geometry.patch:
                    continue
                events -= len(item.events)
            items.append(item)
            if events <= 0:
                break
    return items
