"""Where events come from while something else breaks: recordings, folders of files, a camera.

Lives here: making them, small and from a seed.
"""

import struct
import threading
from pathlib import Path

import numpy as np
import zenoh

from streamfeat.events import make_events
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.codecs import encode
from streamfeat.messages.packets import Label
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.simulate.saccades import Saccades, digit_samples

__all__ = ["EVENTS_A_FILE", "MODEL", "ROOT", "TRAIN", "Camera", "digits", "folder_of_samples"]

ROOT = Path(__file__).resolve().parents[2]
TRAIN = ROOT / "recordings" / "digits_train.mcap"
MODEL = ROOT / "recordings" / "digits.safetensors"

EVENTS_A_FILE = 3000


def digits(path: Path, n: int) -> Path:
    """Simulated digits as a labelled recording; every third is held out."""
    with RecordingWriter(path) as writer:
        for i, sample in enumerate(digit_samples(n, 0, "train", saccades=Saccades(saccade_us=33_000))):
            start = 200_000 + 300_000 * i
            writer.write_label(Label(start, 100_000, sample.label, "test" if i % 3 == 0 else "train"))
            moved = sample.events.copy()
            moved["t"] += start
            writer.write_events(moved, (34, 34))
    return path


def folder_of_samples(folder: Path, n: int, seed: int) -> Path:
    """A data set of `n` files, `SPLIT/LABEL/FILE`."""
    rng, most = np.random.default_rng(seed), EVENTS_A_FILE
    for i in range(n):
        inner = folder / ("Train" if i % 4 else "Test") / str(i % 10)
        inner.mkdir(parents=True, exist_ok=True)
        x, y, p = (rng.integers(0, side, most) for side in (34, 34, 2))
        np.savez(inner / f"{i}.npz", x=x, y=y, p=p, t=np.sort(rng.integers(0, 100_000, most)))
    return folder


class Camera:
    """Puts a packet every 10 ms; a context manager."""

    EVENTS, STEP_US = 200, 10_000

    def __init__(self, session: zenoh.Session) -> None:
        self._publisher = session.declare_publisher(
            "cam/events", congestion_control=zenoh.CongestionControl.BLOCK
        )
        self.n_put = 0
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._put)

    @property
    def is_heard(self) -> bool:
        return bool(self._publisher.matching_status.matching)

    def __enter__(self) -> "Camera":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ends.set()
        self._thread.join()

    def events(self, i: int):
        rng = np.random.default_rng(i)
        n = self.EVENTS
        t = np.sort(rng.integers(i * self.STEP_US, (i + 1) * self.STEP_US, n))
        return make_events(rng.integers(0, 64, n), rng.integers(0, 48, n), rng.integers(0, 2, n), t)

    def _put(self) -> None:
        while not self._ends.wait(self.STEP_US / 1e6):
            if not self.is_heard:
                continue
            payload, base_ns = encode(self.events(self.n_put), "mono")
            packet = EventPacket(0, "", 48, 64, self.n_put, base_ns, "mono", False, payload)
            attached = struct.pack("<qqB16s", self.n_put + 1, 0, 16, b"torture's camera")
            self._publisher.put(packet.to_cdr(), attachment=attached)
            self.n_put += 1
