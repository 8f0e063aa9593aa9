"""Samples as the methods of others take them: those to learn from, events as columns, coarser pixels.

Lives here: what `surfaces`, `spiking`, `retina` and `spike_tensor` share.
Not here: which samples are held out (`splits`).
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from sklearn.cluster import MiniBatchKMeans
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from streamfeat.events import Events, Resolution
from streamfeat.recordings.reader import HELD_OUT_SPLITS, Recording, Sample

__all__ = ["centres", "downsampled", "some_training_samples", "training_samples", "until"]


def training_samples(recordings: Sequence[Recording]) -> Iterator[Sample]:
    """Samples of splits that are not held out."""
    for recording in recordings:
        for sample in recording.samples():
            if sample.label.split not in HELD_OUT_SPLITS:
                yield sample


def some_training_samples(
    recordings: Sequence[Recording], most: int, rng: np.random.Generator
) -> tuple[int, Iterator[Sample]]:
    """How many of the training samples are drawn at random, `most` at most; and these, in stream order."""
    labels = (label for recording in recordings for label in recording.labels)
    n_samples = sum(label.split not in HELD_OUT_SPLITS for label in labels)
    chosen = set(rng.permutation(n_samples)[:most].tolist())
    return len(chosen), (s for i, s in enumerate(training_samples(recordings)) if i in chosen)


def centres(vectors: NDArray[np.float32], n: int, seed: int) -> NDArray[np.float32]:
    """`n` centres of vectors by k-means in batches, on one thread: `(n, d)` float32."""
    means = MiniBatchKMeans(n, batch_size=4096, n_init=1, random_state=seed)
    with threadpool_limits(1, user_api="openmp"):
        means.fit(vectors)
    found: NDArray[np.float32] = means.cluster_centers_.astype(np.float32)
    return found


def downsampled(events: Events, resolution: Resolution, times: int) -> tuple[Events, Resolution]:
    """Events and sensor with `times` x `times` pixels taken for one, as encoders downsample; the same for 1.

    Args:
        events: not changed.
        resolution: of the sensor; events beyond it are left out.
        times: sensor pixels along each side of one of the new ones.
    """
    if times == 1:
        return events, resolution
    height, width = resolution
    small = events[(events["x"] < width) & (events["y"] < height)].copy()
    small["x"] //= times
    small["y"] //= times
    return small, (-(-height // times), -(-width // times))


def until(
    events: Events, resolution: Resolution, origin_us: int | None = None, t_us: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The events that count, in order of time: `x, y, p` and microseconds since the origin, `(n,)` int64."""
    x, y, p, t = (events[name].astype(np.int64) for name in ("x", "y", "p", "t"))
    if len(t) == 0:
        return x, y, p, t
    origin = int(t.min()) if origin_us is None else origin_us
    last = int(t.max()) if t_us is None else t_us
    keep = (x < resolution[1]) & (y < resolution[0]) & ((p == 0) | (p == 1)) & (t >= origin) & (t <= last)
    order = np.flatnonzero(keep)[np.argsort(t[keep], kind="stable")]
    return x[order], y[order], p[order], t[order] - origin
