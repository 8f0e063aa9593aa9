"""What is measured on: real events, the updates they ask for, and encoders of any size.

Lives here: choosing a burst of events from a recording, spelling out its updates, building encoders.
Not here: timing.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import streamfeat as sf
from streamfeat.engine.window import count_window
from streamfeat.events import Events, Resolution
from streamfeat.learn import settings as learning
from streamfeat.learn.fit import geometry_of, learn_encoder
from streamfeat.learn.initial import random_directions
from streamfeat.learn.volumes import sample_volumes, windows_of
from streamfeat.learn.whitening import VolumeWhitener
from streamfeat.recordings.reader import Label, Sample

__all__ = ["Burst", "Material", "Setting", "Updates", "encoder_of", "encoder_of_volumes"]

_MOST_EVENTS = 2_000_000  # of a recording without labels


@dataclass(frozen=True)
class Setting:
    """What a part of the measurement is given.

    Attributes:
        material: events.
        quick: smallest sizes, only to see that everything runs.
        n_filters: `K` of the paper's geometry.
        n_bins: bins of the paper's geometry.
        models: folder where encoders that took long to learn are kept.
        say: called with what is being done.
    """

    material: "Material"
    quick: bool
    n_filters: int
    n_bins: int
    models: Path
    say: Callable[[str], None]

    def rounds(self, wanted: int) -> int:
        """Rounds of a race."""
        return 2 if self.quick else wanted

    def geometry(self, stride: int, **changes: int) -> sf.Geometry:
        """The paper's geometry, patch 12, with bins that share the length of a sample."""
        fields = {"patch": 12, "stride": stride, "n_bins": self.n_bins} | changes
        return sf.Geometry(**fields, bin_us=self.material.bin_us(fields["n_bins"]))


@dataclass(frozen=True)
class Burst:
    """Events of one bin, what came before them in the window, and the way back.

    Following `there_and_back` leaves an engine as it was: the same events in reverse order and of the other
    polarity take back what the events did. So a run can be repeated, with caches as they are in mid-stream.

    Attributes:
        resolution: `(height, width)` of the sensor.
        origin_us: start of bin 0.
        before: events of the window before the burst.
        events: the burst, all in the newest bin.
        there_and_back: the burst and its undoing.
    """

    resolution: Resolution
    origin_us: int
    before: Events
    events: Events

    @cached_property
    def there_and_back(self) -> Events:
        back = self.events[::-1].copy()
        back["p"] = 1 - back["p"]
        return np.concatenate([self.events, back])

    def engine(self, encoder: sf.Encoder, **options: Any) -> sf.Engine:
        """An engine that has seen what came before the burst."""
        engine = sf.Engine(encoder, self.resolution, origin_us=self.origin_us, **options)
        engine.feed(self.before)
        if len(self.events):
            engine.advance(int(self.events["t"].max()))
        engine.features()
        return engine


@dataclass(frozen=True)
class Updates:
    """One row for each event of a burst that changes a clipped count, and each volume that covers it.

    Attributes:
        rows: `(n, 4)` int32: volume, entry, count before, count after.
        changed: events that changed a clipped count, whether or not a volume covers them.
        counts: `(T, H, W)` int16, the clipped counts before the burst.
    """

    rows: NDArray[np.int32]
    changed: int
    counts: NDArray[np.int16]

    @classmethod
    def of(cls, burst: Burst, events: Events, geometry: sf.Geometry) -> "Updates":
        """Spell out what `events`, all of the burst's bin, do to volumes."""
        newest = int(burst.events["t"].max())
        counts = count_window(geometry, burst.before, burst.resolution, burst.origin_us, newest)
        unclipped = count_window(
            sf.Geometry(**_fields(geometry) | {"max_count": 2**14 - 1}),
            burst.before,
            burst.resolution,
            burst.origin_us,
            newest,
        )[-1].astype(int)
        limit, patch, stride = geometry.max_count, geometry.patch, geometry.stride
        shape = geometry.grid_shape(burst.resolution)
        rows, changed = [], 0
        for x, y, p in zip(*(events[name].tolist() for name in "xyp"), strict=True):
            row, column = y // geometry.downsample, x // geometry.downsample
            was = unclipped[row, column]
            now = unclipped[row, column] = was + 2 * p - 1
            before, after = (int(min(max(count, -limit), limit)) for count in (was, now))
            if before == after:
                continue
            changed += 1
            for r in _covering(row, shape[0], geometry):
                for c in _covering(column, shape[1], geometry):
                    inside = ((geometry.n_bins - 1) * patch + row - r * stride) * patch + column - c * stride
                    rows.append((r * shape[1] + c, inside, before, after))
        return cls(np.array(rows, np.int32).reshape(-1, 4), changed, counts)

    def volumes(self, geometry: sf.Geometry, resolution: Resolution) -> NDArray[np.int16]:
        """`(V, d)` all volumes before the burst."""
        rows, columns = geometry.grid_shape(resolution)
        side = geometry.patch
        places = np.lib.stride_tricks.sliding_window_view(self.counts, (side, side), axis=(1, 2))
        grid = places[
            :, : rows * geometry.stride : geometry.stride, : columns * geometry.stride : geometry.stride
        ]
        return np.ascontiguousarray(grid[:, :rows, :columns].transpose(1, 2, 0, 3, 4)).reshape(
            rows * columns, -1
        )


def _fields(geometry: sf.Geometry) -> dict[str, int]:
    return {name: getattr(geometry, name) for name in geometry.__dataclass_fields__}


def _covering(pixel: int, count: int, geometry: sf.Geometry) -> range:
    first = max(0, -(-(pixel - geometry.patch + 1) // geometry.stride))
    return range(first, min(count, pixel // geometry.stride + 1))


class Material:
    """Samples of one recording; a recording without labels is one sample.

    Args:
        path: MCAP file.
        most: samples to keep in memory, the first ones.
    """

    def __init__(self, path: Path, most: int = 400) -> None:
        self.path = path
        self.samples: list[Sample] = []
        with sf.open_recording(path) as recording:
            self.duration_us = (
                geometry_of(learning.Setting(bins=1), [recording]).window_us if recording.labels else 0
            )
            for sample in recording.samples():
                self.samples.append(sample)
                if len(self.samples) == most:
                    break
            if not self.samples:
                self.samples = [self._whole(recording)]
                self.duration_us = 100_000
        self.name = path.name

    @staticmethod
    def _whole(recording: Any) -> Sample:
        batches, n = [], 0
        for batch in recording:
            batches.append(batch)
            n += len(batch)
            if n >= _MOST_EVENTS:
                break
        events = np.concatenate(batches)
        events.sort(order="t", kind="stable")
        start = int(events["t"][0])
        return Sample(Label(start, int(events["t"][-1]) - start + 1, ""), events, recording.resolution)

    def describe(self) -> dict[str, Any]:
        """JSON values."""
        events = [len(sample.events) for sample in self.samples]
        return {"recording": self.name, "samples": len(events), "median_events": float(np.median(events))}

    def bin_us(self, n_bins: int) -> int:
        """Length of a bin, so that all share the length of a sample."""
        return max(1, -(-self.duration_us // n_bins))

    def fitting(self, patch: int) -> list[Sample]:
        """Samples whose sensor has room for a volume, those with most events first."""
        fits = [sample for sample in self.samples if min(sample.resolution) >= patch]
        return sorted(fits, key=lambda sample: -len(sample.events))

    def burst(self, geometry: sf.Geometry, most: int) -> Burst:
        """The sample with most events that fall into its last bin, which closes a full window."""
        best = None
        for sample in self.fitting(geometry.patch * geometry.downsample)[:50]:
            events = sample.events[np.argsort(sample.events["t"], kind="stable")]
            start = sample.label.start_us
            position = (events["t"] - start) // geometry.bin_us
            last = events[position == geometry.n_bins - 1]
            if best is None or len(last) > len(best.events):
                best = Burst(sample.resolution, start, events[position < geometry.n_bins - 1], last)
        assert best is not None, f"{self.path}: no sample has room for a volume"
        return Burst(best.resolution, best.origin_us, best.before, best.events[:most])

    def stream(self, most: int) -> tuple[Events, Resolution]:
        """The first samples one after the other, as recorded, and a sensor that holds them all."""
        parts, n = [], 0
        for sample in self.samples:
            parts.append(sample.events)
            n += len(sample.events)
            if n >= most:
                break
        events = np.concatenate(parts)[:most]
        return events, (int(events["y"].max()) + 1, int(events["x"].max()) + 1)

    def volumes(self, geometry: sf.Geometry, n: int) -> NDArray[np.int16]:
        """`(n, d)` random volumes of the recording that are not empty."""
        with sf.open_recording(self.path) as recording:
            windows = windows_of(recording.items(), geometry)
            few = (window for window, _ in zip(windows, range(max(20, n // 32)), strict=False))
            return sample_volumes(few, geometry, n, (0,)).counts


def encoder_of_volumes(
    material: Material,
    geometry: sf.Geometry,
    n_filters: int,
    formulation: Any = "direct",
    encoding: Any = "soft",
    *,
    n_volumes: int = 4000,
    **parameters: Any,
) -> sf.Encoder:
    """An encoder of whitened volumes drawn at random: as dear as a learned one, and made at once."""
    volumes = material.volumes(geometry, n_volumes)
    whitener = VolumeWhitener().fit(volumes)
    rng = np.random.RandomState(0)
    white = whitener.transform(volumes)
    filters = random_directions(white, np.square(white).sum(axis=1), n_filters, rng)
    parameters = {"threshold": 1.0 if formulation == "inverse" else 0.5} | parameters
    return sf.Encoder.build(
        geometry,
        formulation=formulation,
        encoding=encoding,
        filters=filters,
        whitening=whitener.whitening_,
        mean=whitener.mean_,
        eps=whitener.eps,
        **parameters,
    )


def encoder_of(
    setting: Setting, geometry: sf.Geometry, n_filters: int, formulation: Any, encoding: Any
) -> sf.Encoder:
    """An encoder learned from the recording, quickly; kept in the folder of models for the next run."""
    fields = "-".join(str(value) for value in _fields(geometry).values())
    name = f"{setting.material.path.stem}-{fields}-{n_filters}-{formulation}-{encoding}.safetensors"
    path = setting.models / name
    if path.exists():
        return sf.Encoder.load(path)
    setting.say(f"learning {n_filters} filters, {formulation}")
    with sf.open_recording(setting.material.path) as recording:
        encoder = learn_encoder(
            [recording],
            learning.Setting(
                formulation=formulation,
                encoding=encoding,
                filters=n_filters,
                bins=geometry.n_bins,
                window_ms=geometry.window_us / 1000,
                volumes=1_500 if setting.quick else 6000,
                iterations=1 if setting.quick else 3,
                **{name: value for name, value in _fields(geometry).items() if name in learning.DEFAULTS},
            ),
        )
    setting.models.mkdir(parents=True, exist_ok=True)
    encoder.save(path)
    return encoder


DEFAULT_MODELS = Path(tempfile.gettempdir()) / "streamfeat-bench"
