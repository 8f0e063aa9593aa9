"""A Dask cluster whose workers each have a network namespace of their own.

Lives here: how the namespaces and the processes in them are made, killed and cut off.
Not here: what the workers do meanwhile (`workers`).

One bridge on the host is the network; the scheduler and a zenoh router are at its address.
"""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import IO

from distributed import Client

HOST = "10.213.79.1"
_BRIDGE, _INSIDE = "sfwbr", "eth0"
_SPACES = ("sfw0", "sfw1")
_PATIENCE_S = 90.0


class NotHereError(Exception):
    """This machine cannot do it, for the reason given."""


class Two:
    """A scheduler on the host and two workers, each in a namespace.

    Attributes:
        address: of the scheduler.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self._client = Client(address, timeout=_PATIENCE_S, set_as_default=False)
        self._client.wait_for_workers(len(_SPACES), timeout=_PATIENCE_S)
        self._pids: dict[str, int] = self._client.run(os.getpid)
        self._client.close()

    def kill(self, worker: str, *, nanny: bool = False) -> None:
        """kill -9 of the process that serves at an address, or of its nanny and then of that."""
        if nanny:
            for pid in set(_inside(_space_of(worker))) - {self._pids[worker]}:
                _kill(pid)
        _kill(self._pids[worker])

    @staticmethod
    def link(worker: str, state: str) -> None:
        """Set the link of a worker's namespace `up` or `down`."""
        command = ["ip", "-n", _space_of(worker), "link", "set", _INSIDE, state]
        subprocess.run(command, check=True, timeout=20)


@contextlib.contextmanager
def two_workers(
    folder: Path, port: int, *, nanny: bool = True, env: dict[str, str] | None = None
) -> Iterator[Two]:
    """Start them and end them.

    Args:
        folder: for their logs and what they put on disk.
        port: of the scheduler.
        nanny: workers run under one, as they do if nobody asks for anything else.
        env: settings of Dask for all of them.

    Raises:
        NotHereError: there can be no namespaces here.
    """
    address = f"tcp://{HOST}:{port}"
    own = [] if nanny else ["--no-nanny"]
    with contextlib.ExitStack() as stack:
        _make_network(stack)
        scheduler = ["scheduler", "--host", HOST, "--port", port, "--no-dashboard"]
        stack.enter_context(logged(folder / "scheduler.txt", *_dask(scheduler), env=env))
        for i, space in enumerate(_SPACES):
            place = ["--host", _address(i), "--local-directory", folder / space, "--no-dashboard"]
            words = ["ip", "netns", "exec", space, *_dask(["worker", address, *place, *own])]
            stack.enter_context(logged(folder / f"{space}.txt", *words, env=env))
        yield Two(address)


@contextlib.contextmanager
def logged(
    log: Path, *words: object, env: dict[str, str] | None = None, stdout: IO[str] | None = None
) -> Iterator[subprocess.Popen[str]]:
    """A process that says what it says into a file, whoever reads that."""
    with log.open("w", encoding="utf-8") as file:
        one = subprocess.Popen(
            list(map(str, words)),
            stdout=stdout or file,
            stderr=file,
            text=True,
            env=os.environ | (env or {}),
        )
        try:
            yield one
        finally:
            one.kill()
            one.wait()


def _make_network(stack: contextlib.ExitStack) -> None:
    """What is made is taken down with the stack, the latest first; what others have made is left alone."""

    def make(command: str, undo: Callable[[], object] | None = None) -> None:
        if problem := _run(command):
            raise NotHereError(f"{command}: {problem}")
        if undo:
            stack.callback(undo)

    make(f"ip link add {_BRIDGE} type bridge", lambda: _run(f"ip link del {_BRIDGE}"))
    make(f"ip addr add {HOST}/24 dev {_BRIDGE}")
    make(f"ip link set {_BRIDGE} up")
    for i, space in enumerate(_SPACES):
        make(f"ip netns add {space}", partial(_end_space, space))
        make(f"ip link add {space} type veth peer name {_INSIDE} netns {space}")
        make(f"ip link set {space} master {_BRIDGE} up")
        make(f"ip -n {space} addr add {_address(i)}/24 dev {_INSIDE}")
        make(f"ip -n {space} link set {_INSIDE} up")
        make(f"ip -n {space} link set lo up")


def _end_space(space: str) -> None:
    for pid in _inside(space):
        _kill(pid)
    _run(f"ip link del {space}")  # with the namespace it would go too, but some time later
    _run(f"ip netns del {space}")


def _address(i: int) -> str:
    return f"10.213.79.{2 + i}"


def _space_of(worker: str) -> str:
    """The namespace of a worker's address, such as `tcp://10.213.79.2:40123`."""
    host = worker.removeprefix("tcp://").rpartition(":")[0]
    return _SPACES[int(host.rpartition(".")[2]) - 2]


def _inside(space: str) -> list[int]:
    """The processes in a namespace."""
    found = subprocess.run(["ip", "netns", "pids", space], capture_output=True, text=True, timeout=20)
    return [int(pid) for pid in found.stdout.split()]


def _dask(words: Sequence[object]) -> list[object]:
    return [sys.executable, "-m", "dask", *words]


def _run(command: str) -> str:
    try:
        done = subprocess.run(command.split(), capture_output=True, text=True, timeout=20)
    except OSError as error:
        return str(error)
    return done.stderr.strip() or "failed" if done.returncode else ""


def _kill(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
