"""Compare our linear SVM, and our search for its C, with scikit-learn's, on time surfaces of a recording.

Lives here: features as HATS has them (wide and dense), the objective that each reaches for a C, and its time.

    python tools/compare_svms.py ncars.mcap --samples 2000 --columns 3000
    python tools/compare_svms.py ncars.mcap --grid

The objective is `1/2 |w|^2 + C sum max(0, 1 - y (w'x + b))^2`; scikit-learn's penalises `b` as well, beside a
large constant, by next to nothing. With --grid, only the choice of C is timed: ours, and a blind search over
five values for each fold. Seconds are of the processor, over all threads, and by the clock.
"""

import argparse
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.model_selection import GridSearchCV, StratifiedGroupKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.svm import LinearSVC

from streamfeat.classifier import normalise_features, train_classifier
from streamfeat.evaluate.surfaces import AveragedSurfaces
from streamfeat.features import encode_recordings
from streamfeat.recording import open_recording
from streamfeat.svm import LinearSVM

BLIND = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1)


def objective(machine: LinearSVM | LinearSVC, x: np.ndarray, y: np.ndarray, c: float) -> float:
    signs = np.where(y[:, None] == machine.classes_[-len(machine.coef_) :], 1.0, -1.0)
    slack = np.maximum(0, 1 - signs * (x.astype(float) @ machine.coef_.T + machine.intercept_))
    return float(0.5 * np.square(machine.coef_).sum() + c * np.square(slack).sum())


def timed(what: Callable[[], Any]) -> tuple[Any, str]:
    processor, clock = time.process_time(), time.perf_counter()
    found = what()
    return found, f"{time.process_time() - processor:8.1f} {time.perf_counter() - clock:8.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--samples", type=int, help="training samples at most")
    parser.add_argument("--columns", type=int, help="features at most")
    parser.add_argument("--grid", action="store_true", help="time the choice of C")
    arguments = parser.parse_args()
    with open_recording(arguments.recording) as recording:
        surfaces = AveragedSurfaces.fitted([recording])
        samples = encode_recordings(surfaces, [recording])
    rng = np.random.default_rng(0)
    rows = rng.permutation(np.flatnonzero(~samples.held_out))[: arguments.samples]
    columns = rng.permutation(samples.rows.shape[1])[: arguments.columns]
    x, y = samples.rows[np.ix_(rows, columns)], samples.labels[rows]
    print(f"{len(x):,} samples of {x.shape[1]:,} features, {len(np.unique(y))} classes")
    if arguments.grid:
        trained, spent = timed(lambda: train_classifier(x, y.tolist(), surfaces))
        print(f"{'':>12} processor    clock\n{'ours':>12} {spent}  {trained.provenance}")
        folds = StratifiedGroupKFold(3, shuffle=True, random_state=0).split(x, y, np.arange(len(y)))
        grid = GridSearchCV(
            make_pipeline(FunctionTransformer(normalise_features), StandardScaler(), LinearSVM()),
            {"linearsvm__C": BLIND},
            cv=list(folds),
        )
        _, spent = timed(lambda: grid.fit(x, y))
        scores = dict(zip(BLIND, grid.cv_results_["mean_test_score"].round(4).tolist(), strict=True))
        print(f"{'blind grid':>12} {spent}  {grid.best_params_} {scores}")
        return
    x = StandardScaler().fit_transform(normalise_features(x))
    warm = LinearSVM(warm_start=True)
    print(f"{'C':>8} {'':>12} {'objective':>14} processor    clock")
    for c in BLIND:
        warm.set_params(C=c)
        liblinear = LinearSVC(C=c, dual="auto", intercept_scaling=30, max_iter=2000, random_state=0)
        for name, machine in (("ours", LinearSVM(C=c)), ("ours, warm", warm), ("LinearSVC", liblinear)):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", ConvergenceWarning)
                _, spent = timed(lambda machine=machine: machine.fit(x, y))
            note = "  did not converge" if caught else ""
            print(f"{c:8g} {name:>12} {objective(machine, x, y, c):14.6f} {spent}{note}", flush=True)


if __name__ == "__main__":
    main()
