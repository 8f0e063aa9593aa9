"""An encoder that was not learned, for checks and tests.

Lives here: `random_encoder`. Not here: learning (`learn`), and how matrices become an encoder (`encoder`).
"""

from typing import Any

import numpy as np

from streamfeat.engine.encoder import Encoder, Encoding, Formulation
from streamfeat.engine.geometry import Geometry

__all__ = ["random_encoder"]


def random_encoder(
    seed: int | np.random.Generator,
    geometry: Geometry,
    n_filters: int,
    formulation: Formulation = "direct",
    encoding: Encoding = "soft",
    *,
    threshold: float = 0.1,
    whitening: float = 0.2,
    **parameters: Any,
) -> Encoder:
    """An encoder like a learned one in all that costs time: random filters of unit length, a mean near zero.

    Example:
        >>> encoder = random_encoder(0, Geometry(patch=12, stride=4), 400, encoding="split")

    Args:
        seed: of the random numbers, or their generator.
        geometry: of the local volumes.
        n_filters: K.
        formulation: see `Encoder`.
        encoding: see `Encoder`.
        threshold: lambda0.
        whitening: how far the whitening is from the identity, as the norm of a random row; 0 is the identity.
        parameters: others of `Encoder.build`.

    Raises:
        InputError: see `Encoder.build`.
    """
    rng, d = np.random.default_rng(seed), geometry.entries
    matrix = np.eye(d)
    if whitening:
        matrix += whitening / np.sqrt(d) * rng.standard_normal((d, d))
    filters = rng.standard_normal((n_filters, d))
    return Encoder.build(
        geometry,
        formulation=formulation,
        encoding=encoding,
        threshold=threshold,
        filters=filters / np.linalg.norm(filters, axis=1, keepdims=True),
        whitening=(matrix + matrix.T) / 2,
        mean=0.1 * rng.standard_normal(d),
        **parameters,
    )
