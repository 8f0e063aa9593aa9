"""How near codes are to the mathematics, and how much memory an engine takes.

Lives here: the parts `precision` and `memory`. Not here: anything timed.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numba.core.runtime import _nrt_python, rtsys

import streamfeat as sf
from streamfeat.engine.window import count_window
from tools.bench.inverse import whitened
from tools.bench.material import Setting, Updates, encoder_of
from tools.bench.scaling import flat_encoder

__all__ = ["measure_memory", "measure_precision"]


def measure_precision(setting: Setting) -> dict[str, Any]:
    """Soft codes of the engine against the same in float64 NumPy, with unquantised filters."""
    geometry = setting.geometry(stride=4)
    encoder = encoder_of(setting, geometry, setting.n_filters, "direct", "soft")
    filters, threshold = encoder.filters.astype(np.float64), encoder.threshold
    largest = difference = 0.0
    volumes = 0
    samples = setting.material.fitting(geometry.patch)[:: max(1, len(setting.material.samples) // 8)]
    for sample in samples[: 1 if setting.quick else 8]:
        start = sample.label.start_us
        last = start + geometry.window_us - 1
        engine = sf.Engine(encoder, sample.resolution, origin_us=start)
        engine.feed(sample.events)
        engine.advance(last)
        codes = engine.codes().reshape(-1, encoder.n_filters)
        counts = count_window(geometry, sample.events, sample.resolution, start, last)
        window = Updates(np.zeros((0, 4), np.int32), 0, counts).volumes(geometry, sample.resolution)
        z = whitened(encoder, window) @ filters.T
        exact = np.sign(z) * np.maximum(np.abs(z) - threshold, 0)
        exact[~window.any(1)] = 0
        largest = max(largest, float(np.abs(exact).max()))
        difference = max(difference, float(np.abs(codes - exact).max()))
        volumes += int(window.any(1).sum())
    return {
        "volumes": volumes,
        "largest_code": round(largest, 4),
        "largest_difference": float(f"{difference:.3g}"),
        "relative": float(f"{difference / largest:.3g}"),
    }


def measure_memory(setting: Setting) -> dict[str, Any]:
    """An engine for 640x480 pixels, in processes of its own, without and with looking ahead."""
    figures = {}
    for look_ahead in (False, True):
        command = [
            sys.executable,
            "-m",
            "tools.bench.precision",
            str(setting.n_filters),
            str(int(look_ahead)),
        ]
        # Whatever is allocated is a mapping of its own, so that what was freed before does not hide it.
        environment = os.environ | {
            "MALLOC_MMAP_THRESHOLD_": "65536",
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        }
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        figures["looking ahead" if look_ahead else "one plane"] = json.loads(done.stdout)
    return figures


def memory_of_engine(n_filters: int, *, look_ahead: bool) -> dict[str, Any]:
    """Bytes of one engine that has seen events all over its sensor.

    The arithmetic minimum: an int32 count for each pixel of the ring and each bin, one int32 row of K
    projections for each volume, looking ahead two, and four int32 rows of pooled sums. The operator is
    read-only and shared by all engines of an encoder.
    """
    geometry = sf.Geometry(patch=12, stride=4, n_bins=7, bin_us=1000, downsample=4)
    rng = np.random.default_rng(0)
    encoder = flat_encoder(geometry, n_filters)
    resolution = (480, 640)
    small = sf.Engine(encoder, (96, 96), look_ahead=look_ahead)
    _use(small, rng, 500)
    before = _resident()
    engine = sf.Engine(encoder, resolution, look_ahead=look_ahead)
    _use(engine, rng, 20_000)
    resident = _resident() - before
    allocated = _allocations(engine, rng)
    (rows, columns), (height, width) = geometry.grid_shape(resolution), geometry.ring_shape(resolution)
    projected = (2 if look_ahead else 1) * rows * columns * n_filters
    least = 4 * (geometry.n_bins * height * width + projected + 4 * n_filters)
    own = _own_bytes(engine, set())
    return {
        "volumes": rows * columns,
        "least_bytes": least,
        "state_bytes": own,
        "state_over_least": round(own / least, 3),
        "resident_bytes": resident,
        "operator_bytes": sum(a.nbytes for a in encoder.operator if isinstance(a, np.ndarray)),
        "allocations_in_1000_events": allocated,
    }


def _use(engine: sf.Engine, rng: np.random.Generator, n: int) -> None:
    """Feed and follow events of 10 bins."""
    engine.feed(_events(engine, rng, n, 0, 7000))
    engine.features()
    engine.follow(_events(engine, rng, n // 10, 7000, 10_000))
    engine.prepare(10**9)
    engine.features()


def _events(engine: sf.Engine, rng: np.random.Generator, n: int, start: int, stop: int) -> Any:
    height, width = engine.resolution
    x, y, p = rng.integers(0, width, n), rng.integers(0, height, n), rng.integers(0, 2, n)
    return sf.make_events(x, y, p, np.sort(rng.integers(start, stop, n)))


def _resident() -> int:
    """Resident bytes of this process; 0 where nobody says."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * 4096
    except OSError:
        return 0


def _allocations(engine: sf.Engine, rng: np.random.Generator) -> int:
    """Arrays that compiled code allocates for 1,000 events, beyond those that every call hands over."""
    _nrt_python.memsys_enable_stats()
    allocated = []
    for i, n in enumerate((1000, 2000)):
        start = 10_000 + 2000 * i
        followed, fed = (_events(engine, rng, n, t, t + 900) for t in (start, start + 1000))
        engine.features()
        before = rtsys.get_allocation_stats().mi_alloc
        engine.follow(followed)
        engine.feed(fed)
        allocated.append(rtsys.get_allocation_stats().mi_alloc - before)
    return int(allocated[1] - allocated[0])


def _own_bytes(value: Any, seen: set[int]) -> int:
    """Bytes of the arrays that can be written and are reached from an object."""
    if id(value) in seen or isinstance(value, sf.Encoder):
        return 0
    seen.add(id(value))
    if isinstance(value, np.ndarray):
        if value.flags.writeable and isinstance(value.base, np.ndarray):
            return _own_bytes(value.base, seen)  # aligned within a larger one, which nothing else holds
        return value.nbytes if value.flags.writeable else 0
    if isinstance(value, tuple | list):
        return sum(_own_bytes(item, seen) for item in value)
    return sum(_own_bytes(item, seen) for item in vars(value).values()) if hasattr(value, "__dict__") else 0


if __name__ == "__main__":
    n, ahead = sys.argv[1:]
    print(json.dumps(memory_of_engine(int(n), look_ahead=ahead == "1")))
