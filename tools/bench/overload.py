"""Ten times what `--emit event` can carry: what does `--emit auto` do?

Lives here: the part `overload`. How many events a second this machine takes in with an emission after each;
then the same samples, without the silence between them, at ten times that rate under `auto`: what was
dropped, how deep the queues were, how far behind the end was, and whether emissions have the bits of the
offline encoder.
Not here: what a single event costs.
"""

import asyncio
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

import streamfeat as sf
from streamfeat.latency.end_to_end import without_silence
from streamfeat.messages.packets import Label, Packet
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.session import Session
from tools.bench.material import Setting, encoder_of

__all__ = ["measure_overload"]

_TIMES = 10
_COMPARED = 200


def measure_overload(setting: Setting) -> dict[str, Any]:
    """Both runs, K = 400 and stride 4."""
    geometry = sf.Geometry(patch=12, stride=4, n_bins=3, bin_us=setting.material.bin_us(3))
    encoder = encoder_of(setting, geometry, 40 if setting.quick else 400, "direct", "split")
    with sf.open_recording(setting.material.path) as recording:
        items = list(_first_samples(recording, geometry.window_us, 3 if setting.quick else 100))
    times = [item.start_us if isinstance(item, Label) else int(item.events["t"][-1]) for item in items]
    events = sum(len(item.events) for item in items if isinstance(item, Packet))
    _run(encoder, items[:4], "event")  # compiles
    seconds, *_ = _run(encoder, items, "event")
    carried = events / seconds
    recorded_s = (max(times) - min(times)) / 1e6
    speed = _TIMES * carried * recorded_s / events
    seconds, session, emissions, deepest = _run(encoder, items, "auto", speed)
    same, compared = _exact(encoder, items, [e for e in emissions if e.sample])
    stats = session.stats()
    return {
        "events": events,
        "event_carries_per_s": round(carried),
        "offered_per_s": round(_TIMES * carried),
        "accepted": stats.events,
        "late": stats.late,
        "rejected": stats.rejected,
        "emissions": stats.emissions,
        "deepest_queues": deepest,
        "seconds": round(seconds, 3),
        "seconds_offered": round(recorded_s / speed, 3),
        "compared": compared,
        "with_the_bits_of_the_offline_encoder": same,
    }


class _Kept:
    """A sink that keeps the last emission of each group it is given."""

    def __init__(self) -> None:
        self.emissions: list[Emission] = []

    def write(self, emissions: Sequence[Emission]) -> None:
        self.emissions.append(emissions[-1])

    def close(self, *, failed: bool) -> None:
        """Nothing is held open."""


def _run(
    encoder: sf.Encoder, items: list[Label | Packet], emit: str, speed: float | None = None
) -> tuple[float, Session, list[Emission], list[int]]:
    """Seconds, session, kept emissions and the deepest that each queue was."""
    session = Session(encoder, EmitPolicy.parse(emit), clock=time.perf_counter)
    sink, deepest = _Kept(), [0, 0]

    def look(_: object) -> None:
        stats = pipeline.stats()
        deepest[:] = max(deepest[0], stats.queued_in), max(deepest[1], stats.queued_out)

    pipeline = Pipeline(iter(items), session, [sink], speed=speed, on_progress=look)
    begun = time.perf_counter()
    asyncio.run(pipeline.run())
    return time.perf_counter() - begun, session, sink.emissions, deepest


def _exact(encoder: sf.Encoder, items: list[Label | Packet], emissions: list[Emission]) -> tuple[int, int]:
    """How many of some emissions have the bits of the offline encoder, of how many.

    By the number of events, for one packet may end and the next begin within a microsecond.
    """
    packets = [item for item in items if isinstance(item, Packet)]
    events = np.concatenate([packet.events for packet in packets])
    picked = emissions[:: max(1, len(emissions) // _COMPARED)]
    same = 0
    for emission in picked:
        start = emission.sample.start_us
        own = events[np.searchsorted(events["t"], start) : emission.n_events]
        resolution = next(p.resolution for p in packets if p.events["t"][-1] >= start)
        offline = encoder.encode(own, resolution, origin_us=start, t_us=emission.t_us - 1)
        same += np.array_equal(offline, emission.features)
    return same, len(picked)


def _first_samples(recording: Any, window_us: int, samples: int) -> Iterator[Label | Packet]:
    """Items of the first labelled samples of a recording, without the silence between them."""
    for item in without_silence(recording.items(), window_us):
        samples -= isinstance(item, Label)
        if samples < 0:
            return
        yield item
