"""Publishers, routers and links that break, and a listener that is stopped.

Each gives how soon all is well again, `recovered_s`, and what was lost; `unaccounted` are packets that nobody
has counted.
"""

import contextlib
import signal
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from streamfeat.live.network import open_session
from tools.live_bench.processes import (
    KEY,
    Process,
    Reader,
    finish,
    listener,
    process,
    streamfeat,
    zenoh_config,
)

ROUTER = """
import sys, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
print("ready", flush=True)
sys.stdin.read()
"""


def publisher_killed(arguments: Namespace) -> dict[str, Any]:
    """kill -9 of the publisher, and another in its place."""
    port = ["--port", arguments.port]
    with open_session(port=arguments.port) as session, listener(arguments, "--emit", "10ms") as (one, _):
        reader = Reader(session)
        packets: list[tuple[float, bytes]] = []
        watch = session.declare_subscriber(
            KEY, lambda s: packets.append((time.perf_counter(), s.attachment.to_bytes()))
        )
        with _playing(arguments, *port) as first:
            _steady(reader)
            first.kill()
        killed = time.perf_counter()
        with _playing(arguments, *port) as second:
            # What is read in between is a window that empties: what counts comes after a packet.
            began = _first_after(packets, killed + 0.2, 60)
            recovered = reader.next_after(began, 60)
            time.sleep(2)
            finish(second)
        time.sleep(0.5)
        watch.undeclare()
        result = finish(one)
    return {
        "from_first_packet_s": None if recovered is None else round(recovered, 3),
        "from_kill_s": None if recovered is None else round(began + recovered - killed, 3),
        "seen_by_another_reader": len(packets),
    } | _counts(result)


def router_killed(arguments: Namespace) -> dict[str, Any]:
    """kill -9 of the router between clients for a second, and another in its place."""
    address = f"127.0.0.1:{arguments.port}"
    config = zenoh_config("router", listen=[address])
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        path = Path(name) / "client.json5"
        path.write_text(zenoh_config("client", connect=[address]))
        router = stack.enter_context(process(sys.executable, "-c", ROUTER, config))
        router.stdout.readline()
        session = stack.enter_context(open_session(path))
        reader = Reader(session)
        one, _ = stack.enter_context(listener(arguments, "--emit", "10ms", "--zenoh-config", path))
        camera = stack.enter_context(_playing(arguments, "--zenoh-config", path))
        _steady(reader)
        router.kill()
        router.wait()
        time.sleep(1)
        again = stack.enter_context(process(sys.executable, "-c", ROUTER, config))
        again.stdout.readline()
        back = time.perf_counter()
        recovered = reader.next_after(back, 30)
        return _after(recovered, camera, one, reader)


def subscriber_stopped(arguments: Namespace) -> dict[str, Any]:
    """SIGSTOP of the listener for some seconds."""
    with open_session(port=arguments.port) as session, listener(arguments, "--emit", "10ms") as (one, _):
        reader = Reader(session)
        with _playing(arguments, "--port", arguments.port) as camera:
            _steady(reader)
            one.send_signal(signal.SIGSTOP)
            time.sleep(arguments.cut)
            on = time.perf_counter()
            one.send_signal(signal.SIGCONT)
            recovered = reader.next_after(on, 30)
            return _after(recovered, camera, one, reader)


def network_cut(arguments: Namespace) -> dict[str, Any]:
    """The camera's network namespace is cut off for some seconds."""
    space, outside, inside = "sfbench", "sfb0", "sfb1"
    setup = [
        f"ip netns add {space}",
        f"ip link add {outside} type veth peer name {inside} netns {space}",
        f"ip addr add 10.213.77.1/24 dev {outside}",
        f"ip link set {outside} up",
        f"ip -n {space} addr add 10.213.77.2/24 dev {inside}",
        f"ip -n {space} link set {inside} up",
        f"ip -n {space} link set lo up",
    ]
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        stack.callback(lambda: subprocess.run(["ip", "netns", "del", space], capture_output=True))
        for command in setup:
            done = subprocess.run(command.split(), capture_output=True, text=True)
            if done.returncode:
                return {"skipped": f"{command}: {done.stderr.strip()}"}
        address = f"10.213.77.1:{arguments.port}"
        here, there = Path(name) / "here.json5", Path(name) / "there.json5"
        here.write_text(zenoh_config("peer", listen=[address]))
        there.write_text(zenoh_config("client", connect=[address]))
        one, _ = stack.enter_context(listener(arguments, "--emit", "10ms", "--zenoh-config", here))
        session = stack.enter_context(open_session(there))
        reader = Reader(session)
        into = ["ip", "netns", "exec", space]
        camera = stack.enter_context(_playing(arguments, "--zenoh-config", there, prefix=into))
        _steady(reader)
        subprocess.run(["ip", "-n", space, "link", "set", inside, "down"], check=True)
        time.sleep(arguments.cut)
        subprocess.run(["ip", "-n", space, "link", "set", inside, "up"], check=True)
        up = time.perf_counter()
        return _after(reader.next_after(up, 30), camera, one, reader)


def _playing(
    arguments: Namespace, *more: object, prefix: Sequence[str] = ()
) -> contextlib.AbstractContextManager[Process]:
    words = ["publish", arguments.recording, KEY, "--loop", "--speed", "8", "--wait", "20", "--json"]
    return streamfeat(*words, *more, prefix=prefix)


def _steady(reader: Reader, timeout: float = 90.0) -> None:
    """Wait until features come."""
    if reader.next_after(time.perf_counter(), timeout) is None:
        raise SystemExit("no features come at all")


def _after(recovered: float | None, camera: Process, one: Process, reader: Reader) -> dict[str, Any]:
    """Let it run on for some seconds, end the camera and then the listener, and compare what they counted."""
    time.sleep(3)
    published = finish(camera)["packets"]
    while reader.next_after(time.perf_counter(), 1) is not None:
        pass  # what was under way when the camera ended still arrives
    result = _counts(finish(one))
    missing = published - sum(result[name] for name in ("packets", "unheard", "lost", "dropped"))
    return {
        "recovered_s": recovered and round(recovered, 3),
        "published": published,
        "unaccounted": missing,
    } | result


def _counts(result: dict[str, Any]) -> dict[str, Any]:
    names = "packets unheard lost dropped duplicates foreign restarts incomplete"
    return {name: result[name] for name in names.split()}


def _first_after(packets: list[tuple[float, bytes]], since: float, timeout: float) -> float:
    """When the first packet came after a moment."""
    limit = time.perf_counter() + timeout
    while time.perf_counter() < limit:
        if found := next((t for t, _ in list(packets) if t > since), None):
            return found
        time.sleep(0.01)
    raise SystemExit("no packets come from the second publisher")
