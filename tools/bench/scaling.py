"""How the cost of an event grows: the paper's table of complexity, measured.

Lives here: the part `scaling`. Not here: peers, its picture (`pictures`).

One quantity at a time moves away from the paper's geometry (K = 1700, patch 12, 7 bins, one volume for each
event). An update of the direct formulation is O(K) whatever the volume's length d is, from scratch it is
O(K d); the inverse formulation pays for its active atoms.
"""

from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import streamfeat as sf
from streamfeat.engine.random_encoder import random_encoder
from tools.bench.direct import follower
from tools.bench.material import Setting, encoder_of_volumes
from tools.bench.timing import Contestant, race

__all__ = ["measure_scaling"]

SWEEPS: dict[str, tuple[int, ...]] = {
    "K": (100, 200, 400, 800, 1700, 3400),
    "patch": (4, 8, 12, 16, 21),
    "bins": (2, 4, 7, 10),
    "stride": (2, 3, 4, 6, 12),
}
INVERSE = (100, 200, 400, 800, 1700)


def measure_scaling(setting: Setting) -> dict[str, Any]:
    """Nanoseconds an update against K, patch, bins, and an event against stride."""
    with threadpool_limits(1):
        return {name: _sweep(setting, name, values) for name, values in SWEEPS.items()} | {
            "inverse": _inverse(setting)
        }


def _sweep(setting: Setting, name: str, values: tuple[int, ...]) -> dict[str, Any]:
    values = values[:2] if setting.quick else values
    setting.say(f"{name}: {', '.join(map(str, values))}")
    contestants, per_event, products = {}, {}, {}
    for value in values:
        k = value if name == "K" else setting.n_filters
        patch = value if name == "patch" else 12
        geometry = setting.geometry(
            stride=value if name == "stride" else patch,
            patch=patch,
            n_bins=value if name == "bins" else setting.n_bins,
        )
        encoder = flat_encoder(geometry, k)
        burst = setting.material.burst(geometry, 100 if setting.quick else 600)
        contestants[str(value)], updates, _ = follower(burst, encoder)
        per_event[str(value)] = round(len(updates.rows) / max(1, updates.changed), 3)
        if name != "stride":
            products[f"from scratch {value}"] = _product(encoder)
    result = race(contestants | products, setting.rounds(15))
    return {
        "updates_per_event": per_event,
        "ns": {name: result.figure(name) for name in contestants},
        "from_scratch_ns": {name.removeprefix("from scratch "): result.figure(name) for name in products},
    }


def _inverse(setting: Setting) -> dict[str, Any]:
    """Both formulations with the same atoms, volumes of the recording drawn at random."""
    setting.say("both formulations")
    geometry = setting.geometry(stride=12)
    contestants = {}
    for k in INVERSE[: 2 if setting.quick else None]:
        burst = setting.material.burst(geometry, 10 if setting.quick else 40)
        for formulation, parameters in (("direct", {}), ("inverse", {"gap": 1e-4})):
            encoder = encoder_of_volumes(setting.material, geometry, k, formulation, **parameters)
            contestants[f"{formulation} {k}"], _, _ = follower(burst, encoder)
    result = race(contestants, setting.rounds(5))
    return {
        formulation: {
            name.partition(" ")[2]: result.figure(name)
            for name in contestants
            if name.startswith(formulation)
        }
        for formulation in ("direct", "inverse")
    }


def flat_encoder(geometry: sf.Geometry, n_filters: int) -> sf.Encoder:
    """Random filters without whitening: the direct formulation costs the same whatever they are."""
    return random_encoder(0, geometry, n_filters, threshold=0.5)


def _product(encoder: sf.Encoder) -> Contestant:
    vector, out = np.ones(encoder.geometry.entries, np.float32), np.empty(encoder.n_filters, np.float32)
    return Contestant(lambda: np.dot(encoder.filters, vector, out=out))
