"""How sparse the codes of learned filters are, on samples that were held out.

Lives here: kurtosis of projections, and the share of codes that are not zero. Not here: accuracy (`scores`).
"""

from collections.abc import Sequence

import numpy as np

from streamfeat.classify.features import sample_end
from streamfeat.engine.encoder import Encoder
from streamfeat.learn.volumes import Window, sample_volumes
from streamfeat.learn.whitening import whitened
from streamfeat.recordings.reader import Sample

__all__ = ["code_statistics"]

_VOLUMES, _PER_SAMPLE = 10_000, 64


def code_statistics(encoder: Encoder, samples: Sequence[Sample], seed: int) -> dict[str, float]:
    """Of random volumes with events, drawn alike for every encoder of one geometry and seed.

    Args:
        encoder: of which the first scale is looked at.
        samples: to draw volumes from; with no room for a volume in any there are no statistics.
        seed: of drawing them.

    Returns:
        `kurtosis`, the mean over filters of `E z^4 / (E z^2)^2` of their projections `z`, 3 where Gaussian;
        `used`, the share of `|z|` above the threshold: of codes that are not zero, if thresholds are soft.
    """
    windows = [Window(s.events, s.resolution, s.label.start_us, sample_end(s.label)) for s in samples]
    drawn = sample_volumes(windows, encoder.geometry, _VOLUMES, (seed,), per_window=_PER_SAMPLE)
    if not len(drawn.counts):
        return {}
    white = whitened(drawn.counts, encoder.operator.eps, encoder.mean, encoder.whitening)
    z = white @ encoder.filters.T
    squares = np.square(z, dtype=np.float64)
    kurtosis = np.square(squares).mean(axis=0) / np.maximum(squares.mean(axis=0) ** 2, 1e-30)
    used = np.mean(np.abs(z) > encoder.threshold)
    return {"kurtosis": round(float(kurtosis.mean()), 2), "used": round(float(used), 4)}
