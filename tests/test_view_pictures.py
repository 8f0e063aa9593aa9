"""Pictures and columns: what an event, a count, a volume or a feature looks like."""

import numpy as np
import pytest

from streamfeat.events import make_events
from streamfeat.view.pictures import NOTHING, bins_picture, event_picture, feature_columns, volume_picture

WINDOW = (0, 100_000)


def picture_of(x, y, p, t, resolution=(4, 6), now_us=0, length_us=50_000, window=WINDOW):
    batches = [make_events([a], [b], [c], [d]) for a, b, c, d in zip(x, y, p, t, strict=True)]
    return event_picture(batches, resolution, window, now_us, length_us)


def test_an_event_is_on_or_off_where_it_happened():
    picture = picture_of([1, 5], [2, 3], [1, 0], [10, 10])
    assert picture.shape == (4, 6)
    assert (picture[2, 1], picture[3, 5]) == (255, 1)
    assert np.count_nonzero(picture != NOTHING) == 2


def test_the_latest_event_of_a_pixel_is_seen_and_older_ones_fade():
    picture = picture_of([0, 0, 1, 2], [0, 0, 0, 0], [0, 1, 1, 1], [0, 60_000, 40_000, 5_000])
    assert picture[0, 0] == 255
    assert NOTHING < picture[0, 1] < 255
    assert picture[0, 2] == NOTHING, "older than the picture is long"


def test_silence_empties_the_picture():
    assert (picture_of([0], [0], [1], [0], now_us=50_000) == NOTHING).all()
    assert (event_picture([], (4, 6), WINDOW, 0, 50_000) == NOTHING).all()


@pytest.mark.parametrize(
    "event", [(6, 0, 1, 5), (0, 4, 1, 5), (0, 0, 2, 5), (0, 0, -1, 5), (0, 0, 1, -1), (0, 0, 1, 100_000)]
)
def test_what_the_engine_refuses_is_not_seen(event):
    x, y, p, t = ([value, good] for value, good in zip(event, (3, 3, 1, 5), strict=True))
    picture = picture_of(x, y, p, t)
    assert picture[3, 3] == 255
    assert np.count_nonzero(picture != NOTHING) == 1


def test_a_single_event_of_a_large_sensor_is_not_lost():
    picture = picture_of([1279, 640], [719, 1], [1, 0], [0, 0], resolution=(720, 1280))
    assert picture.shape == (360, 640)
    assert (picture[359, 639], picture[0, 320]) == (255, 1)
    assert np.count_nonzero(picture != NOTHING) == 2


def test_bins_lie_side_by_side_with_a_bar_between():
    counts = np.zeros((3, 2, 4), np.int32)
    counts[0, 0, 0], counts[1, 1, 3], counts[2, 0, 1] = -9, 1, 2
    picture = bins_picture(counts, max_count=2)
    assert picture.shape == (2, 3 * 4 + 2)
    assert (picture[:, [4, 9]] == 0).all()
    assert (picture[0, 0], picture[1, 8], picture[0, 11]) == (1, 192, 255)
    assert np.count_nonzero(np.delete(picture, [4, 9], axis=1) != NOTHING) == 3


def test_many_bins_of_a_large_sensor_still_fit():
    picture = bins_picture(np.zeros((7, 480, 640), np.int32), max_count=1)
    assert picture.shape[1] < 1_700


@pytest.mark.real_time
def test_empty_volumes_are_told_from_quiet_ones():
    activity = np.array([[0, 1], [100, 400]])
    picture = volume_picture(activity)
    assert picture[0, 0] == 0
    assert 64 <= picture[0, 1] < picture[1, 0] < picture[1, 1] == 255
    assert (volume_picture(np.zeros((2, 2), np.int64)) == 0).all()


def test_features_have_columns_up_and_down():
    split = np.arange(4 * 6, dtype=np.float32)
    columns = feature_columns(split, "split", 2)
    assert columns.filters == 1
    np.testing.assert_array_equal(columns.positive[1], [6, 7, 8])
    np.testing.assert_array_equal(columns.negative[1], [9, 10, 11])
    soft = feature_columns(np.array([1, -2, 0, 0, 0, 0, 0, 3], np.float32), "soft", 2)
    np.testing.assert_array_equal(soft.positive, [[1, 0], [0, 0], [0, 0], [0, 3]])
    np.testing.assert_array_equal(soft.negative, [[0, 2], [0, 0], [0, 0], [0, 0]])


def test_more_filters_than_columns_share_them():
    features = np.random.default_rng(0).random((4, 1700)).astype(np.float32)
    columns = feature_columns(features.ravel(), "triangle", 2)
    assert columns.filters == 14
    assert columns.positive.shape == (4, 122)
    np.testing.assert_array_equal(columns.positive[2, 3], features[2, 42:56].max())
    np.testing.assert_array_equal(columns.positive[3, -1], features[3, 1694:].max())
    assert (columns.negative == 0).all()


@pytest.mark.parametrize("pooling", [1, 3, 4])
def test_cells_are_those_of_the_grid(pooling):
    features = np.random.default_rng(0).random((pooling**2, 5)).astype(np.float32)
    columns = feature_columns(features.ravel(), "triangle", pooling)
    np.testing.assert_array_equal(columns.positive, features)


def test_more_cells_than_a_plot_has_room_for_share_it():
    features = np.random.default_rng(0).random((6, 6, 5)).astype(np.float32)
    columns = feature_columns(features.ravel(), "triangle", 6)
    assert columns.positive.shape == (16, 5)
    np.testing.assert_array_equal(columns.positive[0], features[:1, :1].max(axis=(0, 1)))
    np.testing.assert_array_equal(columns.positive[5], features[1:3, 1:3].max(axis=(0, 1)))
    assert columns.positive.max() == features.max()
