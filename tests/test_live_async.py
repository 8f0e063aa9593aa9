"""Live topics as an asynchronous iterator, over real zenoh sessions on loopback; bad ports."""

import asyncio
import socket
import threading

import numpy as np
import pytest
import tiny
from live_net import attachment, compiled, free_port, plain_publisher

import streamfeat as sf
from streamfeat.errors import InputError
from streamfeat.live import network
from streamfeat.live.network import Network, open_session
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.codecs import encode

MODEL = tiny.encoder(k=3)
CLASSIFIER = tiny.classifier(MODEL)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    MODEL.save(folder / "model")
    CLASSIFIER.save(folder / "classifier")
    return compiled(folder)


def cdr(events, seq):
    payload, base_ns = encode(events, "mono")
    return EventPacket(0, "", *tiny.RESOLUTION, seq, base_ns, "mono", False, payload).to_cdr()


@pytest.fixture(autouse=True)
def before():
    """Threads that tests of other files have left."""
    THEIRS[:] = threading.enumerate()


THEIRS = []


def ours():
    """Threads of this project that a test has started."""
    return [t.name for t in threading.enumerate() if t.name.startswith("streamfeat") and t not in THEIRS]


def test_emissions_of_live_topics_have_the_bits_of_the_offline_path(files):
    port = free_port()
    sent = [tiny.steady(i * 10_000, (i + 1) * 10_000, 200, seed=i) for i in range(40)]
    everything = np.concatenate(sent)
    is_enough = threading.Event()

    def publish():
        with open_session(port=port) as net, plain_publisher(net, "cam/a/events") as camera:
            for i, events in enumerate(sent):
                camera.put(cdr(events, i), attachment=attachment(i + 1))
            assert is_enough.wait(60)

    async def main():
        options = {"port": port, "max_delay_s": 1e9, "emit": "10ms"}
        async with sf.listen("cam/*/events", files / "model", files / "classifier", **options) as stream:
            publishing = asyncio.create_task(asyncio.to_thread(publish))
            found = []
            async for emission in stream:
                assert emission.topic == "cam/a/events"
                found.append(emission)
                if emission.t_us >= 390_000:
                    break
            is_enough.set()
            await publishing
            while (stats := stream.stats()).session.events < len(everything):
                await asyncio.sleep(0)  # the rest of the packet in which the last bin began
        assert stats.session.events == len(everything)
        assert not any(stats.drops.values())
        return found

    for e in asyncio.run(main()):
        before = everything[everything["t"] < e.t_us]
        features = MODEL.encode(before, tiny.RESOLUTION, origin_us=0, t_us=e.t_us - 1)
        assert np.array_equal(e.features, features)
        assert np.array_equal(e.scores, CLASSIFIER.scores(features))
    assert not ours()
    with socket.socket() as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        one.bind(("127.0.0.1", port))  # nothing holds it any more


def test_stop_ends_listening_and_the_iteration(files):
    async def main():
        async with sf.listen("cam/*/events", MODEL, port=free_port()) as stream:
            while stream._pipeline is None:
                await asyncio.sleep(0)
            stream.stop()
            assert [e async for e in stream] == []

    asyncio.run(main())
    assert not ours()


def test_listening_is_cancelled_wherever_it_waits(files):
    async def listen(port):
        async for _ in sf.listen("cam/*/events", MODEL, port=port):
            pass

    async def main():
        for turns in (1, 3, 10, 100, 1000):
            task = asyncio.create_task(listen(free_port()))
            for _ in range(turns):
                await asyncio.to_thread(int)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            assert not ours()

    asyncio.run(main())


def test_a_port_of_another_program_is_said_to_be_one(monkeypatch):
    monkeypatch.setattr(network, "_MEETING_S", 0.3)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(
            InputError, match=f"port {port} of this machine is held by a program that does not"
        ):
            Network(port=port).open()


@pytest.mark.parametrize("port", [-1, 0, 65536, 99999])
def test_ports_that_do_not_exist_are_refused(port):
    with pytest.raises(InputError, match=f"--port {port}: there is no such port"):
        sf.listen("cam/*/events", MODEL, port=port)


@pytest.mark.parametrize("key", ["/robot/cam1", "robot/cam1/", "", "/"])
def test_keys_that_zenoh_would_not_take_are_refused_in_plain_words(key):
    with pytest.raises(InputError, match="is no zenoh key"):
        network.PlainNames(key)
