"""The page, in a real browser where there is one: what it draws, whom it talks to, what it says."""

import http.client
import re
import socket
import threading
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import tiny
from live_net import PATIENCE_S, until

pytest.importorskip("foxglove", reason="the extra `view` is not installed")

from browser import Browser, find_chromium

from streamfeat.errors import InputError
from streamfeat.stream.emission import Emission
from streamfeat.view.channels import LiveBoard
from streamfeat.view.job import View
from streamfeat.view.page import PageServer, page
from streamfeat.view.sink import ViewSink, about

MODEL = tiny.encoder(k=3)
CLASSIFIER = tiny.classifier(MODEL)
PANELS = ("events", "bins", "volumes", "features", "scores", "latency")
INK = """(id => {
  const canvas = document.getElementById(id);
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const colours = new Set();
  for (let at = 0; at < data.length; at += 4) {
    if (data[at + 3]) colours.add((data[at] << 16) | (data[at + 1] << 8) | data[at + 2]);
  }
  return [...colours];
})"""
"""Colours that are drawn in a canvas."""

needs_chromium = pytest.mark.skipif(find_chromium() is None, reason="no chromium: apt-get install chromium")


@pytest.fixture
def server():
    opened = PageServer(page(1), 0)
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def browser():
    with Browser() as opened:
        yield opened


@pytest.fixture
def tab(browser):
    browser.open("about:blank")  # what was shown before tries to connect again
    browser.until("location.href == 'about:blank'")
    browser.requests.clear()
    browser.problems.clear()
    browser.resize(1280, 900)
    browser.prefer("light")
    return browser


@contextmanager
def shown(folder, items, classifier=CLASSIFIER, **options):
    """Serve a view of some items; gives the address of its page."""
    tiny.write_items(folder / "rec.mcap", items)
    MODEL.save(folder / "model")
    if classifier:
        classifier.save(folder / "classifier")
    chosen = folder / "classifier" if classifier else None
    lines = []
    view = View(folder / "rec.mcap", folder / "model", chosen, web_port=0, say=lines.append, **options)
    thread = threading.Thread(target=view.run)
    thread.start()
    try:
        until(lambda: any("waiting" in line for line in lines))
        yield next(line.partition(": ")[2] for line in lines if line.startswith("page"))
    finally:
        view.stop()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def look(tab, url, frames=1):
    tab.open(url)
    tab.until(f"Number(document.body?.dataset.frames) >= {frames}")
    # What was shown before somebody came is sent channel by channel.
    tab.until("['events', 'bins', 'volumes', 'features'].every((name) => model.last[name])")
    tab.settle()


def get(port, path):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    connection.request("GET", path)
    response = connection.getresponse()
    return response.status, response.read().decode()


def test_there_is_one_page_and_nothing_else(server):
    status, text = get(server.port, "/")
    assert status == 200
    assert text == page(1)
    assert [get(server.port, path)[0] for path in ("/other", "/../page.py", "/?camera=1")] == [404, 404, 200]


def test_the_page_needs_nothing_from_elsewhere():
    text = page(4711)
    assert not re.search(r"https?://|src=|@import|/\* (style|stream|plots|panels) \*/|STREAM_PORT", text)
    assert "default-src 'none'" in text
    assert len(text) < 60_000


def test_a_browser_that_goes_is_nobodys_error(server, capfd):
    for _ in range(5):
        with socket.create_connection(("127.0.0.1", server.port)) as one:
            one.sendall(b"GET / HTTP/1.1\r\n\r\n")
    assert get(server.port, "/")[0] == 200
    assert capfd.readouterr() == ("", "")


def test_a_web_port_in_use_is_one_clear_line(server):
    with pytest.raises(InputError, match=f"--web-port {server.port}: cannot listen there: Address already"):
        PageServer("", server.port)


@needs_chromium
def test_every_panel_is_drawn_and_only_we_are_asked(tab, tmp_path):
    with shown(tmp_path, tiny.labelled_items(6), emit="10ms", speed="1") as url:
        look(tab, url, frames=4)
        tab.until("model.scores.length > 3 && model.latency.length > 1")
        tab.settle()
        light = {id: tab.value(f"{INK}('{id}')") for id in PANELS}
        tab.prefer("dark")
        tab.until("matchMedia('(prefers-color-scheme: dark)').matches")
        tab.settle()
        dark = {id: tab.value(f"{INK}('{id}')") for id in PANELS}
        assert tab.value("document.documentElement.scrollWidth <= innerWidth")
        text = tab.value("document.body.innerText")
    for id in PANELS:
        assert len(light[id]) > 3, f"{id} shows something"
        assert set(light[id]) != set(dark[id]), f"{id} has colours of its own in the dark"
    for part in ("direct, split, K = 3", "samples right", "cat", "dog", "owl", "packets lost", "stream time"):
        assert part in text
    assert tab.problems == []
    assert {re.sub(r":\d+/.*", "", address) for address in tab.requests} == {
        "http://127.0.0.1",
        "ws://127.0.0.1",
    }


@needs_chromium
def test_pixels_are_those_of_the_stream(tab, tmp_path):
    event = tiny.stream([10_000])
    with shown(tmp_path, [tiny.packet(event)], classifier=None) as url:
        look(tab, url)
        picture = tab.value("({ ...model.last.events, data: [...model.last.events.data] })")
        assert tab.value("model.scores.length") == 0
        assert "events1" in tab.value("document.getElementById('counts').innerText").replace("\n", "")
    height, width = tiny.RESOLUTION
    assert (picture["width"], picture["height"]) == (width, height)
    lit = {at: value for at, value in enumerate(picture["data"]) if value != 128}
    assert lit == {int(event["y"][0]) * width + int(event["x"][0]): 255 if event["p"][0] else 1}
    assert tab.problems == []


@needs_chromium
def test_a_page_without_anything_to_show_says_so(tab, tmp_path):
    board = LiveBoard(about(MODEL, ("only one",)), "test", 0)
    server = PageServer(page(board.port), 0)
    try:
        tab.open(f"http://127.0.0.1:{server.port}/")
        tab.until("document.getElementById('state')?.textContent == 'connected, waiting for events'")
        board.announce("/view")
        tab.until("model.about !== null && stream.wanted.size == 6")
        # One class, one reading, nothing else.
        board.record(
            "/view", "prediction", 0, {"t_s": 0, "label": "only one", "scores": [0.5], "sample": None}
        )
        tab.until("model.scores.length == 1")
        tab.settle()
        assert "only one" in tab.value("document.getElementById('legend').innerText")
    finally:
        board.close()
    tab.until("document.getElementById('state').textContent == 'connection lost, trying again'")
    server.close()
    assert not [problem for problem in tab.problems if "WebSocket" not in problem]


@needs_chromium
def test_a_subscription_that_came_too_soon_is_made_again(tab, tmp_path):
    with shown(tmp_path, tiny.labelled_items(1)) as url:
        look(tab, url)
        tab.value("sent = []; stream.send = (message) => sent.push(message); 0")
        wanted = tab.value("[...stream.wanted]")
        for _, channel in wanted:
            tab.value(f"stream.refused('Unknown channel ID: {channel}'); 0")
        tab.value("stream.refused('Unknown channel ID: 987654'); stream.refused('something else'); 0")
        tab.until(f"sent.length >= {len(wanted)}")
        again = [one["subscriptions"][0] for one in tab.value("sent")]
    assert [[one["id"], one["channelId"]] for one in again] == wanted


@needs_chromium
def test_cameras_can_be_chosen_and_missed_pictures_are_counted(tab):
    board = LiveBoard(about(MODEL, ()), "test", 0)
    server = PageServer(page(board.port), 0)
    status = {
        "t_s": 0,
        "width": 16,
        "height": 12,
        "events": 5,
        "events_per_s": 0,
        "active_volumes": 1,
        "volumes": 12,
        "update_us": {"median": 0, "max": 0, "n": 0},
        "drops": {"late": 2},
    }
    try:
        tab.open(f"http://127.0.0.1:{server.port}/")
        for camera in ("left", "right"):
            board.record(f"/{camera}/view", "status", 0, status | {"frame": 1, "camera": camera})
        tab.until("document.getElementById('camera')?.options.length == 2 && model.frame == 1")
        assert tab.value("model.last.status.camera") == "left"
        for camera in ("right", "left", "right"):
            tab.value(f"at('camera').value = '/{camera}/view'; at('camera').onchange()")
            tab.until(f"model.last.status?.camera == '{camera}'")
        board.record("/right/view", "status", 0, status | {"frame": 5, "camera": "right"})
        tab.until("document.body.dataset.missed == '3'")
        assert tab.value("document.querySelectorAll('#counts .some').length") == 2
    finally:
        server.close()
        board.close()


@needs_chromium
@pytest.mark.parametrize("pooling", [1, 2, 3])
def test_each_cell_has_its_bars(tab, pooling):
    geometry = replace(tiny.GEOMETRY, patch=2, stride=2, pooling=pooling)
    model = tiny.encoder(k=3, geometry=geometry)
    features = np.arange(model.n_features, dtype=np.float32)
    emission = Emission(1_000, 1, features, (), np.zeros(0, np.float32), None, False)
    board = LiveBoard(about(model, ()), "test", 0)
    server = PageServer(page(board.port), 0)
    sink = ViewSink([board], model, rate=20, live=False, prefix=lambda topic: "/view", drops=dict)
    board.announce("/view")
    sink.write([emission])
    try:
        tab.open(f"http://127.0.0.1:{server.port}/")
        tab.until("typeof model == 'object' && model.last.features")
        tab.settle()
        cells = tab.value("model.last.features.cells")
        assert len(tab.value(f"{INK}('features')")) > 3
        assert tab.value("model.scale") == tab.value(f"roundUp({features.max()})")
        assert tab.problems == []
    finally:
        server.close()
        board.close()
    for cell, row in zip(cells, features.reshape(pooling**2, 2, -1), strict=True):
        assert cell == {"positive": row[0].tolist(), "negative": row[1].tolist()}
