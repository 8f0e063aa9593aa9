"""Compare the learners with scikit-learn's MiniBatchDictionaryLearning on local volumes of a recording.

Lives here: the same volumes, threshold and threads for all, the objective against time, time at equal passes.

    python tools/compare_learners.py ncars.mcap
    python tools/compare_learners.py ncars.mcap --filters 1700 --bins 7 --volumes 4000 --passes 2 --batches 1

The objective is that of the inverse problem without penalty, `1/2 |x - D l|^2 + lambda0 |l|_1`, a mean over
volumes. Ours is what the learner reports, with the codes it has; scikit-learn's dictionaries get codes solved
to a gap of 1e-6, which its time does not count. Passes that were not made in full are scaled to be.
"""

import argparse
import os
import platform
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from sklearn.base import clone
from sklearn.decomposition import MiniBatchDictionaryLearning
from sklearn.exceptions import ConvergenceWarning

from streamfeat.learn.dictionary import DictionaryLearner
from streamfeat.learn.fit import prepare
from streamfeat.learn.setting import THRESHOLDS, Setting
from streamfeat.learn.transform import TransformLearner
from streamfeat.recording import open_recording

Curve = list[tuple[float, float]]
"""Seconds of learning, and the objective after them."""


def volumes_of(path: Path, n: int, patch: int, bins: int) -> np.ndarray:
    setting = Setting(patch=patch, bins=bins, volumes=n, filters=1)
    with open_recording(path) as recording:
        return prepare([recording], setting, lambda step, done, total, remark: None).white[:]


def lasso_objective(white: np.ndarray, atoms: np.ndarray, threshold: float) -> float:
    coder = DictionaryLearner(len(atoms), threshold=threshold, gap=1e-6)
    coder.components_, coder.n_features_in_ = atoms.astype(np.float32), white.shape[1]
    codes = coder.transform(white)
    error = white - codes @ coder.components_
    return float(0.5 * np.square(error).sum() + threshold * np.abs(codes).sum()) / len(white)


def timed_iterations(learner: TransformLearner | DictionaryLearner, white: np.ndarray) -> Curve:
    """Fit, and say when each iteration was done."""
    curve: Curve = []
    began = time.perf_counter()
    learner.set_params(progress=lambda _, value: curve.append((time.perf_counter() - began, value)))
    learner.fit(white)
    return curve


def batches(n: int, size: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Indices of batches, pass after pass, each in another order."""
    while True:
        order = rng.permutation(n)
        yield from (order[i : i + size] for i in range(0, n - size + 1, size))


def timed_batches(
    learner: MiniBatchDictionaryLearning, white: np.ndarray, most: int, seconds: float
) -> Curve:
    """Learn batch after batch, until there are enough of them or time is up; look at about ten."""
    curve: Curve = []
    spent = 0.0
    next_look = 0.0
    for i, batch in enumerate(batches(len(white), learner.batch_size, np.random.default_rng(0)), 1):
        began = time.perf_counter()
        learner.partial_fit(white[batch])
        spent += time.perf_counter() - began
        done = i >= most or spent >= seconds
        if done or spent >= next_look:
            curve.append((spent, lasso_objective(white, learner.components_, learner.alpha)))
            next_look = spent + seconds / 10
        if done:
            learner.set_params(max_iter=i)
            return curve
    raise AssertionError("batches never end")


def at(curve: Curve, seconds: float) -> str:
    reached = [value for when, value in curve if when <= seconds]
    return f"{reached[-1]:12.3f}" if reached else f"{'-':>12}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--filters", type=int, default=400)
    parser.add_argument("--volumes", type=int, default=5000)
    parser.add_argument("--patch", type=int, default=12)
    parser.add_argument("--bins", type=int, default=3)
    parser.add_argument("--passes", type=int, default=5, help="of our learners")
    parser.add_argument("--batches", type=int, default=10**9, help="of scikit-learn at most")
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--seconds", type=float, default=60, help="for scikit-learn at most")
    parser.add_argument("--jobs", type=int, default=1, help="of scikit-learn's lasso")
    arguments = parser.parse_args()
    k, passes = arguments.filters, arguments.passes
    white = volumes_of(arguments.recording, arguments.volumes, arguments.patch, arguments.bins)
    n, d = white.shape
    print(f"{n:,} volumes, d = {d}, K = {k}, {os.cpu_count()} cores of {platform.machine()}")

    threshold = THRESHOLDS["inverse"]
    both = {"max_iter": passes, "tol": 0.0, "random_state": 0}
    inverse = DictionaryLearner(k, threshold=threshold, coherence=0.0, **both)
    direct = TransformLearner(k, threshold=THRESHOLDS["direct"], **both)
    clone(inverse).set_params(max_iter=1).fit(white[: max(k, 300)])  # compiled before it is timed
    mine = timed_iterations(inverse, white)
    transform = timed_iterations(direct, white)
    other = MiniBatchDictionaryLearning(
        k,
        alpha=threshold,
        batch_size=arguments.batch_size,
        fit_algorithm="cd",
        n_jobs=arguments.jobs,
        random_state=0,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        clone(other).set_params(n_components=2).partial_fit(white[:300])  # its workers have started
        theirs = timed_batches(other, white, arguments.batches, arguments.seconds)

    print(f"\n{'seconds':>8} {'dictionary':>12} {'scikit-learn':>12}")
    for seconds in sorted({when for curve in (mine, theirs) for when, _ in curve}):
        print(f"{seconds:8.2f} {at(mine, seconds)} {at(theirs, seconds)}")
    one_pass = theirs[-1][0] / other.max_iter * n / arguments.batch_size
    print(f"\nseconds for {passes} passes over {n:,} volumes")
    for name, spent in (
        ("scikit-learn", one_pass * passes),
        ("dictionary", mine[-1][0]),
        ("transform", transform[-1][0]),
    ):
        print(f"{name:>12} {spent:10.1f}   1/{one_pass * passes / spent:.0f}")


if __name__ == "__main__":
    main()
