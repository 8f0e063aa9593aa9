"""Some of a recording: a stretch of its time, a part of its sensor.

Lives here: `Selection`, and what of a stream it leaves. Not here: reading and writing.
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution
from streamfeat.messages.packets import Label, Packet

__all__ = ["Selection"]

_BEHIND_US = 10_000_000
"""Events this far behind the end tell that no others will come."""


@dataclass(slots=True)
class Selection:
    """A selection of a recording: a stretch of time and a rectangle of pixels.

    Attributes:
        start_us: after the first event.
        end_us: after the first event, and not taken itself; None for all that follow.
        crop: `(x, y, width, height)` in pixels; the corner becomes pixel 0, 0. None for all of the sensor.
        labels_left_out: labels seen so far that do not lie wholly within.
    """

    start_us: int = 0
    end_us: int | None = None
    crop: tuple[int, int, int, int] | None = None
    labels_left_out: int = 0

    @classmethod
    def parse(cls, start: float | None, end: float | None, crop: str | None) -> Self:
        """Read the options of a command: seconds after the first event, and `x,y,w,h`.

        Raises:
            InputError: one of them makes no sense.
        """
        for name, seconds in (("--start", start), ("--end", end)):
            if seconds is not None and not 0 <= seconds < 1e9:
                raise InputError(f"{name} {seconds:g} is not possible; give seconds after the first event")
        if end is not None and end <= (start or 0.0):
            raise InputError(f"--end {end:g} is not behind --start {start or 0:g}; nothing lies between them")
        corners = None
        if crop is not None:
            found = re.fullmatch(r"(\d{1,5}),(\d{1,5}),(\d{1,5}),(\d{1,5})", crop.replace(" ", ""))
            if not found or not (int(found[3]) and int(found[4])):
                raise InputError(f"--crop {crop!r} is not understood; give x,y,width,height in pixels")
            corners = int(found[1]), int(found[2]), int(found[3]), int(found[4])
        end_us = None if end is None else round(end * 1e6)
        return cls(round((start or 0.0) * 1e6), end_us, corners)

    def __bool__(self) -> bool:
        """Whether anything may be left out."""
        return bool(self.start_us or self.end_us is not None or self.crop)

    def items(self, items: Iterable[Packet | Label]) -> Iterator[Packet | Label]:
        """The selected items of a stream; packets without events are left out.

        Raises:
            InputError: the crop does not fit into the sensor.
        """
        waiting: list[Label] = []  # until the first event tells where time begins
        first_us: int | None = None
        for item in items:
            if isinstance(item, Label):
                waiting.append(item)
            elif len(item.events):
                first_us = int(item.events["t"][0]) if first_us is None else first_us
                for label in waiting:
                    if self._holds(label, first_us):
                        yield label
                    else:
                        self.labels_left_out += 1
                waiting.clear()
                events, resolution = self._cropped(item.events, item.resolution)
                t = item.events["t"]
                if self.end_us is not None and int(t.min()) > first_us + self.end_us + _BEHIND_US:
                    return
                events = events[self._within(events, first_us)]
                if len(events):
                    yield replace(item, events=events, resolution=resolution)

    def _holds(self, label: Label, first_us: int) -> bool:
        end_us = label.start_us + label.duration_us
        is_early = self.start_us and label.start_us < first_us + self.start_us
        return not (is_early or (self.end_us is not None and end_us > first_us + self.end_us))

    def _within(self, events: Events, first_us: int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        t = events["t"]
        taken = np.ones(len(t), np.bool_) if not self.start_us else t >= first_us + self.start_us
        if self.end_us is not None:
            taken &= t < first_us + self.end_us
        return taken

    def _cropped(self, events: Events, resolution: Resolution) -> tuple[Events, Resolution]:
        if self.crop is None:
            return events, resolution
        x, y, width, height = self.crop
        if x + width > resolution[1] or y + height > resolution[0]:
            raise InputError(
                f"--crop {x},{y},{width},{height} reaches beyond a sensor of {resolution[1]}x{resolution[0]}"
            )
        inside = (events["x"] >= x) & (events["x"] < x + width)
        inside &= (events["y"] >= y) & (events["y"] < y + height)
        events = events[inside]
        events["x"] -= np.uint16(x)
        events["y"] -= np.uint16(y)
        return events, (height, width)
