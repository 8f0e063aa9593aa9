"""Eight cameras on two workers of a cluster, of which one is killed or cut off.

Lives here: the cameras, who publishes their features when, and what all have counted.
Not here: the machines and processes (`spaces`).
"""

import json
import re
import signal
import sys
import tempfile
import threading
import time
from argparse import Namespace
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import zenoh

from streamfeat.live.names import Attachment, PlainNames
from streamfeat.live.network import open_session
from streamfeat.live.publisher import MessagePublisher
from streamfeat.messages.cdr import EventPacket, FeaturesMessage
from streamfeat.messages.packets import PacketWriter
from streamfeat.report.machine import Disturbance
from tools.live_bench.faults import ROUTER
from tools.live_bench.processes import FRAME, PROGRAM, camera_packets, numbered, process, zenoh_config
from tools.live_bench.spaces import HOST, NotHereError, Two, logged, two_workers

_KEYS = [f"bench/{i}/events" for i in range(8)]
_SLICE_US = 20_000
_STEADY_S = 3.0
_PATIENCE_S = 90.0
_COUNTED = ("packets", "unheard", "lost", "dropped", "missed")
_BEGUN = re.compile(r"^(\S+): (?:again )?on worker (\S+)$", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class _Case:
    """What is done to one of the workers.

    Attributes:
        does: in words.
        nanny: workers run under one.
        kills: the worker, and `nanny` too where that is killed with it.
        cut_s: seconds that it is without network instead.
        state: all workers keep state in a folder that both see.
        env: settings of Dask.
    """

    does: str
    nanny: bool = True
    kills_nanny: bool = False
    cut_s: float = 0.0
    state: bool = False
    env: dict[str, str] = field(default_factory=dict)


_TTL = {"DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "5s"}
_TCP = {"DASK_DISTRIBUTED__COMM__TIMEOUTS__TCP": "11s"}
CASES = {
    "alone": _Case("worker without a nanny killed", nanny=False),
    "nanny": _Case("worker killed, its nanny starts another"),
    "both": _Case("worker and its nanny killed", kills_nanny=True),
    "state": _Case("worker without a nanny killed, state in a shared folder", nanny=False, state=True),
    "cut": _Case("cut off for 5 s", cut_s=5),
    "long": _Case("cut off for 40 s", cut_s=40),
    "long-alone": _Case("cut off for 40 s, no nanny", nanny=False, cut_s=40),
    "healed": _Case("cut off for 15 s, comm.timeouts.tcp 11 s", cut_s=15, env=_TCP),
    "long-ttl": _Case("cut off for 40 s, worker-ttl 5 s", cut_s=40, env=_TTL),
    "long-tcp": _Case("cut off for 40 s, comm.timeouts.tcp 11 s", cut_s=40, env=_TCP),
}


def measure_workers(arguments: Namespace) -> dict[str, Any]:
    """Each case several times, and medians and maxima of that."""
    disturbance, rows = Disturbance(), []
    for name in arguments.cases or CASES:
        rounds = []
        for _ in range(arguments.rounds):
            try:
                rounds.append(_round(arguments, CASES[name]))
            except NotHereError as error:
                return {"skipped": str(error)}
        rows.append({"case": name, "does": CASES[name].does, **_summary(rounds), "rounds": rounds})
    return {"rows": rows, "steal": round(disturbance.steal_share() or 0.0, 3)}


def table(result: dict[str, Any]) -> str:
    """The rows for people, as Markdown."""
    if "rows" not in result:
        return f"skipped: {result['skipped']}"
    columns = [name for name in result["rows"][0] if name not in ("case", "rounds")]
    lines = [columns, ["---"] * len(columns)]
    lines += [[str(row[name]) for name in columns] for row in result["rows"]]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _summary(rounds: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians over the rounds, and the worst."""

    def of(name: str) -> list[Any]:
        return [one[name] for one in rounds if one[name] is not None]

    found: dict[str, Any] = {"spread": ", ".join(sorted({one["spread"] for one in rounds}))}
    for name in ("served_again_s", "behind_before_ms", "behind_after_ms"):
        values = of(name)
        found[name] = (
            f"{median(values):.2f} (max {max(values):.2f})" if len(values) == len(rounds) else "never"
        )
    for name in ("published", "missed", "lost", "dropped", "incomplete"):
        found[name] = round(median(of(name)))
    for name in ("unaccounted", "served_twice", "twice_s"):
        found[name] = max(of(name), key=abs)
    return found


class _Camera:
    """Publishes numbered packets, and waits for nobody."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self.key, self.sent = key, 0
        self._publisher = MessagePublisher(session, PlainNames(key), key, EventPacket.SCHEMA_NAME)

    def put(self, ready: EventPacket) -> None:
        stamp = (1_000_000 + self.sent * _SLICE_US) * 1000
        self._publisher.put(numbered(ready, self.sent, stamp))
        self.sent += 1

    def behind_s(self, stamp_ns: int) -> float:
        """How much stream time has been sent since a stamp."""
        return 1.0 + self.sent * _SLICE_US / 1e6 - stamp_ns / 1e9

    def close(self) -> None:
        self._publisher.close()


@contextmanager
def _playing(session: zenoh.Session, recording: Path) -> Iterator[tuple[list[_Camera], Callable[[], None]]]:
    """Cameras that play until the block ends, or until they are told to stop."""
    writer, ready = PacketWriter(), []
    for events in camera_packets(recording, 5, _SLICE_US):
        shifted = events.copy()
        shifted["t"] %= _SLICE_US
        ready += writer.messages(shifted[np.argsort(shifted["t"], kind="stable")], FRAME)
    cameras, over = [_Camera(session, key) for key in _KEYS], threading.Event()

    def play() -> None:
        started, n = time.perf_counter(), 0
        while not over.wait(max(0.0, started + n * _SLICE_US / 1e6 - time.perf_counter())):
            for i, camera in enumerate(cameras):
                camera.put(ready[(n + 7 * i) % len(ready)])
            n += 1

    thread = threading.Thread(target=play, daemon=True)
    thread.start()

    def stop() -> None:
        over.set()
        thread.join()

    try:
        yield cameras, stop
    finally:
        stop()
        for camera in cameras:
            camera.close()


@dataclass(frozen=True, slots=True)
class _Seen:
    at: float
    camera: int
    gid: bytes
    behind_s: float


class _Watch:
    """Notes which publisher's features of which camera arrive when."""

    def __init__(self, session: zenoh.Session, cameras: list[_Camera]) -> None:
        self.seen: list[_Seen] = []
        self._cameras = cameras
        self._subscriber = session.declare_subscriber("bench/*/features", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        now, attached = time.perf_counter(), Attachment.unpack(sample.attachment.to_bytes())
        stamp_ns = FeaturesMessage.from_cdr(sample.payload.to_bytes()).stamp_ns
        i = int(str(sample.key_expr).split("/")[1])
        self.seen.append(
            _Seen(now, i, attached.gid if attached else b"", self._cameras[i].behind_s(stamp_ns))
        )

    def since(self, at: float) -> list[_Seen]:
        return [one for one in list(self.seen) if one.at > at]

    def behind_ms(self, start: float, end: float) -> float | None:
        """Median of how old features were when they came."""
        found = [one.behind_s for one in list(self.seen) if start < one.at < end]
        return round(1e3 * median(found), 1) if found else None

    def twice(self) -> tuple[int, float]:
        """How many cameras two publishers had features of at once, and the longest time that was so, in s."""
        spans: dict[tuple[int, bytes], list[float]] = {}
        for one in list(self.seen):
            spans.setdefault((one.camera, one.gid), []).append(one.at)
        longest = Counter[int]()
        for (camera, gid), times in spans.items():
            for (other, other_gid), others in spans.items():
                if camera == other and gid != other_gid and times[0] <= others[0] < times[-1]:
                    both = min(times[-1], others[-1]) - others[0]
                    longest[camera] = max(longest[camera], both)  # type: ignore[assignment]
        return len(longest), round(max(longest.values(), default=0.0), 3)


class _Job:
    """`streamfeat listen --cluster` as a process."""

    def __init__(self, one: Any, folder: Path) -> None:
        self._one, self._folder = one, folder

    def said(self) -> str:
        return (self._folder / "listen.txt").read_text(encoding="utf-8")

    def workers(self) -> dict[str, str]:
        """The latest worker of each camera."""
        return dict(_BEGUN.findall(self.said()))

    def check(self) -> None:
        if self._one.poll() is not None:
            raise SystemExit(self.said())

    def finish(self) -> dict[str, Any]:
        self._one.send_signal(signal.SIGINT)
        self._one.wait(60)
        text = (self._folder / "result.json").read_text(encoding="utf-8")
        if not text:
            raise SystemExit(self.said())
        found: dict[str, Any] = json.loads(text)
        return found


def _round(arguments: Namespace, case: _Case) -> dict[str, Any]:
    """Start everything, break something, and see what comes of it."""
    with tempfile.TemporaryDirectory(prefix="streamfeat-bench-") as name, ExitStack() as stack:
        folder, meeting = Path(name), f"{HOST}:{arguments.port}"
        config = folder / "client.json5"
        config.write_text(_patient(zenoh_config("client", connect=[meeting])))
        scheduler = arguments.port + 5
        two = stack.enter_context(two_workers(folder, scheduler, nanny=case.nanny, env=case.env))
        stack.enter_context(_router(meeting))
        session = stack.enter_context(open_session(config))
        cameras, stop = stack.enter_context(_playing(session, arguments.recording))
        watch = _Watch(session, cameras)
        job = stack.enter_context(_listening(arguments, two, config, folder, case))
        if not _until(lambda: len({one.camera for one in watch.seen}) == len(_KEYS), job):
            raise SystemExit(f"no features come of some cameras; the listener says: {job.said()}")
        time.sleep(_STEADY_S)
        before, began = job.workers(), time.perf_counter()
        spread = Counter(before.values())
        victim = spread.most_common()[-1][0]
        mourned = {i for i, key in enumerate(_KEYS) if before[key] == victim}
        broken = _break(two, victim, case)
        again = _served_again(watch, job, mourned, broken, case)
        time.sleep(_STEADY_S if not case.nanny else 3 * _STEADY_S)
        end = time.perf_counter()
        stop()
        time.sleep(1.5)
        return {
            "spread": "/".join(map(str, sorted(spread.values(), reverse=True))),
            "served_again_s": max(again.values()) if len(again) == len(mourned) else None,
            "of_each": {_KEYS[i]: round(s, 3) for i, s in sorted(again.items())},
            "behind_before_ms": watch.behind_ms(began - _STEADY_S, began),
            "behind_after_ms": watch.behind_ms(end - _STEADY_S, end),
            "after": sorted(Counter(job.workers().values()).values(), reverse=True),
            **_twice(watch),
            **_account(job.finish(), cameras),
        }


def _break(two: Two, victim: str, case: _Case) -> float:
    """When what is done to the victim began."""
    broken = time.perf_counter()
    if not case.cut_s:
        two.kill(victim, nanny=case.kills_nanny)
        return broken
    two.link(victim, "down")
    threading.Timer(case.cut_s, two.link, (victim, "up")).start()
    return broken


def _served_again(
    watch: _Watch, job: _Job, mourned: set[int], broken: float, case: _Case
) -> dict[int, float]:
    """Seconds until each of these cameras has features again, and at least until a cut is over.

    What was under way when it broke does not count.
    """
    last = {one.camera: one.gid for one in list(watch.seen) if one.at <= broken}
    again: dict[int, float] = {}
    looked = broken + (0.0 if not case.cut_s else 0.3)

    def all_are() -> bool:
        for one in watch.since(looked):
            if one.camera in mourned and (case.cut_s or one.gid != last[one.camera]):
                again.setdefault(one.camera, one.at - broken)
        return again.keys() == mourned and time.perf_counter() > broken + case.cut_s

    _until(all_are, job)
    return again


def _twice(watch: _Watch) -> dict[str, Any]:
    cameras, longest = watch.twice()
    return {"served_twice": cameras, "twice_s": longest}


def _account(result: dict[str, Any], cameras: list[_Camera]) -> dict[str, Any]:
    """What was counted against what was published, all cameras together and each."""
    names = [*_COUNTED, "incomplete"]
    each = {}
    for camera in cameras:
        counts = result["of_each"][camera.key]
        each[camera.key] = {
            "published": camera.sent,
            **{name: counts[name] for name in names},
            "unaccounted": camera.sent - sum(counts[name] for name in _COUNTED),
            "starts": counts["starts"],
        }
    sums = {name: sum(one[name] for one in each.values()) for name in ("published", *names)}
    worst = max((one["unaccounted"] for one in each.values()), key=abs)
    return {**sums, "unaccounted": worst, "restarts": result["restarts"], "counts": each}


def _patient(config: str) -> str:
    """Queues as without a configuration: zenoh's own lose packets whenever this machine hesitates."""
    queue = {"size": {"data": 16}, "congestion_control": {"drop": {"wait_before_drop": 50_000}}}
    return json.dumps(json.loads(config) | {"transport": {"link": {"tx": {"queue": queue}}}})


@contextmanager
def _router(meeting: str) -> Iterator[None]:
    with process(sys.executable, "-c", ROUTER, _patient(zenoh_config("router", listen=[meeting]))) as router:
        assert router.stdout
        router.stdout.readline()
        yield


@contextmanager
def _listening(arguments: Namespace, two: Two, config: Path, folder: Path, case: _Case) -> Iterator[_Job]:
    words: list[object] = ["listen", "bench/*/events", "-m", arguments.model, "--emit", "50ms", "--json"]
    words += ["--cluster", two.address, "--zenoh-config", config]
    words += ["--state", folder / "state"] if case.state else []
    with (
        (folder / "result.json").open("w", encoding="utf-8") as file,
        logged(folder / "listen.txt", *PROGRAM, *words, stdout=file, env=case.env) as one,
    ):
        yield _Job(one, folder)


def _until(condition: Callable[[], bool], job: _Job) -> bool:
    """Wait for a state; False where it does not come about."""
    limit = time.monotonic() + _PATIENCE_S
    while not (there := condition()) and time.monotonic() < limit:
        job.check()
        time.sleep(0.02)
    return there
