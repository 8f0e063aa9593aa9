"""Shares of the cameras: which they are, and processes that serve them on real zenoh sessions."""

import json
import subprocess
import sys
from contextlib import ExitStack, contextmanager, suppress
from itertools import count

import pytest
import zenoh
from live_net import Collector, ListSink, attachment, compiled, free_port, plain_session, running, until
from test_live_listen import CLASSIFIER, MODEL, batches, listener, message

from streamfeat.errors import InputError
from streamfeat.files.safetensors_file import read_safetensors
from streamfeat.live.listen import ListenJob
from streamfeat.live.names import RosNames
from streamfeat.live.network import Network, open_session
from streamfeat.live.publisher import MessagePublisher
from streamfeat.live.shard import Shard
from streamfeat.messages.cdr import EventPacket, LabelMessage
from streamfeat.stream.outputs import Outputs

# --- which share


SHARES = {
    "cam/a": (0, 1, 1, 3, 4),
    "cam/b": (0, 0, 0, 0, 5),
    "cam/e": (0, 1, 2, 3, 2),
    "robot/cam0": (0, 0, 0, 2, 2),
    "robot/cam1": (0, 1, 1, 1, 0),
    "robot/cam2": (0, 0, 2, 0, 2),
    "/camera": (0, 0, 1, 0, 4),
    "kamera/ü": (0, 0, 1, 0, 0),
    "": (0, 0, 0, 0, 0),
}
"""Of 1, 2, 3, 4 and 7: what processes that run today have to agree on with those of next year."""


@pytest.mark.parametrize("camera", SHARES)
def test_a_camera_has_the_share_that_it_always_had(camera):
    for of, index in zip((1, 2, 3, 4, 7), SHARES[camera], strict=True):
        for topic in (camera, f"{camera}/events", f"{camera}/label"):
            assert [i for i in range(of) if Shard(i, of).has(topic)] == [index], topic


def test_shares_are_even():
    sizes = [sum(Shard(i, 4).has(f"robot/cam{n}/events") for n in range(4000)) for i in range(4)]
    assert sum(sizes) == 4000
    assert min(sizes) > 900


@pytest.mark.parametrize(
    "text",
    [
        "3/3",
        "0/0",
        "x",
        "",
        "/",
        "1",
        "1/",
        "/2",
        "-1/2",
        "+0/2",
        "0/2/4",
        " 0/2",
        "0.5/2",
        "¹/2",
        "9" * 5000,
    ],
)
def test_what_is_no_share_is_said_in_one_line(text):
    with pytest.raises(InputError, match=r"^--shard .*$") as said:
        Shard.parse(text)
    assert len(str(said.value)) < 150
    assert Shard.parse("2/3") == Shard(2, 3)


# --- processes that serve them


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    MODEL.save(folder / "model")
    CLASSIFIER.save(folder / "classifier")
    return compiled(folder)


class Cameras:
    """Cameras without a token, and the features that are published beside them."""

    def __init__(self, net, names):
        self._net = net
        self.sent = dict.fromkeys(names, 0)
        self.outputs = Collector(net, "cam/*/features")

    def _put(self, key, payload, **more):
        self._net.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK, **more)

    def put(self, name):
        """One packet more of a stream that never ends."""
        i = self.sent[name]
        (events,) = batches(1, events=20, start_us=10_000 * (i + 1))
        gid = name.encode().ljust(16, b"-")
        self._put(f"cam/{name}/events", message(events, i), attachment=attachment(i + 1, gid))
        self.sent[name] += 1

    def put_unannounced(self):
        """A packet of a camera without a token."""
        self._put("cam/unannounced/events", message(batches(1)[0]), attachment=attachment(1, b"u" * 16))

    def label(self, name):
        """A label for what comes next."""
        label = LabelMessage(10_000_000 * (self.sent[name] + 1), "", 10**9, "cat", "", "")
        self._put(f"cam/{name}/label", label.to_cdr(), encoding=f"application/cdr;{label.SCHEMA_NAME}")

    def served(self, name):
        """Numbers and publishers of all features beside a camera."""
        key = f"cam/{name}/features"
        return [
            (int.from_bytes(a[:8], "little"), a[17:]) for k, _, a, _ in [*self.outputs.samples] if k == key
        ]

    def until_served(self, names):
        """Put packets until features come of them."""

        def has_come(name, before):
            self.put(name)
            return len(self.served(name)) > before

        for name in names:
            before = len(self.served(name))
            until(lambda name=name, n=before: has_come(name, n), f"features of {name}")


def own(shard, names):
    return [name for name in names if shard.has(f"cam/{name}")]


@pytest.mark.real_time
def test_every_camera_is_served_exactly_once(files):
    """With labels, which go where their camera goes; what the others leave out is counted, and not lost."""
    port, names = free_port(), "abcdefgh"
    shards = [Shard(i, 3) for i in range(3)]
    sinks = [ListSink() for _ in shards]
    jobs = [
        listener(files, emit="10ms", network=Network(port=port), shard=shard, learn_online=True)
        for shard in shards
    ]
    with plain_session(port, listen=True) as net, ExitStack() as stack:
        for job, sink in zip(jobs, sinks, strict=True):
            stack.enter_context(running(job, Outputs(more=sink)))
        cameras = Cameras(net, names)
        cameras.until_served(names)
        heard = dict(cameras.sent)
        for name in names:
            cameras.label(name)
            for _ in range(10):
                cameras.put(name)

        def all_is_there(job, shard):
            result = job.result()
            return result["packets"] + result["unheard"] == sum(
                cameras.sent[name] for name in own(shard, names)
            )

        for job, shard in zip(jobs, shards, strict=True):
            until(lambda one=(job, shard): all_is_there(*one), lambda job=job: f"all packets: {job.result()}")
        until(lambda: all(len(cameras.served(name)) > 5 for name in names), "their features")
        served = {name: cameras.served(name) for name in names}
    for job, shard, sink in zip(jobs, shards, sinks, strict=True):
        mine = {f"cam/{name}/events" for name in own(shard, names)}
        assert mine
        assert {e.topic for e in sink.emissions} == mine
        assert {e.topic for e in sink.emissions if e.sample and e.sample.label == "cat"} == mine
        result = job.result()
        assert result["cameras"] == len(mine)
        assert (result["lost"], result["dropped"], result["foreign"]) == (0, 0, 0)
        assert "bad label" not in result["warnings"]
        # From when all hear all: ten packets and a label of each of the others.
        others = [name for name in names if name not in own(shard, names)]
        sent = sum(cameras.sent[name] + 1 for name in others)
        assert sent - sum(heard[name] for name in others) <= result["other_shards_packets"] <= sent
    for name in names:
        numbers = [number for number, _ in served[name]]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert len({publisher for _, publisher in served[name]}) == 1


@pytest.mark.real_time
def test_cameras_that_announce_themselves_are_heard_and_nobody_else(files):
    """Each process asks for its own cameras alone; one that comes back later is heard again."""
    port, names = free_port(), "abcdef"
    shards = [Shard(i, 2) for i in range(2)]
    jobs = [
        listener(
            files, emit="10ms", network=Network(port=port), classifier=False, shard=shard, announced=True
        )
        for shard in shards
    ]
    with plain_session(port, listen=True) as net, ExitStack() as stack:
        for job in jobs:
            stack.enter_context(running(job))
        cameras = Cameras(net, names)
        for _ in range(2):
            with ExitStack() as tokens:
                for name in names:
                    token = f"cam/{name}/events/@events/{name.encode().hex()}"
                    tokens.enter_context(net.liveliness().declare_token(token))
                # What somebody makes up is nobody's camera.
                for token in ("cam/*/events/@events/00", "cam/z$*/events/@events/00"):
                    with suppress(zenoh.ZError):
                        tokens.enter_context(net.liveliness().declare_token(token))
                for _ in range(20):
                    cameras.put_unannounced()
                cameras.until_served(names)
            until(lambda: not any(job._cameras.topics for job in jobs), "the cameras' end")
    for job, shard in zip(jobs, shards, strict=True):
        mine = {f"cam/{name}/events" for name in own(shard, names)}
        assert set(job._intake.topics) == mine
        result = job.result()
        assert result["cameras"] == 2 * len(mine)
        assert "other_shards_packets" not in result


@pytest.mark.real_time
def test_a_ros_camera_that_announces_itself_is_heard(files):
    port, sink, asked = free_port(), ListSink(), RosNames("/cam/*/events")
    job = ListenJob(
        asked, files / "model", emit="10ms", network=Network(port=port), announced=True, silence_s=1e9
    )
    names = RosNames("/cam/a/events")
    with open_session(port=port) as net, running(job, Outputs(more=sink)):
        others = RosNames("/other/events")
        cameras = [
            MessagePublisher(net, one, one.expression, EventPacket.SCHEMA_NAME, block=True)
            for one in (names, others)
        ]
        sent = count(1)

        def heard():
            i = next(sent)
            data = message(batches(1, events=20, start_us=10_000 * i)[0], i)
            for camera in cameras:
                camera.put(data)
            return len(sink.emissions) > 2

        until(heard, lambda: f"readings: {job.result()}")
        for camera in cameras:
            camera.close()
    assert set(job._intake.topics) == {"/cam/a/events"}


LISTENER = """
import json, sys
from pathlib import Path
from streamfeat.live.listen import ListenJob
from streamfeat.live.names import PlainNames
from streamfeat.live.network import Network
from streamfeat.live.shard import Shard
model, state, port, shard = sys.argv[1:]
never = dict(silence_s=1e9, patience_s=1e9, max_delay_s=1e9, state_every_s=0.02)
job = ListenJob(
    PlainNames("cam/*/events"), Path(model), emit="10ms", network=Network(port=int(port)), state=Path(state),
    shard=Shard.parse(shard), **never,
)
job.run()
print(json.dumps(job.result() | {"topics": job._cameras.topics}))
"""


@contextmanager
def process(*words):
    one = subprocess.Popen(
        [sys.executable, "-c", LISTENER, *map(str, words)], stdout=subprocess.PIPE, text=True
    )
    try:
        yield one
    finally:
        one.kill()
        one.communicate()


def kept(path):
    """Topics in a state file, and the number that each waits for."""
    if not path.exists():
        return {}
    _, header = read_safetensors(path, "state", 1)
    return {topic["topic"]: topic["delivery"]["next"] for topic in header["topics"]}


def until_kept(path, names, cameras):
    """Wait until a state is that after all that was sent."""

    def is_kept():
        topics = kept(path)
        return all(topics.get(f"cam/{name}/events") == cameras.sent[name] + 1 for name in names)

    until(is_kept, lambda: f"the state of all: {kept(path)}, {cameras.sent}")


def ended(one):
    one.terminate()
    text, _ = one.communicate(timeout=60)
    return json.loads(text)


@pytest.mark.real_time
def test_a_process_that_is_killed_and_started_again_takes_up_its_own_cameras(files, tmp_path):
    port, names = free_port(), "abcf"
    first, second = Shard(0, 2), Shard(1, 2)
    states = tmp_path / "0.state", tmp_path / "1.state"
    words = [(files / "model", state, port, f"{i}/2") for i, state in enumerate(states)]
    mine, others = own(second, names), own(first, names)
    assert (mine, others) == (["a", "c"], ["b", "f"])
    with plain_session(port, listen=True) as net, process(*words[0]) as one:
        cameras = Cameras(net, names)
        with process(*words[1]) as two:
            cameras.until_served(names)
            until_kept(states[1], mine, cameras)
            two.kill()
            two.wait()
        before = {name: len(cameras.served(name)) for name in mine}
        # Nobody takes its place: the others' cameras are served as before.
        cameras.until_served(others)
        assert {name: len(cameras.served(name)) for name in mine} == before
        with process(*words[1]) as two:
            cameras.until_served(mine)
            cameras.until_served(others)
            until_kept(states[0], others, cameras)
            until_kept(states[1], mine, cameras)
            results = ended(one), ended(two)
        assert set(kept(states[0])) == {f"cam/{name}/events" for name in others}
        assert set(kept(states[1])) == {f"cam/{name}/events" for name in mine}
    for result, own_names in zip(results, (others, mine), strict=True):
        assert result["cameras"] == 2
        assert (result["foreign"], result["restarts"], result["dropped"], result["duplicates"]) == (
            0,
            0,
            0,
            0,
        )
        # All that was sent is accounted for: nobody's packets are counted as lost but what came meanwhile.
        sent = sum(cameras.sent[name] for name in own_names)
        assert result["packets"] + result["unheard"] + result["lost"] == sent
    assert results[0]["lost"] == 0


@pytest.mark.real_time
def test_what_another_shard_serves_by_now_is_left_in_the_state(files, tmp_path):
    """Three shares where there were two: nobody goes on with a camera that is another's."""
    port, state, names = free_port(), tmp_path / "state", "abcf"
    job = listener(
        files, emit="10ms", network=Network(port=port), classifier=False, state=state, state_every_s=0.02
    )
    with plain_session(port, listen=True) as net, running(job):
        cameras = Cameras(net, names)
        cameras.until_served(names)
    assert len(kept(state)) == len(names)
    shard = Shard(1, 2)
    again = listener(files, emit="10ms", classifier=False, state=state, shard=shard)
    assert (
        sorted(again._intake.topics)
        == again._cameras.topics
        == [f"cam/{n}/events" for n in own(shard, names)]
    )
