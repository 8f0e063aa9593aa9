"""Hours of a listener, a recorder and a view, in processes of their own, while all around them goes wrong.

Lives here: cameras that come and go and send badly, a disk that is full for a while, browsers that come and
go, and what the processes hold meanwhile.
Not here: a day of stream time at full speed (`soak`).

    python -m torture.hours --hours 2 --out /tmp/soak

writes `OUT-samples.json` (a JSON object a line, each ten seconds) and, each minute and at the end,
`OUT-result.json`: memory, open files, threads, processor time and latency in the first and last tenth, and
what was sent beside what was counted.
"""

import argparse
import asyncio
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

TESTS = Path(__file__).resolve().parents[1]
if __name__ == "__main__":
    sys.path += [str(TESTS), str(TESTS.parent)]

from streamfeat.events import make_events  # noqa: E402
from streamfeat.live.names import Attachment, PlainNames, encoding_of  # noqa: E402
from streamfeat.live.network import open_session  # noqa: E402
from streamfeat.messages.cdr import EventPacket  # noqa: E402
from streamfeat.messages.codecs import encode  # noqa: E402
from torture.nursery import free_port  # noqa: E402
from torture.table import Row, Trials  # noqa: E402

__all__ = ["hours"]

_CAMERAS = 3
_NAMES = 100
"""Cameras have so many names, by turns: more than are followed at a time."""
_STEP_US = 100_000
_EVENTS = 300
_SIDES = 34, 34
_LIFE_S = 20.0, 90.0
_AWAY_S = 1.0, 8.0
_FAULTS = {
    "lost": 0.01,
    "doubled": 0.01,
    "swapped": 0.01,
    "jump": 0.002,
    "restart": 0.002,
    "garbage": 0.002,
}
"""How often each happens to a packet."""
_DISK_BYTES = 48 << 20
_SAMPLE_S = 10.0
_GROWTH = 12 << 20
_TWO_HOURS_S = 7_200.0
_MODEL = "recordings/digits.safetensors", "recordings/digits_classifier.safetensors"


def hours(trials: Trials) -> list[Row]:
    """Rows for what the processes hold, for latency, and for what was counted."""
    seconds = max(180.0, _TWO_HOURS_S * trials.scale)
    siege = _Siege(trials.folder, trials.folder / "siege", seconds, trials.seed)
    return _rows(siege.run(trials.say))


@dataclass
class _Camera:
    """A camera of some life, which sends as a bad network would have it."""

    topic: str
    rng: np.random.Generator
    ends: float
    said: Counter[str]
    gid: bytes = b""
    seq: int = 0
    time_us: int = 1_000_000
    open_gap: int = 0
    held: tuple[bytes, int] | None = None
    payloads: list[bytes] = field(default_factory=list)

    def begin(self, session: Any) -> None:
        self.gid = self.rng.bytes(16)
        self.token = session.liveliness().declare_token(PlainNames(self.topic).token(self.topic, self.gid))
        self.publisher = session.declare_publisher(self.topic, encoding=encoding_of(EventPacket.SCHEMA_NAME))
        self.said["lives"] += 1

    def end(self) -> None:
        if self.held:
            self._put(*self.held)
        self.held = None
        self.publisher.undeclare()
        self.token.undeclare()

    def step(self) -> None:
        """Send a packet, or what becomes of it."""
        fault = self._fault() if self.seq > 3 else ""
        if self.held and fault in ("swapped", "lost"):
            fault = ""  # one at a time, or the packet that is held would be lost, too
        self.said[fault or "sound"] += 1
        if fault == "jump":
            self.time_us += int(self.rng.integers(100_000_000, 300_000_000))
        elif fault == "restart":
            self.time_us = 1_000
        packet, seq = self._packet()
        if fault == "lost":
            self.open_gap += 1
            return
        self.said["lost, and noticeable"] += self.open_gap
        self.open_gap = 0
        if fault == "garbage":
            packet = self.rng.bytes(200)
        if fault == "swapped":
            self.held = packet, seq
            return
        self._put(packet, seq)
        if fault == "doubled":
            self._put(packet, seq)
        if self.held:
            self._put(*self.held)
            self.held = None

    def _fault(self) -> str:
        drawn = float(self.rng.random())
        for name, share in _FAULTS.items():
            if drawn < share:
                return name
            drawn -= share
        return ""

    def _packet(self) -> tuple[bytes, int]:
        t = np.sort(self.rng.integers(0, _STEP_US, _EVENTS))
        x, y, p = (self.rng.integers(0, most, _EVENTS) for most in (_SIDES[1], _SIDES[0], 2))
        payload, base_ns = encode(make_events(x, y, p, t + self.time_us), "mono")
        self.seq += 1
        packet = EventPacket(time.time_ns(), "", *_SIDES, self.seq, base_ns, "mono", False, payload).to_cdr()
        self.time_us += _STEP_US
        return packet, self.seq

    def _put(self, packet: bytes, seq: int) -> None:
        self.publisher.put(packet, attachment=Attachment(seq, time.time_ns(), self.gid).pack())


class _Siege:
    """Everything together, for so many seconds."""

    def __init__(self, folder: Path, out: Path, seconds: float, seed: int, root: Path = TESTS.parent) -> None:
        self.folder, self.out, self.seconds, self.root = folder, out, seconds, root
        self.rng = np.random.default_rng(seed)
        self.said: Counter[str] = Counter()
        self.failures: list[str] = []
        self.port, self.web, self.metrics = free_port(), free_port(), free_port()
        self.lines: Counter[str] = Counter()
        self.began = 0.0

    def run(self, say: Any = lambda line: None) -> dict[str, Any]:
        """Run it; gives the result."""
        with _small_disk(self.folder / "disk") as disk:
            self.disk = disk
            return self._run(say)

    def _run(self, say: Any) -> dict[str, Any]:
        model = ["-m", str(self.root / _MODEL[0]), "-c", str(self.root / _MODEL[1])]
        listen = ["listen", "siege/**", *model, "--emit", "100ms", "--json-lines", "-", "--threads", "1"]
        listen += ["--state", str(self.disk / "state"), "--metrics", f"127.0.0.1:{self.metrics}"]
        view = ["view", "siege/**", *model, "--rate", "4", "--web-port", str(self.web), "--no-open"]
        view += ["--threads", "1", "--zenoh-port", str(self.port)]
        log = self.folder / "listen.err"
        self.listener = self._start([*listen, "--port", str(self.port)], log, stdout=subprocess.PIPE)
        reader = threading.Thread(target=self._read_lines, daemon=True)
        reader.start()
        with (self.folder / "view.out").open("wb") as shown:
            self.viewer = self._start(view, self.folder / "view.err", stdout=shown.fileno())
        self.recorder: subprocess.Popen[bytes] | None = None
        samples: list[dict[str, Any]] = []
        self._wait_for_metrics()
        self.began = time.monotonic()
        stopped = threading.Event()
        browsers = threading.Thread(target=self._browse, args=(stopped,), daemon=True)
        browsers.start()
        with open_session(port=self.port) as session, Path(f"{self.out}-samples.json").open("w") as kept:
            for sample in self._go_on(session):
                samples.append(sample)
                kept.write(json.dumps(sample) + "\n")
                kept.flush()
                if len(samples) % 6 == 0:
                    self._write(samples, "running")
                    say(f"hours: {sample['t_s']:.0f} of {self.seconds:.0f} s")
        stopped.set()
        browsers.join(60)
        self._end_recorder()
        for name, process in (("listen", self.listener), ("view", self.viewer)):
            process.send_signal(signal.SIGINT)
            try:
                status = process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                status = -9
            if status:
                self.failures.append(f"{name} ended with status {status}")
        for log in self.folder.glob("*.err"):
            if "Traceback" in log.read_text(errors="replace"):
                self.failures.append(f"a traceback in {log.name}")
        return self._write(samples, "done")

    def _start(self, words: list[str], log: Path, stdout: int) -> "subprocess.Popen[bytes]":
        python = "import os, sys; os.nice(10); from streamfeat.cli import main; main()"
        environment = {
            **os.environ,
            "PYTHONPATH": str(self.root),
            "NO_COLOR": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        with log.open("ab") as errors:
            return subprocess.Popen(
                [sys.executable, "-c", python, *words], stdout=stdout, stderr=errors, env=environment
            )

    def _read_lines(self) -> None:
        assert self.listener.stdout
        for line in self.listener.stdout:
            emission = json.loads(line)
            self.lines["emissions"] += 1
            self.lines["incomplete"] += bool(emission.get("incomplete"))

    def _go_on(self, session: Any) -> Iterator[dict[str, Any]]:
        cameras: list[_Camera | None] = [None] * _CAMERAS
        back = [0.0] * _CAMERAS
        named = 0
        next_sample = turn = 0.0
        period = min(600.0, self.seconds / 3)
        full = False
        while (now := time.monotonic() - self.began) < self.seconds:
            for i, camera in enumerate(cameras):
                if camera is None and now >= back[i]:
                    topic, named = f"siege/cam{named % _NAMES}/events", named + 1
                    ends = now + float(self.rng.uniform(*_LIFE_S))
                    cameras[i] = camera = _Camera(topic, self.rng, ends, self.said)
                    camera.begin(session)
                elif camera and now >= camera.ends:
                    camera.end()
                    cameras[i], back[i] = None, now + float(self.rng.uniform(*_AWAY_S))
                if cameras[i]:
                    cameras[i].step()  # type: ignore[union-attr]
            should_be_full = 0.6 * period < now % period < 0.6 * period + min(60.0, period / 5)
            if should_be_full != full:
                full = should_be_full
                self._fill() if full else self._make_room()
            self._keep_recording(full, now % period > 0.9 * period)
            for name, process in (("listen", self.listener), ("view", self.viewer)):
                if process.poll() is not None:
                    self.failures.append(f"{name} ended at {now:.0f} s with status {process.returncode}")
                    return
            if now >= next_sample:
                next_sample += _SAMPLE_S
                yield self._sample(now)
            turn = max(turn + _STEP_US / 1e6, now)
            time.sleep(max(0.0, turn - (time.monotonic() - self.began)))
        for camera in cameras:
            if camera:
                camera.end()
        time.sleep(2)
        yield self._sample(time.monotonic() - self.began)

    def _fill(self) -> None:
        self.said["disk full"] += 1
        # Where nothing could be mounted the disk is the machine's, and is left alone.
        with suppress(OSError), (self.disk / "filler").open("ab", buffering=0) as file:
            while self.disk.is_mount():
                file.write(bytes(4096))

    def _make_room(self) -> None:
        (self.disk / "filler").unlink(missing_ok=True)

    def _keep_recording(self, full: bool, ending: bool) -> None:
        """Start a recorder, and look at how one ends: when it is told to, or when its disk is full."""
        if self.recorder and self.recorder.poll() is not None:
            self._judge_recorder(self.recorder.returncode)
        elif self.recorder and ending:
            self._end_recorder()
        elif self.recorder is None and not full and not ending:
            for old in self.disk.glob("out.mcap*"):
                old.unlink()
            self.said["recorders"] += 1
            words = ["record", "siege/**", "-o", str(self.disk / "out.mcap"), "--port", str(self.port), "-q"]
            self.recorder = self._start(
                [*words, "--json"], self.folder / "record.err", stdout=subprocess.DEVNULL
            )

    def _end_recorder(self) -> None:
        if self.recorder:
            self.recorder.send_signal(signal.SIGINT)
            try:
                self._judge_recorder(self.recorder.wait(30))
            except subprocess.TimeoutExpired:
                self.recorder.kill()
                self.failures.append("record did not end within 30 s")

    def _judge_recorder(self, status: int) -> None:
        self.said[f"record ended with {status}"] += 1
        if status not in (0, 2):
            self.failures.append(f"record ended with status {status}")
        self.recorder = None

    def _browse(self, stopped: threading.Event) -> None:
        """Browsers come, look for a while, and go; each third reads nothing."""
        rng = np.random.default_rng(7)
        address = ""
        while not stopped.is_set():
            log = "".join(
                (self.folder / name).read_text(errors="replace") for name in ("view.err", "view.out")
            )
            found = re.findall(r"http://127\.0\.0\.1:\d+/\?token=\S+", log)
            address = found[-1] if found else ""
            if not address:
                stopped.wait(1)
                continue
            stays, reads = float(rng.uniform(5, 40)), bool(rng.integers(3))
            try:
                asyncio.run(_look(address, min(stays, self.seconds / 6), reads, self.said))
                self.said["browsers"] += 1
            except OSError as error:
                self.failures.append(f"a browser: {error}")
            stopped.wait(float(rng.uniform(1, 20)))

    def _wait_for_metrics(self) -> None:
        limit = time.monotonic() + 300
        while time.monotonic() < limit:
            if self.listener.poll() is not None:
                break
            with suppress(OSError):
                self._scrape()
                return
            time.sleep(0.5)
        raise RuntimeError((self.folder / "listen.err").read_text()[-500:])

    def _scrape(self) -> dict[str, float]:
        with urllib.request.urlopen(f"http://127.0.0.1:{self.metrics}/metrics", timeout=20) as answer:
            lines = answer.read().decode().splitlines()
        values = (line.rpartition(" ") for line in lines if not line.startswith("#"))
        return {name.removeprefix("streamfeat_"): float(value) for name, _, value in values}

    def _sample(self, now: float) -> dict[str, Any]:
        held = {
            "listen": _held(self.listener.pid),
            "view": _held(self.viewer.pid),
            "harness": _held(os.getpid()),
        }
        if self.recorder and self.recorder.poll() is None:
            held["record"] = _held(self.recorder.pid)
        try:
            metrics = self._scrape()
        except OSError as error:
            self.failures.append(f"no metrics at {now:.0f} s: {error}")
            metrics = {}
        return {"t_s": round(now, 1), "load": os.getloadavg()[0], "held": held, "metrics": metrics}

    def _write(self, samples: list[dict[str, Any]], state: str) -> dict[str, Any]:
        result = {
            "state": state,
            "seconds": samples[-1]["t_s"],
            "tenths": _tenths(samples),
            "done to it": dict(self.said),
            "counted": {k: v for k, v in samples[-1]["metrics"].items() if "latency" not in k},
            "lines": dict(self.lines),
            "failures": self.failures,
        }
        Path(f"{self.out}-result.json").write_text(json.dumps(result, indent=1) + "\n")
        return result


async def _look(address: str, seconds: float, reads: bool, said: Counter[str]) -> None:
    """Be a browser for a while."""
    from websockets.asyncio.client import connect
    from websockets.exceptions import WebSocketException

    page, _, token = address.partition("/?")
    try:
        async with connect(f"ws://{page.removeprefix('http://')}/stream?{token}", max_queue=2) as connection:
            async with asyncio.timeout(seconds):
                while True:
                    if reads:
                        await connection.recv()
                        said["seen by browsers"] += 1
                    else:
                        await asyncio.sleep(1)
    except TimeoutError:
        return
    except WebSocketException as error:
        raise OSError(f"{type(error).__name__}: {error}") from error


@contextmanager
def _small_disk(where: Path) -> Iterator[Path]:
    """A file system of its own, where one can be mounted; a folder elsewhere."""
    where.mkdir(parents=True, exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={_DISK_BYTES}", "tmpfs", str(where)]
    mounted = os.geteuid() == 0 and subprocess.run(command, check=False, capture_output=True).returncode == 0
    try:
        yield where
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(where)], check=False)


def _held(pid: int) -> dict[str, float]:
    """Memory in bytes, open files, threads and processor seconds of a process."""
    process = Path(f"/proc/{pid}")
    stat = (process / "stat").read_text().rpartition(")")[2].split()
    page, tick = os.sysconf("SC_PAGE_SIZE"), os.sysconf("SC_CLK_TCK")
    return {
        "rss": int((process / "statm").read_text().split()[1]) * page,
        "files": len(os.listdir(process / "fd")),  # noqa: PTH208
        "threads": int(stat[17]),
        "cpu_s": (int(stat[11]) + int(stat[12])) / tick,
    }


def _tenths(samples: list[dict[str, Any]]) -> dict[str, Any]:
    """The first tenth, behind a twentieth to warm up, and the last."""
    n = len(samples)
    warm, tenth = n // 20, max(2, n // 10)
    parts = {"first": samples[warm : warm + tenth], "last": samples[-tenth:]}
    return {name: _summary(part) for name, part in parts.items()} if n >= 4 else {}


def _summary(part: list[dict[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {"from_s": part[0]["t_s"], "to_s": part[-1]["t_s"]}
    span = max(part[-1]["t_s"] - part[0]["t_s"], 1e-9)
    for name in ("listen", "view", "harness"):
        held = [sample["held"][name] for sample in part]
        result[name] = {key: median(one[key] for one in held) for key in ("rss", "files", "threads")}
        result[name]["cpu_share"] = round((held[-1]["cpu_s"] - held[0]["cpu_s"]) / span, 4)
    for kind in ("update", "end_to_end"):
        result[f"{kind}_s"] = _percentiles(part[0]["metrics"], part[-1]["metrics"], kind)
    return result


def _percentiles(before: dict[str, float], after: dict[str, float], kind: str) -> dict[str, float]:
    """Bounds of a Prometheus histogram's buckets that hold some percentiles, interpolated."""
    marks = []
    for name, value in after.items():
        found = re.fullmatch(rf'{kind}_latency_seconds_bucket{{le="(.*)"}}', name)
        if found:
            marks.append((float(found[1]), value - before.get(name, 0.0)))
    marks.sort()
    result = {}
    for share in (0.5, 0.9, 0.99):
        aim, low, under = share * (marks[-1][1] if marks else 0), 0.0, 0.0
        for high, count in marks:
            if count >= aim and count > under:
                result[f"p{share * 100:g}"] = low + (min(high, 10.0) - low) * (aim - under) / (count - under)
                break
            low, under = high, count
    return result


def _rows(result: dict[str, Any]) -> list[Row]:
    said, counted = result["done to it"], result["counted"]
    first, last = result["tenths"]["first"], result["tenths"]["last"]
    what = f"{result['seconds'] / 3600:.2g} h of `listen`, `record` and `view`"
    grown = [
        f"{name} {key}: {first[name][key]:,.0f} to {last[name][key]:,.0f}"
        for name in ("listen", "view")
        for key, most in (("rss", _GROWTH), ("files", 4), ("threads", 2))
        if last[name][key] > first[name][key] + most
    ]
    mb = [f"{part[name]['rss'] / 1e6:.0f}" for name in ("listen", "view") for part in (first, last)]
    steady = f"RSS of listen {mb[0]} to {mb[1]} MB, of view {mb[2]} to {mb[3]} MB, first to last tenth"
    same = counted.get("lost_packets_total") == said["lost, and noticeable"]
    lost = f"{said['lost']} packets lost, {counted.get('lost_packets_total'):.0f} counted"
    unequal = () if same else (lost,)
    slow = [
        f"{kind} p50 {first[kind]['p50']:.2g} to {last[kind]['p50']:.2g}"
        for kind in ("update_s", "end_to_end_s")
        if last[kind]["p50"] > 1.5 * first[kind]["p50"]
    ]
    latency = ", ".join(
        f"{kind} p50 {1e3 * first[kind]['p50']:.2f} to {1e3 * last[kind]['p50']:.2f} ms"
        for kind in ("update_s", "end_to_end_s")
    )
    failures = tuple(result["failures"])
    common = {"seconds": result["seconds"]}
    return [
        Row(f"{what}: all go on", 1, int(not failures), note=_told(said), failures=failures, **common),
        Row(f"{what}: what they hold", 1, int(not grown), note=steady, failures=tuple(grown), **common),
        Row(f"{what}: latency", 1, int(not slow), note=latency, failures=tuple(slow), **common),
        Row(f"{what}: losses", 1, int(same), note=lost, failures=unequal, **common),
    ]


def _told(said: dict[str, int]) -> str:
    return ", ".join(f"{name} {value:,}" for name, value in sorted(said.items()))


def main() -> int:
    """Run it as a program."""
    parser = argparse.ArgumentParser(prog="python -m torture.hours")
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--out", type=Path, default=Path("soak"))
    parser.add_argument("--folder", type=Path, required=True, help="to work in")
    parser.add_argument("--root", type=Path, default=TESTS.parent, help="tree whose streamfeat is run")
    options = parser.parse_args()
    siege = _Siege(options.folder, options.out, 3600 * options.hours, 1, options.root)
    result = siege.run(lambda line: print(line, file=sys.stderr, flush=True))
    for row in _rows(result):
        print(row)
    return int(bool(result["failures"]))


if __name__ == "__main__":
    sys.exit(main())
