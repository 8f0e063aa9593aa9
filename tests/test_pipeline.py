"""The pipeline: same results as a plain loop, bounded queues, and every way to end."""

import asyncio
import json
import os
import signal
import tempfile
import threading
import time

import numpy as np
import pytest
import tiny

from streamfeat.engine.engine import Engine
from streamfeat.errors import InputError
from streamfeat.recordings.reader import open_recording
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.outputs import Outputs
from streamfeat.stream.pipeline import Pipeline
from streamfeat.stream.replay import ReplayJob, parse_speed
from streamfeat.stream.session import Session
from streamfeat.stream.signals import run_until_interrupted
from streamfeat.stream.sinks import JsonLinesSink, RecordingSink, TerminalSink

MODEL = tiny.encoder(k=3)
CLASSIFIER = tiny.classifier(MODEL, [str(digit) for digit in range(10)])


class ListSink:
    """Keeps what it is given; `hold` makes it wait, as a slow disk would."""

    def __init__(self):
        self.parts = []
        self.closed = None
        self.hold = threading.Event()
        self.hold.set()

    def write(self, emissions):
        assert self.hold.wait(30)
        self.parts.append(list(emissions))

    def close(self, *, failed):
        self.closed = "failed" if failed else "done"

    @property
    def emissions(self):
        return [e for part in self.parts for e in part]


class BrokenSink(ListSink):
    def write(self, emissions):
        super().write(emissions)
        raise OSError("no room")


def session(policy="10ms", **options):
    return Session(MODEL, EmitPolicy.parse(policy), CLASSIFIER, **options)


def plain_loop(items, policy="10ms", **options):
    one = session(policy, **options)
    return [e for item in items for e in one.process(item)] + list(one.finish()), one


def same(one, two):
    assert len(one) == len(two)
    for a, b in zip(one, two, strict=True):
        assert (a.t_us, a.n_events, a.sample, a.final) == (b.t_us, b.n_events, b.sample, b.final)
        assert np.array_equal(a.features, b.features)
        assert np.array_equal(a.scores, b.scores)


async def until(condition):
    """Let the loop turn until something holds; the suite's timeout is the limit."""
    while not condition():
        await asyncio.sleep(0)


@pytest.fixture(scope="module")
def digits(tmp_path_factory):
    return tiny.write_digits(tmp_path_factory.mktemp("digits") / "digits.mcap", 12)


@pytest.mark.real_time
@pytest.mark.parametrize("policy", ["10ms", "20ev", "1000ev"])
@pytest.mark.parametrize("speed", [None, 1e6])
def test_results_are_those_of_a_plain_loop(digits, policy, speed):
    with open_recording(digits) as recording:
        expected, loop_session = plain_loop(recording.items(), policy, learn_online=True)
        sink, other = ListSink(), ListSink()
        one = session(policy, learn_online=True)
        pipeline = Pipeline(recording.items(), one, [sink, other], speed=speed)
        asyncio.run(pipeline.run())
    same(sink.emissions, expected)
    same(other.emissions, sink.emissions)
    assert [len(part) for part in other.parts] == [len(part) for part in sink.parts]
    assert one.stats() == loop_session.stats()
    assert np.array_equal(one.classifier.weights, loop_session.classifier.weights)
    assert (sink.closed, other.closed) == ("done", "done")
    assert not pipeline.stats().stopped
    assert pipeline.stats().queued_in == pipeline.stats().queued_out == pipeline.stats().dropped == 0


@pytest.mark.real_time
def test_many_emissions_of_one_packet_are_handed_on_in_parts():
    sink = ListSink()
    asyncio.run(Pipeline([tiny.packet(tiny.steady(0, 50_000, 1000))], session("event"), [sink]).run())
    assert [len(part) for part in sink.parts] == [256, 256, 256, 232]


@pytest.mark.real_time
def test_nothing_in_nothing_out():
    sink = ListSink()
    asyncio.run(Pipeline([], session(), [sink]).run())
    assert (sink.parts, sink.closed) == ([], "done")


@pytest.mark.real_time
def test_what_is_there_does_not_wait_for_what_is_not():
    """A live source says None when it has nothing more: what it gave is read before it goes on."""
    sink, asked = ListSink(), threading.Event()

    def source():
        yield tiny.packet(tiny.steady(0, 15_000, 100))
        yield None
        yield None
        assert asked.wait(30)
        yield tiny.packet(tiny.steady(15_000, 30_000, 100, seed=1))

    async def run():
        pipeline = Pipeline(source(), session("10ms"), [sink])
        task = asyncio.create_task(pipeline.run())
        await until(lambda: sink.parts)
        asked.set()
        await task
        assert pipeline.stats().items == 2

    asyncio.run(run())
    assert [e.t_us for e in sink.emissions[:2]] == [10_000, 20_000]


def live_source(packets, waits):
    """Packets one by one, as a camera gives them; `waits` says after which more is there already."""
    for packet, more in zip(packets, waits, strict=True):
        yield packet
        if not more:
            yield None
            yield None


@pytest.mark.real_time
@pytest.mark.parametrize("policy", ["event", "10ms", "1000ev"])
def test_what_nobody_need_do_beside_is_done_in_one_thread_and_is_the_same(policy):
    packets = [tiny.packet(tiny.steady(i * 5_000, (i + 1) * 5_000, 300, seed=i)) for i in range(60)]
    expected, _ = plain_loop(packets, policy)
    waits = np.random.default_rng(0).random(60) < 0.5

    class Resting(Session):
        rests = 0

        def rest(self):
            super().rest()
            self.rests += 1

    sink, one = ListSink(), Resting(MODEL, EmitPolicy.parse(policy), CLASSIFIER)
    pipeline = Pipeline(live_source(packets, waits), one, [sink])
    asyncio.run(pipeline.run())
    same(sink.emissions, expected)
    assert pipeline.stats().items == 60
    assert one.rests > 0


@pytest.mark.real_time
def test_a_sink_that_fails_in_the_reader_ends_everything():
    sink = BrokenSink()

    def source():
        while True:
            yield tiny.packet(tiny.steady(0, 50_000, 100))
            yield None

    with pytest.raises(OSError, match="no room"):
        asyncio.run(Pipeline(source(), session(), [sink]).run())
    assert sink.closed == "failed"


@pytest.mark.real_time
def test_a_live_source_that_says_nothing_can_be_left():
    """Nothing comes and nothing is said but that: whoever is cancelled need not wait for a packet."""
    asked, sink = threading.Event(), ListSink()

    def source():
        while True:
            asked.set()
            yield None

    async def run():
        task = asyncio.create_task(Pipeline(source(), session(), [sink]).run())
        await until(asked.is_set)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(run())
    assert sink.closed == "failed"


@pytest.mark.real_time
@pytest.mark.parametrize("own", [True, False])
def test_pipelines_side_by_side_end_well_on_a_signal(own):
    read, sinks = [[], []], [ListSink(), ListSink()]
    stopped = threading.Event()

    def bounded(read):
        for item in endless(read, 100):
            if stopped.is_set():
                return
            yield item

    pipelines = [Pipeline(bounded(r), session("50ev"), [s]) for r, s in zip(read, sinks, strict=True)]

    def interrupt_when_both_run():
        while not all(sink.parts for sink in sinks):
            threading.Event().wait(0.001)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt_when_both_run)
    thread.start()
    assert run_until_interrupted(pipelines, stopped.set if own else None)
    thread.join()
    for sink, pipeline in zip(sinks, pipelines, strict=True):
        assert sink.closed == "done"
        assert sink.emissions[-1].n_events == 100 * pipeline.stats().items
    assert not run_until_interrupted([Pipeline([], session(), [])])


def endless(packets_read, n_events=40_000):
    """A source that never ends, and counts what it was asked for."""
    start = 0
    while True:
        packets_read.append(start)
        yield tiny.packet(tiny.steady(start, start + 5_000, n_events, seed=len(packets_read)))
        start += 5_000


@pytest.mark.real_time
def test_a_slow_sink_fills_bounded_queues_and_loses_nothing():
    read, sink = [], ListSink()
    sink.hold.clear()
    one = session("1000ev")

    async def run():
        pipeline = Pipeline(endless(read), one, [sink])
        task = asyncio.create_task(pipeline.run())
        await until(lambda: pipeline.stats().queued_in == 8 and pipeline.stats().queued_out == 8)
        # They stay so for as long as the sink waits: every hop lets the other threads run.
        for _ in range(300):
            await asyncio.to_thread(int)
            assert pipeline.stats().queued_in <= 8
            assert pipeline.stats().queued_out <= 8
        # One group more is in the hands of each task.
        n_items = pipeline.stats().items
        assert n_items <= 8 + 8 + 3
        assert len(read) <= n_items + 2
        pipeline.stop()
        sink.hold.set()
        await task
        assert pipeline.stats().stopped
        return pipeline.stats().items

    n_items = asyncio.run(run())
    expected, _ = plain_loop([item for item, _ in zip(endless([]), range(n_items), strict=False)], "1000ev")
    same(sink.emissions, expected)
    assert one.stats().events == 40_000 * n_items
    assert sink.closed == "done"


@pytest.mark.real_time
def test_a_sink_that_fails_ends_everything(tmp_path):
    good, broken = ListSink(), BrokenSink()
    sinks = [
        good,
        JsonLinesSink(tmp_path / "out.jsonl"),
        RecordingSink(RecordingWriter(tmp_path / "out.mcap")),
        broken,
    ]
    with pytest.raises(OSError, match="no room"):
        asyncio.run(Pipeline(endless([]), session(), sinks).run())
    assert (good.closed, broken.closed) == ("failed", "failed")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.real_time
def test_a_source_that_fails_ends_everything(tmp_path):
    def source():
        yield tiny.packet(tiny.steady(0, 50_000, 100))
        raise InputError("torn cable")

    sink = ListSink()
    sinks = [sink, RecordingSink(RecordingWriter(tmp_path / "out.mcap"))]
    with pytest.raises(InputError, match="torn cable"):
        asyncio.run(Pipeline(source(), session(), sinks).run())
    assert sink.closed == "failed"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.real_time
def test_a_failing_session_ends_everything(monkeypatch):
    def fail(self, batch):
        raise InputError("burnt out")

    monkeypatch.setattr(Engine, "feed", fail)
    monkeypatch.setattr(Engine, "follow", fail)
    sink = ListSink()
    with pytest.raises(InputError, match="burnt out"):
        asyncio.run(Pipeline([tiny.packet(tiny.steady(0, 100, 10))], session(), [sink]).run())
    assert sink.closed == "failed"


@pytest.mark.real_time
def test_a_sink_that_cannot_be_closed_does_not_keep_others_open():
    class Stuck(ListSink):
        def close(self, *, failed):
            raise OSError("cannot close")

    first, last = ListSink(), ListSink()
    with pytest.raises(OSError, match="cannot close"):
        asyncio.run(Pipeline([], session(), [first, Stuck(), last]).run())
    # Sinks are closed from the last to the first.
    assert last.closed == "done"
    assert first.closed == "failed"


@pytest.mark.real_time
@pytest.mark.parametrize("speed", [None, 0.05])
def test_stop_keeps_what_was_read(tmp_path, speed):
    read, sink, target = [], ListSink(), tmp_path / "out.mcap"

    async def run():
        sinks = [sink, RecordingSink(RecordingWriter(target))]
        pipeline = Pipeline(endless(read, 1000), session("500ev"), sinks, speed=speed)
        task = asyncio.create_task(pipeline.run())
        await until(lambda: sink.parts)
        pipeline.stop()
        await task
        return pipeline.stats()

    stats = asyncio.run(run())
    assert stats.stopped
    assert sink.closed == "done"
    assert sink.emissions[-1].n_events == 1000 * stats.items
    from mcap.reader import make_reader

    with target.open("rb") as file:
        counts = make_reader(file).get_summary().statistics.message_count
    assert counts == 2 * len(sink.emissions)
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.real_time
def test_cancelling_the_task_closes_sinks_as_failed(tmp_path):
    sink = ListSink()

    async def run():
        sinks = [sink, JsonLinesSink(tmp_path / "out.jsonl")]
        task = asyncio.create_task(Pipeline(endless([], 1000), session(), sinks).run())
        await until(lambda: sink.parts)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(run())
    assert sink.closed == "failed"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.real_time
def test_progress_is_told_in_order(digits):
    told = []
    with open_recording(digits) as recording:
        pipeline = Pipeline(recording.items(), session(), [], speed=1e6, on_progress=told.append)
        asyncio.run(pipeline.run())
        assert told[-1] == recording.last_us
    assert told == sorted(told)


@pytest.mark.real_time
def test_the_recorded_pace_is_kept():
    # One packet of 400 ms at twice its pace; it is cut, so that emissions do not wait for its end.
    sink = ListSink()
    arrived = []
    write = sink.write
    sink.write = lambda emissions: (arrived.append(time.monotonic()), write(emissions))
    items = [tiny.packet(tiny.steady(0, 400_000, 2000))]
    started = time.monotonic()
    asyncio.run(Pipeline(items, session("100ms"), [sink], speed=2.0).run())
    assert len(sink.parts) == len(arrived) == 4
    # A loaded machine may be late with any of them, but none is early.
    assert all(when - started > 0.05 * nth - 0.01 for nth, when in enumerate(arrived, 1))
    same(sink.emissions, plain_loop(items, "100ms")[0])


# --- sinks


def emissions_of(n=3, policy="1000ev"):
    return plain_loop(tiny.labelled_items(n, names=("1", "2")), policy)[0]


def test_json_lines(tmp_path):
    emissions = emissions_of()
    sink = JsonLinesSink(tmp_path / "a.jsonl", features=True)
    sink.write(emissions[:1])
    assert not (tmp_path / "a.jsonl").exists()
    sink.write(emissions[1:])
    sink.close(failed=False)
    lines = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    assert len(lines) == len(emissions)
    for line, e in zip(lines, emissions, strict=True):
        assert (line["t_us"], line["n_events"], line["prediction"]) == (e.t_us, e.n_events, e.prediction)
        assert np.allclose(list(line["scores"].values()), e.scores, atol=1e-6)
        assert tuple(line["scores"]) == e.labels
        assert np.array_equal(np.array(line["features"], np.float32), e.features)
        assert line["sample"]["label"] == e.sample.label
        assert line["sample"]["elapsed_us"] == 80_000
    with pytest.raises(InputError, match="cannot write there"):
        JsonLinesSink(tmp_path / "no" / "a.jsonl")


def test_json_lines_to_a_stream_do_not_wait_for_a_full_buffer():
    with tempfile.TemporaryFile("w+") as stream, open(stream.fileno(), closefd=False) as reader:
        sink = JsonLinesSink(stream)
        sink.write(emissions_of(1))
        reader.seek(0)
        assert json.loads(reader.readline())["n_events"] == 300
        sink.close(failed=True)
        assert not stream.closed


class Screen:
    def __init__(self):
        self.lines = []

    def print(self, text, **_options):
        self.lines.append(str(text))


def test_the_terminal_is_not_flooded_and_what_is_not_shown_is_counted():
    screen, clock = Screen(), [0.0]
    sink = TerminalSink(screen, clock=lambda: clock[0])
    finals = emissions_of(10)
    assert all(e.final for e in finals)
    sink.write(finals[:4])
    sink.write(finals[4:6])
    clock[0] += 1
    sink.write(finals[6:7])
    sink.write(finals[7:])
    sink.close(failed=False)
    # Of four, one is shown; of two, none; then one, and none of three.
    assert len(screen.lines) == 3
    assert "8 samples" in screen.lines[-1]
    assert "of 7" in screen.lines[1]


def test_the_terminal_without_labels():
    screen, clock = Screen(), [0.0]
    sink = TerminalSink(screen, clock=lambda: clock[0])
    for i in range(30):
        clock[0] = i / 10
        sink.write(plain_loop([tiny.packet(tiny.stream([i]))], "event")[0])
    sink.close(failed=False)
    assert len(screen.lines) == 10


def test_a_line_without_labels_says_rate_active_volumes_and_what_moved():
    screen, clock = Screen(), [0.0]
    sink = TerminalSink(screen, clock=lambda: clock[0], n_filters=3)
    since_1970_us = 1_744_227_144_000_000
    features = [[1, 0, 0, 0, 0, 0], [1, 0, 4, 0, -2, 0], [1, 0, 4, 0, -2, 0]]
    for i, row in enumerate(features):
        clock[0] = float(i)
        sink.write(
            [
                Emission(
                    since_1970_us + i * 500_000,
                    i * 12_345,
                    np.array(row, np.float32),
                    (),
                    np.zeros(0, np.float32),
                    None,
                    False,
                    active_volumes=1_204,
                )
            ]
        )
    assert [" ".join(line.split()) for line in screen.lines] == [
        "0.00 s -/s 1,204 active filters 1+",
        "0.50 s 24.7k/s 1,204 active filters 3+ 2-",
        "1.00 s 24.7k/s 1,204 active filters at rest",
    ]
    assert max(map(len, screen.lines)) <= 60


# --- replay


def test_replay_opens_all_outputs_or_leaves_none(tmp_path, digits):
    MODEL.save(tmp_path / "model")
    (tmp_path / "out.mcap.part").write_bytes(b"left over")
    job = ReplayJob(digits, tmp_path / "model")
    with pytest.raises(InputError, match="left by a writer"):
        job.run(Outputs(recording=tmp_path / "out.mcap", json_lines=tmp_path / "out.jsonl"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model", "out.mcap.part"]


def test_a_replay_inside_a_running_loop_is_one_clear_line_and_leaves_nothing(tmp_path, digits):
    MODEL.save(tmp_path / "model")

    async def inside():
        job = ReplayJob(digits, tmp_path / "model")
        with pytest.raises(InputError, match="an event loop is running here already"):
            job.run(Outputs(json_lines=tmp_path / "out.jsonl"))
        with pytest.raises(InputError, match=r"sf\.replay"):
            run_until_interrupted([])

    asyncio.run(inside())
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "fast", "", "1e9"])
def test_bad_speeds_are_refused(text):
    with pytest.raises(InputError, match="--speed"):
        parse_speed(text)
