"""Views of recordings and of live topics: into a file, over a server, and what can go wrong."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager

import pytest
import tiny
from live_net import PATIENCE_S, attachment, free_port, plain_publisher, plain_session, until
from mcap.reader import make_reader
from typer.testing import CliRunner
from view_client import Client

pytest.importorskip("foxglove", reason="the extra `view` is not installed")

from streamfeat.cli import app
from streamfeat.errors import InputError
from streamfeat.live.names import PlainNames, RosNames
from streamfeat.live.network import Network
from streamfeat.live.publish import PublishJob
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.codecs import encode
from streamfeat.view.job import View, prefix_of

MODEL = tiny.encoder(k=3)
CLASSIFIER = tiny.classifier(MODEL)
ALL = {"events", "bins", "volumes", "features", "prediction", "engine", "status"}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    MODEL.save(folder / "model")
    CLASSIFIER.save(folder / "classifier")
    tiny.write_items(folder / "samples.mcap", tiny.labelled_items(6))
    tiny.write_items(folder / "one.mcap", [tiny.packet(tiny.stream([10_000]))])
    return folder


def written(path):
    """What is in a file: {name: [(log time, message)]}, JSON read."""
    found = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            data = json.loads(message.data) if channel.message_encoding == "json" else message.data
            found.setdefault(channel.topic.removeprefix("/view/"), []).append((message.log_time, data))
    return found


def to_file(files, tmp_path, recording, classifier=True, **options):
    out = tmp_path / "out.mcap"
    chosen = files / "classifier" if classifier else None
    options = {"web_port": None, "recording_out": out, "speed": None} | options
    view = View(files / recording, files / "model", chosen, **options)
    view.run()
    return view, written(out)


@contextmanager
def shown(view, **options):
    """Run a view in a thread; stop it at the end, and raise what it raised."""
    errors = []

    def run():
        try:
            view.run(**options)
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run, name="view")
    thread.start()
    try:
        yield
    finally:
        view.stop()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
        if errors:
            raise errors[0]


def test_a_file_holds_everything_there_is_to_see(files, tmp_path):
    view, found = to_file(files, tmp_path, "samples.mcap", emit="10ms")
    assert set(found) == ALL
    result = view.result()
    assert result["frames"] == len(found["status"]) == len(found["events"])
    assert len(found["bins"]) == len(found["engine"]) > 6
    assert result["frames_skipped"] == 0
    last = found["prediction"][-1][1]
    assert (last["samples"], last["right"]) == (6, result["correct"])
    assert len(last["scores"]) == 3
    assert last["sample"] == {"label": "owl", "start_s": pytest.approx(1.3), "final": True}
    status = found["status"][-1][1]
    assert status["drops"] == {"late": 0, "rejected": 0, "lost": 0, "skipped": 0}
    assert (status["width"], status["height"]) == tiny.RESOLUTION[::-1]
    engine = found["engine"][-1][1]
    assert 0 <= engine["active_volumes"] <= engine["volumes"] == 12
    assert [status["frame"] for _, status in found["status"]] == list(range(1, result["frames"] + 1))


def test_a_file_is_the_same_however_quickly_it_was_written(files, tmp_path):
    def pictures(found):
        return [found[name] for name in ("events", "bins", "volumes", "features", "prediction")]

    first = pictures(to_file(files, tmp_path, "samples.mcap", emit="10ms", rate=50)[1])
    assert first == pictures(to_file(files, tmp_path, "samples.mcap", emit="10ms", rate=50)[1])


def test_a_lower_rate_shows_less_but_never_misses_the_end_of_a_sample(files, tmp_path):
    many = to_file(files, tmp_path, "samples.mcap", emit="event", rate=100)[1]
    few = to_file(files, tmp_path, "samples.mcap", emit="event", rate=2)[1]
    assert len(few["events"]) < len(many["events"]) / 4
    assert sum(message["sample"]["final"] for _, message in few["prediction"]) == 6


def test_without_a_classifier_there_are_no_predictions(files, tmp_path):
    assert set(to_file(files, tmp_path, "samples.mcap", classifier=False)[1]) == ALL - {"prediction"}


def test_one_event_is_enough(files, tmp_path):
    found = to_file(files, tmp_path, "one.mcap")[1]
    assert set(found) == ALL
    assert found["status"][0][1]["events"] == 1
    assert found["engine"][0][1]["active_volumes"] == 1
    assert found["engine"][0][1]["update_us"]["n"] == 1


def test_a_view_that_fails_leaves_no_file(files, tmp_path, monkeypatch):
    def broken(self, sight):
        raise RuntimeError("broken")

    monkeypatch.setattr("streamfeat.view.sink.ViewSink._draw", broken)
    with pytest.raises(RuntimeError, match="broken"):
        to_file(files, tmp_path, "samples.mcap")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.real_time
def test_a_recording_begins_when_somebody_looks_and_its_end_stays(files):
    lines = []
    view = View(
        files / "samples.mcap", files / "model", speed=None, emit="10ms", say=lines.append, foxglove_port=0
    )
    with shown(view):
        until(lambda: any("waiting" in line for line in lines))
        address = lines[0].removeprefix("Foxglove: ")
        assert view.result()["emissions"] == 0
        with Client(address) as client:
            client.subscribe("/status")
            until(lambda: view.result()["samples"] == 6)
        emissions = view.result()["emissions"]
        assert emissions > 6
        with Client(address) as late:
            late.subscribe("/bins", "/features")
            assert {late.message()[0], late.message()[0]} == {"/view/bins", "/view/features"}
    assert view.result()["emissions"] == emissions


@contextmanager
def moving(camera):
    """A camera that sees something while the block runs."""
    ended, (height, width) = threading.Event(), tiny.RESOLUTION

    def see():
        i = 0
        while not ended.wait(0.02):
            i += 1
            payload, base_ns = encode(tiny.steady(i * 10_000, (i + 1) * 10_000, 50, seed=i), "mono")
            packet = EventPacket(0, "", height, width, i, base_ns, "mono", False, payload)
            camera.put(packet.to_cdr(), attachment=attachment(i))

    thread = threading.Thread(target=see)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.mark.real_time
def test_live_topics_are_shown_and_not_answered(files):
    key, lines = "robot/cam/events", []
    port = free_port()
    view = View(
        PlainNames("robot/*/events"),
        files / "model",
        files / "classifier",
        emit="10ms",
        say=lines.append,
        foxglove_port=0,
        network=Network(port=port),
    )
    with shown(view), plain_session(port) as session:
        until(lambda: lines)
        answers = []
        session.declare_subscriber("robot/cam/features", lambda sample: answers.append(1))
        client = Client(lines[0].removeprefix("Foxglove: "))
        with plain_publisher(session, key) as camera, moving(camera), client:
            client.subscribe("/status", "/events")
            got = []
            client.until(lambda: len({topic for topic, *_ in got}) == 2, got)
    assert {topic for topic, *_ in got} == {"/robot/cam/view/status", "/robot/cam/view/events"}
    assert answers == []
    assert view.result()["frames"] >= 1


@pytest.mark.real_time
def test_a_ros_camera_is_shown(files):
    names, port, lines = RosNames("/event_camera/events"), free_port(), []
    view = View(
        names,
        files / "model",
        files / "classifier",
        emit="10ms",
        rate=1000,
        say=lines.append,
        foxglove_port=0,
        network=Network(port=port),
    )
    camera = PublishJob(
        [(files / "samples.mcap", "/event_camera/events")],
        names,
        speed=4.0,
        network=Network(port=port),
        wait_s=30,
    )
    with shown(view):
        until(lambda: lines)
        with Client(lines[0].removeprefix("Foxglove: ")) as client:
            camera.run()
            sent = camera.result()
            until(lambda: view.result()["events"] == sent["events"])
            client.subscribe("/status", "/events", "/prediction")
            got = []
            client.until(lambda: len({topic for topic, *_ in got}) == 3, got)
    assert sent["events"] == 6 * 300
    prefix = "/event_camera/view"
    assert {topic for topic, *_ in got} == {f"{prefix}/{name}" for name in ("status", "events", "prediction")}
    assert view.result()["lost"] == 0


@pytest.mark.parametrize(
    ("topic", "prefix"),
    [("", "/view"), ("robot/cam/events", "/robot/cam/view"), ("/left", "/left/view"), ("events", "/view")],
)
def test_channels_are_called_after_their_camera(topic, prefix):
    assert prefix_of(topic) == prefix


def test_the_layout_shows_every_channel(files, tmp_path):
    view = View(files / "samples.mcap", files / "model", files / "classifier")
    view.write_layout(tmp_path / "layout.json", "")
    layout = json.loads((tmp_path / "layout.json").read_text())
    panels = layout["configById"]
    shown_paths = [config["imageMode"]["imageTopic"] for config in panels.values() if "imageMode" in config]
    shown_paths += [path["value"] for config in panels.values() for path in config.get("paths", [])]
    shown_paths += [config["topicPath"] for config in panels.values() if "topicPath" in config]
    assert {path.split("/")[2].partition(".")[0] for path in shown_paths} == ALL
    assert "/view/prediction.scores[2]" in shown_paths
    found = to_file(files, tmp_path, "samples.mcap")[1]
    for path in shown_paths:
        _resolve(path.removeprefix("/view/"), found)

    def leaves(node):
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout["layout"])) == sorted(panels)


def _resolve(path, found):
    """Every path leads to something in the messages that were really written."""
    name, *fields = path.replace("[:]", "").replace("[", ".").replace("]", "").split(".")
    value = found[name][-1][1]
    for field in fields:
        value = value[int(field)] if isinstance(value, list) else value[field]
    assert value is not None


def test_a_layout_needs_one_camera(files, tmp_path):
    view = View(PlainNames("robot/*/events"), files / "model")
    with pytest.raises(InputError, match="needs the key of one camera"):
        view.write_layout(tmp_path / "layout.json", "robot/*/events")


def invoke(*arguments):
    return CliRunner().invoke(app, ["view", *map(str, arguments)])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.mcap"], "no such file|not there|cannot"),
        (["{samples}", "--rate", "0"], "--rate 0 is not possible"),
        (["{samples}", "--no-web"], "shows nothing without --foxglove or -o"),
        (["{samples}", "--ros2", "/events"], "not both"),
        (["robot/*/events", "--loop"], "are for recordings"),
        (["robot/*/events", "--layout", "{folder}/x.json"], "needs the key of one camera"),
        ([], "give a zenoh key"),
        (["{samples}", "--split", "none"], "no samples of split"),
        (["{samples}", "--speed", "no"], "--speed 'no' is not understood"),
    ],
)
def test_what_makes_no_sense_is_one_clear_line(files, arguments, message):
    filled = [text.format(samples=files / "samples.mcap", folder=files) for text in arguments]
    outcome = invoke(*filled, "-m", files / "model")
    assert isinstance(outcome.exception, InputError)
    assert outcome.exception.args[0].count("\n") == 0
    assert re.search(message, str(outcome.exception))


def test_a_missing_extra_is_named(files, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    outcome = invoke(files / "samples.mcap", "--foxglove")
    assert "pip install 'streamfeat[view]'" in str(outcome.exception)


def test_a_file_is_written_from_the_command_line(files, tmp_path):
    out = tmp_path / "out.mcap"
    outcome = invoke(files / "samples.mcap", "-m", files / "model", "-o", out, "--json")
    assert outcome.exit_code == 0, outcome.output
    assert json.loads(outcome.stdout)["frames"] == len(written(out)["status"])
    assert "exists already" in str(invoke(files / "samples.mcap", "-m", files / "model", "-o", out).exception)


@pytest.mark.real_time
@pytest.mark.parametrize("looking", [False, True])
def test_ctrl_c_ends_a_view(files, looking):
    command = [sys.executable, "-c", "from streamfeat.cli import main; main()", "view"]
    command += [str(files / "samples.mcap"), "-m", str(files / "model"), "--foxglove", "--port", "0"]
    command += ["--loop", "--json"]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )
    try:
        address = process.stderr.readline().strip().removeprefix("Foxglove: ")
        assert "waiting" in process.stderr.readline()
        if looking:
            with Client(address) as client:
                client.subscribe("/status")
                client.message()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, err
    assert (json.loads(out)["frames"] > 0) == looking
    assert "Traceback" not in err


def test_a_port_in_use_is_said_before_anything_is_shown(files):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        view = View(files / "samples.mcap", files / "model", web_port=taken.getsockname()[1])
        with pytest.raises(InputError, match=r"--web-port .* cannot listen there: Address already in use"):
            view.run()
