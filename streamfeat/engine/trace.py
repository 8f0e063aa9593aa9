"""Features and scores after each event of a batch, in columns.

Lives here: `Trace`, and room for what kernels work with; scores of whole feature vectors.
Not here: the kernel (`kernels.trace`), and state (`engine`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.operator import n_features
from streamfeat.events import Events
from streamfeat.kernels.layout import Operator, State
from streamfeat.kernels.predict import PARTS, SUMMED, Weights, predict
from streamfeat.kernels.trace import Reading, trace

__all__ = ["Trace", "joined", "scores_of", "trace_events"]

_NO_CLASS = Weights(np.zeros((PARTS, 0, SUMMED), np.float32), np.zeros(0, np.float32))


class Trace(NamedTuple):
    """What was read after each of `n` events."""

    features: NDArray[np.float32]
    """`(n, n_features)`, or `(0, n_features)` where they were not kept."""
    scores: NDArray[np.float32]
    """`(n, C)`: a column for each row of weights; none without weights."""
    accepted: NDArray[np.int64]
    """`(n,)`: events accepted by then."""


def trace_events(
    events: Events, operator: Operator, state: State, weights: Weights | None, *, keep_features: bool = True
) -> Trace:
    """Follow the events of a batch, and read after each.

    Args:
        events: `(n,)` EVENT_DTYPE, contiguous; not changed.
        operator: the encoder, with the shape of the grid.
        state: changed; up to date with all earlier events.
        weights: of a linear classifier for these features; None for no scores.
        keep_features: whether features are wanted.
    """
    weights = weights or _NO_CLASS
    n, width, (parts, classes, length) = len(events), n_features(operator), weights.rows.shape
    found = Trace(
        np.empty((n if keep_features else 0, width), np.float32),
        np.empty((n, classes), np.float32),
        np.empty(n, np.int64),
    )
    reading = Reading(
        np.empty(width, np.float32),
        np.empty(length, np.float32),
        np.empty((parts, classes + 1), np.float32),
        np.empty(state.pooled.shape[1], np.uint8),
        np.empty(parts, np.uint8),
    )
    trace(events, operator, state, weights, reading, *found)
    return found


def scores_of(features: NDArray[np.float32], weights: Weights) -> NDArray[np.float32]:
    """Scores of feature vectors, each by itself: `(n, C)` for `(n, F)`, contiguous, not changed."""
    parts, classes, length = weights.rows.shape
    found = np.empty((len(features), classes), np.float32)
    roots, sums = np.empty(length, np.float32), np.empty((parts, classes + 1), np.float32)
    predict(features, weights, roots, sums, found)
    return found


def joined(
    first: Trace,
    further: Sequence[tuple[slice, Trace]],
    n_features: int,
    weights: Weights | None,
    *,
    keep_features: bool,
) -> Trace:
    """The trace of an encoder of several scales, from a trace of each.

    An event touches all scales in a part of their cells; scores are those of whole feature vectors.

    Args:
        first: of the first scale, whose features stand in front.
        further: where the features of each other scale stand, and its trace.
        n_features: of all scales.
        weights: of a linear classifier for all features; None for no scores.
        keep_features: whether features are wanted.
    """
    n = len(first.accepted)
    features = np.empty((n, n_features), np.float32)
    features[:, : first.features.shape[1]] = first.features
    for place, one in further:
        features[:, place] = one.features
    scores = scores_of(features, weights) if weights else first.scores
    return Trace(features if keep_features else features[:0], scores, first.accepted)
