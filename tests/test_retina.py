"""DART: its grid, the events that it remembers, and its words."""

import numpy as np
import pytest
import tiny

from streamfeat.errors import InputError
from streamfeat.evaluate.retina import RetinalWords, log_polar_places
from streamfeat.events import EVENT_DTYPE
from streamfeat.recordings.reader import Label, open_recording


def at(x, y):
    """Events at these places, one each microsecond."""
    events = np.zeros(len(x), EVENT_DTYPE)
    events["x"], events["y"], events["t"] = x, y, np.arange(len(x))
    return events


def described(words, x, y, resolution=(40, 40)):
    x, y = np.asarray(x), np.asarray(y)
    return np.concatenate([part for _, part in words.described(x, y, resolution)])


BLANK = RetinalWords(np.zeros((0, 0), np.float32))


def test_rings_are_finer_near_the_centre_and_wedges_go_around():
    places = log_polar_places(8, 3, 4)
    assert places[8, 8] == -1
    assert places[0, 0] == -1  # the corner is beyond the last ring
    outwards = places[8, 9:] // 4
    assert outwards.tolist() == [0, 1, 1, 2, 2, 2, 2, 2]  # edges at 1, 2, 4 and 8 pixels
    assert (places[8, 12], places[12, 8], places[8, 4], places[4, 8]) == (8, 9, 10, 11)
    assert set(places.ravel()) == {-1, *range(12)}


def test_a_descriptor_is_the_distribution_of_what_is_remembered():
    rows = described(BLANK, [20, 22, 22, 20], [20, 20, 20, 20])
    np.testing.assert_array_equal(rows[0], 0)
    east, west = BLANK_PLACES[16, 18], BLANK_PLACES[16, 14]
    np.testing.assert_array_equal(np.flatnonzero(rows[1]), [west])
    np.testing.assert_array_equal(rows[1], rows[2])  # its own pixel is in no place
    assert rows[3, east] == 1


BLANK_PLACES = log_polar_places(16, 7, 12)


def test_the_oldest_event_is_forgotten():
    two = RetinalWords(np.zeros((0, 0), np.float32), remembered=2)
    rows = described(two, [20, 20, 25, 30], [20, 22, 20, 20])
    assert np.count_nonzero(rows[2]) == 1  # of the second alone; the first gave room to the third
    np.testing.assert_array_equal(np.flatnonzero(rows[3]), [BLANK_PLACES[16, 11]])


def test_moved_events_have_the_same_descriptors():
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 20, (2, 300))
    near, far = described(BLANK, x, y), described(BLANK, x + 19, y + 20)
    np.testing.assert_array_equal(near, far)
    assert np.abs(near[5:].sum(axis=1) - 1).max() < 1e-6


def test_words_are_counted_in_quadrants():
    words = np.zeros((2, 84), np.float32)
    words[1, BLANK_PLACES[16, 14]] = 1
    features = RetinalWords(words).encode(at([30, 32, 2], [30, 30, 2]), (40, 40))
    # The first has nothing around it, nor has the last; the second has the first to its west.
    assert features.tolist() == [1, 0, 0, 0, 0, 0, 1, 1]


def test_chunks_change_nothing(monkeypatch):
    rng = np.random.default_rng(1)
    events = at(*rng.integers(0, 30, (2, 700)))
    features = RetinalWords(rng.random((9, 84), np.float32) / 20, remembered=50)
    whole = features.encode(events, (30, 30))
    monkeypatch.setattr("streamfeat.evaluate.retina._CHUNK", 64)
    np.testing.assert_array_equal(features.encode(events, (30, 30)), whole)
    assert whole.sum() == 700


def test_words_are_learned_from_training_samples_alone(tmp_path):
    items = tiny.labelled_items(6)
    path = tiny.write_items(tmp_path / "animals.mcap", items)
    with open_recording(path) as recording:
        words = RetinalWords.fitted([recording], n_words=4, n_descriptors=200)
    assert words.words.shape == (4, 84)
    np.testing.assert_allclose(words.words.sum(axis=1), 1, atol=0.05)


def test_nothing_to_learn_from(tmp_path):
    path = tiny.write_items(
        tmp_path / "none.mcap", [Label(0, 1000, "cat"), tiny.packet(tiny.steady(9_000, 9_900, 3))]
    )
    with open_recording(path) as recording, pytest.raises(InputError, match="dart has nothing to learn from"):
        RetinalWords.fitted([recording])
