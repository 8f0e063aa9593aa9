"""The state of a live job in a file, so that a program that was killed can go on where it was.

Lives here: `Checkpointer`, which takes checkpoints and writes them beside the pipeline; reading them back.
Not here: what the parts keep of themselves (`topic`, `stream.state`, `engine`).

A checkpoint must be of one place in the stream. So the intake puts a barrier there with what it knows
(sequence numbers, clocks, decoders); when the barrier has come through the queue, the cameras have had all
items before it and none after, and their counts and times are added. Emissions made until then must have been
written before the file says that they were: the checkpointer is the last of the sinks too, and waits until it
has seen as many emissions as were made before the barrier.

Projections, codes and pooled sums are not kept: they follow from the counts, bit for bit. That makes the file
small, and leaves a damaged or hostile one nothing to lie about that a kernel would use as an index.
"""

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from streamfeat.engine.scales import MOST_SCALES
from streamfeat.engine.snapshot import Snapshot
from streamfeat.errors import InputError
from streamfeat.events import TIME_LIMIT
from streamfeat.files.atomic import sweep
from streamfeat.files.json_fields import Fields
from streamfeat.files.safetensors_file import read_safetensors, write_safetensors
from streamfeat.live.health import Health
from streamfeat.live.intake import Intake
from streamfeat.live.shard import Shard
from streamfeat.live.topic import MAX_TOPICS, Barrier, resolution_in
from streamfeat.stream.batch import EmissionBatch, Emitter
from streamfeat.stream.cameras import MAX_CAMERAS, CameraLeft, Cameras
from streamfeat.stream.emission import Emission
from streamfeat.stream.session import StreamItem
from streamfeat.stream.state import SessionSnapshot, SessionState, SessionStats

__all__ = ["Checkpointer", "read_state"]

_KIND, _VERSION = "state", 1
_ARRAYS = ("counts", "atoms", "tally", "encoded")
"""Of an engine's snapshot."""


@dataclass(frozen=True, slots=True)
class _Kept:
    """A checkpoint: what goes into the file.

    Attributes:
        saved_ns: when it was taken, since 1970.
        topics: what the intake knows of each.
        cameras: the sessions.
        made: emissions made until then.
    """

    saved_ns: int
    topics: Mapping[str, Mapping[str, Any]]
    cameras: Mapping[str, SessionSnapshot]
    made: int


class Checkpointer(Emitter):
    """Keeps a state file up to date; both the processor of a pipeline, around `Health`, and its last sink.

    Args:
        path: replaced, whole, each time.
        fingerprint: of the encoder.
        health: that processes the items.
        cameras: that it hands them to.
        intake: that puts in the barriers.
        on_failure: told why a file could not be written; the file before it stays, and the job goes on.
    """

    def __init__(
        self,
        path: Path,
        fingerprint: str,
        health: Health,
        cameras: Cameras,
        intake: Intake,
        on_failure: Callable[[str], None],
    ) -> None:
        """Start the thread that writes."""
        self._path, self._fingerprint = path, fingerprint
        self._health, self._cameras, self._intake = health, cameras, intake
        self._on_failure = on_failure
        self._made = self._written = 0
        self._taken: _Kept | None = None
        self._ready: _Kept | None = None
        self._ends = False
        self._changed = threading.Condition()
        sweep(path)
        self._thread = threading.Thread(target=self._keep, name="streamfeat state", daemon=True)
        self._thread.start()

    def batches(self, item: StreamItem | CameraLeft | Barrier, /) -> Iterator[EmissionBatch]:
        """Process an item, or take a checkpoint at a barrier."""
        if isinstance(item, Barrier):
            self._take(item.topics)
            return
        for batch in self._health.batches(item):
            self._made += len(batch)
            yield batch

    def rest(self) -> None:
        """Let the cameras work ahead."""
        self._health.rest()

    def last_batches(self) -> Iterator[EmissionBatch]:
        """Take a checkpoint before the cameras' streams are ended, where the next run goes on."""
        self._take(self._intake.snapshot())
        yield from self._health.last_batches()

    def write(self, emissions: Sequence[Emission]) -> None:
        """All other sinks have written these."""
        with self._changed:
            self._written += len(emissions)
            self._hand_over()

    def close(self, *, failed: bool) -> None:
        """Write what is ready, and end the thread."""
        with self._changed:
            self._ends = True
            self._changed.notify()
        self._thread.join()

    def _take(self, topics: Mapping[str, Mapping[str, Any]]) -> None:
        kept = _Kept(time.time_ns(), topics, self._cameras.snapshots(), self._made)
        with self._changed:
            self._taken = kept
            self._hand_over()

    def _hand_over(self) -> None:
        if self._taken and self._written >= self._taken.made:
            # One that still waits is replaced: a slow disk makes the file older, and holds up nothing.
            self._ready, self._taken = self._taken, None
            self._changed.notify()

    def _keep(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ready or self._ends)
                kept, self._ready = self._ready, None
            if kept is None:
                return
            try:
                _write_state(self._path, self._fingerprint, kept)
            except InputError as error:
                self._on_failure(str(error))


def _write_state(path: Path, fingerprint: str, kept: _Kept) -> None:
    arrays: dict[str, NDArray[Any]] = {}
    for i, session in enumerate(kept.cameras.values()):
        for name, scale in _scales(f"{i}", session.engine) if session.engine else ():
            arrays |= {f"{name}.{array}": getattr(scale, array) for array in _ARRAYS}
    header = {
        "fingerprint": fingerprint,
        "saved_ns": kept.saved_ns,
        "topics": [{"topic": topic, **values} for topic, values in kept.topics.items()],
        "cameras": [{"topic": topic, **_to_json(session)} for topic, session in kept.cameras.items()],
    }
    write_safetensors(path, _KIND, _VERSION, arrays, header, private=True)


def _scales(name: str, engine: Snapshot) -> Iterator[tuple[str, Snapshot]]:
    """The snapshot of each scale, and what the names of its arrays begin with."""
    yield name, engine
    for i, further in enumerate(engine.further, 1):
        yield f"{name}.scale{i}", further


def _to_json(session: SessionSnapshot) -> dict[str, Any]:
    """All of a session but the arrays of its engine."""
    engine = session.engine
    return {
        "moment": asdict(session.state),
        "stats": asdict(session.stats),
        "resolution": session.resolution,
        "engine": _engine_to_json(engine) if engine else None,
    }


def _engine_to_json(engine: Snapshot) -> dict[str, Any]:
    further = (
        {"further": [{"fingerprint": one.fingerprint} for one in engine.further]} if engine.further else {}
    )
    return {"bin": engine.bin, "origin_us": engine.origin_us, **further}


def read_state(
    path: Path, fingerprint: str, intake: Intake, cameras: Cameras, shard: Shard | None = None
) -> None:
    """Let an intake and cameras go on from a file, before anything is taken.

    Args:
        path: that a `Checkpointer` wrote.
        fingerprint: of the encoder.
        intake: without a topic yet.
        cameras: without a session yet.
        shard: cameras of others, which another process serves by now, are left out.

    Raises:
        InputError: it is no such file, of another version or encoder, or holds a state that no job can be in.
    """
    arrays, header = read_safetensors(path, _KIND, _VERSION)
    values = Fields(header, str(path))
    if values.text("fingerprint") != fingerprint:
        raise InputError(f"{path}: the state is of another model; delete it, or give the model that it is of")
    passed_ns = max(time.time_ns() - values.whole("saved_ns"), 0)
    try:
        for topic in values.inners("topics", MAX_TOPICS):
            if shard is None or shard.has(topic.text("topic")):
                intake.restore(topic.text("topic"), topic, passed_ns)
        for i, camera in enumerate(values.inners("cameras", MAX_CAMERAS)):
            if shard is None or shard.has(camera.text("topic")):
                cameras.restore(camera.text("topic"), _session(camera, arrays, i, fingerprint))
    except InputError as error:
        text = str(error).removeprefix(f"{path}: ")
        raise InputError(f"{path}: not a usable state: {text}; delete it to start anew") from None


def _engine(values: Fields, arrays: Mapping[str, NDArray[Any]], name: str, fingerprint: str) -> Snapshot:
    """The snapshot of one scale; all have the same time."""
    missing = [array for array in _ARRAYS if f"{name}.{array}" not in arrays]
    if missing:
        raise InputError(f"{values.where}: {missing[0]} is missing")
    return Snapshot(
        fingerprint=fingerprint,
        counts=arrays[f"{name}.counts"],
        atoms=arrays[f"{name}.atoms"],
        bin=values.whole("bin", -TIME_LIMIT),
        origin_us=values.whole("origin_us", -TIME_LIMIT),
        tally=arrays[f"{name}.tally"],
        encoded=arrays[f"{name}.encoded"],
    )


def _session(values: Fields, arrays: Mapping[str, NDArray[Any]], i: int, fingerprint: str) -> SessionSnapshot:
    engine = None
    resolution = resolution_in(values)
    if (resolution is None) != ("engine" not in values):
        raise InputError(f"{values.where}: a sensor without an engine, or the other way round")
    if "engine" in values:
        inner = values.inner("engine")
        others = inner.inners("further", MOST_SCALES) if "further" in inner else []
        further = [
            _engine(inner, arrays, f"{i}.scale{number}", other.text("fingerprint"))
            for number, other in enumerate(others, 1)
        ]
        engine = replace(_engine(inner, arrays, f"{i}", fingerprint), further=tuple(further))
    moment = SessionState.from_json(values.inner("moment"))
    return SessionSnapshot(moment, SessionStats.from_json(values.inner("stats")), resolution, engine)
