"""A geometry that a machine can follow, for the sensor that recordings are of.

Lives here: the rate of a recording's first second, what a reading costs, the finest grid that keeps pace.
Not here: the geometry itself (`engine.geometry`), whether a stream keeps pace (`stream.load`).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from streamfeat.engine.geometry import Geometry
from streamfeat.learn.settings import Setting
from streamfeat.messages.packets import Packet
from streamfeat.recordings.reader import Recording

__all__ = ["followed", "load_of", "suited_to"]

_SECONDS_A_FILTER = 1.2e-9
"""For each filter of a volume that has changed. Measured on a 346x260 recording, K = 400, each 10 ms: 1.3 ns
with 5,300 volumes (stride 4), 1.1 ns with 21,000 (stride 2), one thread."""

_FILTERS = Setting().filters
"""More filters than the default are a choice, which does not make the grid coarser."""

_EVERY_S = 0.01
"""Between two emissions: what a live display or a controller wants."""

_MOST_LOAD = 0.7
"""Of one core."""

_GRIDS = ((2, 1), (4, 1), (4, 2), (4, 4), (4, 8))
"""Stride and downsample, from the finest; the first is what `Setting` has by default."""

_FIRST_US = 1_000_000
_FIRST_EVENTS = 5_000_000


def suited_to(recordings: Sequence[Recording], setting: Setting) -> Setting:
    """The setting with the finest grid that keeps pace with the sensor on one core, emitting every 10 ms.

    Args:
        recordings: open recordings, whose first second is read.
        setting: whose patch and filters count; its stride and downsample are replaced.
    """
    sensors = [followed(recording) for recording in recordings]
    for stride, downsample in _GRIDS:
        tried = replace(setting, stride=stride, downsample=downsample)
        if max(sum(load_of(one, *sensor) for one in tried.each) for sensor in sensors) <= _MOST_LOAD:
            return tried
    return tried


def load_of(setting: Setting, resolution: tuple[int, int], rate: float) -> float:
    """Processor seconds that a second of a stream takes, estimated: filters times volumes that change.

    Args:
        setting: patch, stride, downsample and filters.
        resolution: `(height, width)` of the sensor.
        rate: events a second.
    """
    sides = setting.sides(resolution)
    geometry = Geometry(patch=sides, stride=setting.stride, downsample=setting.downsample)
    rows, columns = geometry.grid_shape(resolution)
    covering = math.prod(max(1.0, side / setting.stride) for side in sides)
    changed = min(rows * columns, rate * _EVERY_S * covering)
    return min(setting.filters, _FILTERS) * changed * _SECONDS_A_FILTER / _EVERY_S


def followed(recording: Recording) -> tuple[tuple[int, int], float]:
    """The largest resolution in the first second of a recording's stream, and its events a second."""
    first: int | None = None
    last = n_events = 0
    resolution = (0, 0)
    for item in recording.items():
        if not isinstance(item, Packet) or not len(item.events):
            continue
        if first is None:
            first = int(item.events["t"][0])
        last = int(item.events["t"][-1])
        n_events += len(item.events)
        resolution = max(resolution, item.resolution, key=lambda size: size[0] * size[1])
        if not 0 <= last - first < _FIRST_US or n_events > _FIRST_EVENTS:
            break
    seconds = max(last - (first or 0), 10_000) * 1e-6
    return resolution, n_events / seconds
