"""The one rule of which events may be counted: what arrays are asked is what kernels do."""

import numpy as np
import pytest
import tiny
from hypothesis import given, settings
from hypothesis import strategies as st

from streamfeat.engine.engine import Engine
from streamfeat.events import TIME_LIMIT, is_valid, make_events

HEIGHT, WIDTH = tiny.RESOLUTION
EDGES = [-TIME_LIMIT, -TIME_LIMIT + 1, 0, TIME_LIMIT - 1, TIME_LIMIT, -(1 << 63), (1 << 63) - 1]


@pytest.mark.parametrize(
    ("event", "is_right"),
    [
        ((0, 0, 0, 0), True),
        ((WIDTH - 1, HEIGHT - 1, 1, 5), True),
        ((WIDTH, 0, 0, 0), False),
        ((0, HEIGHT, 0, 0), False),
        ((0, 0, 2, 0), False),
        ((0, 0, -1, 0), False),
        ((0, 0, 0, TIME_LIMIT - 1), True),
        ((0, 0, 0, TIME_LIMIT), False),
        ((0, 0, 0, 1 - TIME_LIMIT), True),
        ((0, 0, 0, -TIME_LIMIT), False),
    ],
)
def test_the_rule(event, is_right):
    events = make_events(*([value] for value in event))
    assert is_valid(events, tiny.RESOLUTION).tolist() == [is_right]


@settings(max_examples=200, deadline=None)
@given(
    st.integers(0, WIDTH + 1),
    st.integers(0, HEIGHT + 1),
    st.integers(-2, 3),
    st.one_of(st.sampled_from(EDGES), st.integers(-(1 << 63), (1 << 63) - 1)),
)
def test_an_engine_rejects_what_the_rule_does_not_allow(x, y, p, t):
    events = make_events([x], [y], [p], np.array([t], np.int64))
    engine = Engine(tiny.encoder(k=3), tiny.RESOLUTION)
    engine.feed(events)
    assert (engine.stats().rejected == 0) == bool(is_valid(events, tiny.RESOLUTION)[0])
