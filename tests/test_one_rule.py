"""The same packets, recorded and live: the same features bit for bit, and the same counts."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import tiny
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from live_net import ListSink, compiled, free_port, plain_publisher, plain_session, running, until
from mcap.writer import Writer

from streamfeat.live.inbox import Inbox, RawMessage
from streamfeat.live.intake import Intake
from streamfeat.live.listen import ListenJob
from streamfeat.live.names import Attachment, PlainNames
from streamfeat.live.network import Network
from streamfeat.live.warnings import Warnings
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.codecs import encode
from streamfeat.recordings.reader import open_recording
from streamfeat.stream.cameras import Cameras
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.outputs import Outputs
from streamfeat.stream.session import Session

MODEL = tiny.encoder(k=3)
KEY = "cam/a/events"
STEP_US = 10_000
HOUR_US = 3_600_000_000
HOST_NS = 1_700_000_000_000_000_000
POLICIES = ("10ms", "37ev", "event")


@dataclass
class Sent:
    """One message as it is sent: its publisher's life and number, and when."""

    data: bytes
    life: int
    seq: int
    now_us: int


class Camera:
    """Makes packets of 10 ms each; its clock and its publisher can be disturbed."""

    def __init__(self, encoding, start_us):
        self.encoding, self.t_us = encoding, start_us
        self.now_us = self.life = self.seq = self.made = self.after_us = 0
        self.sent = []

    def packet(self, moved_us=0, moved=slice(0, 0), n=40):
        """The next packet; some of its events, or all, have times that are moved."""
        events = tiny.steady(self.t_us, self.t_us + STEP_US, n, seed=self.made)
        events["t"][moved] += moved_us
        payload, base_ns = encode(events, self.encoding, self.after_us) if n else (b"", self.t_us * 1000)
        if n and self.encoding == "evt3":
            self.after_us = int(events["t"][-1])
        self.put(payload, base_ns)
        self.t_us += STEP_US

    def put(self, payload, base_ns):
        self.now_us += STEP_US
        about = HOST_NS + self.now_us * 1000, "cam", *tiny.RESOLUTION, self.seq, base_ns, self.encoding, False
        self.sent.append(Sent(EventPacket(*about, payload).to_cdr(), self.life, self.seq, self.now_us))
        self.seq += 1
        self.made += 1

    # What can happen, in words.

    def goes_on(self):
        for _ in range(3):
            self.packet()

    def starts_anew(self):
        """Its program is started again, which takes longer than one publisher waits for another."""
        self.t_us, self.seq, self.after_us = 1_000, 0, 0
        self.life += 1
        self.now_us += 600_000

    def falls_back(self):
        self.t_us = max(self.t_us - 5_000_000, 0)
        self.after_us = 0

    def jumps_ahead(self):
        self.t_us += HOUR_US

    def wraps(self):
        self.t_us %= 1 << 31

    def loses_some(self):
        self.seq += 3
        self.t_us += 3 * STEP_US

    def repeats(self):
        if self.sent:
            self.now_us += STEP_US
            self.sent.append(replace(self.sent[-1], now_us=self.now_us))

    def repeats_an_old_one(self):
        if len(self.sent) > 3:
            self.now_us += STEP_US
            self.sent.append(replace(self.sent[-3], now_us=self.now_us))

    def swaps(self):
        self.packet()
        self.packet()
        one, two = self.sent[-2:]
        self.sent[-2:] = replace(two, now_us=one.now_us), replace(one, now_us=two.now_us)

    def has_a_stray_event(self):
        self.packet(2_000_000, slice(20, 21))

    def has_a_stray_packet(self):
        self.packet(30_000_000, slice(None))

    def has_stray_events_at_its_end(self):
        self.packet(3_000_000, slice(-3, None))

    def says_absurd_times(self):
        self.put(encode(tiny.steady(0, 1_000, 20), self.encoding)[0], (1 << 64) - 1)

    def has_nothing_to_say(self):
        self.packet(n=0)

    def sends_rubbish(self):
        self.now_us += STEP_US
        self.sent.append(replace(self.sent[-1], data=b"\0\1\0\0rubbish", now_us=self.now_us))

    def is_silent(self):
        self.now_us += 2_500_000
        self.t_us += 2_500_000


EVERYTHING = [
    *("starts_anew", "falls_back", "jumps_ahead", "loses_some", "repeats", "repeats_an_old_one", "swaps"),
    *("has_a_stray_event", "has_a_stray_packet", "has_stray_events_at_its_end", "says_absurd_times"),
    *("has_nothing_to_say", "is_silent"),
]
ORDERED = [what for what in EVERYTHING if "stray" not in what and "absurd" not in what]
"""What can happen to a camera of an encoding whose times are in order."""


def story(encoding, start_us, happenings):
    """What a camera sends to which this happens, one after the other, with ordinary packets in between."""
    camera = Camera(encoding, start_us)
    camera.goes_on()
    for what in happenings:
        getattr(camera, what)()
        camera.goes_on()
    return camera.sent


def told(emission):
    e = emission
    return e.t_us, e.n_events, e.features.tobytes(), e.final, e.incomplete


def recorded(path, sent, policy):
    """Emissions and counts of a replay."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        channel = writer.register_channel(
            "/events", "cdr", writer.register_schema(EventPacket.SCHEMA_NAME, "ros2msg", b"")
        )
        for i, one in enumerate(sent):
            writer.add_message(channel, HOST_NS + one.now_us * 1000, one.data, HOST_NS, i)
        writer.finish()
    session = Session(MODEL, EmitPolicy.parse(policy))
    with open_recording(path) as recording:
        emissions = [e for item in recording.items() for e in session.process(item)]
        return [told(e) for e in [*emissions, *session.finish()]], dict(recording.counts), session.stats()


def live(sent, policy, *, is_numbered):
    """Emissions and counts of what comes from an inbox, without a network."""
    inbox = Inbox()
    for one in sent:
        arrived_ns = one.now_us * 1000
        attached = Attachment(one.seq + 1, 0, bytes([one.life]) * 16).pack() if is_numbered else b""
        about = KEY, EventPacket.SCHEMA_NAME, one.data, attached
        inbox.put(RawMessage(*about, arrived_ns, HOST_NS + arrived_ns))
    inbox.close()
    intake = Intake(inbox, MODEL.geometry.window_us, Warnings(), silence_s=1e9)
    cameras = Cameras(lambda topic: Session(MODEL, EmitPolicy.parse(policy), topic=topic))
    emissions = [e for item in intake if item is not None for e in cameras.process(item)]
    return [told(e) for e in [*emissions, *cameras.finish()]], dict(intake.counts()), cameras.stats()


happenings = st.one_of(
    st.tuples(st.sampled_from(["mono", "libcaer_cmp"]), st.lists(st.sampled_from(EVERYTHING), max_size=8)),
    st.tuples(st.sampled_from(["libcaer", "evt3"]), st.lists(st.sampled_from(ORDERED), max_size=8)),
)


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(what=happenings, policy=st.sampled_from(POLICIES), start_us=st.sampled_from([5_000, 3 * HOUR_US]))
@example(what=("mono", EVERYTHING), policy="10ms", start_us=5_000)
@example(what=("mono", EVERYTHING[::-1]), policy="event", start_us=5_000)
@example(what=("evt3", ORDERED), policy="10ms", start_us=5_000)
@example(what=("libcaer", ORDERED[::-1]), policy="37ev", start_us=5_000)
@pytest.mark.parametrize("is_numbered", [False, True])
def test_what_is_recorded_and_what_is_heard_are_the_same(
    is_numbered, what, policy, start_us, tmp_path_factory
):
    """Whether numbers are the packets' own, or come with them from a publisher with a name."""
    sent = story(what[0], start_us, what[1])
    path = tmp_path_factory.mktemp("rule") / "a.mcap"
    emissions, counts, stats = recorded(path, sent, policy)
    heard, heard_counts, heard_stats = live(sent, policy, is_numbered=is_numbered)
    assert heard_counts == counts
    assert heard_stats == stats
    assert heard == emissions


def test_a_wrap_is_undone_in_both(tmp_path):
    sent = story("mono", (1 << 31) - 3 * STEP_US, ["wraps"])
    emissions, counts, stats = recorded(tmp_path / "a.mcap", sent, "10ms")
    assert counts == {"wraps": 1}
    assert stats.events == 6 * 40
    assert live(sent, "10ms", is_numbered=False) == (emissions, counts, stats)
    assert emissions[-1][0] > 1 << 31


def test_everything_that_can_happen_is_counted(tmp_path):
    """The streams above do reach each of the counts, so that their being equal says something."""
    found = set()
    for encoding, what in (("mono", EVERYTHING), ("mono", EVERYTHING[::-1]), ("libcaer_cmp", EVERYTHING)):
        found |= set(recorded(tmp_path / "a.mcap", story(encoding, 5_000, what), "10ms")[1])
    assert found == {
        *("restarts", "jumps", "steps back", "lost", "duplicates", "reordered"),
        *("stray packets", "stray events"),
    }


@pytest.mark.parametrize("is_numbered", [False, True])
def test_rubbish_is_refused_in_both_and_the_stream_goes_on(is_numbered, tmp_path):
    sent = story("mono", 5_000, ["sends_rubbish", "sends_rubbish"])
    emissions, counts, _ = recorded(tmp_path / "a.mcap", sent, "10ms")
    heard, heard_counts, stats = live(sent, "10ms", is_numbered=is_numbered)
    # Its number tells that rubbish is a copy, if it came with the message.
    assert heard_counts == counts | ({"duplicates": 2} if is_numbered else {})
    assert [e[:3] for e in heard] == [e[:3] for e in emissions]
    assert stats.events == 9 * 40


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    MODEL.save(folder / "model")
    return compiled(folder)


@pytest.mark.real_time
def test_features_over_zenoh_are_those_of_the_recording(files, tmp_path):
    what = [one for one in EVERYTHING if one != "is_silent"]
    sent = story("mono", 5_000, what) + [
        replace(one, now_us=one.now_us + 10_000_000)
        for one in story("mono", (1 << 31) - 3 * STEP_US, ["wraps"])
    ]
    emissions, counts, stats = recorded(tmp_path / "a.mcap", sent, "10ms")
    port, sink = free_port(), ListSink()
    options = {"silence_s": 1e9, "patience_s": 1e9, "max_delay_s": 1e9, "network": Network(port=port)}
    job = ListenJob(PlainNames("cam/*/events"), files / "model", emit="10ms", **options)
    with (
        plain_session(port, listen=True) as net,
        running(job, Outputs(more=sink)),
        plain_publisher(net, KEY) as camera,
    ):
        for one in sent:
            camera.put(one.data)
        until(
            lambda: (d := job._intake.delivery()).received + d.duplicates == len(sent), job._intake.delivery
        )
    assert dict(job._intake.counts()) == counts
    assert job.session_stats() == stats
    assert [told(e) for e in sink.emissions] == emissions
    assert np.frombuffer(emissions[-1][2], np.float32).any()
