"""What breaks and comes back: publishers, routers and links, between real processes and sessions."""

import json
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager, suppress

import numpy as np
import pytest
import tiny
from live_net import (
    ListSink,
    attachment,
    compiled,
    free_port,
    plain_publisher,
    running,
    until,
)
from test_live_listen import MODEL, batches, listener, message, replayed

from streamfeat.live.names import PlainNames
from streamfeat.live.network import Network, open_session
from streamfeat.live.publisher import MessagePublisher
from streamfeat.messages.cdr import EventPacket
from streamfeat.stream.outputs import Outputs

pytestmark = pytest.mark.real_time

KEY = "cam/a/events"

PUBLISHER = """
import json, sys, time, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
token = session.liveliness().declare_token(f"{sys.argv[2]}/@events/{sys.argv[3]}")
publisher = session.declare_publisher(sys.argv[2], congestion_control=zenoh.CongestionControl.BLOCK)
while not publisher.matching_status.matching:
    time.sleep(0.01)
for line in sys.stdin:
    payload, attached = map(bytes.fromhex, line.split())
    publisher.put(payload, attachment=attached)
"""
ROUTER = """
import sys, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
print("ready", flush=True)
sys.stdin.read()
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    MODEL.save(folder / "model")
    return compiled(folder)


def config(mode, connect=(), listen=()):
    return json.dumps(
        {
            "mode": mode,
            "listen": {"endpoints": [f"tcp/127.0.0.1:{port}" for port in listen]},
            "connect": {
                "endpoints": [f"tcp/127.0.0.1:{port}" for port in connect],
                "timeout_ms": -1,
                "exit_on_failure": False,
                "retry": {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 1.5},
            },
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        }
    )


@contextmanager
def program(text, *words):
    process = subprocess.Popen(
        [sys.executable, "-c", text, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def test_a_publisher_that_is_killed_and_another_in_its_place(files):
    port, sink, sent = free_port(), ListSink(), batches(10)
    job = listener(files, emit="10ms", network=Network(port=port), classifier=False)
    end = int(sent[-1]["t"][-1])
    with running(job, Outputs(more=sink)):
        for life, gid in enumerate((b"1" * 16, b"2" * 16)):
            words = config("peer", connect=[port], listen=[0]), KEY, gid.hex()
            with program(PUBLISHER, *words) as publisher:
                for i, events in enumerate(sent):
                    publisher.stdin.write(f"{message(events, i).hex()} {attachment(i + 1, gid).hex()}\n")
                publisher.stdin.flush()
                until(lambda life=life: job.result()["packets"] == 10 * (life + 1), lambda: f"{job.result()}")
                until(
                    lambda: job._intake.topics[KEY].timeline.reached_us == end,
                    "the last packet's place in time",
                )
                publisher.kill()
        until(lambda: job._cameras.topics == [], "the second one's end")
    result = job.result()
    assert (result["cameras"], result["restarts"], result["foreign"]) == (2, 1, 0)
    assert (result["lost"], result["duplicates"], result["late"]) == (0, 0, 0)
    expected = replayed([tiny.packet(events) for events in sent])
    # The one who is killed ends a life of the camera; the other begins with an empty window.
    assert [e.t_us for e in sink.emissions] == 2 * [e.t_us for e in expected]
    for one, two in zip(sink.emissions, 2 * expected, strict=True):
        assert np.array_equal(one.features, two.features)
        assert not one.incomplete


def test_a_router_that_is_killed_and_another_in_its_place(files, tmp_path):
    """What was put meanwhile is lost, and counted; what comes after it is heard without anybody's help."""
    port, sink, sent = free_port(), ListSink(), iter(range(10**6))
    path = tmp_path / "client.json5"
    path.write_text(config("client", connect=[port]))
    job = listener(files, emit="10ms", classifier=False, network=Network(path))

    with program(ROUTER, config("router", listen=[port])) as router:
        router.stdout.readline()
        with open_session(path) as net, running(job, Outputs(more=sink)), plain_publisher(net, KEY) as camera:

            def put():
                i = next(sent)
                events = tiny.steady(10_000 * i, 10_000 * (i + 1), 20, seed=i)
                camera.put(message(events, i), attachment=attachment(i + 1))

            def heard(count):
                put()
                return job.result()["packets"] >= count

            until(lambda: heard(5))
            router.kill()
            router.wait()
            until(lambda: not list(net.info.routers_zid()), "the router's end")
            for _ in range(10):
                put()
            with program(ROUTER, config("router", listen=[port])) as again:
                again.stdout.readline()
                before = job.result()["packets"]
                until(lambda: heard(before + 5), lambda: f"{job.result()}")
                n = next(sent)
                until(lambda: (r := job.result())["packets"] + r["lost"] + r["unheard"] == n)
    result = job.result()
    assert result["lost"] >= 10
    assert (result["restarts"], result["foreign"], result["duplicates"]) == (0, 0, 0)
    assert result["incomplete"] > 0
    assert not sink.emissions[0].incomplete


class Cable:
    """A TCP link that can be cut, from one port to another."""

    def __init__(self, to_port):
        self._to_port = to_port
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self.is_cut = False
        self._ends = []
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self):
        self.is_cut = True
        for end in self._ends:
            with_no_more(end)

    def mend(self):
        self.is_cut = False

    def close(self):
        self.cut()
        with_no_more(self._server)

    def _accept(self):
        while True:
            try:
                one, _ = self._server.accept()
            except OSError:
                return
            if self.is_cut:
                one.close()
                continue
            other = socket.create_connection(("127.0.0.1", self._to_port))
            self._ends += [one, other]
            for ends in ((one, other), (other, one)):
                threading.Thread(target=self._carry, args=ends, daemon=True).start()

    @staticmethod
    def _carry(source, target):
        try:
            while data := source.recv(65536):
                target.sendall(data)
        except OSError:
            pass
        finally:
            for end in (source, target):
                with_no_more(end)


def with_no_more(end):
    with suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
    end.close()


def listens(port):
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


@pytest.mark.parametrize("reliable", [True, False])
def test_what_a_cut_link_loses_is_recovered_if_both_sides_ask_for_it(files, tmp_path, reliable):
    port, sink, sent = free_port(), ListSink(), batches(60, events=50)
    here, there = tmp_path / "here.json5", tmp_path / "there.json5"
    here.write_text(config("peer", listen=[port]))
    job = listener(files, emit="10ms", classifier=False, network=Network(here, reliable=reliable))
    with running(job, Outputs(more=sink)):
        until(lambda: listens(port), "a listener")
        cable = Cable(port)
        there.write_text(config("client", connect=[cable.port]))
        with open_session(there) as net:
            camera = MessagePublisher(
                net, PlainNames(KEY), KEY, EventPacket.SCHEMA_NAME, block=True, reliable=reliable
            )
            messages = [message(events, i) for i, events in enumerate(sent)]
            if not reliable:
                until(lambda: camera._publisher.matching_status.matching)
            for data in messages[:20]:
                camera.put(data)
            until(lambda: job.result()["packets"] == 20, lambda: f"{job.result()}")
            cable.cut()
            until(lambda: not list(net.info.transports()), "the cut")
            for data in messages[20:40]:
                camera.put(data)
            cable.mend()
            until(lambda: list(net.info.transports()), "the link")
            if reliable:  # a heartbeat tells of them; asked for too soon after the cut, they may be given up
                until(lambda: job.result()["packets"] == 40, lambda: f"{job.result()}")
            else:
                until(lambda: camera._publisher.matching_status.matching)
            for data in messages[40:]:
                camera.put(data)
            expected = 60 if reliable else 40
            until(lambda: job.result()["packets"] == expected, lambda: f"{job.result()}")
            camera.close()
        cable.close()
    result = job.result()
    assert (result["lost"], result["duplicates"], result["foreign"]) == (0 if reliable else 20, 0, 0)
    assert result["events"] == 50 * expected
    if reliable:
        expected = replayed([tiny.packet(events) for events in sent])
        assert [e.t_us for e in sink.emissions] == [e.t_us for e in expected]
        for one, two in zip(sink.emissions, expected, strict=True):
            assert np.array_equal(one.features, two.features)
    assert any(e.incomplete for e in sink.emissions) != reliable
