"""What a view sees without end: cameras under ever new names, and browsers that come, look or do not, and go.

Lives here: feeding a view's tap, engines, sink and page far more of these than any day has; memory.
Not here: who may connect (`outside`), the same over the network (`hours`).
"""

import itertools
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import numpy as np
from websockets.sync.client import connect

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.geometry import Geometry
from streamfeat.events import make_events
from streamfeat.messages.packets import Packet
from streamfeat.stream.cameras import CameraLeft, Cameras
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session
from streamfeat.view.observe import ObservedEngine
from streamfeat.view.page import page
from streamfeat.view.server import PageServer
from streamfeat.view.sink import ViewSink
from torture.soak import resident_bytes
from torture.table import Row, Trials

__all__ = ["viewers"]

_CAMERAS = 5_000
_A_LIFE = 4
"""Packets of each."""
_SIZE = 120, 160
_GROWTH = 8 << 20
"""Bytes by which memory may differ between the first tenth and the end."""


def viewers(trials: Trials) -> list[Row]:
    """A row for cameras that leave, and for such as end without a word; browsers come and go meanwhile."""
    n = trials.times(_CAMERAS, least=200)
    return [_row(trials, n, says=says) for says in (True, False)]


def _row(trials: Trials, n: int, *, says: bool) -> Row:
    began, failures = time.monotonic(), []
    held = [resident_bytes() for _ in _looked_at(n, says=says)]
    early, late = held[len(held) // 10], held[-1]
    what = (
        f"cameras under new names that {'leave' if says else 'end without a word'}, browsers that come and go"
    )
    trials.say(f"{n:,} {what}: {early / 2**20:.1f} MiB after a tenth, {late / 2**20:.1f} at the end")
    if late - early > _GROWTH:
        failures.append(f"memory grew from {early / 2**20:.1f} to {late / 2**20:.1f} MiB")
    survived = 0 if failures else n
    return Row(f"view: {what}", n, survived, seconds=time.monotonic() - began, failures=tuple(failures))


def _looked_at(n: int, *, says: bool) -> Iterator[None]:
    geometry = Geometry(patch=8, stride=4, n_bins=2, bin_us=50_000, max_count=2)
    encoder = Encoder.build(
        geometry,
        formulation="direct",
        encoding="soft",
        threshold=0.3,
        filters=np.eye(8, geometry.entries),
        whitening=np.eye(geometry.entries),
        mean=np.zeros(geometry.entries),
    )
    server = PageServer(page, 0)
    sink = ViewSink([server], encoder, rate=1000, live=True, prefix=lambda topic: f"/{topic}", drops=dict)

    def session(topic: str) -> Session:
        def engine(*arguments, **options):
            return ObservedEngine(*arguments, watch=sink.watch(topic), **options)

        return Session(encoder, EmitPolicy.parse("10ms"), topic=topic, engine=engine)

    cameras, ended = Cameras(session), threading.Event()
    browsers = threading.Thread(target=_browse, args=(server, ended))
    browsers.start()

    def lives() -> Iterator[Packet | CameraLeft]:
        for i in range(n):
            for k in range(_A_LIFE):
                rng = np.random.default_rng(i * _A_LIFE + k)
                t = 10_000 * k + np.sort(rng.integers(0, 10_000, 200))
                events = make_events(rng.integers(0, 160, 200), rng.integers(0, 120, 200), t % 2, t)
                yield Packet(f"robot{i}", events, _SIZE, 0, 0)
            if says:
                yield CameraLeft(f"robot{i}")
            else:
                # What `Cameras` is told, but not the view: as for a camera that it refuses.
                for batch in cameras.batches(CameraLeft(f"robot{i}")):
                    sink.write([*batch])

    try:
        for item, k in zip(sink.tap().items(lives()), itertools.count()):
            for batch in cameras.batches(item):
                sink.write([*batch])
            if k % _A_LIFE == 0:
                yield
    finally:
        ended.set()
        browsers.join()
        server.close()


def _browse(server: PageServer, ended: threading.Event) -> None:
    """One looks for a moment, one asks for nonsense and leaves without a word, one reads nothing."""
    address = server.address.replace("http", "ws").replace("/?", "/stream?")
    silent: list[socket.socket] = []
    while not ended.wait(0.05):
        with suppress(OSError), connect(address, max_size=None) as browser:
            browser.send(json.dumps({"op": "seek", "value": "nowhere"}))
            browser.recv()
        silent.append(socket.create_connection(("127.0.0.1", server.port)))
        if len(silent) > 8:
            silent.pop(0).close()
    for one in silent:
        one.close()
