"""Labelled samples of a camera whose clock starts anew between them or within one."""

import numpy as np
import pytest
import tiny
from mcap.writer import Writer
from test_timeline import HOST_NS

from streamfeat.classify.features import encode_recordings, sample_end
from streamfeat.messages.cdr import EventPacket, LabelMessage
from streamfeat.messages.codecs import encode
from streamfeat.messages.packets import Label
from streamfeat.recordings.options import ReadOptions
from streamfeat.recordings.reader import open_recording
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session

MODEL = tiny.encoder()
SAMPLE_US, GAP_US = 80_000, 150_000


def write(path, runs, *, labels=True, encoding="mono", packets=4):
    """Runs of the clock, each from a time on with names of samples: `[(1_000, "ab"), (0, "c")]`.

    Returns the labels in order, each with its events. The host's time goes on through all of them.
    """
    made, host_us, seed = [], 0, 0
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=3000)
        writer.start("ros2")
        for_events, for_labels = (
            writer.register_channel(
                topic, "cdr", writer.register_schema(kind.SCHEMA_NAME, "ros2msg", kind.SCHEMA.encode())
            )
            for topic, kind in (("/events", EventPacket), ("/label", LabelMessage))
        )
        for begin_us, names in runs:
            seq = after_us = 0
            for i, name in enumerate(names):
                start_us = begin_us + i * (SAMPLE_US + GAP_US)
                seed += 1
                events = tiny.steady(start_us, start_us + SAMPLE_US, 400, seed)
                label = Label(start_us, SAMPLE_US, name, "train", f"{seed}")
                made.append((label, events))
                log_ns = HOST_NS + (host_us + start_us - begin_us) * 1000
                if labels:
                    about = label.start_us * 1000, "", SAMPLE_US * 1000, name, "train", f"{seed}"
                    writer.add_message(for_labels, log_ns, LabelMessage(*about).to_cdr(), log_ns, 0)
                for part in np.array_split(events, packets):
                    payload, base_ns = encode(part, encoding, after_us)
                    after_us = int(part["t"][-1])
                    at_ns = log_ns + (after_us - start_us) * 1000
                    head = at_ns, "", *tiny.RESOLUTION, seq, base_ns, encoding, False
                    writer.add_message(for_events, at_ns, EventPacket(*head, payload).to_cdr(), at_ns, seq)
                    seq += 1
            host_us += len(names) * (SAMPLE_US + GAP_US) + 500_000
        writer.finish()
    return made


RUNS = {
    "to earlier times": [(5_000_000, "abc"), (1_000, "cab")],
    "to the same times": [(1_000, "abc"), (1_000, "cba")],
    "into the time of a sample": [(1_000, "abc"), (50_000, "ab")],
    "again and again": [(1_000, "a"), (1_000, "b"), (1_000, "c"), (1_000, "a"), (1_000, "b")],
    "far ahead": [(1_000, "ab"), (500_000_000, "bc")],
}


@pytest.mark.parametrize("runs", RUNS.values(), ids=RUNS)
@pytest.mark.parametrize("encoding", ["mono", "evt3"])
def test_each_sample_has_its_own_events(tmp_path, runs, encoding):
    if encoding == "evt3" and runs[-1][0] > 10_000_000:
        pytest.skip("its clock of 16.8 s cannot show such a jump")
    made = write(tmp_path / "a.mcap", runs, encoding=encoding)
    with open_recording(tmp_path / "a.mcap") as recording:
        samples = list(recording.samples())
        assert [sample.label for sample in samples] == [label for label, _ in made]
        for sample, (_, events) in zip(samples, made, strict=True):
            np.testing.assert_array_equal(sample.events, events)
        rows = encode_recordings(MODEL, [recording]).rows
    for row, (label, events) in zip(rows, made, strict=True):
        wanted = MODEL.encode(events, tiny.RESOLUTION, origin_us=label.start_us, t_us=sample_end(label))
        np.testing.assert_array_equal(row, wanted)


@pytest.mark.parametrize("emit", ["auto", "10ms", "event"])
@pytest.mark.parametrize("runs", RUNS.values(), ids=RUNS)
def test_each_is_predicted_from_its_own_events(tmp_path, runs, emit):
    made = write(tmp_path / "a.mcap", runs)
    session = Session(MODEL, EmitPolicy.parse(emit))
    with open_recording(tmp_path / "a.mcap") as recording:
        found = [e for item in recording.items() for e in session.process(item)]
    found += session.finish()
    finals = [e for e in found if e.final]
    assert [e.sample for e in finals] == [label for label, _ in made]
    for emission, (label, events) in zip(finals, made, strict=True):
        wanted = MODEL.encode(events, tiny.RESOLUTION, origin_us=label.start_us, t_us=sample_end(label))
        np.testing.assert_array_equal(emission.features, wanted)
        assert not emission.incomplete
    assert session.stats().late == 0


def test_within_a_sample_it_ends_where_the_clock_does(tmp_path):
    """The second half of the sample is of no label: nothing tells what time it was there."""
    made = write(tmp_path / "a.mcap", [(5_000_000, "a"), (0, "b")])
    (label, before), (_, after) = made
    path = tmp_path / "cut.mcap"
    with path.open("wb") as file, open_recording(tmp_path / "a.mcap") as whole:
        writer = Writer(file)
        writer.start("ros2")
        channels = [
            writer.register_channel(
                topic, "cdr", writer.register_schema(kind.SCHEMA_NAME, "ros2msg", kind.SCHEMA.encode())
            )
            for topic, kind in (("/events", EventPacket), ("/label", LabelMessage))
        ]
        about = label.start_us * 1000, "", 10_000_000_000, "a", "", ""
        writer.add_message(channels[1], HOST_NS, LabelMessage(*about).to_cdr(), HOST_NS, 0)
        for i, events in enumerate(whole):
            log_ns = HOST_NS + i * 20_000_000
            payload, base_ns = encode(events, "mono")
            head = log_ns, "", *tiny.RESOLUTION, i % 4, base_ns, "mono", False
            writer.add_message(channels[0], log_ns, EventPacket(*head, payload).to_cdr(), log_ns, i % 4)
        writer.finish()
    with open_recording(path) as recording:
        (sample,) = recording.samples()
        np.testing.assert_array_equal(sample.events, before)
        session = Session(MODEL, EmitPolicy.parse("10ms"))
        found = [e for item in recording.items() for e in session.process(item)] + [*session.finish()]
    (final,) = [e for e in found if e.final]
    wanted = MODEL.encode(before, tiny.RESOLUTION, origin_us=label.start_us, t_us=label.start_us + 9_999_999)
    np.testing.assert_array_equal(final.features, wanted)
    assert session.stats().events == len(before) + len(after)


class TestLabelTables:
    def read(self, tmp_path, text, runs):
        made = write(tmp_path / "a.mcap", runs, labels=False)
        (tmp_path / "l.csv").write_text(text)
        options = ReadOptions(labels=str(tmp_path / "l.csv"))
        with open_recording(tmp_path / "a.mcap", options=options) as recording:
            return made, list(recording.samples())

    def test_seconds_go_on_by_the_clock_of_the_host(self, tmp_path):
        runs = [(5_000_000, "abc"), (1_000, "cab")]
        second_s = (3 * (SAMPLE_US + GAP_US) + 500_000) / 1e6
        text = "start_s,end_s,label\n"
        for begin_s, (_, names) in zip((0, second_s), runs, strict=True):
            for i, name in enumerate(names):
                start_s = begin_s + i * (SAMPLE_US + GAP_US) / 1e6
                text += f"{start_s - 0.02},{start_s + 0.1},{name}\n"
        made, samples = self.read(tmp_path, text, runs)
        assert [sample.label.label for sample in samples] == list("abccab")
        for sample, (_, events) in zip(samples, made, strict=True):
            np.testing.assert_array_equal(sample.events, events)

    def test_stream_times_mean_the_first_run_that_reaches_them(self, tmp_path):
        text = "start_us,end_us,label\n5000000,5080000,x\n1000,81000,y\n"
        made, samples = self.read(tmp_path, text, [(5_000_000, "a"), (1_000, "b"), (1_000, "c")])
        assert [sample.label.label for sample in samples] == ["x", "y"]
        for sample, (_, events) in zip(samples, made[:2], strict=True):
            np.testing.assert_array_equal(sample.events, events)


def test_the_span_of_a_recording_is_that_of_its_runs(run, tmp_path):
    write(tmp_path / "a.mcap", [(1_000, "ab"), (3_600_000_000, "a"), (1_000, "abc")])
    said = run("info", tmp_path / "a.mcap", "--json").json
    assert said["duration_s"] == pytest.approx(0.310 + 0.080 + 0.540, abs=0.01)
