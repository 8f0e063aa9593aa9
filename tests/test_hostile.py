"""Hostile bytes: a short run of every target, and every input that ever failed.

Long runs, guided by coverage: `python tests/torture --only bytes`.
"""

import contextlib
import io
import json
import os
import struct
import subprocess
import sys
import time
import tracemalloc
import warnings
import zipfile
from pathlib import Path

import decode_hostile
import lz4.frame
import numpy as np
import pytest
import tiny
import zstandard
from mcap.reader import make_reader
from mcap.writer import Writer
from safetensors.numpy import save
from torture.fuzz import Watch, all_targets, random_inputs
from torture.mutate import mend_mcap, mend_zip

from streamfeat.camera_files.event_files import read_events
from streamfeat.engine.encoder import Encoder
from streamfeat.engine.geometry import Geometry
from streamfeat.errors import InputError, printable
from streamfeat.events import EVENT_DTYPE
from streamfeat.messages.codecs import PAYLOAD_ENCODINGS
from streamfeat.recordings.reader import Label, open_recording
from streamfeat.recordings.writer import RecordingWriter, recover

TARGETS = all_targets()
ROOT = Path(__file__).resolve().parents[1]


def runs_of(name):
    """So many as take a quarter of a second; an HDF5 file takes a process."""
    if "HDF5" in name:
        return 2
    return {"live intake": 60, "recording": 40, "recover": 40}.get(name, 300)


def watch(name):
    if "HDF5" in name:
        pytest.importorskip("h5py")
    return Watch(TARGETS[name], None)


@pytest.mark.parametrize("name", TARGETS)
def test_a_result_or_a_refusal(name):
    watched = watch(name)
    for data in random_inputs(TARGETS[name], runs_of(name), seed=1):
        watched.execute(data)
    assert watched.done == runs_of(name) > watched.refused


@pytest.mark.parametrize("name", [name for name in TARGETS if "HDF5" not in name])
def test_the_same_bytes_give_the_same(name):
    """What comes out depends on nothing that was fed before."""
    watched = watch(name)
    inputs = list(random_inputs(TARGETS[name], 40, seed=2))[::2]
    outcomes = []
    for order in (inputs, inputs[::-1]):
        found = {}
        for data in order:
            watched.digest = 0
            watched.execute(data)
            found[data] = watched.digest
        outcomes.append(found)
    assert outcomes[0] == outcomes[1]


@pytest.mark.parametrize("mode", ["NUMBA_BOUNDSCHECK", "NUMBA_DISABLE_JIT"])
def test_payloads_within_bounds_and_uncompiled_give_the_same(mode, tmp_path):
    """`python tests/torture --only bytes` does it with the kernels of engines, too."""
    payloads = [
        data[3:][: len(data) // 2 * 2 - 4]
        for encoding in PAYLOAD_ENCODINGS
        for data in random_inputs(TARGETS[f"payload {encoding}"], 60, seed=3)
    ]
    (tmp_path / "payloads").write_bytes(decode_hostile.pack(payloads))
    done = subprocess.run(
        [sys.executable, decode_hostile.__file__, tmp_path / "payloads"],
        env=os.environ | {"PYTHONPATH": str(ROOT), mode: "1", "NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == decode_hostile.decoded(decode_hostile.pack(payloads))


# --- what failed once, minimised


def zip_of(**members):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return out.getvalue()


def npz_of(**columns):
    out = io.BytesIO()
    np.savez(out, **columns)
    return out.getvalue()


def classifier_of(**arrays):
    header = {"format": "streamfeat-classifier", "version": 1, "labels": ["a", "b"], "fingerprint": "x"}
    floats = {"centre": [0], "scale": [1], "weights": [[1]], "bias": [0]} | arrays
    named = {name: np.array(values, np.float32) for name, values in floats.items()}
    return save(named, metadata={"streamfeat": json.dumps(header)})


def tensors_of(dtype, size):
    header = json.dumps({"a": {"dtype": dtype, "shape": [1], "data_offsets": [0, size]}}).encode()
    return struct.pack("<Q", len(header)) + header + bytes(size)


def aedat4_seed(old, new):
    seed = TARGETS["camera file AEDAT4"].seeds()[0]
    assert old in seed
    return seed.replace(old, new, 1)


FAILED = {
    "a key without a slash": ("names and attachments", b"events\0application/cdr\0"),
    "a scale that makes weights infinite": ("classifier", classifier_of(scale=[1e-38], weights=[[1e38]])),
    "weights whose sum is infinite": ("classifier", classifier_of(bias=[3e38], weights=[[3e38]])),
    "a tensor of a type that NumPy lacks": ("model", tensors_of("BF16", 2)),
    "a tensor of another type that NumPy lacks": ("classifier", tensors_of("F8_E4M3", 1)),
    "a member that is no array": ("camera file NumPy", zip_of(x=b"1", y=b"2", p=b"3", t=b"4")),
    "one member that is no array": ("camera file NumPy", zip_of(events=b"12")),
    "a time in seconds beyond all": (
        "camera file NumPy",
        npz_of(x=[1], y=[1], p=[1], t=np.array([1e308])),
    ),
    "a line of time beyond all": ("camera file text", b"1e308 1 2 1\n"),
    "a header that speaks to the terminal": ("camera file EVT2", b"% format EVT\x1b]0;x\x07\n"),
    "a name that is not UTF-8": ("camera file AEDAT4", aedat4_seed(b"EVTS", b"\xff\xfe\xff\xff")),
    "a table that is elsewhere": ("camera file AEDAT4", aedat4_seed(b"IOHE", b"\xff\xff\xff\xff")),
    "a character cut in two": ("camera file AEDAT4", aedat4_seed(b"node name", b"\xc3node na")),
}


@pytest.mark.parametrize("case", FAILED)
def test_what_failed_once(case):
    name, data = FAILED[case]
    with warnings.catch_warnings(action="error"):
        watch(name).execute(data)


# --- claims, links and other bombs; each would take memory or time without end


def test_hdf5_that_never_ends(tmp_path):
    """A heap object without a length: the library looks for the next one for ever."""
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as root:
        root.attrs["geometry"] = "16x12"
        root["CD/events"] = tiny.stream(range(30))
    data = bytearray(path.read_bytes())
    at = data.index(b"16x12")
    data[at - 16 : at + 5] = bytes(21)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.h5: .*(does not come to an end|damaged)"):
        read_events(path)


def npy_claiming(shape):
    out = io.BytesIO()
    header = {"descr": "<i8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(out, header)
    return out.getvalue() + bytes(64)


def npz_claiming(size):
    data = bytearray(npz_of(t=np.zeros(9), x=np.zeros(9), y=np.zeros(9), p=np.zeros(9)))
    at = data.index(b"PK\x01\x02")
    data[at + 24 : at + 28] = struct.pack("<I", size)  # bytes when unpacked, in the directory
    return bytes(data)


def aedat4_of(compression, pack):
    seed = next(seed for seed in TARGETS["camera file AEDAT4"].seeds() if compression in seed)
    at = seed.index(b"</dv>") + 5
    return seed[:at] + struct.pack("<2i", 0, len(pack)) + pack


CLAIMS = {
    "a.npy": lambda: npy_claiming((1 << 40, 4)),
    "b.npy": lambda: npy_claiming((1 << 62, 4)),
    "c.npz": lambda: npz_claiming(0xFFFFFFF0),
    "d.aedat4": lambda: aedat4_of(b"\x04\x22\x4d\x18", lz4.frame.compress(bytes(200 << 20))),
    "e.aedat4": lambda: aedat4_of(
        b"\x28\xb5\x2f\xfd", zstandard.ZstdCompressor(write_content_size=True).compress(bytes(200 << 20))
    ),
    "f.aedat": lambda: (
        b"#!AER-DAT3.1\r\n#Format: RAW\r\n#!END-HEADER\r\n"
        + struct.pack("<hhiiiiii", 1, 0, 8, 4, 0, 0, 0x7FFFFFFF, 0)
    ),
    "g.es": lambda: b"Event Stream\x02\x00\x00\x01\xff\xff\xff\xff" + b"\xff" * 1000,
    "h.txt": lambda: b"1" * 3_000_000,
}


@pytest.mark.parametrize("name", CLAIMS)
def test_what_claims_gigabytes_takes_neither_them_nor_a_second(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(CLAIMS[name]())
    tracemalloc.start()
    started = time.process_time()
    with contextlib.suppress(InputError):
        read = read_events(path)
        assert len(read.events) < 100
        assert read.damage
    took, (_, most) = time.process_time() - started, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert took < 1
    assert most < 256 << 20


def test_hdf5_with_rows_that_nobody_wrote(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as root:
        root.create_dataset("CD/events", (1 << 50,), EVENT_DTYPE, chunks=(1024,))
    with pytest.raises(InputError, match="claims 1125899906842624 events in 0 bytes"):
        read_events(tmp_path / "a.h5")


@pytest.mark.parametrize("how", ["link", "folder", "bytes", "virtual"])
def test_hdf5_that_shows_another_file(tmp_path, how):
    h5py = pytest.importorskip("h5py")
    events = tiny.stream(range(30))
    with h5py.File(tmp_path / "secret.h5", "w") as other:
        other["CD/events"] = events
    (tmp_path / "secret").write_bytes(events.tobytes())
    with h5py.File(tmp_path / "a.h5", "w") as root:
        if how == "folder":
            root["CD"] = h5py.ExternalLink("secret.h5", "CD")
        elif how == "link":
            root.create_group("CD")["events"] = h5py.ExternalLink("secret.h5", "CD/events")
        elif how == "bytes":
            external = [(str(tmp_path / "secret"), 0, events.nbytes)]
            root.create_dataset("CD/events", (30,), events.dtype, external=external)
        else:
            layout = h5py.VirtualLayout((30,), events.dtype)
            layout[:] = h5py.VirtualSource(str(tmp_path / "secret.h5"), "CD/events", (30,))
            root.create_group("CD").create_virtual_dataset("events", layout)
    with pytest.raises(InputError, match=r"no CD/events table|keeps its events in another file"):
        read_events(tmp_path / "a.h5")


def test_a_header_of_digits_takes_no_time_to_refuse(tmp_path):
    path = tmp_path / "a.raw"
    path.write_bytes(b"% evt 2.0\n% geometry " + b"1" * 60_000 + b"\n")
    started = time.process_time()
    with contextlib.suppress(InputError):
        read_events(path)
    assert time.process_time() - started < 10  # it took a minute


def test_a_model_of_more_atoms_than_fit_into_memory():
    """Their products with each other would take 10 GB."""
    with pytest.raises(InputError, match="50000 atoms are too many"):
        Encoder.build(
            Geometry(patch=1, n_bins=1),
            formulation="inverse",
            encoding="soft",
            threshold=0.1,
            filters=np.ones((50_000, 1)),
            whitening=np.ones((1, 1)),
            mean=np.zeros(1),
        )


def test_labels_without_end_do_not_each_hold_the_recording(tmp_path):
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for i in range(40):
            writer.write_label(Label(i, 1 << 50, str(i)))
        writer.write_events(tiny.stream(range(100, 200)), tiny.RESOLUTION)
    with open_recording(tmp_path / "a.mcap") as recording:
        samples = list(recording.samples())
    assert [sample.label.label for sample in samples] == [str(i) for i in range(40)]
    assert [len(sample.events) for sample in samples] == [0] * 24 + [100] * 16


def test_many_channels_of_one_schema_do_not_multiply_it(tmp_path):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema("a/msg/B", "ros2msg", bytes(100_000))
        for i in range(50):
            writer.add_message(writer.register_channel(f"/{i}", "cdr", schema), i, b"x", i)
        writer.finish()
    assert not recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    with (tmp_path / "b.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert (len(summary.schemas), len(summary.channels)) == (1, 50)


def test_what_is_quoted_does_nothing_to_a_terminal():
    assert printable("a line") == "a line"
    assert printable("a\x1b[2J\nb\u202e\ud800") == r"a\x1b[2J b\u202e\ud800"
    assert len(printable("\0" * 10**6)) == len(printable("a" * 10**6)) == 1000
    assert str(InputError("two\nlines")) == "two lines"


# --- sums are made right, so that changes behind them are looked at


def test_sums_are_mended():
    for seed in TARGETS["recording"].seeds():
        assert mend_mcap(seed)[:-40] == seed[:-40]
    data = npz_of(x=np.arange(9))
    at = data.index(b"\x03\0\0\0")
    changed = data[:at] + b"\x09" + data[at + 1 :]
    with pytest.raises(zipfile.BadZipFile, match="Bad CRC"):
        np.load(io.BytesIO(changed))["x"]
    assert 9 in np.load(io.BytesIO(mend_zip(changed)))["x"]
