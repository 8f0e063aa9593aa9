"""Random encoders and event streams, and one stream fed in every way a stream can be cut."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.events import make_events

KINDS = [(f, e) for f in ("direct", "inverse") for e in ("soft", "split", "triangle")]
"""Every formulation with every encoding."""

EXACT_KINDS = [kind for kind in KINDS if kind[0] == "direct" or kind[1] == "triangle"]
LASSO_KINDS = [kind for kind in KINDS if kind not in EXACT_KINDS]

GAP = 1e-6


@dataclass(frozen=True)
class Case:
    """A sensor and an encoder, small enough to be seen whole."""

    geometry: Geometry
    resolution: tuple[int, int]
    n_filters: int
    formulation: str
    encoding: str
    threshold: float
    seed: int
    threads: int = 1
    narrow: bool = False

    @cached_property
    def encoder(self):
        rng = np.random.default_rng(self.seed)
        return random_encoder(
            rng,
            self.geometry,
            self.n_filters,
            self.formulation,
            self.encoding,
            threshold=self.threshold,
            narrow=self.narrow,
        )

    def engine(self, origin_us=0, *, look_ahead=False):
        options = {"look_ahead": look_ahead, "threads": self.threads}
        return Engine(self.encoder, self.resolution, origin_us=origin_us, **options)


@st.composite
def cases(draw, kind, max_bins=4):
    formulation, encoding = kind
    geometry = Geometry(
        patch=draw(st.sampled_from([1, 2, 3, 4, (1, 3), (4, 2), (2, 3)])),
        stride=draw(st.integers(1, 5)),
        n_bins=draw(st.integers(1, max_bins)),
        bin_us=draw(st.sampled_from([1, 7, 1000])),
        downsample=draw(st.integers(1, 3)),
        max_count=draw(st.sampled_from([1, 2, 3, 100])),
        pooling=draw(st.sampled_from([2, 1, 3, 5])),
    )
    smallest = (side * geometry.downsample for side in geometry.sides)
    return Case(
        geometry,
        tuple(draw(st.integers(side, side + 11)) for side in smallest),
        draw(st.sampled_from([1, 5, 31, 32, 33])),
        formulation,
        encoding,
        draw(st.sampled_from([0.02, 0.3])),
        draw(st.integers(0, 1000)),
        draw(st.sampled_from([1, 2, 3])),
        narrow=draw(st.booleans()),
    )


@st.composite
def streams(draw, case, max_events=60):
    """Events in any order: late, out of the sensor, of no polarity, before time zero, windows apart."""
    n = draw(st.integers(0, max_events))
    height, width = case.resolution
    bin_us, window = case.geometry.bin_us, case.geometry.window_us
    near = st.integers(-bin_us // 2, bin_us)
    steps = st.one_of(near, near, near, st.integers(-2 * window, 2 * window), st.just(50 * window))
    column = lambda elements: draw(arrays(np.int64, n, elements=elements))  # noqa: E731
    start = draw(st.integers(-3 * window, 3 * window))
    # Few columns and rows: counts pile up, cancel and saturate.
    return make_events(
        column(st.integers(0, width)),
        column(st.integers(0, height)),
        column(st.sampled_from([1, 0, 1, 0, 1, 0, 1, 0, -1, 2])),
        start + np.cumsum(column(steps)),
    )


def random_events(rng, geometry, resolution, n, n_windows=3.0):
    """The same kinds of events from a generator, most of them in order, on few pixels."""
    span = int(geometry.window_us * n_windows) + 1
    t = np.sort(rng.integers(-span // 2, span // 2 + 1, n))
    moved = rng.random(n) < 0.2
    t[moved] -= rng.integers(0, 2 * geometry.window_us + 1, moved.sum())
    p = rng.integers(0, 2, n)
    p[rng.random(n) < 0.03] = 2
    height, width = resolution
    return make_events(rng.integers(0, width + 1, n), rng.integers(0, height + 1, n), p, t)


def fed_in_every_way(make_engine, events, rng):
    """Engines that were fed the same events: `(how, engine)`, the first one in a single batch.

    `make_engine` takes `look_ahead`.
    """
    whole = make_engine()
    whole.feed(events)
    yield "whole", whole

    one_by_one = make_engine()
    for i in range(len(events)):
        one_by_one.feed(events[i : i + 1])
    yield "one event at a time", one_by_one

    cuts = np.sort(rng.integers(0, len(events) + 1, min(len(events), 6)))
    split = make_engine()
    for batch in np.split(events, cuts):  # equal cuts make empty batches
        split.feed(batch)
        split.feed(events[:0])
    yield "randomly split, with empty batches", split

    read = make_engine()
    for batch in np.split(events, cuts):
        read.feed(batch)
        for look in rng.permutation([read.features, read.codes, read.snapshot, read.stats])[:2]:
            look()
        read.features()
    yield "read at random moments", read

    always_read = make_engine()
    for i in range(len(events)):
        always_read.feed(events[i : i + 1])
        always_read.features()
    yield "read after each event", always_read

    told_the_time = make_engine()
    latest = None
    height, width = told_the_time.resolution
    for event in events:
        told_the_time.feed(np.array([event]))
        if event["x"] < width and event["y"] < height and event["p"] in (0, 1):
            latest = int(event["t"]) if latest is None else max(latest, int(event["t"]))
            told_the_time.advance(latest - int(rng.integers(0, 3)))
            told_the_time.advance(latest)
    yield "told the time after each event", told_the_time

    prepared = make_engine(look_ahead=True)
    end = 0
    while end < len(events):  # so little that most pieces end within a volume
        start, end = end, end + int(rng.integers(1, 4))
        prepared.feed(events[start:end])
        prepared.prepare(int(rng.integers(1, 13)))
    yield "prepared in small pieces", prepared

    for look_ahead in (False, True):
        how = ", looking ahead" if look_ahead else ""

        followed = make_engine(look_ahead=look_ahead)
        followed.follow(events)
        yield f"followed{how}", followed

        cut = make_engine(look_ahead=look_ahead)
        for batch in np.split(events, cuts):
            cut.follow(batch)
            cut.follow(events[:0])
        yield f"followed in batches{how}", cut

        mixed = make_engine(look_ahead=look_ahead)
        for _ in mixed_steps(mixed, events, rng):
            pass
        yield f"in a mix of all ways{how}", mixed


def mixed_steps(engine, events, rng):
    """Feed or follow random batches, and in between read, prepare, tell the time; yields after each batch.

    Yields:
        how many events are in, and the latest time that the engine was told, or None.
    """
    told = None
    end = 0
    while end < len(events):
        start, end = end, min(end + int(rng.choice([1, 1, 2, 5, 20])), len(events))
        batch = events[start:end]
        (engine.follow if rng.random() < 0.5 else engine.feed)(batch)
        for _ in range(rng.integers(0, 3)):
            what = rng.integers(0, 4)
            if what == 0:
                engine.features()
            elif what == 1:
                engine.prepare(int(rng.choice([1, 20, 500, 10**6])))
            elif what == 2 and told is not None:
                engine.advance(told - int(rng.integers(0, 3)))
        height, width = engine.resolution
        good = (batch["x"] < width) & (batch["y"] < height) & (batch["p"] >> 1 == 0)
        if good.any():
            latest = int(batch["t"][good].max())
            told = latest if told is None else max(told, latest)
        yield end, told
