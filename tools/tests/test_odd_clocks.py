"""Endless copies and restarts, at a small size."""

import tracemalloc

import pytest

from streamfeat.recordings.reader import open_recording
from tools.odd_clocks import write


@pytest.mark.parametrize(
    ("kind", "used", "counted"), [("copies", 4, "duplicates"), ("restarts", 80_000, "restarts")]
)
def test_endless_copies_and_restarts_are_read_in_bounded_memory(tmp_path, kind, used, counted):
    """`python tools/odd_clocks.py --messages 10000000` measures it at full size."""
    n = write(tmp_path / "a.mcap", kind, 20_000)
    assert n == 20_000
    with open_recording(tmp_path / "a.mcap") as recording:
        batches = iter(recording)
        next(batches)
        tracemalloc.start()
        assert sum(len(batch) for batch in batches) == used - 4
        held = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert dict(recording.counts) == {counted: n - 1 if kind == "copies" else n // 10 - 1}
    # A chunk of 1.4 MB and its messages; nothing is kept of those that were given or left out.
    assert held < 16 << 20
