"""Emissions as an asynchronous iterator: exact, bounded, cancelled anywhere without a trace."""

import asyncio
import concurrent.futures
import contextlib
import gc
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import tiny

import streamfeat as sf
from streamfeat.stream import emission_stream
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.outputs import Outputs
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.replay import ReplayJob
from streamfeat.stream.session import Session
from streamfeat.stream.threads import Threads

MODEL = tiny.encoder(k=3)
CLASSIFIER = tiny.classifier(MODEL, ["cat", "dog", "owl"])


@pytest.fixture(autouse=True)
def young_garbage():
    """Only what a test makes is looked at for garbage: the modules alone take 0.2 s, hundreds of times."""
    gc.collect()
    gc.freeze()


OTHERS = set()
"""Threads that were there before a test: of an engine that a failure elsewhere keeps for its report, say."""


@pytest.fixture(autouse=True)
def threads_of_others():
    OTHERS.update(threading.enumerate())
    yield
    OTHERS.clear()


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("async")
    MODEL.save(folder / "model")
    CLASSIFIER.save(folder / "classifier")
    tiny.write_items(folder / "in.mcap", tiny.labelled_items(8))
    return folder


def expected_of(path, policy):
    with sf.open_recording(path) as recording:
        session = Session(MODEL, EmitPolicy.parse(policy), CLASSIFIER)
        return [e for item in recording.items() for e in session.process(item)] + list(session.finish())


def same(one, two):
    assert len(one) == len(two)
    for a, b in zip(one, two, strict=True):
        assert (a.t_us, a.n_events, a.sample, a.final) == (b.t_us, b.n_events, b.sample, b.final)
        assert np.array_equal(a.features, b.features)
        assert np.array_equal(a.scores, b.scores)


class Kept:
    def __init__(self):
        self.emissions = []

    def write(self, emissions):
        self.emissions += emissions

    def close(self, *, failed):
        pass


async def collected(stream):
    return [emission async for emission in stream]


def left_over():
    """Threads of ours, and files that are open."""
    gc.collect()
    threads = [t.name for t in threading.enumerate() if t.name.startswith("streamfeat") and t not in OTHERS]
    opened = []
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            opened.append(str(descriptor.readlink()))
    return threads, sorted(
        name for name in opened if name.endswith((".mcap", "model", "classifier", ".part"))
    )


@contextlib.contextmanager
def nothing_leaks():
    before = left_over()
    yield
    assert left_over() == before


# --- what comes out


@pytest.mark.parametrize("policy", ["event", "10ms", "1000ev"])
@pytest.mark.parametrize("speed", [None, 1e6])
def test_a_replay_gives_the_emissions_of_a_plain_loop(files, policy, speed):
    with nothing_leaks():
        stream = sf.replay(files / "in.mcap", files / "model", files / "classifier", emit=policy, speed=speed)
        found = asyncio.run(collected(stream))
    same(found, expected_of(files / "in.mcap", policy))
    stats = stream.stats()
    assert stats.session.emissions == len(found)
    assert stats.session.samples == 8
    assert stats.drops == {"dropped": 0, "late": 0, "rejected": 0, "lost": 0}
    assert stats.waiting == 0


def test_they_are_those_of_the_command(files):
    kept = Kept()
    parts = files / "in.mcap", files / "model", files / "classifier"
    ReplayJob(*parts, emit="1ms").run(Outputs(more=kept))
    same(asyncio.run(collected(sf.replay(*parts, emit="1ms"))), kept.emissions)
    assert len(kept.emissions) > 400


@pytest.mark.parametrize("after", [0, 1, 2, 300])
def test_nothing_is_left_when_the_iterator_is_closed(files, after):
    async def leave():
        async with contextlib.aclosing(aiter(sf.replay(files / "in.mcap", MODEL, emit="event"))) as emissions:
            n = 0
            async for _ in emissions:
                n += 1
                if n > after:
                    break
        assert left_over()[0] == []

    with nothing_leaks():
        asyncio.run(leave())


def test_what_is_open_and_loaded_already_is_taken_as_it_is(files):
    with sf.open_recording(files / "in.mcap") as recording:
        for _ in range(2):
            stream = sf.replay(recording, MODEL, CLASSIFIER, emit=sf.EmitPolicy.parse("10ms"), speed=None)
            found = asyncio.run(collected(stream))
            same(found, expected_of(files / "in.mcap", "10ms"))
        assert len(list(recording)) == 16


def test_two_streams_in_one_running_loop_and_other_tasks_run_meanwhile(files):
    """As in Jupyter: the loop is there already, and its signal handlers stay as they are."""
    turns = 0

    async def count():
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    async def main():
        counting = asyncio.create_task(count())
        made = (sf.replay(files / "in.mcap", MODEL, CLASSIFIER, emit="event", speed=None) for _ in range(2))
        both = await asyncio.gather(*map(collected, made))
        counting.cancel()
        return both

    one, two = asyncio.run(main())
    same(one, two)
    same(one, expected_of(files / "in.mcap", "event"))
    assert turns > 20


def test_the_package_says_what_is_wrong_before_anything_runs_and_when_it_is_read(files, tmp_path):
    for options in ({"emit": "often"}, {"speed": 0.0}, {"speed": float("nan")}):
        with pytest.raises(sf.InputError):
            sf.replay(files / "in.mcap", MODEL, **options)
    for arguments in ((tmp_path / "no.mcap", MODEL), (files / "in.mcap", tmp_path / "no")):
        with nothing_leaks(), pytest.raises(sf.InputError):
            asyncio.run(collected(sf.replay(*arguments)))


# --- bounded


def endless(read, n=20_000):
    start = 0
    while True:
        read.append(start)
        yield tiny.packet(tiny.steady(start, start + 5_000, n, seed=len(read)))
        start += 5_000


class EndlessJob:
    """A job whose source never ends, and that knows what is open."""

    def __init__(self, policy="100ev", items=None, idle=False):
        self.read, self.is_open, self.session = [], False, Session(MODEL, EmitPolicy.parse(policy))
        self.items = items or (endless(self.read) if not idle else self.silence())

    def silence(self):
        while True:
            self.read.append(0)
            yield tiny.packet(tiny.steady(0, 1_000, 100))
            yield None

    @contextlib.contextmanager
    def opened(self, sinks):
        self.is_open = True
        try:
            self.pipeline = Pipeline(self.items, self.session, sinks())
            yield self.pipeline
        finally:
            self.is_open = False

    def stop(self):
        self.pipeline.stop()

    def session_stats(self):
        return self.session.stats()

    def drops(self):
        return {}


@pytest.mark.parametrize("idle", [False, True])
def test_a_program_that_takes_slowly_makes_the_pipeline_wait(idle):
    async def main():
        job = EndlessJob("5ev", idle=idle)
        async with emission_stream.EmissionStream(lambda: job) as stream:
            while stream.stats().waiting < 400:
                await asyncio.sleep(0)
            taken = 0
            async for _ in stream:
                taken += 1
                if taken == 100:
                    break
            # Left in the middle, and gone on with: nothing is missing.
            async for emission in stream:
                assert emission.n_events == 5 * (taken + 1)
                break
            for _ in range(50):
                await asyncio.to_thread(time.sleep, 0)
            assert stream.stats().waiting <= 1024
            assert stream.stats().peak_waiting <= 512
            read = len(job.read)
            for _ in range(50):
                await asyncio.to_thread(time.sleep, 0)
            assert len(job.read) <= read + 20
        assert not job.is_open

    with nothing_leaks():
        asyncio.run(main())


def test_emissions_that_find_no_room_wait_until_the_program_takes():
    sink, written = emission_stream._QueueSink(), threading.Event()
    sink.write([None] * 500)

    def write():
        sink.write([None] * 13)
        written.set()

    writer = threading.Thread(target=write)
    writer.start()
    assert not written.wait(0.3)
    assert len(asyncio.run(sink.take())) == 500
    assert written.wait(30)
    assert len(sink) == 13
    writer.join()


def test_stop_ends_the_source_and_what_was_read_comes_out():
    async def main():
        job, found = EndlessJob("1000ev"), []
        async with emission_stream.EmissionStream(lambda: job) as stream:
            async for emission in stream:
                found.append(emission.n_events)
                if len(found) == 10:
                    stream.stop()
        assert found == [1000 * i for i in range(1, len(found) + 1)]
        assert found[-1] == stream.stats().session.events > 10_000

    with nothing_leaks():
        asyncio.run(main())


def test_stop_before_anything_is_open_ends_at_once():
    async def main():
        async with emission_stream.EmissionStream(EndlessJob) as stream:
            stream.stop()
            assert len(await collected(stream)) < 5000

    with nothing_leaks():
        asyncio.run(main())


# --- cancelled anywhere


async def cancelled_after(turns, start):
    """Start a task, and cancel it after so many turns of the loop; whether it had ended before."""
    task = asyncio.create_task(start())
    for _ in range(turns):
        await asyncio.sleep(0)
        if task.done():
            break
    task.cancel()
    try:
        await task
    except asyncio.CancelledError:
        return False
    return True


@pytest.mark.parametrize(("way", "idle"), [("for", True), ("with", False)])
def test_a_stream_cancelled_at_any_await_leaves_nothing(way, idle):
    jobs = []

    def make_job():
        jobs.append(EndlessJob("50ev", idle=idle))
        return jobs[-1]

    async def read():
        stream = emission_stream.EmissionStream(make_job)
        async with stream if way == "with" else contextlib.nullcontext():
            async for _ in stream:
                await asyncio.sleep(0)

    async def main():
        for turns in [*range(24), *range(24, 1200, 293)]:
            assert not await cancelled_after(turns, read)
            tasks = asyncio.all_tasks() - {asyncio.current_task()}
            while any(t.get_name() == "streamfeat emissions" for t in tasks):
                await asyncio.sleep(0)
                tasks = asyncio.all_tasks() - {asyncio.current_task()}
            assert not any(job.is_open for job in jobs)
            assert left_over()[0] == []

    with nothing_leaks():
        asyncio.run(main())
    assert any(job.read for job in jobs)


def test_a_replay_cancelled_at_any_await_leaves_no_file_open(files):
    async def read():
        async for _ in sf.replay(
            files / "in.mcap", files / "model", files / "classifier", emit="event", speed=1.0
        ):
            pass

    async def main():
        for turns in [*range(16), *range(16, 1200, 293)]:
            before = left_over()
            await cancelled_after(turns, read)
            assert left_over() == before

    with nothing_leaks():
        asyncio.run(main())


def test_cancelled_again_while_it_is_closing(files):
    """The second cancellation does not make it leave its threads behind."""
    held, asked = threading.Event(), threading.Event()

    def source():
        yield tiny.packet(tiny.steady(0, 15_000, 100))
        asked.set()
        held.wait(30)
        while True:
            yield None

    async def main():
        job = EndlessJob(items=source())
        task = asyncio.create_task(collected(emission_stream.EmissionStream(lambda: job)))
        while not asked.is_set():
            await asyncio.sleep(0)
        for _ in range(5):
            task.cancel()
            for _ in range(20):
                await asyncio.sleep(0)
        assert job.is_open
        assert not task.done()
        held.set()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert not job.is_open

    with nothing_leaks():
        asyncio.run(main())


def test_a_cancelled_call_is_waited_for_without_blocking_the_loop():
    began, held = threading.Event(), threading.Event()

    def call():
        began.set()
        assert held.wait(30)

    async def main():
        with Threads(1) as threads:
            task = asyncio.create_task(threads.run(call))
            while not began.is_set():
                await asyncio.sleep(0)
            for _ in range(3):
                task.cancel()
                for _ in range(30):
                    await asyncio.sleep(0)
                assert not task.done()
                assert threads.cancelled
            held.set()
            with pytest.raises(asyncio.CancelledError):
                await task

    with nothing_leaks():
        asyncio.run(main())


def test_a_loop_that_ends_takes_its_streams_with_it():
    """asyncio.run cancels every task, and the thread that waits for room must not keep it."""
    jobs = []

    async def main():
        jobs.append(EndlessJob("1ev"))
        stream = emission_stream.EmissionStream(lambda: jobs[0])
        await stream.__aenter__()
        # The thread that writes waits for room: more parts have come than it could take.
        while stream.stats().waiting < 512 or stream.stats().pipeline.queued_out < 2:
            await asyncio.sleep(0)

    with nothing_leaks():
        asyncio.run(main())
    assert not jobs[0].is_open


def test_a_loop_that_is_left_closes_what_it_was_over(files):
    async def main():
        before = left_over()
        async for emission in sf.replay(files / "in.mcap", MODEL, CLASSIFIER, emit="event", speed=None):
            assert emission.n_events == 1
            break
        gc.collect()
        while left_over() != before:
            await asyncio.sleep(0)

    with nothing_leaks():
        asyncio.run(main())


def test_a_stream_runs_once(files):
    async def main():
        stream = sf.replay(files / "in.mcap", MODEL, speed=None)
        assert len(await collected(stream)) > 0
        assert await collected(stream) == []
        await stream.aclose()
        closed = sf.replay(files / "in.mcap", MODEL)
        await closed.aclose()
        assert await collected(closed) == []

    asyncio.run(main())


# --- errors

ERRORS = [
    (OSError("torn cable"), OSError),
    (StopIteration(), RuntimeError),
    (StopAsyncIteration(), RuntimeError),
    (asyncio.CancelledError(), RuntimeError),
    (concurrent.futures.CancelledError(), RuntimeError),
    (GeneratorExit(), RuntimeError),
    (SystemExit(3), RuntimeError),
    (KeyboardInterrupt(), RuntimeError),
]


class Failing:
    """An iterator that raises after some packets; `idle` says in between that nothing more is there."""

    def __init__(self, error, idle):
        self.error, self.idle, self.given = error, idle, 0

    def __iter__(self):
        return self

    def __next__(self):
        self.given += 1
        if self.given > 6:
            raise self.error
        return None if self.idle and self.given % 2 == 0 else tiny.packet(tiny.steady(0, 15_000, 100))


@pytest.mark.parametrize("idle", [False, True])
@pytest.mark.parametrize(("error", "kind"), ERRORS, ids=lambda v: getattr(v, "__name__", type(v).__name__))
def test_errors_of_a_source_end_everything(error, kind, idle):
    job = EndlessJob(items=Failing(error, idle))
    with nothing_leaks():
        if isinstance(error, StopIteration):  # what it means there
            assert asyncio.run(collected(emission_stream.EmissionStream(lambda: job)))
        else:
            with pytest.raises(kind) as caught:
                asyncio.run(collected(emission_stream.EmissionStream(lambda: job)))
            assert error in (caught.value, caught.value.__cause__)
    assert not job.is_open


class FailingSink:
    def __init__(self, error, *, in_close=False):
        self.error, self.in_close, self.closed = error, in_close, None

    def write(self, emissions):
        if not self.in_close:
            raise self.error

    def close(self, *, failed):
        self.closed = failed
        if self.in_close:
            raise self.error


@pytest.mark.parametrize("where", ["write", "close", "write in the reader"])
@pytest.mark.parametrize(("error", "kind"), ERRORS, ids=lambda v: getattr(v, "__name__", type(v).__name__))
def test_errors_of_a_sink_end_everything(error, kind, where):
    idle = where == "write in the reader"
    bad, good = FailingSink(error, in_close=where == "close"), FailingSink(None, in_close=False)
    good.write = lambda emissions: None

    def source():
        for i in range(5 if where == "close" else 10**9):
            yield tiny.packet(tiny.steady(i * 15_000, (i + 1) * 15_000, 100))
            if idle:
                yield None

    pipeline = Pipeline(source(), Session(MODEL, EmitPolicy.parse("10ms")), [good, bad])
    with nothing_leaks(), pytest.raises(kind) as caught:
        asyncio.run(pipeline.run())
    assert error in (caught.value, caught.value.__cause__)
    assert good.closed is True
    assert bad.closed is (where != "close")


@pytest.mark.parametrize(("error", "kind"), ERRORS, ids=lambda v: getattr(v, "__name__", type(v).__name__))
def test_errors_of_a_processor_end_everything(error, kind):
    class Broken:
        def batches(self, item):
            raise error
            yield

        def last_batches(self):
            yield from ()

        def rest(self):
            pass

    sink = FailingSink(None, in_close=False)
    with nothing_leaks(), pytest.raises((kind, RuntimeError)):
        asyncio.run(Pipeline(endless([], 100), Broken(), [sink]).run())
    assert sink.closed is True


def test_an_error_that_nobody_has_seen_comes_out_of_the_block():
    async def main():
        async with emission_stream.EmissionStream(lambda: job) as stream:
            while stream._task and not stream._task.done():
                await asyncio.sleep(0)

    job = EndlessJob(items=Failing(OSError("torn cable"), False))
    with nothing_leaks(), pytest.raises(OSError, match="torn cable"):
        asyncio.run(main())


def test_an_error_of_the_program_is_not_hidden_by_one_of_the_pipeline():
    async def main():
        async with emission_stream.EmissionStream(lambda: job) as stream:
            while stream._task and not stream._task.done():
                await asyncio.sleep(0)
            raise ZeroDivisionError

    job = EndlessJob(items=Failing(OSError("torn cable"), False))
    with nothing_leaks(), pytest.raises(ZeroDivisionError):
        asyncio.run(main())
