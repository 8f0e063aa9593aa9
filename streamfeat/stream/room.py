"""The memory that the engines of all cameras may hold together.

Lives here: `Room`, its limit, and the option that changes it. Not here: how many cameras there may be
(`cameras`), and what a file may unpack to (`files.budget`).

A system promises memory before it has it: an engine can be made that does not fit, and the process is ended
when its pages are used. So engines are weighed as they are made, and one that is too much is refused.
"""

import os
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.events import Resolution
from streamfeat.files.budget import parse_bytes

__all__ = ["MEMORY", "Room", "engine_bytes", "usable_bytes"]

MEMORY = "STREAMFEAT_MEMORY"
"""Environment variable with the limit, such as `4G`; `streamfeat --memory 4G COMMAND` sets it."""

_SHARE = 2
_SIZES_KNOWN = 64
_GROUP_LIMITS = "/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"


def usable_bytes() -> int:
    """Half of the memory that this process may have at all: of the machine, or of its container."""
    if given := os.environ.get(MEMORY, ""):
        return parse_bytes(given, "--memory")
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for path in _GROUP_LIMITS:
        try:
            limits.append(int(Path(path).read_text()))
        except (OSError, ValueError):  # no such group, or one without a limit
            continue
    return min(limits) // _SHARE


class Room:
    """Weighs engines as they are made; those that are gone weigh nothing.

    Args:
        most_bytes: of all engines that live at a time; that of `usable_bytes` if not given.
    """

    def __init__(self, most_bytes: int | None = None) -> None:
        """No engine is there yet."""
        self._most = usable_bytes() if most_bytes is None else most_bytes
        self._held: weakref.WeakKeyDictionary[Engine, str] = weakref.WeakKeyDictionary()
        self._too_large: dict[Resolution, int] = {}

    @property
    def held_bytes(self) -> int:
        """Of all engines."""
        return sum(engine_bytes(engine) for engine in list(self._held))

    def maker(self, topic: str, make: Callable[..., Engine]) -> Callable[..., Engine]:
        """A function that makes an engine of a camera as `make` does, if there is room for it.

        The engine that it replaces, of the same camera, is not counted.
        """

        def weighed(encoder: Encoder, resolution: Resolution, **options: Any) -> Engine:
            # Where one of this size was too much none is made: a packet may ask a hundred times a second.
            self._refuse(topic, self._too_large.get(resolution, 0))
            engine = make(encoder, resolution, **options)
            try:
                self._refuse(topic, engine_bytes(engine))
            except MemoryError:
                if len(self._too_large) >= _SIZES_KNOWN:
                    self._too_large.clear()
                self._too_large[resolution] = engine_bytes(engine)
                raise
            self._held[engine] = topic
            return engine

        return weighed

    def _refuse(self, topic: str, mine: int) -> None:
        others = sum(engine_bytes(one) for one, of in list(self._held.items()) if of != topic)
        if others + mine > self._most:
            raise MemoryError(
                f"its engine of {_mega(mine)} and the {_mega(others)} of others are more than the "
                f"{_mega(self._most)} that they may have; `streamfeat --memory BYTES COMMAND` allows more, a "
                "model with a larger stride or downsample needs less"
            )


def engine_bytes(engine: Engine) -> int:
    """Bytes of an engine's arrays, those of all scales; a system gives it their pages as they are used."""
    mine = sum(array.nbytes for array in engine._state)
    return mine + sum(engine_bytes(scale) for _, scale in engine._further)


def _mega(n_bytes: int) -> str:
    return f"{n_bytes / 1e6:,.0f} MB"
