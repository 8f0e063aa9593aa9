"""What the paper promises of both formulations, seen on recordings: objective, conditioning, solutions.

Lives here: learning on each recording, the objective after every half-step, condition number, coherence,
and codes of the inverse formulation beside those of scikit-learn and SPAMS. Not here: how quick all of that
is (`tools/bench --only inverse`), and pictures of filters (`streamfeat evaluate --report`).

    python tools/show_guarantees.py recordings/digits_train.mcap ncars.mcap
    python tools/show_guarantees.py digits.mcap --filters 100 --volumes 5000 --iterations 10 --json seen.json

The objective may not rise from one half-step to the next; the exit status is 1 where it did. Codes of the
direct formulation are soft thresholds, the exact solution in closed form, so there is nothing to compare.
"""

import argparse
import importlib.util
import json
import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.decomposition import sparse_encode
from sklearn.exceptions import ConvergenceWarning
from threadpoolctl import threadpool_limits

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT))

from streamfeat.learn.dictionary import DictionaryLearner  # noqa: E402
from streamfeat.learn.fit import learn_encoder, prepare  # noqa: E402
from streamfeat.learn.settings import Setting  # noqa: E402
from streamfeat.recordings.reader import open_recording  # noqa: E402

Codes = NDArray[np.float64]

ROUNDING = 1e-5
"""Share of the objective that float32 may take it up by."""

N_PROBLEMS = 200
"""Volumes whose codes are compared."""

GAP = 1e-8


def largest_rise(objective: Sequence[float]) -> float:
    """The largest step upwards between two half-steps, relative to the objective there; below 0 if none."""
    values = np.asarray(objective, np.float64)
    return float((np.diff(values) / np.abs(values[:-1])).max()) if len(values) > 1 else -1.0


def lasso_objective(x: Codes, atoms: Codes, codes: Codes, penalty: float) -> Codes:
    """`1/2 |x - D l|^2 + penalty |l|_1` of each volume, `(n,)`."""
    return 0.5 * np.square(x - codes @ atoms).sum(axis=1) + penalty * np.abs(codes).sum(axis=1)


def codes_of_others(x: Codes, atoms: Codes, penalty: float) -> dict[str, Codes]:
    """The same lassos by others, each as exact as it can: scikit-learn, and SPAMS where it is installed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # objectives are compared, whatever it stopped at
        found = {
            f"scikit-learn {name}": sparse_encode(x, atoms, algorithm=name, alpha=penalty, max_iter=20_000)
            for name in ("lasso_cd", "lasso_lars")
        }
    if importlib.util.find_spec("spams"):
        import spams

        given, dictionary = np.asfortranarray(x.T), np.asfortranarray(atoms.T)
        codes = spams.lasso(given, D=dictionary, lambda1=penalty, mode=2, numThreads=1)
        found["SPAMS lasso"] = np.asarray(codes.todense()).T
    return found


def examine(path: Path, setting: Setting, formulation: str) -> dict[str, Any]:
    """Learn from one recording; figures as JSON values."""
    setting = replace(setting, formulation=formulation)
    with open_recording(path) as recording:
        encoder = learn_encoder([recording], setting)
        seen = encoder.provenance
        objective = list(seen["objective"])
        result: dict[str, Any] = {
            "recording": path.name,
            "formulation": formulation,
            "filters": encoder.n_filters,
            "objective": objective,
            "largest_rise": largest_rise(objective),
            "condition": seen["condition"],
            "coherence": seen["coherence"],
            "unused": seen["unused"],
        }
        if formulation == "inverse":
            white = prepare([recording], setting, lambda *step: None).white
            x = np.concatenate(white.fetch(white.each(np.asarray)))[:N_PROBLEMS]
            result["solutions"] = solutions(x, encoder.filters, setting.penalty)
    return result


def solutions(
    x: NDArray[np.float32], atoms: NDArray[np.float32], penalty: float
) -> dict[str, dict[str, float]]:
    """How far objectives of others lie above ours, relative; below 0 where ours is worse."""
    learner = DictionaryLearner(len(atoms), threshold=penalty, gap=GAP)
    learner.components_, learner.n_features_in_ = atoms, atoms.shape[1]
    ours = learner.transform(x).astype(np.float64)
    wide, wide_atoms = x.astype(np.float64), atoms.astype(np.float64)
    mine = lasso_objective(wide, wide_atoms, ours, penalty)
    found = {}
    for name, codes in codes_of_others(wide, wide_atoms, penalty).items():
        above = lasso_objective(wide, wide_atoms, codes, penalty) / mine - 1
        found[name] = {
            "least": float(above.min()),
            "most": float(above.max()),
            "codes": float(np.abs(codes - ours).max()),
            "used": float(np.median(np.count_nonzero(codes, axis=1))),
        }
    return found


def table(results: Sequence[dict[str, Any]]) -> str:
    """Two tables in Markdown."""
    lines = [
        "| recording | formulation | K | objective, half-steps | largest rise | condition | coherence |",
        "|---|---|---:|---|---:|---:|---:|",
    ]
    for one in results:
        objective = " ".join(f"{value:.4g}" for value in _thinned(one["objective"]))
        rise = f"{one['largest_rise']:.1e}" if one["largest_rise"] > 0 else "none"
        condition, coherence = (
            " to ".join("inf" if v is None else f"{v:.3g}" for v in (one[name][0], one[name][-1]))
            for name in ("condition", "coherence")
        )
        lines.append(
            f"| {one['recording']} | {one['formulation']} | {one['filters']:,} | {objective} | {rise} | "
            f"{condition} | {coherence} |"
        )
    lines += [
        "",
        "| recording | lassos by | objective above ours, least to most | codes differ by | atoms used |",
        "|---|---|---:|---:|---:|",
    ]
    for one in results:
        for name, found in one.get("solutions", {}).items():
            span = f"{found['least']:+.1e} to {found['most']:+.1e}"
            beside = f"{span} | {found['codes']:.1e} | {found['used']:g}"
            lines.append(f"| {one['recording']} | {name} | {beside} |")
    return "\n".join(lines)


def _thinned(values: Sequence[float], most: int = 6) -> list[float]:
    return [values[i] for i in np.unique(np.linspace(0, len(values) - 1, most).astype(int))]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("recordings", nargs="+", type=Path, help="MCAP files")
    add("--filters", type=int, default=200, help="K (default: %(default)s)")
    add("--patch", type=int, default=12, help="pixels (default: %(default)s)")
    add("--bins", type=int, default=3, help="time bins (default: %(default)s)")
    add("--volumes", type=int, default=5_000, help="to learn from (default: %(default)s)")
    add("--iterations", type=int, default=8, help="(default: %(default)s)")
    add("--json", type=Path, help="write the figures, too")
    given = parser.parse_args(arguments)
    names = ("filters", "patch", "bins", "volumes", "iterations")
    setting = Setting(**{name: getattr(given, name) for name in names})
    results = []
    with threadpool_limits(1):
        for path in given.recordings:
            for formulation in ("direct", "inverse"):
                print(f"{path.name}, {formulation}", file=sys.stderr)
                results.append(examine(path, setting, formulation))
    print(table(results))
    if given.json:
        given.json.write_text(json.dumps(results, indent=1) + "\n")
    return int(any(one["largest_rise"] > ROUNDING for one in results))


if __name__ == "__main__":
    sys.exit(main())
