"""What others on this machine, or a file of theirs, can try: pages, silent clients, claims, names.

Lives here: such trials by the hundred, and what must hold for each.
Not here: bytes of decoders (`fuzz`), cameras without end (`crowd`), hours of it (`hours`).
"""

import io
import os
import socket
import string
import struct
import threading
import time
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import zstandard

from streamfeat.cli.consoles import SafeConsole
from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.files.budget import FLOOR_BYTES
from streamfeat.files.outputs import OutputFile
from streamfeat.recordings.reader import open_recording
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.view.gate import FOXGLOVE_ORIGINS, Gate, GuardedPort
from streamfeat.view.server import PageServer
from torture.table import Row, Trials

__all__ = ["outside"]

_MAGIC = b"\x89MCAP0\r\n"
_EVENTS = 100
_BAD = [chr(c) for c in (*range(32), *range(127, 160), 0x202E, 0x2066, 0x2028, 0xFEFF, 0xD800)]


def outside(trials: Trials) -> list[Row]:
    """One row for each kind."""
    try:
        return [
            _tried(trials, "a file that unpacks to gigabytes: refused in time and memory", 100, _claims),
            _tried(
                trials, "a request with another Host, Origin or token, page and Foxglove", 2_000, _requests
            ),
            _tried(trials, "64 clients that connect and say nothing: the next is answered", 20, _silent),
            _tried(trials, "names with escapes, marks and newlines: printed as text", 20_000, _names),
            _tried(trials, "a second writer of one output: refused, and the first ends well", 500, _writers),
        ]
    finally:
        while _ports:
            _ports.pop().close()


Trial = Callable[[np.random.Generator, Path], int]
"""Does it once; gives the events lost and counted. AssertionError: it did not survive."""


def _tried(trials: Trials, what: str, times: int, trial: Trial) -> Row:
    rng, began = np.random.default_rng(trials.seed), time.monotonic()
    n, lost, failures = trials.times(times), 0, []
    for i in range(n):
        try:
            lost += trial(rng, trials.folder)
        except AssertionError as error:
            failures.append(f"trial {i}: {error}")
    trials.say(f"{what}: {n}")
    return Row(what, n, n - len(failures), lost, seconds=time.monotonic() - began, failures=tuple(failures))


def _claims(rng: np.random.Generator, folder: Path) -> int:
    """A schema or empty records in a chunk that claims far more than the file has, and good events."""
    good = folder / "good.mcap"
    if not good.exists():
        with RecordingWriter(good) as writer:
            n = np.arange(_EVENTS)
            writer.write_events(make_events(n % 16, n % 12, n % 2, 1000 + n), (12, 16))
    size = int(rng.integers(FLOOR_BYTES, 3 * FLOOR_BYTES))
    kind = int(rng.integers(3))
    if kind == 0:
        head = struct.pack("<H", 900) + _text("a/msg/B") + _text("ros2msg") + struct.pack("<I", size)
        inner = _record(3, head + bytes(size))
    else:
        inner = (_record(0x90, b"") if kind == 1 else _record(3, b"")) * (size // 9)
    packed = zstandard.ZstdCompressor(level=1).compress(inner)
    chunk = (
        struct.pack("<QQQI", 0, 1, len(inner), 0) + _text("zstd") + struct.pack("<Q", len(packed)) + packed
    )
    del inner
    path = folder / "claims.mcap"
    header = _record(1, _text("ros2") + _text("x"))
    path.write_bytes(_MAGIC + header + _record(6, chunk) + good.read_bytes()[len(_MAGIC) :])
    started = time.process_time()
    tracemalloc.start()
    try:
        with open_recording(path) as recording:
            assert recording.n_events == _EVENTS, f"{recording.n_events} events"
            assert sum(recording.losses.counts.values()), "nothing is counted as lost"
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    took = time.process_time() - started
    assert most < 2 * FLOOR_BYTES, f"{most} bytes"
    assert took < 2, f"{took} s"
    return 0


def _record(opcode: int, body: bytes) -> bytes:
    return bytes([opcode]) + struct.pack("<Q", len(body)) + body


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


class _Ports:
    """A page and a guarded port, opened once."""

    def __init__(self) -> None:
        self.page = PageServer(lambda port, token: "<html>", 0)
        self.guarded = GuardedPort(Gate(FOXGLOVE_ORIGINS), 0, "127.0.0.1:9")

    def close(self) -> None:
        self.page.close()
        self.guarded.close()


_ports: list[_Ports] = []


def _opened() -> _Ports:
    if not _ports:
        _ports.append(_Ports())
    return _ports[0]


def _requests(rng: np.random.Generator, folder: Path) -> int:
    ports = _opened()
    server = (ports.page, ports.guarded)[int(rng.integers(2))]
    token = server.address.rpartition("token=")[2]
    wrong = int(rng.integers(3))
    hosts = ["evil.example", f"evil.example:{server.port}", "127.0.0.1", f"127.0.0.1:{server.port + 1}", ""]
    origins = ["http://evil.example", "null", f"http://127.0.0.1:{server.port + 1}", "https://127.0.0.1"]
    tokens = ["", token[:-1], token + "a", token.swapcase(), "%00", "a" * 2000]
    host = str(rng.choice(hosts)) if wrong == 0 else f"127.0.0.1:{server.port}"
    origin = str(rng.choice(origins)) if wrong == 1 else None
    given = str(rng.choice(tokens)) if wrong == 2 else token
    path = str(rng.choice(["/", "/stream"])) if server is ports.page else "/"
    lines = [
        f"GET {path}?token={given} HTTP/1.1",
        f"Host: {host}",
        *([f"Origin: {origin}"] if origin else []),
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Protocol: foxglove.sdk.v1",
    ]
    answer = _answer(server.port, "\r\n".join([*lines, "", ""]).encode())
    assert answer.startswith((b"HTTP/1.1 403", b"HTTP/1.1 400")), f"{lines[:3]}: {answer[:60]!r}"
    return 0


def _answer(port: int, data: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", port), timeout=20) as one:
        one.sendall(data)
        return one.recv(200)


def _silent(rng: np.random.Generator, folder: Path) -> int:
    server = _opened().page
    silent = [socket.create_connection(("127.0.0.1", server.port), timeout=20) for _ in range(64)]
    try:
        for one in silent[::2]:
            one.sendall(b"GET / HTTP/1.1\r\nHost: ")
        request = f"GET /?token={server.address.rpartition('token=')[2]} HTTP/1.1\r\n"
        lines = f"Host: 127.0.0.1:{server.port}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        keys = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        answer = _answer(server.port, (request + lines + keys).encode())
        assert answer.startswith(b"HTTP/1.1 200"), f"{answer[:60]!r}"
    finally:
        for one in silent:
            one.close()
    return 0


def _names(rng: np.random.Generator, folder: Path) -> int:
    letters = [*string.ascii_letters[:8], "[", "]", "/", "[red]", *rng.choice(_BAD, 6)]
    name = "".join(str(one) for one in rng.choice(letters, 20))
    said = io.StringIO()
    console = SafeConsole(file=said, force_terminal=True, color_system=None, width=1000)
    console.print(name, markup=False, highlight=False)
    shown = said.getvalue().replace("\n", "")
    assert shown.isprintable(), ascii(shown)
    return 0


def _writers(rng: np.random.Generator, folder: Path) -> int:
    path = folder / "out"
    refused: list[str] = []

    def second() -> None:
        try:
            OutputFile(path).close()
        except InputError as error:
            refused.append(str(error))

    with OutputFile(path) as first:
        thread = threading.Thread(target=second)
        first.file.write(b"a" * int(rng.integers(10_000)))
        thread.start()
        thread.join()
        first.file.write(b"end")
    assert refused, "two writers of one output"
    assert path.read_bytes().endswith(b"end"), "the first did not end well"
    with suppress(FileNotFoundError):
        os.unlink(path)  # noqa: PTH108
    return 0
