"""Films: videos, and folders of frames, as grey frames with times.

Lives here: opening either, and reading it frame by frame in bounded memory.
Not here: single images (`pictures`), and what a camera sees in a film (`camera`).
"""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.events import Resolution
from streamfeat.files.locations import natural_order
from streamfeat.simulate.pictures import IMAGE_ENDINGS, MOST_PIXELS, fitted_size, load_picture

__all__ = ["Film", "FrameFolder", "Video", "open_film"]


class Film(Protocol):
    """A film; iterating yields `(t_us, frame)`, times increasing from 0, frames `(height, width)` float64.

    Attributes:
        resolution: `(height, width)` of the frames that are yielded.
        n_frames: how many there are, as far as is known before they are read.
        duration_us: time of the last of them.
        damage: what the last iteration could not read, a line for each reason.
    """

    resolution: Resolution
    n_frames: int
    duration_us: int
    damage: list[str]

    def __iter__(self) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """Read it from the beginning."""


class FrameFolder:
    """A folder of images as a film, in the order of their names with numbers as numbers.

    Args:
        folder: with the images right inside.
        fps: frames a second.
        box: largest `(height, width)`; None for the size of the first frame.

    Raises:
        InputError: there are fewer than two images, or the first cannot be read.
    """

    def __init__(self, folder: Path, fps: float, box: Resolution | None) -> None:
        """Read the first image."""
        names = (path for path in folder.iterdir() if path.suffix.lower() in IMAGE_ENDINGS)
        self._frames = sorted(names, key=lambda path: natural_order(path.name))
        self._folder, self._fps, self.damage = folder, fps, list[str]()
        self.n_frames = len(self._frames)
        if self.n_frames < 2:
            raise InputError(
                f"{folder}: a film needs two images right inside, this has {self.n_frames}; a data set has "
                "folders LABEL/IMAGE"
            )
        self._box = box or (1 << 14, 1 << 14)
        self.resolution = load_picture(self._frames[0], self._box, enlarge=False).shape
        self.duration_us = self._time(self.n_frames - 1)

    def _time(self, i: int) -> int:
        return round(i * 1e6 / self._fps)

    def __iter__(self) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """See `Film`; an image that cannot be read, or of another shape, is left out."""
        self.damage = []
        for i, path in enumerate(self._frames):
            try:
                frame = load_picture(path, self._box, enlarge=False)
                if frame.shape != self.resolution:
                    raise InputError(f"{path}: has other proportions than the first frame")
            except InputError as error:
                self.damage.append(str(error))
            else:
                yield self._time(i), frame


class Video:
    """A video file, decoded by FFmpeg through PyAV; the first video stream.

    Args:
        path: the file.
        box: largest `(height, width)`; None for the size of the video.

    Raises:
        InputError: PyAV is not there; the file cannot be read, or has no frames.
    """

    def __init__(self, path: Path, box: Resolution | None) -> None:
        """Look at all packets, without decoding them."""
        try:
            import av
        except ImportError:
            raise InputError(
                f"{path}: reading videos needs PyAV: pip install 'streamfeat[simulate]'"
            ) from None
        self._av, self._path, self.damage = av, path, list[str]()
        times: list[int] = []
        with self._opened() as container:
            stream = self._stream(container)
            size = stream.codec_context.height, stream.codec_context.width
            rate = stream.average_rate or Fraction(30)
            unit = stream.time_base or 1 / rate
            try:
                for packet in container.demux(stream):
                    if packet.size:
                        times.append(
                            packet.pts if packet.pts is not None else round(len(times) / rate / unit)
                        )
            except av.error.FFmpegError:
                pass  # it is told where the frames are read
        self.n_frames = len(times)
        if not times or min(size) < 1:
            raise InputError(f"{path}: is a video without frames")
        if size[0] * size[1] > MOST_PIXELS:
            raise InputError(
                f"{path}: is {size[1]}x{size[0]} pixels, more than {MOST_PIXELS:,}; make it smaller"
            )
        self._unit_us = unit * 1_000_000
        self.duration_us = round((max(times) - min(times)) * self._unit_us)
        self.resolution = fitted_size(size, box or size, enlarge=False)

    def _opened(self) -> Any:
        try:
            return self._av.open(str(self._path))
        except (self._av.error.FFmpegError, OSError, ValueError) as error:
            raise InputError(f"{self._path}: is no video that can be read ({error})") from None

    def _stream(self, container: Any) -> Any:
        if not container.streams.video:
            raise InputError(f"{self._path}: has no video stream")
        return container.streams.video[0]

    def __iter__(self) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """See `Film`; frames whose time is not later than the one before are left out."""
        self.damage = []
        height, width = self.resolution
        first: int | None = None
        at_us, late = -1, 0
        with self._opened() as container:
            stream = self._stream(container)
            try:
                for i, frame in enumerate(container.decode(stream)):
                    pts = frame.pts if frame.pts is not None else i
                    first = pts if first is None else first
                    t_us = round((pts - first) * self._unit_us)
                    if t_us <= at_us:
                        late += 1
                        continue
                    at_us = t_us
                    grey = frame.reformat(width, height, "gray").to_ndarray()
                    yield t_us, grey.astype(np.float64) / 255.0
            except self._av.error.FFmpegError as error:
                self.damage.append(
                    f"{self._path}: ends after {max(at_us, 0) / 1e6:.3f} s, it is damaged ({error})"
                )
        if late:
            self.damage.append(f"{self._path}: {late} frames are not later than the one before, and left out")


def open_film(place: Path, box: Resolution | None, fps: float | None = None) -> Film:
    """Open a video, or a folder with frames right inside.

    Args:
        place: the file or folder.
        box: largest `(height, width)`; None for the size of the film. It is never enlarged.
        fps: frames a second of a folder, 30 if not given; a video has its own.

    Raises:
        InputError: there is none, or `fps` is given for a video.
    """
    if place.is_dir():
        return FrameFolder(place, fps or 30.0, box)
    if not place.is_file():
        raise InputError(f"{place}: does not exist")
    if fps is not None:
        raise InputError(f"{place}: is a video, which has times of its own; --fps is for folders of frames")
    return Video(place, box)
