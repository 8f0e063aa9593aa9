"""One sample of a data set, whatever kind of file it is in.

Lives here: camera files and recordings (MCAP, bags) behind one face.
Not here: which files are samples, and of what (`datasets`).
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import numpy as np

from streamfeat.camera_files.event_files import open_events
from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution
from streamfeat.files.locations import Location, StoreLocation, is_folder, size_of
from streamfeat.recordings.bags import BAG_ENDINGS, bag_members
from streamfeat.recordings.reader import Packet, open_recording

__all__ = ["RECORDED", "SampleFile", "bytes_of", "is_recorded", "open_sample"]

RECORDED = (*BAG_ENDINGS, ".bag")
"""Endings of files that are recordings."""


class SampleFile(Protocol):
    """A sample, opened but not read; iterating yields `(n,)` batches of `EVENT_DTYPE` in stored order.

    Attributes:
        declared: `(height, width)` that the file says, None where it does not.
        damage: what the last iteration could not read, a line for each reason.
    """

    declared: Resolution | None
    damage: list[str]

    def __iter__(self) -> Iterator[Events]:
        """Read it from the beginning."""


class _Recorded:
    """A recording as a sample: the events of the first run of its camera's clock, inside its resolution.

    Raises:
        InputError: it cannot be read, or has several cameras.
    """

    def __init__(self, place: Location) -> None:
        self._place = place
        self.damage: list[str] = []
        with open_recording(place) as recording:
            self.declared: Resolution | None = recording.resolution

    def __iter__(self) -> Iterator[Events]:
        left_out = outside = 0
        with open_recording(self._place) as recording:
            for item in recording.items():
                if isinstance(item, Packet) and len(item.events):
                    if item.epoch:
                        left_out += len(item.events)
                        continue
                    events, (height, width) = item.events, recording.resolution
                    inside = (events["y"] < height) & (events["x"] < width)
                    outside += len(events) - int(np.count_nonzero(inside))
                    yield events[inside]
            losses = recording.losses
            self.damage = [f"{n} x {why}: {losses.first[why]}" for why, n in losses.counts.items()]
        if outside:
            self.damage.append(f"{outside} events outside {width}x{height} pixels are left out")
        if left_out:
            self.damage.append(f"its clock starts anew; the {left_out} events after that are left out")


def is_recorded(place: Location) -> bool:
    """Whether a sample is a recording: by its ending, or a bag's folder."""
    return place.name.lower().endswith(RECORDED) or is_folder(place)


def open_sample(place: Location) -> SampleFile:
    """Open a sample; a camera file must be local.

    Raises:
        InputError: it is of no known format, or cannot be read.
    """
    if is_recorded(place):
        return _Recorded(place)
    if isinstance(place, StoreLocation):
        raise InputError(f"{place}: is in a store; fetch it first")
    return open_events(place)


def bytes_of(place: Location) -> int:
    """Bytes of a sample's file, or of all files of its bag.

    Raises:
        InputError: it is in a store and cannot be opened, or a bag without files.
        OSError: it is local, and not there.
    """
    if isinstance(place, Path) and not place.is_dir():
        return size_of(place)
    return sum(map(size_of, bag_members(place)[0])) if is_folder(place) else size_of(place)
