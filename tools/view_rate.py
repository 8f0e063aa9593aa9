"""Pictures a second of `streamfeat view`, and its share of a processor, with features and without.

Lives here: running the command, being its browser, counting. Not here: what is shown (`streamfeat.view`).

    python tools/view_rate.py REC
    python tools/view_rate.py REC -m model.safetensors --seconds 20 --chromium

The recording is looped at its own pace. Cases take turns, each in a process of its own; the median of each is
printed as JSON: pictures that came in a second, the longest wait for one, features that came in a second, and
the share of one processor that the command took (not the browser). `--chromium` draws in a real one, and
counts what it drew. Linux only: the processor's time is read from /proc.
"""

import argparse
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "tests"))

from browser import Browser  # noqa: E402

_PATIENCE_S = 180.0
_WARM_S = 2.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("-m", "--model", type=Path, help="for the case with features; else the general one")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each turn (default: %(default)s)")
    parser.add_argument("--turns", type=int, default=3, help="of each case (default: %(default)s)")
    parser.add_argument("--rate", type=float, default=20.0, help="asked for (default: %(default)s)")
    parser.add_argument("--chromium", action="store_true", help="draw in a headless Chromium")
    given = parser.parse_args()
    features = ["-m", str(given.model)] if given.model else ["--features"]
    cases = {"events alone": [], "with features": features}
    found: dict[str, list[dict[str, float]]] = {name: [] for name in cases}
    look = _drawn if given.chromium else _received
    for _ in range(given.turns):
        for name, options in cases.items():
            command = [str(given.recording), *options, "--rate", str(given.rate)]
            with _viewing(command) as (process, address):
                found[name].append(look(process, address, given.seconds))
    medians = {
        name: {key: round(float(np.median([turn[key] for turn in turns])), 2) for key in turns[0]}
        for name, turns in found.items()
    }
    print(json.dumps({"cores": os.cpu_count(), "load": round(os.getloadavg()[0], 1), **medians}, indent=1))


@contextlib.contextmanager
def _viewing(arguments: list[str]) -> "Iterator[tuple[int, str]]":
    """The command at work: its process, and the address of its page."""
    command = [
        sys.executable,
        "-m",
        "streamfeat",
        "view",
        *arguments,
        "--loop",
        "--web-port",
        "0",
        "--no-open",
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, env=environment
    )
    assert process.stderr
    said: list[str] = []
    try:
        for line in process.stderr:
            said.append(line)
            if line.startswith("page: "):
                break
        else:
            raise SystemExit("".join(said))
        # What else it says is not to fill the pipe.
        threading.Thread(target=process.stderr.read, daemon=True).start()
        yield process.pid, said[-1].partition(": ")[2].strip()
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(_PATIENCE_S)


def _received(process: int, address: str, seconds: float) -> dict[str, float]:
    """What a browser gets that draws nothing."""
    from websockets.sync.client import connect

    stream = re.sub(r"^http(.*)/\?", r"ws\1/stream?", address)
    with connect(stream, open_timeout=_PATIENCE_S, max_size=None) as socket:
        times: dict[str, list[float]] = {"events": [], "features": []}
        while not times["events"]:
            _note(socket.recv(_PATIENCE_S), times)
        _until(socket, time.monotonic() + _WARM_S, times)
        times = {"events": [], "features": []}
        before, started = _processor_s(process), time.monotonic()
        _until(socket, started + seconds, times)
        passed = time.monotonic() - started
        return _summary(times, passed, _processor_s(process) - before)


def _until(socket: Any, end: float, times: dict[str, list[float]]) -> None:
    while (left := end - time.monotonic()) > 0:
        with contextlib.suppress(TimeoutError):
            _note(socket.recv(left), times)


def _note(message: str | bytes, times: dict[str, list[float]]) -> None:
    if isinstance(message, bytes):
        header = json.loads(message[2 : 2 + int.from_bytes(message[:2], "little")])
        channel = header["channel"]
    else:
        channel = json.loads(message)["channel"]
    if channel in times:
        times[channel].append(time.monotonic())


def _drawn(process: int, address: str, seconds: float) -> dict[str, float]:
    """What a browser draws."""
    noted = """
      window.drawnMs = { events: [], features: [] };
      const hear = listener.onMessage;
      listener.onMessage = (camera, channel, message) => {
        hear(camera, channel, message);
        if (channel in drawnMs) drawnMs[channel].waiting = true;
      };
      const draw = drawAll;
      drawAll = () => {
        draw();
        for (const times of Object.values(drawnMs)) {
          if (times.waiting) times.push(performance.now() / 1000);
          times.waiting = false;
        }
      };
      0
    """
    with Browser(1400, 900) as browser:
        browser.open(address)
        browser.until("Number(document.body?.dataset.frames) > 0")
        time.sleep(_WARM_S)
        browser.value(noted)
        before, started = _processor_s(process), time.monotonic()
        time.sleep(seconds)
        times = browser.value("({ events: [...drawnMs.events], features: [...drawnMs.features] })")
        passed = time.monotonic() - started
        return _summary(times, passed, _processor_s(process) - before)


def _summary(times: dict[str, list[float]], passed: float, worked: float) -> dict[str, float]:
    return {
        "pictures_per_s": len(times["events"]) / passed,
        "longest_ms": 1e3 * float(np.diff(times["events"]).max())
        if len(times["events"]) > 1
        else float("inf"),
        "features_per_s": len(times["features"]) / passed,
        "processor_share": worked / passed,
    }


def _processor_s(process: int) -> float:
    """Seconds of a processor that a process has taken."""
    after_name = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(after_name[11]) + int(after_name[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
