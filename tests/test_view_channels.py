"""Channels over a real server and in a real file: what clients get, and what clients do wrong."""

import json
import socket
import sys

import numpy as np
import pytest
from live_net import until
from mcap.reader import make_reader
from view_client import Client

pytest.importorskip("foxglove", reason="the extra `view` is not installed")

from streamfeat.errors import InputError
from streamfeat.view.channels import FileBoard, LiveBoard
from streamfeat.view.gate import MAX_CLIENTS

ABOUT = {"labels": "cat\ndog"}
STATUS = {"t_s": 1.5, "frame": 1}


@pytest.fixture
def board():
    opened = LiveBoard(ABOUT, "test", 0)
    yield opened
    opened.close()


@pytest.mark.real_time
def test_a_client_gets_what_is_shown(board):
    board.announce("/view")
    with Client(board.address) as client:
        client.subscribe("/status", "/events")
        until(lambda: _subscribed(board, "status", "events"))
        board.record("/view", "status", 1_500_000, STATUS)
        topic, log_time, payload = client.message()
        assert (topic, log_time, json.loads(payload)) == ("/view/status", 1_500_000_000, STATUS)
        board.picture("/view", "events", 7, np.arange(6, dtype=np.uint8).reshape(2, 3))
        topic, log_time, payload = client.message()
        assert (topic, log_time) == ("/view/events", 7_000)
        assert bytes(range(6)) in payload
    channels = {channel["topic"]: channel for channel in client.channels.values()}
    assert channels["/view/events"]["schemaName"] == "foxglove.RawImage"
    assert channels["/view/status"]["metadata"] == ABOUT
    assert set(channels) == {
        f"/view/{name}"
        for name in ("events", "bins", "volumes", "features", "prediction", "engine", "status")
    }


def test_who_comes_late_gets_what_was_shown_last(board):
    board.record("/view", "status", 1, {"frame": 1})
    board.record("/view", "status", 2, {"frame": 2})
    with Client(board.address) as client:
        client.subscribe("/status")
        assert json.loads(client.message()[2]) == {"frame": 2}


@pytest.mark.real_time
def test_whoever_looks_is_noticed():
    looked = []
    board = LiveBoard(ABOUT, "test", 0, lambda: looked.append(1))
    try:
        board.announce("/view")
        with Client(board.address) as client:
            assert not looked
            client.subscribe("/status")
            until(lambda: looked)
    finally:
        board.close()


@pytest.mark.real_time
def test_a_client_that_does_not_read_loses_pictures_and_holds_up_nobody(board):
    board.announce("/view")
    picture = np.zeros((480, 640), np.uint8)
    with Client(board.address, receive_buffer=4096) as slow, Client(board.address) as quick:
        for client in (slow, quick):
            client.subscribe("/events")
        until(lambda: _subscribed(board, "events"))
        got = []
        for i in range(400):
            board.picture("/view", "events", i, picture)
            if i % 40 == 39:
                quick.until(lambda last=i: got and got[-1][1] == last * 1000, got)
        times = []
        slow.until(lambda: times and times[-1][1] == 399_000, times)
        assert len(times) < 400, "what had to wait was dropped"
        assert times == sorted(times, key=lambda message: message[1])


@pytest.mark.parametrize(
    ("address", "host", "origin"),
    [
        ("/", None, None),
        ("/?token=", None, None),
        ("/?token=0123456789abcdef012345", None, "https://app.foxglove.dev"),
        (None, "evil.example:{port}", None),
        (None, None, "http://evil.example"),
        (None, None, "null"),
        (None, None, "https://app.foxglove.dev.evil.example"),
        (None, "127.0.0.1", None),
    ],
)
def test_foxglove_connects_with_the_printed_address_only(board, address, host, origin):
    """Any page of a browser could read the pictures."""
    where = f"ws://127.0.0.1:{board.port}{address}" if address else board.address
    with pytest.raises(AssertionError, match="403"):
        Client(where, host=host and host.format(port=board.port), origin=origin)


@pytest.mark.parametrize("origin", [None, "https://app.foxglove.dev", "file://"])
def test_foxglove_is_let_in(board, origin):
    board.record("/view", "status", 1, {"frame": 1})
    with Client(board.address, origin=origin) as client:
        client.subscribe("/status")
        assert json.loads(client.message()[2]) == {"frame": 1}


def test_a_page_of_ones_own_can_be_allowed():
    board = LiveBoard(ABOUT, "test", 0, origins={"http://localhost:8080"})
    try:
        Client(board.address, origin="http://localhost:8080")._socket.close()
        with pytest.raises(AssertionError, match="403"):
            Client(board.address, origin="https://app.foxglove.dev")
    finally:
        board.close()


@pytest.mark.skipif(sys.platform != "linux", reason="a system with one loopback address")
def test_the_server_behind_the_gate_is_not_on_the_common_address(board):
    with socket.socket() as one, pytest.raises(ConnectionRefusedError):
        one.connect(("127.0.0.1", board._server.port))


def test_no_more_than_sixteen_clients_and_their_places_come_back(board):
    board.record("/view", "status", 1, {"frame": 1})
    clients = [Client(board.address) for _ in range(MAX_CLIENTS)]
    with pytest.raises(AssertionError, match="503"):
        Client(board.address)
    for client in clients:
        client._socket.close()
    until(lambda: board._guard._n_clients == 0)
    with Client(board.address) as client:
        client.subscribe("/status")
        assert client.message()[0] == "/view/status"


def test_clients_that_say_nothing_hold_up_nobody(board):
    board.record("/view", "status", 1, {"frame": 1})
    silent = [socket.create_connection(("127.0.0.1", board.port)) for _ in range(200)]
    try:
        with Client(board.address) as client:
            client.subscribe("/status")
            assert client.message()[0] == "/view/status"
    finally:
        for one in silent:
            one.close()


def test_a_client_that_goes_without_a_word_is_nobodys_error(board, capfd):
    board.announce("/view")
    client = Client(board.address)
    client.subscribe("/events")
    client._socket.close()
    for i in range(50):
        board.picture("/view", "events", i, np.zeros((100, 100), np.uint8))
    with Client(board.address) as other:
        other.subscribe("/events")
        assert other.message()[1] == 49_000
    assert capfd.readouterr() == ("", "")


def test_a_port_in_use_is_one_clear_line():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"--port {port}: cannot listen there: Address already in use"):
            LiveBoard(ABOUT, "test", port)


def test_cameras_beyond_the_limit_replace_the_oldest(board, monkeypatch):
    monkeypatch.setattr("streamfeat.view.channels.MAX_CAMERAS", 2)
    for i in range(3):
        board.record(f"/cam{i}/view", "status", 0, {"frame": i})
    with Client(board.address) as client:
        client.subscribe("/cam1/view/status", "/cam2/view/status")
        assert not any(channel["topic"].startswith("/cam0") for channel in client.channels.values())


def test_a_file_has_schemas_that_others_know(tmp_path):
    board = FileBoard(ABOUT, tmp_path / "out.mcap")
    board.picture("/view", "bins", 1_000_001, np.full((2, 5), 128, np.uint8))
    board.record("/view", "status", 2_000_000, STATUS)
    board.close()
    with (tmp_path / "out.mcap").open("rb") as file:
        rows = [
            (schema.name, channel.topic, channel.message_encoding, message.log_time, message.data)
            for schema, channel, message in make_reader(file).iter_messages()
        ]
    assert [row[:4] for row in rows] == [
        ("foxglove.RawImage", "/view/bins", "protobuf", 1_000_001_000),
        ("streamfeat.Status", "/view/status", "json", 2_000_000_000),
    ]
    assert json.loads(rows[1][4]) == STATUS


def test_a_file_that_cannot_be_written_is_one_clear_line(tmp_path):
    with pytest.raises(InputError, match="cannot write there"):
        FileBoard(ABOUT, tmp_path / "nowhere" / "out.mcap")


def _subscribed(board, *names):
    return all(board._channels["/view"][name].has_sinks() for name in names)
