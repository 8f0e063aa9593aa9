"""Features of many samples at once, for training and evaluation.

Lives here: `EventFeatures`, the scikit-learn transformer, and encoding samples on all cores.
Not here: streams (`engine`), and what one window's features are (`window`).
"""

import os
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin

from streamfeat.encoder import Encoder, FeatureMap
from streamfeat.errors import InputError
from streamfeat.recording import Label, Sample

__all__ = ["EventFeatures", "encode_samples", "sample_end"]


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
    n = threads or os.cpu_count() or 1

    def encode(sample: Sample) -> tuple[Label, NDArray[np.float32]]:
        origin, end = sample.label.start_us, sample_end(sample.label)
        return sample.label, encoder.encode(sample.events, sample.resolution, origin_us=origin, t_us=end)

    source = iter(samples)
    with ThreadPoolExecutor(n, thread_name_prefix="encode") as pool:
        ahead: deque[Future[tuple[Label, NDArray[np.float32]]]] = deque(
            pool.submit(encode, sample) for sample in islice(source, 2 * n)
        )
        while ahead:
            yield ahead.popleft().result()
            ahead.extend(pool.submit(encode, sample) for sample in islice(source, 1))


class EventFeatures(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Turn labelled samples into features, as a step of a scikit-learn `Pipeline`.

    Stateless: the encoder is learned beforehand, without labels.

    Args:
        encoder: the frozen encoder.
        threads: how many encode at once; as many as there are cores if not given.
    """

    def __init__(self, encoder: Encoder, threads: int | None = None) -> None:
        """Keep the parameters."""
        self.encoder = encoder
        self.threads = threads

    def fit(self, X: Any, y: Any = None) -> Self:
        """Do nothing; the encoder is frozen."""
        return self

    def transform(self, X: Iterable[Sample]) -> NDArray[np.float32]:
        """Features `(n, n_features)` float32 of `n` samples, such as `list(recording.samples())`.

        Raises:
            InputError: one of them is not a sample.
        """
        rows = [features for _, features in encode_samples(self.encoder, _checked(X), threads=self.threads)]
        return np.stack(rows) if rows else np.zeros((0, self.encoder.n_features), np.float32)

    def __sklearn_is_fitted__(self) -> bool:
        """Say that there is nothing to fit."""
        return True


def _checked(samples: Iterable[Any]) -> Iterator[Sample]:
    for i, sample in enumerate(samples):
        if not isinstance(sample, Sample):
            raise InputError(
                f"sample {i} is of type {type(sample).__name__}; "
                "give labelled samples, such as list(recording.samples())"
            )
        yield sample
