"""Features of many samples at once, for training and evaluation.

Lives here: `EventFeatures`, the scikit-learn transformer; encoding samples on all cores.
Not here: streams (`engine`), and what one window's features are (`window`).
"""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin

from streamfeat.classify.variants import PLAIN, Variant
from streamfeat.engine.encoder import Encoder, FeatureMap
from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution
from streamfeat.recordings.reader import HELD_OUT_SPLITS, Label, Losses, Recording, Sample
from streamfeat.work.workers import THIS_PROCESS, Workers

__all__ = [
    "EncodedSamples",
    "EventFeatures",
    "encode_recordings",
    "encode_samples",
    "sample_end",
    "training_set",
]


T = TypeVar("T")
R = TypeVar("R")


def sample_end(label: Label) -> int:
    """The last microsecond of a labelled sample: its features are read there."""
    return label.start_us + label.duration_us - 1


def encode_samples(
    encoder: FeatureMap, samples: Iterable[Sample], *, threads: int | None = None
) -> Iterator[tuple[Label, NDArray[np.float32]]]:
    """Encode labelled samples on several threads; kernels release the GIL.

    Args:
        encoder: the frozen encoder.
        samples: read one at a time, a few ahead of what has been yielded.
        threads: how many; as many as there are cores if not given.

    Yields:
        label and `(n_features,)` float32, in order.
    """

    def encode(sample: Sample) -> tuple[Label, NDArray[np.float32]]:
        origin, end = sample.label.start_us, sample_end(sample.label)
        return sample.label, encoder.encode(sample.events, sample.resolution, origin_us=origin, t_us=end)

    yield from _mapped(encode, samples, threads)


def _mapped(function: Callable[[T], R], values: Iterable[T], threads: int | None) -> Iterator[R]:
    """Call a function for each value on several threads, a few ahead of what has been yielded; in order."""
    n = threads or os.cpu_count() or 1
    source = iter(values)
    with ThreadPoolExecutor(n, thread_name_prefix="encode") as pool:
        ahead: deque[Future[R]] = deque(pool.submit(function, value) for value in islice(source, 2 * n))
        while ahead:
            yield ahead.popleft().result()
            ahead.extend(pool.submit(function, value) for value in islice(source, 1))


@dataclass(frozen=True, slots=True)
class EncodedSamples:
    """Features of labelled samples in the order of the stream.

    Attributes:
        rows: `(n, F)` float32.
        labels: `(n,)` names.
        sources: `(n,)` texts, the sources of the samples according to their labels.
        held_out: `(n,)` bool, whether a sample is of a held-out split.
    """

    rows: NDArray[np.float32]
    labels: NDArray[np.str_]
    sources: NDArray[np.str_]
    held_out: NDArray[np.bool_]


def encode_recordings(
    encoder: FeatureMap,
    recordings: Sequence[Recording],
    report: Callable[[str, int, int, str], None] = lambda step, done, total, remark: None,
    *,
    variant: Variant = PLAIN,
    held_out_too: bool = False,
    workers: Workers = THIS_PROCESS,
) -> EncodedSamples:
    """Encode all labelled samples of recordings, or a variant of those that are not held out.

    Args:
        encoder: the frozen encoder.
        recordings: open recordings.
        report: called with (step, done, of how many, remark).
        variant: other than `PLAIN`, it is encoded of training samples only, unless `held_out_too`.
        held_out_too: encode the variant of samples of held-out splits as well.
        workers: read and encode.
    """
    labels: list[Label] = []
    rows: list[NDArray[np.float32]] = []
    step = "encoding" if variant == PLAIN else f"encoding, {variant}"
    for recording in recordings:
        losses, parts = Losses(), [(recording.part(part),) for part in recording.parts()]
        found = workers.map(_encode_part, parts, workers.hold(encoder), variant, held_out_too)
        for done, (names, encoded, lost) in enumerate(found, 1):
            labels += names
            rows.append(encoded)
            losses.add_all(lost)
            report(step, done, len(parts), f"{recording.path.name}, {len(labels):,} samples")
        recording.losses = losses
    return EncodedSamples(
        np.concatenate(rows) if rows else np.empty((0, encoder.n_features), np.float32),
        np.array([label.label for label in labels], str),
        np.array([label.source for label in labels], str),
        np.array([label.split in HELD_OUT_SPLITS for label in labels], bool),
    )


def _encode_part(
    opener: Callable[[], Recording], encoder: FeatureMap, variant: Variant, held_out_too: bool
) -> tuple[list[Label], NDArray[np.float32], Losses]:
    with opener() as recording:
        samples = recording.samples()
        if variant != PLAIN:
            wanted = (s for s in samples if held_out_too or s.label.split not in HELD_OUT_SPLITS)
            samples = (variant.of(s) for s in wanted)
        encoded = [*encode_samples(encoder, samples, threads=1)]
        rows = np.empty((len(encoded), encoder.n_features), np.float32)
        for row, (_, features) in zip(rows, encoded, strict=True):
            row[:] = features
        return [label for label, _ in encoded], rows, recording.losses


def training_set(
    samples: EncodedSamples, others: Sequence[EncodedSamples] = ()
) -> tuple[NDArray[np.float32], list[str], NDArray[np.int64]]:
    """Rows to train a classifier on, their labels, and the number of each row's sample.

    Args:
        samples: of which those that are not held out are taken.
        others: variants of just those, which are learned from as well.
    """
    seen = ~samples.held_out
    rows, labels = samples.rows[seen], samples.labels[seen].tolist()
    numbers = np.arange(len(rows))
    if not others:
        return rows, labels, numbers
    n = 1 + len(others)
    return np.concatenate([rows, *(other.rows for other in others)]), n * labels, np.tile(numbers, n)


class EventFeatures(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Turn samples of events into features, as a step of a scikit-learn `Pipeline`.

    Stateless: the encoder is learned beforehand, without labels. `set_output(transform="pandas")` makes its
    output a data frame, as everywhere in scikit-learn.

    Example:
        >>> EventFeatures(encoder, resolution=(34, 34)).transform([events, more_events]).shape
        (2, 3200)

    Args:
        encoder: the frozen encoder.
        threads: how many encode at once; as many as there are cores if not given.
        resolution: `(height, width)` of the sensor, for event arrays that come without one.
    """

    def __init__(
        self, encoder: Encoder, threads: int | None = None, resolution: Resolution | None = None
    ) -> None:
        """Keep the parameters."""
        self.encoder = encoder
        self.threads = threads
        self.resolution = resolution

    def fit(self, X: Any, y: Any = None) -> Self:
        """Do nothing; the encoder is frozen."""
        return self

    def transform(self, X: Iterable[Sample | Events | tuple[Events, Resolution]]) -> NDArray[np.float32]:
        """Features of `n` samples: `(n, n_features)` float32.

        Args:
            X: labelled samples, such as `list(recording.samples())`, whose features are those at the end of
                the label; or event arrays, `(m,)` EVENT_DTYPE or of another tool (see `as_events`), whose
                window begins with the first and ends with the last event; or pairs of such an array and its
                `(height, width)`.

        Raises:
            InputError: one of them is of another type, or an array has no resolution.
        """
        rows = list(_mapped(self._encode, enumerate(X), self.threads))
        return np.stack(rows) if rows else np.zeros((0, self.encoder.n_features), np.float32)

    def _encode(self, numbered: tuple[int, Any]) -> NDArray[np.float32]:
        number, sample = numbered
        if isinstance(sample, Sample):
            origin_us, end_us = sample.label.start_us, sample_end(sample.label)
            return self.encoder.encode(sample.events, sample.resolution, origin_us=origin_us, t_us=end_us)
        resolution = self.resolution
        if isinstance(sample, tuple) and len(sample) == 2:
            sample, resolution = sample
        if not isinstance(sample, np.ndarray) or sample.dtype.names is None:
            raise InputError(
                f"sample {number} is of type {type(sample).__name__}; give labelled samples, such as "
                "list(recording.samples()), or structured arrays of events"
            )
        if resolution is None:
            raise InputError(
                f"sample {number} is an array of events without a resolution; give "
                "EventFeatures(encoder, resolution=(height, width)), or pairs of events and resolution"
            )
        return self.encoder.encode(sample, resolution)

    def get_feature_names_out(self, input_features: Any = None) -> NDArray[np.object_]:
        """Name each feature by its cell (row, column) and filter: `(n_features,)` str, such as `cell_0_1_17`.

        With the encoding `split` a filter has two, `cell_0_1_17_pos` and `cell_0_1_17_neg`. Those of a second
        scale begin with `scale_2_`, and so on.

        Args:
            input_features: samples have no features of their own, so it is ignored.
        """
        names = [
            f"{f'scale_{number}_' if number > 1 else ''}cell_{row}_{column}_{k}{half}"
            for number, scale in enumerate(self.encoder.scales, 1)
            for row in range(scale.geometry.pooling)
            for column in range(scale.geometry.pooling)
            for half in (("_pos", "_neg") if scale.encoding == "split" else ("",))
            for k in range(scale.n_filters)
        ]
        return np.array(names, object)

    def __sklearn_is_fitted__(self) -> bool:
        """Say that there is nothing to fit."""
        return True
