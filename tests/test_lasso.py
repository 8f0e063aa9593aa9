"""The lasso solver: its certificate where problems are degenerate, and that nothing drifts."""

import dataclasses

import naive
import numpy as np
import pytest
from kernel_table import assert_certified, lasso_scratch, with_response
from streams import GAP, random_encoder, random_events

from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.events import make_events
from streamfeat.kernels.lasso import CODE, RESPONSE, solve_lasso


def solve(atoms, x, penalty, gap=GAP, start=None):
    """Solve from a code (or from nothing); the gap that was reached, and the code with its response."""
    gram = (atoms @ atoms.T).astype(np.float32)
    kept = with_response(gram, np.zeros(len(atoms)) if start is None else start)
    work, chosen, corners = lasso_scratch(len(atoms))
    right, square = atoms @ x, float(x @ x)
    reached = solve_lasso(right, square, penalty, gram, gap, kept, work[1:], chosen, corners)
    residual = right - gram.astype(np.float64) @ kept[CODE]
    own = naive.duality_gap(residual, right, kept[CODE], square, penalty) / max(square / 2, 1e-300)
    assert own == pytest.approx(reached, abs=1e-9)  # that of all atoms, not of the working set alone
    return reached, kept


def degenerate(rng):
    """`(name, atoms, x)`: twice the same atom, its negative, one of length zero, more atoms than entries."""
    x = rng.normal(size=8)
    atoms = rng.normal(size=(5, 8)) / np.sqrt(8)
    yield "duplicates", np.concatenate([atoms, atoms, -atoms]), x
    yield "of length zero", np.concatenate([atoms, np.zeros((3, 8))]), x
    yield "all of length zero", np.zeros((4, 8)), x
    yield "nearly the same", atoms[:1] + 1e-3 * rng.normal(size=(40, 8)), x
    yield "overcomplete", rng.normal(size=(100, 8)) / np.sqrt(8), x
    yield "nothing to explain", atoms, np.zeros(8)
    yield "in the span of one atom", atoms, 3 * atoms[0]
    yield "of very different lengths", atoms * np.array([1e-6, 1e-3, 1, 30, 100])[:, None], x


@pytest.mark.parametrize("penalty", [1e-2, 0.3, 100.0])
@pytest.mark.parametrize("seed", range(5))
def test_degenerate_problems_end_within_the_gap(seed, penalty):
    rng = np.random.default_rng(seed)
    for name, atoms, x in degenerate(rng):
        for start in (None, rng.normal(size=len(atoms)) * np.linalg.norm(atoms, axis=1)):
            reached, kept = solve(atoms, x, penalty, start=start)
            assert np.isfinite(kept).all(), name
            if x.any() or start is None:
                assert reached <= GAP, name


@pytest.mark.parametrize("seed", range(400, 500))
def test_descent_that_creeps_is_extrapolated(seed):
    """Few dimensions, many atoms, a small penalty: weights move between atoms by tiny steps.

    One seed in a hundred took tens of thousands of sweeps, or 256,000 without arriving.
    """
    geometry = Geometry(patch=2, stride=1, n_bins=1, bin_us=1)
    encoder = random_encoder(np.random.default_rng(seed), geometry, 33, "inverse", "split", threshold=0.02)
    engine = Engine(encoder, (2, 2), origin_us=0)
    engine.feed(make_events([0], [1], [1], [0]))
    engine.features()
    assert_certified(engine._operator, engine._state)


def test_weights_that_creep_between_dependent_atoms_arrive():
    """Seven atoms in use in five dimensions: without a line search 256,000 sweeps were not enough."""
    geometry = Geometry(patch=(1, 3), stride=1, n_bins=2, bin_us=1)
    encoder = random_encoder(np.random.default_rng(285), geometry, 31, "inverse", "split", threshold=0.02)
    engine = Engine(encoder, (1, 3), origin_us=0)
    engine.feed(make_events([1], [0], [0], [0]))
    engine.features()
    assert_certified(engine._operator, engine._state)


def test_a_gap_below_float_rounding_ends():
    rng = np.random.default_rng(0)
    atoms = rng.normal(size=(20, 8)) / np.sqrt(8)
    reached, _ = solve(atoms, rng.normal(size=8), 0.1, gap=1e-300)
    assert reached < 1e-12


def test_a_code_within_the_gap_is_left_as_it_is():
    rng = np.random.default_rng(1)
    atoms, x = rng.normal(size=(40, 20)) / np.sqrt(20), rng.normal(size=20)
    _, first = solve(atoms, x, 0.1)
    reached, again = solve(atoms, x, 0.1, start=first[CODE])
    assert reached <= GAP
    np.testing.assert_array_equal(again[CODE], first[CODE])


@pytest.mark.parametrize("look_ahead", [False, True])
def test_responses_do_not_drift_in_a_long_stream(look_ahead):
    rng = np.random.default_rng(2)
    geometry = Geometry(patch=4, stride=2, n_bins=3, bin_us=100_000, max_count=3)
    encoder = random_encoder(rng, geometry, 60, "inverse", "soft", threshold=0.3)
    engine = Engine(encoder, (10, 10), look_ahead=look_ahead)
    events = random_events(rng, geometry, (10, 10), 6000, n_windows=1.0)
    engine.follow(events[np.argsort(events["t"])])
    engine.features()
    assert engine.stats().encoded_volumes > 5000
    assert_certified(engine._operator, engine._state)
    code, response = engine._state.atoms[engine._state.clock[4], :, [CODE, RESPONSE]]
    expected = code @ engine._operator.gram.astype(np.float64)
    np.testing.assert_allclose(response, expected, rtol=0, atol=1e-12 * np.abs(code).sum(axis=1).max())


def test_codes_of_a_snapshot_that_do_not_belong_to_a_volume_do_no_harm():
    rng = np.random.default_rng(3)
    geometry = Geometry(patch=4, stride=2, n_bins=3, bin_us=1000)
    encoder = random_encoder(rng, geometry, 20, "inverse", "soft")
    engine = Engine(encoder, (10, 10))
    snapshot = engine.snapshot()
    engine.restore(dataclasses.replace(snapshot, atoms=np.ones_like(snapshot.atoms)))
    events = random_events(rng, geometry, (10, 10), 30, n_windows=1.0)
    engine.follow(events)
    engine.features()
    assert_certified(engine._operator, engine._state)
