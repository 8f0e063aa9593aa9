"""Whether a sensor can be followed: what is said of it, and the grid that `learn` chooses for it."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import tiny

import streamfeat as sf
from streamfeat.engine.geometry import Geometry
from streamfeat.learn.sensor import followed, load_of, suited_to
from streamfeat.learn.settings import Setting
from streamfeat.live.listen import ListenJob
from streamfeat.live.names import PlainNames
from streamfeat.messages.packets import Packet
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.load import Load
from streamfeat.stream.session import Session


def told(seconds_each, geometry=None, n=100, step_us=10_000, resolution=(260, 346)):
    """What is said of a stream of `n` packets, each of which takes so long."""
    said = []
    now = itertools.count()
    # Two readings of the clock around each step of the work; a packet here is one step.
    load = Load(geometry or Geometry(), said.append, clock=lambda: next(now) * seconds_each)
    for i in range(n):
        events = tiny.steady(i * step_us, (i + 1) * step_us, 50)
        assert list(load.timed(iter(()), Packet("", events, resolution, 0, 0))) == []
    return said, load


def test_nothing_is_said_of_work_that_keeps_pace():
    said, load = told(0.008)
    assert (said, load.is_done) == ([], True)


def test_too_much_work_is_told_once_with_what_would_help():
    said, _ = told(0.02)
    (line,) = said
    assert line.startswith("346x260 pixels and 0.01 M events/s take 2.0 s of work a second with this model: ")
    assert "learn one with --preset fast (stride 4), or emit less often" in line


@pytest.mark.parametrize(
    ("seconds", "geometry", "remedy"),
    [
        (0.05, Geometry(), "learn one with --stride 4 --downsample 2"),
        (0.02, Geometry(stride=4), "learn one with --downsample 2"),
        (0.2, Geometry(stride=4), "learn one with --downsample 8"),
        (0.02, Geometry(stride=3, downsample=2), "learn one with --stride 4 --downsample 4"),
    ],
)
def test_the_remedy_is_the_least_that_reaches(seconds, geometry, remedy):
    (line,) = told(seconds, geometry)[0]
    assert remedy in line


def test_what_compiles_at_the_start_and_what_takes_the_emissions_do_not_count():
    said = []
    clock = [0.0]
    load = Load(Geometry(), said.append, clock=lambda: clock[0])

    def work(first):
        clock[0] += 20.0 if first else 0.001
        yield "emission"

    for i in range(100):
        events = tiny.steady(i * 10_000, (i + 1) * 10_000, 50)
        for emission in load.timed(work(i == 0), Packet("", events, (260, 346), 0, 0)):
            assert emission == "emission"
            clock[0] += 1.0  # the sink
    assert (said, load.is_done) == ([], True)


def test_a_stream_with_a_silence_is_not_judged():
    said, load = told(0.5, step_us=2_000_000, n=5)
    assert (said, load.is_done) == ([], True)


def test_a_session_is_timed_and_its_emissions_are_the_same():
    encoder = tiny.encoder()
    packets = [
        Packet("", tiny.steady(i * 10_000, (i + 1) * 10_000, 50), tiny.RESOLUTION, 0, 0) for i in range(90)
    ]
    said, ticks = [], itertools.count()
    load = Load(encoder.geometry, said.append, clock=lambda: next(ticks) * 1.0)
    runs = []
    for one in (load, None):
        session = Session(encoder, EmitPolicy.parse("20ms"), load=one)
        runs.append([e.features.tobytes() for p in packets for e in session.process(p)])
    assert runs[0] == runs[1]
    assert len(said) == 1


def test_replay_says_so(run, tmp_path, monkeypatch):
    path = tmp_path / "long.mcap"
    with sf.RecordingWriter(path) as writer:
        for i in range(100):
            writer.write_events(tiny.steady(i * 10_000, (i + 1) * 10_000, 50), tiny.RESOLUTION)
    tiny.encoder().save(tmp_path / "model")
    command = ["replay", path, "-m", tmp_path / "model", "--emit", "10ms", "--quiet"]
    assert "too much work" not in run(*command).err
    monkeypatch.setattr("streamfeat.stream.load._TOO_MUCH", 0.0)
    err = run(*command).err
    assert err.count("too much work") == 1
    assert "emit less often" in err


@pytest.mark.parametrize(
    ("resolution", "rate", "grid"),
    [
        ((34, 34), 40_000, (2, 1)),
        ((100, 120), 40_000, (2, 1)),
        ((260, 346), 580_000, (4, 1)),
        ((260, 346), 3_000, (2, 1)),
        ((480, 640), 2_000_000, (4, 2)),
        ((720, 1280), 10_000_000, (4, 2)),
    ],
)
def test_the_grid_that_suits_a_sensor(monkeypatch, resolution, rate, grid):
    monkeypatch.setattr("streamfeat.learn.sensor.followed", lambda recording: (resolution, rate))
    for setting in (Setting(), Setting(filters=1700, volumes=20_000)):
        found = suited_to([None], setting)
        assert (found.stride, found.downsample) == grid
        assert replace(found, stride=2, downsample=1) == setting


def test_a_sensor_that_no_grid_follows_gets_the_coarsest_and_a_small_one_costs_little(monkeypatch):
    monkeypatch.setattr("streamfeat.learn.sensor.followed", lambda recording: ((30_000, 30_000), 1e9))
    assert suited_to([None], Setting()).downsample == 8
    assert load_of(Setting(), (8, 8), 1e6) < 1e-3


def test_the_rate_is_that_of_the_first_second(tmp_path):
    path = tmp_path / "rec.mcap"
    with sf.RecordingWriter(path) as writer:
        for second, n in enumerate((2000, 90_000)):
            events = tiny.steady(second * 1_000_000, (second + 1) * 1_000_000, n)
            for part in np.array_split(events, 20):
                writer.write_events(part, tiny.RESOLUTION)
    with sf.open_recording(path) as recording:
        resolution, rate = followed(recording)
    assert resolution == tiny.RESOLUTION
    assert rate == pytest.approx(2000, rel=4)
    assert rate < 10_000


def test_learn_chooses_it_and_says_so(run, tmp_path, monkeypatch):
    tiny.write_digits(tmp_path / "train.mcap", 8)
    learn = ["learn", tmp_path / "train.mcap", "--overwrite", "-o", tmp_path / "model", "--filters", "6"]
    learn += ["--patch", "6", "--bins", "2", "--volumes", "300", "--iterations", "1"]
    assert "geometry:" not in run(*learn).err
    assert sf.Encoder.load(tmp_path / "model").geometry.stride == 2
    monkeypatch.setattr("streamfeat.learn.sensor.followed", lambda recording: ((260, 346), 580_000))
    monkeypatch.setattr("streamfeat.learn.sensor._SECONDS_A_FILTER", 1e-7)
    assert "--stride 4 --downsample 1, the finest that one core follows" in run(*learn).err
    assert sf.Encoder.load(tmp_path / "model").geometry.stride == 4
    for given in (["--stride", "2"], ["--preset", "fast", "--stride", "2"], ["--downsample", "1"]):
        assert "geometry:" not in run(*learn, *given).err
        assert sf.Encoder.load(tmp_path / "model").geometry.stride == 2
    options = {"filters": 6, "patch": 6, "bins": 2, "volumes": 300, "iterations": 1}
    assert sf.learn_encoder(tmp_path / "train.mcap", **options).geometry.stride == 4
    assert sf.learn_encoder(tmp_path / "train.mcap", stride=2, **options).geometry.stride == 2


def test_a_listener_warns_of_the_camera_that_is_too_much():
    job = ListenJob(PlainNames("robot/*/events"), tiny.encoder())
    session = job._make_session("robot/left/events")
    ticks = itertools.count()
    session._load._clock = lambda: next(ticks) * 1.0
    for i in range(90):
        packet = Packet("", tiny.steady(i * 10_000, (i + 1) * 10_000, 50), tiny.RESOLUTION, 0, 0)
        for _ in session.process(packet):
            pass
    assert job._warnings.counts == {"too much work": 1}
