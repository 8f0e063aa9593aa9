"""Whether this machine can follow a sensor with a model, measured on the first second of its stream.

Lives here: `Load`, which times a session's work and says what would help. Not here: the work (`session`), and
who is told (`replay`, `live.listen`).
"""

import time
from collections.abc import Callable, Iterator

from streamfeat.engine.geometry import Geometry
from streamfeat.messages.packets import Packet
from streamfeat.stream.batch import EmissionBatch

__all__ = ["Load"]

_SKIPPED_US = 200_000
"""Stream time before anything counts: kernels are compiled, or read from numba's cache, in it."""

_MEASURED_US = 500_000
_TOO_MUCH = 0.9
_AIM = 0.7
"""Of one core: from where a sensor cannot be followed, and what a model that can should take."""


class Load:
    """Times the work on the packets of one camera, and tells once if it takes longer than the stream.

    Processor time of the thread counts, so that other programs do not. Where time stands still for longer
    than is measured, or packets are as long as that, nothing is said.

    Args:
        geometry: of the model.
        say: told, once at most, in a line.
        clock: processor seconds of the thread that works.
    """

    def __init__(
        self, geometry: Geometry, say: Callable[[str], None], clock: Callable[[], float] = time.thread_time
    ) -> None:
        """Wait for the first packet."""
        self._geometry, self._say, self._clock = geometry, say, clock
        self._first_us: int | None = None
        self._from_us = self._events = 0
        self._seconds = 0.0
        self.is_done = False

    def timed(self, work: Iterator[EmissionBatch], packet: Packet) -> Iterator[EmissionBatch]:
        """The same emissions; what they take is added up, what is done with them is not."""
        while True:
            started = self._clock()
            batch = next(work, None)
            self._seconds += self._clock() - started
            if batch is None:
                break
            yield batch
        if len(packet.events) and not self.is_done:
            self._add(packet)

    def _add(self, packet: Packet) -> None:
        now = int(packet.events["t"][-1])
        if self._first_us is None:
            self._first_us = now
        if self._from_us == 0:
            if now - self._first_us >= _SKIPPED_US:
                self._from_us, self._seconds = now, 0.0
            return
        self._events += len(packet.events)
        if (passed := now - self._from_us) >= _MEASURED_US:
            self.is_done = True
            load = self._seconds / (passed * 1e-6)
            if load > _TOO_MUCH and passed < 2 * _MEASURED_US:
                self._say(self._advice(load, packet, self._events / (passed * 1e-6)))

    def _advice(self, load: float, packet: Packet, rate: float) -> str:
        height, width = packet.resolution
        return (
            f"{width}x{height} pixels and {rate / 1e6:.2f} M events/s take {load:.1f} s of work a second "
            f"with this model: {self._remedy(load / _AIM)}, or emit less often"
        )

    def _remedy(self, factor: float) -> str:
        """The least change of the geometry that makes so many times less work: volumes count."""
        stride, downsample = self._geometry.stride, self._geometry.downsample
        if stride < 4 and (4 / stride) ** 2 >= factor:
            return "learn one with --preset fast (stride 4)"
        coarser = "--stride 4 " if stride < 4 else ""
        gained = max(1.0, (4 / stride) ** 2)
        while gained < factor and downsample < 16:
            downsample, gained = 2 * downsample, 4 * gained
        return f"learn one with {coarser}--downsample {downsample}"
