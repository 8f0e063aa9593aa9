"""Several cameras side by side: each as if it were alone, made when it appears, released when it leaves."""

from dataclasses import replace

import numpy as np
import tiny

from streamfeat.engine.geometry import Geometry
from streamfeat.errors import InputError
from streamfeat.messages.packets import Watermark
from streamfeat.stream.cameras import CameraLeft, Cameras
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session

MODEL = tiny.encoder(k=3)
CLASSIFIER = tiny.classifier(MODEL)


def make_session(topic):
    return Session(MODEL, EmitPolicy.parse("10ms"), CLASSIFIER, topic=topic)


def run(items, cameras):
    return [e for item in items for e in cameras.process(item)]


def of_topic(items, topic):
    return [replace(item, topic=topic) for item in items]


def test_each_camera_is_read_as_if_it_were_alone():
    streams = {topic: of_topic(tiny.labelled_items(3 + i), topic) for i, topic in enumerate("abc")}
    rng = np.random.default_rng(0)
    order = rng.permutation([topic for topic, items in streams.items() for _ in items])
    waiting = {topic: iter(items) for topic, items in streams.items()}
    cameras = Cameras(make_session)
    emissions = run([next(waiting[topic]) for topic in order], cameras) + list(cameras.finish())
    for topic, items in streams.items():
        alone = make_session(topic)
        expected = [e for item in items for e in alone.process(item)] + list(alone.finish())
        mine = [e for e in emissions if e.topic == topic]
        assert [e.t_us for e in mine] == [e.t_us for e in expected]
        assert all(np.array_equal(a.features, b.features) for a, b in zip(mine, expected, strict=True))
    stats = cameras.stats()
    assert (stats.events, stats.samples, stats.emissions) == (300 * 12, 12, len(emissions))
    assert stats.correct == sum(bool(e.correct) for e in emissions if e.final)
    assert cameras.topics == []


def test_who_leaves_is_read_once_more_and_forgotten():
    cameras = Cameras(make_session)
    run([replace(tiny.packet(tiny.steady(0, 5_000, 50)), topic="a")], cameras)
    assert cameras.topics == ["a"]
    (last,) = run([CameraLeft("a")], cameras)
    assert (last.topic, last.n_events) == ("a", 50)
    assert cameras.topics == []
    assert run([CameraLeft("a"), Watermark("a", 10**9)], cameras) == []
    run([replace(tiny.packet(tiny.steady(0, 5_000, 50)), topic="a")], cameras)
    assert (cameras.seen, cameras.stats().events) == (2, 100)


def test_more_cameras_than_there_is_room_for():
    told = []
    cameras = Cameras(make_session, limit=3, on_refusal=lambda *what: told.append(what))
    packets = [replace(tiny.packet(tiny.stream([5])), topic=topic) for topic in "abcdea"]
    run(packets, cameras)
    assert cameras.topics == ["a", "b", "c"]
    assert [topic for topic, *_ in told] == ["d", "e"]
    assert cameras.refused == {"too many cameras": 2}
    run([CameraLeft("b"), packets[3]], cameras)
    assert cameras.topics == ["a", "c", "d"]


def test_a_packet_that_cannot_be_used_costs_its_camera_no_more_than_its_window(monkeypatch):
    grid_shape = Geometry.grid_shape

    def refusing(self, resolution):
        if resolution == (2, 2):
            raise InputError("so many volumes that sums could overflow")
        return grid_shape(self, resolution)

    monkeypatch.setattr(Geometry, "grid_shape", refusing)
    cameras = Cameras(make_session)
    good = replace(tiny.packet(tiny.steady(0, 5_000, 50)), topic="a")
    bad = replace(tiny.packet(tiny.stream([6_000], resolution=(2, 2)), (2, 2)), topic="a")
    run([good, bad, replace(good, topic="b"), good], cameras)
    assert cameras.refused == {"unusable": 1}
    assert cameras.stats().events == 150
    assert cameras.topics == ["b", "a"]


def test_cameras_work_ahead_in_turns_while_there_is_time():
    now, rested = [0.0], []

    class Slow(Session):
        def rest(self):
            rested.append(self._topic)
            now[0] += 0.0006

    cameras = Cameras(lambda topic: Slow(MODEL, EmitPolicy.parse("10ms"), topic=topic), clock=lambda: now[0])
    cameras.rest()
    run([replace(tiny.packet(tiny.steady(0, 5_000, 50)), topic=topic) for topic in "abc"], cameras)
    for _ in range(3):
        cameras.rest()
    assert sorted(rested) == sorted("abc" * 2)
    assert len(set(rested[:3])) == 3
    now[0] += 1.0
    rested.clear()
    run([CameraLeft("a"), CameraLeft("b")], cameras)
    cameras.rest()
    assert rested == ["c"]
