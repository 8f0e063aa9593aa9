"""What the network can send without end: copies of packets, and cameras that come and go.

Lives here: feeding an intake and its cameras far more of these than any run would meet; counts and memory.
Not here: the network itself (`kills`, `state`), and what one bad item does (`tests/test_live_bounds.py`).
"""

import time
from collections.abc import Callable, Iterator

import numpy as np

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.geometry import Geometry
from streamfeat.events import make_events
from streamfeat.live.inbox import Announcement, Inbox, RawMessage
from streamfeat.live.intake import Intake
from streamfeat.live.names import Attachment
from streamfeat.live.warnings import Warnings
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.codecs import encode
from streamfeat.stream.cameras import Cameras
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session
from torture.soak import resident_bytes
from torture.table import Row, Trials

_COPIES = 10_000_000
_CAMERAS = 10_000
_A_TIME = 500
"""Messages that are put into the inbox before they are taken."""
_GROWTH = 8 << 20
"""Bytes by which memory may differ between the first and the last tenth."""
_SIZE = 12, 16


def crowd(trials: Trials) -> list[Row]:
    """A row for copies with and without a publisher's name, and one for cameras that come and go."""
    n = trials.times(_COPIES, least=2_000)
    return [
        _row(trials, f"{n:,} copies of packets {how}", _copies(n, is_named=is_named), n)
        for how, is_named in (("with a publisher's name", True), ("without", False))
    ] + [_churn(trials)]


class _Job:
    """An intake and its cameras."""

    def __init__(self) -> None:
        geometry = Geometry(patch=4, stride=4, n_bins=2, bin_us=50_000, max_count=2)
        filters = np.eye(3, geometry.entries)
        encoder = Encoder.build(
            geometry,
            formulation="direct",
            encoding="soft",
            threshold=0.3,
            filters=filters,
            whitening=np.eye(geometry.entries),
            mean=np.zeros(geometry.entries),
        )
        self.inbox = Inbox()
        self.intake = Intake(self.inbox, geometry.window_us, Warnings(), silence_s=1e9)
        self.cameras = Cameras(lambda topic: Session(encoder, EmitPolicy.parse("10ms"), topic=topic))

    def take(self) -> None:
        """Let everything in the inbox through."""
        while taken := self.inbox.take(0):
            for message in taken:
                for item in self.intake._items(message):
                    for _ in self.cameras.process(item):
                        pass


def _packet(topic: str, number: int, *, is_named: bool = True, ago_s: float = 0.0) -> RawMessage:
    t = 10_000 * number + np.arange(20) * 500
    events = make_events(np.arange(20) % _SIZE[1], np.arange(20) % _SIZE[0], np.arange(20) % 2, t)
    payload, base_ns = encode(events, "mono")
    about = int(t[0]) * 1000, "", *_SIZE, number, base_ns, "mono", False, payload
    attached = Attachment(number, 0, b"crowd of cameras").pack() if is_named else b""
    arrived_ns = time.monotonic_ns() - round(ago_s * 1e9)
    return RawMessage(topic, EventPacket.SCHEMA_NAME, EventPacket(*about).to_cdr(), attached, arrived_ns, 0)


def _copies(n: int, *, is_named: bool) -> Callable[[], Iterator[str]]:
    """Each packet, and then copies of the thousand before it; yields what is wrong at the end."""

    def run() -> Iterator[str]:
        job, sent, number = _Job(), 0, 0
        recent: list[RawMessage] = []
        while sent < n:
            number += 1
            new = _packet("cam/events", number, is_named=is_named)
            recent = [*recent[-999:], new]
            job.inbox.put(new)
            for copy in recent[-min(_A_TIME, n - sent) :]:
                job.inbox.put(copy)
                sent += 1
            job.take()
            yield ""
        counts, stats = job.intake.counts(), job.cameras.stats()
        if (counts["duplicates"], stats.events, counts["lost"]) != (n, 20 * number, 0):
            yield f"{dict(counts)} and {stats.events} events of {number} packets and {n} copies"

    return run


def _churn(trials: Trials) -> Row:
    n = trials.times(_CAMERAS, least=400)

    def run() -> Iterator[str]:
        job = _Job()
        for i in range(n):
            topic = f"robot{i}/events"
            job.inbox.put(Announcement(topic, here=True))
            job.inbox.put(_packet(topic, 1, ago_s=61.0))
            job.inbox.put(Announcement(topic, here=False))
            job.take()
            for _ in range(2):
                for item in job.intake._releases(1.0):
                    for _ in job.cameras.process(item):
                        pass
            yield "" if len(job.cameras.topics) == 0 else f"{job.cameras.topics} stay"
        received, events = job.intake.delivery().received, job.cameras.stats().events
        if (job.cameras.seen, received, events) != (n, n, 20 * n):
            yield f"{job.cameras.seen} cameras, {received} packets and {events} events of {n} cameras"

    return _row(trials, f"{n:,} cameras that come and go", run, n)


def _row(trials: Trials, fault: str, run: Callable[[], Iterator[str]], n: int) -> Row:
    """Run it to its end, and see that memory does not grow after the first tenth of its steps."""
    began, failures, held = time.monotonic(), [], []
    for wrong in run():
        if wrong:
            failures.append(wrong)
        held.append(resident_bytes())
    early, late = held[len(held) // 10], held[-1]
    if late - early > _GROWTH:
        failures.append(f"memory grew from {early / 2**20:.1f} to {late / 2**20:.1f} MiB")
    trials.say(f"{fault}: {early / 2**20:.1f} MiB after a tenth, {late / 2**20:.1f} at the end")
    survived = n if not failures else 0
    note = f"memory {(late - early) / 2**20:+.1f} MiB after the first tenth"
    return Row(fault, n, survived, seconds=time.monotonic() - began, note=note, failures=tuple(failures[:5]))
