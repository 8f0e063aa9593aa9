"""The inverse formulation: codes that are lassos, atoms that never raise the objective."""

import numpy as np
import pytest
import tiny
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from sklearn.decomposition import MiniBatchDictionaryLearning, sparse_encode

from streamfeat.learn.dictionary import DictionaryLearner, _replace, _Sums, _sweep

D = 12


def lasso_objective(white, codes, atoms, penalty):
    error = 0.5 * np.square(white - codes @ atoms).sum(axis=1)
    return error + penalty * np.abs(codes).sum(axis=1)


def assert_never_rises(learner, white):
    energy = 0.5 * np.square(white).sum() / len(white)
    assert len(learner.objective_) == 2 * learner.n_iter_ == 2 * len(learner.coherence_)
    # Codes and their correlations are float32.
    assert np.diff(learner.objective_).max() <= 2e-6 * (energy + np.abs(learner.objective_).max())


@settings(max_examples=25)
@given(
    k=st.integers(1, 2 * D),
    d=st.sampled_from([2, 5, D]),
    threshold=st.sampled_from([0.05, 0.3, 2.0]),
    coherence=st.sampled_from([0.0, 0.01, 1.0, 30.0]),
    gap=st.sampled_from([1e-1, 1e-3, 1e-6]),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_objective_never_rises(k, d, threshold, coherence, gap, seed):
    white = tiny.white_volumes(200, d)
    learner = DictionaryLearner(
        k, threshold=threshold, coherence=coherence, max_iter=6, tol=0.0, gap=gap, chunk_size=150
    )
    learner.set_params(random_state=seed).fit(white)
    # A replaced atom may be more coherent with the others than the one it replaces.
    if not (coherence and learner.replaced_):
        assert_never_rises(learner, white)
    assert np.allclose(np.linalg.norm(learner.components_, axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("coherence", [0.0, 0.3, 10.0])
@pytest.mark.parametrize("k", [40, 72, 110])
def test_the_objective_never_rises_on_real_volumes(shared_data, k, coherence):
    white = tiny.real_white_volumes(shared_data)
    learner = DictionaryLearner(k, max_iter=6, tol=0.0, coherence=coherence, random_state=0).fit(white)
    assert_never_rises(learner, white)
    assert learner.objective_[-1] < learner.objective_[0]


def test_objective_and_codes_are_those_of_the_lasso():
    white = tiny.white_volumes(120)
    make = {"threshold": 0.3, "coherence": 0.7, "tol": 0.0, "gap": 1e-7, "random_state": 2}
    learner = DictionaryLearner(20, max_iter=3, **make).fit(white)
    assert learner.replaced_ == 0
    atoms = learner.components_.astype(np.float64)
    codes = learner.transform(white)
    reference = sparse_encode(
        white.astype(np.float64), atoms, algorithm="lasso_cd", alpha=0.3, max_iter=10_000
    )
    mine, other = (lasso_objective(white, found, atoms, 0.3) for found in (codes, reference))
    assert np.all(mine <= other + 1e-6 * np.square(white).sum(axis=1) + 1e-6)
    again = DictionaryLearner(20, max_iter=4, **make).fit(white)
    coherence = 0.7 / 4 * np.sum((atoms.T @ atoms - np.eye(D)) ** 2)
    assert again.objective_[6] == pytest.approx(mine.mean() + coherence, rel=1e-4)
    assert np.array_equal(again.objective_[:6], learner.objective_)


def sums_of(white, codes):
    n = len(white)
    return _Sums(codes.T @ codes / n, codes.T @ white / n, np.abs(codes).sum(axis=0) / n)


def test_a_sweep_is_the_approximate_ksvd_of_the_paper():
    rng = np.random.default_rng(0)
    white = rng.standard_normal((60, D))
    atoms = rng.standard_normal((7, D))
    atoms /= np.linalg.norm(atoms, axis=1, keepdims=True)
    codes = rng.standard_normal((60, 7)) * (rng.random((60, 7)) < 0.4)
    # Rubinstein, Zibulevsky and Elad (2008), algorithm 5, with the codes rescaled.
    expected, left = atoms.copy(), codes.copy()
    for j in range(7):
        error = white - left @ expected + np.outer(left[:, j], expected[j])
        expected[j] = error.T @ left[:, j]
        expected[j] /= np.linalg.norm(expected[j])
        best = (error @ expected[j]) @ left[:, j] - 0.2 * np.abs(left[:, j]).sum()
        left[:, j] *= max(best / (left[:, j] @ left[:, j]), 0)
    found, sums = atoms.copy(), sums_of(white, codes)
    scale = _sweep(found, sums, 0.2, 0.0)
    assert np.allclose(found, expected)
    assert np.allclose(codes * scale, left)
    after = sums_of(white, left)
    assert np.allclose(sums.gram, after.gram)
    assert np.allclose(sums.cross, after.cross)
    assert np.allclose(sums.l1, after.l1)
    value = lasso_objective(white, left, expected, 0.2).mean() - 0.5 * np.square(white).sum() / 60
    assert sums.objective(found, 0.2) == pytest.approx(value)


def test_sweeps_find_atoms_between_fit_and_coherence():
    rng = np.random.default_rng(1)
    start = np.eye(3, 4) + 0.5
    start /= np.linalg.norm(start, axis=1, keepdims=True)
    codes = rng.standard_normal((300, 3))
    white = codes @ start + 0.3 * rng.standard_normal((300, 4))

    def objective(rows):
        """Of atoms, in any length, and a scale for the codes of each."""
        atoms = rows[:, :4] / np.linalg.norm(rows[:, :4], axis=1, keepdims=True)
        fit = lasso_objective(white, codes * rows[:, 4], atoms, 0.01).mean()
        return fit + 0.5 / 4 * (np.sum((atoms @ atoms.T - np.eye(3)) ** 2) + 1)

    tries = [np.hstack([start, np.ones((3, 1))]) + 0.3 * rng.standard_normal((3, 5)) for _ in range(10)]
    best = min(minimize(lambda flat: objective(flat.reshape(3, 5)), one.ravel()).fun for one in tries)
    atoms, scale = start.copy(), np.ones(3)
    for _ in range(200):
        scale = scale * _sweep(atoms, sums_of(white, codes * scale), 0.01, 0.5)
    assert objective(np.column_stack([atoms, scale])) <= best + 1e-6


def test_an_unused_atom_stays_where_it_is_until_it_is_replaced():
    atoms, sums = np.eye(3), _Sums(np.diag([4.0, 1.0, 0.0]), np.diag([1.0, 3.0, 0.0]), np.zeros(3))
    assert np.array_equal(_sweep(atoms, sums, 0.1, 0.0), [0.25, 3.0, 1.0])
    assert np.array_equal(atoms, np.eye(3))


def test_unused_atoms_become_what_is_represented_worst():
    white = np.zeros((40, D), np.float32)
    white[:, 0] = 5
    white[17] = 0
    white[17, 3] = 7
    squares = np.square(white).sum(axis=1, dtype=float)
    rows = np.eye(3, D, dtype=np.float32)
    errors = np.full(40, 0.2)
    errors[[17, 20]] = 49, 1
    assert _replace(rows, np.array([1, 2]), white, squares, errors) == 2
    assert np.array_equal(rows, np.eye(D)[[0, 3, 0]])
    # A volume of zeros is nothing to become.
    assert _replace(rows, np.array([1, 2]), 0 * white, 0 * squares, errors) == 0


def test_atoms_without_use_are_replaced_in_learning():
    white = tiny.white_volumes(300)
    learner = DictionaryLearner(15, threshold=0.3, max_iter=1, random_state=0).fit(white)
    assert learner.unused_ == 0
    learner.components_[4:] = learner.components_[4]
    learner.set_params(warm_start=True, max_iter=1).fit(white)
    assert learner.unused_ >= 10
    learner.components_[4:] = learner.components_[4]
    learner.set_params(warm_start=True, max_iter=8, tol=0.0).fit(white)
    assert learner.replaced_ >= 10
    assert (np.abs(learner.transform(white)).max(axis=0) > 0).sum() > 12


def test_coherence_falls_with_its_weight_and_conditions_the_dictionary():
    white = tiny.white_volumes() * np.linspace(0.2, 3, D, dtype=np.float32)
    found = [
        DictionaryLearner(20, threshold=0.3, coherence=c, max_iter=20, random_state=0).fit(white)
        for c in (0.0, 1.0, 30.0)
    ]
    assert found[0].coherence_[-1] > found[1].coherence_[-1] > found[2].coherence_[-1]
    assert found[0].condition_[-1] > found[1].condition_[-1] > found[2].condition_[-1]
    assert found[2].condition_[-1] < 1.1


@pytest.mark.filterwarnings("ignore:Objective did not converge")
def test_fewer_passes_than_scikit_learn_for_a_lower_objective():
    white = tiny.white_volumes(1500, 30).astype(np.float64)
    mine = DictionaryLearner(45, threshold=0.3, coherence=0.0, max_iter=5, tol=0.0, random_state=0)
    mine.fit(white)
    other = MiniBatchDictionaryLearning(
        45, alpha=0.3, max_iter=5, batch_size=256, fit_algorithm="cd", random_state=0
    ).fit(white)
    values = []
    for atoms in (mine.components_.astype(np.float64), other.components_):
        codes = sparse_encode(white, atoms, algorithm="lasso_cd", alpha=0.3, max_iter=5000)
        values.append(lasso_objective(white, codes, atoms, 0.3).mean())
    assert values[0] <= values[1]
