"""Compare the decoders of event files: right or wrong, and how quick.

Prints one line for each library and format: events, million events a second (median of interleaved runs, in
this process, after one unmeasured run), and whether the events equal the reference. The reference is the
format as published, decoded one word at a time in plain Python, or, for AEDAT4, the vendor's own library.
Libraries that are not installed are left out (`pip install faery expelliarmus eventcv dv-processing`).

For EVT3 an extra line shows the range that the file's own TIME_HIGH words allow for its times.
"""

import argparse
import importlib.util
import os
import platform
import statistics
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from streamfeat.camera_files.event_files import read_events
from streamfeat.events import Events, make_events


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    data = Path(os.environ.get("STREAMFEAT_DATA", Path(__file__).parents[2] / "shared" / "data"))
    parser.add_argument(
        "--folder", type=Path, default=data / "samples", help="sample files (default: %(default)s)"
    )
    parser.add_argument("--dat", type=Path, help="one .dat file to measure too")
    parser.add_argument("--runs", type=int, default=9, help="interleaved runs (default: %(default)s)")
    args = parser.parse_args()
    paths = {
        "evt2": args.folder / "evt2_640x480.raw",
        "evt3": args.folder / "evt3_1280x720.raw",
        "aedat4": args.folder / "dvs_320x240.aedat4",
        "bin40": args.folder / "ncaltech101_faces_easy_0001.bin",
    } | ({"dat": args.dat} if args.dat else {})
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, NumPy {np.__version__}\n")
    print("| format | library | events | Mev/s | against the reference |")
    print("|---|---|---:|---:|---|")
    for name, path in paths.items():
        reference = REFERENCES[name](path)
        readers, results = {}, {}
        for library, read in READERS[name].items():
            if importlib.util.find_spec(library) is None:
                continue
            try:
                results[library] = read(path)
            except Exception as error:  # each library has its own, down to Exception itself
                print(f"| {name} | {library} | | | fails: {error!s:.80} |")
            else:
                readers[library] = read
        rates: dict[str, list[float]] = {library: [] for library in readers}
        for _ in range(args.runs):
            for library, read in readers.items():
                start = time.perf_counter()
                read(path)
                rates[library].append(len(results[library]) / (time.perf_counter() - start) / 1e6)
        for library, events in results.items():
            verdict = differences(events, reference)
            rate = statistics.median(rates[library])
            print(f"| {name} | {library} | {len(events)} | {rate:.1f} | {verdict} |")


def differences(events: Events, reference: Events) -> str:
    if len(events) != len(reference):
        return f"{len(events) - len(reference):+} events"
    found = []
    for field in "xypt":
        delta = events[field].astype(np.int64) - reference[field].astype(np.int64)
        if delta.any():
            n = np.count_nonzero(delta)
            found.append(f"{field} differs in {n} events, by {delta.min():+} to {delta.max():+}")
    return "; ".join(found) or "equal"


def with_faery(path: Path) -> Events:
    import faery

    version = "evt2" if b"% evt 2.0" in path.read_bytes()[:500] else None
    batches = list(faery.events_stream_from_file(path, version_fallback=version))
    packets = np.concatenate(batches)
    return make_events(packets["x"], packets["y"], packets["on"], packets["t"])


def with_expelliarmus(encoding: str) -> Callable[[Path], Events]:
    def read(path: Path) -> Events:
        import expelliarmus

        rows = expelliarmus.Wizard(encoding=encoding, fpath=path).read()
        return make_events(rows["x"], rows["y"], rows["p"], rows["t"])

    return read


def with_eventcv(path: Path) -> Events:
    import eventcv

    x, y, t, p = eventcv.load(str(path), time_unit="microseconds").numpy().T
    return make_events(x, y, p, t)


def with_dv_processing(path: Path) -> Events:
    import dv_processing

    recording = dv_processing.io.MonoCameraRecording(str(path))
    batches = []
    while recording.isRunning() and (batch := recording.getNextEventBatch()) is not None:
        batches.append(batch.numpy())
    rows = np.concatenate(batches)
    return make_events(rows["x"], rows["y"], rows["polarity"], rows["timestamp"])


def with_streamfeat(path: Path) -> Events:
    return read_events(path).events


def after_header(path: Path) -> bytes:
    data = path.read_bytes()
    start = 0
    while data.startswith(b"% ", start):
        start = data.index(b"\n", start) + 1
    return data[start:]


def reference_evt2(path: Path) -> Events:
    high, rows = 0, []
    for (word,) in struct.iter_unpack("<I", after_header(path)):
        kind = word >> 28
        if kind == 8:
            high = word & 0xFFFFFFF
        elif kind in (0, 1):
            rows.append((word >> 11 & 0x7FF, word & 0x7FF, kind, high << 6 | word >> 22 & 0x3F))
    return make_events(*np.array(rows).T)


def reference_evt3(path: Path) -> Events:
    """t = TIME_HIGH << 12 | TIME_LOW, whatever came before; the sample file has no wrap."""
    high = low = y = base = polarity = 0
    highs, rows = [], []
    for (word,) in struct.iter_unpack("<H", after_header(path)):
        kind, value = word >> 12, word & 0xFFF
        if kind == 0x8:
            high = value
            highs.append(value)
        elif kind == 0x6:
            low = value
        elif kind == 0x0:
            y = value & 0x7FF
        elif kind == 0x2:
            rows.append((value & 0x7FF, y, value >> 11, high << 12 | low))
        elif kind == 0x3:
            base, polarity = value & 0x7FF, value >> 11
        elif kind in (0x4, 0x5):
            width = 12 if kind == 0x4 else 8
            rows += [(base + i, y, polarity, high << 12 | low) for i in range(width) if value >> i & 1]
            base += width
    events = make_events(*np.array(rows).T)
    assert min(highs) << 12 <= events["t"].min()
    assert events["t"].max() < (max(highs) + 1) << 12
    print(f"| evt3 | (its TIME_HIGH words) | | | times from {min(highs) << 12} to {(max(highs) + 1) << 12} |")
    return events


def reference_bin40(path: Path) -> Events:
    rows = []
    for x, y, high, middle, low in struct.iter_unpack("5B", path.read_bytes()):
        rows.append((x, y, high >> 7, (high & 0x7F) << 16 | middle << 8 | low))
    return make_events(*np.array(rows).T)


def reference_dat(path: Path) -> Events:
    rows = []
    for t, word in struct.iter_unpack("<II", after_header(path)[2:]):
        rows.append((word & 0x3FFF, word >> 14 & 0x3FFF, word >> 28, t))
    return make_events(*np.array(rows).T)


READERS: dict[str, dict[str, Callable[[Path], Any]]] = {
    "evt2": {
        "streamfeat": with_streamfeat,
        "faery": with_faery,
        "expelliarmus": with_expelliarmus("evt2"),
        "eventcv": with_eventcv,
    },
    "evt3": {
        "streamfeat": with_streamfeat,
        "faery": with_faery,
        "expelliarmus": with_expelliarmus("evt3"),
        "eventcv": with_eventcv,
    },
    "aedat4": {
        "streamfeat": with_streamfeat,
        "faery": with_faery,
        "eventcv": with_eventcv,
        "dv_processing": with_dv_processing,
    },
    "bin40": {"streamfeat": with_streamfeat},
    "dat": {
        "streamfeat": with_streamfeat,
        "faery": with_faery,
        "expelliarmus": with_expelliarmus("dat"),
        "eventcv": with_eventcv,
    },
}
REFERENCES: dict[str, Callable[[Path], Events]] = {
    "evt2": reference_evt2,
    "evt3": reference_evt3,
    "aedat4": with_dv_processing,
    "bin40": reference_bin40,
    "dat": reference_dat,
}

if __name__ == "__main__":
    main()
