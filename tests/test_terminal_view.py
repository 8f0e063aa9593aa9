"""The live picture: which character is lit where, and what a terminal must have for it."""

import io

import numpy as np
import pytest
import tiny
from rich.console import Console

from streamfeat.demo.terminal import EventPicture, TerminalView, draw_while
from streamfeat.events import make_events
from streamfeat.recordings.reader import Label
from streamfeat.stream.emission import Emission


def terminal(width=60, **options):
    # `legacy_windows` would turn blocks off; the encoding is that of the file.
    file = io.TextIOWrapper(io.BytesIO(), encoding=options.pop("encoding", "utf-8"))
    options = {"force_terminal": True, "color_system": "truecolor", "_environ": {}} | options
    return Console(file=file, width=width, height=40, **options)


def lines(picture, now_us):
    return [line.rstrip() for line in picture.draw(now_us).plain.split("\n")]


def test_a_character_is_two_pixels():
    picture = EventPicture((4, 6))
    picture.add(make_events([0, 1, 2, 2, 3], [0, 1, 0, 1, 3], [1, 0, 1, 1, 0], [5] * 5))
    assert lines(picture, 5) == ["▀▄█", "   ▄"]


def test_what_is_on_is_warm_and_what_is_off_is_blue():
    picture = EventPicture((2, 2))
    picture.add(make_events([0, 1], [0, 0], [1, 0], [5, 5]))
    warm, blue = (span.style.color.triplet for span in picture.draw(5).spans)
    assert warm.red > warm.blue
    assert blue.blue > blue.red


def test_light_fades_with_stream_time_however_often_it_is_drawn():
    picture = EventPicture((2, 2))
    picture.add(make_events([0, 1], [0, 0], [1, 1], [0, 100_000]))
    assert lines(picture, 100_000) == [" ▀"]
    assert lines(picture, 100_000) == [" ▀"]
    assert lines(picture, 200_000) == [""]


def test_a_wide_sensor_is_drawn_smaller_and_what_is_outside_not_at_all():
    picture = EventPicture((480, 640), columns=32)
    picture.add(make_events([639, 700, 639], [479, 0, 9999], [1, 1, 1], [0] * 3))
    drawn = lines(picture, 0)
    assert (len(drawn), len(drawn[-1])) == (12, 32)
    assert drawn[-1].strip() == "▄"
    assert not any(drawn[:-1])


@pytest.mark.parametrize(
    ("options", "fits"),
    [
        ({}, True),
        ({"width": 59}, False),
        ({"force_terminal": False}, False),
        ({"encoding": "ascii"}, False),
        ({"_environ": {"TERM": "dumb"}}, False),
        ({"no_color": True}, True),
    ],
)
def test_what_a_terminal_must_have(options, fits):
    assert TerminalView.fits(terminal(**options)) == fits


@pytest.mark.parametrize("no_color", [False, True])
def test_sixty_columns_hold_picture_bars_and_counts(no_color):
    console = terminal(no_color=no_color)
    now = 0.0
    view = TerminalView(console, (34, 34), clock=lambda: now)
    sample = Label(0, 100, "5", "test")
    labels = tuple("0123456789")
    for i in range(4):
        scores = np.eye(10, dtype=np.float32)[5 if i else 3]
        view.picture.add(tiny.steady(i * 100, i * 100 + 100, 50, resolution=(34, 34)))
        view.write([Emission(i * 100, i, np.zeros(4, np.float32), labels, scores, sample, True)])
    console.file.seek(0)
    # The clock stood still, so only the first was drawn so far.
    assert "0 % of 1 right" in console.file.read()
    view.close(failed=False)
    console.file.seek(0)
    written = console.file.read()
    assert "75 % of 4 right" in written
    assert "this is a 5" in written
    assert ("38;2;" in written) == (not no_color)
    assert "━" in written


def test_bars_have_one_scale_for_all_that_was_drawn():
    console = terminal(color_system=None)
    view = TerminalView(console, (34, 34), clock=lambda: 0.0)
    lengths = []
    for top in (4.0, 1.0, 8.0):
        scores = np.array([0.0, top, top / 2], np.float32)
        bars = view._bars(Emission(0, 0, np.zeros(4, np.float32), ("a", "b", "c"), scores, None, False))
        lengths.append([len(bar.plain) for bar in bars.columns[1]._cells])
    assert lengths == [[0, 16, 8], [0, 4, 2], [0, 16, 8]]
    view.close(failed=False)


def test_features_without_a_classifier_are_drawn_too():
    console = terminal()
    view = TerminalView(console, (34, 34))
    view.write([Emission(0, 7, np.zeros(4, np.float32), (), np.zeros(0, np.float32), None, False)])
    view.close(failed=False)
    console.file.seek(0)
    assert "7 events" in console.file.read()


def test_events_are_drawn_until_something_else_is_done():
    console, asked = terminal(), []

    def goes_on():
        asked.append(1)
        return len(asked) < 4

    packets = [tiny.packet(tiny.steady(i * 50_000, i * 50_000 + 50_000, 200)) for i in range(40)]
    draw_while(goes_on, console, packets, tiny.RESOLUTION)
    assert len(asked) == 4
    console.file.seek(0)
    assert "█" in console.file.read()
    draw_while(lambda: True, console, packets[:1], tiny.RESOLUTION)


def test_a_view_of_nothing_closes():
    TerminalView(terminal(), (34, 34)).close(failed=True)
