"""Compare the learners with scikit-learn's MiniBatchDictionaryLearning on local volumes of a recording.

Lives here: the same volumes, threshold and threads for all, the objective against time, time at equal passes.

    python tools/compare_learners.py ncars.mcap
    python tools/compare_learners.py ncars.mcap --filters 1700 --bins 7 --volumes 4000 --passes 2 \\
        --batches 1 --scaled-to 100000

The objective is that of the inverse problem without penalty, `1/2 |x - D l|^2 + lambda0 |l|_1`, a mean over
volumes. Ours is what the learner reports, with the codes it has; scikit-learn's dictionaries get codes solved
to a gap of 1e-6, which its time does not count. Passes that were not made in full are scaled to be.

With --scaled-to there is no objective, and times are scaled to passes over so many volumes: scikit-learn's by
its batches, ours by what half of the volumes (no fewer than K) took less, as the step after a pass does not
grow.
Seconds are of the processor, over all threads, and by the clock.
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


def scaled(learner: TransformLearner | DictionaryLearner, white: np.ndarray, total: int) -> np.ndarray:
    """Seconds of the processor and by the clock for `total` volumes, from `white` and half of it."""
    spent = []
    for rows in (white[: len(white) // 2], white):
        began = np.array([time.process_time(), time.perf_counter()])
        clone(learner).fit(rows)
        spent.append(np.array([time.process_time(), time.perf_counter()]) - began)
    each = (spent[1] - spent[0]) / (len(white) - len(white) // 2)
    return spent[1] + each * (total - len(white))


def batches(n: int, size: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Indices of batches, pass after pass, each in another order."""
    while True:
        order = rng.permutation(n)
        yield from (order[i : i + size] for i in range(0, n - size + 1, size))


def timed_batches(
    learner: MiniBatchDictionaryLearning, white: np.ndarray, most: int, seconds: float, looking: bool
) -> tuple[Curve, np.ndarray]:
    """Learn batch after batch, until there are enough of them or time is up; look at about ten if at any.

    Returns the curve, and the seconds of the processor and by the clock that a batch took.
    """
    curve: Curve = []
    spent = np.zeros(2)
    next_look = 0.0
    for i, batch in enumerate(batches(len(white), learner.batch_size, np.random.default_rng(0)), 1):
        began = np.array([time.process_time(), time.perf_counter()])
        learner.partial_fit(white[batch])
        spent += np.array([time.process_time(), time.perf_counter()]) - began
        done = i >= most or spent[1] >= seconds
        if looking and (done or spent[1] >= next_look):
            curve.append((spent[1], lasso_objective(white, learner.components_, learner.alpha)))
            next_look = spent[1] + seconds / 10
        if done:
            return curve, spent / i
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
    parser.add_argument("--scaled-to", type=int, help="volumes that times are scaled to")
    arguments = parser.parse_args()
    k, passes = arguments.filters, arguments.passes
    white = volumes_of(arguments.recording, arguments.volumes, arguments.patch, arguments.bins)
    n, d = white.shape
    print(f"{n:,} volumes, d = {d}, K = {k}, {os.cpu_count()} cores of {platform.machine()}")

    threshold = THRESHOLDS["inverse"]
    both = {"max_iter": passes, "tol": 0.0, "random_state": 0}
    inverse = DictionaryLearner(k, threshold=threshold, coherence=0.0, **both)
    direct = TransformLearner(k, threshold=THRESHOLDS["direct"], **both)
    clone(inverse).set_params(n_atoms=10, max_iter=1).fit(white[:300])  # compiled before it is timed
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
        looking = arguments.scaled_to is None
        theirs, batch = timed_batches(other, white, arguments.batches, arguments.seconds, looking)
    total = n if looking else arguments.scaled_to
    one = batch * passes * total / arguments.batch_size
    print(f"\nseconds for {passes} passes over {total:,} volumes, of the processor and by the clock")
    print(f"{'scikit-learn':>12} {one[0]:10.1f} {'':>6} {one[1]:10.1f}", flush=True)
    curves = {}
    for name, learner in (("transform", direct), ("dictionary", inverse)):
        if looking:
            processor = time.process_time()
            curves[name] = timed_iterations(learner, white)
            spent = np.array([time.process_time() - processor, curves[name][-1][0]])
        else:
            spent = scaled(learner, white, total)
        shares = [f"1/{share:.1f}" for share in one / spent]
        print(f"{name:>12} {spent[0]:10.1f} {shares[0]:>6} {spent[1]:10.1f} {shares[1]:>6}", flush=True)
    if looking:
        mine = curves["dictionary"]
        print(f"\nobjective\n{'seconds':>8} {'dictionary':>12} {'scikit-learn':>12}")
        for seconds in sorted({when for curve in (mine, theirs) for when, _ in curve}):
            print(f"{seconds:8.2f} {at(mine, seconds)} {at(theirs, seconds)}")


if __name__ == "__main__":
    main()
