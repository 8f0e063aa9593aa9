"""Labels made on the page: what may be changed, what is refused, the file, and the keys in a real browser."""

import json
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager

import numpy as np
import pytest
import tiny
from browser import Browser, find_chromium
from live_net import PATIENCE_S, until
from test_json import check
from websockets.sync.client import connect

from streamfeat.errors import InputError
from streamfeat.messages.packets import Label
from streamfeat.recordings.labels import read_labels
from streamfeat.recordings.reader import open_recording
from streamfeat.view.job import View
from streamfeat.view.labelling import LabelSheet, label_path
from streamfeat.view.player import Piece, PlayedTime

FIRST_US = 5_000_000
needs_chromium = pytest.mark.skipif(find_chromium() is None, reason="no chromium: apt-get install chromium")


@pytest.fixture
def recording(tmp_path):
    events = tiny.steady(FIRST_US, FIRST_US + 2_000_000, 4_000)
    events["t"][0] = FIRST_US
    return tiny.write_items(
        tmp_path / "drive.mcap", [tiny.packet(part) for part in np.array_split(events, 20)]
    )


def sheet_of(recording, path=None, classes=(), read=True):
    with open_recording(recording) as rec:
        sheet = LabelSheet(rec, path or label_path(str(recording)), classes)
    if read:
        sheet.read_to([Piece(0, FIRST_US, FIRST_US + 2_000_000)], 2_000_000)
    return sheet


def add(sheet, start, end, label, **more):
    sheet.do({"op": "label", "start": start, "end": end, "label": label} | more)
    return sheet.record()["problem"]


def kept(sheet):
    return [(label.start_us, label.duration_us, label.label) for label in read_labels(sheet.path).labels]


def test_a_label_is_in_the_file_at_once_in_stream_time(recording):
    sheet = sheet_of(recording)
    assert not sheet.path.exists()
    assert add(sheet, 1.0, 1.25, "wave") == ""
    assert add(sheet, 0.5, 0.75, "rest, or: none") == ""
    assert kept(sheet) == [(5_500_000, 250_000, "rest, or: none"), (6_000_000, 250_000, "wave")]
    shown = sheet.record()
    assert [(label["start_s"], label["end_s"]) for label in shown["labels"]] == [(0.5, 0.75), (1.0, 1.25)]
    assert (shown["saved"], shown["file"]) == (True, "drive.labels.csv")
    assert sheet.result() == {
        "labels": str(sheet.path),
        "samples": 2,
        "seconds_by_class": {"rest, or: none": 0.25, "wave": 0.25},
    }


def test_reopening_goes_on_and_keeps_what_others_wrote(recording, tmp_path):
    table = tmp_path / "own.csv"
    table.write_text("start_s,end_s,label,split,source\n0.5,0.75,rest,test,video 7\n")
    sheet = sheet_of(recording, table)
    assert add(sheet, 1, 1.5, "wave") == ""
    again = sheet_of(recording, table, ["wave", "other"])
    assert again.record()["classes"] == ["wave", "other", "rest"]
    assert [label["label"] for label in again.record()["labels"]] == ["rest", "wave"]
    assert read_labels(table).labels[0] == Label(5_500_000, 250_000, "rest", "test", "video 7")


def test_changing_removing_and_taking_back(recording):
    sheet = sheet_of(recording)
    add(sheet, 0, 0.5, "a")
    add(sheet, 1, 1.5, "b")
    sheet.do({"op": "relabel", "at": FIRST_US, "start": 0.25, "end": 0.75, "label": "c"})
    assert kept(sheet) == [(5_250_000, 500_000, "c"), (6_000_000, 500_000, "b")]
    sheet.do({"op": "unlabel", "at": 6_000_000})
    assert kept(sheet) == [(5_250_000, 500_000, "c")]
    for _ in range(3):
        sheet.do({"op": "undo"})
    assert kept(sheet) == [(5_000_000, 500_000, "a")]
    sheet.do({"op": "undo"})
    assert (sheet.record()["labels"], sheet.record()["can_undo"]) == ([], False)
    sheet.do({"op": "undo"})
    assert sheet.record()["problem"] == "there is nothing to take back"


REFUSED = {
    "overlap": (0.75, 1.2, "b", "b would overlap a, 0.50 to 1.00 s"),
    "inside": (0.6, 0.7, "b", "would overlap a"),
    "around": (0.2, 1.9, "b", "would overlap a"),
    "empty": (1.5, 1.5, "b", "ends after its start"),
    "backward": (1.5, 1.2, "b", "ends after its start"),
    "no time": (None, 1.5, "b", "a start and an end"),
    "not a number": (float("nan"), 1.5, "b", "a start and an end"),
    "no name": (1.2, 1.5, " ", "a class has a name"),
    "no text": (1.2, 1.5, ["b"], "a class has a name"),
    "long name": (1.2, 1.5, "b" * 81, "up to 80 letters"),
}


@pytest.mark.parametrize(("start", "end", "name", "reason"), REFUSED.values(), ids=REFUSED)
def test_what_makes_no_sense_is_said_and_changes_nothing(recording, start, end, name, reason):
    sheet = sheet_of(recording)
    add(sheet, 0.5, 1.0, "a")
    before = sheet.path.read_bytes()
    assert reason in add(sheet, start, end, name)
    assert sheet.path.read_bytes() == before
    assert add(sheet, 1.0, 1.25, "b") == "", "a label may begin where another ends"


def test_what_is_not_read_yet_waits(recording):
    sheet = sheet_of(recording)
    add(sheet, 1.0, 1.5, "a")
    unread = sheet_of(recording, read=False)
    assert unread.record()["labels"] == []
    assert "not been read so far" in add(unread, 0, 0.5, "b")
    assert len(read_labels(sheet.path).labels) == 1


def test_labels_of_another_recording_are_refused(recording, tmp_path):
    sheet = sheet_of(recording)
    add(sheet, 1.0, 1.5, "a")
    other = tiny.write_items(
        tmp_path / "other.mcap", [tiny.packet(tiny.steady(FIRST_US, 7_000_000, 90, seed=3))]
    )
    with pytest.raises(InputError, match=r"labels of another recording, drive\.mcap"):
        sheet_of(other, sheet.path)
    early = tmp_path / "early.csv"
    early.write_text("start_us,end_us,label\n1000000,2000000,a\n")
    with pytest.raises(InputError, match="before the recording's first event"):
        sheet_of(recording, early)


def test_the_file_is_not_written_over_another_programs(recording):
    sheet = sheet_of(recording)
    add(sheet, 0, 0.5, "a")
    sheet.path.write_text("start_us,end_us,label\n6000000,6100000,mine\n")
    assert "changed by another program" in add(sheet, 1, 1.5, "b")
    assert "mine" in sheet.path.read_text()
    with pytest.raises(InputError, match="changed by another program"):
        sheet.check_saved()


def test_a_file_that_cannot_be_written_is_said(recording, tmp_path):
    sheet = sheet_of(recording, tmp_path / "no folder" / "labels.csv")
    assert "cannot write there" in add(sheet, 0, 0.5, "a")
    assert not sheet.record()["saved"]
    with pytest.raises(InputError, match="cannot write there"):
        sheet.check_saved()


def test_labels_of_the_recording_are_where_one_begins(tmp_path):
    path = tiny.write_items(tmp_path / "in.mcap", tiny.labelled_items(3))
    sheet = sheet_of(path)
    assert sheet.result()["samples"] == 3
    assert sheet.result()["labels"] is None
    with open_recording(path) as rec:
        first = rec.labels[0]
    sheet.do({"op": "unlabel", "at": first.start_us})
    assert [label.source for label in read_labels(sheet.path).labels] == ["sample 1", "sample 2"]


@pytest.mark.parametrize("source", ["s3://bucket/drive.mcap", "runs/*.mcap"])
def test_where_there_is_no_place_beside_it_one_is_asked_for(source):
    with pytest.raises(InputError, match=r"-o LABELS\.csv"):
        label_path(source)


def test_played_time_becomes_stream_time_across_jumps(recording):
    played = PlayedTime()
    for start, stop in ((0, 100_000), (100_000, 200_000), (90_000_000, 90_100_000), (1_000, 101_000)):
        played.add(tiny.stream([start, stop]))
    assert played.us == 200_000 + 0 + 0
    assert played.pieces == [
        Piece(0, 0, 200_000),
        Piece(200_000, 90_100_000, 90_100_000),
        Piece(200_000, 101_000, 101_000),
    ]
    played.add(tiny.stream([301_000]))
    sheet = sheet_of(recording, read=False)
    sheet.read_to(played.pieces, played.us)
    assert "clock was set back" in add(sheet, 0.25, 0.35, "a")
    assert add(sheet, 0.05, 0.15, "a") == ""
    assert kept(sheet) == [(50_000, 100_000, "a")]


@contextmanager
def labelled(recording, sheet):
    lines = []
    view = View(recording, labels=sheet, web_port=0, say=lines.append)
    thread = threading.Thread(target=view.run)
    thread.start()
    try:
        until(lambda: any("waiting" in line for line in lines))
        yield next(line.partition(": ")[2] for line in lines if line.startswith("page"))
    finally:
        view.stop()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


PRESS = "(key => document.body.dispatchEvent(new KeyboardEvent('keydown', { key, bubbles: true })))"
DRAG = """((from, to) => {
  const canvas = at("timeline");
  canvas.setPointerCapture = () => {};
  const [x0, x1] = [from, to].map((s) => scaleOf(lengthS(model.cameras.get(model.camera).last),
    canvas.clientWidth).x(s) + canvas.getBoundingClientRect().left);
  const y = canvas.getBoundingClientRect().top + 20;
  const way = [["pointerdown", x0], ["pointermove", (x0 + x1) / 2], ["pointermove", x1], ["pointerup", x1]];
  for (const [type, x] of way)
    canvas.dispatchEvent(new PointerEvent(type, { clientX: x, clientY: y, pointerId: 1, bubbles: true }));
})"""
"""A drag over the timeline between two played seconds."""


@pytest.mark.real_time
@needs_chromium
def test_keys_and_dragging_make_labels(recording):
    sheet = sheet_of(recording, classes=["wave"], read=False)
    with Browser() as tab, labelled(recording, sheet) as address:
        tab.prefer("light")
        tab.open(address)
        tab.until("typeof lastOf == 'function' && lastOf('player')?.ended && lastOf('timeline')?.done")

        def press(key):
            tab.value(f"{PRESS}('{key}')")

        labels = "lastOf('labels').labels"
        # A range by dragging, named by a key.
        tab.value(f"{DRAG}(0.5, 1.0); 0")
        tab.until("marking.range")
        press("1")
        tab.until(f"{labels}.length == 1")
        assert tab.value(f"{labels}[0].start_s") == pytest.approx(0.5, abs=0.01)
        assert tab.value(f"{labels}[0].end_s") == pytest.approx(1.0, abs=0.01)
        # A class of one's own, begun and ended by its key while the recording stands still.
        tab.value(
            "at('new-class').value = 'rest'; "
            "at('new-class').dispatchEvent(new KeyboardEvent('keydown', { key: 'Enter' })); 0"
        )
        tab.until("lastOf('labels').classes.length == 2")
        tab.value("stream.ask('pause', { value: true }); seek(1.2); 0")
        tab.until("lastOf('player').paused && Math.abs(lastOf('player').at_s - 1.2) < 0.05")
        press("2")
        assert tab.value("marking.open.name") == "rest"
        tab.value("seek(1.6); 0")
        tab.until("Math.abs(lastOf('player').at_s - 1.6) < 0.05")
        press("2")
        tab.until(f"{labels}.length == 2")
        # One that overlaps is refused, in words.
        tab.value(f"{DRAG}(0.9, 1.1); 0")
        press("2")
        tab.until("lastOf('labels').problem.includes('would overlap wave')")
        tab.settle()
        assert "would overlap wave" in tab.value("at('label-state').textContent")
        # The end of a chosen label is dragged; undo takes that back; Delete removes.
        tab.value("choose(0.7); 0")
        tab.value(f"{DRAG}({labels}[0].end_s, 0.8); 0")
        tab.until(f"Math.abs({labels}[0].end_s - 0.8) < 0.02")
        press("u")
        tab.until(f"Math.abs({labels}[0].end_s - 1.0) < 0.02")
        tab.value("choose(0.7); 0")
        press("Delete")
        tab.until(f"{labels}.length == 1")
        press("u")
        tab.until(f"{labels}.length == 2")
        for width in (390, 800, 1400, 1920):
            tab.resize(width, 800)
            tab.settle()
            assert tab.value("document.documentElement.scrollWidth <= innerWidth"), width
        assert tab.problems == []
    names = [label.label for label in read_labels(sheet.path).labels]
    assert names == ["wave", "rest"]


def shown(browser, channel, what):
    """Wait until something is shown."""
    while True:
        text = browser.recv(PATIENCE_S)
        said = json.loads(text) if isinstance(text, str) else {}
        if said.get("channel") == channel and what(said["record"]):
            return


@pytest.mark.real_time
def test_the_command_saves_and_writes_a_recording_when_it_is_interrupted(recording, tmp_path, run):
    words = ["label", recording, "--classes", "wave, rest", "--mcap", tmp_path / "out.mcap", "--no-open"]
    program = [sys.executable, "-W", "error", "-c", "from streamfeat.cli import main; main()"]
    process = subprocess.Popen(
        [*program, *map(str, words), "--web-port", "0", "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        address = process.stderr.readline().removeprefix("page: ").strip()
        with connect(address.replace("http", "ws").replace("/?", "/stream?"), max_size=None) as browser:
            shown(browser, "timeline", lambda told: told["done"])
            for start in (0.2, 0.3, 0.6):  # the second overlaps
                ask = {"op": "label", "start": start, "end": start + 0.2, "label": "wave"}
                browser.send(json.dumps(ask))
            shown(browser, "labels", lambda told: len(told["labels"]) == 2)
        process.send_signal(signal.SIGINT)
        text, errors = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.communicate()
    result = json.loads(text)
    check("label", result)
    assert process.returncode == 0, errors
    assert result["samples"] == len(read_labels(recording.parent / "drive.labels.csv").labels) == 2
    with open_recording(tmp_path / "out.mcap") as rec:
        assert [label.label for label in rec.labels] == ["wave"] * result["samples"]
    other = tiny.write_items(tmp_path / "other.mcap", [tiny.packet(tiny.steady(0, 900_000, 90))])
    refused = run("label", other, "-o", recording.parent / "drive.labels.csv", "--no-open")
    assert refused.status == 2
    assert "labels of another recording" in refused.err
