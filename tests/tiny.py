"""Tiny models, streams and recordings that several test modules share."""

import numpy as np

from streamfeat.classify.classifier import Classifier
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.events import make_events
from streamfeat.learn.volumes import sample_volumes, windows_of
from streamfeat.learn.whitening import VolumeWhitener
from streamfeat.recordings.reader import Label, Packet, open_recording
from streamfeat.recordings.writer import RecordingWriter
from streamfeat.simulate.saccades import Saccades, digit_samples

GEOMETRY = Geometry(patch=4, stride=4, n_bins=2, bin_us=50_000, max_count=2)
"""A window of 100 ms."""

RESOLUTION = (12, 16)


def encoder(formulation="direct", encoding="split", *, k=5, geometry=GEOMETRY, seed=0):
    """An encoder of random filters."""
    return random_encoder(seed, geometry, k, formulation, encoding, threshold=0.3, whitening=0.0)


def classifier(model, labels=("cat", "dog", "owl"), seed=0):
    """A classifier of random weights that fits the model."""
    rng = np.random.default_rng(seed)
    n, columns = model.n_features, 1 if len(labels) == 2 else len(labels)
    return Classifier(
        labels=tuple(labels),
        centre=rng.standard_normal(n).astype(np.float32) / 10,
        scale=rng.uniform(0.5, 2, n).astype(np.float32),
        weights=rng.standard_normal((n, columns)).astype(np.float32),
        bias=rng.standard_normal(columns).astype(np.float32),
        fingerprint=model.fingerprint,
        provenance={"seed": seed},
    )


def stream(times, seed=0, resolution=RESOLUTION):
    """Events at the given times, at random pixels."""
    rng = np.random.default_rng(seed)
    t = np.asarray(times, np.int64)
    height, width = resolution
    n = len(t)
    return make_events(rng.integers(0, width, n), rng.integers(0, height, n), rng.integers(0, 2, n), t)


def white_volumes(n=400, d=12, seed=0):
    """Sparse combinations of a few directions, and noise: what learners learn from."""
    rng = np.random.default_rng(seed)
    codes = rng.standard_normal((n, 8)) * (rng.random((n, 8)) < 0.3)
    x = codes @ rng.standard_normal((8, d)) + 0.2 * rng.standard_normal((n, d))
    return x.astype(np.float32)


def real_white_volumes(shared_data, n=1500):
    """Whitened local volumes of a real recording, `(n, 72)`."""
    geometry = Geometry(patch=6, stride=6, n_bins=2, bin_us=5_000, max_count=1)
    with open_recording(shared_data / "samples/eventpacket_libcaer_cmp_346x260.mcap") as recording:
        windows = windows_of(recording.items(), geometry)
        counts = sample_volumes(windows, geometry, n, (0,)).counts
    return VolumeWhitener().fit_transform(counts)


def steady(start_us, stop_us, n, seed=0, resolution=RESOLUTION):
    """`n` events at sorted random times of `[start_us, stop_us)`."""
    times = np.sort(np.random.default_rng(seed + 1000).integers(start_us, stop_us, n))
    return stream(times, seed, resolution)


def packet(events, resolution=RESOLUTION):
    """A packet as a recording gives it."""
    return Packet("/events", events, resolution, 0, 0)


def labelled_items(n=4, *, names=("cat", "dog", "owl"), events=300, duration_us=80_000, gap_us=150_000):
    """Labelled samples that follow each other with silence in between, two packets each."""
    items = []
    start = gap_us
    for i in range(n):
        items.append(Label(start, duration_us, names[i % len(names)], "train", f"sample {i}"))
        batch = steady(start, start + duration_us, events, seed=i)
        items += [packet(batch[: events // 3]), packet(batch[events // 3 :])]
        start += duration_us + gap_us
    return items


def write_items(path, items, **options):
    """Write items as a recording."""
    with RecordingWriter(path, **options) as writer:
        for item in items:
            if isinstance(item, Label):
                writer.write_label(item)
            else:
                writer.write_events(item.events, item.resolution)
    return path


def write_digits(path, n=20, *, split="train", n_held_out=0, seed=0):
    """Simulated digits as a labelled recording: 100 ms each, 34x34 pixels; the first few may be held out."""
    start = 200_000
    with RecordingWriter(path) as writer:
        samples = digit_samples(n, seed, split, saccades=Saccades(saccade_us=33_000))
        for i, sample in enumerate(samples):
            name = "test" if i < n_held_out else split
            writer.write_label(Label(start, 100_000, sample.label, name, sample.source))
            moved = sample.events.copy()
            moved["t"] += start
            writer.write_events(moved, (34, 34))
            start += 300_000
    return path
