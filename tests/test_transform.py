"""The direct formulation: an objective that is the published one, never rises and never stalls."""

import functools

import numpy as np
import pytest
import tiny
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize, minimize_scalar

from streamfeat.errors import InputError
from streamfeat.learn.initial import random_directions
from streamfeat.learn.omega import Omega, condition_number, mutual_coherence
from streamfeat.learn.transform import TransformLearner, _closed_form, _positive_root, _Quadratic, _update

FreeLearner = functools.partial(TransformLearner, rows="free", start="random")

D = 12

WEIGHTS = [
    {"conditioning": 0.1, "coherence": 0.1, "log_det": 0.1},
    {"conditioning": 0.0, "coherence": 0.0, "log_det": 0.0},
    {"conditioning": 0.0, "coherence": 2.0, "log_det": 0.0},
    {"conditioning": 1.0, "coherence": 0.0, "log_det": 0.5},
    {"conditioning": 0.01, "coherence": 5.0, "log_det": 0.01},
]

weights = st.sampled_from([0.0, 0.01, 0.1, 1.0, 10.0])


def assert_never_rises(objective, white):
    # Codes are float32: a step may seem to rise by their rounding.
    energy = np.square(white).sum() / len(white)
    assert np.isfinite(objective).all()
    assert np.diff(objective).max() <= 1e-6 * (np.abs(objective).max() + energy)


def moment_of(white, conditioning=0.0):
    return (white.T @ white / len(white)).astype(float) + conditioning * np.eye(white.shape[1])


def problem_of(white, k, *, threshold=0.4, seed=0, conditioning=0.0, **omega):
    """The transform half-step that follows the first codes, with the transform that those are of."""
    start = random_directions(white, np.square(white).sum(axis=1), k, np.random.RandomState(seed))
    z = white @ start.T
    codes = z - z.clip(-threshold, threshold)
    cross = (codes.T @ white / len(white)).astype(float)
    return _Quadratic(moment_of(white, conditioning), cross, Omega(**omega)), start.astype(float)


def best_of(problem, start):
    """The minimum for fixed codes, by L-BFGS."""

    def both(flat):
        A = flat.reshape(start.shape)
        return problem.value(A), problem.gradient(A).ravel()

    return minimize(both, start.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 5000}).fun


@settings(max_examples=25)
@given(
    k=st.integers(1, 2 * D),
    d=st.sampled_from([2, 5, D]),
    threshold=st.sampled_from([0.0, 0.1, 0.5, 3.0]),
    conditioning=weights,
    coherence=weights,
    log_det=weights,
    seed=st.integers(0, 2**32 - 1),
)
def test_the_objective_never_rises(k, d, threshold, conditioning, coherence, log_det, seed):
    learner = FreeLearner(
        k,
        threshold=threshold,
        conditioning=conditioning,
        coherence=coherence,
        log_det=log_det,
        max_iter=6,
        tol=0.0,
        chunk_size=150,
        random_state=seed,
    )
    white = tiny.white_volumes(200, d)
    learner.fit(white)
    assert len(learner.objective_) == 2 * learner.n_iter_ == 2 * len(learner.condition_)
    assert_never_rises(learner.objective_, white)


@pytest.mark.parametrize("omega", WEIGHTS)
@pytest.mark.parametrize("k", [40, 72, 110])
def test_the_objective_never_rises_on_real_volumes(shared_data, k, omega):
    white = tiny.real_white_volumes(shared_data)
    learner = FreeLearner(k, max_iter=8, tol=0.0, random_state=0, **omega).fit(white)
    assert_never_rises(learner.objective_, white)
    assert learner.objective_[-1] < learner.objective_[0]


@pytest.mark.parametrize("omega", WEIGHTS)
@pytest.mark.parametrize("k", [D - 5, D, D + 4])
def test_the_objective_is_the_published_one(k, omega):
    white = tiny.white_volumes(300).astype(np.float64)
    make = {"threshold": 0.4, "tol": 0.0, "random_state": 0} | omega
    last = FreeLearner(k, max_iter=2, **make).fit(white)
    before = FreeLearner(k, max_iter=1, **make).fit(white)
    A = before.components_.astype(np.float64)
    z = white @ A.T
    codes = np.sign(z) * np.maximum(np.abs(z) - 0.4, 0)
    value = (0.5 * np.sum((z - codes) ** 2) + 0.4 * np.abs(codes).sum()) / len(white)
    value += omega["conditioning"] / 2 * np.sum(A**2)
    # Written with the inner products between filters; as printed it differs by a constant.
    value += omega["coherence"] / 4 * (np.sum((A @ A.T - np.eye(k)) ** 2) + D - k)
    gram = A.T @ A if k >= D else A @ moment_of(white, omega["conditioning"]) @ A.T
    if omega["log_det"]:
        value -= omega["log_det"] * np.linalg.slogdet(gram)[1]
    assert last.objective_[2] == pytest.approx(value, rel=1e-5)
    assert np.allclose(before.transform(white), codes, atol=1e-4)


@pytest.mark.parametrize("omega", WEIGHTS)
@pytest.mark.parametrize("shape", [(7, D), (D, D), (20, D), (1, 3)])
def test_the_gradient_is_that_of_the_penalty(shape, omega):
    rng = np.random.default_rng(0)
    rows, way = rng.standard_normal((2, *shape))
    penalty, moment = Omega(**omega), moment_of(rng.standard_normal((30, shape[1])))
    values = [penalty.value(rows + step * way, moment) for step in (1e-6, -1e-6)]
    slope = (values[0] - values[1]) / 2e-6
    assert slope == pytest.approx(np.sum(penalty.gradient(rows, moment) * way), rel=1e-5, abs=1e-6)


def test_a_singular_transform_has_no_log_determinant():
    assert Omega(log_det=0.1).value(np.ones((4, 3))) == np.inf
    assert Omega(coherence=1.0).value(np.eye(3)) == 0.0


@given(
    sigma=st.floats(0, 100),
    coherence=st.floats(0, 100),
    shrink=st.floats(1e-3, 1e3),
    log_det=st.floats(1e-6, 10),
)
def test_the_quartic_is_solved(sigma, coherence, shrink, log_det):
    def value(g):
        penalty = coherence / 4 * (shrink * g * g - 1) ** 2 - 2 * log_det * np.log(g)
        return g * g / 2 - sigma * g + penalty

    root = _positive_root(np.array([sigma]), coherence, np.array([shrink]), log_det)[0]
    reference = minimize_scalar(value, bounds=(1e-9, 2 * root + 1), method="bounded")
    assert value(root) <= reference.fun + 1e-9 * max(1, abs(reference.fun))


@pytest.mark.parametrize(("k", "log_det"), [(D - 5, 0.0), (D - 5, 0.4), (D, 0.4), (D + 9, 0.4), (D + 9, 0.0)])
def test_the_closed_form_is_the_minimum_without_coherence(k, log_det):
    problem, start = problem_of(tiny.white_volumes(), k, conditioning=0.2, log_det=log_det)
    found = _closed_form(problem)
    assert np.abs(problem.gradient(found)).max() < 1e-8
    assert problem.value(found) <= best_of(problem, start) + 1e-8


@pytest.mark.parametrize("coherence", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("k", [D - 5, D, D + 9])
def test_an_update_comes_near_the_minimum_where_the_closed_form_does_not(k, coherence):
    # Unequal variances, so that the singular basis of L X' S^-T is not the best.
    white = tiny.white_volumes() * np.linspace(0.2, 3, D, dtype=np.float32)
    problem, start = problem_of(white, k, coherence=coherence, log_det=0.01)
    best, before = best_of(problem, start), problem.value(start)
    found = start
    for _ in range(5):
        found = _update(problem, found, problem.value(found))
    candidate = problem.value(_closed_form(problem))
    assert problem.value(found) - best < 0.02 * (before - best)
    assert problem.value(found) < candidate


@pytest.mark.parametrize("coherence", [0.1, 1.0])
def test_coherence_alone_does_not_stall(coherence):
    white = tiny.white_volumes() * np.linspace(0.2, 3, D, dtype=np.float32)
    learner = FreeLearner(
        D + 9, conditioning=0, coherence=coherence, log_det=0, max_iter=200, tol=1e-7, random_state=0
    ).fit(white)
    # Where it stops, the gradient is zero, and not just the step refused.
    rows = learner.components_.astype(np.float64)
    codes = learner.transform(white)
    cross = codes.T @ white / len(white)
    problem = _Quadratic(moment_of(white), cross, Omega(coherence=coherence))
    start = random_directions(white, np.square(white).sum(axis=1), D + 9, np.random.RandomState(0)).astype(
        float
    )
    assert np.linalg.norm(problem.gradient(rows)) < 0.02 * np.linalg.norm(problem.gradient(start))


def test_condition_and_coherence_are_reported():
    white = tiny.white_volumes() * np.linspace(0.2, 3, D, dtype=np.float32)
    make = {"threshold": 0.1, "max_iter": 10, "random_state": 0}
    bare = FreeLearner(20, coherence=0, log_det=0.01, **make).fit(white)
    firm = FreeLearner(20, coherence=1, log_det=1, **make).fit(white)
    assert firm.condition_[-1] < bare.condition_[-1] / 2
    for learner in (bare, firm):
        assert learner.unused_ == 0
        rows = learner.components_.astype(np.float64)
        assert learner.condition_[-1] == pytest.approx(np.linalg.cond(rows), rel=1e-4)
        unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        cosines = [abs(unit[i] @ unit[j]) for i in range(20) for j in range(i)]
        assert learner.coherence_[-1] == pytest.approx(max(cosines), rel=1e-4)
    narrow = [FreeLearner(5, coherence=c, random_state=0).fit(white).coherence_[-1] for c in (0.0, 3.0, 30.0)]
    assert narrow[0] > narrow[1] > narrow[2]


def test_condition_and_coherence_of_degenerate_rows():
    assert condition_number(np.zeros((2, 3))) == np.inf
    assert condition_number(np.diag([4.0, 2.0, 0.0])) == pytest.approx(2)
    assert mutual_coherence(np.array([[1.0, 0.0], [0.0, 0.0], [-3.0, 0.0]])) == 1
    assert mutual_coherence(np.ones((1, 3))) == 0


@pytest.mark.parametrize("omega", WEIGHTS)
def test_a_threshold_above_all_codes_is_survived(omega):
    learner = FreeLearner(D + 3, threshold=1e6, max_iter=3, random_state=0, **omega)
    learner.fit(tiny.white_volumes())
    assert np.isfinite(learner.components_).all()
    assert learner.unused_ == D + 3
    assert not learner.transform(tiny.white_volumes()).any()


def test_fewer_filters_than_entries_have_the_other_determinant():
    learner = FreeLearner(D // 2, log_det=0.3, max_iter=3, tol=0.0, random_state=0)
    learner.fit(tiny.white_volumes())
    assert np.isfinite(learner.objective_).all()
    assert learner.condition_[-1] < 10


# --- unit rows


@pytest.mark.parametrize("start", ["kmeans", "random"])
def test_unit_rows_keep_their_length_and_lower_the_published_objective(start):
    white = tiny.white_volumes()
    learner = TransformLearner(20, threshold=0.5, start=start, max_iter=12, tol=0.0, random_state=0).fit(
        white
    )
    np.testing.assert_allclose(np.linalg.norm(learner.components_, axis=1), 1, rtol=1e-6)
    assert (np.diff(learner.objective_) <= 1e-9).all()
    assert learner.objective_[-1] < learner.objective_[0] - 1e-3
    # 1/2 |A X - L|^2 + lambda0 |L|_1 per volume, where |A X|^2 is that of white volumes.
    codes = learner.transform(white).astype(float)
    products = white.astype(float) @ learner.components_.T
    fit = 0.5 * 20 + np.mean(np.sum(0.5 * codes**2 - products * codes + 0.5 * np.abs(codes), axis=1))
    again = learner.set_params(warm_start=True, max_iter=1).fit(white)
    assert again.objective_[0] == pytest.approx(fit, rel=1e-6)


def test_unit_rows_are_in_the_direction_of_what_their_codes_respond_to():
    white = tiny.white_volumes()
    make = {"threshold": 0.4, "tol": 0.0, "random_state": 0}
    before = TransformLearner(9, max_iter=1, **make).fit(white)
    after = TransformLearner(9, max_iter=2, **make).fit(white)
    z = white @ before.components_.T
    expected = (np.sign(z) * np.maximum(np.abs(z) - 0.4, 0)).T @ white
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(after.components_, expected, atol=1e-4)


def test_a_filter_that_nothing_uses_stays():
    learner = TransformLearner(5, threshold=1e6, max_iter=2, tol=0.0, random_state=0)
    learner.fit(tiny.white_volumes())
    assert learner.unused_ == 5
    np.testing.assert_allclose(np.linalg.norm(learner.components_, axis=1), 1, rtol=1e-6)


def test_what_rows_and_start_can_be():
    for wrong in ({"rows": "long"}, {"start": "zero"}):
        with pytest.raises(InputError, match="must be"):
            TransformLearner(5, **wrong).fit(tiny.white_volumes())
