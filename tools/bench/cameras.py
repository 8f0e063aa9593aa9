"""Emissions of ordinary cameras, against what one would otherwise write for them.

Lives here: the part `cameras`: an emission every 10 ms on 346x260 and 640x480, beside a convolution of the
same filters over frames in PyTorch, and FEAST of eventcv on the same events.
Not here: crops and single events (`direct`), an earlier version (`goals`).

PyTorch gets its frames ready made: clipped counts of the window, float32; a program would have to make them
too. Its features are compared with ours: the filters are the quantised ones, so they agree to rounding.
FEAST gets a piece of the events of an emission, and its time is taken in proportion.
"""

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import streamfeat as sf
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.engine.window import count_window
from streamfeat.events import Events
from tools.bench.camera_streams import CAMERAS, EMIT_US, CameraStream, sampled
from tools.bench.direct import with_encoding
from tools.bench.material import Setting
from tools.bench.timing import PROCESS, WALL, Contestant, race

__all__ = ["measure_cameras"]

SLICES, FILTERS, FEAST_EVENTS = 10, 400, 1000
"""Emissions of a run, filters, and events that FEAST is given in one."""


def measure_cameras(setting: Setting, samples: Path | None) -> dict[str, Any]:
    """Nanoseconds of an emission, for each camera."""
    names = ("DAVIS", "VGA")
    if samples is None or not all((samples / CAMERAS[name].sample).exists() for name in names):
        return {"missing": ["the folder of camera samples"]}
    return {name: _measure(setting, samples, CAMERAS[name]) for name in names[: 1 if setting.quick else 2]}


def _measure(setting: Setting, samples: Path, stream: CameraStream) -> dict[str, Any]:
    geometry = sf.Geometry(stride=stream.stride)
    encoder = with_encoding(random_encoder(0, geometry, FILTERS, threshold=1.0), geometry, "split")
    events = sampled(stream, samples, Path(), 3 * SLICES).events
    parts = np.split(events, np.searchsorted(events["t"], np.arange(1, 3 * SLICES) * EMIT_US))
    before, parts = parts[:-SLICES], parts[-SLICES:]
    contestants = {
        f"ours, {threads} thread{'s' * (threads > 1)}": _ours(encoder, stream, before, parts, threads)
        for threads in (1, 2)
    }
    missing, difference = [], None
    if importlib.util.find_spec("torch"):
        more, difference = _convolution(encoder, stream, before, parts)
        contestants |= more
    else:
        missing.append("torch")
    if importlib.util.find_spec("eventcv"):
        contestants["FEAST of eventcv, 256 features"] = _feast(stream, before, parts[0])
    else:
        missing.append("eventcv")
    setting.say(f"{stream.name}: {len(contestants)} contestants")
    result = race(contestants, setting.rounds(7))
    ours = "ours, 1 thread"
    return {
        "resolution": list(stream.resolution),
        "events_per_emission": round(float(np.mean([len(part) for part in parts]))),
        "race": result.figures(),
        "over_ours": {name: result.ratio(name, ours) for name in contestants if name != ours},
        "largest_difference": difference,
        "missing": missing,
    }


def _ours(
    encoder: sf.Encoder, stream: CameraStream, before: list[Events], parts: list[Events], threads: int
) -> Contestant:
    engine, parts = sf.Engine(encoder, stream.resolution, threads=threads), [part.copy() for part in parts]
    for part in before:
        engine.feed(part)

    def run() -> None:
        for part in parts:
            engine.feed(part)
            engine.features()

    def go_on() -> None:
        for part in parts:
            part["t"] += SLICES * EMIT_US

    return Contestant(run, SLICES, go_on, WALL if threads > 1 else PROCESS)


def _convolution(
    encoder: sf.Encoder, stream: CameraStream, before: list[Events], parts: list[Events]
) -> tuple[dict[str, Contestant], float]:
    """Contestants of one thread and of all, and how far their features are from ours, relative."""
    import torch

    window = np.concatenate(before[-20:])
    frames = []
    for part in parts:
        window = np.concatenate([window, part])
        frames.append(_frame(encoder.geometry, stream, window, int(part["t"][-1])))
    network = convolution(encoder)
    engine = sf.Engine(encoder, stream.resolution)
    for part in (*before, parts[0]):
        engine.feed(part)
    mine, theirs = engine.features(), network(torch.from_numpy(frames[0])).numpy()
    tensors = [torch.from_numpy(frame) for frame in frames]

    def run(threads: int) -> Callable[[], None]:
        def go() -> None:
            torch.set_num_threads(threads)
            for tensor in tensors:
                network(tensor)

        return go

    cores = os.cpu_count() or 1
    found = {
        "conv2d of PyTorch, one thread": Contestant(run(1), SLICES, clock=PROCESS),
        "conv2d of PyTorch, all threads": Contestant(run(cores), SLICES, clock=WALL),
    }
    return found, float(f"{np.abs(mine - theirs).max() / np.abs(mine).max():.2g}")


def _frame(geometry: sf.Geometry, stream: CameraStream, events: Events, t_us: int) -> NDArray[np.float32]:
    counts = count_window(geometry, events, stream.resolution, 0, t_us)
    return counts.astype(np.float32)[None]


def convolution(encoder: sf.Encoder) -> Callable[[Any], Any]:
    """Features of counts `(1, T, H, W)` float32 by convolutions: the same filters, threshold and pooling."""
    import torch
    from torch.nn import functional

    geometry, operator, k = encoder.geometry, encoder.operator, encoder.n_filters
    shape = (k, geometry.n_bins, geometry.patch, geometry.patch)
    filters = operator.columns[:, :k].T.astype(np.float32) * np.float32(operator.scale)
    weights = torch.from_numpy(np.ascontiguousarray(filters.reshape(shape)))
    ones, d = torch.ones((1, *shape[1:])), geometry.entries
    offset = torch.from_numpy(operator.offset[:k].copy())[None, :, None, None]
    threshold, stride = float(operator.threshold), geometry.stride

    def features(counts: Any) -> Any:
        with torch.inference_mode():
            mean = functional.conv2d(counts, ones, stride=stride) / d
            squares = functional.conv2d(counts * counts, ones, stride=stride)
            sigma = torch.sqrt(squares / d - mean * mean + operator.eps)
            z = functional.conv2d(counts, weights, stride=stride) / sigma - offset
            code = functional.softshrink(z, threshold) * (squares > 0)
            halves = torch.cat([code.clamp(min=0), (-code).clamp(min=0)], 1)[0]
            rows, columns = (-(-side // 2) for side in code.shape[2:])
            cells = [
                halves[:, down, across].sum((1, 2))
                for down in (slice(None, rows), slice(rows, None))
                for across in (slice(None, columns), slice(columns, None))
            ]
            return torch.cat(cells)

    return features


def _feast(stream: CameraStream, before: list[Events], part: Events) -> Contestant:
    import eventcv

    def table(events: Events) -> Any:
        rows = np.stack([events["x"], events["y"], events["t"], events["p"]], axis=1).astype(np.int64)
        height, width = stream.resolution
        return eventcv.from_numpy(rows, sensor_size=(width, height), time_unit="us")

    model = eventcv.FEAST(n_features=256, patch=11, tau_ms=20.0)
    model.fit(table(before[-1][:FEAST_EVENTS]))
    few = part[:FEAST_EVENTS]
    given = table(few)
    return Contestant(lambda: model.transform(given), len(few) / len(part), clock=PROCESS)
