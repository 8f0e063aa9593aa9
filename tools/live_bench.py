"""Measure live topics: latency against a bare zenoh echo, rates, and what happens when something breaks.

Lives here: a camera and a reader in this process, the commands under test in processes of their own, and one
JSON line for each measurement.

    python tools/live_bench.py latency rate router -m model.safetensors -r ncars.mcap
    python tools/live_bench.py all -m model.safetensors -r ncars.mcap --seconds 60
"""

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from streamfeat.emission import EmitPolicy
from streamfeat.encoder import Encoder
from streamfeat.events import Events
from streamfeat.live.names import Attachment, PlainNames
from streamfeat.live.network import open_session
from streamfeat.live.publisher import MessagePublisher
from streamfeat.messages import EventPacket, FeaturesMessage
from streamfeat.packets import Packet, PacketWriter
from streamfeat.recording import open_recording
from streamfeat.session import Session

FRAME = (100, 120)
"""All samples are shown on one sensor of this size."""
PROGRAM = [sys.executable, "-c", "from streamfeat.cli import main; main()"]
KEY = "bench/cam/events"

ECHO = """
import sys, zenoh
from zenoh.handlers import Callback
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
publisher = session.declare_publisher("bench/echo/out", express=True)
answer = lambda sample: publisher.put(sample.payload, attachment=sample.attachment)
subscriber = session.declare_subscriber("bench/echo/in", Callback(answer, indirect=False))
sys.stdin.read()
"""
ROUTER = """
import sys, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
print("ready", flush=True)
sys.stdin.read()
"""


def camera_packets(recording: Path, seconds: float, slice_us: int = 2_000) -> list[Events]:
    """The events of a recording without the silence between samples, in slices as a driver sends them."""
    slices, shift, total = [], 0, 0
    with open_recording(recording) as rec:
        for sample in rec.samples():
            events = sample.events[np.argsort(sample.events["t"], kind="stable")]
            events = events[(events["x"] < FRAME[1]) & (events["y"] < FRAME[0])].copy()
            events["t"] += shift - sample.label.start_us
            edges = np.arange(shift, shift + sample.label.duration_us + 1, slice_us)
            slices += [part for part in np.split(events, np.searchsorted(events["t"], edges)) if len(part)]
            shift += sample.label.duration_us
            total += sample.label.duration_us
            if total > seconds * 1e6:
                break
    return slices


class Reader:
    """Notes when features arrive, and the numbers of events that a plain subscriber sees."""

    def __init__(self, session: zenoh.Session) -> None:
        self.features: list[tuple[float, int, bool]] = []
        self.arrived = threading.Event()
        self._subscriber = session.declare_subscriber("bench/*/features", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        now = time.perf_counter()
        message = FeaturesMessage.from_cdr(sample.payload.to_bytes())
        self.features.append((now, message.stamp_ns // 1000, message.incomplete))
        self.arrived.set()

    def next_after(self, since: float, timeout: float = 30.0) -> float | None:
        """Seconds from `since` to the next features."""
        until = time.perf_counter() + timeout
        while time.perf_counter() < until:
            after = next((t for t, *_ in reversed(self.features) if t > since), None)
            if after is not None:
                return min(t for t, *_ in self.features if t > since) - since
            self.arrived.clear()
            self.arrived.wait(0.05)
        return None


@contextlib.contextmanager
def process(*words: object, prefix: Sequence[str] = ()) -> Iterator[subprocess.Popen[str]]:
    one = subprocess.Popen(
        [*prefix, *map(str, words)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield one
    finally:
        if one.poll() is None:
            one.kill()
        one.communicate()


@contextlib.contextmanager
def listener(arguments: argparse.Namespace, *more: object) -> Iterator[tuple[subprocess.Popen[str], int]]:
    metrics = arguments.port + 1
    words = ["listen", "bench/*/events", "-m", arguments.model, "--port", arguments.port, "--json", "-q"]
    with process(*PROGRAM, *words, "--metrics", f"127.0.0.1:{metrics}", *more) as one:
        yield one, metrics


def counts(metrics: int) -> dict[str, float]:
    with urllib.request.urlopen(f"http://127.0.0.1:{metrics}/metrics", timeout=10) as page:
        lines = page.read().decode().splitlines()
    pairs = (line.rsplit(" ", 1) for line in lines if not line.startswith("#"))
    return {name.removeprefix("streamfeat_").removesuffix("_total"): float(value) for name, value in pairs}


def finish(one: subprocess.Popen[str]) -> dict[str, Any]:
    one.send_signal(signal.SIGINT)
    text, errors = one.communicate(timeout=60)
    if not text:
        raise SystemExit(errors)
    return json.loads(text)


def wait_for_reader(session: zenoh.Session, key: str, timeout: float = 60.0) -> None:
    with session.declare_publisher(key) as probe:
        until = time.monotonic() + timeout
        while not probe.matching_status.matching:
            if time.monotonic() > until:
                raise SystemExit(f"nobody reads {key}")
            time.sleep(0.01)


def encoded(slices: list[Events]) -> list[tuple[int, int, bytes]]:
    """Each packet as (time of its last event, number of events, CDR)."""
    writer = PacketWriter()
    return [
        (int(part["t"][-1]), len(part), message.to_cdr())
        for part in slices
        for message in writer.messages(part, FRAME)
    ]


def put_at_pace(packets: list[tuple[int, int, bytes]], put: Callable[[bytes], None]) -> list[float]:
    """Put packets at the pace of their events; gives when each was put."""
    started, first, when = time.perf_counter(), packets[0][0], []
    for last_us, _, data in packets:
        wait = started + (last_us - first) / 1e6 - time.perf_counter()
        if wait > 0:
            time.sleep(wait)
        when.append(time.perf_counter())
        put(data)
    return when


def share(values: Sequence[float], percent: float) -> float:
    return round(1e3 * float(np.percentile(values, percent)), 3) if len(values) else float("nan")


def emission_seconds(model: Path, slices: list[Events]) -> list[float]:
    """What the packets that bring a reading cost by themselves: no network, no pipeline."""
    session = Session(Encoder.load(model), EmitPolicy.parse("10ms"))
    spent = []
    for part in slices:
        started = time.perf_counter()
        readings = len(list(session.process(Packet("", part, FRAME, 0, 0))))
        if readings:
            spent.append(time.perf_counter() - started)
    return spent


def latency(arguments: argparse.Namespace) -> dict[str, Any]:
    """From a packet's put to the features that it completes, and to its echo from a bare callback."""
    slices = camera_packets(arguments.recording, min(arguments.seconds, 30))
    packets = encoded(slices)
    alone = emission_seconds(arguments.model, slices)[5:]
    meeting = json.dumps(
        {
            "mode": "peer",
            "connect": {"endpoints": [f"tcp/127.0.0.1:{arguments.port}"]},
            "listen": {"endpoints": ["tcp/127.0.0.1:0"]},
            "scouting": {"multicast": {"enabled": False}},
        }
    )
    with (
        open_session(port=arguments.port) as session,
        listener(arguments, "--emit", "10ms") as (one, _),
        process(sys.executable, "-c", ECHO, meeting),
    ):
        reader = Reader(session)
        echoes: list[tuple[float, int]] = []

        def note(sample: zenoh.Sample) -> None:
            attached = Attachment.unpack(sample.attachment.to_bytes())
            echoes.append((time.perf_counter(), attached.seq if attached else 0))

        watch = session.declare_subscriber("bench/echo/out", note)
        camera = MessagePublisher(session, PlainNames(KEY), KEY, EventPacket.SCHEMA_NAME)
        bare = session.declare_publisher("bench/echo/in", express=True)
        for key in (KEY, "bench/echo/in"):
            wait_for_reader(session, key)
        echoed_at: list[float] = []

        def put(data: bytes) -> None:
            camera.put(data)
            # Not at once: the two would measure how they wait for each other.
            time.sleep(0.0007)
            echoed_at.append(time.perf_counter())
            bare.put(data, attachment=Attachment(len(echoed_at), 0, bytes(16)).pack())

        when = put_at_pace(packets, put)
        time.sleep(1)
        watch.undeclare()
        camera.close()
        result = finish(one)
    ends = np.array([last for last, *_ in packets])
    # The packet that completes a reading is the first whose events reach beyond it.
    seen = [
        arrived - when[index]
        for arrived, t_us, _ in reader.features
        if (index := int(np.searchsorted(ends, t_us))) < len(ends)
    ]
    echo = [arrived - echoed_at[seq - 1] for arrived, seq in echoes]
    return {
        "packets": len(packets),
        "events_per_packet": round(float(np.mean([n for _, n, _ in packets]))),
        "readings": len(seen),
        "emission_alone_p50_ms": share(alone, 50),
        "emission_alone_p99_ms": share(alone, 99),
        "features_p50_ms": share(seen, 50),
        "features_p99_ms": share(seen, 99),
        "echo_p50_ms": share(echo, 50),
        "echo_p99_ms": share(echo, 99),
        "p50_ratio_beyond_the_emission": round((share(seen, 50) - share(alone, 50)) / share(echo, 50), 2),
        "lost": result["lost"],
        "dropped": result["dropped"],
    }


def at_rate(arguments: argparse.Namespace, rate: float, seconds: float, emit: str = "auto") -> dict[str, Any]:
    """Publish packets of 4,096 events at a rate; nothing waits for the listener."""
    rng = np.random.default_rng(0)
    size, ready = 4096, []
    writer = PacketWriter()
    events = np.concatenate(camera_packets(arguments.recording, 5))
    step_us = max(int(size / rate * 1e6), 1)
    with (
        open_session(port=arguments.port) as session,
        listener(arguments, "--emit", emit) as (one, metrics),
    ):
        reader = Reader(session)
        camera = MessagePublisher(session, PlainNames(KEY), KEY, EventPacket.SCHEMA_NAME)
        wait_for_reader(session, KEY)
        # The same pixels again and again, at the times of this rate; encoding is not what is measured.
        for i in range(min(len(events) // size, 64)):
            batch = events[i * size : (i + 1) * size].copy()
            batch["t"] = np.sort(rng.integers(0, step_us, len(batch)))
            (message,) = writer.messages(batch, FRAME)
            ready.append(message)
        started, n = time.perf_counter(), 0
        while (now := time.perf_counter()) - started < seconds:
            due = int((now - started) * rate / size)
            if n >= due:
                time.sleep(0.0005)
                continue
            message = ready[n % len(ready)]
            stamp = n * step_us * 1000
            fresh = EventPacket(stamp, "", *FRAME, n, stamp, message.encoding, False, message.events)
            camera.put(fresh.to_cdr())
            n += 1
        sent_s = time.perf_counter() - started
        # One more that waits for its turn: of what is lost at the very end nothing else would tell.
        attached = Attachment(n + 1, time.time_ns(), camera.gid).pack()
        blocking = zenoh.CongestionControl.BLOCK
        stamp = n * step_us * 1000
        last = EventPacket(stamp, "", *FRAME, n, stamp, message.encoding, False, message.events)
        session.put(KEY, last.to_cdr(), congestion_control=blocking, attachment=attached)
        n += 1
        stopped = time.perf_counter()
        wait = time.monotonic() + 30
        while (seen := counts(metrics))['queue_depth{queue="inbox_messages"}'] and time.monotonic() < wait:
            time.sleep(0.05)
        time.sleep(0.3)
        behind_s = max((t for t, *_ in reader.features), default=stopped) - stopped
        camera.close()
        result = finish(one)
    return {
        "asked_events_per_s": round(rate),
        "sent_events_per_s": round(n * size / sent_s),
        "heard_events_per_s": round(result["events"] / sent_s),
        "seconds": round(sent_s, 1),
        "sent_packets": n,
        "packets": result["packets"],
        "lost": result["lost"],
        "dropped": result["dropped"],
        "unaccounted": n - sum(result[name] for name in ("packets", "lost", "dropped", "unheard")),
        "readings": result["emissions"],
        "incomplete": result["incomplete"],
        "last_features_after_s": round(behind_s, 3),
        "end_to_end_p50_ms": result.get("end_to_end_p50_ms"),
        "end_to_end_p99_ms": result.get("end_to_end_p99_ms"),
        "cameras_seen": int(seen["cameras"]),
    }


def rate(arguments: argparse.Namespace) -> dict[str, Any]:
    """The highest rate at which nothing is lost for as long as asked, and ten times that for ten seconds."""
    asked = arguments.first_rate
    while asked < 2e8 and is_whole(tried := at_rate(arguments, asked, 3.0)):
        print(json.dumps({"try": tried}), flush=True)
        asked *= 1.5
    # What is carried for seconds need not be carried for a minute.
    while asked > 1e4:
        asked *= 0.6
        long = at_rate(arguments, asked, arguments.seconds)
        if is_whole(long):
            ten_times = at_rate(arguments, asked * 10, min(arguments.seconds, 10))
            return {"highest": long, "ten times": ten_times}
        print(json.dumps({"try": long}), flush=True)
    return {"none": long}


def is_whole(tried: dict[str, Any]) -> bool:
    """Whether all that was asked for was sent, and all that was sent was used."""
    missing = tried["lost"] + tried["dropped"] + tried["unaccounted"]
    return not missing and tried["sent_events_per_s"] >= 0.95 * tried["asked_events_per_s"]


def client(folder: Path, port: int, name: str) -> Path:
    path = folder / f"{name}.json5"
    path.write_text(
        json.dumps(
            {
                "mode": "client",
                "connect": {
                    "endpoints": [f"tcp/127.0.0.1:{port}"],
                    "timeout_ms": -1,
                    "exit_on_failure": False,
                    "retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
                },
                "scouting": {"multicast": {"enabled": False}},
            }
        )
    )
    return path


def playing(arguments: argparse.Namespace, *more: object, prefix: Sequence[str] = ()) -> Any:
    words = ["publish", arguments.recording, KEY, "--loop", "--speed", "8", "--wait", "20", "--json"]
    return process(*PROGRAM, *words, *more, prefix=prefix)


def steady(reader: Reader, timeout: float = 90.0) -> None:
    """Wait until features come."""
    if reader.next_after(time.perf_counter(), timeout) is None:
        raise SystemExit("no features come at all")


def accounted(published: int | None, result: dict[str, Any]) -> dict[str, Any]:
    known = {
        name: result[name]
        for name in (
            "packets",
            "unheard",
            "lost",
            "dropped",
            "duplicates",
            "foreign",
            "restarts",
            "incomplete",
        )
    }
    if published is None:
        return known
    missing = published - sum(result[name] for name in ("packets", "unheard", "lost", "dropped"))
    return {"published": published, "unaccounted": missing} | known


def first_after(packets: list[tuple[float, bytes]], since: float, timeout: float) -> float:
    """When the first packet came after a moment."""
    limit = time.perf_counter() + timeout
    while time.perf_counter() < limit:
        if found := next((t for t, _ in list(packets) if t > since), None):
            return found
        time.sleep(0.01)
    raise SystemExit("no packets come from the second publisher")


def publisher_killed(arguments: argparse.Namespace) -> dict[str, Any]:
    """kill -9 of the publisher, and another in its place."""
    port = ["--port", arguments.port]
    with open_session(port=arguments.port) as session, listener(arguments, "--emit", "10ms") as (one, _):
        reader = Reader(session)
        packets: list[tuple[float, bytes]] = []
        watch = session.declare_subscriber(
            KEY, lambda s: packets.append((time.perf_counter(), s.attachment.to_bytes()))
        )
        with playing(arguments, *port) as first:
            steady(reader)
            first.kill()
        killed = time.perf_counter()
        with playing(arguments, *port) as second:
            # What is read in between is a window that empties: what counts comes after a packet.
            began = first_after(packets, killed + 0.2, 60)
            recovered = reader.next_after(began, 60)
            time.sleep(2)
            second.send_signal(signal.SIGINT)
            second.communicate(timeout=30)
        time.sleep(0.5)
        watch.undeclare()
        result = finish(one)
    return {
        "from_first_packet_s": None if recovered is None else round(recovered, 3),
        "from_kill_s": None if recovered is None else round(began + recovered - killed, 3),
        "seen_by_another_reader": len(packets),
    } | accounted(None, result)


def router_killed(arguments: argparse.Namespace) -> dict[str, Any]:
    """kill -9 of the router between clients for a second, and another in its place."""
    config = json.dumps(
        {
            "mode": "router",
            "listen": {"endpoints": [f"tcp/127.0.0.1:{arguments.port}"]},
            "scouting": {"multicast": {"enabled": False}},
        }
    )
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        path = client(Path(name), arguments.port, "client")
        router = stack.enter_context(process(sys.executable, "-c", ROUTER, config))
        router.stdout.readline()
        session = stack.enter_context(open_session(path))
        reader = Reader(session)
        one, _ = stack.enter_context(listener(arguments, "--emit", "10ms", "--zenoh-config", path))
        camera = stack.enter_context(playing(arguments, "--zenoh-config", path))
        steady(reader)
        router.kill()
        router.wait()
        time.sleep(1)
        again = stack.enter_context(process(sys.executable, "-c", ROUTER, config))
        again.stdout.readline()
        back = time.perf_counter()
        recovered = reader.next_after(back, 30)
        time.sleep(2)
        camera.send_signal(signal.SIGINT)
        published = json.loads(camera.communicate(timeout=30)[0])["packets"]
        time.sleep(0.5)
        result = finish(one)
    return {"recovered_s": recovered and round(recovered, 3)} | accounted(published, result)


def subscriber_stopped(arguments: argparse.Namespace) -> dict[str, Any]:
    """SIGSTOP of the listener for some seconds."""
    with open_session(port=arguments.port) as session, listener(arguments, "--emit", "10ms") as (one, _):
        reader = Reader(session)
        with playing(arguments, "--port", arguments.port) as camera:
            steady(reader)
            one.send_signal(signal.SIGSTOP)
            time.sleep(arguments.cut)
            on = time.perf_counter()
            one.send_signal(signal.SIGCONT)
            recovered = reader.next_after(on, 30)
            time.sleep(3)
            camera.send_signal(signal.SIGINT)
            published = json.loads(camera.communicate(timeout=30)[0])["packets"]
        time.sleep(0.5)
        result = finish(one)
    return {"recovered_s": recovered and round(recovered, 3)} | accounted(published, result)


def network_cut(arguments: argparse.Namespace) -> dict[str, Any]:
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
        there, here = Path(name) / "there.json5", Path(name) / "here.json5"
        endpoint = f"tcp/10.213.77.1:{arguments.port}"
        quiet = {"scouting": {"multicast": {"enabled": False}}}
        here.write_text(
            json.dumps(quiet | {"mode": "peer", "listen": {"endpoints": [endpoint, "tcp/127.0.0.1:0"]}})
        )
        there.write_text(
            json.dumps(
                json.loads(client(Path(name), 1, "x").read_text())
                | {"connect": {"endpoints": [endpoint], "timeout_ms": -1, "exit_on_failure": False}}
            )
        )
        session_file = client(Path(name), arguments.port, "reader")
        session_file.write_text(session_file.read_text().replace("127.0.0.1", "10.213.77.1"))
        one, _ = stack.enter_context(listener(arguments, "--emit", "10ms", "--zenoh-config", here))
        time.sleep(1)
        session = stack.enter_context(open_session(session_file))
        reader = Reader(session)
        into = ["ip", "netns", "exec", space]
        camera = stack.enter_context(playing(arguments, "--zenoh-config", there, prefix=into))
        steady(reader)
        subprocess.run(["ip", "-n", space, "link", "set", inside, "down"], check=True)
        time.sleep(arguments.cut)
        subprocess.run(["ip", "-n", space, "link", "set", inside, "up"], check=True)
        up = time.perf_counter()
        recovered = reader.next_after(up + 0.05, 30)
        time.sleep(3)
        camera.send_signal(signal.SIGINT)
        published = json.loads(camera.communicate(timeout=30)[0])["packets"]
        time.sleep(0.5)
        result = finish(one)
    return {"recovered_s": recovered and round(recovered + 0.05, 3)} | accounted(published, result)


MEASUREMENTS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "latency": latency,
    "rate": rate,
    "publisher": publisher_killed,
    "router": router_killed,
    "stopped": subscriber_stopped,
    "cut": network_cut,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="+", choices=[*MEASUREMENTS, "all"])
    parser.add_argument("-m", "--model", type=Path, required=True)
    parser.add_argument("-r", "--recording", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--cut", type=float, default=5.0, help="seconds of SIGSTOP, and of the cut")
    parser.add_argument("--first-rate", type=float, default=500_000)
    parser.add_argument("--port", type=int, default=17470)
    arguments = parser.parse_args()
    load = os.getloadavg()[0]
    print(json.dumps({"cores": os.cpu_count(), "load before": load, "python": sys.version.split()[0]}))
    for name in MEASUREMENTS if "all" in arguments.what else arguments.what:
        arguments.port += 10
        print(json.dumps({name: MEASUREMENTS[name](arguments)}), flush=True)


if __name__ == "__main__":
    main()
