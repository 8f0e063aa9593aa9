"""One limit for the memory of all engines of a job, and one for emissions under way, by their bytes."""

import asyncio
import threading
from dataclasses import replace

import numpy as np
import pytest
import tiny

from streamfeat.engine.engine import Engine
from streamfeat.errors import InputError
from streamfeat.stream.batch import EmissionBatch
from streamfeat.stream.cameras import CameraLeft, Cameras
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.emission_stream import _QueueSink
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.room import MEMORY, Room, engine_bytes, usable_bytes
from streamfeat.stream.session import Session

MODEL = tiny.encoder(k=3)
WEIGHT = engine_bytes(Engine(MODEL, tiny.RESOLUTION))


def packet(topic, resolution=tiny.RESOLUTION):
    return replace(tiny.packet(tiny.stream([5]), resolution), topic=topic)


def cameras_in(room, told):
    def session(topic):
        return Session(MODEL, EmitPolicy.parse("10ms"), topic=topic, engine=room.maker(topic, Engine))

    return Cameras(session, on_refusal=lambda *what: told.append(what))


def run(items, cameras):
    return [e for item in items for e in cameras.process(item)]


def test_a_camera_whose_engine_is_too_much_for_all_is_refused_alone():
    told, room = [], Room(2 * WEIGHT)
    cameras = cameras_in(room, told)
    run([packet("a"), packet("b"), packet("c"), packet("a")], cameras)
    assert cameras.topics == ["a", "b"]
    assert room.held_bytes == 2 * WEIGHT
    assert cameras.refused == {"out of memory": 1}
    ((topic, _, error),) = told
    assert topic == "c"
    assert "--memory BYTES COMMAND` allows more" in error
    run([CameraLeft("a"), packet("c")], cameras)
    assert cameras.topics == ["b", "c"]


def test_what_was_too_large_is_not_made_again_to_be_weighed():
    made = []

    def make(*arguments, **options):
        made.append(1)
        return Engine(*arguments, **options)

    session = Session(MODEL, EmitPolicy.parse("10ms"), engine=Room(WEIGHT - 1).maker("a", make))
    for _ in range(3):
        with pytest.raises(MemoryError, match="--memory BYTES"):
            [*session.process(packet("a"))]
    assert len(made) == 1


def test_the_engine_that_a_camera_had_before_is_not_counted():
    """It has another resolution now; for a moment both are there."""
    told, room = [], Room(4 * WEIGHT)
    cameras = cameras_in(room, told)
    larger = tiny.RESOLUTION[0] + 4, tiny.RESOLUTION[1]
    run([packet("a"), packet("b"), packet("a", larger), packet("a"), packet("a", larger)], cameras)
    assert (cameras.topics, told) == (["a", "b"], [])
    assert room.held_bytes > 2 * WEIGHT


def test_the_limit_is_half_of_the_memory_or_what_is_asked_for(monkeypatch):
    monkeypatch.delenv(MEMORY, raising=False)
    assert 1 << 28 < usable_bytes() < 1 << 50
    monkeypatch.setenv(MEMORY, "3M")
    assert usable_bytes() == 3 << 20
    monkeypatch.setenv(MEMORY, "much")
    with pytest.raises(InputError, match="--memory much: give a number of bytes"):
        usable_bytes()


def test_a_recording_whose_engine_does_not_fit_is_one_line(tmp_path, run, monkeypatch):
    monkeypatch.setenv(MEMORY, "1G")  # so that what the option sets is undone
    tiny.write_items(tmp_path / "rec.mcap", [tiny.packet(tiny.steady(0, 5_000, 50))])
    MODEL.save(tmp_path / "model")
    result = run("--memory", "1K", "replay", tmp_path / "rec.mcap", "-m", tmp_path / "model")
    assert result.status == 2
    assert "--memory BYTES COMMAND` allows more" in result.err
    assert result.err.count("\n") == 1


# --- emissions


def heavy(i):
    """30 MB of features that no page of memory is behind."""
    return EmissionBatch(
        t_us=np.array([i]),
        n_events=np.array([i]),
        features=np.zeros((1, 7_500_000), np.float32),
        labels=(),
        scores=np.zeros((1, 0), np.float32),
        incomplete=np.zeros(1, np.bool_),
    )


class Heavy:
    """One item, many heavy emissions."""

    made = 0

    def batches(self, item):
        for i in range(8):
            self.made += 1
            yield heavy(i)

    def last_batches(self):
        return iter(())

    def rest(self):
        pass


class Slow:
    """Writes nothing before it may."""

    def __init__(self):
        self.may, self.writes, self.written = threading.Event(), threading.Event(), []

    def write(self, emissions):
        self.writes.set()
        self.may.wait()
        self.written.extend(emission.t_us for emission in emissions)

    def close(self, *, failed):
        assert not failed


def test_few_heavy_emissions_are_under_way():
    """Two are with the sink or wait for it, one waits for room; by their number it could be 2,000."""
    processor, sink = Heavy(), Slow()

    async def look():
        pipeline = Pipeline([object()], processor, [sink])
        running = asyncio.create_task(pipeline.run())
        await asyncio.to_thread(sink.writes.wait)
        for _ in range(20):
            await asyncio.sleep(0.005)
        assert processor.made == 3
        sink.may.set()
        await running

    asyncio.run(look())
    assert sink.written == list(range(8))


def test_a_program_that_takes_nothing_has_few_heavy_emissions_waiting():
    queue, done = _QueueSink(), []

    def write():
        for i in range(4):
            queue.write(heavy(i))
            done.append(i)

    async def look():
        queue.serve(asyncio.get_running_loop())
        writer = threading.Thread(target=write)
        writer.start()
        while len(queue) < 2:
            await asyncio.sleep(0.001)
        await asyncio.sleep(0.02)
        assert done == [0, 1]
        taken = []
        while len(taken) < 4:
            taken += await queue.take()
        writer.join()
        return [emission.t_us for emission in taken]

    assert asyncio.run(look()) == [0, 1, 2, 3]
