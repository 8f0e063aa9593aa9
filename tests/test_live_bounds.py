"""Whatever the network sends has a bound, is counted and shown, and one bad item leaves the others alone."""

import json
import time
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import zenoh
from live_net import ListSink, attachment, compiled, free_port, plain_publisher, plain_session, running, until
from test_live_listen import MODEL, listener, message

from streamfeat.files.json_fields import Fields
from streamfeat.live import intake as intake_module
from streamfeat.live import record as record_module
from streamfeat.live import subscription as subscription_module
from streamfeat.live.inbox import Announcement, Inbox, RawMessage
from streamfeat.live.intake import Intake
from streamfeat.live.names import PlainNames, RosNames
from streamfeat.live.network import Network
from streamfeat.live.publisher import OutputSink
from streamfeat.live.record import RecordJob
from streamfeat.live.refusals import MAX_NAME, problem_of
from streamfeat.live.subscription import Subscription
from streamfeat.live.topic import MAX_TOPICS
from streamfeat.live.warnings import Warnings
from streamfeat.messages.cdr import EventPacket, FeaturesMessage, LabelMessage
from streamfeat.messages.clock import CameraClock, Placement
from streamfeat.messages.codecs import encode
from streamfeat.messages.packets import MAX_STREAM_US, Label, Packet
from streamfeat.stream.cameras import MAX_CAMERAS, CameraLeft, Cameras
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.outputs import Outputs
from streamfeat.stream.session import Session

SECOND_NS = 1_000_000_000
GID = b"0123456789abcdef"


class Listening:
    """An intake and its cameras, without a network."""

    def __init__(self, **options):
        self.inbox, self.warnings, self.items = Inbox(), Warnings(), []
        self.intake = Intake(self.inbox, MODEL.geometry.window_us, self.warnings, silence_s=1e9, **options)
        self.cameras = Cameras(
            lambda topic: Session(MODEL, EmitPolicy.parse("10ms"), topic=topic),
            on_refusal=lambda topic, reason, error: self.warnings.add(reason, topic, error),
        )

    def take(self, *messages):
        """What cameras make of some messages."""
        for one in messages:
            self.inbox.put(one)
        got = []
        for one in self.inbox.take(0) or []:
            for item in self.intake._items(one):
                self.items.append(item)
                got += self.cameras.process(item)
        return got


def packet(topic, start_us=10_000, number=1, gid=GID, ago_s=0.0, **changes):
    data = message(tiny.steady(start_us, start_us + 10_000, 20), number, **changes)
    arrived_ns = time.monotonic_ns() - int(ago_s * SECOND_NS)
    return RawMessage(topic, EventPacket.SCHEMA_NAME, data, attachment(number, gid), arrived_ns, 0)


def label(topic, start_ns=10_000_000, duration_ns=10**7, text="cat"):
    data = LabelMessage(start_ns, "", duration_ns, text, "", "").to_cdr()
    return RawMessage(topic, LabelMessage.SCHEMA_NAME, data, b"", 0, 0)


# --- names


@pytest.mark.parametrize(
    ("key", "topic", "size", "reason"),
    [
        ("cam/a/events", "cam/a/events", 100, ""),
        ("cam/*/events", "cam/*/events", 100, "wildcard key"),
        ("cam/**", "cam/**", 100, "wildcard key"),
        ("0/type/hash", "/", 100, "bad name"),
        ("a" * (MAX_NAME + 1), "a" * (MAX_NAME + 1), 100, "bad name"),
        ("a" * MAX_NAME, "a" * MAX_NAME, 100, ""),
        ("cam/a/events", "cam/a/events", (4 << 20) + 1, "too large"),
    ],
)
def test_what_is_refused_before_its_bytes_are_looked_at(key, topic, size, reason):
    assert problem_of(key, topic, size) == reason


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    MODEL.save(folder / "model")
    return compiled(folder)


@pytest.mark.real_time
def test_a_put_on_a_wildcard_reaches_no_camera(files):
    port, sink = free_port(), ListSink()
    job = listener(files, emit="10ms", network=Network(port=port), classifier=False)
    with (
        plain_session(port, listen=True) as net,
        running(job, Outputs(more=sink)),
        plain_publisher(net, "cam/a/events") as camera,
    ):
        net.put("cam/*/events", message(tiny.steady(10_000, 20_000, 50)), attachment=attachment(1))
        net.put("cam/*/label", LabelMessage(0, "", 10**6, "cat", "", "").to_cdr())
        camera.put(message(tiny.steady(10_000, 30_000, 50)), attachment=attachment(1))
        until(lambda: job.result()["events"] == 50 and job.result()["warnings"].get("wildcard key"))
    assert job.result()["cameras"] == 1
    assert {e.topic for e in sink.emissions} == {"cam/a/events"}


@pytest.mark.real_time
def test_a_put_on_a_bare_type_does_not_end_a_ros_listener(files):
    from streamfeat.live.listen import ListenJob

    port, names = free_port(), RosNames("/**")
    options = {"silence_s": 1e9, "patience_s": 1e9, "max_delay_s": 1e9, "network": Network(port=port)}
    job = ListenJob(names, files / "model", emit="10ms", **options)
    good, bare = (
        names.key("/cam/events", EventPacket.SCHEMA_NAME),
        "0/event_camera_msgs::msg::dds_::EventPacket_",
    )
    with (
        plain_session(port, listen=True) as net,
        running(job),
        plain_publisher(net, good) as camera,
    ):
        net.put(f"{bare}/RIHS01_x", message(tiny.steady(10_000, 50_000, 50)), attachment=attachment(1))
        camera.put(message(tiny.steady(10_000, 50_000, 50)), attachment=attachment(1))
        until(lambda: job.result()["events"] == 50 and job.result()["warnings"].get("bad name") == 1)
    assert job.result()["cameras"] == 1


def test_two_cameras_with_one_name_for_their_outputs():
    job = Listening()
    job.take(packet("robot/cam/events"), packet("robot/cam"), packet("robot/cam2"))
    assert job.cameras.topics == ["robot/cam/events", "robot/cam2"]
    assert job.warnings.counts == {"one name for two outputs": 1}


def test_escape_sequences_of_names_do_not_reach_the_terminal():
    lines = []
    Warnings(lines.append).add("unknown type", "cam/\x1b[2J\n" + "x" * 5000, "a\rb")
    (line,) = lines
    assert line.isprintable()
    assert len(line) < 400


# --- places


def test_a_plain_key_that_fell_silent_gives_its_place_to_a_new_one():
    job = Listening()
    for i in range(MAX_CAMERAS):
        job.take(packet(f"cam/{i}/events", ago_s=75 - i / 100))
    job.take(packet("cam/new/events"))
    assert not job.warnings.counts
    assert "cam/new/events" in job.cameras.topics
    assert len(job.cameras.topics) == MAX_CAMERAS
    assert [item.topic for item in job.items if isinstance(item, CameraLeft)] == ["cam/0/events"]
    # The one that lost its place has another as soon as it is heard.
    job.take(packet("cam/0/events", 20_000, 2))
    assert "cam/0/events" in job.cameras.topics
    assert "cam/1/events" not in job.cameras.topics


def test_cameras_that_are_heard_keep_their_places():
    job = Listening()
    for i in range(MAX_CAMERAS + 3):
        job.take(packet(f"cam/{i}/events", ago_s=30))
    assert len(job.cameras.topics) == MAX_CAMERAS
    assert job.warnings.counts == {"too many cameras": 3}


def test_names_of_rubbish_take_no_place():
    job = Listening()
    for i in range(2 * MAX_TOPICS):
        job.take(RawMessage(f"bad/{i}", EventPacket.SCHEMA_NAME, b"rubbish", attachment(1), 0, 0))
    assert not job.intake.topics
    assert job.warnings.counts == {"bad packet": 2 * MAX_TOPICS}


def test_cameras_that_come_and_go_leave_nothing_behind():
    job = Listening()
    for i in range(600):
        topic = f"cam/{i}/events"
        job.take(Announcement(topic, here=True), packet(topic, ago_s=61), Announcement(topic, here=False))
        for item in job.intake._releases(1.0):
            list(job.cameras.process(item))
        for item in job.intake._releases(1.0):
            list(job.cameras.process(item))
        assert not job.cameras.topics
    intake = job.intake
    assert len(intake.topics) == len(intake._outputs) == MAX_TOPICS
    assert not [*intake._leaving, *intake._awaited, *intake._early]
    assert intake.delivery().received == job.cameras.seen == 600
    assert job.cameras.stats().events == 600 * 20


# --- one bad item


def test_a_camera_at_the_end_of_time_wraps_and_the_others_go_on():
    """It steps up to the latest time that a message stamp can hold, then by its period beyond."""
    job = Listening()
    top, period = MAX_STREAM_US - 50_000, 1 << 31
    times = [top - period, top, top + 10_000, top - period + 60_000, top - period + 70_000]
    got = []
    for number, start_us in enumerate(times, 1):
        got += job.take(packet("cam/bad/events", start_us, number))
        got += job.take(packet("cam/good/events", 10_000 * number, number))
    got += job.cameras.finish()
    for emission in got:
        FeaturesMessage(emission.t_us * 1000, "", 0, emission.features).to_cdr()
    assert {e.topic for e in got} == {"cam/bad/events", "cam/good/events"}
    assert job.cameras.stats().events == 10 * 20
    assert job.intake.counts() == {"jumps": 1, "restarts": 1}
    assert job.warnings.counts == {"clock jumped": 1, "clock restarted": 1}


def test_a_clock_that_wraps_led_beyond_the_end_of_time_starts_anew():
    clock = CameraClock()
    clock.reached_us, clock.offset_us = MAX_STREAM_US - 10, 1 << 31
    t_us = MAX_STREAM_US - (1 << 31)
    assert clock.place(t_us - 5, t_us, 0).event == ""
    assert clock.place(t_us + 5, t_us + 20, 0) == Placement(0, 1, "restarted")


def test_times_beyond_those_of_message_stamps_are_left_out():
    job = Listening()
    events = tiny.steady(10_000, 20_000, 20)
    payload, _ = encode(events, "mono")
    job.take(packet("cam/a/events"))
    for number, base in ((2, (MAX_STREAM_US + 1) * 1000), (3, (1 << 64) - 1)):
        job.take(packet("cam/a/events", number=number, events=payload, time_base=base))
    job.take(packet("cam/a/events", 30_000, 4))
    assert job.intake.counts() == {"stray packets": 2}
    packets = [item for item in job.items if isinstance(item, Packet)]
    assert [p.lost for p in packets] == [0, 2]
    assert job.cameras.stats().events == 40


@pytest.mark.parametrize(
    "bad",
    [
        {"start_ns": -30 * SECOND_NS},
        {"start_ns": 2**31 * SECOND_NS - 1, "duration_ns": 10**9},
        {"duration_ns": 2 * 3600 * SECOND_NS},
        {"text": "x" * 5000},
    ],
    ids=str,
)
def test_a_label_that_cannot_be_is_refused_alone(bad):
    if bad.get("start_ns", 0) < 0:
        data = bytearray(label("cam/a/label").payload)
        data[4:8] = (-30).to_bytes(4, "little", signed=True)
        one = RawMessage("cam/a/label", LabelMessage.SCHEMA_NAME, bytes(data), b"", 0, 0)
    else:
        one = label("cam/a/label", **bad)
    job = Listening()
    job.take(one, packet("cam/a/events"), one, packet("cam/a/events", 20_000, 2))
    assert not any(isinstance(item, Label) for item in job.items)
    assert job.warnings.counts == {"bad label": 2}
    assert job.cameras.stats().events == 40


def test_a_label_far_ahead_is_warned_of():
    job = Listening()
    job.take(packet("cam/a/events"), label("cam/a/label", 2 * SECOND_NS))  # the next sample of a data set
    assert job.warnings.counts == {}
    job.take(label("cam/a/label", 59 * SECOND_NS))
    assert job.warnings.counts == {"label ahead": 1}
    job.take(label("cam/a/label", 62 * SECOND_NS))
    assert job.warnings.counts == {"label ahead": 1, "bad label": 1}


def test_an_emission_that_cannot_be_published_is_counted_and_the_others_are():
    port, refused, published = free_port(), [], []
    with plain_session(port, listen=True) as net:
        sink = OutputSink(
            net,
            PlainNames("cam/*/events"),
            lambda source_ns, now_ns: published.append(source_ns),
            lambda topic, error: refused.append((topic, error)),
        )
        features = np.zeros(4, np.float32)
        about = {"labels": (), "scores": np.zeros(0, np.float32), "sample": None, "final": False}
        emissions = [
            Emission(t_us=t_us, n_events=1, features=features, topic="cam/a/events", source_ns=i, **about)
            for i, t_us in enumerate((5, -5, 1 << 60, 6))
        ]
        sink.write(emissions)
        sink.close(failed=False)
    assert published == [0, 3]
    assert [topic for topic, _ in refused] == ["cam/a/events"] * 2


def test_what_was_taken_in_can_be_kept_and_gone_on_from():
    """Numbers and stamps at their limits: the next start must not refuse what this one has written."""
    job = Listening()
    data = bytearray(packet("cam/a/events", as_="evt3").payload)
    data[4:8] = (-7).to_bytes(4, "little", signed=True)
    raw = RawMessage("cam/a/events", EventPacket.SCHEMA_NAME, bytes(data), attachment(2**63 - 1), 0, 0)
    job.take(raw, packet("b" * MAX_NAME))
    assert job.intake.delivery().received == 2
    other = Listening()
    for topic, values in job.intake.snapshot().items():
        assert len(topic) <= MAX_NAME
        other.intake.restore(topic, Fields(json.loads(json.dumps(values)), topic), 0)
    assert other.intake.delivery() == job.intake.delivery()


# --- tokens


def token(key, kind=zenoh.SampleKind.PUT):
    return SimpleNamespace(key_expr=key, kind=kind)


def test_tokens_without_end_are_refused_and_counted():
    inbox = Inbox()
    with (
        plain_session(free_port(), listen=True) as net,
        Subscription(net, PlainNames("cam/*/events"), inbox) as subscription,
    ):
        names = [f"cam/{i}/events/@events/{i:032x}" for i in range(20_000)]
        for name in names:
            subscription._on_token(token(name))
        assert subscription._n_tokens == sum(map(len, subscription._tokens.values())) == 1 << 14
        assert inbox.depth == 4096
        assert inbox.refused == (20_000 - (1 << 14)) + (1 << 14) - 4096
        subscription._on_token(token("cam/" + "x" * 5000 + "/events/@events/00"))
        assert inbox.refused == 20_000 - 4096 + 1
        for name in names:
            subscription._on_token(token(name, zenoh.SampleKind.DELETE))
        assert subscription._n_tokens == 0
        assert not subscription._tokens


@pytest.mark.real_time
def test_ten_thousand_announced_cameras_are_followed_in_part_and_left_at_once():
    inbox = Inbox()
    with plain_session(free_port(), listen=True) as net:
        subscription = Subscription(net, PlainNames("cam/*/events"), inbox, announced=True)
        for i in range(10_000):
            subscription._on_token(token(f"cam/{i}/events/@events/{i:032x}"))
        started = time.monotonic()
        subscription.close()
        assert time.monotonic() - started < 2.0
        assert not subscription._follower.is_alive()
    assert inbox.refused >= 10_000 - 4096


@pytest.mark.real_time
def test_a_follower_follows_no_more_than_its_places_and_gives_them_back(monkeypatch):
    monkeypatch.setattr(subscription_module, "MAX_TOPICS", 3)
    inbox, subscribed = Inbox(), []
    with plain_session(free_port(), listen=True) as net:
        with Subscription(net, PlainNames("cam/*/events"), inbox, announced=True) as subscription:
            honest = subscription._subscribe

            def subscribe(expression):
                subscribed.append(expression)
                return honest(expression)

            monkeypatch.setattr(subscription, "_subscribe", subscribe)
            names = [f"cam/{i}/events/@events/00" for i in range(6)]
            for name in names[:5]:
                subscription._on_token(token(name))
            until(lambda: inbox.refused == 2, lambda: inbox.refused)
            subscription._on_token(token(names[0], zenoh.SampleKind.DELETE))
            subscription._on_token(token(names[5]))
            until(lambda: "cam/5/events" in subscribed, lambda: subscribed)
        assert [one for one in subscribed if one.endswith("events")] == [
            f"cam/{i}/events" for i in (0, 1, 2, 5)
        ]


# --- recording


def test_topics_of_a_file_are_bounded(monkeypatch, tmp_path):
    monkeypatch.setattr(record_module, "_MAX_WRITTEN", 5)
    job = RecordJob(PlainNames("cam/**"), tmp_path / "a.mcap")
    for i in range(20):
        one = label(f"cam/{i}/label")
        if job._is_wanted(one):
            job._written[one.topic] += 1
    assert len(job._written) == 5
    assert job._warnings.counts == {"too many topics": 15}


def test_topics_that_are_recorded_give_their_places_back(monkeypatch, tmp_path):
    monkeypatch.setattr(record_module, "MAX_TOPICS", 5)
    job = RecordJob(PlainNames("cam/**"), tmp_path / "a.mcap")
    assert all(job._is_wanted(packet(f"cam/{i}/events")) for i in range(20))
    assert len(job._topics) == 5
    assert job.result()["lost"] == 0
    assert not job._warnings.counts
    assert intake_module.MAX_TOPICS == MAX_TOPICS
