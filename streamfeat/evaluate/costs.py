"""What an update of one event costs with a learned encoder.

Lives here: a short measurement beside the accuracy of each setting of a sweep.
Not here: distributions, and other ways to read an engine (`streamfeat.latency`, which is built on this room).
"""

import math
import time
from collections.abc import Iterable

import numpy as np

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.recordings.reader import Sample

__all__ = ["update_us"]

_MOST_SAMPLES = 4
_RUN = 25
"""Events between two looks at the clock: a call from Python is spread over them."""
_WARM_UP = 200
_MOST_SECONDS = 2.0


def update_us(
    encoder: Encoder, samples: Iterable[Sample], most_seconds: float = _MOST_SECONDS
) -> float | None:
    """Microseconds in which an engine follows one event, with features current after it.

    The median over runs of 25 events in the first four samples, so that beginnings of bins do not count; the
    beginning of the first sample warms up and is not counted.

    Args:
        encoder: the learned encoder.
        samples: to take events from, in stream order.
        most_seconds: of the clock; the measurement ends early with what it has.

    Returns:
        the median, None where there are too few events.
    """
    took: list[float] = []
    deadline = math.inf
    for i, sample in zip(range(_MOST_SAMPLES), samples, strict=False):
        engine = Engine(encoder, sample.resolution, origin_us=sample.label.start_us)
        events = sample.events if i else sample.events[:_WARM_UP]
        for start in range(0, len(events) - _RUN + 1, _RUN):
            part = events[start : start + _RUN].copy()
            begun = time.perf_counter()
            if begun > deadline:
                break
            engine.follow(part)
            if i:
                took.append((time.perf_counter() - begun) / _RUN)
        if not i:
            deadline = time.perf_counter() + most_seconds  # what was compiled just now does not count
    return float(np.median(took)) * 1e6 if took else None
