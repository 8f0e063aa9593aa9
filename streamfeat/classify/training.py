"""From encoded samples to the classifier that is asked for, or to the better one.

Lives here: the choice between the linear classifier and the kernel. Not here: training either (`classifier`,
`kernel`).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.classify.classifier import Classifier, train_classifier
from streamfeat.classify.kernel import KERNEL_SHARE, MOST_POINTS, KernelClassifier, train_kernel_classifier
from streamfeat.classify.machine import cells_of
from streamfeat.engine.encoder import FeatureMap
from streamfeat.errors import InputError

__all__ = ["KERNELS", "check_kernel", "train"]

KERNELS = ("auto", "linear", "rbf")
"""`auto`: `rbf` where rows are few enough and folds say that it is better, else `linear`."""


def check_kernel(name: str) -> None:
    """Refuse a kernel that there is not.

    Raises:
        InputError: it names those that there are.
    """
    if name not in KERNELS:
        raise InputError(f"kernel is {name!r}, it must be one of {', '.join(KERNELS)}")


def train(
    kernel: str,
    rows: NDArray[np.float32],
    labels: Sequence[str],
    features: FeatureMap,
    parts: NDArray[np.int64],
    *,
    provenance: Mapping[str, Any] | None = None,
    alone: bool = False,
    report: Callable[[str, int, int, str], None] = lambda step, done, total, remark: None,
) -> Classifier | KernelClassifier:
    """Train a classifier.

    Args:
        kernel: one of `KERNELS`.
        rows: `(n, F)` float32, features.
        labels: `n` names.
        features: what made the rows.
        parts: `(n,)` the fold in which each row is scored.
        provenance: JSON values kept with it.
        alone: with `rbf`, leave the linear classifier beside it untrained: it is not going to be used.
        report: called with (step, done, of how many, remark).

    Raises:
        InputError: see `train_classifier`; or `rbf` is asked for, and rows are too many or memory is short.
    """
    check_kernel(kernel)
    if kernel == "rbf" and alone:
        linear = Classifier.untrained(labels, features)
    else:
        linear = train_classifier(rows, labels, features, parts=parts, provenance=provenance, report=report)
    if kernel == "linear" or (kernel == "auto" and len(rows) > MOST_POINTS):
        return linear
    try:
        found = train_kernel_classifier(rows, linear, np.asarray(labels), parts, cells_of(features), report)
    except InputError:
        if kernel == "auto":  # there is no memory for it
            return linear
        raise
    better = found.provenance[KERNEL_SHARE] > max(linear.provenance.get("cross_validation", {"": 0}).values())
    return found if kernel == "rbf" or better else linear
