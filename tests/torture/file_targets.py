"""What reads files that nobody has vouched for: recordings, models, classifiers, camera files.

Lives here: one target for each kind of file. Not here: messages and live input (`targets`).
"""

import atexit
import functools
import io
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import camera_files_scene as scenes
import lz4.frame
import numpy as np
import zstandard

from streamfeat.camera_files.event_files import open_events
from streamfeat.classify.classifier import Classifier
from streamfeat.convert.datasets import convert
from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.events import Events
from streamfeat.messages.cdr import EventArray, LabelMessage
from streamfeat.recordings.reader import Label, Packet, open_recording
from streamfeat.recordings.writer import RecordingWriter, recover
from torture.mutate import mend_mcap, mend_tensors, mend_zip
from torture.targets import Target, check_events, check_line, some_events

__all__ = ["FILE_TARGETS"]

_CONVERTED = 16
"""One input in so many is converted to a recording, too."""
_TINY = Geometry(patch=2, stride=2, n_bins=2, bin_us=50_000, max_count=2)


@functools.cache
def _folder() -> Path:
    """Where `TMPDIR` says; removed when the process ends in order."""
    folder = Path(tempfile.mkdtemp(prefix="torture_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _file(name: str, data: bytes) -> Path:
    path = _folder() / name
    path.write_bytes(data)
    return path


def _written(write: Callable[[Path], object], name: str = "seed") -> bytes:
    path = _folder() / name
    path.unlink(missing_ok=True)
    write(path)
    return path.read_bytes()


# --- recordings


def _recording_seeds() -> list[bytes]:
    def write(path: Path, encoding: str, compression: Any, chunk_size: int) -> None:
        with RecordingWriter(path, encoding=encoding, compression=compression, chunk_size=chunk_size) as out:
            for i in range(3):
                events = some_events(20, i)
                events["t"] += 200_000 * i
                out.write_label(Label(200_000 * i, 100_000, f"class {i}", "train", "a.dat"))
                out.write_events(events, (12, 16))
            array = EventArray(700_000_000, "", 12, 16, some_events(9)).to_cdr()
            out.write_message("/events", EventArray, array, 700_000_000, 9)
            out.write_message("/label", LabelMessage, b"no label", 700_000_000, 9)

    kinds = [
        ("mono", "none", 1),
        ("evt3", "none", 1 << 20),
        ("libcaer_cmp", "lz4", 1),
        ("libcaer", "zstd", 99),
    ]
    return [_written(functools.partial(_call, write, kind)) for kind in kinds]


def _call(write: Callable[..., None], kind: tuple[Any, ...], path: Path) -> None:
    write(path, *kind)


def _read_recording(data: bytes) -> bytes:
    with open_recording(_file("a.mcap", data)) as recording:
        seen, labels = _read_items(recording.items())
        assert recording.losses or not labels or recording.labels
        samples = sum(len(sample.events) for sample in recording.samples())
        counts = sorted(recording.losses.counts.items())
        for line in recording.losses.first.values():
            check_line(line)
        return seen + repr((samples, labels, counts, recording.topics)).encode()


def _read_items(items: Iterator[Packet | Label]) -> tuple[bytes, int]:
    seen, labels = b"", 0
    for item in items:
        if isinstance(item, Packet):
            seen += check_events(item.events)
        else:
            labels += 1
    return seen, labels


def _recover_recording(data: bytes) -> bytes:
    target = _folder() / "recovered.mcap"
    losses = recover(_file("a.mcap", data), target, overwrite=True)
    again = recover(target, _folder() / "twice.mcap", overwrite=True)
    assert not again, f"the recovered file has losses: {again}"
    whole = target.read_bytes()
    assert whole == (_folder() / "twice.mcap").read_bytes()
    return whole + repr(sorted(losses.counts.items())).encode()


# --- models and classifiers


def _model_seeds() -> list[bytes]:
    kinds = [("direct", "split"), ("direct", "triangle"), ("inverse", "soft"), ("inverse", "split")]
    return [_written(random_encoder(1, _TINY, 3, *kind, threshold=0.3).save) for kind in kinds]


def _load_model(data: bytes) -> bytes:
    encoder = Encoder.load(_file("a.safetensors", data))
    geometry = encoder.geometry
    side = geometry.patch * geometry.downsample
    if side > 64 or geometry.n_bins > 64 or encoder.n_features > 1 << 16:
        return b"large"
    engine = Engine(encoder, (side + geometry.stride, side))
    engine.feed(some_events(20, width=side, height=side))
    features = engine.features()
    assert features.shape == (encoder.n_features,)
    assert np.isfinite(features).all()
    return encoder.fingerprint.encode() + features.tobytes()


def _classifier_seeds() -> list[bytes]:
    rng = np.random.default_rng(2)
    made = []
    for labels in (("cat", "dog"), ("cat", "dog", "owl")):
        columns = 1 if len(labels) == 2 else len(labels)
        arrays = {
            "centre": rng.standard_normal(4),
            "scale": rng.uniform(0.5, 2, 4),
            "weights": rng.standard_normal((4, columns)),
            "bias": rng.standard_normal(columns),
        }
        floats = {name: array.astype(np.float32) for name, array in arrays.items()}
        made.append(Classifier(labels=labels, fingerprint="a" * 64, provenance={"seed": 2}, **floats))
    return [_written(classifier.save) for classifier in made]


def _load_classifier(data: bytes) -> bytes:
    classifier = Classifier.load(_file("a.safetensors", data))
    features = np.linspace(-3, 3, len(classifier.centre), dtype=np.float32)
    scores = classifier.scores(features)
    assert scores.shape == (len(classifier.labels),)
    assert np.isfinite(scores).all()
    assert classifier.predict(features) in classifier.labels
    return scores.tobytes()


_JSON_WORDS = (b"1e308", b"-1", b"0", b"NaN", b"true", b"null", b"[]", b"{}", b'""', b"99999999999999999999")
_TENSOR_WORDS = (b"F32", b"F64", b"BF16", b"I8", b"BOOL", b"F8_E4M3", b"[0]", b"\\u0000", *_JSON_WORDS)


# --- camera files


def _read_foreign(name: str, data: bytes) -> bytes:
    path = _file(name, data)
    file = open_events(path)
    seen = b""
    for batch in file:
        seen += check_events(batch)
        if file.declared and len(batch):
            assert batch["y"].max() < file.declared[0]
            assert batch["x"].max() < file.declared[1]
    for line in file.damage:
        check_line(line)
    if zlib.crc32(data) % _CONVERTED == 0:
        done = convert(path, _folder() / "converted.mcap", overwrite=True)
        seen += repr(done.events).encode()
    return seen + repr((file.resolution, file.lost_bytes, file.damage)).encode()


def _words(events: Events) -> Iterator[tuple[int, int, int, int]]:
    return zip(*(events[field].tolist() for field in "xypt"), strict=True)


def _dat_seeds() -> list[bytes]:
    rows = b"".join(
        t.to_bytes(4, "little") + (x | y << 14 | p << 28).to_bytes(4, "little")
        for x, y, p, t in _words(some_events())
    )
    heads = (b"% Version 2\n% Width 304\n% Height 240\n", b"% Date 2020-01-01\n% end\n", b"")
    return [head + b"\x00\x08" + rows for head in heads]


def _bin40_seeds() -> list[bytes]:
    rows = b"".join(
        bytes((x, y)) + (p << 23 | t & 0x7FFFFF).to_bytes(3, "big") for x, y, p, t in _words(some_events())
    )
    return [rows, rows[:50] + bytes((0, 240, 0, 0, 0)) + rows[50:]]


def _evt2_seeds() -> list[bytes]:
    words = [
        word
        for x, y, p, t in _words(some_events())
        for word in (8 << 28 | t >> 6, p << 28 | (t & 63) << 22 | x << 11 | y)
    ]
    body = np.array(words, "<u4").tobytes()
    heads = (
        b"% evt 2.0\n",
        b"% format EVT2;width=640;height=480\n% end\n",
        b"% evt 2.0\n% geometry 640x480\n",
    )
    return [head + body for head in heads]


def _evt3_seeds() -> list[bytes]:
    words = [
        word
        for x, y, p, t in _words(some_events())
        for word in (
            0x8000 | t >> 12,
            0x6000 | t & 0xFFF,
            y,
            0x2000 | p << 11 | x,
            0x3000 | x,
            0x4F0F,
            0x50F0,
        )
    ]
    body = np.array(words, "<u2").tobytes()
    heads = (b"% evt 3.0\n% end\n", b"% format EVT3;height=480;width=640\n", b"% evt 3.0\n% geometry 64x48\n")
    return [head + body for head in heads]


def _text_seeds() -> list[bytes]:
    rows = list(_words(some_events(12)))
    seconds = "".join(f"{t / 1e6:.6f} {x} {y} {p}\n" for x, y, p, t in rows)
    micro = "".join(f"{t},{x},{y},{p}\n" for x, y, p, t in rows)
    return [
        seconds.encode(),
        f"16 12\n{seconds}".encode(),
        f"timestamp,x,y,polarity\n{micro}".encode(),
        f"# events\n% more\n{micro}".encode(),
    ]


def _numpy_seeds() -> list[bytes]:
    events = some_events(12)
    columns = {name: np.ascontiguousarray(events[name]) for name in "xypt"}
    signed = columns | {"p": columns["p"] * 2 - 1, "t": columns["t"] / 1e6}
    made = []
    for save in (
        lambda out: np.save(out, events),
        lambda out: np.savez(out, **columns),
        lambda out: np.savez(out, **signed),
        lambda out: np.savez(out, events=events),
        lambda out: np.savez_compressed(out, **columns),
        _zip_of_bytes,
    ):
        out = io.BytesIO()
        save(out)
        made.append(out.getvalue())
    return made


def _zip_of_bytes(out: io.BytesIO) -> None:
    """Members that are no arrays, though they have the names of some."""
    with zipfile.ZipFile(out, "w") as archive:
        for name in ("x", "y", "p", "t.npy", "a\nb.npy"):
            archive.writestr(name, b"\x93NUMPY no" if name == "y" else b"12")


def _hdf5_seeds() -> list[bytes]:
    import h5py

    def write(path: Path, options: dict[str, Any]) -> None:
        with h5py.File(path, "w") as root:
            root.attrs["geometry"] = "16x12"
            root.create_dataset("CD/events", data=some_events(30), **options)

    kinds: list[dict[str, Any]] = [{}, {"chunks": (8,)}, {"chunks": (16,), "compression": "gzip"}]
    kinds.append({"chunks": (10,), "fletcher32": True, "shuffle": True, "maxshape": (None,)})
    return [_written(functools.partial(_call, write, (kind,)), "seed.h5") for kind in kinds]


def _aedat4_seeds() -> list[bytes]:
    return [_aedat4(0, 4), _aedat4(0, 30), _aedat4(1, 30), _aedat4(3, 30)]


def _aedat4(compression: int, n: int) -> bytes:
    """A file of two packets of events and one of triggers, as DV lays them out, without an index."""
    pack: Callable[[bytes], bytes] = bytes
    if compression:
        pack = lz4.frame.compress if compression == 1 else zstandard.ZstdCompressor().compress
    streams = "".join(
        f"<node name='{number}'><attr key='typeIdentifier'>{kind}</attr><node name='info'>"
        "<attr key='sizeX'>16</attr><attr key='sizeY'>12</attr></node></node>"
        for number, kind in enumerate(("EVTS", "TRIG"))
    )
    description = f"<dv version='2.0'><node name='outInfo'>{streams}</node></dv>".encode()
    # A table: where its fields are, then the fields themselves, then what they point to.
    fields = struct.pack("<5H2x", 10, 20, 4, 8, 16)
    table = struct.pack("<iiqI", len(fields), compression, -1, 4) + struct.pack("<I", len(description))
    header = struct.pack("<I4s", 8 + len(fields), b"IOHE") + fields + table + description
    parts = [b"#!AER-DAT4.0\r\n", struct.pack("<I", len(header)), header]
    rows = np.zeros(n, "<i8,<i2,<i2,<u4")
    for column, field in zip(rows.dtype.names or (), "txyp", strict=True):
        rows[column] = some_events(n)[field]
    for kind, stream in ((b"EVTS", 0), (b"TRIG", 1), (b"EVTS", 0)):
        body = struct.pack("<I4s3H2xiII", 16, kind, 6, 8, 4, 8, 4, n) + rows.tobytes()
        packed = pack(struct.pack("<I", len(body)) + body)
        parts += [struct.pack("<2i", stream, len(packed)), packed]
    return b"".join(parts)


def _scene(n: int = 12) -> Events:
    return some_events(n)


def _evt21_seeds() -> list[bytes]:
    header = b"% evt 2.1\n% geometry 64x48\n% end\n"
    return [scenes.evt21(_scene(), header, is_swapped=is_swapped) for is_swapped in (False, True)]


def _aedat_seeds() -> list[bytes]:
    events = _scene()
    plain = [scenes.aedat1(events), scenes.aedat1(events, b""), scenes.aedat2(events), scenes.aedat3(events)]
    return [*plain, scenes.aedat2(events, "DVS128"), scenes.aedat2(events, "Davis346red")]


def _event_stream_seeds() -> list[bytes]:
    return [scenes.event_stream(_scene(), is_atis=is_atis) for is_atis in (False, True)]


def _table_seeds() -> list[bytes]:
    rows = list(_words(_scene()))
    forms = (
        ("t;x;y;p\n", lambda x, y, p, t: f"{t / 1e6:.6f};{x};{y};{p}".replace(".", ",")),
        ('"x","y","on","t_us"\r\n', lambda x, y, p, t: f'"{x}","{y}","{bool(p)}","{t}"\r'),
        ("%geometry:64,48\n", lambda x, y, p, t: f"{x},{y},{p},{t} # seen"),
        ("", lambda x, y, p, t: f"{x}\t{y}\t{p}\t{t / 1e6:.6f}".replace(".", ",")),
        ("id|t|x|y|p|of\n", lambda x, y, p, t: f"7|{t}|{x}|{y}|{2 * p - 1}|car"),
    )
    return [(head + "".join(f"{form(*row)}\n" for row in rows)).encode() for head, form in forms]


def _npy_seeds() -> list[bytes]:
    made = []
    for array in (scenes.table(_scene(), "txyp"), scenes.table(_scene(), "xytp").T.astype(">f4"), _scene()):
        out = io.BytesIO()
        np.save(out, array)
        made.append(out.getvalue())
    return made


def _ecf_seeds() -> list[bytes]:
    import h5py

    def write(path: Path, mode: int) -> None:
        scenes.ecf_file(h5py, path, [scenes.ecf(some_events(250), mode)])

    return [_written(functools.partial(_call, write, (mode,)), "seed.h5") for mode in (0, 1, 2)]


_XML_WORDS = (b"<node name='0'>", b"<attr key='sizeX'>", b"</node>", b"99999", b"<!DOCTYPE a>", b"EVTS")
_HEAD_WORDS = (b"% ", b"\n", b"% end\n", b"geometry ", b"640x480", b"width=", b"height=", b"%", b"evt 3.0")
_CAMERA_WORDS = (*_HEAD_WORDS, b"99999", b"0x0", b"format EVT3;", b"% Width 99999999\n", b"\x00\x08")
_AEDAT_WORDS = (b"#!AER-DAT1", b"#!AER-DAT2.0\r\n", b"# AEChip: DVS128\r\n", b"Davis640", b"#Format: RAW\r\n")
_ROW_WORDS = (
    b"1e999",
    b"nan",
    b"inf",
    b"-1",
    b"1e308",
    b",",
    b" ",
    b"\n",
    b"\r",
    b"#",
    b"0x1p3",
    b"1_0",
    b"t",
)
_NUMPY_WORDS = (
    b"<f8",
    b"|O8",
    b">i8",
    b"|b1",
    b"<f2",
    b"<c16",
    b"<M8[s]",
    b"(",
    b"()",
    b"99999999999",
    b"|S0",
)
_EVENT_LINES = (*_ROW_WORDS, b"0.1 1 2 1\n", b"x", b"99999999999999999999", b"\x0b", b"\x1c")

FILE_TARGETS = [
    Target(
        "recording",
        _recording_seeds,
        _read_recording,
        5_000,
        mend_mcap,
        most=16_384,
        memory=640 << 20,
        kernels=True,
    ),
    Target("recover", _recording_seeds, _recover_recording, 2_500, mend_mcap, most=16_384, memory=640 << 20),
    Target(
        "model",
        _model_seeds,
        _load_model,
        8_000,
        mend_tensors,
        words=_TENSOR_WORDS,
        memory=192 << 20,
        kernels=True,
    ),
    Target("classifier", _classifier_seeds, _load_classifier, 10_000, mend_tensors, words=_TENSOR_WORDS),
    *(
        Target(
            f"camera file {name}",
            seeds,
            functools.partial(_read_foreign, f"a.{ending}"),
            runs,
            mend,
            words,
            most=16_384 if runs < 5_000 else 4096,
            kernels=name in ("EVT3", "Event Stream"),
        )
        for name, ending, seeds, runs, mend, words in (
            ("DAT", "dat", _dat_seeds, 6_000, bytes, _CAMERA_WORDS),
            ("40-bit", "bin", _bin40_seeds, 6_000, bytes, ()),
            ("EVT2", "raw", _evt2_seeds, 6_000, bytes, _CAMERA_WORDS),
            ("EVT3", "raw", _evt3_seeds, 6_000, bytes, _CAMERA_WORDS),
            ("text", "txt", _text_seeds, 6_000, bytes, _EVENT_LINES),
            ("NumPy", "npz", _numpy_seeds, 4_000, mend_zip, _NUMPY_WORDS),
            ("HDF5", "h5", _hdf5_seeds, 12, bytes, ()),
            ("AEDAT4", "aedat4", _aedat4_seeds, 6_000, bytes, _XML_WORDS),
            ("EVT2.1", "raw", _evt21_seeds, 5_000, bytes, _CAMERA_WORDS),
            ("EVT4", "raw", lambda: [scenes.evt4(_scene(), b"% evt 4.0\n")], 5_000, bytes, _CAMERA_WORDS),
            ("AEDAT 1 to 3", "aedat", _aedat_seeds, 5_000, bytes, _AEDAT_WORDS),
            ("Event Stream", "es", _event_stream_seeds, 6_000, bytes, ()),
            ("table", "csv", _table_seeds, 6_000, bytes, (*_EVENT_LINES, b";", b"|", b'"', b"\r\n")),
            ("NumPy array", "npy", _npy_seeds, 5_000, bytes, _NUMPY_WORDS),
            ("ECF in HDF5", "h5", _ecf_seeds, 12, bytes, ()),
        )
    ),
]
