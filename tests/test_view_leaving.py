"""A view of cameras that come and go: nothing is kept of those that left, little of others."""

import time

import numpy as np
import pytest
import tiny

from streamfeat.engine.engine import EngineStats
from streamfeat.messages.packets import Packet
from streamfeat.stream.cameras import MAX_CAMERAS, CameraLeft
from streamfeat.view.observe import Sight, Updates
from streamfeat.view.page import page
from streamfeat.view.server import PageServer
from streamfeat.view.sink import ViewSink

ENCODER = tiny.encoder(k=3)


class Board:
    """Knows the cameras that it shows."""

    def __init__(self):
        self.shown = set()

    def picture(self, prefix, name, t_us, picture):
        self.shown.add(prefix)

    def record(self, prefix, name, t_us, record):
        self.shown.add(prefix)

    def forget(self, prefix):
        self.shown.discard(prefix)


def view_of(boards):
    return ViewSink(boards, ENCODER, rate=1000, live=True, prefix=lambda topic: f"/{topic}", drops=dict)


def sight(topic):
    grid = ENCODER.geometry.grid_shape(tiny.RESOLUTION)
    counts = np.zeros((ENCODER.geometry.n_bins, *tiny.RESOLUTION), np.int32)
    activity, stats = np.zeros(grid, np.int64), EngineStats(0, 0, 0, 0, 0, 0, 0)
    return Sight(topic, tiny.RESOLUTION, (), (0, 1), 0, counts, activity, stats, Updates(0, 0, 0))


def test_a_camera_that_leaves_is_forgotten(tmp_path):
    board = Board()
    sink = view_of([board])

    def items():
        for i in range(5):
            yield Packet(f"robot{i}", tiny.stream([5]), tiny.RESOLUTION, 0, 0)
            sink.watch(f"robot{i}").see(sight(f"robot{i}"))
            if i % 2:
                sink.write([])
            else:
                sink.watch(f"robot{i}").see(sight(f"robot{i}"))  # the one before is not drawn any more
            assert board.shown == {f"/robot{i}"}
            yield CameraLeft(f"robot{i}")

    assert len([*sink.tap().items(items())]) == 10
    assert board.shown == set()
    assert sink.skipped == 3
    sink.write([])
    assert board.shown == set()


def test_cameras_that_end_without_a_word_are_few():
    sink = view_of([])
    for i in range(3 * MAX_CAMERAS):
        sink.watch(f"robot{i}").see(sight(f"robot{i}"))
    assert len(sink._slots) == MAX_CAMERAS


def test_the_page_keeps_nothing_of_a_camera_that_left():
    server = PageServer(page, 0)
    try:
        for camera in ("/a", "/b"):
            server.picture(camera, "events", 0, np.zeros((4, 4), np.uint8))
        server.forget("/a")
        until = time.monotonic() + 20
        while {camera for camera, _ in server._latest} != {"/b"}:
            assert time.monotonic() < until
            time.sleep(0.01)
    finally:
        server.close()
    server.forget("/b")


def test_channels_of_a_camera_that_left_are_closed(tmp_path):
    pytest.importorskip("foxglove", reason="the extra `view` is not installed")
    from streamfeat.view.channels import FileBoard

    board = FileBoard({}, tmp_path / "out.mcap")
    board.record("/a", "status", 1, {"frame": 1})
    board.forget("/a")
    assert (board._channels, board._last) == ({}, {})
    board.record("/a", "status", 2, {"frame": 2})
    board.close()
