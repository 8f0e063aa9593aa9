"""What another user, another clock, a suspended machine, a slow core and a bad network do to real commands.

Lives here: such trials, each with commands in processes of their own. Not here: packets and cameras that are
bad themselves (`hours`, `crowd`), and signals (`interrupts`).

What a trial needs and this machine lacks (root, libfaketime, uvloop) is said, and its row left out.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from streamfeat.recordings.reader import open_recording
from torture.nursery import free_port
from torture.sources import MODEL, ROOT, TRAIN
from torture.table import Row, Trials

__all__ = ["surroundings"]

_FAKETIME = sorted(Path("/usr/lib").glob("*/faketime/libfaketime.so.1"))
_STARTS_S = 8.0
_NOBODY = 65534
_SYSTEM_PYTHON = Path(f"/usr/bin/python3.{sys.version_info.minor}")
_PATH = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
_ENV = {**os.environ, "PYTHONPATH": _PATH, "OPENBLAS_NUM_THREADS": "1", "NO_COLOR": "1"}


def surroundings(trials: Trials) -> list[Row]:
    """A row for each trial that can be made here."""
    can_be_another = os.geteuid() == 0 and bool(shutil.which("setpriv")) and _SYSTEM_PYTHON.exists()
    tried = [
        (
            "installed by root, run by another user without a home: seven commands",
            _other_user,
            can_be_another,
        ),
        ("the clock is set back and forth, by 40 years at most: listen, record, --state", _clocks, _FAKETIME),
        ("suspended for an hour: listen and replay", _suspended, _FAKETIME),
        ("a process at 1 % of a core", _slow, True),
        ("access control with wildcard keys", _access, True),
        ("a router that is killed twice inside a burst", _router, True),
        ("the same with --reliable", _reliable_router, True),
        ("sf.replay and sf.listen under uvloop", _uvloop, find_spec("uvloop")),
    ]
    rows = []
    for name, trial, possible in tried:
        if possible:
            rows.append(_row(trials, name, trial))
        else:
            trials.say(f"{name}: not possible here")
    return rows


def _row(trials: Trials, name: str, trial: Callable[[Path], int | None]) -> Row:
    began, lost, failures = time.monotonic(), None, []
    n = trials.times(3, least=1)
    for i in range(n):
        folder = trials.folder / f"trial{i}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        try:
            found = trial(folder)
            lost = lost if found is None else (lost or 0) + found
        except AssertionError as error:
            failures.append(f"trial {i}: {error}")
    trials.say(f"{name}: {n}, {len(failures)} failed")
    took = time.monotonic() - began
    return Row(name, n, n - len(failures), lost, seconds=took, failures=tuple(failures))


class _Command:
    """A command that runs until it is told to end."""

    def __init__(self, folder: Path, *words: object, **environment: str) -> None:
        self._name = words[0]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "streamfeat", *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=_ENV | environment,
        )

    def send(self, number: int) -> None:
        self._process.send_signal(number)

    def end(self, *statuses: int) -> dict[str, Any]:
        """Its result, after an interrupt."""
        self.send(signal.SIGINT)
        try:
            out, err = self._process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
            raise AssertionError("it did not end within a minute") from None
        assert "Traceback" not in err, err[-500:]
        assert self._process.returncode in (statuses or (0,)), (
            f"status {self._process.returncode}: {err[-500:]}"
        )
        return dict(json.loads(out)) if out else {}


def _sum_up(sent: dict[str, Any], heard: dict[str, Any]) -> int:
    """Events that are missing, if what came and what was counted as lost is all that was sent."""
    counted = sum(heard.get(name, 0) for name in ("packets", "lost", "dropped", "duplicates"))
    # What was lost behind the last packet that came, and before the first, is known to nobody.
    assert counted <= sent["packets"] + heard.get("duplicates", 0), f"sent {sent}, heard {heard}"
    return int(sent["events"] - heard["events"] - heard.get("late", 0))


# --- another user


def _other_user(folder: Path) -> None:
    installed, work, own = folder / "installed", folder / "work", folder / "own.safetensors"
    shutil.copytree(
        ROOT / "streamfeat", installed / "streamfeat", ignore=shutil.ignore_patterns("__pycache__")
    )
    shutil.copy(TRAIN, installed / "rec.mcap")
    shutil.copy(MODEL, installed / "model")
    shutil.copy(MODEL, own)
    work.mkdir()
    work.chmod(0o777)
    (folder / "closed").mkdir(mode=0o700)
    own.chmod(0o600)
    for path in (folder.parent, folder, installed):
        path.chmod(0o755)
    packages = next(path for path in sys.path if path.endswith("site-packages"))
    path = os.pathsep.join((str(installed), packages))
    rec, model = installed / "rec.mcap", installed / "model"
    for words, status in (
        (["--version"], 0),
        (["doctor"], 0),
        (["info", rec], 0),
        (["replay", rec, "-m", model, "-o", "out.mcap", "-q"], 0),
        (["replay", rec, "-m", model, "-o", folder / "closed/out.mcap", "-q"], 2),
        (["record", "a/*", "-o", folder / "closed/out.mcap"], 2),
        (["replay", rec, "-m", own], 2),
    ):
        done = subprocess.run(
            [
                *("setpriv", f"--reuid={_NOBODY}", f"--regid={_NOBODY}", "--clear-groups"),
                *("env", "-i", "HOME=/nonexistent", "LANG=C", f"PYTHONPATH={path}", f"TMPDIR={work}"),
                *(str(_SYSTEM_PYTHON), "-m", "streamfeat", *map(str, words)),
            ],
            capture_output=True,
            text=True,
            cwd=work,
            timeout=400,
        )
        assert done.returncode == status, f"{words}: status {done.returncode}, {done.stderr[-500:]}"
        assert "Traceback" not in done.stderr, done.stderr[-500:]
        assert not status or done.stderr.count("\n") == 1, done.stderr
    assert (work / "out.mcap").stat().st_uid == _NOBODY


# --- clocks


@contextmanager
def _clock(folder: Path, *, monotonic: bool) -> Iterator[tuple[dict[str, str], Callable[[str], int]]]:
    """The environment of commands whose clock is what a function sets, such as `-2h`."""
    stamp = folder / "clock"
    stamp.write_text("+0")
    environment = {
        "LD_PRELOAD": str(_FAKETIME[0]),
        "FAKETIME_TIMESTAMP_FILE": str(stamp),
        "FAKETIME_NO_CACHE": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "0" if monotonic else "1",
    }
    yield environment, stamp.write_text


def _clocks(folder: Path) -> int:
    port = free_port()
    listen = [
        "listen",
        "cam/*",
        "-m",
        MODEL,
        "--port",
        port,
        "--state",
        "st",
        "--json",
        "-q",
        "--max-delay",
        60,
    ]
    with _clock(folder, monotonic=False) as (environment, set_clock):
        listener = _Command(folder, *listen, "-o", "l.mcap", **environment)
        time.sleep(_STARTS_S)
        recorder = _Command(
            folder, "record", "cam/*", "-o", "r.mcap", "--port", port, "--json", "-q", **environment
        )
        time.sleep(_STARTS_S / 2)
        camera = _Command(folder, "publish", TRAIN, "cam/a", "--port", port, "--json", **environment)
        for moved in ("+0", "-2h", "+1d", "-10y", "+0", "+40y", "+0"):
            time.sleep(1.5)
            set_clock(moved)
        sent = camera.end()
        time.sleep(1)
        recorded, heard = recorder.end(), listener.end()
    lost = _sum_up(sent, heard)
    assert recorded["messages"] > 0.8 * sent["packets"], f"sent {sent}, recorded {recorded}"
    with open_recording(folder / "r.mcap") as recording:
        assert recording.n_events > 0.8 * sent["events"], f"{recording.n_events} events of {sent}"
    again = _Command(folder, *listen)
    time.sleep(_STARTS_S)
    kept = again.end()
    assert kept["packets"] == heard["packets"], f"the state is another: {kept}, not {heard}"
    return lost


def _suspended(folder: Path) -> int:
    port = free_port()
    with _clock(folder, monotonic=True) as (environment, set_clock):
        words = ["-m", MODEL, "--json", "-q"]
        listener = _Command(
            folder, "listen", "cam/*", *words, "--port", port, "--state", "st", "-o", "l.mcap", **environment
        )
        player = _Command(folder, "replay", TRAIN, *words, "--speed", 1, "-o", "p.mcap", **environment)
        time.sleep(_STARTS_S)
        camera = _Command(folder, "publish", TRAIN, "cam/a", "--port", port, "--json")
        time.sleep(4)
        for command in (listener, player):
            command.send(signal.SIGSTOP)
        time.sleep(2)
        set_clock("+1h")
        for command in (listener, player):
            command.send(signal.SIGCONT)
        time.sleep(4)
        sent, heard, played = camera.end(), listener.end(), player.end(130, 0)
    assert played["events"], "nothing was replayed"
    assert (folder / "l.mcap").exists(), "what was heard was not written"
    return _sum_up(sent, heard)


# --- a slow core


def _slow(folder: Path) -> int:
    port = free_port()
    listener = _Command(
        folder, "listen", "cam/*", "-m", MODEL, "--port", port, "-o", "l.mcap", "--json", "-q"
    )
    time.sleep(_STARTS_S)
    camera, over = _Command(folder, "publish", TRAIN, "cam/a", "--port", port, "--json"), threading.Event()

    def hold_back() -> None:
        while not over.wait(0.002):
            listener.send(signal.SIGSTOP)
            time.sleep(0.198)
            listener.send(signal.SIGCONT)

    holding = threading.Thread(target=hold_back)
    holding.start()
    try:
        time.sleep(10)
        sent = camera.end()
    finally:
        over.set()
        holding.join()
    return _sum_up(sent, listener.end())


# --- the network


def _configured(folder: Path, name: str, **about: Any) -> Path:
    path = folder / f"{name}.json5"
    path.write_text(json.dumps({"scouting": {"multicast": {"enabled": False}}, **about}))
    return path


def _client(folder: Path, port: int) -> Path:
    meeting = {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": -1, "exit_on_failure": False}
    return _configured(folder, "client", mode="client", connect=meeting)


def _access(folder: Path) -> int:
    port = free_port()
    messages = ["put", "declare_subscriber", "liveliness_token", "declare_liveliness_subscriber"]
    messages += ["liveliness_query", "query", "reply", "declare_queryable", "delete"]
    rule = {"id": "a", "permission": "allow", "flows": ["ingress", "egress"], "messages": messages}
    server = _configured(
        folder,
        "server",
        mode="peer",
        listen={"endpoints": [f"tcp/127.0.0.1:{port}"]},
        access_control={
            "enabled": True,
            "default_permission": "deny",
            "rules": [{**rule, "key_exprs": ["robot/**", "streamfeat/robot/**"]}],
            "subjects": [{"id": "all"}],
            "policies": [{"rules": ["a"], "subjects": ["all"]}],
        },
    )
    listener = _Command(
        folder, "listen", "robot/*/events", "-m", MODEL, "--zenoh-config", server, "--json", "-q"
    )
    time.sleep(_STARTS_S)
    client = _client(folder, port)
    keys = "robot/a/events", "other/a/events"
    cameras = [_Command(folder, "publish", TRAIN, key, "--zenoh-config", client, "--json") for key in keys]
    time.sleep(_STARTS_S)
    sent, denied = (camera.end() for camera in cameras)
    time.sleep(0.5)
    heard = listener.end()
    assert denied["packets"] > 0, "nothing was sent that could be denied"
    assert heard["cameras"] == 1, f"heard {heard}"
    return _sum_up(sent, heard)


def _router(folder: Path, *options: str) -> int:
    port = free_port()
    meeting = {"endpoints": [f"tcp/127.0.0.1:{port}"]}
    about = _configured(folder, "router", mode="router", listen=meeting)
    code = f"import time, zenoh; s = zenoh.open(zenoh.Config.from_file({str(about)!r})); time.sleep(1e6)"
    routers = [subprocess.Popen([sys.executable, "-c", code])]
    try:
        client = _client(folder, port)
        both = ["--zenoh-config", client, "--json", *options]
        listener = _Command(folder, "listen", "cam/a", "-m", MODEL, "-q", *both)
        time.sleep(_STARTS_S)
        camera = _Command(folder, "publish", TRAIN, "cam/a", "--speed", 5, *both)
        time.sleep(_STARTS_S / 2)
        for _ in range(2):
            routers[-1].kill()
            time.sleep(1)
            routers.append(subprocess.Popen([sys.executable, "-c", code]))
            time.sleep(4)
        sent = camera.end()
        time.sleep(1)
        heard = listener.end()
    finally:
        for router in routers:
            router.kill()
            router.wait()
    assert heard["packets"] > 0.3 * sent["packets"], f"sent {sent}, heard {heard}"
    return _sum_up(sent, heard)


def _reliable_router(folder: Path) -> int:
    return _router(folder, "--reliable")


_UNDER_UVLOOP = """
import asyncio, sys, uvloop
import streamfeat as sf
recording, model, port = sys.argv[1], sys.argv[2], int(sys.argv[3])
async def main():
    seen = 0
    async for emission in sf.replay(recording, model, emit="1000ev", speed=None):
        seen += 1
        if seen == 300:
            break
    async with sf.listen("none/*", model, port=port):
        await asyncio.sleep(0.2)
    return seen, sum([1 async for _ in sf.replay(recording, model, emit="bin", speed=None)])
print(uvloop.run(main()) == asyncio.run(main()) == (300, 750))
"""


def _uvloop(folder: Path) -> None:
    words = [sys.executable, "-W", "error", "-c", _UNDER_UVLOOP, str(TRAIN), str(MODEL), str(free_port())]
    done = subprocess.run(words, capture_output=True, text=True, env=_ENV, timeout=400)
    assert (done.returncode, done.stdout, done.stderr) == (0, "True\n", ""), done.stderr[-500:] or done.stdout
