"""The inverse formulation, event by event: against solvers that begin anew for each volume.

Lives here: the part `inverse`. Not here: the direct formulation (`direct`).

Ours follows real events and takes them back; every volume that an event hits is solved again, from the code
it had, to a relative duality gap of 1e-4. How many atoms a code uses decides the time of everybody, so there
are three penalties, multiples of the one the dictionary was learned with. The peers solve problems of the
same kind, the volumes as those events left them, with the Gram matrix at hand; the gap that each reached is
measured, in float64.
"""

import importlib.util
import os
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.decomposition import sparse_encode
from sklearn.exceptions import ConvergenceWarning
from threadpoolctl import threadpool_limits

import streamfeat as sf
from tools.bench.direct import follower
from tools.bench.material import Setting, Updates, encoder_of
from tools.bench.timing import THREAD, WALL, Contestant, race

__all__ = ["measure_inverse"]

GAP = 1e-4
PENALTIES = (1, 2, 4)
PROBLEMS, CALLS = 32, 2
"""Problems that SPAMS is given at once; single calls of scikit-learn in one run."""


def measure_inverse(setting: Setting) -> dict[str, Any]:
    """Nanoseconds for each lasso of our engine, scikit-learn and SPAMS, at each penalty."""
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the gap that was reached is measured
        return {f"{share:g}": _measure(setting, share) for share in PENALTIES}


def _measure(setting: Setting, share: float) -> dict[str, Any]:
    geometry = setting.geometry(stride=4)
    learned = encoder_of(setting, geometry, setting.n_filters, "inverse", "soft")
    encoder = sf.Encoder.build(
        geometry,
        formulation="inverse",
        encoding="soft",
        threshold=share * learned.threshold,
        filters=learned.filters,
        whitening=learned.whitening,
        mean=learned.mean,
        eps=learned.operator.eps,
        gap=GAP,
    )
    burst = setting.material.burst(geometry, 10 if setting.quick else 60)
    ours, updates, _ = follower(burst, encoder)
    contestants = {"ours": ours}
    engine = burst.engine(encoder)
    engine.follow(burst.events)
    forth = Updates.of(burst, burst.events, geometry)
    whole = forth.volumes(geometry, burst.resolution)
    problems = Problems.of(encoder, _passed_through(whole, forth.rows))
    own, exact = _gaps_of_engine(engine, encoder, whole, forth.rows)
    gaps = {"ours": own, "ours, with filters before quantising": exact}
    used = int(
        np.median(np.count_nonzero(engine.codes().reshape(-1, encoder.n_filters)[forth.rows[:, 0]], 1))
    )
    missing = []
    for name, options in {
        "lasso_cd": {"alpha": encoder.threshold},
        "lasso_lars": {"alpha": encoder.threshold},
        "omp": {"n_nonzero_coefs": max(used, 1)},
    }.items():
        contestants[f"scikit-learn {name}"], codes = problems.scikit(name, options)
        if name != "omp":
            gaps[f"scikit-learn {name}"] = problems.gap(codes)
    if importlib.util.find_spec("spams"):
        for threads in sorted({1, os.cpu_count() or 1}):
            name = f"SPAMS, batch, {threads} thread{'s' * (threads > 1)}"
            contestants[name], codes = problems.spams(threads)
            gaps[name] = problems.gap(codes)
    else:
        missing.append("spams-bin")
    setting.say(f"{len(updates.rows)} lassos of ours, {len(problems.x)} for others")
    result = race(contestants, setting.rounds(5))
    others = [name for name in contestants if name != "ours"]
    return {
        "threshold": encoder.threshold,
        "nonzero": used,
        "updates": len(updates.rows),
        "problems": len(problems.x),
        "race": result.figures(),
        "over_ours": {name: result.ratio(name, "ours") for name in others},
        "largest_relative_gap": {name: float(f"{gap:.3g}") for name, gap in gaps.items()},
        "missing": missing,
    }


def whitened(encoder: sf.Encoder, volumes: NDArray[np.int16]) -> NDArray[np.float64]:
    """`(n, d)` volumes as the mathematics has them, in float64."""
    values = volumes.astype(np.float64)
    mean = values.mean(axis=1, keepdims=True)
    sigma = np.sqrt(np.square(values).mean(axis=1, keepdims=True) - mean**2 + encoder.operator.eps)
    normal = (values - mean) / sigma - encoder.mean.astype(np.float64)
    return np.asarray(normal @ encoder.whitening.astype(np.float64).T)


def _passed_through(volumes: NDArray[np.int16], rows: NDArray[np.int32]) -> NDArray[np.int16]:
    """The volume that each of some updates leaves behind."""
    volumes = volumes.copy()
    left = np.empty((len(rows), volumes.shape[1]), np.int16)
    for i, (volume, entry, before, after) in enumerate(rows):
        volumes[volume, entry] += after - before
        left[i] = volumes[volume]
    chosen = np.random.default_rng(0).permutation(np.flatnonzero(left.any(1)))[:PROBLEMS]
    return left[chosen]


def _gaps_of_engine(
    engine: sf.Engine, encoder: sf.Encoder, volumes: NDArray[np.int16], rows: NDArray[np.int32]
) -> tuple[float, float]:
    """Of the problems that the engine solves, with its quantised operator, and of those before quantising."""
    volumes, operator, k = volumes.copy(), encoder.operator, encoder.n_filters
    np.add.at(volumes, (rows[:, 0], rows[:, 1]), (rows[:, 3] - rows[:, 2]).astype(np.int16))
    hit = np.unique(rows[:, 0])
    hit = hit[volumes[hit].any(1)]
    codes = engine.codes().reshape(-1, k)[hit].astype(np.float64)
    exact = Problems.of(encoder, volumes[hit])
    values = volumes[hit].astype(np.float64)
    sigma = np.sqrt(np.square(values).mean(1) - values.mean(1) ** 2 + operator.eps)
    projections = values @ operator.columns[:, :k].astype(np.float64)
    own = Problems(exact.x, exact.atoms, exact.penalty)
    own.right = projections * (operator.scale / sigma)[:, None] - operator.offset[:k] / operator.unit
    return own.gap(codes), exact.gap(codes)


class Problems:
    """Lassos with one dictionary, in float64."""

    def __init__(self, x: NDArray[np.float64], atoms: NDArray[np.float64], penalty: float) -> None:
        self.x, self.atoms, self.penalty = x, atoms, penalty
        self.gram, self.right = atoms @ atoms.T, x @ atoms.T

    @classmethod
    def of(cls, encoder: sf.Encoder, volumes: NDArray[np.int16]) -> "Problems":
        """The lassos of some volumes."""
        return cls(whitened(encoder, volumes), encoder.filters.astype(np.float64), encoder.threshold)

    def gap(self, codes: NDArray[np.float64]) -> float:
        """The largest duality gap of `(n, K)` codes, relative to `1/2 |x|^2` (Fercoq et al. 2015)."""
        right, square = self.right[: len(codes)], np.square(self.x[: len(codes)]).sum(1)
        rest = right - codes @ self.gram
        shrink = np.minimum(1, self.penalty / np.abs(rest).max(axis=1))
        fit, cross = (codes * right).sum(1), (codes * rest).sum(1)
        remainder = square - fit - cross
        l1 = self.penalty * np.abs(codes).sum(1)
        gap = (1 + shrink**2) * remainder / 2 + l1 - shrink * (remainder + cross)
        return float((2 * gap / square).max())

    def scikit(self, name: str, options: dict[str, Any]) -> tuple[Contestant, NDArray[np.float64]]:
        """One call for one volume, a few in a run; and the codes found."""
        count = min(CALLS, len(self.x))

        def solve(i: int) -> NDArray[np.float64]:
            found = sparse_encode(
                self.x[i : i + 1],
                self.atoms,
                gram=self.gram,
                cov=np.ascontiguousarray(self.right[i : i + 1].T),
                algorithm=name,
                check_input=False,
                **options,
            )
            return np.asarray(found[0])

        codes = np.stack([solve(i) for i in range(count)])
        return Contestant(lambda: [solve(i) for i in range(count)], count), codes

    def spams(self, threads: int) -> tuple[Contestant, NDArray[np.float64]]:
        """All volumes in one call; and the codes found."""
        import spams

        x, gram, right = (np.asfortranarray(a) for a in (self.x.T, self.gram, self.right.T))

        def solve() -> Any:
            return spams.lasso(x, Q=gram, q=right, lambda1=self.penalty, mode=2, numThreads=threads)

        codes = np.asarray(solve().todense()).T
        return Contestant(solve, len(self.x), clock=WALL if threads > 1 else THREAD), codes
