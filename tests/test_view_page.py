"""The page, in a real browser where there is one: what it draws, whom it talks to, what it says."""

import http.client
import json
import re
import socket
import threading
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np
import pytest
import tiny
from browser import Browser, find_chromium
from live_net import PATIENCE_S, until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from streamfeat.errors import InputError
from streamfeat.stream.emission import Emission
from streamfeat.view.job import View
from streamfeat.view.page import page
from streamfeat.view.server import PageServer
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
LAST = "model.cameras.get(model.camera)?.last ?? {}"
"""What was last shown of the camera that is looked at."""

needs_chromium = pytest.mark.skipif(find_chromium() is None, reason="no chromium: apt-get install chromium")


@pytest.fixture
def server():
    opened = PageServer(page, 0)
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
    tab.until(f"['events', 'bins', 'volumes', 'features'].every((name) => ({LAST})[name])")
    tab.settle()


def get(server, path, token=True, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE_S)
    address = path + server.address.partition("/?")[2].join(("?", "")) if token else path
    connection.request("GET", address, headers=headers)
    response = connection.getresponse()
    return response.status, response.read().decode()


@pytest.mark.real_time
def test_there_is_one_page_for_those_who_know_the_token(server):
    status, text = get(server, "/")
    assert status == 200
    assert text == page(server.port, server.address.partition("token=")[2])
    assert get(server, "/other")[0] == 404
    assert get(server, "/", token=False)[0] == get(server, "/?token=guess", token=False)[0] == 403


@pytest.mark.real_time
@pytest.mark.parametrize("path", ["/", "/stream"])
@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Host": "127.0.0.1:1"},
    ],
)
def test_other_names_and_pages_of_other_origins_get_nothing(server, path, headers):
    upgrade = {
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        "Sec-WebSocket-Version": "13",
    }
    status, text = get(server, path, **(upgrade if path == "/stream" else {}), **headers)
    assert status == 403
    assert "script" not in text


@pytest.mark.real_time
def test_a_browser_is_shown_the_latest_and_asks_for_what_makes_sense():
    asked, looked = [], []
    server = PageServer(page, 0, on_viewer=lambda: looked.append(1), on_asked=asked.append)
    address = server.address.replace("http", "ws").replace("/?", "/stream?")
    for i in range(3):
        server.record("/view", "status", 0, {"frame": i})
    server.picture("/view", "events", 0, np.array([[1, 2, 3], [4, 5, 6]], np.uint8))
    try:
        with connect(address) as browser:
            text, data = browser.recv(PATIENCE_S), browser.recv(PATIENCE_S)
            assert json.loads(text) == {"camera": "/view", "channel": "status", "record": {"frame": 2}}
            length = int.from_bytes(data[:2], "little")
            header = {"camera": "/view", "channel": "events", "width": 3, "height": 2}
            assert json.loads(data[2 : 2 + length]) == header
            assert data[2 + length :] == bytes([1, 2, 3, 4, 5, 6])
            for message in ("no json", "[1]", "{}", "[" * 3000, b"\xff", '{"op": "step"}'):
                browser.send(message)
            until(lambda: asked)
        assert asked == [{"op": "step"}]
        assert looked == [1]
        with connect(address) as browser:
            browser.send("x" * 5000)
            browser.recv(PATIENCE_S), browser.recv(PATIENCE_S)
            with pytest.raises(ConnectionClosed):
                browser.recv(PATIENCE_S)
        assert get(server, "/")[0] == 200
    finally:
        server.close()


@pytest.mark.real_time
def test_no_more_than_sixteen_browsers_look(server):
    address = server.address.replace("http", "ws").replace("/?", "/stream?")
    with ExitStack() as looking:
        for _ in range(16):
            looking.enter_context(connect(address))
        with pytest.raises(InvalidStatus, match="503"):
            connect(address)


def test_the_page_needs_nothing_from_elsewhere():
    text = page(4711, "secret")
    assert not re.search(r"https?://|src=|@import|/\* (style|stream|plots|panels) \*/|STREAM_", text)
    assert "default-src 'none'" in text
    assert len(text) < 60_000


@pytest.mark.real_time
def test_a_browser_that_goes_is_nobodys_error(server, capfd):
    for _ in range(5):
        with socket.create_connection(("127.0.0.1", server.port)) as one:
            one.sendall(b"GET / HTTP/1.1\r\n\r\n")
    assert get(server, "/")[0] == 200
    assert capfd.readouterr() == ("", "")


@pytest.mark.real_time
def test_a_web_port_in_use_is_one_clear_line(server):
    with pytest.raises(
        InputError, match=f"--web-port {server.port}: cannot listen there: Address already in use"
    ):
        PageServer(page, server.port)


@pytest.mark.real_time
@needs_chromium
def test_every_panel_is_drawn_and_only_we_are_asked(tab, tmp_path):
    with shown(tmp_path, tiny.labelled_items(6), emit="10ms", speed=1.0) as url:
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
    for part in ("direct, split, K = 3", "samples right", "cat", "dog", "owl", "event rate", "stream time"):
        assert part in text
    assert tab.problems == []
    assert {re.sub(r":\d+/.*", "", address) for address in tab.requests} == {
        "http://127.0.0.1",
        "ws://127.0.0.1",
    }


@pytest.mark.real_time
@needs_chromium
def test_pixels_are_those_of_the_stream(tab, tmp_path):
    event = tiny.stream([10_000])
    with shown(tmp_path, [tiny.packet(event)], classifier=None) as url:
        look(tab, url)
        picture = tab.value(f"(({{ events }}) => ({{ ...events, data: [...events.data] }}))({LAST})")
        assert tab.value("model.scores.length") == 0
        assert "events1" in tab.value("document.getElementById('counts').innerText").replace("\n", "")
    height, width = tiny.RESOLUTION
    assert (picture["width"], picture["height"]) == (width, height)
    lit = {at: value for at, value in enumerate(picture["data"]) if value != 128}
    assert lit == {int(event["y"][0]) * width + int(event["x"][0]): 255 if event["p"][0] else 1}
    assert tab.problems == []


@pytest.mark.real_time
@needs_chromium
def test_events_alone_fill_the_page_and_can_be_steered(tab, tmp_path):
    tiny.write_items(tmp_path / "rec.mcap", [tiny.packet(tiny.steady(0, 900_000, 3_000))])
    lines = []
    view = View(tmp_path / "rec.mcap", web_port=0, say=lines.append)
    thread = threading.Thread(target=view.run)
    thread.start()
    try:
        until(lambda: any("waiting" in line for line in lines))
        tab.open(next(line.partition(": ")[2] for line in lines if line.startswith("page")))
        tab.until("typeof model !== 'undefined'")
        player = f"({LAST}).player"
        tab.until(f"typeof model == 'object' && ({player})?.ended && ({LAST}).timeline?.done")
        assert tab.value("getComputedStyle(document.querySelector('.features')).display") == "none"
        assert tab.value(f"({LAST}).timeline.counts.reduce((a, b) => a + b)") == 3_000
        tab.value("stream.ask('pause', { value: true }); seek(0.5); 0")
        tab.until(f"!({player}).ended && ({player}).paused")
        tab.value("stream.ask('step'); 0")
        tab.until(f"({player}).paused && ({player}).at_s > 0.5")
        assert tab.value(f"({player}).at_s") == pytest.approx(0.53, abs=0.06)
        tab.value("at('play').click(); 0")
        tab.until(f"({player}).ended")
        for width in (390, 800, 1400, 1920):
            tab.resize(width, 800)
            tab.settle()
            assert tab.value("document.documentElement.scrollWidth <= innerWidth"), width
        assert tab.problems == []
    finally:
        view.stop()
        thread.join(PATIENCE_S)
    assert view.result()["lost"] == 0


@pytest.mark.real_time
@needs_chromium
def test_a_page_without_anything_to_show_says_so(tab):
    server = PageServer(page, 0)
    try:
        tab.open(server.address)
        tab.until("document.getElementById('state')?.textContent == 'connected, waiting for events'")
        server.record("", "about", 0, about(MODEL, ("only one",)))
        tab.until("model.about !== null")
        # One class, one emission, nothing else.
        server.record(
            "/view", "prediction", 0, {"t_s": 0, "label": "only one", "scores": [0.5], "sample": None}
        )
        tab.until("model.scores.length == 1")
        tab.settle()
        assert "only one" in tab.value("document.getElementById('legend').innerText")
    finally:
        server.close()
    tab.until("document.getElementById('state').textContent == 'connection lost, trying again'")
    assert not [problem for problem in tab.problems if "WebSocket" not in problem]


@pytest.mark.real_time
@needs_chromium
def test_a_thousand_classes_and_names_of_any_kind_are_drawn(tab):
    """A newline in a class was the end of the page; so were a thousand classes."""
    names = ["two\nlines", "<b>bold</b>", "\u202eright to left", *(f"class {i}" for i in range(997))]
    server = PageServer(page, 0)
    try:
        tab.open(server.address)
        server.record("", "about", 0, about(MODEL, names))
        tab.until("model.about?.labels.length == 1000")
        for i in range(200):
            scores = [float((7 * i + j) % 1000 == 0) + (j == 0) for j in range(1000)]
            record = {"t_s": i, "label": names[0], "scores": scores, "sample": None}
            server.record("/view", "prediction", i, record)
            tab.until(f"model.scores.at(-1)?.t == {i}")
        tab.settle()
        legend = tab.value("document.getElementById('legend').innerText")
        assert {"two", "lines", "others"} <= set(legend.split())
        assert tab.value("document.querySelectorAll('#legend b').length") <= 11
        assert tab.problems == []
    finally:
        server.close()


@pytest.mark.real_time
@needs_chromium
def test_cameras_can_be_chosen_and_missed_pictures_are_counted(tab):
    server = PageServer(page, 0)
    status = {"t_s": 0, "width": 16, "height": 12, "events": 5, "events_per_s": 0, "drops": {"late": 2}}
    try:
        tab.open(server.address)
        for camera in ("left", "right"):
            server.record(f"/{camera}/view", "status", 0, status | {"frame": 1, "camera": camera})
        tab.until("document.getElementById('camera')?.options.length == 2 && model.frame == 1")
        assert tab.value(f"({LAST}).status.camera") == "left"
        for camera in ("right", "left", "right"):
            tab.value(f"at('camera').value = '/{camera}/view'; at('camera').onchange()")
            tab.until(f"({LAST}).status?.camera == '{camera}'")
        for frame in (1, 5):
            server.record("/right/view", "status", 0, status | {"frame": frame, "camera": "right"})
            tab.until(f"model.frame == {frame}")
        tab.until("document.body.dataset.missed == '3'")
        tab.settle()
        assert tab.value("document.querySelectorAll('#counts .some').length") == 2
    finally:
        server.close()


@pytest.mark.real_time
@needs_chromium
@pytest.mark.parametrize("pooling", [1, 2, 3])
def test_each_cell_has_its_bars(tab, pooling):
    geometry = replace(tiny.GEOMETRY, patch=2, stride=2, pooling=pooling)
    model = tiny.encoder(k=3, geometry=geometry)
    features = np.arange(model.n_features, dtype=np.float32)
    emission = Emission(1_000, 1, features, (), np.zeros(0, np.float32), None, False)
    server = PageServer(page, 0)
    server.record("", "about", 0, about(model, ()))
    sink = ViewSink([server], model, rate=20, live=False, prefix=lambda topic: "/view", drops=dict)
    sink.write([emission])
    try:
        tab.open(server.address)
        tab.until(f"typeof model == 'object' && ({LAST}).features")
        tab.settle()
        cells = tab.value(f"({LAST}).features.cells")
        assert len(tab.value(f"{INK}('features')")) > 3
        assert tab.value("model.scale") == tab.value(f"roundUp({features.max()})")
        assert tab.problems == []
    finally:
        server.close()
    for cell, row in zip(cells, features.reshape(pooling**2, 2, -1), strict=True):
        assert cell == {"positive": row[0].tolist(), "negative": row[1].tolist()}


WRITTEN = """
window.written = [];
const { fillText } = CanvasRenderingContext2D.prototype;
CanvasRenderingContext2D.prototype.fillText = function (text, ...place) {
  if (this.canvas.id === "latency") written.push(text);
  return fillText.call(this, text, ...place);
};
0
"""
"""Notes what is written into the plot of latencies."""


@needs_chromium
def test_axes_count_time_as_the_head_does_and_nothing_lies_beside_an_empty_place(tab):
    epoch_s = 1_744_227_144
    status = {"width": 16, "height": 12, "events": 5, "events_per_s": 0, "drops": {}, "camera": "a"}
    server = PageServer(page, 0)
    server.record("", "about", 0, about(MODEL, ()))
    try:
        tab.open(server.address)
        tab.until("typeof model == 'object' && open")
        tab.value(WRITTEN)
        for i in range(9):
            t_s = epoch_s + i / 10
            server.record("/a/view", "status", 0, status | {"t_s": t_s, "frame": i})
            updates = {"median": 20, "max": 30, "n": 1}
            engine = {"t_s": t_s, "active_volumes": 1, "volumes": 4, "update_us": updates}
            server.record("/a/view", "engine", 0, engine)
            tab.until(f"model.latency.length == {i + 1}")
        tab.value("written.length = 0, dirty = true")
        tab.settle()
        written = set(tab.value("written"))
        assert {"0.00", "0.20", "stream time (s)"} <= written, written
        tab.value("at('time').click(), written.length = 0, dirty = true")
        tab.settle()
        written = set(tab.value("written"))
        assert "camera time (s)" in written
        assert any(text.startswith("17442271") for text in written), written
        for width in (390, 800, 1400, 1920):
            tab.resize(width, 900)
            tab.settle()
            assert tab.value("document.documentElement.scrollWidth <= innerWidth"), width
            # Without a classifier the row of the features has no hole where scores would be.
            boxes = "[...document.querySelectorAll('section')].map((s) => s.getBoundingClientRect())"
            row = "document.querySelector('.features').getBoundingClientRect().top"
            beside = f"Math.max(...{boxes}.filter((b) => Math.abs(b.top - {row}) < 2).map((b) => b.right))"
            edge = "document.querySelector('main').getBoundingClientRect().right"
            assert tab.value(beside) == pytest.approx(tab.value(edge), abs=1), width
    finally:
        server.close()


@needs_chromium
def test_a_long_name_of_a_class_leaves_its_key_in_sight(tab):
    sheet = {"classes": ["wave", "a very long name of a class " * 3], "file": "l.csv", "saved": True}
    label = {"at": 5, "start_s": 0.25, "end_s": 0.5, "label": "wave"}
    server = PageServer(page, 0)
    server.record("", "about", 0, about(None, ()))
    server.record("/view", "player", 0, {"at_s": 0, "paused": True, "ended": False, "speed": 1})
    server.record("/view", "labels", 0, sheet | {"labels": [label], "problem": "", "can_undo": False})
    try:
        tab.open(server.address)
        tab.until("document.querySelectorAll('#classes button').length == 2")
        for width in (390, 1400):
            tab.resize(width, 900)
            tab.settle()
            ends = "(([a, b]) => [a, b].map((e) => e.getBoundingClientRect().right))"
            button, key = tab.value(
                f"{ends}([...document.querySelectorAll('#classes button, #classes kbd')].slice(2))"
            )
            assert key < button
        tab.value("choose(0.3)")
        tab.settle()
        assert tab.value("at('label-hint').textContent").startswith("wave, 0.25 to 0.50 s: ")
    finally:
        server.close()
