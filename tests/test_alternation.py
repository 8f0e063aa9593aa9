"""What both learners share: seeds, stopping, interruption and resumption, chunks, refusals."""

import itertools
import tracemalloc

import numpy as np
import pytest
import tiny
from sklearn.base import clone
from sklearn.utils.estimator_checks import parametrize_with_checks

from streamfeat.errors import InputError
from streamfeat.learn import chunks
from streamfeat.learn.chunks import ChunkedVolumes
from streamfeat.learn.dictionary import DictionaryLearner
from streamfeat.learn.transform import TransformLearner
from streamfeat.learn.whitening import VolumeWhitener

D = 12

LEARNERS = [
    TransformLearner(15, tol=0.0, random_state=7),
    DictionaryLearner(15, tol=0.0, random_state=7, threshold=0.3, coherence=0.1),
]
learners = pytest.mark.parametrize("learner", LEARNERS, ids=lambda learner: type(learner).__name__)


@parametrize_with_checks(
    [TransformLearner(5, max_iter=3, random_state=0), DictionaryLearner(5, max_iter=3, random_state=0)]
)
def test_learners_are_scikit_learn_estimators(estimator, check):
    check(estimator)


@learners
def test_a_seed_decides_everything_and_progress_is_told(learner):
    white = tiny.white_volumes()
    told = []
    one = clone(learner).set_params(max_iter=5).fit(white)
    two = clone(learner).set_params(max_iter=5, progress=lambda *step: told.append(step)).fit(white)
    other = clone(learner).set_params(max_iter=5, random_state=8).fit(white)
    assert np.array_equal(one.components_, two.components_)
    assert not np.array_equal(one.components_, other.components_)
    assert told == list(zip(range(1, 6), one.objective_[1::2], strict=True))
    assert not one.interrupted_


@learners
def test_learning_stops_when_little_is_gained(learner):
    white = tiny.white_volumes()
    found = clone(learner).set_params(max_iter=100, tol=0.01).fit(white)
    gains = -np.diff(found.objective_[1::2]) / np.abs(found.objective_[3::2])
    assert 1 < found.n_iter_ < 100
    assert (gains[:-1] > 0.01).all()
    assert gains[-1] <= 0.01


class Interruption:
    """Ctrl-C, when volumes are made for the so-manieth time."""

    def __init__(self, times):
        self.left = itertools.count(times, -1)

    def __call__(self, rows):
        if next(self.left) < 0:
            raise KeyboardInterrupt
        return rows


@learners
def test_an_interruption_keeps_the_last_whole_iteration(learner):
    white = tiny.white_volumes()
    three = clone(learner).set_params(max_iter=3).fit(white)
    # One pass for the lengths, ten for the start.
    passes = 11 * 4
    an_iteration = 4 if isinstance(learner, TransformLearner) else 8
    late = ChunkedVolumes(white, 100, Interruption(passes + 3 * an_iteration + 2))
    found = clone(learner).set_params(max_iter=50).fit(late)
    assert found.interrupted_
    assert found.n_iter_ == 3
    assert np.allclose(found.components_, three.components_, atol=1e-3)
    assert found.transform(white).shape == (400, 15)
    found = clone(learner).fit(ChunkedVolumes(white, 100, Interruption(passes + 2)))
    assert (found.interrupted_, found.n_iter_, len(found.objective_)) == (True, 0, 0)


@learners
def test_ctrl_c_and_a_warm_start_are_as_if_nothing_had_happened(learner):
    white = tiny.white_volumes()
    whole = clone(learner).set_params(max_iter=7).fit(white)

    def ctrl_c(iteration, objective):
        if iteration == 3:
            raise KeyboardInterrupt

    parts = clone(learner).set_params(max_iter=7, progress=ctrl_c).fit(white)
    assert (parts.interrupted_, parts.n_iter_) == (True, 3)
    first = parts.objective_
    parts.set_params(progress=None, warm_start=True, max_iter=4).fit(white)
    assert not parts.interrupted_
    if isinstance(learner, TransformLearner):
        assert np.array_equal(parts.components_, whole.components_)
        assert np.array_equal([*first, *parts.objective_], whole.objective_)
    else:
        # Codes start from zero again, and are the same within the duality gap.
        assert np.array_equal(first, whole.objective_[:6])
        assert parts.objective_[-1] == pytest.approx(whole.objective_[-1], rel=0.01)
        assert parts.objective_[-1] < first[-1]


@learners
def test_a_warm_start_of_another_shape_is_refused(learner):
    found = clone(learner).set_params(max_iter=1, warm_start=True).fit(tiny.white_volumes())
    with pytest.raises(InputError, match=r"components_ have shape \(15, 12\), \(15, 9\) is to be learned"):
        found.fit(tiny.white_volumes(d=9))


@learners
def test_what_volumes_come_in_makes_no_difference(learner, tmp_path):
    white = tiny.white_volumes()
    np.save(tmp_path / "white.npy", white)
    expected = clone(learner).set_params(max_iter=3).fit(white).components_
    mapped = np.load(tmp_path / "white.npy", mmap_mode="r")
    for volumes in (mapped, white.astype(np.float64), ChunkedVolumes(white)):
        found = clone(learner).set_params(max_iter=3).fit(volumes)
        assert np.array_equal(found.components_, expected)
    in_chunks = clone(learner).set_params(max_iter=3, chunk_size=33).fit(white)
    assert np.allclose(in_chunks.components_, expected, atol=1e-3)


@learners
def test_no_float_copy_of_all_volumes_is_made(learner):
    n, d = 40_000, 24
    counts = np.random.default_rng(0).integers(-1, 2, (n, d)).astype(np.int8)
    whitener = VolumeWhitener().fit(counts[:5000])
    volumes = ChunkedVolumes(counts, 500, whitener.transform)
    # A high threshold: codes that are not zero are kept from one iteration to the next.
    make = clone(learner).set_params(max_iter=2, threshold=3.0)
    make.fit(ChunkedVolumes(counts[:500], 500, whitener.transform))  # compiled before it is measured
    tracemalloc.start()
    make.fit(volumes)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < n * d * 4 * 3 / 4


def test_few_volumes_are_whitened_once_and_many_on_every_pass(monkeypatch):
    counts = np.random.default_rng(0).integers(-1, 2, (600, 24)).astype(np.int8)
    whitener = VolumeWhitener().fit(counts)
    calls = []

    def make(rows):
        calls.append(len(rows))
        return whitener.transform(rows)

    def learned():
        calls.clear()
        volumes = ChunkedVolumes(counts, 200).made(make)
        return TransformLearner(12, max_iter=3, random_state=0).fit(volumes).components_

    kept = learned()
    assert calls == [200, 200, 200]
    monkeypatch.setattr(chunks, "_KEPT", 4 * counts.size - 1)
    assert np.array_equal(learned(), kept)
    assert len(calls) > 3 * 3


BAD_VOLUMES = {
    "too few for K": (tiny.white_volumes(14), "n_samples = 14 is too few volumes to learn K = 15 from"),
    "constant": (np.zeros((50, D), np.float32), "all 50 volumes are constant"),
    "NaN": (np.where(np.arange(600).reshape(50, D) == 77, np.nan, 1.0), "volume 6 holds NaN or infinity"),
    "beyond float32": (np.full((50, D), 1e200), "volume 0 holds NaN or infinity as a float32"),
}


@learners
@pytest.mark.parametrize("case", BAD_VOLUMES)
def test_volumes_that_cannot_be_learned_from(learner, case):
    volumes, reason = BAD_VOLUMES[case]
    with pytest.raises(InputError, match=reason) as refusal:
        clone(learner).fit(volumes)
    assert "\n" not in str(refusal.value)


@learners
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"max_iter": 0}, "max_iter 0 .* at least one"),
        ({"chunk_size": 0}, "chunk_size 0"),
        ({"threshold": -1.0}, "threshold is -1"),
        ({"threshold": np.nan}, "threshold is nan"),
        ({"coherence": -1.0}, "coherence is -1"),
        ({"coherence": np.inf}, "coherence is inf"),
    ],
)
def test_parameters_that_cannot_be_used(learner, change, reason):
    with pytest.raises(InputError, match=reason):
        clone(learner).set_params(**change).fit(tiny.white_volumes())


def test_each_learner_checks_what_is_its_own():
    white = tiny.white_volumes()
    for learner, reason in (
        (TransformLearner(0), "K is 0"),
        (TransformLearner(5, rows="free", log_det=-1), "log_det is -1"),
        (TransformLearner(5, rows="free", conditioning=np.nan), "conditioning is nan"),
        (DictionaryLearner(0), "K is 0"),
        (DictionaryLearner(5, threshold=0), "above zero"),
        (DictionaryLearner(5, gap=0), "gap is 0"),
    ):
        with pytest.raises(InputError, match=reason):
            learner.fit(white)
