"""Streams of ordinary cameras, for a comparison of two versions and with peers.

Lives here: samples of cameras repeated in time, the samples of N-CARS one after the other, and one camera at
any rate. Not here: what is done with them (`tree_worker`, `cameras`).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import streamfeat as sf
from streamfeat.events import Events, Resolution

__all__ = ["CAMERAS", "EMIT_US", "NCARS", "CameraStream", "Sampled", "at_rate", "sampled"]

EMIT_US = 10_000

DAVIS = "eventpacket_libcaer_cmp_346x260.mcap"


@dataclass(frozen=True)
class CameraStream:
    """A sample of a camera, and the grid that its model has.

    Attributes:
        name: as it is shown.
        sample: file in the folder of samples; none for the labelled recording.
        resolution: `(height, width)`.
        stride: ring pixels.
        downsample: of the model.
    """

    name: str
    sample: str
    resolution: Resolution
    stride: int = 4
    downsample: int = 1


NCARS = CameraStream("N-CARS", "", (100, 120), stride=2)

CAMERAS = {
    stream.name: stream
    for stream in (
        CameraStream("DAVIS", DAVIS, (260, 346)),
        CameraStream("DAVIS, stride 2", DAVIS, (260, 346), stride=2),
        CameraStream("VGA", "evt2_640x480.raw", (480, 640)),
        CameraStream("HD", "evt3_1280x720.raw", (720, 1280)),
        CameraStream("HD, downsample 4", "evt3_1280x720.raw", (720, 1280), downsample=4),
        NCARS,
    )
}
"""346x260 pixels as recorded; VGA and HD made of 50 and 9 ms again and again."""


@dataclass(frozen=True)
class Sampled:
    """Events of a stream.

    Attributes:
        events: in order of time.
        starts: `(n,)` int64, where a stream starts anew, in us: one, or one for each labelled sample.
    """

    events: Events
    starts: Any

    def save(self, path: Path) -> None:
        """To a file that `tree_worker` reads in another process."""
        np.savez(path, events=self.events, starts=self.starts)


def sampled(stream: CameraStream, samples: Path, labelled: Path, emissions: int) -> Sampled:
    """Events enough for so many emissions.

    Args:
        stream: which.
        samples: folder of camera samples.
        labelled: recording of N-CARS.
        emissions: every 10 ms.
    """
    if not stream.sample:
        return _samples(labelled, emissions)
    with sf.open_recording(samples / stream.sample) as recording:
        events = np.concatenate(list(recording))
    height, width = stream.resolution
    events = events[(events["x"] < width) & (events["y"] < height)]
    events["t"] -= events["t"].min()
    return Sampled(_repeated(events, emissions * EMIT_US), np.zeros(1, np.int64))


def at_rate(samples: Path, rate: float, emissions: int) -> Sampled:
    """The 346x260 camera as if so many events a second came.

    Fewer events are every n-th; more are copies of the stream at other moments.
    """
    base = sampled(CAMERAS["DAVIS"], samples, Path(), emissions)
    own = len(base.events) / (emissions * EMIT_US / 1e6)
    span, rng = emissions * EMIT_US, np.random.default_rng(0)
    parts, wanted = [], int(rate * span / 1e6)
    for i in range(int(np.ceil(rate / own))):
        part = base.events.copy()
        part["t"] = (part["t"] + i * span // 7 + i) % span
        parts.append(part)
    events = np.concatenate(parts)
    events = events[np.sort(rng.permutation(len(events))[:wanted])]
    return Sampled(np.sort(events, order="t", kind="stable"), base.starts)


def _repeated(events: Events, wanted: int) -> Events:
    span = int(events["t"].max()) + 1
    rounds = []
    for i in range(-(-wanted // span)):
        again = events.copy()
        again["t"] += i * span
        rounds.append(again)
    together = np.concatenate(rounds)
    return together[together["t"] < wanted]


def _samples(path: Path, emissions: int) -> Sampled:
    """Labelled samples one after the other, whole emissions long, each with a window of its own."""
    parts, starts, start = [], [], 0
    with sf.open_recording(path) as recording:
        for sample in recording.samples():
            events = np.sort(sample.events, order="t", kind="stable")
            events["t"] += start - sample.label.start_us
            parts.append(events)
            starts.append(start)
            start += -(-sample.label.duration_us // EMIT_US) * EMIT_US
            if start >= emissions * EMIT_US:
                break
    return Sampled(np.concatenate(parts), np.array(starts, np.int64))
