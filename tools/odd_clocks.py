"""Read recordings of endless copies, and of a clock that starts anew every second: time and memory of each.

Example: python tools/odd_clocks.py --messages 10000000

Time, of a processor, should grow with the number of messages, and memory should not. The first recording of
each kind is a tenth of the second.
"""

import argparse
import resource
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray

from streamfeat.events import make_events
from streamfeat.messages.cdr import EventPacket
from streamfeat.messages.codecs import encode
from streamfeat.recordings.reader import open_recording

_IN_A_CHUNK = 10_000
_EVENTS = 4
_SECOND_NS = 1_000_000_000
_BASE_S = 1_700_000_000
_MESSAGE = struct.Struct("<BQHIQQ")
_LOG_TIME, _STAMP = 15, 35
"""Bytes of a message record at which its log time and the seconds of its header begin."""


def _records(channel: int, kind: str) -> NDArray[np.uint8]:
    """Message records of one chunk, `(10000, bytes)`: one packet, or ten that tell of one second."""
    rows = []
    for i in range(_IN_A_CHUNK):
        number = 0 if kind == "copies" else i % 10
        t = number * 100_000 + np.arange(_EVENTS) * 10
        payload, base_ns = encode(make_events(t % 64, t % 48, t % 2, t), "mono")
        about = _BASE_S * _SECOND_NS, "", 48, 64, number, base_ns, "mono", False
        data = EventPacket(*about, payload).to_cdr()
        head = _MESSAGE.pack(0x05, _MESSAGE.size - 9 + len(data), channel, i, 0, 0)
        rows.append(np.frombuffer(head + data, np.uint8))
    return np.stack(rows)


def write(path: Path, kind: str, n: int) -> int:
    """Write a recording of about `n` messages without a summary; return how many there are.

    Copies have one time; of the others each ten are a second later, by the host, than those before.
    """
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start("ros2")
        schema = writer.register_schema(EventPacket.SCHEMA_NAME, "ros2msg", EventPacket.SCHEMA.encode())
        records = _records(writer.register_channel("/events", "cdr", schema), kind)
        writer.flush()
        copies = max(n // _IN_A_CHUNK, 1)
        tenths = np.arange(_IN_A_CHUNK) if kind == "restarts" else np.zeros(_IN_A_CHUNK, np.int64)
        for _ in range(copies):
            log_ns = _BASE_S * _SECOND_NS + tenths * (_SECOND_NS // 10)
            records[:, _LOG_TIME : _LOG_TIME + 8] = log_ns[:, None].view(np.uint8)
            records[:, _STAMP : _STAMP + 4] = (log_ns // _SECOND_NS).astype("<u4")[:, None].view(np.uint8)
            body = records.tobytes()
            about = int(log_ns[0]), int(log_ns[-1]), len(body), 0, 0, len(body)
            file.write(struct.pack("<BQQQQIIQ", 0x06, 40 + len(body), *about) + body)
            tenths = tenths + _IN_A_CHUNK if kind == "restarts" else tenths
    return copies * _IN_A_CHUNK


def measure(path: Path) -> None:
    """Read a recording, and print events, seconds of a processor, the most memory in MiB, and counts."""
    started = time.process_time()
    with open_recording(path) as recording:
        n = sum(len(batch) for batch in recording)
        counts = dict(recording.counts)
    seconds = time.process_time() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{n:>12,} events used  {seconds:8.2f} s  {peak:7.0f} MiB  {counts}")


def main() -> None:
    """Measure both kinds at a tenth of the number of messages and at all of it, each in its own process."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--messages", type=int, default=1_000_000, help="in the larger recording of each kind"
    )
    parser.add_argument("--kind", action="append", choices=["copies", "restarts"], help="may be repeated")
    parser.add_argument("--read", type=Path, help="only read this recording")
    given = parser.parse_args()
    if given.read:
        measure(given.read)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "odd.mcap")
        for kind in given.kind or ["copies", "restarts"]:
            for n in (given.messages // 10, given.messages):
                written = write(path, kind, n)
                print(f"{kind:8} {written:>12,} messages  ", end="", flush=True)
                subprocess.run([sys.executable, __file__, "--read", str(path)], check=True)


if __name__ == "__main__":
    main()
