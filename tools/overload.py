"""Ten times what `--emit event` can carry: what does `--emit auto` do?

Measures how many events a second this machine takes in with a reading after each, then plays the same
samples, the silence between them cut out, at ten times that rate under `auto`; says what was dropped, how
deep the queues were, how far behind the end was, and compares readings with the offline encoder, bit for bit.

    python tools/overload.py recordings/digits_test.mcap -m recordings/digits.safetensors
"""

import argparse
import asyncio
import json
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import streamfeat as sf
from streamfeat.latency.end_to_end import without_silence
from streamfeat.messages.packets import Label, Packet
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.session import Session

TIMES = 10
COMPARED = 200


class Kept:
    """A sink that keeps the last reading of each group it is given."""

    def __init__(self) -> None:
        self.emissions: list[Emission] = []

    def write(self, emissions: Sequence[Emission]) -> None:
        self.emissions.append(emissions[-1])

    def close(self, *, failed: bool) -> None:
        """Nothing is held open."""


def run(encoder, items, emit, speed=None):
    """Seconds, session, kept emissions and the deepest that each queue was."""
    session = Session(encoder, EmitPolicy.parse(emit), clock=time.perf_counter)
    sink, deepest = Kept(), [0, 0]

    def look(_):
        stats = pipeline.stats()
        deepest[:] = max(deepest[0], stats.queued_in), max(deepest[1], stats.queued_out)

    pipeline = Pipeline(iter(items), session, [sink], speed=speed, on_progress=look)
    begun = time.perf_counter()
    asyncio.run(pipeline.run())
    return time.perf_counter() - begun, session, sink.emissions, deepest


def exact(encoder, items, emissions):
    """How many of some emissions have the bits of the offline encoder, of how many.

    By the number of events, for one packet may end and the next begin within a microsecond.
    """
    packets = [item for item in items if isinstance(item, Packet)]
    events = np.concatenate([packet.events for packet in packets])
    picked = emissions[:: max(1, len(emissions) // COMPARED)]
    same = 0
    for emission in picked:
        start = emission.sample.start_us
        own = events[np.searchsorted(events["t"], start) : emission.n_events]
        resolution = next(p.resolution for p in packets if p.events["t"][-1] >= start)
        offline = encoder.encode(own, resolution, origin_us=start, t_us=emission.t_us - 1)
        same += np.array_equal(offline, emission.features)
    return same, len(picked)


def first_samples(recording, window_us, samples):
    """Items of the first labelled samples of a recording, without the silence between them."""
    for item in without_silence(recording.items(), window_us):
        samples -= isinstance(item, Label)
        if samples < 0:
            return
        yield item


def main():
    """Both runs, and what they show, as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("-m", "--model", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=100, help="labelled samples to play")
    options = parser.parse_args()
    encoder = sf.Encoder.load(options.model)
    with sf.open_recording(options.recording) as recording:
        items = list(first_samples(recording, encoder.geometry.window_us, options.samples))
    times = [item.start_us if isinstance(item, Label) else int(item.events["t"][-1]) for item in items]
    events = sum(len(item.events) for item in items if isinstance(item, Packet))
    run(encoder, items[:4], "event")  # compiles
    seconds, *_ = run(encoder, items, "event")
    carried = events / seconds
    recorded_s = (max(times) - min(times)) / 1e6
    speed = TIMES * carried * recorded_s / events
    seconds, session, emissions, deepest = run(encoder, items, "auto", speed)
    same, compared = exact(encoder, items, [e for e in emissions if e.sample])
    stats = session.stats()
    print(
        json.dumps(
            {
                "events": events,
                "event_carries_per_s": round(carried),
                "offered_per_s": round(TIMES * carried),
                "accepted": stats.events,
                "late": stats.late,
                "rejected": stats.rejected,
                "readings": stats.emissions,
                "deepest_queues": deepest,
                "seconds": round(seconds, 3),
                "seconds_offered": round(recorded_s / speed, 3),
                "readings_with_the_bits_of_the_offline_encoder": f"{same} of {compared}",
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
