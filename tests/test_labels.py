"""Label files: which times they mean, where their labels stand in a stream, and what is wrong with them."""

import numpy as np
import pytest
import tiny

import streamfeat as sf
from streamfeat.errors import InputError
from streamfeat.messages.packets import Label, Packet
from streamfeat.recordings.labels import read_labels
from streamfeat.recordings.options import ReadOptions

FIRST_US = 3_000_000


@pytest.fixture
def recording(tmp_path):
    events = tiny.steady(FIRST_US, FIRST_US + 2_000_000, 4_000)
    events["t"][0] = FIRST_US
    parts = [tiny.packet(part) for part in np.array_split(events, 7)]
    return tiny.write_items(tmp_path / "in.mcap", parts)


def table(tmp_path, text):
    (tmp_path / "labels.csv").write_text(text)
    return tmp_path / "labels.csv"


def opened(recording, labels):
    return sf.open_recording(recording, options=ReadOptions(labels=str(labels)))


SECONDS = "start_s,end_s,label\n0.25,0.75,cat\n1.0,1.5,dog\n"
SAME = {
    "seconds": SECONDS,
    "milliseconds": "start_ms,end_ms,label\n250,750,cat\n1000,1500,dog\n",
    "stream time": "start_us,end_us,label\n3250000,3750000,cat\n4000000,4500000,dog\n",
    "durations": "onset_s;duration_s;class\n0.25;0.5;cat\n1.0;0.5;dog\n",
    "seconds by their values": "Start,End,Label\n0.25,0.75,cat\n1.0,1.5,dog\n",
    "stream time by its values": "label\tstart\tend\ncat\t3250000\t3750000\ndog\t4000000\t4500000\n",
    "not in order, byte order mark": "\ufeffstart_s,end_s,label\n1.0,1.5,dog\n0.25,0.75,cat\n\n",
}


@pytest.mark.parametrize("text", SAME.values(), ids=SAME)
def test_the_same_labels_in_any_way(recording, tmp_path, text):
    with opened(recording, table(tmp_path, text)) as rec:
        found = [(label.start_us, label.duration_us, label.label) for label in rec.labels]
        assert found == [(3_250_000, 500_000, "cat"), (4_000_000, 500_000, "dog")]
        assert rec.is_labelled
        assert bool(rec.assumptions) == ("_" not in text.partition("\n")[0])


def test_a_sample_has_the_events_of_its_time_and_the_stream_loses_none(recording, tmp_path):
    with sf.open_recording(recording) as rec:
        events = np.concatenate([*rec])
    with opened(recording, table(tmp_path, SECONDS)) as rec:
        for sample in rec.samples():
            start, end = sample.label.start_us, sample.label.start_us + sample.label.duration_us
            expected = events[(events["t"] >= start) & (events["t"] < end)]
            np.testing.assert_array_equal(sample.events, expected)
        np.testing.assert_array_equal(np.concatenate([*rec]), events)
        before: list[Packet] = []
        for item in rec.items():
            if isinstance(item, Label):
                assert all(p.events["t"].max() < item.start_us for p in before)
            else:
                before.append(item)


def test_split_and_source_are_kept(recording, tmp_path):
    text = "start_s,end_s,label,split,source\n0,0.5,cat,test,video 7\n"
    with opened(recording, table(tmp_path, text)) as rec:
        assert [(label.split, label.source) for label in rec.labels] == [("test", "video 7")]


def test_they_stand_in_place_of_those_of_the_recording(tmp_path):
    path = tiny.write_items(tmp_path / "in.mcap", tiny.labelled_items(3))
    with opened(path, table(tmp_path, "start_s,end_s,label\n0,0.1,mine\n")) as rec:
        assert [label.label for label in rec.labels] == ["mine"]


BAD = {
    "overlap": ("start_s,end_s,label\n0,1,a\n0.5,2,b\n", "lines 2 and 3 overlap"),
    "unknown column": ("start_s,end_s,label,speed\n0,1,a,3\n", "unknown: speed"),
    "no label": ("start_s,end_s\n0,1\n", "columns start_s,end_s are not those of labels"),
    "two units": ("start_s,end_us,label\n0,1,a\n", "two units"),
    "no number": ("start_s,end_s,label\n0,1,a\nx,2,b\n", "line 3: start 'x' is no number"),
    "not a number": ("start_s,end_s,label\nnan,1,a\n", "is no number"),
    "ends before": ("start_s,end_s,label\n2,1,a\n", "not after its start"),
    "empty label": ("start_s,end_s,label\n0,1,\n", "the label is empty"),
    "short row": ("start_s,end_s,label\n0\n", "line 2: end '' is no number"),
    "beyond time": ("start_s,end_s,label\n0,1e30,a\n", "no time of a recording"),
    "empty": ("", "holds no labels"),
    "names only": ("start_s,end_s,label\n", "holds no labels"),
}


@pytest.mark.parametrize(("text", "reason"), BAD.values(), ids=BAD)
def test_what_is_wrong_is_said_in_one_line(tmp_path, text, reason):
    with pytest.raises(InputError, match=reason) as error:
        read_labels(table(tmp_path, text))
    assert str(error.value).startswith(str(tmp_path))


def test_a_file_of_another_recording_and_none(recording, tmp_path):
    with (
        opened(recording, table(tmp_path, "start_us,end_us,label\n90000000,99000000,a\n")) as rec,
        pytest.raises(InputError, match="no label lies within the recording"),
    ):
        _ = rec.labels
    with pytest.raises(InputError, match="labels cannot be read"):
        opened(recording, tmp_path / "none.csv")


def test_train_and_replay_take_them(run, tmp_path):
    items, rows = [], ["start_s,end_s,label"]
    for i, item in enumerate(tiny.labelled_items(18)):
        if isinstance(item, Label):
            start = (item.start_us - 150_000) / 1e6
            rows.append(f"{start},{start + item.duration_us / 1e6},{item.label}")
        else:
            if i == 1:
                item.events["t"][0] = 150_000
            items.append(item)
    path, labels = tiny.write_items(tmp_path / "in.mcap", items), table(tmp_path, "\n".join(rows))
    model, classifier = tmp_path / "m.safetensors", tmp_path / "c.safetensors"
    tiny.encoder().save(model)
    bare = run("train", path, "-m", model, "-o", classifier)
    assert (bare.status, "--labels" in bare.err) == (2, True)
    trained = run("train", path, "-m", model, "-o", classifier, "--labels", labels, "--json")
    assert (trained.status, trained.json["samples"]) == (0, 18)
    replayed = run("replay", path, "-m", model, "-c", classifier, "--labels", labels, "--json").json
    assert (replayed["samples"], replayed["late"]) == (18, 0)
    assert replayed["correct"] > 6
