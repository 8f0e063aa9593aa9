"""Fewer filters, chosen by labels: those that a linear classifier leans on.

Lives here: ranking the filters of an encoder by a classifier's weights, and the encoder of those kept.
Not here: learning filters (`learn`), training the classifier (`classifier`).

One step of the recursive elimination of Guyon, Weston, Barnhill and Vapnik (2002), section 4: a feature
counts as much as the square of its weight. We deviate: the features of a filter, its cells and signs, stay
or go together, so that the model gets smaller and not only its feature vector; and all are dropped at once.
"""

import numpy as np
from numpy.typing import NDArray

from streamfeat.classify.classifier import Classifier
from streamfeat.engine.encoder import Encoder
from streamfeat.errors import InputError

__all__ = ["filter_weights", "with_best_filters"]


def filter_weights(encoder: Encoder, classifier: Classifier) -> NDArray[np.float64]:
    """How much a classifier leans on each filter: squared weights of standardised features, `(K,)`.

    Args:
        encoder: of one scale.
        classifier: trained with it.

    Raises:
        InputError: they do not belong together, or there are several scales.
    """
    classifier.check_fits(encoder)
    if encoder.further:
        raise InputError("filters are chosen among those of one scale; give a model of one")
    # Features lie by cell, by sign if the encoding has them, and last by filter.
    squares = np.square(classifier.weights, dtype=np.float64).sum(axis=1)
    return np.asarray(squares.reshape(-1, encoder.n_filters).sum(axis=0))


def with_best_filters(encoder: Encoder, classifier: Classifier, n: int) -> Encoder:
    """The encoder of the `n` filters that a classifier leans on most, in the order that they had.

    Args:
        encoder: of one scale, with at least `n` filters.
        classifier: a linear one that was trained with it, on samples that may be looked at.
        n: filters to keep.

    Raises:
        InputError: there are not so many filters, or see `filter_weights`.
    """
    weights = filter_weights(encoder, classifier)
    if not 1 <= n <= len(weights):
        raise InputError(f"{n} of {len(weights)} filters cannot be kept; give 1 to {len(weights)}")
    best = np.sort(np.argsort(-weights, kind="stable")[:n])
    return Encoder.build(
        encoder.geometry,
        formulation=encoder.formulation,
        encoding=encoder.encoding,
        threshold=encoder.threshold,
        filters=encoder.filters[best],
        whitening=encoder.whitening,
        mean=encoder.mean,
        eps=encoder.operator.eps,
        gap=encoder.operator.gap,
        narrow=encoder.is_narrow,
        provenance={**encoder.provenance, "kept_filters": best.tolist(), "of_filters": len(weights)},
    )
