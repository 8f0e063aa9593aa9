"""The direct formulation, event by event: against floors in C, and against other ways to the same features.

Lives here: the parts `floors` and `peers`. Not here: the inverse formulation (`inverse`).

A run follows a burst of real events in one bin and takes them back, so every event does the work that most
events do, with caches as they are in mid-stream; bin boundaries are the matter of the part `latency`. Times
are divided by the updates: an event that changes a clipped count, times the volumes that cover it.
"""

import importlib.util
import os
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import streamfeat as sf
from streamfeat.engine.operator import with_fixed_point
from tools.bench.floor import BUILDS, Floor, Walks, compile_floor, quadrants
from tools.bench.material import Burst, Setting, Updates, encoder_of_volumes
from tools.bench.timing import WALL, Contestant, Race, race

__all__ = ["measure_floors", "measure_peers"]

BURST = 2000
"""Events of a burst."""


def follower(
    burst: Burst, encoder: sf.Encoder, **options: Any
) -> tuple[Contestant, Updates, Callable[[], NDArray[np.float32]]]:
    """Following a burst there and back as a contestant, its updates, and the features half-way."""
    events = burst.there_and_back
    updates = Updates.of(burst, events, encoder.geometry)
    engine = burst.engine(encoder, **options)

    def half_way() -> NDArray[np.float32]:
        engine.follow(burst.events)
        features = engine.features()
        engine.follow(events[len(burst.events) :])
        return features

    return Contestant(lambda: engine.follow(events), max(1, len(updates.rows))), updates, half_way


def measure_floors(setting: Setting) -> dict[str, Any]:
    """Our update against the same in C and against its bytes."""
    geometry = setting.geometry(stride=12)
    burst = setting.material.burst(geometry, BURST)
    encoder = encoder_of_volumes(setting.material, geometry, setting.n_filters)
    ours, updates, half_way = follower(burst, encoder)
    contestants = {"ours": ours}
    volumes = updates.volumes(geometry, burst.resolution)
    shape = geometry.grid_shape(burst.resolution)
    operator = with_fixed_point(encoder.operator, shape)
    features = half_way()
    forth = Updates.of(burst, burst.events, geometry).rows
    libraries = {name: compile_floor(flags) for name, flags in BUILDS.items()}
    equal = True
    for name, library in libraries.items():
        for stored in (False, True) if library else ():
            floor = Floor(library, operator, volumes, shape, stored=stored)
            floor.moves(forth)()
            pooled = (floor.pooled[:, : encoder.n_filters].reshape(-1) / operator.unit).astype(np.float32)
            equal &= bool(np.array_equal(pooled, features))
            floor.moves(updates.rows[len(forth) :])()
            kind = f"{name}, old code {'stored' if stored else 'computed'}"
            contestants[kind] = Contestant(floor.moves(updates.rows), ours.units)
    floors = [name for name in contestants if name != "ours"]
    library = next((library for library in libraries.values() if library), None)
    walks = _walks(Walks(library), operator, volumes, updates, shape) if library else {}
    contestants |= {name: Contestant(walk, ours.units) for name, (walk, _) in walks.items()}
    setting.say(f"{len(contestants)} contestants, {len(updates.rows)} updates")
    with threadpool_limits(1):
        result = race(contestants, setting.rounds(150))
    best = result.fastest(floors) if floors else None
    return {
        "events": len(burst.there_and_back),
        "changed": updates.changed,
        "updates": len(updates.rows),
        "volumes": len(volumes),
        "volumes_hit": len(np.unique(updates.rows[:, 0])),
        "columns_hit": len(np.unique(updates.rows[:, 1])),
        "race": result.figures(),
        "floor": best,
        "floor_equals_ours": equal if floors else None,
        "ours_over_floor": result.ratio("ours", best) if best else None,
        "bytes": _bytes_floor(result, walks) if walks else None,
        "bandwidth": _bandwidth(setting, Walks(library)) if library else None,
    }


Walk = tuple[Callable[[], object], int]


def _walks(
    walks: Walks, operator: Any, volumes: NDArray[np.int16], updates: Updates, shape: tuple[int, int]
) -> dict[str, Walk]:
    """A walk over each array that an update cannot avoid, in the order of the real updates, with its bytes.

    The old code is computed again, so codes are not among them; moments and counts are some 50 bytes.
    """
    width, rows = len(operator.offset), updates.rows
    projections = np.zeros((len(volumes), width), np.int32)
    pooled = np.zeros((4, width), np.int32)
    offset = operator.offset[None]
    place = quadrants(shape)[rows[:, 0]]
    first = np.zeros(len(rows), np.int32)
    return {
        "column, read": (walks.over(operator.columns, rows[:, 1], write=False), 2 * width),
        "offset, read": (walks.over(offset, first, write=False), 4 * width),
        "projection, read and written": (walks.over(projections, rows[:, 0], write=True), 8 * width),
        "pooled sums, read and written": (walks.over(pooled, place, write=True), 8 * width),
    }


def _bytes_floor(result: Race, walks: dict[str, Walk]) -> dict[str, Any]:
    total = np.sum([result.nanoseconds[name] for name in walks], axis=0)
    both = Race({"ours": result.nanoseconds["ours"], "bytes": total}, result.discarded)
    return {
        "bytes": sum(size for _, size in walks.values()),
        "ns": both.figure("bytes"),
        "ours_over_bytes": both.ratio("ours", "bytes"),
        "gigabytes_per_s": {
            name: round(size / result.figure(name)["p50"], 1) for name, (_, size) in walks.items()
        },
    }


def _bandwidth(setting: Setting, walks: Walks) -> dict[str, float]:
    """Gigabytes a second of walking over memory that fits a cache, for comparison."""
    contestants = {}
    for cache, size in (("16 kB", 1 << 14), ("1 MB", 1 << 20), ("32 MB", 1 << 25)):
        memory = np.zeros((1, size // 8))
        passes = np.zeros(max(1, (1 << 22) // size), np.int32)
        moved = float(len(passes) * size)
        contestants[f"{cache}, read"] = Contestant(walks.over(memory, passes, write=False), moved)
        contestants[f"{cache}, read and written"] = Contestant(
            walks.over(memory, passes, write=True), 2 * moved
        )
    result = race(contestants, setting.rounds(10))
    return {name: round(1 / result.figure(name)["p50"], 1) for name in contestants}


def measure_peers(setting: Setting) -> dict[str, Any]:
    """Our update in each encoding and with overlapping volumes, against computing features otherwise."""
    sparse, dense = setting.geometry(stride=12), setting.geometry(stride=4)
    burst = setting.material.burst(sparse, 20 if setting.quick else BURST)
    encoder = encoder_of_volumes(setting.material, sparse, setting.n_filters)
    contestants: dict[str, Contestant] = {}
    updates: dict[str, Any] = {}
    for name, geometry, encoding in (
        ("ours, soft", sparse, "soft"),
        ("ours, split", sparse, "split"),
        ("ours, triangle", sparse, "triangle"),
        ("ours, soft, nine volumes", dense, "soft"),
    ):
        mine = with_encoding(encoder, geometry, encoding)
        contestants[name], spelled, _ = follower(burst, mine)
        updates[name] = {"changed": spelled.changed, "updates": len(spelled.rows)}
    spelled = Updates.of(burst, burst.events, sparse)
    contestants |= _matrices(encoder, spelled.volumes(sparse, burst.resolution))
    missing = []
    for package, make in (("eventcv", _feast), ("tonic", _averaged_surface)):
        if importlib.util.find_spec(package):
            contestants |= make(burst)
        else:
            missing.append(package)
    setting.say(f"{len(contestants)} contestants")
    with threadpool_limits(1):
        result = race(contestants, setting.rounds(15))
    ours = "ours, soft"
    others = [name for name in contestants if not name.startswith("ours")]
    return {
        "events": len(burst.there_and_back),
        "updates": updates,
        "race": result.figures(),
        "over_ours": {name: result.ratio(name, ours) for name in others},
        "missing": missing,
    }


def with_encoding(encoder: sf.Encoder, geometry: sf.Geometry, encoding: Any) -> sf.Encoder:
    """The same filters in another encoding or on another grid."""
    return sf.Encoder.build(
        geometry,
        formulation=encoder.formulation,
        encoding=encoding,
        threshold=encoder.threshold,
        filters=encoder.filters,
        whitening=encoder.whitening,
        mean=encoder.mean,
        eps=encoder.operator.eps,
    )


def _matrices(encoder: sf.Encoder, volumes: NDArray[np.int16]) -> dict[str, Contestant]:
    """Codes of whole volumes by a product in float32: one volume at a time, and 512 at once."""
    operator, batch = encoder.operator, 512
    k = encoder.n_filters
    matrix = np.ascontiguousarray(operator.columns[:, :k].T * np.float32(operator.scale), np.float32)
    offset, threshold = operator.offset[:k], np.float32(operator.threshold)
    filled = volumes[volumes.any(1)].astype(np.float32)
    filled /= filled.std(axis=1, keepdims=True) + np.float32(1e-3)
    many = np.ascontiguousarray(np.resize(filled, (batch, filled.shape[1])).T)
    one = np.ascontiguousarray(many[:, 0])
    z_one, z_many = np.empty(k, np.float32), np.empty((k, batch), np.float32)

    def soft(z: NDArray[np.float32]) -> None:
        z -= np.clip(z, -threshold, threshold)

    def from_scratch() -> None:
        for _ in range(8):
            np.dot(matrix, one, out=z_one)
            np.subtract(z_one, offset, out=z_one)
            soft(z_one)

    def batched() -> None:
        np.dot(matrix, many, out=z_many)
        np.subtract(z_many, offset[:, None], out=z_many)
        soft(z_many)

    def batched_on_all() -> None:
        with threadpool_limits(os.cpu_count()):
            batched()

    return {
        "matrix-vector product": Contestant(from_scratch, 8),
        "batched matrix product, one thread": Contestant(batched, batch),
        "batched matrix product, all threads": Contestant(batched_on_all, batch, clock=WALL),
    }


def _feast(burst: Burst) -> dict[str, Contestant]:
    """FEAST (Afshar et al. 2020): the nearest of 256 features to the time surface around each event."""
    import eventcv

    def stream(events: Any) -> Any:
        table = np.stack([events["x"], events["y"], events["t"] - burst.origin_us, events["p"]], axis=1)
        height, width = burst.resolution
        return eventcv.from_numpy(table.astype(np.int64), sensor_size=(width, height), time_unit="us")

    model = eventcv.FEAST(n_features=256, patch=11, tau_ms=20.0)
    model.fit(stream(burst.before[-2 * len(burst.events) :]))
    events = stream(burst.events)
    name = "FEAST of eventcv, 256 features"
    return {name: Contestant(lambda: model.transform(events), len(burst.events))}


def _averaged_surface(burst: Burst) -> dict[str, Contestant]:
    """HATS (Sironi et al. 2018) with tonic's own parameters."""
    import tonic

    height, width = burst.resolution
    surface = tonic.transforms.ToAveragedTimesurface((width, height, 2))
    events = burst.events.astype([(name, "<i8") for name in "xypt"])
    name = "averaged time surface of tonic (HATS)"
    return {name: Contestant(lambda: surface(events), len(events))}
