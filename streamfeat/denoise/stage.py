"""Taking noise out of a stream: hot pixels, events within the refractory period, isolated events.

Lives here: `Denoising`, what is to be taken out; `Denoiser`, the stage between a source and an engine.
Not here: the loop over events (`kernels.denoise`), and options of commands (`cli.options`).

The stage is causal and exact: whichever way a stream is cut into packets, the same events come through. A
label, another epoch of the camera's clock and another resolution start it anew, so that a labelled sample
comes through as if it stood alone; replay, training and offline features see the same events.
"""

import re
from dataclasses import dataclass, replace
from typing import Self, TypeVar

import numpy as np

from streamfeat.errors import InputError
from streamfeat.events import TIME_LIMIT, Events, Resolution
from streamfeat.kernels.denoise import HOT, HOT_LEVEL, ISOLATED, REFRACTORY, mark_noise
from streamfeat.messages.packets import Label, Packet, Watermark

__all__ = ["Denoiser", "Denoising", "parse_duration"]

_UNITS_US = {"us": 1.0, "ms": 1e3, "s": 1e6}
_LONGEST_US = 3_600_000_000
_NAMES = {"hot pixels": HOT, "refractory": REFRACTORY, "isolated": ISOLATED}

Item = TypeVar("Item", bound=Packet | Label | Watermark)


def parse_duration(text: str, option: str) -> int:
    """Read a duration such as `500us`, `1ms` or `0.2s`, in microseconds.

    Raises:
        InputError: the text is not a time between 1 us and an hour; names the option.
    """
    found = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*(us|ms|s)", text.strip())
    us = round(float(found[1]) * _UNITS_US[found[2]]) if found else 0
    if not 0 < us <= _LONGEST_US:
        raise InputError(f"{option} {text!r} is not understood; give a duration such as 500us, 1ms or 0.2s")
    return us


@dataclass(frozen=True, slots=True)
class Denoising:
    """Kinds of noise to take out, looked at in this order; 0 leaves one kind in.

    Attributes:
        hot_rate: events a second from one pixel, above which the pixel is hot. The rate is that of a leaky
            bucket of one second: bursts of up to `hot_rate` events pass, and a pixel that goes on falls
            silent until its rate has been below for a second or two.
        refractory_us: events that follow the one before at their pixel by less.
        isolated_us: events without another of the eight pixels around within this time before.
    """

    hot_rate: float = 0.0
    refractory_us: int = 0
    isolated_us: int = 0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InputError: a value is out of range.
        """
        if self.hot_rate and not 1 <= self.hot_rate <= HOT_LEVEL:
            raise InputError(f"hot pixels of {self.hot_rate:g} events a second; give 1 to {HOT_LEVEL:,}")
        if not (0 <= self.refractory_us <= _LONGEST_US and 0 <= self.isolated_us <= _LONGEST_US):
            raise InputError("refractory period and time of support must be between 0 and an hour")

    @classmethod
    def parse(cls, hot_pixels: float | None, refractory: str | None, isolated: str | None) -> Self:
        """Read what the options of a command say.

        Raises:
            InputError: one of them is not understood.
        """
        return cls(
            hot_pixels or 0.0,
            parse_duration(refractory, "--refractory") if refractory is not None else 0,
            parse_duration(isolated, "--isolated") if isolated is not None else 0,
        )

    def __bool__(self) -> bool:
        """Whether anything is taken out."""
        return bool(self.hot_rate or self.refractory_us or self.isolated_us)

    @property
    def names(self) -> tuple[str, ...]:
        """Reasons that are switched on, as `Denoiser.removed` names them."""
        return tuple(name for name, at in _NAMES.items() if self.limits[at])

    @property
    def limits(self) -> tuple[int, int, int]:
        """Microseconds, as `kernels.denoise` takes them."""
        step = round(HOT_LEVEL / self.hot_rate) if self.hot_rate else 0
        return step, self.refractory_us, self.isolated_us


class Denoiser:
    """The stage: packets in, packets out with fewer events; everything else passes.

    Memory is 32 bytes a pixel. A packet that loses all of its events still passes, for its time and number.
    """

    def __init__(self, denoising: Denoising) -> None:
        """Start with a sensor that was silent for ever."""
        self.denoising = denoising
        self._limits = np.array(denoising.limits, np.int64)
        self._removed = np.zeros(3, np.int64)
        self._past = np.empty((3, 0, 0), np.int64)
        self._level = np.empty((0, 0), np.int64)
        self._epoch = 0

    @property
    def removed(self) -> dict[str, int]:
        """Events taken out so far for each reason that is switched on."""
        return {name: int(self._removed[_NAMES[name]]) for name in self.denoising.names}

    def restart(self) -> None:
        """Forget the past, not the counts."""
        self._past.fill(-TIME_LIMIT)
        self._level.fill(0)

    def events(self, events: Events, resolution: Resolution) -> Events:
        """The events of a batch that are no noise.

        Args:
            events: `(n,)` EVENT_DTYPE, not changed.
            resolution: `(height, width)` of the sensor; another than before starts anew.

        Returns:
            `(m,)` in the same order; the same array where all are kept.
        """
        if self._level.shape != resolution:
            self._past, self._level = np.empty((3, *resolution), np.int64), np.empty(resolution, np.int64)
            self.restart()
        keep = np.empty(len(events), np.bool_)
        mark_noise(events, self._limits, self._past, self._level, self._removed, keep)
        return events if keep.all() else events[keep]

    def process(self, item: Item) -> Item:
        """One item of a stream without its noise."""
        if isinstance(item, Label):
            self.restart()
        elif isinstance(item, Packet):
            if item.epoch != self._epoch:
                self._epoch = item.epoch
                self.restart()
            if len(item.events):
                return replace(item, events=self.events(item.events, item.resolution))
        return item
