"""Going on after a crash: engines, sessions and listeners, with the bits of those that never stopped."""

import copy
import json
import math
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import tiny
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from live_net import Collector, attachment, compiled, free_port, plain_session, until
from streams import KINDS, LASSO_KINDS, cases, random_encoder, random_events, streams
from test_live_listen import MODEL, batches, message, replayed

from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.files.safetensors_file import read_safetensors, write_safetensors
from streamfeat.kernels.layout import BEFORE_TIME
from streamfeat.live.checkpoint import Checkpointer, read_state
from streamfeat.live.health import Health
from streamfeat.live.inbox import Inbox, RawMessage
from streamfeat.live.intake import Intake
from streamfeat.live.names import PlainNames
from streamfeat.live.network import open_session
from streamfeat.live.publisher import MessagePublisher
from streamfeat.live.topic import Barrier
from streamfeat.live.warnings import Warnings
from streamfeat.messages.cdr import EventPacket, FeaturesMessage
from streamfeat.messages.codecs import encode
from streamfeat.messages.packets import Label, Packet, Watermark
from streamfeat.stream.cameras import Cameras
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session

RANDOM = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
KEY = "cam/a/events"

# --- engines


@pytest.mark.parametrize("kind", KINDS, ids="-".join)
@RANDOM
@given(data=st.data())
def test_an_engine_that_is_restored_anywhere_goes_on_with_the_same_bits(kind, data):
    case = data.draw(cases(kind))
    events = data.draw(streams(case))
    look_ahead = data.draw(st.booleans())
    engine, other = (case.engine(origin_us=origin, look_ahead=look_ahead) for origin in (5, 0))
    place = data.draw(st.integers(0, len(events)))
    for batch in np.split(events[:place], [place // 2]):
        data.draw(st.sampled_from([engine.feed, engine.follow]))(batch)
        data.draw(st.sampled_from([engine.features, engine.stats, lambda: engine.prepare(50)]))()
    other.feed(events)  # something to be forgotten
    other.features()
    other.restore(engine.snapshot())
    rest = events[place:]
    for batch in np.array_split(rest, 3):
        how = data.draw(st.sampled_from(["feed", "follow"]))
        is_prepared, is_read = data.draw(st.booleans()), data.draw(st.booleans())
        for one in (engine, other):
            getattr(one, how)(batch)
            if is_prepared:
                one.prepare(30)
        if is_read:
            assert engine.features().tobytes() == other.features().tobytes()
    assert engine.codes().tobytes() == other.codes().tobytes()
    assert engine.features().tobytes() == other.features().tobytes()
    assert engine.counts().tobytes() == other.counts().tobytes()
    assert engine.window_us == other.window_us
    mine, theirs = engine.stats(), other.stats()
    assert replace(mine, encoded_volumes=0) == replace(theirs, encoded_volumes=0)


@pytest.mark.parametrize("kind", LASSO_KINDS, ids="-".join)
def test_engines_that_look_ahead_go_on_from_the_codes_of_a_snapshot_alone(kind):
    """A lasso that the other plane has solved before would be where the next starts, in one of them."""
    geometry = Geometry(patch=3, stride=2, n_bins=3, bin_us=1000, max_count=2)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        encoder = random_encoder(rng, geometry, 33, *kind)
        events = random_events(rng, geometry, (13, 18), 400)
        engine, other = (Engine(encoder, (13, 18), look_ahead=True) for _ in range(2))
        batches = np.array_split(events, 20)
        for batch in batches[:10]:
            engine.feed(batch)
            engine.prepare(10**6)
        other.restore(engine.snapshot())
        for batch in batches[10:]:
            for one in (engine, other):
                one.feed(batch)
                one.prepare(10**6)
            assert engine.features().tobytes() == other.features().tobytes()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"counts": np.zeros((2, 12, 16), np.int64)}, "counts of int64"),
        ({"counts": np.zeros((2, 12, 15), np.int32)}, "counts of int32 (2, 12, 15)"),
        ({"atoms": np.full((12, 5), np.nan)}, "an entry of a code"),
        ({"atoms": np.full((12, 5), 1e300)}, "an entry of a code"),
        ({"tally": np.full(5, -1)}, "less than zero"),
        ({"encoded": np.zeros(3, np.int64)}, "encoded of int64 (3,)"),
        ({"bin": 1 << 61}, "beyond 2^62"),
        ({"bin": BEFORE_TIME - 1}, "beyond 2^62"),
        ({"origin_us": 1 << 62}, "beyond 2^62"),
        ({"fingerprint": "x"}, "of encoder x"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_snapshot_of_no_engine_is_refused_and_changes_nothing(changes, reason):
    engine = Session(tiny.encoder("inverse"), EmitPolicy("auto"))._engine_for(tiny.RESOLUTION)
    engine.feed(tiny.steady(0, 80_000, 100))
    snapshot, features = engine.snapshot(), engine.features()
    with pytest.raises(InputError) as error:
        engine.restore(replace(snapshot, **changes))
    assert reason in str(error.value)
    assert engine.features().tobytes() == features.tobytes()


# --- sessions, by way of the file


def cameras_of(policy="10ms", classifier=None):
    return Cameras(
        lambda topic: Session(MODEL, EmitPolicy.parse(policy), classifier, topic=topic, clock=lambda: 0.0)
    )


class Job:
    """What a listener has, without a network."""

    def __init__(self, path, policy="10ms", mark_s=math.inf):
        self.inbox, self.cameras = Inbox(), cameras_of(policy)
        self.intake = Intake(self.inbox, MODEL.geometry.window_us, Warnings(), mark_s=mark_s)
        if path.exists():
            read_state(path, MODEL.fingerprint, self.intake, self.cameras)
        self.health = Health(self.cameras, self.intake, self.inbox, Warnings())
        self.failures = []
        parts = self.health, self.cameras, self.intake, self.failures.append
        self.keeper = Checkpointer(path, MODEL.fingerprint, *parts)

    def process(self, items):
        return [e for item in items for e in self.keeper.process(item)]

    def die(self, failures=0):
        """Write what is ready, and no more."""
        self.keeper.close(failed=True)
        assert len(self.failures) == failures


def some_items(rng, n=12):
    """Packets of two cameras, labels, silences, missing packets, a clock that starts anew, another sensor."""
    now, epoch, items = 200_000, 0, []
    for i in range(n):
        topic = f"cam{rng.integers(2)}"
        what = rng.integers(12)
        step = int(rng.choice([0, 3_000, 20_000, 400_000]))
        if what == 0:
            items.append(Label(now, int(rng.integers(1, 90_000)), "cat", topic=topic))
        elif what <= 2:
            items.append(Watermark(topic, now + step))
        else:
            epoch += int(what == 3)
            size = (20, 24) if what == 4 else tiny.RESOLUTION
            events = tiny.steady(now, now + step + 1, int(rng.integers(0, 80)), seed=i, resolution=size)
            events["t"][rng.random(len(events)) < 0.05] -= 50_000
            lost = int(rng.random() < 0.1)
            items.append(Packet(topic, events, size, 0, i, lost=lost, epoch=epoch, source_ns=i))
        now += step
    return items


@pytest.mark.parametrize("policy", ["event", "7ev", "10ms", "auto"])
@RANDOM
@given(seed=st.integers(0, 10_000))
@example(seed=404)
def test_sessions_that_are_restored_anywhere_go_on_with_the_same_bits(policy, seed, tmp_path_factory):
    path = tmp_path_factory.mktemp("state") / "state"
    rng = np.random.default_rng(seed)
    items = some_items(rng)
    place = int(rng.integers(0, len(items) + 1))
    job, plain = Job(path, policy), cameras_of(policy)
    expected = [[e for item in part for e in plain.process(item)] for part in (items[:place], items[place:])]
    got = job.process(items[:place])
    if got:
        job.keeper.write(got)
    job.process([Barrier(job.intake.snapshot())])
    job.die()
    again = Job(path, policy)
    rest = again.process(items[place:])
    assert list(map(told, got + rest)) == list(map(told, expected[0] + expected[1]))
    assert again.cameras.stats() == plain.stats()
    again.die()


def told(emission):
    e = emission
    return (e.topic, e.t_us, e.n_events, e.features.tobytes(), e.sample, e.final, e.incomplete)


def test_another_policy_may_go_on(tmp_path):
    path = tmp_path / "state"
    job = Job(path, "10ms")
    job.keeper.write(job.process([tiny.packet(tiny.steady(0, 45_000, 50))]))
    list(job.keeper.finish())
    job.die()
    again = Job(path, "7000us")
    assert [e.t_us for e in again.process([Watermark("/events", 60_000)])] == [49_000, 56_000]
    again.die()


def test_readings_between_events_and_silences_do_not_go_back():
    """Under `event`, a silence begins where events have led to, not where the one before it ended."""
    session = Session(MODEL, EmitPolicy.parse("event"))
    items = [
        tiny.packet(tiny.stream([0, 10])),
        Watermark("", 60_000),
        tiny.packet(tiny.stream([5_000_000])),
        Watermark("", 5_060_000),
    ]
    times = [e.t_us for item in items for e in session.process(item)]
    assert times == [1, 11, 50_000, 5_000_001, 5_050_000]


# --- what the file says, and when


def test_a_file_never_says_more_than_was_written(tmp_path):
    """Emissions that no sink has taken yet are made again."""
    path = tmp_path / "state"
    job = Job(path)
    packets = [tiny.packet(events) for events in batches(8)]
    first, second = job.process(packets[:4]), None
    job.process([Barrier({})])
    second = job.process(packets[4:])
    assert first
    assert second
    job.keeper.write(first[:-1])
    job.die()
    assert not path.exists()
    job = Job(path)
    first = job.process(packets[:4])
    job.process([Barrier({})])
    job.keeper.write(first)
    job.die()
    again = Job(path)
    assert [told(e) for e in again.process(packets[4:])] == [told(e) for e in second]
    again.die()


def test_what_was_kept_at_the_end_is_from_before_the_end(tmp_path):
    """A listener that is stopped and started goes on, too: its streams have not ended."""
    path, plain = tmp_path / "state", cameras_of()
    packets = [tiny.packet(events) for events in batches(8)]
    expected = [e for packet in packets for e in plain.process(packet)]
    job = Job(path)
    got = job.process(packets[:4])
    job.keeper.write([*got, *job.keeper.finish()])
    job.die()
    again = Job(path)
    assert [told(e) for e in got + again.process(packets[4:])] == [told(e) for e in expected]
    again.die()


def test_a_file_that_cannot_be_written_does_not_end_the_job(tmp_path):
    job = Job(tmp_path / "none" / "state")
    job.process([Barrier({})])
    job.keeper.write([])
    job.die(failures=1)
    (failure,) = job.failures
    assert "cannot write there" in failure


def test_what_a_killed_writer_left_is_removed(tmp_path):
    path, mine, other = (tmp_path / name for name in ("state", ".state.x1_.tmp", ".state.backup"))
    for one in (mine, other):
        one.write_bytes(b"")
    Job(path).die()
    assert list(tmp_path.iterdir()) == [other]


def put(job, events, i, gid=b"0123456789abcdef", as_="mono", after_us=0):
    """One packet through the inbox and the intake; what it makes of it."""
    attached = attachment(i + 1, gid)
    payload, base_ns = encode(events, as_, after_us)
    data = message(events, i, as_=as_, events=payload, time_base=base_ns)
    job.inbox.put(RawMessage(KEY, EventPacket.SCHEMA_NAME, data, attached, i * 10_000_000, 0))
    return [item for taken in [job.inbox.take(0)] for m in taken for item in job.intake._items(m)]


@pytest.mark.parametrize("encoding", ["mono", "libcaer_cmp", "evt3"])
def test_numbers_clocks_and_decoders_go_on(encoding, tmp_path):
    """Packets of a decoder that carries on its state, three of them missing, one twice, and late."""
    path, sent = tmp_path / "state", batches(20, start_us=17_000_000)
    order = [0, 1, 2, 6, 4, 7, 7, 8, 5, 9, 10]
    plain, job = Job(tmp_path / "none"), Job(path)
    for at, i in enumerate(order):
        if at == 6:
            job.process([Barrier(job.intake.snapshot())])
            job.die()
            job = Job(path)
        after_us = int(sent[i - 1]["t"][-1]) if i else 0
        one, two = (put(each, sent[i], i, as_=encoding, after_us=after_us) for each in (plain, job))
        assert [(p.lost, p.epoch, p.events.tobytes()) for p in one] == [
            (p.lost, p.epoch, p.events.tobytes()) for p in two
        ]
        got = job.process(two)
        assert [told(e) for e in plain.process(one)] == [told(e) for e in got]
        job.keeper.write(got)
    assert job.intake.delivery() == plain.intake.delivery()
    assert plain.intake.delivery().duplicates == 1
    assert plain.intake.delivery().reordered == 2
    for each in (plain, job):
        each.die()


# --- files that nobody has vouched for


def nasty(rng):
    values = [None, -1, 0, 1, True, 2**31, 2**62, -(2**62), 2**63, 2**70, 1.5, math.inf, "", "x" * 3000]
    values += [[], {}, [1, 2], [2**40, 2**40], {"x": 1}, [0] * 5000]
    return values[rng.integers(len(values))]


def places(value, path=()):
    yield path
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, one in inner:
        yield from places(one, (*path, key))


def changed(header, rng):
    """A copy with one value replaced."""
    header = copy.deepcopy(header)
    options = [path for path in places(header) if path]
    path = options[rng.integers(len(options))]
    value = header
    for key in path[:-1]:
        value = value[key]
    value[path[-1]] = nasty(rng)
    return header, path


def opened(path):
    """A job, or why there is none."""
    try:
        return Job(path), None
    except InputError as error:
        return None, str(error)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A state file of two cameras, one of them within a labelled sample."""
    path = tmp_path_factory.mktemp("sound") / "state"
    job = Job(path)
    for i, events in enumerate(batches(6)):
        job.keeper.write(job.process(put(job, events, i, as_="evt3" if i else "mono")) or [])
    job.keeper.write(job.process([Label(75_000, 60_000, "cat", topic=KEY)]))
    job.process([tiny.packet(tiny.steady(0, 40_000, 100))])
    list(job.keeper.finish())
    job.keeper._written = job.keeper._made
    job.keeper.write([])
    job.die()
    return path


def test_a_state_with_any_value_replaced_is_refused_in_one_line_or_does_no_harm(sound, tmp_path):
    arrays, header = read_safetensors(sound, "state", 1)
    del header["format"], header["version"]
    rng = np.random.default_rng(7)
    refused = 0
    for i in range(300):
        bad, _ = changed(header, rng)
        path = tmp_path / f"bad{i}"
        write_safetensors(path, "state", 1, arrays, bad)
        job, error = opened(path)
        if error:
            refused += 1
            assert "\n" not in error
            assert str(path) in error
            continue
        job.process(put(job, batches(8)[6], 6))
        job.process([Watermark(KEY, 2_000_000), tiny.packet(tiny.steady(60_000, 90_000, 50))])
        list(job.keeper.finish())
        job.die()
    assert refused > 150


def test_arrays_of_a_state_that_do_not_fit_are_refused(sound, tmp_path):
    arrays, header = read_safetensors(sound, "state", 1)
    del header["format"], header["version"]
    for name, array in arrays.items():
        flat = array.reshape(-1)
        for other in (None, array[1:], array.astype(np.float32), flat, array[np.newaxis]):
            if other is not None and (other.shape, other.dtype) == (array.shape, array.dtype):
                continue
            given = {k: v for k, v in arrays.items() if k != name} | ({} if other is None else {name: other})
            path = tmp_path / "bad"
            write_safetensors(path, "state", 1, given, header)
            with pytest.raises(InputError, match="not a usable state"):
                Job(path)


def test_a_state_that_is_cut_or_of_another_model_is_refused(sound, tmp_path):
    path, data = tmp_path / "bad", sound.read_bytes()
    for length in range(0, len(data), 97):
        path.write_bytes(data[:length])
        with pytest.raises(InputError):
            Job(path)
    path.write_bytes(data)
    job = Job(tmp_path / "none")
    job.die()
    with pytest.raises(InputError, match="of another model"):
        read_state(path, "0" * 64, job.intake, job.cameras)


# --- real listeners, killed

LISTENER = """
import sys
from pathlib import Path
from streamfeat.live.listen import ListenJob
from streamfeat.live.names import PlainNames
from streamfeat.live.network import Network
model, state, port, reliable = sys.argv[1:]
never = dict(silence_s=1e9, patience_s=1e9, max_delay_s=1e9)
never |= dict(network=Network(None, int(port), reliable == "True"), state=Path(state), state_every_s=0.02)
job = ListenJob(PlainNames("cam/*/events"), Path(model), emit="10ms", **never)
job.run()
import json
print(json.dumps(job.result()))
"""


@contextmanager
def listening(*words):
    process = subprocess.Popen([sys.executable, "-c", LISTENER, *map(str, words)], stdout=subprocess.PIPE)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    MODEL.save(folder / "model")
    return compiled(folder)


def next_number(path):
    """The number that a state file waits for."""
    if not path.exists():
        return 0
    _, header = read_safetensors(path, "state", 1)
    topics = {topic["topic"]: topic for topic in header["topics"]}
    return topics[KEY]["delivery"]["next"] if KEY in topics else 0


@pytest.mark.real_time
@pytest.mark.parametrize("reliable", [True, False])
def test_a_listener_that_is_killed_goes_on_where_it_was(reliable, files, tmp_path):
    """What is put while nobody listens is recovered if both sides ask for it, or else lost and counted."""
    port, state, sent = free_port(), tmp_path / "state", batches(30, events=50)
    words = files / "model", state, port, reliable
    messages = [message(events, i) for i, events in enumerate(sent)]
    with plain_session(port, listen=True) as net:
        features = Collector(net, "cam/a/features")
        with open_session(port=port) as camera_net:
            names = PlainNames(KEY)
            camera = MessagePublisher(
                camera_net, names, KEY, EventPacket.SCHEMA_NAME, block=True, reliable=reliable
            )

            def is_heard():
                # An advanced publisher cannot tell; who comes late gets what was put.
                return reliable or camera._publisher.matching_status.matching

            with listening(*words) as process:
                until(lambda: is_heard() or process.poll() is not None, "a listener")
                for data in messages[:12]:
                    camera.put(data)
                until(lambda: next_number(state) == 13, "the state of 12 packets")
                process.kill()
                process.wait()
            until(lambda: reliable or not is_heard(), "the end of the listener")
            before = len(features.samples)
            for data in messages[12:20]:
                camera.put(data)
            with listening(*words) as process:
                until(lambda: is_heard() or process.poll() is not None, "a listener")
                for data in messages[20:]:
                    camera.put(data)
                until(lambda: next_number(state) == 31, "the state of 30 packets")
                if reliable:
                    until(lambda: len(features.samples) >= 29, lambda: f"{len(features.samples)} features")
                process.terminate()
                out, _ = process.communicate(timeout=60)
            camera.close()
    result = json.loads(out)
    got = [FeaturesMessage.from_cdr(payload) for payload in features.of("features")]
    packets = [tiny.packet(events) for events in sent]
    if reliable:
        assert (result["packets"], result["lost"], result["events"]) == (30, 0, 1500)
        assert not any(one.incomplete for one in got)
        expected = replayed(packets)
        assert len(got) >= len(expected) - 1
    else:
        assert (result["packets"], result["lost"], result["events"]) == (22, 8, 1100)
        expected = replayed(packets[:12])[:-1]
        expected += replayed(packets[:12] + packets[20:])[len(expected) :]
        assert all(one.incomplete for one in got[before : before + 10])
    for one, e in zip(got, expected, strict=False):
        assert (one.stamp_ns, one.n_events) == (e.t_us * 1000, e.n_events)
        assert one.data.tobytes() == e.features.tobytes()


def test_a_camera_that_left_meanwhile_is_given_up(tmp_path, monkeypatch):
    """Its time stands still until it is heard or released: nobody knows whether it was silent."""
    path = tmp_path / "state"
    job = Job(path)
    job.keeper.write(job.process(put(job, batches(1)[0], 0)))
    list(job.keeper.finish())
    job.die()
    again = Job(path)
    again.intake._silence_s = 0.0
    assert list(again.intake._silences(0.04)) == []
    monkeypatch.setattr("streamfeat.live.intake._RESTORED_S", 0.05)
    gone = [item for _ in range(4) for item in again.intake._releases(0.02)]
    assert [item.topic for item in gone] == [KEY]
    again.process(gone)
    assert again.cameras.topics == []
    again.die()
    heard = Job(path)
    put(heard, batches(2)[1], 1)
    assert list(heard.intake._releases(1000.0)) == []
    assert [tick.topic for tick in heard.intake._silences(0.04)] == []
    heard.die()


def test_a_mark_comes_when_something_came(tmp_path):
    job = Job(tmp_path / "none", mark_s=0.0)
    put(job, batches(1)[0], 0)
    job.inbox.put(RawMessage(KEY, EventPacket.SCHEMA_NAME, message(batches(2)[1], 1), attachment(2), 0, 0))
    items = []
    for item in job.intake:
        items.append(item)
        if item is None and len(items) > 4:
            job.inbox.close()
    job.die()
    assert [type(item) for item in items if item is not None] == [Packet, Barrier]


def test_no_polarity_and_no_events_are_no_state():
    events = make_events([0], [0], [3], [0])
    session = Session(MODEL, EmitPolicy.parse("10ms"))
    assert session.snapshot().engine is None
    list(session.process(tiny.packet(events)))
    other = Session(MODEL, EmitPolicy.parse("10ms"))
    other.restore(session.snapshot())
    assert other.stats() == session.stats()
    assert other.stats().rejected == 1


def test_the_format_of_a_state_is_that_of_its_version(sound):
    """Files of version 1 were written by earlier programs: other names in them need another version."""
    _, header = read_safetensors(sound, "state", 1)
    camera, topic = header["cameras"][0], header["topics"][0]
    assert set(header) - {"format", "version"} == {"fingerprint", "saved_ns", "topics", "cameras"}
    assert set(camera) == {"topic", "moment", "stats", "resolution", "engine"}
    assert set(camera["moment"]) == {
        *("origin_us", "last_us", "next_us", "every_us", "unread", "epoch", "silent_us", "incomplete_us"),
        *("lost", "seen_label", "sample"),
    }
    assert set(camera["stats"]) == {
        *("events", "late", "rejected", "saturated", "emissions", "incomplete", "samples", "correct"),
        "unknown_labels",
    }
    assert set(topic) == {
        *("topic", "reader", "clock", "delivery", "resolution", "stream_us", "label_end_us", "lost"),
    }


def test_a_state_of_another_version_is_refused_in_one_line(sound, tmp_path):
    arrays, header = read_safetensors(sound, "state", 1)
    del header["format"], header["version"]
    path = tmp_path / "later"
    write_safetensors(path, "state", 2, arrays, header)
    with pytest.raises(InputError, match=r"later: .*version") as caught:
        Job(path)
    assert "\n" not in str(caught.value)
