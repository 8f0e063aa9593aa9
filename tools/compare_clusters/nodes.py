"""Two nodes of an engine, the second in a network namespace of its own.

Lives here: how they are started, killed, cut off, and which ports they used between them.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

SPACE, OUTSIDE, INSIDE = "sfclust", "sfc0", "sfc1"
HERE, THERE = "10.213.78.1", "10.213.78.2"
PORT = 6399
"""Below 10002: from there to 19999 Ray wants every port for its workers."""
_SETUP = (
    f"ip netns add {SPACE}",
    f"ip link add {OUTSIDE} type veth peer name {INSIDE} netns {SPACE}",
    f"ip addr add {HERE}/24 dev {OUTSIDE}",
    f"ip link set {OUTSIDE} up",
    f"ip -n {SPACE} addr add {THERE}/24 dev {INSIDE}",
    f"ip -n {SPACE} link set {INSIDE} up",
    f"ip -n {SPACE} link set lo up",
)
_RAY = ["--num-cpus=2", "--object-store-memory=200000000", "--disable-usage-stats", "--block"]


class NotHereError(Exception):
    """This machine cannot do it, for the reason given."""


class Two:
    """A scheduler or head with a worker here, a worker in the namespace."""

    def __init__(self, address: str) -> None:
        self.address = address

    def pids(self) -> list[int]:
        """The processes in the namespace."""
        found = subprocess.run(["ip", "netns", "pids", SPACE], capture_output=True, text=True, timeout=20)
        return [int(pid) for pid in found.stdout.split()]

    def kill(self) -> None:
        _kill(self.pids())

    def link(self, state: str) -> None:
        subprocess.run(["ip", "-n", SPACE, "link", "set", INSIDE, state], check=True, timeout=20)


@contextlib.contextmanager
def two(engine: str, folder: Path, threads: int = 1) -> Iterator[Two]:
    """Start both and end them.

    Args:
        engine: `ray` or `dask`.
        folder: where they may write.
        threads: of a Dask worker: as many functions that run for ever fit in.

    Raises:
        NotHereError: there can be no namespace here.
    """
    with contextlib.ExitStack() as stack:
        stack.callback(_run, f"ip netns del {SPACE}")
        for command in _SETUP:
            if problem := _run(command):
                raise NotHereError(f"{command}: {problem}")
        address = f"{HERE}:{PORT}" if engine == "ray" else f"tcp://{HERE}:{PORT}"
        inside = ["ip", "netns", "exec", SPACE]
        both = Two(address)
        stack.callback(both.kill)
        for number, command in enumerate(_commands(engine, address, threads)):
            prefix = inside if number == len(_commands(engine, address, threads)) - 1 else []
            log = stack.enter_context((folder / f"{engine}{number}.txt").open("wb"))
            process = subprocess.Popen(
                [*prefix, sys.executable, "-m", *command], stdout=log, stderr=log, start_new_session=True
            )
            stack.callback(_end, process)
            _until_listening(PORT, Path(log.name), process)
        yield both


def _commands(engine: str, address: str, threads: int) -> list[list[str]]:
    if engine == "ray":
        ray = ["ray.scripts.scripts", "start", *_RAY]
        return [
            [*ray, "--head", f"--port={PORT}", f"--node-ip-address={HERE}", "--include-dashboard=false"],
            [*ray, f"--address={address}", f"--node-ip-address={THERE}"],
        ]
    worker = ["distributed.cli.dask_worker", address, f"--nthreads={threads}", "--memory-limit=0"]
    scheduler = ["distributed.cli.dask_scheduler", f"--host={HERE}", f"--port={PORT}", "--no-dashboard"]
    return [
        scheduler,
        [*worker, f"--host={HERE}", "--no-dashboard"],
        [*worker, f"--host={THERE}", "--no-dashboard"],
    ]


def _run(command: str) -> str:
    done = subprocess.run(command.split(), capture_output=True, text=True, timeout=20)
    return done.stderr.strip() or "failed" if done.returncode else ""


def _until_listening(port: int, log: Path, process: subprocess.Popen[bytes]) -> None:
    limit = time.monotonic() + 90
    while time.monotonic() < limit and process.poll() is None:
        found = subprocess.run(["ss", "-ltnH", f"sport = {port}"], capture_output=True, timeout=20)
        if found.stdout:
            return
        time.sleep(0.1)
    said = [line for line in log.read_text(errors="replace").splitlines() if line.strip()][-1:]
    raise NotHereError(f"the first node did not come up: exit status {process.poll()}, {said}")


def connections() -> list[str]:
    """Between the two nodes, which listening ports have been connected to."""
    listening = {}
    for space, prefix in ((HERE, []), (THERE, ["ip", "netns", "exec", SPACE])):
        ss = subprocess.run([*prefix, "ss", "-ltnH"], capture_output=True, text=True, timeout=20)
        listening[space] = {line.split()[3].rpartition(":")[2] for line in ss.stdout.splitlines()}
    ss = subprocess.run(["ss", "-tnH"], capture_output=True, text=True, timeout=20)
    found = set()
    for line in ss.stdout.splitlines():
        ends = [end.replace("[::ffff:", "").replace("]", "").rpartition(":") for end in line.split()[3:5]]
        if {host for host, _, _ in ends} == {HERE, THERE}:
            (_, _, mine), (_, _, theirs) = ends
            found.add(f"here:{mine}" if mine in listening[HERE] else f"there:{theirs}")
    return sorted(found)


def family(pid: int) -> list[int]:
    """A process and all that come from it."""
    found = [pid]
    for one in found:
        for task in Path(f"/proc/{one}/task").glob("*/children"):
            with contextlib.suppress(OSError):
                found += [int(child) for child in task.read_text().split()]
    return found


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill all that a node is made of: asked to end, Ray waits half a minute for what serves for ever."""
    _kill(family(process.pid))
    process.wait(20)


def _kill(pids: list[int]) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
