"""Recorded samples beside simulations of the same images."""

import numpy as np
import pytest

from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE
from tools.compare_simulation import likeness, pair_table

SIZE = 12, 16


def sample(seed, n=400):
    """Events of a few places, each more often than others, over 300 ms."""
    rng = np.random.default_rng(seed)
    events = np.zeros(n, EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(0, 300_000, n))
    events["x"], events["y"] = rng.choice(SIZE[1], 4)[rng.integers(0, 4, n)], rng.integers(0, SIZE[0], n)
    events["p"] = rng.integers(0, 2, n)
    return events, SIZE


def test_a_simulation_that_is_the_recording_is_alike_in_everything():
    samples = {str(i): sample(i) for i in range(5)}
    lines = pair_table(samples, dict(reversed(samples.items())) | {"other": sample(9)}).splitlines()
    assert lines[0].startswith("| 5 images, medians |")
    assert "| events | 400 | 400 | 1.00 to 1.00 |" in lines
    assert lines[-1] == "recordings nearest to their own image's simulation: 1.000"
    halved = {name: (events[::2], size) for name, (events, size) in samples.items()}
    assert "| events | 400 | 200 | 0.50 to 0.50 |" in pair_table(samples, halved)


def test_likeness_is_the_correlation_of_counts():
    real, other = [sample(0), sample(1)], [sample(2), sample(0), sample(3)]
    found = likeness(real, other)
    assert found.shape == (2, 3)
    assert found[0].argmax() == 1
    assert found[0, 1] == pytest.approx(1)
    counts = [
        np.histogram2d(e["y"], e["x"], SIZE, [(0, 12), (0, 16)])[0].ravel() for e, _ in (real[1], other[2])
    ]
    assert found[1, 2] == pytest.approx(np.corrcoef(*counts)[0, 1])


def test_where_polarities_are_turned_around_it_is_told():
    events, size = sample(0)
    turned = events.copy()
    turned["p"] = 1 - turned["p"]
    assert likeness([(events, size)], [(turned, size)])[0, 0] == pytest.approx(1)
    assert [likeness([(events, size)], [(turned, size)], i)[0, 0] for i in range(3)] == pytest.approx(
        [-1] * 3
    )


def test_recordings_without_a_common_name_are_refused():
    with pytest.raises(InputError, match="no sample"):
        pair_table({"a": sample(0)}, {"b": sample(0)})
