"""Cameras on the workers of a cluster: each served by one, and by another when that dies."""

import contextlib
import json
import os
import signal
import threading

import pytest
import tiny
from live_net import Collector, compiled, free_port, running, until
from test_live_listen import MODEL, message

pytest.importorskip("distributed", reason="needs the extra `cluster`")

from test_json import check

from streamfeat.cli.rendering import complete
from streamfeat.live.cluster import ClusterListen, ServedCamera
from streamfeat.live.names import PlainNames, RosNames
from streamfeat.live.network import Network, TopicWatch, open_session
from streamfeat.live.publisher import MessagePublisher
from streamfeat.messages.cdr import EventPacket
from streamfeat.work.cluster import local

PACKET_US = 10_000


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    MODEL.save(folder / "model")
    return compiled(folder) / "model"


@pytest.fixture(scope="module")
def two():
    with local(2, 1) as cluster:
        yield cluster


class Camera:
    """Publishes a packet every ten milliseconds until it is closed, and announces itself."""

    def __init__(self, session, key):
        self.sent = 0
        self._publisher = MessagePublisher(session, PlainNames(key), key, EventPacket.SCHEMA_NAME, block=True)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        while not self._over.wait(PACKET_US / 1e6):
            start = 1_000_000 + self.sent * PACKET_US
            self._publisher.put(message(tiny.steady(start, start + PACKET_US, 50, self.sent), self.sent))
            self.sent += 1

    def close(self):
        self._over.set()
        self._thread.join()
        self._publisher.close()


@contextlib.contextmanager
def cameras(session, keys):
    with contextlib.ExitStack() as stack:
        found = [Camera(session, key) for key in keys]
        for camera in found:
            stack.callback(camera.close)
        yield found


def counted(one):
    return sum(one[name] for name in ("packets", "lost", "dropped", "missed", "unheard"))


@pytest.mark.real_time
@pytest.mark.parametrize("keeps_state", [False, True])
def test_cameras_of_a_worker_that_dies_are_served_again(two, model, tmp_path, keeps_state):
    port, keys = free_port(), [f"robot/{i}/events" for i in range(4)]
    state = tmp_path / "state" if keeps_state else None
    lines = []
    options = {"network": Network(port=port), "emit": "10ms", "state": state, "say": lines.append}
    job = ClusterListen(PlainNames("robot/*/events"), two, model, **options)
    until(lambda: len(two.processes()) == 2, "two workers")
    with open_session(port=port) as session, running(job):
        features = Collector(session, "robot/*/features")
        with cameras(session, keys) as publishing:

            def each_since(start):
                return len({key for key, *_ in features.samples[start:]}) == len(keys)

            until(lambda: each_since(0), lambda: f"features of each: {job.result()}")
            until(lambda: all(one.now.get("packets") for one in job.cameras.values()), "counts of each")
            pids = two.processes()
            victim = job.cameras[keys[0]].worker
            mourned = [topic for topic, one in job.cameras.items() if one.worker == victim]
            os.kill(pids[victim], signal.SIGKILL)
            until(lambda: all(job.cameras[topic].starts == 2 for topic in mourned), "others in their place")
            start = len(features.samples)
            until(lambda: each_since(start), lambda: f"features of each again: {job.result()}")
            until(lambda: all(job.cameras[topic].now.get("packets") for topic in mourned), "their counts")
        sent = [camera.sent for camera in publishing]
        until(
            lambda: [counted(job.result()["of_each"][key]) for key in keys] == sent, lambda: f"{job.result()}"
        )
    result = job.result()
    check("listen --cluster", complete("listen --cluster", result))
    assert (result["cameras"], result["restarts"]) == (4, len(mourned))
    assert [counted(result["of_each"][key]) for key in keys] == sent
    for key in keys:
        one = result["of_each"][key]
        assert one["starts"] == (2 if key in mourned else 1)
        assert bool(one["missed"] + one["lost"]) == (key in mourned)
        assert key not in mourned or one["incomplete"] > 0
    if keeps_state:
        assert len(list(state.iterdir())) == 4
    assert len([line for line in lines if "again on worker" in line]) == len(mourned)


@pytest.mark.real_time
def test_topics_are_found_by_their_tokens_alone():
    port, found = free_port(), []
    with (
        open_session(port=port) as session,
        open_session(port=port) as other,
        TopicWatch(session, PlainNames("a/*/events"), found.append),
    ):
        with cameras(other, ["a/1/events", "b/1/events", "a/2/events"]):
            until(lambda: set(found) == {"a/1/events", "a/2/events"})
        names, ros = RosNames("/cam$*/events", 3), []
        with TopicWatch(session, names, ros.append):
            for topic in ("/cam1/events", "/cat/events", "/cam2/events"):
                MessagePublisher(other, RosNames(topic, 3), topic, EventPacket.SCHEMA_NAME)
            until(lambda: set(ros) == {"/cam1/events", "/cam2/events"})


@pytest.mark.real_time
def test_one_camera_without_a_wildcard_needs_no_token_and_a_configuration_goes_along(two, model, tmp_path):
    port, config = free_port(), tmp_path / "client.json5"
    config.write_text(json.dumps({"mode": "client", "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"]}}))
    job = ClusterListen(PlainNames("robot/0/events"), two, model, network=Network(config, 1), emit="10ms")
    with open_session(port=port) as session, running(job):
        publisher = session.declare_publisher("robot/0/events")
        until(lambda: publisher.matching_status.matching, "a subscriber")
        publisher.put(message(tiny.steady(0, PACKET_US, 50), 0))
        until(lambda: job.result()["packets"] == 1, lambda: f"{job.result()}")
    assert job.result()["of_each"]["robot/0/events"]["starts"] == 1


def told(packets, unheard=0, lost=0, **more):
    return {
        "packets": packets,
        "unheard": unheard,
        "lost": lost,
        "dropped": 0,
        "events": 10 * packets,
        **more,
    }


def test_what_a_dead_worker_may_have_lost_is_counted():
    one = ServedCamera()
    one.hear("a", told(0, begins=True))
    one.hear("a", told(10, 5, 1))
    one.hear("b", told(0, begins=True))
    one.hear("b", told(0))
    one.hear("c", told(0, begins=True))
    one.hear("c", told(4, 20))
    one.hear("c", told(6, 20, 2))
    assert (one.starts, one.worker, one.missed, one.first_unheard) == (3, "c", 4, 5)
    assert one.counts() | {"packets": 16, "events": 160, "lost": 3} == one.counts()


def test_what_a_state_has_kept_is_counted_once():
    one = ServedCamera()
    one.hear("a", told(0, begins=True))
    one.hear("a", told(10, 5, 1))
    one.hear("b", told(7, 5, begins=True))
    assert one.counts() | {"packets": 10, "events": 100, "lost": 1} == one.counts()
    one.hear("b", told(9, 5, 10))  # of the 10 the dead one had read 3, and lost 1
    assert (one.missed, one.first_unheard) == (0, 5)
    assert one.counts() | {"packets": 12, "events": 120, "lost": 7} == one.counts()
    one.hear("c", told(10, 5, 12, begins=True))  # kept after the last that was told
    one.hear("c", told(11, 5, 12))
    assert one.missed == 0
    assert one.counts() | {"packets": 14, "events": 140, "lost": 9} == one.counts()
    later = ServedCamera()
    later.hear("c", told(100, 5, begins=True))
    later.hear("c", told(103, 5, 2))
    assert (later.first_unheard, later.missed) == (105, 0)
    assert later.counts() | {"packets": 3, "events": 30, "lost": 2} == later.counts()


def test_a_worker_that_was_given_up_is_not_listened_to():
    one = ServedCamera()
    one.hear("a", told(0, begins=True))
    one.hear("a", told(10))
    one.hear("b", told(0, begins=True))
    one.hear("b", told(5, 12))
    one.hear("a", told(40))
    assert (one.missed, one.counts()["packets"], one.worker) == (2, 15, "b")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--workers", "1", "-o", "x.mcap"), "features and predictions go to the network"),
        (("--workers", "0"), "0 workers cannot do anything"),
        (("--cluster", "tcp://127.0.0.1:1", "--emit", "now"), "no scheduler answers"),
    ],
)
def test_refusals_are_one_line(run, model, options, reason, monkeypatch):
    monkeypatch.setattr("streamfeat.work.cluster._PATIENCE_S", 0.5)
    result = run("listen", "a/*/events", "-m", model, *options)
    assert (result.status, result.err.count("\n")) == (2, 1)
    assert reason in result.err
