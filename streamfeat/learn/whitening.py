"""Normalising and whitening local volumes.

Lives here: `VolumeWhitener`, a scikit-learn transformer. Not here: which volumes (`volumes`).
"""

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigh
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import check_is_fitted

from streamfeat.errors import InputError
from streamfeat.learn.chunks import ChunkedVolumes, checked_volumes
from streamfeat.work.workers import Sums

__all__ = ["VolumeWhitener", "whitened"]


class VolumeWhitener(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Mean and contrast of each volume removed, then ZCA over all of them.

    `v_hat = (v - mean(v)) / sqrt(var(v) + eps)`, `x = W (v_hat - mu)`,
    `W = U (Lambda + eps_zca)^(-1/2) U'` from the covariance `U Lambda U'` of `v_hat`
    (Coates, Ng and Lee 2011, section 3.1).

    Args:
        eps: added to the variance of each volume.
        eps_zca: added to every eigenvalue; large values whiten less.
        chunk_size: volumes held as floats at a time by each thread.

    Attributes:
        mean_: `(d,)` float32, `mu`.
        whitening_: `(d, d)` float32, `W`, symmetric.
    """

    def __init__(self, eps: float = 0.01, eps_zca: float = 0.1, chunk_size: int = 2048) -> None:
        """Keep the parameters."""
        self.eps = eps
        self.eps_zca = eps_zca
        self.chunk_size = chunk_size

    def fit(self, X: ArrayLike | ChunkedVolumes, y: Any = None) -> Self:
        """Learn mean and whitening from `(n, d)` volumes in one pass; sums are float64.

        Args:
            X: an array or a memory map of any integer or float dtype, or volumes in chunks; not changed.
            y: ignored.

        Raises:
            InputError: there are not more volumes than entries, a value is not finite, or every volume is
                constant.
        """
        volumes = checked_volumes(self, X, self.chunk_size)
        n, d = volumes.shape
        if n <= d:
            raise InputError(
                f"n_samples = {n} is too few volumes for the covariance of their {d} entries; "
                f"give more than {d}, or use a smaller patch or fewer bins"
            )
        total, products = volumes.total(_moments, self.eps)
        # Of a constant volume nothing but rounding is left.
        if np.trace(products) <= 1e-9 * n:
            raise InputError(
                f"all {n} volumes (n_features = {d}) are constant; there is no covariance to learn: "
                "use recordings with events, or a larger patch"
            )
        mean = total / n
        values, vectors = eigh(products / n - np.outer(mean, mean))
        scaled = vectors / np.sqrt(values.clip(min=0.0) + self.eps_zca)
        whitening = scaled @ vectors.T
        self.mean_ = mean.astype(np.float32)
        self.whitening_ = ((whitening + whitening.T) / 2).astype(np.float32)
        return self

    def transform(self, X: ArrayLike) -> NDArray[np.float32]:
        """Whiten `(n, d)` volumes; float32."""
        check_is_fitted(self)
        volumes = checked_volumes(self, X, self.chunk_size, reset=False)
        white = np.empty(volumes.shape, np.float32)
        for start in range(0, len(white), self.chunk_size):
            rows = slice(start, start + self.chunk_size)
            white[rows] = whitened(volumes[rows], self.eps, self.mean_, self.whitening_)
        return white

    def __sklearn_tags__(self) -> Any:
        """Say that what comes out is float32 whatever goes in."""
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = []
        return tags


def whitened(
    volumes: NDArray[Any], eps: float, mean: NDArray[np.float32], whitening: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Volumes `(n, d)` with what a whitener, or an encoder, has learned; float32."""
    return np.asarray((_normalised(volumes, eps) - mean) @ whitening, np.float32)


def _normalised(chunk: NDArray[np.float32], eps: float) -> NDArray[np.float32]:
    values: NDArray[np.float32] = chunk - chunk.mean(axis=1, keepdims=True)
    values /= np.sqrt(np.square(values).mean(axis=1, keepdims=True) + np.float32(eps))
    return values


def _moments(chunk: NDArray[np.float32], eps: float) -> Sums:
    """Sums of `v_hat` and of `v_hat v_hat'`."""
    normal = _normalised(chunk, eps)
    return normal.sum(axis=0, dtype=np.float64), (normal.T @ normal).astype(np.float64)
