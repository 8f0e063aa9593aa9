"""Compare the decoders of event files: the same events or not, and how quick.

For each format that another library reads, on the samples of the shared data and on generated files: whether
its events equal ours, and where they do not, which of the two equals the format as published, decoded one
word at a time in plain Python. Rates are million events a second, the median of runs that are interleaved in
this process, after one unmeasured run; a library that fails or differs has none. Libraries that are not
installed are named and left out (`pip install faery expelliarmus eventcv dv-processing evlib`).
"""

import argparse
import datetime
import importlib.metadata
import importlib.util
import os
import platform
import statistics
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from streamfeat.camera_files.event_files import read_events
from streamfeat.convert.outputs import open_output
from streamfeat.events import Events, make_events

SIZE = (480, 640)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    data = Path(os.environ.get("STREAMFEAT_DATA", Path(__file__).parents[2] / "shared" / "data"))
    parser.add_argument(
        "--folder", type=Path, default=data / "samples", help="samples (default: %(default)s)"
    )
    parser.add_argument("--runs", type=int, default=9, help="interleaved runs (default: %(default)s)")
    parser.add_argument(
        "--events", type=int, default=500_000, help="of generated files (default: %(default)s)"
    )
    args = parser.parse_args()
    there = {library: importlib.util.find_spec(library) is not None for library in LIBRARIES}
    named = [f"{name} {importlib.metadata.version(name)}" for name in LIBRARIES if there[name]]
    left_out = ", ".join(name for name in LIBRARIES if not there[name]) or "none"
    print(f"`{' '.join(['python', *sys.argv])}`, {datetime.date.today()}: {platform.machine()}, "
          f"{os.cpu_count()} cores, {', '.join(named)}; not installed: {left_out}\n")  # fmt: skip
    print("| format | file | events | ours = theirs | ours, Mev/s | the best library, Mev/s |")
    print("|---|---|---:|---|---:|---:|")
    with tempfile.TemporaryDirectory() as folder:
        for name, path in (*samples(args.folder), *generated(Path(folder), args.events)):
            readers = {library: read for library, read in READERS[name].items() if there[library]}
            print(row(name, path, readers, args.runs, is_sample=path.parent == args.folder), flush=True)


def row(name: str, path: Path, readers: dict[str, "Read"], runs: int, *, is_sample: bool) -> str:
    """One line of the table."""
    mine = read_events(path).events
    verdicts, right = [], {}
    truth: Events | None = None
    for library, read in readers.items():
        try:
            theirs = read(path)
        except Exception as error:  # each library has its own, down to Exception itself
            verdicts.append(f"{library} fails: {' '.join(str(error).split())[:70]}")
            continue
        if different := differences(mine, theirs):
            if truth is None and name in PUBLISHED:
                truth = PUBLISHED[name](path)
            verdicts.append(f"{library}: {different}{judged(mine, theirs, truth)}")
        else:
            right[library] = read
    rates: dict[str, list[float]] = {library: [] for library in ("", *right)}
    for _ in range(runs):
        for library, read in {"": lambda path: read_events(path).events, **right}.items():
            start = time.perf_counter()
            read(path)
            rates[library].append(len(mine) / (time.perf_counter() - start) / 1e6)
    medians = {library: statistics.median(found) for library, found in rates.items()}
    ours = medians.pop("")
    best = max(medians, key=medians.__getitem__, default="")
    equal = [f"yes: {', '.join(right)}"] if right else []
    theirs_best = f"{best} {medians[best]:.1f}" if best else ""
    shown = path.name if is_sample else "generated"
    verdict = "; ".join([*equal, *verdicts])
    return f"| {name} | {shown} | {len(mine):,} | {verdict} | {ours:.1f} | {theirs_best} |"


def differences(mine: Events, theirs: Events) -> str:
    """How theirs differ from ours, in a few words; empty where they do not."""
    if len(mine) != len(theirs):
        return f"{len(theirs) - len(mine):+,} events"
    found = []
    for field in "xypt":
        delta = theirs[field].astype(np.int64) - mine[field].astype(np.int64)
        if n := int(np.count_nonzero(delta)):
            found.append(f"{field} of {n:,} events differs by {delta.min():+} to {delta.max():+}")
    return ", ".join(found)


def judged(mine: Events, theirs: Events, truth: Events | None) -> str:
    """Which of two is right."""
    if truth is None:
        return ""
    equal = [name for name, events in (("ours", mine), ("theirs", theirs)) if not differences(truth, events)]
    return f" ({' and '.join(equal) or 'neither'} as published)"


def samples(folder: Path) -> Iterator[tuple[str, Path]]:
    """Recordings of real cameras."""
    for name, file in (
        ("evt2", "evt2_640x480.raw"),
        ("evt3", "evt3_1280x720.raw"),
        ("aedat4", "dvs_320x240.aedat4"),
        ("bin40", "ncaltech101_faces_easy_0001.bin"),
    ):
        if (folder / file).exists():
            yield name, folder / file


def generated(folder: Path, n: int) -> Iterator[tuple[str, Path]]:
    """Random events over 20 seconds, so that the clock of EVT3 turns, in files of ours and of faery."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 20_000_000, n))
    t -= t[0]  # faery and others write and read some formats from their first event on
    events = make_events(rng.integers(0, SIZE[1], n), rng.integers(0, SIZE[0], n), rng.integers(0, 2, n), t)
    for name, file in (("evt3", "a.raw"), ("hdf5", "a.h5"), ("csv", "a.csv")):
        with open_output(folder / file) as output:
            output.write(events, SIZE)
        yield name, folder / file
    words = np.empty((n, 2), "<u4")
    words[:, 0] = t
    words[:, 1] = events["x"] | events["y"].astype("<u4") << 14 | events["p"].astype("<u4") << 28
    head = b"% Version 2\n% Width 640\n% Height 480\n\x0c\x08"
    (folder / "a.dat").write_bytes(head + words.tobytes())
    yield "dat", folder / "a.dat"
    if importlib.util.find_spec("faery"):
        import faery

        rows = np.zeros(n, faery.EVENTS_DTYPE)
        for mine, field in zip("xypt", ("x", "y", "on", "t"), strict=True):
            rows[field] = events[mine]
        for name in ("es", "aedat4"):
            faery.events_stream_from_array(rows, SIZE[::-1]).to_file(folder / f"b.{name}")
            yield name, folder / f"b.{name}"


Read = Callable[[Path], Events]


def with_faery(path: Path) -> Events:
    import faery

    version = "evt2" if b"% evt 2.0" in path.read_bytes()[:500] else None
    options: dict[str, Any] = {"version_fallback": version}
    if path.suffix == ".csv":
        options = {"dimensions_fallback": SIZE[::-1], "csv_properties": faery.CsvProperties.default()}
    rows = np.concatenate(list(faery.events_stream_from_file(path, **options)))
    return make_events(rows["x"], rows["y"], rows["on"], rows["t"])


def with_expelliarmus(encoding: str) -> Read:
    def read(path: Path) -> Events:
        import expelliarmus

        rows = expelliarmus.Wizard(encoding=encoding, fpath=path).read()
        return make_events(rows["x"], rows["y"], rows["p"], rows["t"])

    return read


def with_eventcv(path: Path) -> Events:
    import eventcv

    x, y, t, p = eventcv.load(str(path), time_unit="microseconds").numpy().T
    return make_events(x, y, p > 0, t)


def with_evlib(path: Path) -> Events:
    import evlib

    rows = evlib.load_events(str(path)).collect()
    t = rows["t"].dt.total_microseconds().to_numpy()
    return make_events(rows["x"].to_numpy(), rows["y"].to_numpy(), rows["polarity"].to_numpy() > 0, t)


def with_dv_processing(path: Path) -> Events:
    import dv_processing

    recording = dv_processing.io.MonoCameraRecording(str(path))
    batches = []
    while recording.isRunning() and (batch := recording.getNextEventBatch()) is not None:
        batches.append(batch.numpy())
    rows = np.concatenate(batches)
    return make_events(rows["x"], rows["y"], rows["polarity"], rows["timestamp"])


def after_header(path: Path) -> bytes:
    data = path.read_bytes()
    start = 0
    while data.startswith(b"% ", start):
        start = data.index(b"\n", start) + 1
    return data[start:]


def published_evt3(path: Path) -> Events:
    """t = TIME_HIGH << 12 | TIME_LOW; a fall of TIME_HIGH by more than half its range is a turn."""
    high = turns = low = y = base = polarity = 0
    rows = []
    for (word,) in struct.iter_unpack("<H", after_header(path)):
        kind, value = word >> 12, word & 0xFFF
        if kind == 0x8:
            turns += high - value > 0x7FF
            high = value
        elif kind == 0x6:
            low = value
        elif kind == 0x0:
            y = value & 0x7FF
        elif kind == 0x2:
            rows.append((value & 0x7FF, y, value >> 11, turns << 24 | high << 12 | low))
        elif kind == 0x3:
            base, polarity = value & 0x7FF, value >> 11
        elif kind in (0x4, 0x5):
            width, t = (12 if kind == 0x4 else 8), turns << 24 | high << 12 | low
            rows += [(base + i, y, polarity, t) for i in range(width) if value >> i & 1]
            base += width
    return make_events(*np.array(rows).T)


LIBRARIES = ("faery", "expelliarmus", "eventcv", "dv_processing", "evlib")
_COMMON: dict[str, Read] = {"faery": with_faery, "eventcv": with_eventcv, "evlib": with_evlib}
READERS: dict[str, dict[str, Read]] = {
    **{name: {**_COMMON, "expelliarmus": with_expelliarmus(name)} for name in ("evt2", "evt3", "dat")},
    "aedat4": {**_COMMON, "dv_processing": with_dv_processing},
    "hdf5": {"eventcv": with_eventcv, "evlib": with_evlib},
    "csv": _COMMON,
    "es": {"faery": with_faery},
    "bin40": {"eventcv": with_eventcv, "evlib": with_evlib},
}
PUBLISHED: dict[str, Read] = {"evt3": published_evt3}

if __name__ == "__main__":
    main()
