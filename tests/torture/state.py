"""`kill -9` of a listener that keeps its state, again and again, while a camera sends.

Lives here: the camera, the listener, and comparing what all its lives gave with a run that never stopped.
"""

import json
import shutil
import sys
import time
from pathlib import Path
from statistics import median

import numpy as np

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.events import Events, make_events
from streamfeat.live.listen import ListenJob
from streamfeat.live.names import PlainNames
from streamfeat.live.network import Network, open_session
from streamfeat.live.publisher import MessagePublisher
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.codecs import encode
from streamfeat.messages.packets import Packet
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.outputs import Outputs
from streamfeat.stream.session import Session
from torture.nursery import Nursery, free_port
from torture.table import Row, Trials

__all__ = ["listener", "state"]

ROOT = Path(__file__).resolve().parents[2]
KEY = "cam/events"
_TIMES = 30
_KILLS = 2
"""In each trial."""
_PACKETS, _EVENTS, _STEP_US = 120, 300, 10_000
_SIDES = 34, 34
_PATIENCE_S = 120.0


def listener(words: list[str]) -> None:
    """`streamfeat listen --state`, but that no silence of a busy machine is taken for one of the camera."""
    model, kept, port = words
    job = ListenJob(
        PlainNames(KEY),
        Path(model),
        emit="10ms",
        network=Network(None, int(port), reliable=True),
        publish=False,
        state=Path(kept),
        state_every_s=0.05,
        silence_s=1e9,
        patience_s=1e9,
        max_delay_s=1e9,
    )
    job.run(Outputs(json_lines=sys.stdout, with_features=True))


def state(trials: Trials) -> list[Row]:
    """One row."""
    encoder = _encoder(trials.seed)
    model = trials.folder / "model"
    encoder.save(model)
    began, rng = time.monotonic(), np.random.default_rng(trials.seed)
    failures, recoveries, again = [], [], 0
    times = trials.times(_TIMES, least=1)
    with Nursery(ROOT) as nursery:
        for i in range(times):
            folder = trials.folder / f"trial_{i}"
            folder.mkdir()
            try:
                repeated, took = _once(nursery, encoder, model, folder, rng)
                again += repeated
                recoveries += took
            except (AssertionError, TimeoutError) as error:
                failures.append(f"trial {i}: {error}")
            shutil.rmtree(folder)
            trials.say(f"state {i + 1}/{times}")
    return [
        Row(
            f"`kill -9` of `listen --state`, {_KILLS} times in {_PACKETS} packets",
            times,
            times - len(failures),
            0 if not failures else None,
            recovery_s=median(recoveries) if recoveries else None,
            seconds=time.monotonic() - began,
            note=f"--reliable; emissions have the bits of a run that never stopped; {again:,} made twice",
            failures=tuple(failures),
        )
    ]


def _encoder(seed: int) -> Encoder:
    geometry = Geometry(patch=8, stride=4, n_bins=3, bin_us=33_334, max_count=2)
    return random_encoder(seed, geometry, 16, encoding="split", threshold=0.3)


def _sent(i: int) -> Events:
    rng = np.random.default_rng(i)
    t = np.sort(rng.integers(i * _STEP_US, (i + 1) * _STEP_US, _EVENTS)) + 1_000_000
    return make_events(*(rng.integers(0, most, _EVENTS) for most in (*_SIDES, 2)), t)


def _once(
    nursery: Nursery, encoder: Encoder, model: Path, folder: Path, rng: np.random.Generator
) -> tuple[int, list[float]]:
    """One stream, its listener killed on the way: emissions made twice, and seconds to the next."""
    port, kept = free_port(), folder / "state"
    moments = {int(n) for n in rng.choice(np.arange(2, _PACKETS - 2), _KILLS, replace=False)}
    words = ["@listener", model, kept, port]
    took = []
    with open_session(port=port) as session:
        camera = MessagePublisher(
            session, PlainNames(KEY), KEY, EventPacket.SCHEMA_NAME, block=True, reliable=True
        )
        lives, started = [folder / "life0"], 0.0
        child = nursery.start(words, lives[0])
        for i in range(_PACKETS):
            payload, base_ns = encode(_sent(i), "mono")
            camera.put(EventPacket(0, "", *_SIDES, i, base_ns, "mono", False, payload).to_cdr())
            time.sleep(float(rng.uniform(0, 0.02)))
            if i in moments:
                # Packet 1 brings about the first emission, and each later one the next.
                _until(lambda: _emissions(lives[-1]), child.log)
                took += [time.monotonic() - started] * (started > 0)
                child.kill(float(rng.uniform(0, 0.05)))
                started = time.monotonic()
                lives.append(folder / f"life{len(lives)}")
                child = nursery.start(words, lives[-1])
            elif started and _emissions(lives[-1]):
                took.append(time.monotonic() - started)
                started = 0.0
        _until(lambda: _emissions(lives[-1]), child.log)
        took += [time.monotonic() - started] * (started > 0)
        session_of_plain = Session(encoder, EmitPolicy.parse("10ms"))
        packets = [Packet(KEY, _sent(i), _SIDES, 0, i) for i in range(_PACKETS)]
        expected = [e for packet in packets for e in session_of_plain.process(packet)]
        _until(lambda: any(r["t_us"] == expected[-1].t_us for r in _emissions(lives[-1])), child.log)
        child.send(15)
        child.wait()
        camera.close()
    got = [emission for life in lives for emission in _emissions(life)]
    by_time = {emission["t_us"]: emission for emission in got}
    for e in expected:
        assert e.t_us in by_time, f"no emission at {e.t_us} us"
    for emission in got:
        assert not emission.get("incomplete"), f"incomplete at {emission['t_us']} us"
    bits = {e.t_us: e.features.tobytes() for e in expected}
    for emission in got:
        if emission["t_us"] in bits:
            features = np.array(emission["features"], np.float32).tobytes()
            assert features == bits[emission["t_us"]], f"other features at {emission['t_us']} us"
    return len(got) - len(by_time), took


def _emissions(log: Path) -> list[dict]:  # type: ignore[type-arg]
    """Whole lines; the last may have been cut off."""
    lines = log.read_bytes().splitlines(keepends=True) if log.exists() else []
    return [json.loads(line) for line in lines if line.endswith(b"\n") and line.startswith(b"{")]


def _until(holds, log: Path) -> None:
    limit = time.monotonic() + _PATIENCE_S
    while not holds():
        if time.monotonic() > limit:
            raise TimeoutError(log.read_text()[-300:] if log.exists() else "nothing was said")
        time.sleep(0.01)
