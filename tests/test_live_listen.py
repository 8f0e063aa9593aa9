"""Listening on real zenoh sessions over loopback: what arrives, what is published, what goes wrong."""

import io
import json
import os
import re
import time
import urllib.request

import numpy as np
import pytest
import tiny
import zenoh
from live_net import (
    PATIENCE_S,
    Collector,
    ListSink,
    attachment,
    compiled,
    free_port,
    plain_publisher,
    plain_session,
    running,
    until,
    until_heard,
)
from rich.console import Console

from streamfeat.errors import InputError
from streamfeat.live import intake
from streamfeat.live.listen import ListenJob
from streamfeat.live.names import PlainNames
from streamfeat.live.network import Network
from streamfeat.live.publish import PublishJob
from streamfeat.live.record import RecordJob
from streamfeat.live.screen import HealthTable
from streamfeat.messages.cdr import EventPacket, FeaturesMessage, LabelMessage, PredictionMessage
from streamfeat.messages.codecs import encode
from streamfeat.recordings.reader import open_recording
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.outputs import Outputs
from streamfeat.stream.session import Session

pytestmark = pytest.mark.real_time

MODEL = tiny.encoder(k=3)
CLASSIFIER = tiny.classifier(MODEL)
WINDOW = MODEL.geometry.window_us
NEVER = 1e9
"""As long as a camera may be silent where the test's own pauses must not count."""


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    MODEL.save(folder / "model")
    CLASSIFIER.save(folder / "classifier")
    return compiled(folder)


def listener(files, expression="cam/*/events", classifier=True, **options):
    options = {
        "silence_s": NEVER,
        "patience_s": NEVER,
        "max_delay_s": NEVER,
        "network": Network(port=free_port()),
    } | options
    chosen = files / "classifier" if classifier else None
    return ListenJob(PlainNames(expression), files / "model", chosen, **options)


def message(batch, seq=0, resolution=tiny.RESOLUTION, as_="mono", **changes):
    payload, base_ns = encode(batch, as_)
    about = {
        "stamp_ns": 0,
        "frame_id": "",
        "height": resolution[0],
        "width": resolution[1],
        "seq": seq,
        "time_base": base_ns,
        "encoding": as_,
        "is_bigendian": False,
        "events": payload,
    }
    return EventPacket(**(about | changes)).to_cdr()


def batches(n, events=200, start_us=10_000, step_us=10_000):
    return [
        tiny.steady(start_us + i * step_us, start_us + (i + 1) * step_us, events, seed=i) for i in range(n)
    ]


def replayed(packets, policy="10ms"):
    session = Session(MODEL, EmitPolicy.parse(policy), CLASSIFIER)
    return [e for p in packets for e in session.process(p)] + list(session.finish())


def same(emissions, expected):
    assert [e.t_us for e in emissions] == [e.t_us for e in expected]
    for one, two in zip(emissions, expected, strict=True):
        assert np.array_equal(one.features, two.features)
        assert np.array_equal(one.scores, two.scores)


def test_features_over_zenoh_are_those_of_a_replay_of_the_recording_made_meanwhile(files, tmp_path):
    port, sent = free_port(), batches(60)
    job = listener(files, emit="10ms", network=Network(port=port))
    recorder = RecordJob(PlainNames("cam/*/events"), tmp_path / "meanwhile.mcap", network=Network(port=port))
    with plain_session(port, listen=True) as net, running(job), running(recorder):
        features = Collector(net, "cam/a/features")
        predictions = Collector(net, "cam/a/prediction")
        with plain_publisher(net, "cam/a/events") as camera:
            until_heard(net, "cam/probe/events", job, recorder)
            for i, events in enumerate(sent):
                camera.put(message(events, i), attachment=attachment(i + 1))
            until(lambda: job.result()["packets"] == recorder_count(recorder) == 60, "all packets")
            n_before_the_end = 59
            until(lambda: len(predictions.samples) >= n_before_the_end)
    with open_recording(tmp_path / "meanwhile.mcap") as recording:
        assert recording.topic == "/cam/a/events"
        packets = list(recording.items())
    assert recording.losses.counts == {}
    assert np.array_equal(np.concatenate([p.events for p in packets]), np.concatenate(sent))
    expected = replayed(packets)
    assert len(expected) == n_before_the_end + 1
    got = [FeaturesMessage.from_cdr(payload) for payload in features.of("features")]
    said = [PredictionMessage.from_cdr(payload) for payload in predictions.of("prediction")]
    assert len(got) >= n_before_the_end
    for one, two, e in zip(got, said, expected, strict=False):
        assert (one.stamp_ns, one.n_events, one.incomplete) == (e.t_us * 1000, e.n_events, False)
        assert one.data.tobytes() == e.features.tobytes()
        assert (two.stamp_ns, two.label) == (e.t_us * 1000, e.prediction)
        assert two.scores.tobytes() == e.scores.tobytes()
    numbers = [int.from_bytes(sample[2][:8], "little") for sample in features.samples]
    assert numbers == list(range(1, len(numbers) + 1))
    assert {sample[3] for sample in features.samples} == {"application/cdr;streamfeat_msgs/msg/Features"}
    result = job.result()
    assert (result["events"], result["lost"], result["dropped"], result["late"]) == (12_000, 0, 0, 0)


def recorder_count(recorder):
    return recorder.result()["messages"]


def test_a_wildcard_serves_cameras_that_come_and_go(files, tmp_path):
    port, sink = free_port(), ListSink()
    job = listener(files, emit="1000ev", network=Network(port=port), classifier=False)
    output = tmp_path / "out.mcap"
    with plain_session(port, listen=True) as net, running(job, Outputs(more=sink, recording=output)):
        with plain_publisher(net, "cam/a/events") as camera:
            for i, events in enumerate(batches(5)):
                camera.put(message(events, i), attachment=attachment(i + 1))
            until(lambda: len(sink.emissions) == 1)
        token = net.liveliness().declare_token("cam/b/events/@events/" + "62" * 16)
        with plain_publisher(net, "cam/b/events") as camera:
            for i, events in enumerate(batches(6, start_us=7_000_000)):
                camera.put(message(events, i), attachment=attachment(i + 1, b"b" * 16))
            until(lambda: len(sink.emissions) == 2)
            assert job.health.result()["cameras"] == 2
        # The one that announced itself is released when it leaves: what it still had is read.
        token.undeclare()
        until(lambda: len(sink.emissions) == 3)
        assert job._cameras.topics == ["cam/a/events"]
    assert [e.topic for e in sink.emissions] == ["cam/a/events", "cam/b/events", "cam/b/events"]
    assert [e.n_events for e in sink.emissions] == [1000, 1000, 1200]
    expected = MODEL.encode(np.concatenate(batches(6, start_us=7_000_000)), tiny.RESOLUTION, origin_us=0)
    assert np.array_equal(sink.emissions[-1].features, expected)
    from mcap.reader import make_reader

    with output.open("rb") as file:
        channels = make_reader(file).get_summary().channels.values()
    assert {channel.topic for channel in channels} == {"/cam/a/features", "/cam/b/features"}
    assert sink.closed == "done"


def test_published_recordings_arrive_whole_and_labelled(files, tmp_path):
    port, sink = free_port(), ListSink()
    items = tiny.labelled_items(6)
    recording = tiny.write_items(tmp_path / "labelled.mcap", items)
    job = listener(files, emit="1000ev", network=Network(port=port), learn_online=True)
    keys = ["cam/a/events", "cam/b/events"]
    publishing = PublishJob(
        [(recording, key) for key in keys],
        PlainNames(keys[0]),
        speed=None,
        network=Network(port=port),
        wait_s=30,
    )
    with running(job, Outputs(more=sink)):
        publishing.run()
        # The last sample has no label after it: the camera leaves, and that ends it.
        until(lambda: job.result()["samples"] == 12)
    assert publishing.result()["events"] == 2 * 1800
    session = Session(MODEL, EmitPolicy.parse("1000ev"), CLASSIFIER, learn_online=True)
    expected = [e for item in items for e in session.process(item)] + list(session.finish())
    for key in keys:
        same([e for e in sink.emissions if e.topic == key], expected)
    assert job.result()["correct"] == 2 * session.stats().correct
    assert job.result()["lost"] == 0


def test_word_that_a_camera_leaves_may_overtake_its_last_packets(files, monkeypatch):
    """zenoh sends declarations before data: who leaves is released when nothing has come for a while."""
    port, sink, sent = free_port(), ListSink(), batches(12)
    job = listener(files, emit="10ms", network=Network(port=port))
    key = "cam/a/events"
    monkeypatch.setattr(intake, "GRACE_S", NEVER)
    with (
        plain_session(port, listen=True) as net,
        running(job, Outputs(more=sink)),
        plain_publisher(net, key) as camera,
    ):
        for life, gid in enumerate((b"1" * 16, b"2" * 16)):
            token = net.liveliness().declare_token(f"{key}/@events/{gid.hex()}")
            camera.put(message(sent[0], 0), attachment=attachment(1, gid))
            token.undeclare()
            until(lambda: key in job._intake._leaving, "word of leaving")
            for i, events in enumerate(sent[1:], 1):
                camera.put(message(events, i), attachment=attachment(i + 1, gid))
            # The next one need not wait until this one is released, and begins anew.
            until(lambda life=life: job.result()["packets"] == 12 * (life + 1), lambda: f"{job.result()}")
        until(lambda: job._cameras.topics == [key], "the second one's session")
        monkeypatch.setattr(intake, "GRACE_S", 0.0)
        until(lambda: job._cameras.topics == [], lambda: f"nobody, {vars(job._intake)}")
    packets = [tiny.packet(events) for events in sent]
    for life in (sink.emissions[:12], sink.emissions[12:]):
        same(life, replayed(packets))
    result = job.result()
    assert (result["cameras"], result["restarts"], result["foreign"], result["late"]) == (2, 1, 0, 0)


def test_a_silent_camera_decays_to_nothing(files):
    port, sink = free_port(), ListSink()
    job = listener(files, emit="20ms", network=Network(port=port), silence_s=0.05, classifier=False)
    with (
        plain_session(port, listen=True) as net,
        running(job, Outputs(more=sink)),
        plain_publisher(net, "cam/a/events") as camera,
    ):
        camera.put(message(tiny.steady(10_000, 20_000, 50)), attachment=attachment(1))
        until(lambda: sink.emissions and not sink.emissions[-1].features.any())
        # Time that passes goes no further than the window does.
        until(lambda: job._intake.topics["cam/a/events"].silent_s > 0.5)
        times = [e.t_us for e in sink.emissions]
        assert times == list(range(20_000, 20_000 + WINDOW + 1, 20_000))
        assert sink.emissions[0].features.any()
        # Events that come after count as if nothing had happened.
        late = tiny.steady(100_000, 110_000, 50, seed=1)
        camera.put(message(late, 1), attachment=attachment(2))
        until(lambda: job.result()["events"] == 100)
    assert job.result()["late"] == 0
    assert [e.t_us for e in sink.emissions] == sorted(e.t_us for e in sink.emissions)


@pytest.mark.parametrize("emit", ["event", "10ms", "auto"])
def test_a_clock_that_starts_anew_is_followed_at_once(files, emit):
    port, sink, hour = free_port(), ListSink(), 3_600_000_000
    job = listener(files, emit=emit, network=Network(port=port), classifier=False)
    with (
        plain_session(port, listen=True) as net,
        running(job, Outputs(more=sink)),
        plain_publisher(net, "cam/a/events") as camera,
    ):
        for i, start in enumerate((30 * hour, 10_000, 7 * hour)):
            events = tiny.steady(start, start + 30_000, 100, seed=i)
            camera.put(message(events, i), attachment=attachment(i + 1))
            until(lambda i=i: job.result()["events"] == 100 * (i + 1))
    warnings = job.result()["warnings"]
    assert (warnings["clock restarted"], warnings["clock jumped"]) == (1, 1)
    last = sink.emissions[-1]
    expected = MODEL.encode(
        tiny.steady(7 * hour, 7 * hour + 30_000, 100, seed=2), tiny.RESOLUTION, origin_us=0
    )
    assert np.array_equal(last.features, expected)
    assert last.incomplete
    assert not sink.emissions[0].incomplete
    assert job.result()["late"] == 0
    assert len(sink.emissions) <= 300 + 3


def test_gaps_mark_a_window_and_no_more(files):
    port, sink = free_port(), ListSink()
    job = listener(files, emit="10ms", network=Network(port=port), classifier=False)
    sent = batches(30)
    with plain_session(port, listen=True) as net, running(job, Outputs(more=sink)):
        features = Collector(net, "cam/a/features")
        with plain_publisher(net, "cam/a/events") as camera:
            for i, events in enumerate(sent):
                if i not in (10, 11):
                    camera.put(message(events, i), attachment=attachment(i + 1))
            camera.put(message(sent[5], 5), attachment=attachment(6))
            camera.put(message(sent[11], 11), attachment=attachment(12))
            until(lambda: job.result()["reordered"] == 1)
            until(lambda: len(features.samples) >= 29)
    result = job.result()
    assert (result["lost"], result["duplicates"], result["reordered"], result["packets"]) == (1, 1, 1, 29)
    gap_us = int(sent[12]["t"][0])
    before_us = int(sent[9]["t"][-1])
    marked = [e.t_us for e in sink.emissions if e.incomplete]
    assert marked == [e.t_us for e in sink.emissions if before_us < e.t_us <= gap_us + WINDOW]
    assert result["incomplete"] == len(marked)
    told = [FeaturesMessage.from_cdr(payload).incomplete for payload in features.of("features")]
    assert told == [e.incomplete for e in sink.emissions][: len(told)]


class HeldSink(ListSink):
    """Waits until it is let go, as a stuck disk would."""

    def __init__(self):
        super().__init__()
        import threading

        self.go = threading.Event()

    def write(self, emissions):
        assert self.go.wait(PATIENCE_S)
        super().write(emissions)


def test_overload_drops_the_oldest_whole_packets_and_says_so(files, monkeypatch):
    port, sink = free_port(), HeldSink()
    job = listener(files, emit="event", network=Network(port=port), classifier=False, patience_s=0.05)
    job._inbox._max_bytes = 400_000
    sent = batches(1000, events=1000)
    with (
        plain_session(port, listen=True) as net,
        running(job, Outputs(more=sink)),
        plain_publisher(net, "cam/a/events") as camera,
    ):
        for i, events in enumerate(sent):
            camera.put(message(events, i), attachment=attachment(i + 1))
        until(lambda: job._inbox.depth and job._inbox.dropped > 100)
        assert job._inbox._bytes <= 400_000
        sink.go.set()
        accounted = ("packets", "dropped", "lost", "unheard")
        until(lambda: sum(job.result()[n] for n in accounted) == 1000, lambda: f"1000, not {job.result()}")
    result = job.result()
    assert result["lost"] == 0
    assert result["dropped"] > 100
    assert result["incomplete"] > 0
    assert result["events"] == 1000 * result["packets"]
    assert result["emissions"] < result["events"]
    # The newest packets are those that were kept.
    assert sink.emissions[-1].t_us == int(sent[-1]["t"][-1]) + 1


# --- bad input


def hostile_payloads():
    rng = np.random.default_rng(0)
    good = message(tiny.steady(0, 1000, 50), 7)
    cases = [(rng.bytes(int(n)), "bad packet") for n in rng.integers(0, 3000, 50)]
    cases += [(good[:n], "bad packet") for n in range(0, len(good), 7)]
    lying = bytearray(good)
    lying[-50 * 8 - 4 : -50 * 8] = (2**32 - 1).to_bytes(4, "little")
    cases.append((bytes(lying), "bad packet"))
    one = tiny.stream([5])
    cases += [
        (message(one, 1, encoding="evt9"), "bad packet"),
        (message(one, 1, is_bigendian=True), "bad packet"),
        (message(one, 1, height=0), "bad packet"),
        (message(one, 1, height=60_000, width=60_000), "bad packet"),
        (message(one, 1, events=bytes(9)), "bad packet"),
        (message(one, 1, time_base=2**64 - 1), "stray packet"),
        (message(tiny.stream([0]), 1, as_="libcaer", time_base=2**63 - 1), "stray packet"),
        (os.urandom(10_000_000), "too large"),
        (message(one, 1, events=bytes(8) * (2**20 // 2 + 1) * 2)[: 4 << 20], "bad packet"),
    ]
    return cases


def test_bad_input_is_counted_by_reason_and_the_stream_goes_on(files):
    port, sink, lines = free_port(), ListSink(), []
    job = listener(files, emit="1000ev", network=Network(port=port), classifier=False)
    job._warnings._say = lines.append
    cases = hostile_payloads()
    sent = batches(len(cases), events=20)
    started = time.monotonic()
    with plain_session(port, listen=True) as net, running(job, Outputs(more=sink)):
        bad_key = "cam/bad/events"
        with plain_publisher(net, bad_key) as bad, plain_publisher(net, "cam/good/events") as good:
            for i, ((payload, _), events) in enumerate(zip(cases, sent, strict=True)):
                good.put(message(events, i), attachment=attachment(i + 1))
                bad.put(payload, attachment=attachment(i + 1, b"x" * 16))
            # Without any attachment, of a type that is not ours, and under an encoding that is none.
            bad.put(b"\x00\x01\0\0rubbish")
            bad.put(b"hello", encoding="text/plain", attachment=b"z" * 5000)
            bad.put(b"hello", encoding="application/cdr;sensor_msgs/msg/Image")
            until(lambda: job.result()["events"] == 20 * len(cases))
            expected = {}
            for _, reason in cases:
                expected[reason] = expected.get(reason, 0) + 1
            expected["bad packet"] += 1
            until(lambda: sum(job.result()["warnings"].get(r, 0) for r in expected) >= sum(expected.values()))
            until(lambda: job.result()["warnings"].get("unknown type") == 2)
    warnings = job.result()["warnings"]
    assert {reason: warnings[reason] for reason in expected} == expected
    seconds = time.monotonic() - started
    for reason in warnings:
        assert sum(line.startswith(f"{reason}: ") for line in lines) <= seconds + 2
    assert sink.emissions[-1].topic == "cam/good/events"


def test_events_outside_a_sensor_that_changes_its_size(files):
    port, sink = free_port(), ListSink()
    job = listener(files, emit="1000ev", network=Network(port=port), classifier=False)
    wide = tiny.steady(0, 1000, 100, resolution=(12, 40))
    outside = int(np.count_nonzero(wide["x"] >= tiny.RESOLUTION[1]))
    assert 0 < outside < 100
    small = tiny.steady(2000, 3000, 100, resolution=(8, 8))
    with (
        plain_session(port, listen=True) as net,
        running(job, Outputs(more=sink)),
        plain_publisher(net, "cam/a/events") as camera,
    ):
        camera.put(message(wide, 0), attachment=attachment(1))
        camera.put(message(small, 1, (8, 8)), attachment=attachment(2))
        until(lambda: job.result()["packets"] == 2)
    result = job.result()
    assert (result["events"], result["rejected"]) == (200 - outside, outside)
    assert result["warnings"]["resolution changed"] == 1
    assert np.array_equal(sink.emissions[-1].features, MODEL.encode(small, (8, 8), origin_us=0))


def test_two_cameras_on_one_key(files):
    port, sink = free_port(), ListSink()
    job = listener(files, emit="1000ev", network=Network(port=port), classifier=False)
    with (
        plain_session(port, listen=True) as net,
        running(job, Outputs(more=sink)),
        plain_publisher(net, "cam/a/events") as camera,
    ):
        for i, events in enumerate(batches(40)):
            camera.put(message(events, i), attachment=attachment(i + 1, b"1" * 16))
            camera.put(message(events, i), attachment=attachment(i + 70, b"2" * 16))
        until(lambda: (r := job.result())["packets"] + r["foreign"] == 80)
    result = job.result()
    assert (result["packets"], result["foreign"], result["lost"]) == (40, 40, 0)
    assert result["events"] == 8000
    assert result["warnings"]["second publisher"] == 40


def test_topics_without_end_are_refused(files, monkeypatch):
    monkeypatch.setattr(intake, "MAX_TOPICS", 5)
    port = free_port()
    job = listener(files, "**", emit="1000ev", network=Network(port=port), classifier=False)
    with plain_session(port, listen=True) as net, running(job), plain_publisher(net, "x/**") as camera:
        for i in range(40):
            net.put(f"x/{i}", message(tiny.stream([5])), attachment=attachment(1))
        until(lambda: job.result()["warnings"].get("too many topics") == 35)
        del camera
    assert job.result()["cameras"] == 5


@pytest.mark.parametrize(
    ("label", "reason"),
    [
        (LabelMessage(0, "", 2**63, "cat", "", "").to_cdr(), "bad label"),
        (LabelMessage(10**18, "", 10**6, "cat", "", "").to_cdr(), "bad label"),
        (b"\0\1\0\0cat", "bad label"),
    ],
)
def test_labels_that_make_no_sense(files, label, reason):
    port = free_port()
    job = listener(files, emit="1000ev", network=Network(port=port), learn_online=True)
    with (
        plain_session(port, listen=True) as net,
        running(job),
        plain_publisher(net, "cam/a/events") as camera,
    ):
        camera.put(message(batches(1)[0]), attachment=attachment(1))
        until(lambda: job.result()["packets"] == 1)
        net.put("cam/a/label", label, encoding="application/cdr;streamfeat_msgs/msg/Label")
        until(lambda: job.result()["warnings"].get(reason) == 1)
        camera.put(message(batches(2)[1]), attachment=attachment(2))
        until(lambda: job.result()["events"] == 400)
    assert job.result()["samples"] == 0


# --- delivery and health


def test_reliable_late_joiners_get_history_and_nothing_is_missed(files, tmp_path):
    port, sink = free_port(), ListSink()
    recording = tiny.write_items(tmp_path / "r.mcap", [tiny.packet(b) for b in batches(50)])
    job = listener(files, emit="1000ev", network=Network(port=port, reliable=True), classifier=False)
    from streamfeat.live.network import open_session
    from streamfeat.live.publisher import CameraSink
    from streamfeat.messages.packets import PacketWriter

    writer = PacketWriter()
    with open_session(port=port) as net, open_recording(recording) as rec:
        packets = [m for item in rec.items() for m in writer.messages(item.events, item.resolution)]
        camera = CameraSink(net, PlainNames("cam/a/events"), "cam/a/events", reliable=True, block=True)
        camera.write(packets[:30])
        with running(job, Outputs(more=sink)):
            until(lambda: job.result()["packets"] == 30, "history")
            camera.write(packets[30:])
            until(lambda: job.result()["packets"] == 50)
            camera.close(failed=False)
    assert job.result()["events"] == 10_000
    assert job.result()["lost"] == 0


def test_metrics_tell_what_the_summary_tells(files):
    port, metrics = free_port(), free_port()
    job = listener(files, emit="10ms", network=Network(port=port), metrics=f"127.0.0.1:{metrics}")
    with (
        plain_session(port, listen=True) as net,
        running(job),
        plain_publisher(net, "cam/a/events") as camera,
    ):
        for i, events in enumerate(batches(20)):
            if i != 7:
                now = time.time_ns()
                camera.put(message(events, i), attachment=attachment(i + 1, source_ns=now))
        until(lambda: (r := job.result())["events"] == 3800 and "end_to_end_p50_ms" in r)
        with urllib.request.urlopen(f"http://127.0.0.1:{metrics}/metrics", timeout=10) as page:
            text = page.read().decode()
    result = job.result()
    values = dict(line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))
    for name, key in (
        ("streamfeat_events_total", "events"),
        ("streamfeat_packets_total", "packets"),
        ("streamfeat_lost_packets_total", "lost"),
        ("streamfeat_dropped_packets_total", "dropped"),
        ("streamfeat_late_events_total", "late"),
    ):
        assert float(values[name]) == result[key], name
    assert result["lost"] == 1
    assert float(values['streamfeat_warnings_total{reason="packets missing"}']) == 1
    assert float(values["streamfeat_update_latency_seconds_count"]) >= 18
    assert 0 < float(values["streamfeat_end_to_end_latency_seconds_count"]) <= 19
    assert {'streamfeat_queue_depth{queue="inbox_messages"}', "streamfeat_cameras"} <= set(values)
    assert 0 < result["end_to_end_p50_ms"] <= result["end_to_end_p99_ms"]
    json.dumps(result)


class Terminal(io.StringIO):
    """Notes what a terminal would be sent."""

    def isatty(self):
        return True


def test_a_terminal_shows_one_table_of_the_figures_of_the_metrics(files):
    port, terminal = free_port(), Terminal()
    console = Console(file=terminal, width=120, height=40, force_terminal=True, color_system=None)
    job = listener(files, emit="10ms", network=Network(port=port))
    with (
        plain_session(port, listen=True) as net,
        running(job, Outputs(console=console)),
        plain_publisher(net, "cam/a/events") as camera,
    ):
        for i, events in enumerate(batches(20)):
            if i == 10:  # the rate is that of half a second
                until(lambda: "cam/a/events" in terminal.getvalue(), "the table")
                time.sleep(0.5)
            if i != 7:
                camera.put(message(events, i), attachment=attachment(i + 1, source_ns=time.time_ns()))
        camera.put(b"", attachment=attachment(21))
        until(lambda: re.search(r"\+[0-9.]+ +[1-9][0-9,]* ", terminal.getvalue()), "a rate of events")
        until(lambda: job.result()["emissions"] >= 18 and job.result()["warnings"].get("bad packet"))
        plain = Console(file=io.StringIO(), width=120)
        plain.print(HealthTable(job.health))
        shown = plain.file.getvalue()
        assert re.search(r"^(cat|dog|owl) +\+[0-9.]+ +[0-9,]+ +0\.\d\d s +cam/a/events", shown, re.M)
        said = " ".join(shown.split())
        assert re.search(
            r"3,800 events; 1[89] emissions; 20 packets; update p50 [0-9.]+ ms, p99 [0-9.]+", said
        )
        assert re.search(r"end to end p50 [0-9.]+ ms, p99 [0-9.]+ ms", said)
        # What went wrong is there, and what did not is not.
        assert "lost packets 1" in said
        assert "bad packet 1, packets missing 1" in said
        assert "late events" not in said
        assert "duplicate" not in said
        for width in (40, 60):
            narrow = Console(file=io.StringIO(), width=width)
            narrow.print(HealthTable(job.health))
            assert re.search(r"^(cat|dog|owl) +\+[0-9.]+ ", narrow.file.getvalue(), re.M)
            assert "cam/a/events" in narrow.file.getvalue()
    # Not a terminal: a line a second, and no table.
    text = io.StringIO()
    with (
        plain_session(port := free_port(), listen=True) as net,
        running(
            listener(files, emit="10ms", network=Network(port=port)),
            Outputs(console=Console(file=text, width=120)),
        ),
        plain_publisher(net, "cam/a/events") as camera,
    ):
        for i, events in enumerate(batches(3)):
            camera.put(message(events, i), attachment=attachment(i + 1))
        until(text.getvalue, "a line")
    assert text.getvalue().count("\n") == 1
    assert "cam/a/events" in text.getvalue()


def test_what_cannot_work_is_said_at_once(files, tmp_path):
    with pytest.raises(InputError, match="--learn-online needs a classifier"):
        listener(files, classifier=False, learn_online=True)
    for address in ("9100", "127.0.0.1:", ":1", "127.0.0.1:99999", "a:b"):
        with pytest.raises(InputError, match="--metrics"):
            listener(files, metrics=address)
    with pytest.raises(InputError, match="no key expression"):
        listener(files, "cam//events").run()
    config = tmp_path / "zenoh.json5"
    config.write_text("{mode: 'planet'}")
    with pytest.raises(InputError, match="zenoh cannot use this configuration"):
        listener(files, network=Network(config)).run()
    with pytest.raises(InputError, match="zenoh cannot use this configuration"):
        listener(files, network=Network(tmp_path / "none.json5")).run()
    port = free_port()
    with plain_session(port, listen=True), pytest.raises(InputError, match="cannot listen there"):
        listener(files, metrics=f"127.0.0.1:{port}").run()


def test_sessions_stay_on_this_machine_by_default():
    from streamfeat.live.network import open_session

    port = free_port()
    with open_session(port=port) as one, open_session(port=port) as two:
        until(lambda: two.info.peers_zid())
        for link in (*one.info.links(), *two.info.links()):
            assert "127.0.0.1" in str(link.src)
            assert "127.0.0.1" in str(link.dst)
        # What goes through shared memory is gone when a reader hesitates.
        assert [transport.is_shm for transport in one.info.transports()] == [False]
        assert not one.is_closed()
    assert one.is_closed()
    assert isinstance(one, zenoh.Session)
