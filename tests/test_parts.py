"""Parts of recordings: read one by one, anywhere, they hold everything once."""

import math
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from streamfeat.events import make_events
from streamfeat.recordings.reader import Label, Part, Recording, Sample, open_recording
from streamfeat.recordings.records import Losses
from streamfeat.recordings.writer import RecordingWriter

RESOLUTION = (60, 80)


def in_parts(recording, parts, read):
    for part in parts:
        with recording.part(part)() as one:
            yield from read(one)


def plain(item):
    if isinstance(item, Sample):
        return item.label, item.events.tolist(), item.resolution
    return repr(item)


@settings(max_examples=30)
@given(data=st.data())
def test_parts_hold_everything_once(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("parts") / "a.mcap"
    is_labelled, time = data.draw(st.booleans()), 0
    with RecordingWriter(path, chunk_size=data.draw(st.sampled_from([1, 300, 2000]))) as writer:
        for i in range(data.draw(st.integers(1, 8))):
            if is_labelled and data.draw(st.integers(0, 3)):
                writer.write_label(Label(time, data.draw(st.sampled_from([1, 200, 500])), str(i)))
            n = data.draw(st.integers(0, 40))
            writer.write_events(make_events(range(n), 0, 1, [time + 7 * k for k in range(n)]), RESOLUTION)
            time += 300
        writer.write_events(make_events([1], 0, 1, [time]), RESOLUTION)
    with open_recording(path) as recording:
        starts = sorted(recording._source.cuts())
        cuts = sorted({0, *data.draw(st.lists(st.sampled_from(starts), max_size=4))})
        parts = [Part(*ends) for ends in zip(cuts, [*cuts[1:], math.inf], strict=True)]
        for read in (Recording.items, Recording.samples):
            whole = [plain(item) for item in read(recording)]
            assert [plain(item) for item in in_parts(recording, parts, read)] == whole


def test_parts_are_of_the_file_alone(tmp_path):
    events = make_events(np.arange(600_000) % 200, 0, 1, np.arange(600_000))
    for encoding, expected in (("mono", 2), ("evt3", 1)):
        path = tmp_path / encoding
        with RecordingWriter(path, encoding=encoding, compression="none") as writer:
            writer.write_events(events, (1, 200))
        with open_recording(path) as recording:
            parts = recording.parts()
            assert (parts[0].start, parts[-1].end) == (0, math.inf)
            assert all(one.end == other.start for one, other in pairwise(parts))
            assert len(parts) >= expected
            assert (len(parts) == 1) == (expected == 1)
            got = np.concatenate([*in_parts(recording, parts, iter)])
            np.testing.assert_array_equal(got, events)


def test_damage_is_counted_in_the_part_where_it_is(tmp_path):
    path = tmp_path / "a.mcap"
    events = make_events(np.arange(600_000) % 200, 0, 1, np.arange(600_000))
    with RecordingWriter(path, compression="none") as writer:
        writer.write_label(Label(0, 10**9, "cat"))
        writer.write_events(events, (1, 200))
    with open_recording(path) as recording:
        parts = recording.parts()
        assert len(parts) > 1
    data = bytearray(path.read_bytes())
    data[parts[1].start + 5000] ^= 1
    path.write_bytes(data)
    found, read = Losses(), 0
    with open_recording(path) as recording:
        for part in parts:
            with recording.part(part)() as one:
                read += sum(len(sample.events) for sample in one.samples())
                found.add_all(one.losses)
        (sample,) = recording.samples()
        whole = recording.losses
    assert read == len(sample.events) < len(events)
    assert found.counts["damaged chunk"] == whole.counts["damaged chunk"] == 1
    assert found.bytes["damaged chunk"] == whole.bytes["damaged chunk"]
