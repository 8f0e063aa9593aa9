"""Folders of foreign event files -> labelled samples -> one recording.

Lives here: the folder layouts of data sets, where samples stand in time, and the conversion to MCAP.
Not here: the formats of single files (`event_files`) and MCAP itself (`streamfeat.recordings.writer`).
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from streamfeat.camera_files.event_files import EXTENSIONS
from streamfeat.convert.sample_files import RECORDED, bytes_of, is_recorded, open_sample
from streamfeat.convert.splits import SamplePath, chosen, split_named
from streamfeat.denoise.stage import Denoiser, Denoising
from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution
from streamfeat.files.locations import Location, StoreLocation, fetched, files_below, is_folder, location_of
from streamfeat.recordings.bags import METADATA, is_bag
from streamfeat.recordings.reader import Label
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.work.workers import THIS_PROCESS, Workers

__all__ = [
    "Conversion",
    "KnownSet",
    "Look",
    "Measured",
    "SamplePath",
    "convert",
    "find_samples",
    "is_data_set",
    "write_samples",
]

_ENDINGS = (*EXTENSIONS, *RECORDED)
_LONGEST_SAMPLE_US = 3_600_000_000  # an hour; one damaged time must not push all later samples away
_HELD_IN_MEMORY = 2 << 20  # bytes of a file, at most 96 times that in events; larger files are read twice


@dataclass(frozen=True, slots=True)
class Conversion:
    """Result of a conversion: counts of what was written, and a line for each file with a fault.

    `failed` files are not in the recording; of `damaged` files, all that could be read is.
    `bytes_in` counts the files that were converted, `bytes_out` the recording; `removed` the events that were
    taken out as noise, by reason.
    """

    samples: int
    events: int
    failed: list[tuple[Location, str]]
    damaged: list[tuple[Location, str]]
    bytes_in: int
    bytes_out: int
    removed: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class KnownSet:
    """Facts of a data set that stand in its documentation and not in its files."""

    duration_us: int
    """Nominal length of a sample."""
    resolution: Resolution | None
    """`(height, width)` of every sample, None where each has its own."""


# In these the clock of a file starts with the sample. N-CARS: Sironi et al. (2018), crops of 100 ms, first
# event always at 0. N-MNIST and N-Caltech101: Orchard et al. (2015), three saccades of 100 ms, first event up
# to 7 ms after the start; some files run on to 316 ms.
_NCARS = KnownSet(100_000, None)
_NMNIST = KnownSet(300_000, (34, 34))
_NCALTECH101 = KnownSet(300_000, None)


@dataclass(frozen=True, slots=True)
class Measured:
    """One file after a first look: its batches (in memory, or read again) and what all of them show."""

    batches: Iterable[Events]
    resolution: Resolution
    n: int
    first_us: int
    last_us: int


_NOTHING = Measured((), (1, 1), 0, 0, 0)


@dataclass(frozen=True, slots=True)
class Look:
    """The outcome of reading one file, and its bytes."""

    file: Measured
    damage: str = ""
    size: int = 0
    error: str = ""


def is_data_set(place: Location) -> bool:
    """Whether a place is a folder of samples: one with files of a bag right inside is a recording."""
    return is_folder(place) and not is_bag(place)


def find_samples(folder: str | Path | StoreLocation, endings: tuple[str, ...] = _ENDINGS) -> list[SamplePath]:
    """Find the labelled samples of a data set folder.

    A sample is a file of a known kind; its label is the name of the folder it is in. The nearest folder above
    the label whose name ends in train, test, validation or a usual variant (`Train`, `n-cars_test`) gives the
    split; `folder` itself counts. Hidden files, folders of annotations, and files without a label are passed
    over. A rosbag2 folder, known by its `metadata.yaml`, is one sample, and so is a link that leads nowhere:
    it cannot be read, and is listed.

    Args:
        folder: or its URL.
        endings: of the names of files that are samples, in small letters.

    Returns:
        Samples sorted by `source`, their path relative to `folder` with forward slashes.

    Raises:
        InputError: there is no such folder, or no sample in it.
    """
    folder = location_of(folder)
    if not is_folder(folder):
        raise InputError(f"{folder}: is no folder")
    samples = []
    name = folder.name if isinstance(folder, StoreLocation) else folder.resolve().name
    files = [*_files(folder)]
    bags = {source.rpartition("/")[0] for _, source in files if source.rpartition("/")[2] == METADATA}
    for path, source in _outside_bags(files, bags):
        *above, _ = parts = source.split("/")
        hidden = any(part.startswith(".") or part.endswith("_annotations") for part in parts)
        leads_nowhere = isinstance(path, Path) and not path.exists()  # it may have been a folder
        is_sample = source in bags or path.name.lower().endswith(endings) or leads_nowhere
        if hidden or not is_sample or not (above or leads_nowhere):
            continue
        if len(above) == 1 and split_named(above[0]) and not leads_nowhere:
            continue  # a file right inside a split has no label
        split = next(filter(None, map(split_named, [*above[-2::-1], name])), "")
        samples.append(SamplePath(path, above[-1] if above else path.name, split, source))
    if not samples:
        raise InputError(
            f"{folder}: holds no samples; expected LABEL/FILE or SPLIT/LABEL/FILE with files ending in "
            f"{' '.join(sorted(endings))}"
        )
    return sorted(samples, key=lambda sample: sample.source)


def _outside_bags(files: Iterable[tuple[Location, str]], bags: set[str]) -> Iterator[tuple[Location, str]]:
    """Files of no bag, and each bag's folder."""
    for path, source in files:
        inside, _, name = source.rpartition("/")
        if inside not in bags:
            yield path, source
        elif name == METADATA:
            yield _folder_of(path, name), inside


def _folder_of(path: Location, name: str) -> Location:
    """The folder of a file of this name."""
    if isinstance(path, Path):
        return path.parent
    if path.inside:
        return replace(path, inside=path.inside.removesuffix(f"/{name}"))
    return StoreLocation(path.url.replace(f"/{name}", "", 1))


def _files(folder: Location) -> Iterable[tuple[Location, str]]:
    """Files in a folder, however deep, each with its path from there."""
    if isinstance(folder, StoreLocation):
        return files_below(folder)
    return _local_files(folder, folder, frozenset())


def _local_files(folder: Path, top: Path, above: frozenset[tuple[int, int]]) -> Iterator[tuple[Path, str]]:
    """Files below a folder, those of folders that are links too, unless one leads back to where it is.

    Raises:
        InputError: a folder may not be entered: its samples would be missing without a word.
    """
    try:
        about = folder.stat()
        inside = sorted(folder.iterdir())
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be entered: {error.strerror}; its samples would be missing"
        ) from None
    if (about.st_dev, about.st_ino) in above:
        return
    for path in inside:
        if path.is_dir():
            yield from _local_files(path, top, above | {(about.st_dev, about.st_ino)})
        elif path.is_file() or path.is_symlink():
            # A link that leads nowhere is a sample that cannot be read, and is reported as one.
            yield path, path.relative_to(top).as_posix()


def convert(
    source: str | Path | StoreLocation,
    out: str | Path | StoreLocation,
    *,
    overwrite: bool = False,
    gap_us: int = 1_000_000,
    split: str | None = None,
    hold_out: tuple[int, int] | None = None,
    interleaved: int | None = None,
    encoding: str = "mono",
    compression: Literal["zstd", "lz4", "none"] = "zstd",
    limit: int | None = None,
    denoising: Denoising | None = None,
    progress: Callable[[int, int], None] | None = None,
    workers: Workers = THIS_PROCESS,
) -> Conversion:
    """Convert a data set folder to a recording.

    Samples follow each other in order of their relative paths, each announced by its label, with silence of
    `gap_us` before each and between one's nominal end and the next. In N-CARS, N-MNIST and N-Caltech101 the
    start of a sample is time 0 of its file; elsewhere it is the first event. A label lasts the nominal
    duration of its data set, or to its last event where that is later or nothing is nominal.

    Of a source in a store one file at a time is fetched; one that is not given ends the conversion.

    Args:
        source: the folder, or its URL.
        out: the recording to write, a local file. It appears only when all is written.
        overwrite: replace `out` where it exists.
        gap_us: silence between samples in microseconds, positive; at least one window of the encoder to be.
        split: name for the split of all samples, instead of what their folders say.
        hold_out: `(i, n)`: block `i` of `n`, of neighbours in each class, is split "validation" and the
            others "train", see `splits.hold_out_block`. Samples in test folders stay "test".
        interleaved: every such sample (5: index 4, 9, ...) is split "validation" instead. Where neighbours
            are near copies, as in what was cut from video, such samples are not held out.
        encoding: of the packets, see `streamfeat.messages.codecs.PAYLOAD_ENCODINGS`.
        compression: of the chunks, see `RecordingWriter`.
        limit: convert only so many samples, as many of each label as the others have.
        denoising: noise to take out of each sample.
        progress: called with samples done and samples in all, after each.
        workers: read the files, but for large ones; the recording is written here.

    Raises:
        InputError: `source` cannot be read at all, `out` cannot be written, or an argument is out of range.
    """
    source, out = location_of(source), location_of(out)
    if isinstance(out, StoreLocation):
        raise InputError(f"{out}: recordings are written to local files; give one, and copy it to the store")
    samples = find_samples(source)
    data_set = _recognise(samples)
    samples = chosen(samples, gap_us, split, hold_out, interleaved, limit)
    denoiser = Denoiser(denoising or Denoising())
    with RecordingWriter(out, encoding=encoding, compression=compression, overwrite=overwrite) as writer:
        looks = workers.map(_look, ((sample.path, data_set) for sample in samples))
        done = write_samples(samples, data_set, gap_us, writer, denoiser, progress, looks)
    return replace(done, bytes_out=out.stat().st_size, removed=denoiser.removed)


def _of_place(error: InputError, path: Location, place: Location) -> str:
    """An error with the name of the file that the user gave."""
    return str(error).replace(str(path), str(place))


def _write_events(
    path: Location, file: Measured, shift_us: int, writer: RecordingWriter, denoiser: Denoiser
) -> int:
    """Write the events of a sample without their noise; return how many."""
    denoiser.restart()
    n = 0
    for batch in file.batches:
        moved = (denoiser.events(batch, file.resolution) if denoiser.denoising else batch).copy()
        n += len(moved)
        moved["t"] += shift_us
        try:
            writer.write_events(moved, file.resolution)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    return n


def write_samples(
    samples: Sequence[SamplePath],
    data_set: KnownSet | None,
    gap_us: int,
    writer: RecordingWriter,
    denoiser: Denoiser,
    progress: Callable[[int, int], None] | None,
    looks: Iterable["Look | None"],
) -> Conversion:
    """Write samples one after the other, each with its label before it and a silence of `gap_us` behind it.

    Args:
        samples: in the order in which they are written.
        data_set: nominal facts; None where each sample begins with its first event and ends with its last.
        gap_us: see `convert`.
        writer: open.
        denoiser: takes noise out of each.
        progress: see `convert`.
        looks: of each sample what was found in it; None for one that is to be read here.

    Raises:
        InputError: no sample can be read, or one cannot be written.
    """
    failed, damaged = [], []
    n_events, bytes_in, start_us = 0, 0, gap_us
    for done, (sample, look) in enumerate(zip(samples, looks, strict=True), 1):
        with contextlib.ExitStack() as copies:
            if look is None:  # it is large
                look = _look_at(copies.enter_context(_local(sample.path)), sample.path, data_set)
            if look.error:
                failed.append((sample.path, look.error))
            else:
                origin_us, file = 0 if data_set else look.file.first_us, look.file
                nominal_us = data_set.duration_us if data_set else 0
                duration_us = max(nominal_us, file.last_us - origin_us + 1)
                writer.write_label(Label(start_us, duration_us, sample.label, sample.split, sample.source))
                n_events += _write_events(sample.path, file, start_us - origin_us, writer, denoiser)
                start_us += duration_us + gap_us
                bytes_in += look.size
                if look.damage:
                    damaged.append((sample.path, look.damage))
        if progress:
            progress(done, len(samples))
    if len(failed) == len(samples):
        raise InputError(f"none of the {len(samples)} samples can be read; the first: {failed[0][1]}")
    return Conversion(len(samples) - len(failed), n_events, failed, damaged, bytes_in, 0)


def _look(place: Location, data_set: KnownSet | None) -> "Look | None":
    """Read a file, if it is small enough to be held."""
    with _local(place) as path:
        with contextlib.suppress(OSError, InputError):  # what is wrong with it is found when it is read
            if bytes_of(path) > _HELD_IN_MEMORY:
                return None
        return _look_at(path, place, data_set)


def _local(place: Location) -> contextlib.AbstractContextManager[Location]:
    """Where a sample is read: recordings in a store are read there, of other files a copy is made."""
    return contextlib.nullcontext(place) if is_recorded(place) else fetched(place)


def _look_at(path: Location, place: Location, data_set: KnownSet | None) -> "Look":
    """Read a file, which is at `path` now."""
    try:
        file, damage = _measure(path, data_set)
        if file.last_us - (0 if data_set else file.first_us) >= _LONGEST_SAMPLE_US:
            raise InputError(f"{path}: lasts to {file.last_us} us, longer than an hour; damaged?")
    except InputError as error:
        return Look(_NOTHING, error=_of_place(error, path, place))
    return Look(file, damage, bytes_of(path))


def _measure(path: Location, data_set: KnownSet | None) -> tuple[Measured, str]:
    """Read a file once, for its extent in space and time; hold its events only when it is small."""
    file = open_sample(path)
    batches: Iterable[Events] = file if is_recorded(path) or bytes_of(path) > _HELD_IN_MEMORY else [*file]
    resolution = data_set.resolution if data_set else None
    n, height, width, first_us, last_us = 0, 1, 1, np.iinfo(np.int64).max, 0
    for batch in batches:
        if len(batch):
            n += len(batch)
            height, width = max(height, int(batch["y"].max()) + 1), max(width, int(batch["x"].max()) + 1)
            first_us, last_us = min(first_us, int(batch["t"].min())), max(last_us, int(batch["t"].max()))
    if n == 0:
        raise InputError(f"{path}: holds no events")
    resolution = resolution or file.declared or (height, width)
    if height > resolution[0] or width > resolution[1]:
        raise InputError(
            f"{path}: events cover {width}x{height} pixels, its data set {resolution[1]}x{resolution[0]}"
        )
    return Measured(batches, resolution, n, first_us, last_us), "; ".join(file.damage)


def _recognise(samples: Sequence[SamplePath]) -> KnownSet | None:
    labels = {sample.label for sample in samples}
    endings = {sample.path.suffix.lower() for sample in samples}
    if endings == {".dat"} and labels <= {"cars", "background"}:
        return _NCARS
    if endings == {".bin"}:
        return _NMNIST if labels <= set("0123456789") else _NCALTECH101
    return None
