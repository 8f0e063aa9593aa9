"""Learning: objectives that never rise, solutions that are solutions, fair samples of volumes."""

import numpy as np
import pytest
import tiny
from sklearn.decomposition import sparse_encode
from sklearn.utils.estimator_checks import parametrize_with_checks

from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.geometry import Geometry
from streamfeat.learn.dictionary import DictionaryLearner
from streamfeat.learn.fit import bin_length, learn_encoder
from streamfeat.learn.transform import TransformLearner
from streamfeat.learn.volumes import Window, sample_volumes, windows_of
from streamfeat.learn.whitening import VolumeWhitener
from streamfeat.recording import Label, open_recording

D = 12


def white_volumes(n=400, d=D, seed=0):
    """Sparse combinations of a few directions, and noise."""
    rng = np.random.default_rng(seed)
    codes = rng.standard_normal((n, 8)) * (rng.random((n, 8)) < 0.3)
    x = codes @ rng.standard_normal((8, d)) + 0.2 * rng.standard_normal((n, d))
    return x.astype(np.float32)


@parametrize_with_checks(
    [
        TransformLearner(5, max_iter=3, random_state=0),
        DictionaryLearner(5, max_iter=3, random_state=0),
        VolumeWhitener(),
    ]
)
def test_estimators_are_scikit_learn_estimators(estimator, check):
    check(estimator)


# --- the direct formulation

WEIGHTS = [
    {"conditioning": 0.1, "coherence": 0.1, "log_det": 0.1},
    {"conditioning": 0.0, "coherence": 0.0, "log_det": 0.0},
    {"conditioning": 0.0, "coherence": 2.0, "log_det": 0.0},
    {"conditioning": 1.0, "coherence": 0.0, "log_det": 0.5},
    {"conditioning": 0.01, "coherence": 5.0, "log_det": 0.01},
]


@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("k", [D - 5, D, D + 9])
def test_transform_objective_never_rises(k, weights):
    white = white_volumes()
    learner = TransformLearner(k, max_iter=12, tol=0.0, random_state=1, chunk_size=150, **weights).fit(white)
    assert len(learner.objective_) == 2 * learner.n_iter_ == 2 * len(learner.condition_)
    # Codes are float32: a step may seem to rise by their rounding.
    rounding = 1e-6 * np.abs(learner.objective_[0])
    assert np.diff(learner.objective_).max() <= rounding
    assert learner.objective_[-1] < learner.objective_[0]


@pytest.mark.parametrize("weights", WEIGHTS)
def test_transform_objective_is_the_published_one(weights):
    white = white_volumes(300).astype(np.float64)
    last = TransformLearner(D + 4, threshold=0.4, max_iter=2, tol=0.0, random_state=0, **weights)
    before = TransformLearner(D + 4, threshold=0.4, max_iter=1, tol=0.0, random_state=0, **weights)
    last.fit(white)
    transform = before.fit(white).components_.astype(np.float64)
    z = white @ transform.T
    codes = np.sign(z) * np.maximum(np.abs(z) - 0.4, 0)
    value = (0.5 * np.sum((z - codes) ** 2) + 0.4 * np.abs(codes).sum()) / len(white)
    value += weights["conditioning"] / 2 * np.sum(transform**2)
    # |A'A - I|^2 is (sigma^2 - 1)^2 summed over all d singular values.
    value += weights["coherence"] / 4 * np.sum((transform.T @ transform - np.eye(D)) ** 2)
    if weights["log_det"]:
        value -= weights["log_det"] * np.linalg.slogdet(transform.T @ transform)[1]
    assert last.objective_[2] == pytest.approx(value, rel=1e-5)
    assert np.allclose(before.transform(white), codes, atol=1e-4)


@pytest.mark.parametrize("k", [D - 5, D, D + 9])
def test_transform_step_is_least_squares_without_coherence_and_determinant(k):
    white = white_volumes().astype(np.float64)
    learner = TransformLearner(k, threshold=0.4, conditioning=0.3, coherence=0, log_det=0, max_iter=1)
    learner.set_params(random_state=3).fit(white)
    start = start_of(white, k, 3)
    z = white @ start.T
    codes = z - z.clip(-0.4, 0.4)
    # The ridge problem 1/2n |A X - L|^2 + c/2 |A|^2.
    gram = white.T @ white / len(white) + 0.3 * np.eye(D)
    assert np.allclose(learner.components_, np.linalg.solve(gram, white.T @ codes / len(white)).T, atol=1e-5)


def start_of(white, k, seed):
    from sklearn.utils import check_random_state

    from streamfeat.learn.initial import random_directions

    return random_directions(white.astype(np.float32), k, check_random_state(seed)).astype(np.float64)


@pytest.mark.parametrize(("k", "log_det"), [(D - 5, 0.0), (D, 0.4), (D + 9, 0.4), (D + 9, 0.0)])
def test_closed_form_is_the_minimiser_for_fixed_codes(k, log_det):
    white = white_volumes().astype(np.float64)
    learner = TransformLearner(
        k, threshold=0.2, conditioning=0.2, coherence=0.0, log_det=log_det, max_iter=1, random_state=5
    )
    found = learner.fit(white).components_.astype(np.float64)
    z = white @ start_of(white, k, 5).T
    codes = z - z.clip(-0.2, 0.2)

    def smooth(transform):
        fit = 0.5 * np.sum((white @ transform.T - codes) ** 2) / len(white)
        squares = np.linalg.svd(transform, compute_uv=False) ** 2
        return fit + 0.1 * squares.sum() - (log_det * np.log(squares).sum() if log_det else 0)

    best = smooth(found)
    rng = np.random.default_rng(0)
    for size in (1e-3, 1e-2, 0.1, 1.0):
        for _ in range(20):
            assert smooth(found + size * rng.standard_normal(found.shape)) > best - 1e-9


def test_transform_is_reproducible_and_reports():
    white = white_volumes()
    told = []
    make = {"max_iter": 5, "tol": 0.0, "random_state": 7}
    one = TransformLearner(15, **make, progress=lambda i, value: told.append((i, value))).fit(white)
    two = TransformLearner(15, **make).fit(white)
    other = TransformLearner(15, **(make | {"random_state": 8})).fit(white)
    assert np.array_equal(one.components_, two.components_)
    assert not np.array_equal(one.components_, other.components_)
    assert told == list(zip(range(1, 6), one.objective_[1::2], strict=True))
    assert one.condition_[-1] == pytest.approx(np.linalg.cond(one.components_), rel=1e-4)


def test_conditioning_terms_condition_the_transform():
    white = white_volumes() * np.linspace(0.2, 3, D, dtype=np.float32)
    bare = TransformLearner(20, conditioning=0, coherence=0, log_det=0, random_state=0).fit(white)
    firm = TransformLearner(20, conditioning=1, coherence=1, log_det=1, random_state=0).fit(white)
    assert firm.condition_[-1] < bare.condition_[-1] / 2


@pytest.mark.parametrize("weights", WEIGHTS)
def test_a_threshold_above_all_codes_is_survived(weights):
    learner = TransformLearner(D + 3, threshold=1e6, max_iter=3, random_state=0, **weights)
    learner.fit(white_volumes())
    assert np.isfinite(learner.components_).all()
    assert not learner.transform(white_volumes()).any()


def test_transform_refusals():
    with pytest.raises(InputError, match="must not be negative"):
        TransformLearner(5, coherence=-1).fit(white_volumes())
    with pytest.raises(InputError, match="at least one"):
        TransformLearner(0).fit(white_volumes())
    with pytest.raises(InputError, match="constant"):
        TransformLearner(5).fit(np.zeros((50, D), np.float32))


# --- the inverse formulation


@pytest.mark.parametrize("k", [D - 5, D, 2 * D])
def test_dictionary_objective_never_rises(k):
    learner = DictionaryLearner(
        k, threshold=0.3, max_iter=8, tol=0.0, gap=1e-6, chunk_size=150, random_state=1
    )
    white = white_volumes()
    learner.fit(white)
    energy = 0.5 * np.square(white).sum() / len(white)
    assert len(learner.objective_) == 2 * learner.n_iter_
    assert np.diff(learner.objective_).max() <= 2e-6 * energy
    assert learner.objective_[-1] < 0.9 * learner.objective_[0]
    assert np.linalg.norm(learner.components_, axis=1).max() <= 1 + 1e-6


def test_dictionary_objective_and_codes_are_those_of_the_lasso():
    white = white_volumes(120)
    learner = DictionaryLearner(20, threshold=0.3, max_iter=3, tol=0.0, gap=1e-7, random_state=2).fit(white)
    atoms = learner.components_.astype(np.float64)
    codes = learner.transform(white)
    reference = sparse_encode(
        white.astype(np.float64), atoms, algorithm="lasso_cd", alpha=0.3, max_iter=10_000
    )

    def objective(codes):
        return 0.5 * np.square(white - codes @ atoms).sum(axis=1) + 0.3 * np.abs(codes).sum(axis=1)

    allowed = 1e-6 * np.square(white).sum(axis=1) + 1e-6
    assert np.all(objective(codes) <= objective(reference) + allowed)
    again = DictionaryLearner(20, threshold=0.3, max_iter=4, tol=0.0, gap=1e-7, random_state=2).fit(white)
    assert again.objective_[6] == pytest.approx(objective(codes).mean(), rel=1e-4)
    assert np.array_equal(again.objective_[:6], learner.objective_)


def test_atoms_are_updated_within_the_unit_ball():
    gram, cross = np.diag([4.0, 1.0, 0.0]), np.diag([1.0, 3.0, 5.0])
    atoms = DictionaryLearner._update_atoms(np.eye(3, dtype=np.float32), gram, cross)
    # The best first atom lies inside, the best second outside, and nothing uses the third.
    assert np.array_equal(atoms, np.diag([0.25, 1.0, 1.0]))


def test_unused_atoms_are_replaced_by_what_is_represented_worst():
    # 39 volumes along one direction, one along another that the dictionary does not know.
    white = np.zeros((40, D), np.float32)
    white[:, 0] = 5
    white[17] = 0
    white[17, 3] = 7
    learner = DictionaryLearner(3, threshold=0.5, max_iter=1, random_state=0)
    atoms = np.zeros((3, D), np.float32)
    atoms[:, :3] = np.eye(3)
    codes = np.zeros((40, 3), np.float32)
    learner.replaced_ = 0
    learner._code(white, atoms, codes)
    gram, _, _ = learner._sums(white, codes)
    learner._replace_unused(white, atoms, codes, gram)
    assert learner.replaced_ == 2
    assert np.array_equal(atoms[0], np.eye(D)[0])
    assert sorted(atoms[1:].argmax(axis=1).tolist()) == [0, 3]


def test_dictionary_refusals_and_seed():
    with pytest.raises(InputError, match="above zero"):
        DictionaryLearner(5, threshold=0).fit(white_volumes())
    one, two = (DictionaryLearner(9, max_iter=2, random_state=3).fit(white_volumes()) for _ in range(2))
    assert np.array_equal(one.components_, two.components_)


# --- whitening


def test_whitening_is_zca():
    rng = np.random.default_rng(0)
    volumes = np.rint(rng.standard_normal((3000, D)) @ rng.standard_normal((D, D))).astype(np.int16)
    whitener = VolumeWhitener(eps=0.01, eps_zca=1e-3, chunk_size=700).fit(volumes)
    white = whitener.transform(volumes)
    v = volumes.astype(np.float64)
    normal = v - v.mean(axis=1, keepdims=True)
    normal /= np.sqrt((normal**2).mean(axis=1, keepdims=True) + 0.01)
    values, vectors = np.linalg.eigh(np.cov(normal.T, bias=True))
    expected = vectors @ np.diag(1 / np.sqrt(values + 1e-3)) @ vectors.T
    assert np.allclose(whitener.mean_, normal.mean(axis=0), atol=1e-6)
    # The direction of the mean has no variance at all: rounding decides there, times 1/sqrt(eps_zca).
    assert np.allclose(whitener.whitening_, expected, atol=1e-3)
    assert np.allclose(white, (normal - normal.mean(axis=0)) @ expected, atol=1e-3)
    covariance = np.cov(white.T.astype(np.float64), bias=True)
    without_mean = np.eye(D) - 1 / D
    assert np.allclose(covariance, without_mean, atol=0.05)


def test_whitening_does_not_touch_its_input():
    volumes = np.arange(60, dtype=np.int16).reshape(5, 12) % 7
    before = volumes.copy()
    VolumeWhitener().fit_transform(volumes)
    assert np.array_equal(volumes, before)


# --- volumes

POINT = Geometry(patch=1, stride=1, n_bins=1, bin_us=1000, max_count=1000)


def window(value, *, shape=(1, 1), n=1):
    """A window whose every pixel counts `value`, on `n` of its pixels."""
    y, x = np.divmod(np.arange(n), shape[1])
    events = make_events(np.repeat(x, value), np.repeat(y, value), 1, np.zeros(n * value, np.int64))
    return Window(events, shape, 0, 999)


def test_volumes_of_a_known_stream():
    geometry = Geometry(patch=2, stride=1, n_bins=2, bin_us=100, max_count=2)
    events = make_events(
        [0, 1, 1, 1, 1, 0, 0], [0, 0, 1, 1, 1, 1, 1], [1, 0, 1, 1, 1, 0, 1], [*range(0, 140, 20)]
    )
    found = sample_volumes([Window(events, (2, 2), 0, 199)], geometry, 3, np.random.default_rng(0))
    # Bin by bin, row by row; three ON events are clipped to two; the last two fall into the second bin.
    expected = [1, -1, 0, 2, 0, 0, 0, 0]
    expected[6] += -1 + 1
    assert found.counts.tolist() == [expected] * 3
    assert found.counts.dtype == np.int16
    assert (found.empty_share, found.windows) == (0.0, 1)


def test_windows_have_equal_chances():
    counts = np.zeros(11)
    rng = np.random.default_rng(0)
    for _ in range(60):
        found = sample_volumes((window(v) for v in range(1, 11)), POINT, 40, rng, per_window=16)
        assert len(found.counts) == 40
        counts += np.bincount(found.counts[:, 0], minlength=11)
    # 2,400 draws, 240 expected of each window; one in 10,000 for a chi square of 33.7 with 9 degrees.
    assert np.square(counts[1:] - 240).sum() / 240 < 33.7


def test_places_have_equal_chances():
    y, x = np.divmod(np.arange(6), 3)
    events = make_events(np.repeat(x, y * 3 + x + 1), np.repeat(y, y * 3 + x + 1), 1, np.zeros(21, np.int64))
    windows = [Window(events, (2, 3), 0, 999)] * 40
    found = sample_volumes(windows, POINT, 10_000, np.random.default_rng(0), per_window=60)
    counts = np.bincount(found.counts[:, 0], minlength=7)[1:]
    assert counts.sum() == 2400
    assert np.square(counts - 400).sum() / 400 < 25.7


def test_empty_places_are_drawn_again_and_counted():
    windows = [window(3, shape=(4, 4), n=4)] * 50
    found = sample_volumes(windows, POINT, 10_000, np.random.default_rng(0), per_window=8)
    assert (found.counts == 3).all()
    assert found.empty_share == pytest.approx(0.75, abs=0.04)


def test_too_small_windows_are_passed_over():
    geometry = Geometry(patch=3, stride=1, n_bins=1, bin_us=1000)
    with pytest.raises(InputError, match=r"no local volume of 3x3 .* 0 windows"):
        sample_volumes([window(1, shape=(2, 9))], geometry, 5, np.random.default_rng(0))
    with pytest.raises(InputError, match="1 windows"):
        sample_volumes([window(1, shape=(9, 9), n=0)], geometry, 5, np.random.default_rng(0))


def test_windows_of_labelled_items():
    items = tiny.labelled_items(3)
    held_out = Label(5_000_000, 80_000, "cat", "test", "")
    items += [held_out, tiny.packet(tiny.steady(5_000_000, 5_080_000, 20))]
    found = list(windows_of(items, tiny.GEOMETRY))
    labels = [item for item in items[:-2] if isinstance(item, Label)]
    assert [w.origin_us for w in found] == [label.start_us for label in labels]
    assert [w.last_us for w in found] == [label.start_us + label.duration_us - 1 for label in labels]
    assert [len(w.events) for w in found] == [300] * 3
    assert all(w.resolution == tiny.RESOLUTION for w in found)


@pytest.mark.parametrize("split", ["validation", "valid", "val", "test"])
def test_held_out_splits_are_not_looked_at(split):
    items = [Label(0, 1000, "cat", split, ""), tiny.packet(tiny.steady(0, 1000, 20))]
    assert list(windows_of(items, tiny.GEOMETRY)) == []


def test_windows_of_unlabelled_items():
    size = tiny.GEOMETRY.window_us
    events = tiny.steady(7_000, 7_000 + 10 * size, 2000)
    events["t"][1500:] += 5 * size
    expected, rest = [], events["t"]
    while len(rest):
        n = int(np.searchsorted(rest, rest[0] + size))
        expected.append((n, rest[0], rest[0] + size - 1))
        rest = rest[n:]
    assert len(expected) > 9
    for cut in (2000, 130, 1):
        items = [tiny.packet(events[i : i + cut]) for i in range(0, 2000, cut)]
        found = list(windows_of(items, tiny.GEOMETRY))
        assert [(len(w.events), w.origin_us, w.last_us) for w in found] == expected


def test_windows_end_where_the_resolution_changes():
    first, second = tiny.steady(0, 1000, 10), tiny.steady(1000, 2000, 20, resolution=(8, 8))
    found = list(windows_of([tiny.packet(first), tiny.packet(second, (8, 8))], tiny.GEOMETRY))
    assert [(len(w.events), w.resolution) for w in found] == [(10, tiny.RESOLUTION), (20, (8, 8))]


# --- all of it


@pytest.mark.parametrize("formulation", ["direct", "inverse"])
def test_learn_encoder(tmp_path, formulation):
    path = tiny.write_items(tmp_path / "a.mcap", tiny.labelled_items(6))
    told = []
    with open_recording(path) as recording:
        model, again = (
            learn_encoder(
                [recording],
                tiny.GEOMETRY,
                formulation=formulation,
                n_filters=7,
                n_volumes=200,
                max_iter=2,
                seed=4,
                report=lambda *step: told.append(step),
            )
            for _ in range(2)
        )
    assert (model.n_filters, model.formulation, model.geometry) == (7, formulation, tiny.GEOMETRY)
    assert model.fingerprint == again.fingerprint
    assert model.provenance["windows"] == 6
    assert model.provenance["volumes"] == 200
    assert model.provenance["recordings"] == ["a.mcap"]
    assert {step[0] for step in told} == {"reading windows", "whitening", "learning"}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"formulation": "sideways"}, "formulation is 'sideways'"),
        ({"encoding": "loud"}, "encoding is 'loud'"),
        ({"n_volumes": 1}, "at least two volumes"),
        ({"max_iter": 0}, "one iteration"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**40}, "seed"),
        ({"threshold": float("nan")}, "threshold"),
        ({"n_filters": 0}, "one filter"),
    ],
)
def test_bad_parameters_are_refused_before_any_work(tmp_path, change, reason):
    path = tiny.write_items(tmp_path / "a.mcap", tiny.labelled_items(2))
    with open_recording(path) as recording, pytest.raises(InputError, match=reason):
        learn_encoder([recording], tiny.GEOMETRY, **({"n_filters": 5, "n_volumes": 50} | change))


def test_bin_length(tmp_path):
    labelled = tiny.write_items(tmp_path / "a.mcap", tiny.labelled_items(2, duration_us=90_001))
    with open_recording(labelled) as recording:
        assert bin_length([recording], 3, None) == 30_001
        assert bin_length([recording], 3, 30) == 10_000
        assert bin_length([], 4, None) == 25_000
        for n_bins, window_ms in ((0, None), (3, 0.0), (3, float("nan"))):
            with pytest.raises(InputError):
                bin_length([recording], n_bins, window_ms)
