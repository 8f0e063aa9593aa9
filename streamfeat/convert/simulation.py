"""Images and films -> simulated events -> one recording.

Lives here: how a folder of images becomes labelled samples, and a film one recording.
Not here: the camera, its motion and the files that it looks at (`streamfeat.simulate`).

Each sample depends on the seed, its path within the folder, and its image alone: the same bits on any number
of workers, with any `limit`, in any order.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from streamfeat.convert.datasets import Conversion, KnownSet, Look, Measured, find_samples, write_samples
from streamfeat.convert.splits import chosen
from streamfeat.denoise.stage import Denoiser, Denoising
from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution
from streamfeat.recordings.reader import Label
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.simulate.camera import CameraModel, EventCamera
from streamfeat.simulate.films import Film
from streamfeat.simulate.pictures import IMAGE_ENDINGS, load_picture, on_monitor
from streamfeat.simulate.saccades import Saccades, simulate_saccades
from streamfeat.work.workers import THIS_PROCESS, Workers

__all__ = [
    "BORDERS",
    "MONITOR_CAMERA",
    "Border",
    "Scene",
    "is_image_folder",
    "simulate_film",
    "simulate_images",
    "simulated_image",
]

MONITOR_CAMERA = CameraModel(resolution=(180, 240), threshold=0.28)
"""The camera of N-Caltech101. Its threshold is the one parameter that was chosen by measurement: with it
images of faces give as many events as the real sample of one (tools/compare_simulation.py)."""

Border = Literal["crop", "black", "edge"]
BORDERS: tuple[str, ...] = get_args(Border)

_NOTHING = Measured((), (1, 1), 0, 0, 0)
_CHUNK_US = 1_000_000
"""Events of a film are written about once in so much of its time."""
_LEAST_PX = 8


@dataclass(frozen=True, slots=True)
class Scene:
    """What stands before the camera, and how it moves.

    Attributes:
        camera: the sensor; its resolution is the largest that a sample has.
        amplitude_px: how far the image moves from its centre, to each side, in pixels.
        border: `crop`: the image is as large as fits, and the sensor as large as the part of it that never
            leaves the view, so that no border is ever seen, as in N-Caltech101, whose one sample here is 7
            pixels smaller than its image. `black`: the sensor has its whole resolution, the image is as large
            as fits at any moment, and all around is black. `edge`: the same, but all around is as the image's
            border, as in N-MNIST, whose digits are dark on a bright screen.
        gamma: exponent from what an image says to its light on a monitor.
        seed: of the background noise; that of the sensor's mismatch is the camera's.

    Raises:
        InputError: a value makes no sense.
    """

    camera: CameraModel = MONITOR_CAMERA
    amplitude_px: float = 3.5
    border: Border = "crop"
    gamma: float = 2.2
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what makes no sense."""
        if self.border not in BORDERS:
            raise InputError(f"--border {self.border} is unknown; choose from {', '.join(BORDERS)}")
        if not 0 < self.amplitude_px <= 100:
            raise InputError(
                f"--amplitude {self.amplitude_px:g} is not possible; give pixels, from above 0 to 100"
            )
        if not 0.1 <= self.gamma <= 10:
            raise InputError(f"--gamma {self.gamma:g} is not possible; give 1, 2.2 or so")
        if min(self.camera.resolution) - self.margin_px < _LEAST_PX:
            raise InputError(
                f"a sensor of {self.camera.resolution[1]}x{self.camera.resolution[0]} is too small for an "
                f"image that moves by {self.margin_px} pixels; give a larger --resolution or a smaller "
                "--amplitude"
            )

    @property
    def margin_px(self) -> int:
        """Pixels that the image moves, all in all."""
        return round(2 * self.amplitude_px)


def is_image_folder(place: Path) -> bool:
    """Whether a folder has no images right inside, so that it is a data set and no film."""
    return place.is_dir() and not any(path.suffix.lower() in IMAGE_ENDINGS for path in place.iterdir())


def simulate_images(
    source: Path,
    out: Path,
    scene: Scene,
    *,
    overwrite: bool = False,
    gap_us: int = 1_000_000,
    split: str | None = None,
    hold_out: tuple[int, int] | None = None,
    interleaved: int | None = None,
    limit: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    workers: Workers = THIS_PROCESS,
) -> Conversion:
    """Show each image of a folder LABEL/IMAGE to a camera that makes three saccades, and record it.

    Labels, splits, sources and the time between samples are as those of `datasets.convert`.

    Args:
        source: the folder.
        out: the recording to write. It appears only when all is written.
        scene: the camera and its motion.
        overwrite: as of `datasets.convert`, and so are the others.
        gap_us: see there.
        split: see there.
        hold_out: see there.
        interleaved: see there.
        limit: see there.
        progress: see there.
        workers: read images and simulate; the recording is written here.

    Raises:
        InputError: there is no image, or none can be read, `out` cannot be written, or an argument is out of
            range.
    """
    samples = chosen(find_samples(source, IMAGE_ENDINGS), gap_us, split, hold_out, interleaved, limit)
    known = KnownSet(3 * Saccades().saccade_us, None)
    with RecordingWriter(out, overwrite=overwrite) as writer:
        looks = workers.map(_look, ((sample.path, sample.source) for sample in samples), scene)
        done = write_samples(samples, known, gap_us, writer, Denoiser(Denoising()), progress, looks)
    return replace(done, bytes_out=out.stat().st_size)


def simulate_film(
    film: Film,
    out: Path,
    scene: Scene,
    *,
    label: Label | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Conversion:
    """Show a film to a camera that stands still, and record it, from time 0, in bounded memory.

    Between two frames log intensity is linear in time: no frames are made up in between, as VID2E (Gehrig et
    al. 2020, "Video to Events", section 3.1) does, so what moves by more than a pixel a frame fades over.

    Args:
        film: its resolution is the sensor's.
        out: the recording to write. It appears only when all is written.
        scene: the camera; the film itself moves.
        label: of the whole film; its times are set here.
        overwrite: as of `datasets.convert`.
        progress: called with frames done and frames in all.

    Raises:
        InputError: no two frames can be read, or `out` cannot be written.
    """
    camera = replace(scene.camera, resolution=film.resolution)
    seeing = EventCamera(camera, np.random.default_rng(scene.seed))
    n_frames = n_events = 0
    written_us = t_us = 0
    with RecordingWriter(out, overwrite=overwrite) as writer:
        if label is not None:
            writer.write_label(replace(label, start_us=0, duration_us=max(film.duration_us, 1)))
        for t_us, frame in film:
            seeing.see(np.log(camera.black_level + on_monitor(frame, scene.gamma)), t_us)
            n_frames += 1
            if t_us - written_us >= _CHUNK_US:
                written_us = t_us
                n_events += _write(writer, seeing, camera.resolution)
            if progress:
                progress(n_frames, film.n_frames)
        if n_frames < 2:
            why = f": {film.damage[0]}" if film.damage else ""
            raise InputError(f"the film has {n_frames} frames that can be read, nothing can change{why}")
        n_events += _write(writer, seeing, camera.resolution, last=True)
    damaged = [(out, line) for line in film.damage]
    return Conversion(1, n_events, [], list(damaged), 0, out.stat().st_size)


def _write(
    writer: RecordingWriter, seeing: EventCamera, resolution: Resolution, *, last: bool = False
) -> int:
    events = seeing.events(last=last)
    writer.write_events(events, resolution)
    return len(events)


def simulated_image(path: Path, source: str, scene: Scene) -> tuple[Events, Resolution]:
    """The events of one image, at times from 0, and the resolution of its sensor.

    Args:
        path: of the image.
        source: its name in the data set, which decides its noise beside the seed.
        scene: the camera and its motion.

    Raises:
        InputError: the image cannot be read, or gives no events.
    """
    full, margin = scene.camera.resolution, scene.margin_px
    box = full if scene.border == "crop" else (full[0] - margin, full[1] - margin)
    picture = on_monitor(load_picture(path, box), scene.gamma)
    rows, columns = picture.shape
    if scene.border == "crop":
        full = rows - margin, columns - margin
        if min(full) < _LEAST_PX:
            raise InputError(
                f"{path}: is {columns}x{rows} pixels on the sensor, too narrow to move by {margin}; "
                "--border black shows all of it"
            )
    if scene.border != "black" and np.ptp(picture) == 0:
        raise InputError(f"{path}: is all of one grey; nothing changes where it moves")
    amplitude = scene.amplitude_px, scene.amplitude_px
    saccades = Saccades(image_px=max(rows, columns), amplitude_px=amplitude)
    rng = np.random.default_rng([scene.seed, zlib.crc32(source.encode())])
    camera = replace(scene.camera, resolution=full)
    events = simulate_saccades(picture, rng, camera, saccades, goes_on=scene.border != "black")
    if not len(events):
        raise InputError(f"{path}: gives no events; is it all of one grey?")
    return events, full


def _look(path: Path, source: str, scene: Scene) -> Look:
    """One image as `write_samples` takes it."""
    try:
        events, resolution = simulated_image(path, source, scene)
    except InputError as error:
        return Look(_NOTHING, error=str(error))
    first_us, last_us = int(events["t"][0]), int(events["t"][-1])
    return Look(Measured((events,), resolution, len(events), first_us, last_us), size=path.stat().st_size)
