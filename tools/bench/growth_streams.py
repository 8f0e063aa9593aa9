"""Loads of an engine, and the streams of events that they are measured on.

Lives here: loads, and putting recorded samples down on a sensor until there are as many events as asked.
Not here: timing (`growth`).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

import streamfeat as sf
from streamfeat.events import Events, Resolution
from tools.bench.direct import with_encoding
from tools.bench.material import Material
from tools.bench.scaling import flat_encoder

__all__ = ["SLICE_US", "Load", "Stream", "sweeps"]

SLICE_US = 10_000


@dataclass(frozen=True)
class Load:
    """What is varied; the defaults are the preset `fast` on a small sensor.

    Attributes:
        emit: `event`, or `10ms`.
        filters: K.
        stride: pixels.
        resolution: `(height, width)`.
        cameras: in one process, each with an engine, taking turns.
        rate: events a second of each camera.
        bin_us: whole slices.
    """

    emit: str
    filters: int = 400
    stride: int = 4
    resolution: Resolution = (120, 160)
    cameras: int = 1
    rate: int = 200_000
    bin_us: int = 30_000

    @property
    def name(self) -> str:
        height, width = self.resolution
        return (
            f"{self.emit}, K {self.filters}, stride {self.stride}, {width}x{height}, "
            f"{self.cameras} cameras, {self.rate / 1e6:g} Mev/s"
        )

    @property
    def geometry(self) -> sf.Geometry:
        return sf.Geometry(patch=12, stride=self.stride, n_bins=3, bin_us=self.bin_us, max_count=1)

    def encoder(self) -> sf.Encoder:
        encoder = flat_encoder(self.geometry, self.filters)
        return with_encoding(encoder, self.geometry, "split")


def sweeps(quick: bool) -> list[Load]:
    """All loads: one quantity at a time moves away from the base."""
    found = []
    for emit in ("event", "10ms"):
        base = Load(emit)
        found += [replace(base, filters=k) for k in (100, 200, 400, 800, 1600)]
        found += [replace(base, stride=stride) for stride in (2, 6, 12)]
        found += [replace(base, resolution=r) for r in ((60, 80), (240, 320), (480, 640))]
        found += [replace(base, rate=rate) for rate in (50_000, 800_000)]
        found += [replace(base, cameras=n) for n in (2, 4, 8)]
    return [Load(emit) for emit in ("event", "10ms")] if quick else found


class Stream:
    """A piece of an endless stream; `go_on` moves it on in time, so that it can be fed again and again.

    Args:
        material: samples.
        load: sensor and rate.
        events: how many, about; the piece is whole bins long, a window at least.
    """

    def __init__(self, material: Material, load: Load, events: int) -> None:
        rng = np.random.default_rng(0)
        rate, resolution, bin_us = load.rate, load.resolution, load.bin_us
        self.period_us = max(load.geometry.n_bins, round(events / rate * 1e6 / bin_us)) * bin_us
        wanted, parts, n = int(rate * self.period_us / 1e6), [], 0
        while n < wanted:
            sample = material.samples[rng.integers(len(material.samples))]
            part = sample.events.copy()
            # Beyond the sensor on all sides, so that no pixel has more than others.
            for name, side, own in zip("yx", resolution, sample.resolution, strict=True):
                place = part[name].astype(np.int64) + rng.integers(1 - own, side)
                part = part[(place >= 0) & (place < side)]
                part[name] = place[(place >= 0) & (place < side)]
            start = rng.integers(self.period_us) - sample.label.start_us
            part["t"] = (part["t"] + start) % self.period_us
            parts.append(part[: wanted - n])
            n += len(parts[-1])
        self.events: Events = np.concatenate(parts)
        self.events.sort(order="t", kind="stable")
        self.resolution = resolution

    @cached_property
    def slices(self) -> list[Events]:
        """Views of 10 ms each."""
        edges = np.arange(SLICE_US, self.period_us, SLICE_US)
        return np.split(self.events, np.searchsorted(self.events["t"] % self.period_us, edges))

    def go_on(self) -> None:
        """Move on in time by one period."""
        self.events["t"] += self.period_us
