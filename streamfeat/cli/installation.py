"""The state of this installation: versions, missing extras, exactness and speed.

Lives here: versions against what the package asks for, extras, threads, kernels, a second of work.
Not here: measurements that figures are quoted from (`latency`), and how the result is shown (`cli`).
"""

import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.events import Events
from streamfeat.kernels import cache
from streamfeat.report.machine import Disturbance, describe_machine
from streamfeat.simulate.camera import CameraModel
from streamfeat.simulate.saccades import digit_samples

__all__ = ["EXTRAS", "examine"]

EXTRAS = {
    "bags": "bags of ROS 1 and 2 as recordings",
    "cluster": "work on other processes and machines",
    "convert": "Prophesee HDF5 files",
    "export": "Arrow, Parquet and pandas",
    "plot": "pages and pictures of results",
    "simulate": "events of images and videos",
    "deep": "the network of `evaluate --method est`",
    "store": "recordings by URL",
    "view": "Foxglove",
    "bench": "peers in tools/bench",
    "fuzz": "guided inputs in tests/torture",
    "test": "the tests",
    "lint": "lint and types",
}
"""The purpose of each extra."""

_VECTORS = ("sse4.2", "avx", "avx2", "fma", "avx512f", "avx512bw", "avx512vl", "neon", "sve")
_FILTERS = 400
_GEOMETRY = Geometry(patch=12, stride=4, n_bins=3, bin_us=100_000, max_count=1)
"""The default of `streamfeat learn`."""

_SAMPLE_US = 1_000_000


def examine(progress: Callable[[str], None] = lambda step: None, *, seconds: float = 1.0) -> dict[str, Any]:
    """Look at everything; compiles kernels where that has not been done yet.

    Args:
        progress: told what comes next.
        seconds: of work in the speed check.

    Returns:
        JSON values; `problems` has a line for each thing that keeps streamfeat from working as it should.
    """
    progress("versions")
    required, extras = _requirements()
    problems = [
        f"{name} {found or 'is missing'}, wanted {wanted}: pip install --upgrade streamfeat"
        for name, (found, wanted) in required.items()
        if not _satisfies(found, wanted)
    ]
    features = [name for name, there in llvm.get_host_cpu_features().items() if there]
    report: dict[str, Any] = {
        "machine": describe_machine() | {"target": llvm.get_host_cpu_name()},
        "cpu_features": sorted(features),
        "vectors": [name for name in _VECTORS if name in features],
        "threads": _threads(),
        "required": {
            name: {"installed": found, "wanted": wanted} for name, (found, wanted) in required.items()
        },
        "extras": {
            extra: {
                "for": EXTRAS.get(extra, ""),
                "missing": [
                    name + (f" {wanted}, not {found}" if found else "")
                    for name, (found, wanted) in parts.items()
                    if not _satisfies(found, wanted)
                ],
            }
            for extra, parts in extras.items()
        },
    }
    report |= _work(progress, seconds)
    if not report["kernels"]["cached"]:
        problems.append(
            "compiled kernels cannot be kept anywhere, so every start compiles them again: set "
            "NUMBA_CACHE_DIR to a folder that can be written to"
        )
    if not report["exact"]:
        problems.append(
            "features of the stream differ from those computed offline: please report this machine"
        )
    return report | {"problems": problems}


def _threads() -> dict[str, Any]:
    """How many numba uses, and through which library; asking how many starts them."""
    n = numba.get_num_threads()
    return {"numba": n, "layer": numba.threading_layer()}  # type: ignore[attr-defined]


def _requirements() -> tuple[dict[str, tuple[str, str]], dict[str, dict[str, tuple[str, str]]]]:
    """Installed version ("" for none) and wanted range of each dependency; the same for each extra."""
    required: dict[str, tuple[str, str]] = {}
    extras: dict[str, dict[str, tuple[str, str]]] = {}
    for requirement in map(Requirement, requires("streamfeat") or []):
        about = _installed(requirement.name), str(requirement.specifier)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            required[requirement.name] = about
            continue
        for extra in metadata("streamfeat").get_all("Provides-Extra") or []:
            if requirement.marker.evaluate({"extra": extra}):
                extras.setdefault(extra, {})[requirement.name] = about
    return required, extras


def _installed(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _satisfies(found: str, wanted: str) -> bool:
    """Whether an installed version is inside bounds such as `>=2.0,<3`; "" is never."""
    return bool(found) and SpecifierSet(wanted).contains(found, prereleases=True)


def _work(progress: Callable[[str], None], seconds: float) -> dict[str, Any]:
    """Encode simulated digits both ways; then as many events as fit into the time."""
    progress("compiling kernels, if this is the first time")
    events, resolution = _digit_events(), CameraModel().resolution
    encoder = random_encoder(0, _GEOMETRY, _FILTERS, encoding="split", threshold=0.3)
    started = time.perf_counter()
    feeding, following = Engine(encoder, resolution), Engine(encoder, resolution)
    feeding.feed(events)
    following.follow(events)
    offline = encoder.encode(events, resolution, origin_us=0)
    compiled = time.perf_counter() - started
    exact = all(np.array_equal(engine.features(), offline) for engine in (feeding, following))
    progress("a second of work")
    disturbance = Disturbance()
    fed = _events_per_second(feeding.feed, events, 0.3 * seconds, size=len(events))
    followed = _events_per_second(following.follow, events, 0.7 * seconds, size=200)
    return {
        "kernels": _kernel_cache() | {"first_use_s": round(compiled, 2)},
        "exact": exact,
        "speed": {
            "events_per_s": round(fed),
            "event_us": round(1e6 / followed, 2),
            "filters": encoder.n_filters,
            "taken_by_others": disturbance.steal_share(),
        },
    }


def _kernel_cache() -> dict[str, Any]:
    folder = cache.folder()
    return {"folder": str(folder or ""), "cached": folder is not None, "digest": cache.digest()}


def _events_per_second(take: Callable[[Events], None], events: Events, seconds: float, *, size: int) -> float:
    """Take batches of `size` for some seconds of the clock; stream time goes on at each round."""
    n, events = 0, events.copy()
    started = time.perf_counter()
    while True:
        events["t"] += _SAMPLE_US
        for start in range(0, len(events), size):
            batch = events[start : start + size]
            take(batch)
            n += len(batch)
            if (spent := time.perf_counter() - started) >= seconds:
                return n / spent


def _digit_events() -> Events:
    return next(iter(digit_samples(1, 0))).events
