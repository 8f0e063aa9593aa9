"""One row for each compiled kernel: how to make arguments for it, and how its results compare.

The tests run every row against the twin of the same name in `naive`; benchmarks time the same rows.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import naive
import numpy as np
from camera_files_scene import ecf
from numba import njit
from streams import EXACT_KINDS, GAP, KINDS, LASSO_KINDS, random_encoder, random_events

from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.operator import n_features
from streamfeat.events import EVENT_DTYPE
from streamfeat.kernels import (
    change,
    code,
    decode,
    denoise,
    dense,
    encode,
    file_codes,
    follow,
    ingest,
    lasso,
    narrow,
    pixels,
    planes,
    predict,
    retina,
    spiking,
    surfaces,
    trace,
    update,
    volume,
)
from streamfeat.kernels.file_codes import ECF_PADDING
from streamfeat.kernels.layout import (
    BEFORE_TIME,
    CLOCK_DIRTY,
    CLOCK_NOW,
    CLOCK_ORIGIN,
    CLOCK_PLANE,
    CLOCK_SLOT,
    CLOCK_TOUCHED,
    CURSOR_CODED,
    CURSOR_ENTRY,
    CURSOR_PROJECTED,
    LANES,
    MOMENT_SQUARES,
    SPLIT,
    Operator,
    State,
)
from streamfeat.kernels.predict import PARTS, SUMMED, Weights
from streamfeat.kernels.trace import Reading

SCRATCH = {
    "touched",
    "touched_slots",
    "dirty",
    "code",
    "work",
    "active",
    "corners",
    "values",
    "windows",
    "awaiting",
    "load",
    "entries",
    "changes",
    "sums",
    "queue",
    "queued",
    "lines",
    "crowds",
}
"""Fields of a State whose content means nothing between two calls."""


def copied(value):
    """A copy of what a kernel may change; an operator is frozen and stays itself."""
    if isinstance(value, State | Reading):
        return type(value)(*(field.copy() for field in value))
    return value.copy() if isinstance(value, np.ndarray) else value


def assert_same(kernel, twin, *, scratch=frozenset(), name="result"):
    if isinstance(kernel, Operator):
        return
    if isinstance(kernel, Reading | Weights):
        for field in kernel._fields:
            assert_same(getattr(kernel, field), getattr(twin, field), name=field)
    elif isinstance(kernel, State):
        for field in State._fields:
            if field == "encoded":  # which part encodes a volume is nobody's business
                assert kernel.encoded.sum() == twin.encoded.sum()
            elif field not in scratch:
                assert_same(getattr(kernel, field), getattr(twin, field), name=field)
    elif isinstance(kernel, np.ndarray):
        np.testing.assert_array_equal(kernel, twin, err_msg=name, strict=True)
    else:
        assert kernel == twin, name


@dataclass(frozen=True)
class Run:
    """What a function was given, what it became, and what was returned."""

    before: tuple[Any, ...]
    after: tuple[Any, ...]
    result: Any


def exact(kernel: Run, twin: Run) -> None:
    assert_same(kernel.result, twin.result)
    for mine, yours in zip(kernel.after, twin.after, strict=True):
        assert_same(mine, yours)


def exact_but_codes(kernel: Run, twin: Run) -> None:
    """All but the last argument, which is scratch."""
    exact(*(Run(run.before[:-1], run.after[:-1], run.result) for run in (kernel, twin)))


def exact_but_lines(kernel: Run, twin: Run) -> None:
    assert_same(kernel.after[-1], twin.after[-1])


def exact_but_sums(kernel: Run, twin: Run) -> None:
    """All but scratch, and what is written behind an odd list."""
    n = kernel.before[0]
    for run in (kernel, twin):
        for array in run.after[1:3]:
            array[n:] = 0
    exact_but_codes(kernel, twin)


def exact_below_the_top(kernel: Run, twin: Run) -> None:
    """All but what lies above the touched stack."""
    for run in (kernel, twin):
        state = run.after[-1]
        state.touched[state.clock[CLOCK_TOUCHED] :] = 0
    exact(kernel, twin)


def exact_but_scratch(kernel: Run, twin: Run) -> None:
    assert_same(kernel.result, twin.result)
    for mine, yours in zip(kernel.after, twin.after, strict=True):
        assert_same(mine, yours, scratch=SCRATCH)


def exact_waiting(kernel: Run, twin: Run) -> None:
    """As above, and the volume that waits, if it does, with its entries."""
    exact_but_scratch(kernel, twin)
    waiting, part = kernel.before[3:5]
    for name in ("awaiting", "windows") if kernel.result[1] > waiting else ():
        mine, yours = (getattr(run.after[-1], name)[part, waiting] for run in (kernel, twin))
        assert_same(mine, yours)


def exact_but_atoms(kernel: Run, twin: Run) -> None:
    """As above; lasso codes are each within the gap, and what was pooled is what they are."""
    operator, state = kernel.after[-2:]
    if not operator.inverse:
        return exact_but_scratch(kernel, twin)
    for run in (kernel, twin):
        naive.add_up(len(run.after[-1].code), run.after[-1])
    assert_same(kernel.result, twin.result)
    assert_same(state, twin.after[-1], scratch=SCRATCH | {"atoms", "pooled"})
    assert_certified(operator, state)
    if state.projections.shape[1] > 1:
        assert_pooled(operator, state)
    return None


def exact_but_atoms_of_a_part(kernel: Run, twin: Run) -> None:
    """As above, once the other parts are complete as well."""
    for run in (kernel, twin):
        part, parts, operator, state = run.after
        if operator.inverse and state.projections.shape[1] > 1:
            for other in range(parts):
                if other != part:
                    naive.complete(other, parts, operator, state)
            naive.finish(parts, operator, state)
    exact_but_atoms(kernel, twin)


def exact_but_responses(kernel: Run, twin: Run) -> None:
    """As `exact_but_scratch`, but for the order of the sums of a response."""
    mine, yours = (run.after[-1].atoms for run in (kernel, twin))
    np.testing.assert_allclose(mine, yours, rtol=1e-12, atol=1e-12)
    yours[:] = mine
    exact_but_scratch(kernel, twin)


def exact_list(kernel: Run, twin: Run) -> None:
    """As `exact_but_scratch`, and the stack of volumes is no scratch."""
    exact_but_scratch(kernel, twin)
    mine, yours = (run.after[-1] for run in (kernel, twin))
    n = mine.clock[CLOCK_DIRTY]
    assert_same(mine.dirty[:n], yours.dirty[:n])
    assert_same(mine.load[: n + 1], yours.load[: n + 1])


def exact_but_features(kernel: Run, twin: Run) -> None:
    """As `exact_but_atoms`, of the arguments before those that are written to; features as the codes are.

    A lasso may have several solutions, as far apart as one likes: its features are compared with its codes.
    """
    at = next(i for i, value in enumerate(kernel.after) if isinstance(value, State)) + 1
    exact_but_atoms(*(Run(run.before[:at], run.after[:at], None) for run in (kernel, twin)))
    operator, state = kernel.after[at - 2 : at]
    features, expected = kernel.after[at], twin.after[at]
    if operator.inverse:
        features = np.atleast_2d(features)[-1:]
        expected = np.zeros_like(features)
        for row in expected:
            naive.read_features(operator, state, row)
    assert_same(features, expected)
    for mine, yours in zip(kernel.after[at + 1 :], twin.after[at + 1 :], strict=True):
        assert_same(mine, yours)


def exact_trace(kernel: Run, twin: Run) -> None:
    """As `exact_but_features`; scores are those of the features, and what was read last is scratch."""

    def without(run):
        events, operator, state, _, _, features, _, accepted = run.after
        return Run(run.before, (events, operator, state, features, accepted), None)

    exact_but_features(without(kernel), without(twin))
    _, operator, _, weights, reading, features, scores, _ = kernel.after
    if not operator.inverse:
        assert_same(scores, twin.after[6])
    if len(features):
        expected = np.zeros_like(scores)
        naive.predict(features, weights, reading.roots.copy(), reading.sums.copy(), expected)
        assert_same(scores, expected)


def exact_but_roots(kernel: Run, twin: Run) -> None:
    """All but the roots of the part that was summed last."""
    for run in (kernel, twin):
        run.after[-1].roots[:] = 0
    exact(kernel, twin)


def in_planes(state):
    """`(plane, row)` of each volume that has a code in a plane."""
    rows = state.projections.shape[1]
    coded = state.cursors[:, CURSOR_CODED]
    return [(plane, row) for plane, cursor in enumerate(coded) for row in range(min(cursor, rows))]


def assert_pooled(operator, state):
    """What is pooled are the codes that are there."""
    pooled, fixed = np.zeros_like(state.pooled), np.zeros_like(state.code[0, 0])
    for plane, row in in_planes(state):
        naive.fix_atoms(state.atoms[plane, row, 0], operator, fixed)
        naive.pool(
            fixed, 1, operator.kind, pooled[plane, naive.cell_index(row, operator.shape, operator.pooling)]
        )
    np.testing.assert_array_equal(state.pooled, pooled)


def assert_certified(operator, state):
    """Each volume's atoms solve its lasso within the relative duality gap of the operator."""
    for place in in_planes(state):
        projection, moments, (atoms, response) = (
            field[place] for field in (state.projections, state.moments, state.atoms)
        )
        if not moments[MOMENT_SQUARES]:
            assert not atoms.any()
            assert not response.any()
            continue
        sigma = naive.deviation(moments, len(operator.columns), operator.eps)
        square = naive.whitened_square(moments, sigma, operator)
        k = len(atoms)
        right = projection[:k] * (operator.scale / sigma) - operator.offset[:k] / operator.unit
        assert_response(operator.gram, atoms, response)
        penalty = operator.threshold / operator.unit
        residual = right - operator.gram.astype(np.float64) @ atoms
        gap = naive.duality_gap(residual, right, atoms, square, penalty)
        assert gap <= (operator.gap + 1e-11) * square / 2


def exact_unless_refused(kernel: Run, twin: Run) -> None:
    """Words of an unknown type end a packet: what was written before that means nothing."""
    assert_same(kernel.result, twin.result)
    if kernel.result >= 0:
        exact(kernel, twin)


def close(kernel: Run, twin: Run) -> None:
    square = kernel.before[3]
    assert abs(kernel.result - twin.result) <= 1e-12 * square


def lasso_within_gap(kernel: Run, twin: Run) -> None:
    right, square, penalty, gram, gap = kernel.before[:5]
    codes = kernel.after[5][0], twin.after[5][0]
    mine, yours = (naive.lasso_objective(right, square, penalty, gram, code) for code in codes)
    assert kernel.result <= gap
    assert abs(mine - yours) <= gap * square / 2 + 1e-12 * square
    assert_response(gram, *kernel.after[5])


def rows_within_gap(kernel: Run, twin: Run) -> None:
    right, squares, penalty, gram, gap, _ = kernel.before
    for b, square, mine, yours in zip(right, squares, kernel.after[5], twin.after[5], strict=True):
        parts = [naive.lasso_objective(b.astype(float), square, penalty, gram, a) for a in (mine, yours)]
        assert abs(parts[0] - parts[1]) <= gap * square / 2 + 1e-6 * square


def close_but_scratch(kernel: Run, twin: Run) -> None:
    for mine, yours in zip(kernel.after, twin.after, strict=True):
        is_work = np.ndim(mine) == 2 and len(mine) == LASSO_ROWS
        if isinstance(mine, np.ndarray) and mine.dtype == np.float64 and not is_work:
            np.testing.assert_allclose(mine, yours, atol=1e-9)


def selected(kernel: Run, twin: Run) -> None:
    assert kernel.result == twin.result
    np.testing.assert_array_equal(kernel.after[4][: kernel.result], twin.after[4][: twin.result])


def lasso_code_within_gap(kernel: Run, twin: Run) -> None:
    """By the certificate; the twin is slow to arrive where there are more atoms than entries."""
    projection, sigma, square, operator, *_ = kernel.before
    k, penalty = operator.n_filters, operator.threshold / operator.unit
    right = projection[:k] * (operator.scale / sigma) - operator.offset[:k] / operator.unit
    (code, response), (twins, _) = kernel.after[4], twin.after[4]
    slack = (operator.gap + 1e-11) * square / 2
    assert naive.duality_gap(right - response, right, code, square, penalty) <= slack
    assert_response(operator.gram, code, response)
    mine, yours = (naive.lasso_objective(right, square, penalty, operator.gram, c) for c in (code, twins))
    assert mine <= yours + slack


def assert_response(gram, atoms, response):
    """What is kept is what the code makes of the Gram matrix: rounding aside, nothing has drifted."""
    expected = gram.astype(np.float64) @ atoms
    np.testing.assert_allclose(response, expected, rtol=0, atol=1e-12 * max(1, np.abs(atoms).sum()))


# Random arguments. Each maker takes a generator and returns the arguments of one call.


def pick(rng, options):
    return options[rng.integers(len(options))]


NARROW_KINDS = [("direct", "soft"), ("direct", "split")]
"""Formulations and encodings that have a narrow state."""


def random_engine(rng, kinds=KINDS, narrow=None):
    """A small engine with events in all of its window, read at some moment or never.

    In the narrow state or not; in half of the cases, where it can be, if that is not said.
    """
    geometry = Geometry(
        patch=int(pick(rng, [1, 2, 3, 4, 9])),
        stride=int(rng.integers(1, 6)),
        n_bins=int(rng.integers(1, 5)),
        bin_us=int(pick(rng, [1, 7, 1000])),
        downsample=int(rng.integers(1, 4)),
        max_count=int(pick(rng, [1, 2, 3, 100])),
        pooling=int(pick(rng, [1, 2, 3, 5])),
    )
    if geometry.entries == 1:
        geometry = Geometry(patch=2, stride=1, n_bins=1, bin_us=10)
    tall, wide = (side * geometry.downsample for side in geometry.sides)
    resolution = (int(tall + rng.integers(0, 12)), int(wide + rng.integers(0, 12)))
    formulation, encoding = pick(rng, kinds)
    threshold = float(pick(rng, [0.02, 0.3]))
    n_filters = int(pick(rng, [1, 5, 32, 33]))
    if narrow is None:
        narrow = rng.random() < 0.5
    encoder = random_encoder(
        rng, geometry, n_filters, formulation, encoding, threshold=threshold, narrow=narrow
    )
    ahead = bool(rng.random() < 0.7)
    engine = Engine(
        encoder,
        resolution,
        origin_us=int(rng.integers(-2000, 2000)),
        look_ahead=ahead,
        threads=int(rng.integers(1, 4)),
    )
    engine.feed(random_events(rng, geometry, resolution, int(rng.integers(0, 200))))
    # Boundaries crossed one by one: rows of a plane are left from before, or were prepared.
    for _ in range(rng.integers(0, 4)):
        if rng.random() < 0.7:
            engine.features()
            engine.prepare(int(pick(rng, [1, 30, 10**6])))
        engine.advance(bin_start(engine, 1))
    return engine


def bin_start(engine, ahead=0):
    """When the current bin of an engine began, or one after it begins; bin 0 if it has seen nothing."""
    clock = engine._state.clock
    now = max(int(clock[CLOCK_NOW]), -(2**40))
    return int(clock[CLOCK_ORIGIN]) + (now + ahead) * engine.encoder.geometry.bin_us


def read_engine(rng, kinds=KINDS, *, more=0, narrow=None):
    """A random engine whose sums are current, the next bin partly prepared.

    With `more` events counted since, none of them in a new bin.
    """
    engine = random_engine(rng, kinds, narrow)
    engine.advance(0)
    engine.features()
    engine.prepare(int(pick(rng, [-1, 1, 30, 300, 10**6])))
    events = random_events(rng, engine.encoder.geometry, engine.resolution, more)
    events["t"] = np.minimum(events["t"], bin_start(engine, 1) - 1)
    engine.feed(events)
    return engine


def parts_of(engine):
    return engine._operator, copied(engine._state)


def random_values(rng, operator):
    limit, d = operator.max_count, len(operator.columns)
    values = rng.integers(-limit, limit + 1, d).astype(np.int16)
    values[rng.random(d) < rng.random()] = 0
    if rng.random() < 0.1:
        values[:] = 1  # no variance
    return values


def random_volume(rng, kinds=KINDS):
    """An operator and the projection and moments of one random volume that is not empty."""
    operator = random_engine(rng, kinds, narrow=False)._operator
    values = random_values(rng, operator)
    values[0] = values[0] or 1
    projection, moments = np.zeros(operator.columns.shape[1], np.int32), np.zeros(4, np.int64)
    projection[:], moments[:] = naive.sums_of(values, operator)
    return operator, projection, moments


def random_code(rng, width):
    return rng.integers(-(2**20), 2**20, width).astype(np.int32)


def make_deviation(rng):
    operator, _, moments = random_volume(rng)
    return moments, len(operator.columns), operator.eps


def make_whitened_square(rng):
    operator, _, moments = random_volume(rng, [("direct", "triangle"), ("inverse", "soft")])
    if rng.random() < 0.3:
        moments[2:] = rng.integers(-(2**40), 2**40, 2)  # of no volume: what comes out is bounded
    return moments, naive.deviation(moments, len(operator.columns), operator.eps), operator


def make_soft_code(rng):
    operator, projection, moments = random_volume(rng)
    sigma = naive.deviation(moments, len(operator.columns), operator.eps)
    return projection, sigma, operator, random_code(rng, len(projection))


def make_triangle_code(rng):
    operator, projection, moments = random_volume(rng, [("direct", "triangle")])
    sigma = naive.deviation(moments, len(operator.columns), operator.eps)
    square = naive.whitened_square(moments, sigma, operator)
    return projection, sigma, square, operator, random_code(rng, len(projection))


def make_pool(rng):
    kind, width = int(rng.integers(0, 3)), int(pick(rng, [32, 64]))
    pooled = rng.integers(-(2**30), 2**30, 2 * width if kind == SPLIT else width).astype(np.int32)
    return random_code(rng, width), int(pick(rng, [-1, 1])), kind, pooled


def one_step(rng, before, operator):
    """A clipped count after one event that changes it; often one nearer to zero."""
    limit = operator.max_count
    if before and rng.random() < 0.5:
        return before - int(np.sign(before))
    return int(pick(rng, [count for count in (before - 1, before + 1) if -limit <= count <= limit]))


def random_move(rng, kinds):
    """A volume that is not empty and an entry that changes: operator, projection, sigmas, squares, change."""
    operator, *_ = random_volume(rng, kinds)
    values = random_values(rng, operator)
    values[0] = values[0] or 1
    entry = int(rng.integers(0, len(values)))
    after = values.copy()
    after[entry] = one_step(rng, int(values[entry]), operator)
    sums = [naive.sums_of(v, operator) for v in (values, after)]
    sigmas = tuple(naive.deviation(moments, len(values), operator.eps) for _, moments in sums)
    squares = tuple(naive.whitened_square(m[1], s, operator) for m, s in zip(sums, sigmas, strict=True))
    change = int(after[entry]) - int(values[entry])
    return operator, sums[0][0], sigmas, squares, change, operator.columns[entry]


def make_move_code(rng):
    kind = pick(rng, [("direct", "soft"), ("direct", "split")])
    operator, projection, sigmas, _, change, column = random_move(rng, [kind])
    gains = (naive.gain(sigma, operator) for sigma in sigmas)
    width = len(projection) * (2 if operator.kind == SPLIT else 1)
    pooled = rng.integers(-(2**30), 2**30, width).astype(np.int32)
    threshold = np.float32(operator.threshold)
    if rng.random() < 0.5:
        column = column.astype(np.int32)  # as the sum of several columns has it
    return change, column, projection, *gains, operator.offset, threshold, operator.kind, pooled


def make_pool_soft(rng):
    operator, projection, moments = random_volume(rng, [("direct", "soft"), ("direct", "split")])
    factor = naive.gain(naive.deviation(moments, len(operator.columns), operator.eps), operator)
    width = len(projection) * (2 if operator.kind == SPLIT else 1)
    pooled = rng.integers(-(2**30), 2**30, width).astype(np.int32)
    threshold = np.float32(operator.threshold)
    sign = np.int64(pick(rng, [-1, 1]))
    return sign, projection, factor, operator.offset, threshold, operator.kind, pooled


def make_move_triangle(rng):
    operator, projection, sigmas, squares, change, column = random_move(rng, [("direct", "triangle")])
    gains, lengths = tuple(naive.gain(s, operator) for s in sigmas), tuple(np.float32(s) for s in squares)
    pooled = rng.integers(-(2**30), 2**30, len(projection)).astype(np.int32)
    codes, unit = np.zeros((3, len(projection)), np.int32), np.float32(operator.unit)
    column = column.astype(np.int32)
    arrays = operator.offset, operator.square_norms, operator.n_filters, unit, pooled, codes
    return change, column, projection, gains, lengths, *arrays


def make_gain(rng):
    return float(rng.random() + 0.1), random_engine(rng)._operator


def make_mean_distance(rng):
    return rng.integers(0, 2**30, 33).astype(np.int32), int(rng.integers(1, 34))


def make_bin_length(rng):
    operator, state = parts_of(random_engine(rng))
    if rng.random() < 0.3:
        state.clock[CLOCK_NOW] = BEFORE_TIME
    return operator, state


def make_slot_of(rng):
    _, state = parts_of(random_engine(rng))
    return int(rng.integers(0, len(state.counts))), state


def make_fixed_distance(rng):
    z, length, norm = (np.float32(value) for value in rng.normal(size=3) ** 2)
    unit = np.float32(2.0 ** int(rng.integers(8, 17)))
    return z * unit, length, norm, unit


def make_evt3(rng):
    words = random_words(rng, [0, 2, 2, 3, 4, 5, 6, 8, 8, 10])
    state = np.zeros(6, np.int64)
    if rng.random() < 0.5:  # what a packet before has left
        high, low, row, column = int(rng.integers(0, 2**20)), *(int(v) for v in rng.integers(0, 2**11, 3))
        column = int(pick(rng, [column, 65_520, 65_530]))
        state[:] = high, low, row, column, rng.integers(0, 2), rng.integers(0, 5)
    is_high = words >> 12 == 8
    steps = rng.choice([0, 1, 7, 2047, 2048, 2049, 4090, 4095], is_high.sum())
    words[is_high] = 8 << 12 | (state[0] + np.cumsum(steps)) % 4096
    return words, state, np.zeros(12 * len(words), EVENT_DTYPE)


def make_libcaer_cmp(rng):
    words = random_words(rng, [0, 1, 2, 3, 3, 4, 5] + [6] * (rng.random() < 0.1))
    state = np.zeros(3, np.int64)
    if rng.random() < 0.5:  # what a packet before has left
        state[:] = rng.integers(0, 2**11), pick(rng, [0, 65_520, 65_530]), rng.integers(0, 2)
        words[:1] = 5 << 12 | rng.integers(0, 256)
    return words, int(rng.integers(0, 2**50)), state, np.zeros(8 * len(words), EVENT_DTYPE)


def random_sensor(rng):
    return tuple(int(pick(rng, [1, 1000, 2**14, 2**15, 2**16])) for _ in range(2))


def make_mono(rng):
    words = rng.integers(0, 2**64, random_length(rng, 80), np.uint64)
    thousands = rng.random(len(words)) < 0.2
    words[thousands] -= words[thousands] % np.uint64(2**32) % np.uint64(1000)
    out, span = np.zeros(2 * len(words), np.int64), np.array([7, 7])
    base_us, rest_ns = int(rng.integers(0, 2**54)), int(pick(rng, [0, 1, 999, rng.integers(0, 1000)]))
    return words, base_us, rest_ns, *random_sensor(rng), out, span


def make_libcaer(rng):
    n = random_length(rng, 80)
    us = np.sort(rng.integers(0, 2**31, n)).astype(np.uint64)
    if rng.random() < 0.5:
        us = (us + np.uint64(rng.integers(2**31))) % np.uint64(2**31)
    us ^= (rng.random(n) < 0.1) * np.uint64(rng.choice([1, 2**31]))
    words = us << np.uint64(32) | rng.integers(0, 2**32, n, np.uint64)
    out, span = np.zeros(2 * n, np.int64), np.array([7, 7])
    return words, int(rng.integers(0, 2**54)), *random_sensor(rng), out, span


def make_place_events(rng):
    events, height, width, span = make_time_span(rng)
    events["t"] //= pick(rng, [1, 2**40])
    events["t"][rng.random(len(events)) < 0.1] = pick(rng, [2**62, -(2**62), 2**62 - 1])
    events["p"] = rng.choice([0, 1, 1, -1, 2], len(events))
    reached_us = int(pick(rng, [-(2**62), 0, 2**20]))
    return events, height, width, reached_us, np.zeros(len(events), np.int64), span


def make_time_span(rng):
    events = np.zeros(random_length(rng, 40), EVENT_DTYPE)
    events["x"], events["y"] = rng.integers(0, 12, len(events)), rng.integers(0, 12, len(events))
    events["t"] = rng.integers(-(2**62), 2**62, len(events))
    return events, int(rng.integers(1, 12)), int(rng.integers(1, 12)), np.array([7, 7])


def _counts(rng, n, bits):
    """Counts that go on a little, and now and then by about half of their range or more."""
    half = 2 ** (bits - 1)
    steps = rng.choice([0, 1, 700, -5, half - 1, half, half + 1, -half, -half - 1, 2 * half - 9], n)
    return (int(rng.choice([0, 5, half, 2 * half - 1])) + np.cumsum(steps)) % 2**bits


def make_turns_between(rng):
    bits = int(pick(rng, [28, 32]))
    before, now = (int(count) for count in _counts(rng, 2, bits))
    return -1 if rng.random() < 0.1 else before, now, bits


def make_evt2(rng):
    n = random_length(rng, 60)
    words = rng.integers(0, 2**28, n, np.uint32) | rng.choice([0, 1, 8, 10, 14], n).astype(np.uint32) << 28
    is_high = words >> 28 == 8
    words[is_high] = 8 << 28 | _counts(rng, np.count_nonzero(is_high), 28)
    state = np.array([-1, 0] if rng.random() < 0.3 else [rng.integers(0, 2**28), rng.integers(-2, 3)])
    return words, state, np.zeros(n, EVENT_DTYPE)


def make_dat(rng):
    n = random_length(rng, 40)
    records = rng.integers(0, 2**32, (n, 2), np.uint32)
    records[:, 0] = _counts(rng, n, 32)
    records[:, 1] &= rng.choice([0x0FFFFFFF, 0xFFFFFFFF], n).astype(np.uint32)
    state = np.array([-1, 0] if rng.random() < 0.3 else [rng.integers(0, 2**32), rng.integers(-2, 3)])
    return records, state, np.zeros(n, EVENT_DTYPE)


def make_event_stream(rng):
    data = rng.integers(0, 256, int(rng.integers(0, 80)), np.uint8)
    data[rng.random(len(data)) < 0.3] |= 0xFC
    state = np.array([*rng.integers(0, 2**40, 2), 0])
    return data, bool(rng.random() < 0.5), state, np.zeros(len(data) // 5, EVENT_DTYPE)


def make_ecf(rng):
    n = int(rng.integers(0, 60))
    events = np.zeros(n, EVENT_DTYPE)
    steps = rng.choice([0, 0, 1, 14, 15, 16, 300_000], n) * (rng.random() < 0.8)
    events["t"] = np.cumsum(steps) + int(rng.integers(0, 2**40))
    events["y"] = np.repeat(rng.integers(0, 2048, n), int(pick(rng, [1, 3, 40])))[:n]
    events["x"] = np.minimum(np.cumsum(rng.choice([1, 1, 2, 7], n)), 2047)
    events["p"] = np.repeat(rng.integers(0, 2, n), int(pick(rng, [1, 2, 130])))[:n]
    data = np.frombuffer(ecf(events, int(pick(rng, [0, 1, 2]))), np.uint8).copy()
    if rng.random() < 0.3:
        data = data[: int(rng.integers(12, len(data) + 1))]
    if rng.random() < 0.3:
        data[int(rng.integers(4, len(data)))] = rng.integers(0, 256)
    return np.concatenate([data, np.zeros(ECF_PADDING, np.uint8)]), len(data), np.zeros(n, EVENT_DTYPE)


def make_rows(rng):
    separator = pick(rng, [b",", b";", b" "])
    numbers = [b"1", b"-20", b"+3", b"0.5", b".25", b"7.", b"123456789012345678", b" 4\t"]
    bad = [b"", b".", b"-", b"1e5", b"x", b"1234567890123456789", b"0.123456789012345678", b"1 2", b"--1"]
    rows = []
    for _ in range(int(rng.integers(0, 6))):
        kinds = numbers + bad * (rng.random() < 0.15)
        rows.append(separator.join(pick(rng, kinds) for _ in range(int(rng.integers(3, 6)))))
        rows += [b"  "] * (rng.random() < 0.2)
    text = b"\n".join(rows) + b"\n" * (rng.random() < 0.9)
    wanted = np.array(pick(rng, [[0, 1, 2], [0, 2], [1], [2, 3]]))
    out = np.zeros((2, len(wanted), int(pick(rng, [3, 9, 9]))), np.int64)
    code = separator[0] if separator != b" " else 0
    return np.frombuffer(text, np.uint8).copy(), code, wanted, out[0].copy(), out[1].copy()


def make_groups(rng):
    data = rng.integers(0, 256, 140, np.uint8)
    bits = int(pick(rng, [12, 24]))
    return data, int(rng.integers(0, 125)), 3, bits, np.zeros(int(rng.integers(0, 40)), EVENT_DTYPE)


def random_length(rng, most):
    """Of a batch, which is often enough empty."""
    return 0 if rng.random() < 0.1 else int(rng.integers(1, most))


def random_words(rng, kinds):
    n = random_length(rng, 80)
    return (rng.choice(kinds, n) << 12 | rng.integers(0, 4096, n)).astype(np.uint16)


def make_advance_to_bin(rng):
    operator, state = parts_of(read_engine(rng) if rng.random() < 0.7 else random_engine(rng))
    if rng.random() < 0.1:
        state.clock[CLOCK_NOW] = BEFORE_TIME
    steps = [1, 1, 1, -2, -1, 0, 2, len(state.counts), 7]
    return max(int(state.clock[CLOCK_NOW]), -5000) + int(pick(rng, steps)), operator, state


def hostile_events(rng, engine, n, n_windows=6.0):
    events = random_events(rng, engine.encoder.geometry, engine.resolution, n, n_windows=n_windows)
    hostile = rng.random(n) < 0.05
    events["t"][hostile] = rng.choice([-(2**63), 2**63 - 1, 2**62, -(2**62)], hostile.sum())
    events["p"][rng.random(n) < 0.05] = rng.choice([-1, 2, 32767, -32768])
    events["x"][rng.random(n) < 0.05] = 65535
    return events


def make_count_event(rng):
    engine = read_engine(rng)
    operator, state = parts_of(engine)
    (height, width), n_bins, limit = engine.resolution, len(state.counts), operator.max_count
    x, y, p = int(rng.integers(0, width)), int(rng.integers(0, height)), int(rng.integers(0, 2))
    place = int(pick(rng, [0, 0, 0, 1 - n_bins, 1 - n_bins, -n_bins, -n_bins - 5, 1, n_bins + 5]))
    t = bin_start(engine, place) + int(pick(rng, [0, operator.bin_us - 1]))
    state.counts[:, y // operator.downsample, x // operator.downsample] = pick(
        rng, [-limit - 5, -limit - 1, -limit, 0, limit, limit + 1, limit + 5]
    )
    if rng.random() < 0.3:
        values = [(width, y, p, t), (x, height, p, t), (x, y, -1, t), (x, y, 2, t)]
        x, y, p, t = pick(rng, [*values, *((x, y, p, t) for t in (2**62, -(2**62), -(2**63), 2**63 - 1))])
    return int(x), int(y), int(p), int(t), operator, state


def make_is_valid(rng):
    *event, _, state = make_count_event(rng)
    return *event, state


def make_count_events(rng):
    engine = random_engine(rng)
    operator, state = parts_of(engine)
    events = hostile_events(rng, engine, 100)
    if rng.random() < 0.3:  # most on one pixel and in one bin: counts go beyond the limit and come back
        near = rng.random(len(events)) < 0.7
        events["x"][near] = events["y"][near] = 0
        events["t"][near] = bin_start(engine)
        events["p"][near] = (np.arange(near.sum()) // 8 + rng.integers(0, 2)) % 2
    if rng.random() < 0.2:
        events["t"][rng.random(len(events)) < 0.05] = bin_start(engine, len(state.counts) + 5)
    return events, operator, state


def lasso_problem(rng):
    """`D`, `x` with more entries than atoms, so that the slow twin arrives as well."""
    k = int(rng.integers(1, 12))
    atoms, x = rng.normal(size=(k, 3 * k)) / np.sqrt(3 * k), 2 * rng.normal(size=3 * k)
    gram = (atoms @ atoms.T).astype(np.float32)
    start = (rng.normal(size=k) * (rng.random(k) < 0.5)).astype(np.float32)
    return atoms @ x, float(x @ x), gram, start


def frozen(array):
    array.flags.writeable = False
    return array


def make_duality_gap(rng):
    right, square, gram, start = lasso_problem(rng)
    atoms = start.astype(np.float64)
    square *= pick(rng, [1.0, 1.0, 0.01])  # smaller than it can be, as rounding may make it
    return right - gram.astype(np.float64) @ atoms, right, atoms, square, float(pick(rng, [0.1, 10.0]))


LASSO_ROWS = 5


def lasso_scratch(k):
    padded = -(-k // LANES) * LANES
    return np.zeros((LASSO_ROWS, padded)), np.zeros(k, np.int64), np.zeros(k * padded, np.float32)


def with_response(gram, start):
    return np.array([start, gram.astype(np.float64) @ start])


def make_solve_lasso(rng):
    right, square, gram, start = lasso_problem(rng)
    penalty = float(pick(rng, [0.05, 0.5, 10.0]))
    work, *scratch = lasso_scratch(len(right))
    if rng.random() < 0.2:  # the solution itself
        start = naive._shrunken_gradient_steps(right, penalty, gram.astype(float), start.astype(float))
    return right, square, penalty, frozen(gram), 1e-8, with_response(gram, start), work[1:], *scratch


def make_select_atoms(rng):
    right, _, gram, start = lasso_problem(rng)
    atoms, response = with_response(gram, start)
    if rng.random() < 0.2:
        atoms, response = np.zeros((2, len(right)))
    return right, atoms, response, float(pick(rng, [0.05, 0.5, 10.0])), np.zeros(len(right), np.int64)


def make_copy_corner(rng):
    _, _, gram, _ = lasso_problem(rng)
    chosen = np.flatnonzero(rng.random(len(gram)) < 0.6)
    return frozen(gram), chosen, np.ones((len(chosen), LANES), np.float32)


def make_descend(rng):
    right, _, gram, start = lasso_problem(rng)
    if rng.random() < 0.3:
        right[0], gram[0], gram[:, 0], start[0] = 0, 0, 0, 0  # an atom of length zero
    n, atoms = len(gram), start.astype(np.float64)
    corner, residual = np.zeros((n, LANES), np.float32), np.zeros(LANES)
    corner[:, :n], residual[:n] = gram, right - gram.astype(np.float64) @ atoms
    return 0.1, corner, atoms, residual


def make_extrapolate(rng):
    penalty, corner, atoms, residual = make_descend(rng)
    if rng.random() < 0.2:  # nothing bends the objective
        residual[: len(corner)] += corner[:, : len(corner)] @ atoms
        corner[:] = 0
    direction = float(pick(rng, [1.0, 0.01])) * rng.normal(size=len(atoms))
    return penalty, corner, atoms - direction * (rng.random(len(atoms)) < 0.7), atoms, residual


def make_add_rows(rng):
    gram, n = rng.normal(size=(12, 33)).astype(np.float32), int(rng.integers(0, 12))
    return rng.normal(size=n), rng.permutation(12)[:n], frozen(gram), rng.normal(size=33)


def make_respond(rng):
    _, _, gram, start = lasso_problem(rng)
    work, chosen, _ = lasso_scratch(len(gram))
    return frozen(gram), np.array([start, rng.normal(size=len(gram))]), work, chosen


def make_subtract_row(rng):
    row, residual = rng.normal(size=33).astype(np.float32), rng.normal(size=33)
    return float(rng.normal()), frozen(row), residual


def make_lasso_code(rng):
    operator, projection, moments = random_volume(rng, LASSO_KINDS)
    sigma = naive.deviation(moments, len(operator.columns), operator.eps)
    square = naive.whitened_square(moments, sigma, operator)
    kept = with_response(operator.gram, rng.normal(size=operator.n_filters))
    return projection, sigma, square, operator, kept, *lasso_scratch(operator.n_filters)


def make_fix_atoms(rng):
    operator = random_engine(rng, LASSO_KINDS, narrow=False)._operator
    k, scale = operator.n_filters, pick(rng, [1, 1e9])
    atoms = scale * rng.normal(size=k)
    return atoms, operator, random_code(rng, len(operator.offset))


def make_solve_lasso_rows(rng):
    right, _, gram, _ = lasso_problem(rng)
    k, n = len(right), int(rng.integers(1, 9))
    rights, codes = rng.normal(size=(n, k)).astype(np.float32), rng.normal(size=(n, k)).astype(np.float32)
    # Any right is D'x of some x; the shortest has this square, a longer one only moves the objective.
    inverse = np.linalg.inv(gram.astype(np.float64))
    squares = 1.1 * np.einsum("ni,ij,nj->n", rights, inverse, rights)
    return rights, squares, 0.2, gram, GAP, codes


def random_row(rng, state):
    """`(plane, volume)` of a volume that has a code in its plane."""
    return pick(rng, in_planes(state))


def make_encode_volume(rng):
    operator, state = parts_of(read_engine(rng))
    place = random_row(rng, state)
    projection, moments, atoms = (
        field[place].copy() for field in (state.projections, state.moments, state.atoms)
    )
    if rng.random() < 0.2:
        projection[:], moments[:] = 0, 0
    atoms[:] = rng.normal(size=atoms.shape)
    # A lasso that is solved again is for `lasso_code`: its code has no twin of the same bits.
    fresh = bool(rng.random() < 0.5) and not (operator.inverse and moments[MOMENT_SQUARES])
    return projection, moments, atoms, fresh, random_part(rng, state), operator, state


def make_pool_volume(rng):
    operator, state = parts_of(read_engine(rng, EXACT_KINDS))
    plane, volume = random_row(rng, state)
    sign, part = np.int64(pick(rng, [-1, 1])), random_part(rng, state)
    return plane, volume, volume, sign, part, operator, state


def one_row(state):
    """The state of an offline window: volumes share a row."""
    rows = {name: getattr(state, name)[:1, :1].copy() for name in ("projections", "moments", "atoms")}
    clock = state.clock.copy()
    clock[CLOCK_PLANE] = 0
    return state._replace(
        **rows,
        cursors=np.zeros((1, 3), np.int64),
        pooled=np.zeros_like(state.pooled[:1]),
        clock=clock,
        partial=np.zeros_like(state.partial[:, :1]),
        windows=state.windows[:, :0].copy(),
        awaiting=state.awaiting[:, :0].copy(),
    )


def rewind(rng, plane, operator, state):
    """Let a plane be one that volumes are about to enter; rows that leave it stay as they are."""
    cursors, ahead = state.cursors[plane], int(plane != state.clock[CLOCK_PLANE])
    projected = int(rng.integers(0, cursors[CURSOR_PROJECTED] + 1))
    coded = int(rng.integers(0, min(projected, cursors[CURSOR_CODED]) + 1))
    cursors[:] = coded, projected, 0
    if projected < naive.volumes_of(operator) and rng.random() < 0.5:
        most = int(rng.integers(0, 9))
        _, following = naive.project_volume(plane, projected, ahead, 0, most, 0, operator, state)
        end = (len(state.applied) - ahead) * math.prod(operator.patch)
        cursors[:] = (coded, projected + 1, 0) if following == end else (coded, projected, following)
    state.pooled[plane] = 0
    for row in range(coded):
        sums = state.pooled[plane, naive.cell_index(row, operator.shape, operator.pooling)]
        if operator.steps is not None:
            naive.pool_row_of(None, None, None, plane, row, 1, 0, operator, state, sums)
            continue
        row_of = (field[plane, row] for field in (state.projections, state.moments, state.atoms))
        naive.encode_volume(*row_of, False, 0, operator, state)
        naive.pool(state.code[0, 0], 1, operator.kind, sums)


def random_part(rng, state):
    return int(rng.integers(0, len(state.code)))


def random_share(rng, state):
    """One of the parts of an update, and how many there are."""
    parts = int(rng.integers(1, len(state.code) + 1))
    return int(rng.integers(0, parts)), parts


def random_most(rng):
    return int(pick(rng, [1, 3, 10**6]))


def make_project_volume(rng):
    operator, state = parts_of(read_engine(rng))
    part, volumes = random_part(rng, state), naive.volumes_of(operator)
    if rng.random() < 0.2:
        plane, volume, start, state = 0, int(rng.integers(0, volumes)), 0, one_row(state)
    else:
        plane = int(rng.integers(0, len(state.cursors)))
        rewind(rng, plane, operator, state)
        volume, start = min(int(state.cursors[plane, 1]), volumes - 1), int(state.cursors[plane, 2])
    ahead = int(plane != state.clock[CLOCK_PLANE])
    return plane, volume, ahead, start, random_most(rng), part, operator, state


def make_enter_atoms(rng):
    operator, state = parts_of(read_engine(rng))
    return operator.lasso, *random_row(rng, state), random_part(rng, state), operator, state


CLOSED_KINDS = [("direct", "soft"), ("direct", "split")]


def make_can_wait(rng):
    state = parts_of(read_engine(rng))[1]
    return (one_row(state) if rng.random() < 0.3 else state,)


def make_let_in(rng):
    operator, state = parts_of(read_engine(rng, CLOSED_KINDS))
    plane, volume = random_row(rng, state)
    if rng.random() < 0.4:  # more entries that are not zero than random events leave
        state.applied[:] = random_ring(rng, operator, state)
    if rng.random() < 0.2:
        state.applied[:] = 0
    ahead = int(plane != state.clock[CLOCK_PLANE])
    waiting = int(rng.integers(0, state.awaiting.shape[1]))
    state.windows[:] = 7  # of volumes that waited before
    return plane, volume, ahead, waiting, random_part(rng, state), operator, state


def random_ring(rng, operator, state):
    limit = operator.max_count
    ring = rng.integers(-limit, limit + 1, state.applied.shape)
    ring[rng.random(ring.shape) < rng.random()] = 0
    return ring


def make_multiply(rng):
    operator, state = parts_of(read_engine(rng, CLOSED_KINDS))
    plane, part = int(rng.integers(0, len(state.cursors))), random_part(rng, state)
    waiting = int(rng.integers(0, min(state.awaiting.shape[1], naive.volumes_of(operator)) + 1))
    state.awaiting[part, :waiting] = rng.permutation(naive.volumes_of(operator))[:waiting]
    for window in state.windows[part, :waiting]:
        window[: len(operator.columns)] = random_values(rng, operator)
    return plane, waiting, part, operator, state


def make_enter_code(rng):
    operator, state = parts_of(read_engine(rng, EXACT_KINDS))
    part, volumes = random_part(rng, state), naive.volumes_of(operator)
    if rng.random() < 0.2:
        state = one_row(state)
    plane = int(rng.integers(0, len(state.cursors)))
    return plane, int(rng.integers(0, volumes)), part, operator, state


def engine_with_a_plane_to_fill(rng):
    operator, state = parts_of(read_engine(rng))
    if rng.random() < 0.3:
        return operator, one_row(state)
    rewind(rng, int(state.clock[CLOCK_PLANE]), operator, state)
    return operator, state


def make_list_missing(rng):
    return engine_with_a_plane_to_fill(rng)


def make_fill_plane(rng):
    return engine_with_a_plane_to_fill(rng)


def make_complete(rng):
    operator, state = engine_with_a_plane_to_fill(rng)
    naive.list_missing(operator, state)
    return *random_share(rng, state), operator, state


def make_count_filled(rng):
    ring, _, _, _, (_, patch), _ = random_place(rng)
    stride = int(rng.integers(1, 4))
    height, width = ring.shape[1:]
    crowds = np.zeros((height + 1, (width - patch) // stride + 1), np.int32)
    return ring, stride, patch, np.ones((2, width + 1), np.int32), crowds


def make_look_ahead(rng):
    operator, state = parts_of(random_engine(rng) if rng.random() < 0.2 else read_engine(rng))
    goals = (int(goal) for goal in rng.integers(0, 1 + naive.volumes_of(operator), 2))
    return *goals, int(pick(rng, [-1, 0, 1, 30, 10**6])), operator, state


def make_update(rng):
    engine = random_engine(rng) if rng.random() < 0.5 else read_engine(rng, more=40)
    return parts_of(engine)


def make_read(rng):
    *parts, operator, state = make_update(rng)
    return *parts, operator, state, np.zeros(n_features(operator), np.float32)


def engine_with_news(rng):
    """An engine with events since its last emission, some planes of which are as if being filled."""
    operator, state = parts_of(read_engine(rng, more=40))
    for plane in range(len(state.cursors)):
        if rng.random() < 0.3:
            rewind(rng, plane, operator, state)
    return operator, state


def end_in_a_volume(rng, operator, state):
    """Let a plane's cursors end within a volume that covers a changed entry, near that entry."""
    plane, n_touched = int(rng.integers(0, len(state.cursors))), int(state.clock[CLOCK_TOUCHED])
    if n_touched == 0:
        return
    slot, row, column = np.unravel_index(int(pick(rng, state.touched[:n_touched])), state.counts.shape)
    rows, columns = range(*state.volume_rows[row]), range(*state.volume_columns[column])
    if not (rows and columns):
        return
    r, c = int(pick(rng, rows)), int(pick(rng, columns))
    position = (slot - state.clock[CLOCK_SLOT] - 1) % len(state.counts) - (plane != state.clock[CLOCK_PLANE])
    inside = row - r * operator.stride, column - c * operator.stride
    entry = int((position * operator.patch[0] + inside[0]) * operator.patch[1] + inside[1])
    volume = r * int(state.volume_columns.max()) + c
    end = int(pick(rng, [entry, entry + 1, rng.integers(1, len(operator.columns))]))
    state.cursors[plane] = min(int(state.cursors[plane, CURSOR_CODED]), volume), volume, max(end, 1)


def make_mark_dirty(rng):
    operator, state = engine_with_news(rng)
    if rng.random() < 0.6:
        end_in_a_volume(rng, operator, state)
    return operator, state


def make_renew(rng):
    operator, state = engine_with_news(rng)
    naive.mark_dirty(operator, state)
    return *random_share(rng, state), operator, state


def make_first_with_load(rng):
    load = np.sort(rng.integers(0, 50, int(rng.integers(1, 12)))).astype(np.int32)
    return int(rng.integers(0, 60)), load, int(rng.integers(0, len(load) + 1))


def make_share_of_load(rng):
    part, parts, _, state = make_complete(rng)
    return part, parts, state


def make_share_of(rng):
    part, parts, _, state = make_renew(rng)
    return part, parts, state


def make_touched_bins(rng):
    return (make_renew(rng)[-1],)


def make_settle(rng):
    operator, state = engine_with_news(rng)
    naive.mark_dirty(operator, state)
    return (state,)


def make_finish(rng):
    operator, state = engine_with_news(rng)
    state.partial[:] = rng.integers(-9, 10, state.partial.shape)
    return int(rng.integers(1, len(state.code) + 1)), operator, state


def near_the_end(rng, operator, state):
    """Position, row and column of an entry where the plane ahead ends within a volume, or None."""
    if len(state.cursors) == 1 or rng.random() < 0.2:
        return None
    _, volume, end = state.cursors[1 - int(state.clock[CLOCK_PLANE])].tolist()
    if end == 0:
        return None
    area, width = math.prod(operator.patch), operator.patch[1]
    position, inside = divmod(int(pick(rng, [end - 1, end])) % ((len(state.counts) - 1) * area), area)
    top, left = (index * operator.stride for index in divmod(volume, int(state.volume_columns.max())))
    return position + 1, top + inside // width, left + inside % width


def changed_place(rng, operator, state):
    """Position, row and column of an entry whose clipped count is made another one."""
    anywhere = tuple(int(rng.integers(0, side)) for side in state.counts.shape)
    position, row, column = near_the_end(rng, operator, state) or anywhere
    entry = naive.slot_of(position, state), row, column
    state.counts[entry] = one_step(rng, int(state.applied[entry]), operator)
    return position, row, column


def make_change_volume(rng, kinds=EXACT_KINDS, *, stays=False, narrow=None):
    operator, state = parts_of(read_engine(rng, kinds, narrow=narrow))
    if narrow and operator.steps is None:
        return make_change_volume(rng, kinds, stays=stays, narrow=narrow)
    places = [place for place in in_planes(state) if not stays or state.moments[place][MOMENT_SQUARES] > 0]
    if not places:
        return make_change_volume(rng, kinds, stays=stays, narrow=narrow)
    plane, volume = pick(rng, places)
    part, ahead = random_part(rng, state), int(plane != state.clock[CLOCK_PLANE])
    values = naive._gather(state.applied, ahead, volume, operator, state)
    state.values[part, 0, : len(values)] = values
    filled = np.flatnonzero(values)
    n = int(pick(rng, [1, 1, min(2, len(values)), len(values)]))
    listed = rng.permutation(len(values))[:n]
    if len(filled) and rng.random() < 0.5:
        listed = np.array([pick(rng, filled)])
    after = values.copy()
    after[listed] = [one_step(rng, int(values[entry]), operator) for entry in listed]
    if stays and not after.any():
        return make_change_volume(rng, kinds, stays=stays, narrow=narrow)
    state.entries[part, : len(listed)] = listed
    state.changes[part, : len(listed)] = (after - values)[listed]
    return plane, volume, len(listed), part, operator, state


def make_move_volume(rng):
    kinds = [kind for kind in EXACT_KINDS if kind[0] == "direct"]
    return make_change_volume(rng, kinds, stays=True, narrow=False)


def make_queue_volume(rng):
    plane, volume, n, part, operator, state = make_change_volume(rng, NARROW_KINDS, stays=True, narrow=True)
    wait = rng.random()
    if wait < 0.7:  # others wait, of this volume's cell or of another, or as many as can
        cell = naive.cell_index(volume, operator.shape, operator.pooling)
        mine = [v for v in waiting(rng, plane, operator, state) if v != volume]
        if not mine:
            return make_queue_volume(rng)
        sign = int(pick(rng, [-1, 0, 1]))
        one_cell = [v for v in mine if (state.cells[v] == cell) == (wait < 0.5)] or mine
        fill_queue(rng, plane, one_cell, sign, part, operator, state)
    return plane, volume, n, part, operator, state


def waiting(rng, plane, operator, state):
    """Volumes that have a code in a plane and are not empty, in any order."""
    found = [v for p, v in in_planes(state) if p == plane and state.moments[plane, v][MOMENT_SQUARES] > 0]
    return rng.permutation(found).astype(int).tolist()


def fill_queue(rng, plane, volumes, sign, part, operator, state):
    """Let volumes of one cell wait, whose moments have changed but whose projections have not."""
    width, limit = operator.columns.shape[1], operator.max_count
    ahead, n, cell = int(plane != state.clock[CLOCK_PLANE]), 0, state.cells[volumes[0]]
    most = pick(rng, [1, 3, state.queue.shape[1]])
    for mine in volumes:
        values = naive._gather(state.applied, ahead, mine, operator, state)
        moments = state.moments[plane, mine]
        open_ = np.flatnonzero(values * (sign or 1) < limit)
        if state.cells[mine] != cell or not len(open_) or n == most:
            continue
        entry = int(pick(rng, open_))
        after = values.copy()
        after[entry] += sign or 1
        if not after.any() or (values != _entries_of(plane, mine, operator, state)).any():
            continue
        before = naive.narrow_gain(moments, operator)
        moments[:] = naive.sums_of(after, operator)[1]
        column = operator.columns[entry]
        state.sums[part, n + 1] = column
        place = entry * width if sign else (n + 1) * width
        row = (plane * state.projections.shape[1] + mine) * width
        state.queue[part, n] = place, row, before + 2**32 * naive.narrow_gain(moments, operator)
        n += 1
    state.queued[part] = n, plane, cell, sign


def _entries_of(plane, volume, operator, state):
    """The entries that a volume's projection stands for."""
    values = naive._gather(state.applied, int(plane != state.clock[CLOCK_PLANE]), volume, operator, state)
    values[naive._entries_in(plane, volume, state) :] = 0
    return values


def make_move_queued(rng):
    operator, state = parts_of(read_engine(rng, NARROW_KINDS, narrow=True))
    plane, part = int(rng.integers(0, len(state.cursors))), random_part(rng, state)
    if operator.steps is None or not (volumes := waiting(rng, plane, operator, state)):
        return make_move_queued(rng)
    if rng.random() < 0.8:
        fill_queue(rng, plane, volumes, int(pick(rng, [-1, 0, 1])), part, operator, state)
    return part, operator, state


def make_follow_rest(rng):
    if rng.random() < 0.3:
        operator, state = parts_of(read_engine(rng, narrow=False))
        return None, random_part(rng, state), operator, state
    part, operator, state = make_move_queued(rng)
    return operator.upper, part, operator, state


def make_move_rows(rng):
    part, operator, state = make_move_queued(rng)
    n, plane, cell, sign = state.queued[part].tolist()
    columns = operator.columns if sign else state.sums[part]
    rows, sums = state.projections.reshape(-1), state.pooled[plane, cell]
    return n, sign, state.queue[part], columns.reshape(-1), rows, operator.upper, operator.lower, sums


def narrow_volume(rng):
    """As `random_volume`, in the narrow state."""
    operator = random_engine(rng, NARROW_KINDS, narrow=True)._operator
    if operator.steps is None:
        return narrow_volume(rng)
    values = random_values(rng, operator)
    values[0] = values[0] or 1
    projection, moments = naive.sums_of(values, operator)
    return operator, projection.astype(np.int16), moments


def make_narrow_gain(rng):
    operator, _, moments = narrow_volume(rng)
    return moments, operator


def make_narrow_code(rng):
    operator, projection, moments = narrow_volume(rng)
    code = random_code(rng, len(projection))
    return naive.narrow_gain(moments, operator), projection, operator.upper, operator.lower, code


def make_pool_narrow(rng):
    *row, _ = make_narrow_code(rng)
    pooled = rng.integers(-(2**30), 2**30, 2 * len(row[1])).astype(np.int32)
    return int(pick(rng, [-1, 1])), *row, pooled


def kinds_of(operator):
    """The first arguments of what is compiled for one kind of state."""
    return operator.upper, operator.wide, operator.lasso


def make_follow_changes(rng):
    *arguments, operator, state = make_change_volume(rng)
    return *kinds_of(operator), *arguments, operator, state


def exact_once_moved(kernel: Run, twin: Run) -> None:
    """As `exact_but_scratch`, once the queues are empty; of the twin, too, where others waited before."""
    for run in (kernel, twin):
        operator, state = run.after[-2:]
        if operator.steps is not None:
            for part in range(len(state.queued)):
                naive.move_queued(part, operator, state)
        naive.add_up(len(state.code), state)
    exact_but_scratch(kernel, twin)


def make_write_code(rng):
    arguments = make_encode_volume(rng)
    while not arguments[1][MOMENT_SQUARES]:
        arguments = make_encode_volume(rng)
    return *kinds_of(arguments[-2]), *arguments


def make_pool_row_of(rng):
    plane, volume, _, sign, part, operator, state = make_pool_volume(rng)
    sums = np.zeros_like(state.pooled[0, 0])
    return *kinds_of(operator), plane, volume, sign, part, operator, state, sums


def make_write_features(rng):
    operator, state, features = make_read_features(rng)
    return operator.steps, operator, state.pooled[0].copy(), features


def make_change_place(rng):
    operator, state = parts_of(read_engine(rng))
    coming = 1 - int(state.clock[CLOCK_PLANE])
    for _ in range(8 if len(state.cursors) > 1 else 0):
        rewind(rng, coming, operator, state)
        if state.cursors[coming, CURSOR_ENTRY]:
            break
    return *changed_place(rng, operator, state), operator, state


def make_follow(rng):
    engine = read_engine(rng)
    events = hostile_events(rng, engine, int(rng.integers(0, 12)), 2.0)
    near = rng.random(len(events)) < 0.5  # or most would be late
    bin_us = engine.encoder.geometry.bin_us
    events["t"][near] = np.sort(bin_start(engine) + rng.integers(0, 2 * bin_us + 1, near.sum()))
    operator, state = parts_of(engine)
    return events, operator, state


def make_follow_event(rng):
    events, *sensor = make_follow(rng)
    while len(events) == 0:
        events, *sensor = make_follow(rng)
    return *(int(events[name][0]) for name in ("x", "y", "p", "t")), *sensor


def random_weights(rng, n_features, classes):
    length = SUMMED * math.ceil(math.ceil(n_features / PARTS) / SUMMED)
    rows = rng.standard_normal((PARTS, classes, length)).astype(np.float32)
    return Weights(rows, rng.standard_normal(classes).astype(np.float32))


def reading_for(weights, n_features, cells):
    """Scratch with anything in it."""
    _, classes, length = weights.rows.shape
    return Reading(
        np.full(n_features, np.nan, np.float32),
        np.full(length, np.nan, np.float32),
        np.full((PARTS, classes + 1), np.nan, np.float32),
        np.zeros(cells, np.uint8),
        np.zeros(PARTS, np.uint8),
    )


def make_trace(rng):
    events, operator, state = make_follow(rng)
    n, classes = len(events), int(pick(rng, [0, 1, 1, 3]))
    weights = random_weights(rng, n_features(operator), classes)
    reading = reading_for(weights, n_features(operator), state.pooled.shape[1])
    features = np.zeros((int(pick(rng, [0, n, n])), n_features(operator)), np.float32)
    scores, accepted = np.zeros((n, classes), np.float32), np.zeros(n, int)
    return events, operator, state, weights, reading, features, scores, accepted


def make_read_stale(rng):
    operator, state = parts_of(read_engine(rng, EXACT_KINDS))
    weights = random_weights(rng, n_features(operator), int(pick(rng, [0, 1, 3])))
    reading = reading_for(weights, n_features(operator), state.pooled.shape[1])
    naive.read_features(operator, state, reading.features)
    reading.sums[:] = rng.standard_normal(reading.sums.shape)
    stale = rng.random(len(reading.is_stale)) < pick(rng, [0.0, 0.3, 1.0])
    reading.features.reshape(len(stale), -1)[stale] = np.nan
    reading.is_stale[:] = stale
    reading.parts[:] = rng.random(PARTS) < pick(rng, [0.0, 0.0, 0.3])
    return operator, state, weights, reading


def make_mark_cells(rng):
    operator, state = parts_of(random_engine(rng))
    x, y = (int(rng.integers(len(ring))) for ring in (state.ring_columns, state.ring_rows))
    return x, y, operator, state, (rng.random(state.pooled.shape[1]) < 0.1).astype(np.uint8)


def random_features(rng, n, length):
    features = np.abs(rng.standard_normal((n, length)) * 100).astype(np.float32)
    features *= pick(rng, [np.float32(1), rng.choice([-1, 1], features.shape).astype(np.float32)])
    features[rng.random(features.shape) < pick(rng, [0.2, 1.0])] = 0
    return features


def make_predict(rng):
    n_features, classes, n = int(rng.integers(1, 1200)), int(pick(rng, [1, 3])), int(rng.integers(0, 4))
    weights = random_weights(rng, n_features, classes)
    reading = reading_for(weights, n_features, 1)
    features = random_features(rng, n, n_features)
    return features, weights, reading.roots, reading.sums, np.zeros((n, classes), np.float32)


def make_sum_part(rng):
    n_features, classes = int(rng.integers(1, 1200)), int(pick(rng, [0, 1, 3]))
    weights = random_weights(rng, n_features, classes)
    reading = reading_for(weights, n_features, 1)
    features = random_features(rng, 1, n_features)[0]
    return int(rng.integers(PARTS)), features, weights, reading.roots, reading.sums


def make_score_parts(rng):
    classes = int(pick(rng, [0, 1, 3]))
    sums = rng.standard_normal((PARTS, classes + 1)).astype(np.float32)
    sums[:, classes] = np.abs(sums[:, classes]) * pick(rng, [0, 1, 1])
    return sums, rng.standard_normal(classes).astype(np.float32), np.zeros(classes, np.float32)


def make_part_of(rng):
    n_features = int(rng.integers(1, 1200))
    return int(rng.integers(n_features)), n_features


def make_read_cell(rng):
    operator, state = parts_of(read_engine(rng))
    return (
        int(rng.integers(state.pooled.shape[1])),
        operator,
        state,
        random_features(rng, 1, n_features(operator))[0],
    )


def make_read_features(rng):
    operator, state = parts_of(read_engine(rng))
    return operator, state, np.zeros(n_features(operator), np.float32)


def make_add_column(rng):
    column = rng.integers(-32767, 32768, 32).astype(np.int16)
    return np.int32(rng.integers(-100, 101)), frozen(column), random_code(rng, 32)


def make_sum_columns(rng):
    n, d, width = int(rng.integers(0, 9)), 8, int(pick(rng, [32, 64, 96, 128, 160, 416]))
    columns = rng.integers(-32767, 32768, (d, width)).astype(np.int16)
    changes = rng.integers(-(2**15) + 1, 2**15, d + 1).astype(np.int16)
    changes[rng.random(d + 1) < 0.5] = 1
    if int(np.abs(changes[:n].astype(np.int64)).sum()) * 32767 >= 2**31:  # an operator allows no such sum
        changes = np.sign(changes)
    entries = np.append(rng.permutation(d), 0).astype(np.int32)
    return (
        n,
        entries,
        changes,
        frozen(columns),
        random_code(rng, width).astype(pick(rng, [np.int32, np.int16])),
    )


def sums_only(kernel: Run, twin: Run) -> None:
    assert_same(kernel.after[-1], twin.after[-1])


def make_add_moments(rng):
    n, *_ = make_change_entries(rng)
    changes = rng.integers(-(2**14) + 1, 2**14, n + 2).astype(np.int16)
    return n, changes, rng.integers(-(2**40), 2**40, 4)


def make_change_moments(rng):
    n, entries, changes, values, operator, _, moments, _ = make_change_entries(rng)
    return n, entries, changes, values, operator, moments


def random_changes(rng, operator, values):
    """Some entries and how much they change, so that none leaves the range of clipped counts."""
    n = int(rng.integers(0, len(values) + 1))
    entries, limit = rng.permutation(len(values)).astype(np.int32), min(operator.max_count, 100)
    changes = rng.integers(-limit, limit + 1, len(values)).astype(np.int16) - values[entries]
    return np.append(entries, np.int32(0)), np.append(changes, np.int16(0)), n


def make_change_entries(rng):
    operator, projection, moments = random_volume(rng)
    values = random_values(rng, operator).clip(-100, 100)
    entries, changes, n = random_changes(rng, operator, values)
    return n, entries, changes, values, operator, projection, moments, random_code(rng, len(projection))


def random_place(rng):
    """A ring of clipped counts, and where a volume lies in it, which need not be a square."""
    n_bins, rows, columns = int(rng.integers(1, 5)), int(rng.integers(1, 11)), int(rng.integers(1, 21))
    patch = rows, columns if rng.random() < 0.7 else rows
    d = n_bins * math.prod(patch)
    height, width = (side + int(more) for side, more in zip(patch, rng.integers(0, 6, 2), strict=True))
    ring = rng.integers(-2, 3, (n_bins, height, width)).astype(np.int16)
    ring[rng.random(ring.shape) < rng.random()] = 0
    top, left = int(rng.integers(0, height - patch[0] + 1)), int(rng.integers(0, width - patch[1] + 1))
    return ring, int(rng.integers(0, n_bins)), top, left, patch, d


def make_gather_volume(rng):
    ring, first_slot, top, left, patch, d = random_place(rng)
    start, end = sorted(int(entry) for entry in rng.integers(0, d + 1, 2))
    return ring, first_slot, start, end, top, left, patch, np.ones(d, np.int16)


def make_list_entries(rng):
    d = int(rng.integers(1, 200))
    values = np.zeros(-(-d // 64) * 64, np.int16)
    values[:] = rng.integers(-2, 3, len(values))
    values[rng.random(len(values)) < rng.random()] = 0
    start, end = sorted(int(entry) for entry in rng.integers(0, d + 1, 2))
    return values, start, end, np.zeros(d, np.int32), np.zeros(d, np.int16)


def _surface_events(rng, height, width, n):
    t = np.sort(rng.uniform(0, 3, n))
    x, y = rng.integers(0, width, n), rng.integers(0, height, n)
    return x, y, rng.integers(0, 2, n), t


def make_draw_picture(rng):
    tall, wide, height, width = rng.integers(1, 9, 4)
    lines = rng.integers(0, tall, (height, 4)), rng.integers(0, wide, (width, 4))
    weights = rng.random((height, 4)), rng.random((width, 4))
    out = np.empty((height, width))
    return rng.random((tall, wide)), lines[0], weights[0], lines[1], weights[1], np.empty(wide), out


def make_fire_pixels(rng):
    n, room = int(rng.integers(1, 30)), int(rng.choice([0, 2, 9, 400]))
    before, steps = rng.integers(-9, 9, n) / 8, rng.choice([0, -1, 1, 3, -4, 9], n) / 8
    start = float(rng.integers(0, 10_000))
    end = start + float(rng.choice([1, 50, 4_000]))
    thresholds = rng.integers(1, 4, (2, n)) / 16
    release = start + rng.choice([-5.0, 0.0, 0.5, end - start, 9_000.0], n)
    state = before + rng.integers(-1, 2, n) / 32, release
    outs = (np.zeros(room, np.int64) for _ in range(3))
    refractory = float(rng.choice([0, 1, 30, 1_000]))
    return before, before + steps, start, end, thresholds, refractory, *state, int(rng.integers(0, n)), *outs


def make_add_memory_surfaces(rng):
    height, width, cell = rng.integers(3, 12, 3)
    radius = int(rng.integers(0, 4))
    rows, columns, side = -(-height // cell), -(-width // cell), 2 * radius + 1
    events = _surface_events(rng, height, width, random_length(rng, 60))
    memory = rng.uniform(0, 2, (2, height, width))
    return *events, int(cell), memory, rng.uniform(0, 1, (rows, columns, 2, side, side))


def make_time_surfaces(rng):
    height, width, side = int(rng.integers(1, 9)), int(rng.integers(1, 9)), 2 * int(rng.integers(0, 4)) + 1
    x, y, p, t = _surface_events(rng, height, width, random_length(rng, 60))
    n_polarities = int(rng.choice([2, 2, 5]))  # of a camera, or of a layer of HOTS
    p = p if n_polarities == 2 else rng.integers(0, n_polarities, len(p))
    latest = np.full((n_polarities, height + side - 1, width + side - 1), -np.inf)
    return x, y, p, t, latest, np.empty((len(x), n_polarities, side, side), np.float32)


def make_describe_events(rng):
    height, width, radius, n_places = (int(rng.integers(1, most)) for most in (9, 9, 4, 6))
    x, y, _, _ = _surface_events(rng, height, width, random_length(rng, 60))
    places = rng.integers(-1, n_places, (2 * radius + 1, 2 * radius + 1))
    recent = np.zeros((height + 2 * radius, width + 2 * radius), np.int64)
    queue, filled = np.full(int(rng.integers(1, 30)), -1), rng.random() < 0.5
    if filled:
        rows, columns = rng.integers(0, height, len(queue)), rng.integers(0, width, len(queue))
        queue[:] = (rows + radius) * recent.shape[1] + columns + radius
        np.add.at(recent.reshape(-1), queue, 1)
    head = rng.integers(0, len(queue) if filled else 1, 1)
    return x, y, places, recent, queue, head, np.empty((len(x), n_places), np.float32)


def _neurons(rng):
    """Events, and the shapes of neurons and of cells of a few pixels."""
    height, width, cell, n_orientations = (int(rng.integers(1, most)) for most in (9, 9, 5, 5))
    x, y, p, t = _surface_events(rng, height, width, random_length(rng, 60))
    cells = -(-height // cell), -(-width // cell), n_orientations
    return (x, y, p, t), (2, height, width, n_orientations), cells, cell, 2 * int(rng.integers(0, 3)) + 1


def make_spike_first(rng):
    (x, y, p, t), neurons, cells, cell, side = _neurons(rng)
    weights = rng.integers(-60, 100, (side, side, neurons[3])).astype(np.int32)
    limits = np.array([rng.choice([60, 150]), rng.choice([0, 25]), *rng.choice([0, 5], 2), cell], np.int64)
    potential = rng.integers(-80, 60, neurons).astype(np.int32)
    updated, fired, pooled = (
        np.full(shape, past)
        for shape, past in ((neurons[:3], 0), (neurons[:3], BEFORE_TIME), (cells, BEFORE_TIME))
    )
    t = np.floor(t * 10).astype(np.int64)
    return x, y, p, t, weights, limits, potential, updated, fired, pooled, np.zeros(cells, np.int64)


def make_spike_leaky(rng):
    events, neurons, cells, cell, side = _neurons(rng)
    weights = rng.uniform(-60, 100, (side, side, neurons[3]))
    numbers = float(rng.choice([60, 150])), float(rng.choice([0.0, 0.3])), cell
    state = rng.uniform(-80, 60, neurons), np.zeros(neurons[:3]), np.full(neurons, -np.inf)
    return *events, weights, *numbers, *state, np.zeros(cells, np.int64)


def close_surfaces(kernel: Run, twin: Run) -> None:
    """Powers of e may differ in their last bits."""
    for mine, yours in zip(kernel.after, twin.after, strict=True):
        np.testing.assert_allclose(mine, yours, rtol=1e-6)


def make_mark_noise(rng):
    height, width, n = int(rng.integers(1, 6)), int(rng.integers(1, 6)), random_length(rng, 200)
    events = np.zeros(n, EVENT_DTYPE)
    events["x"], events["y"] = rng.integers(0, width + 1, n), rng.integers(0, height + 1, n)
    events["p"] = rng.choice([0, 1, 0, 1, 0, 1, -1, 2], n)
    steps = rng.choice([0, 1, 20, 300, -40, 5_000, 2_000_000, -2_000_000], n, p=[0.2] * 4 + [0.05] * 4)
    events["t"] = np.cumsum(steps)
    if n:
        events["t"][rng.integers(0, n)] = rng.choice([1 << 62, -(1 << 62), (1 << 62) - 1, 1 - (1 << 62), 5])
    limits = np.array([rng.choice([0, 1, 90_000, 600_000]), *rng.choice([0, 1, 20, 300], 2)], np.int64)
    limits *= rng.random() > 0.1
    past = np.where(rng.random((3, height, width)) < 0.5, BEFORE_TIME, rng.integers(-500, 500))
    level = rng.integers(0, 2 * denoise.HOT_LEVEL, (height, width))
    return events, limits, past.astype(np.int64), level, rng.integers(0, 9, 3), np.zeros(n, np.bool_)


@dataclass(frozen=True)
class Row:
    """A kernel, a maker of random arguments, and the meaning of "the same result"."""

    kernel: Callable[..., Any]
    make: Callable[[np.random.Generator], tuple[Any, ...]]
    agree: Callable[[Run, Run], None] = exact

    @property
    def name(self) -> str:
        return self.kernel.__name__

    @property
    def call(self) -> Callable[..., Any]:
        """The kernel as Python can call it: one that only kernels can call is compiled once more."""
        options = self.kernel.targetoptions
        if not options.get("no_cpython_wrapper"):
            return self.kernel
        return njit(error_model=options["error_model"], _nrt=options["_nrt"])(self.kernel.py_func)

    @property
    def twin(self) -> Callable[..., Any]:
        return getattr(naive, self.name)


KERNELS = [
    Row(code.deviation, make_deviation),
    Row(code.whitened_square, make_whitened_square),
    Row(code.soft_code, make_soft_code),
    Row(code.triangle_code, make_triangle_code),
    Row(code.pool, make_pool),
    Row(code.pool_soft, make_pool_soft),
    Row(code.move_code, make_move_code),
    Row(code.move_triangle, make_move_triangle, exact_but_codes),
    Row(code.fixed_distance, make_fixed_distance),
    Row(code.mean_distance, make_mean_distance),
    Row(code.gain, make_gain),
    Row(decode.decode_evt3, make_evt3),
    Row(decode.decode_libcaer_cmp, make_libcaer_cmp, exact_unless_refused),
    Row(decode.decode_mono, make_mono),
    Row(decode.decode_libcaer, make_libcaer),
    Row(decode.place_events, make_place_events),
    Row(decode.time_span, make_time_span),
    Row(denoise.mark_noise, make_mark_noise),
    Row(file_codes.turns_between, make_turns_between),
    Row(file_codes.decode_evt2, make_evt2),
    Row(file_codes.decode_dat, make_dat),
    Row(file_codes.decode_event_stream, make_event_stream),
    Row(file_codes.decode_ecf, make_ecf, exact_unless_refused),
    Row(file_codes.decode_groups, make_groups, exact_unless_refused),
    Row(file_codes.parse_rows, make_rows, exact_unless_refused),
    Row(ingest.advance_to_bin, make_advance_to_bin),
    Row(ingest.is_valid, make_is_valid),
    Row(ingest.count_event, make_count_event),
    Row(ingest.bin_length, make_bin_length),
    Row(ingest.slot_of, make_slot_of),
    Row(ingest.count_events, make_count_events, exact_below_the_top),
    Row(lasso.duality_gap, make_duality_gap, close),
    Row(lasso.solve_lasso, make_solve_lasso, lasso_within_gap),
    Row(lasso.subtract_row, make_subtract_row),
    Row(lasso.descend, make_descend, close_but_scratch),
    Row(lasso.extrapolate, make_extrapolate, close_but_scratch),
    Row(lasso.select_atoms, make_select_atoms, selected),
    Row(lasso.copy_corner, make_copy_corner),
    Row(lasso.add_rows, make_add_rows, close_but_scratch),
    Row(lasso.respond, make_respond, close_but_scratch),
    Row(lasso.lasso_code, make_lasso_code, lasso_code_within_gap),
    Row(lasso.fix_atoms, make_fix_atoms),
    Row(lasso.solve_lasso_rows, make_solve_lasso_rows, rows_within_gap),
    Row(encode.encode_volume, make_encode_volume),
    Row(encode.pool_volume, make_pool_volume, exact_but_scratch),
    Row(encode.read_cell, make_read_cell),
    Row(encode.read_features, make_read_features),
    Row(encode.write_code, make_write_code),
    Row(encode.pool_row_of, make_pool_row_of, exact_but_scratch),
    Row(encode.write_features, make_write_features),
    Row(narrow.narrow_gain, make_narrow_gain),
    Row(narrow.narrow_code, make_narrow_code),
    Row(narrow.pool_narrow, make_pool_narrow),
    Row(narrow.move_rows, make_move_rows),
    Row(narrow.move_queued, make_move_queued, exact_but_scratch),
    Row(narrow.queue_volume, make_queue_volume, exact_once_moved),
    Row(dense.can_wait, make_can_wait),
    Row(dense.let_in, make_let_in, exact_waiting),
    Row(dense.multiply, make_multiply, exact_but_scratch),
    Row(planes.project_volume, make_project_volume, exact_but_scratch),
    Row(planes.enter_atoms, make_enter_atoms, exact_but_responses),
    Row(planes.enter_code, make_enter_code, exact_but_scratch),
    Row(planes.count_filled, make_count_filled, exact_but_lines),
    Row(planes.list_missing, make_list_missing, exact_list),
    Row(planes.share_of, make_share_of),
    Row(planes.first_with_load, make_first_with_load),
    Row(planes.share_of_load, make_share_of_load),
    Row(planes.finish, make_finish),
    Row(planes.fill_plane, make_fill_plane, exact_but_atoms),
    Row(planes.complete, make_complete, exact_but_atoms_of_a_part),
    Row(planes.look_ahead, make_look_ahead, exact_but_atoms),
    Row(update.mark_dirty, make_mark_dirty, exact_but_scratch),
    Row(update.renew, make_renew, exact_but_atoms),
    Row(update.touched_bins, make_touched_bins),
    Row(update.settle, make_settle),
    Row(update.update, make_update, exact_but_atoms),
    Row(update.read, make_read, exact_but_features),
    Row(change.change_volume, make_change_volume, exact_but_scratch),
    Row(change.move_volume, make_move_volume, exact_but_scratch),
    Row(change.follow_changes, make_follow_changes, exact_once_moved),
    Row(change.follow_rest, make_follow_rest, exact_but_scratch),
    Row(change.change_place, make_change_place, exact_but_atoms),
    Row(follow.follow_event, make_follow_event, exact_but_atoms),
    Row(follow.follow, make_follow, exact_but_atoms),
    Row(predict.part_of, make_part_of),
    Row(predict.sum_part, make_sum_part),
    Row(predict.score_parts, make_score_parts),
    Row(predict.predict, make_predict),
    Row(trace.mark_cells, make_mark_cells),
    Row(trace.read_stale, make_read_stale, exact_but_roots),
    Row(trace.trace, make_trace, exact_trace),
    Row(pixels.draw_picture, make_draw_picture),
    Row(pixels.fire_pixels, make_fire_pixels),
    Row(retina.describe_events, make_describe_events),
    Row(spiking.spike_first, make_spike_first),
    Row(spiking.spike_leaky, make_spike_leaky, close_surfaces),
    Row(surfaces.add_memory_surfaces, make_add_memory_surfaces, close_surfaces),
    Row(surfaces.time_surfaces, make_time_surfaces, close_surfaces),
    Row(volume.add_column, make_add_column),
    Row(volume.add_moments, make_add_moments),
    Row(volume.change_moments, make_change_moments),
    Row(volume.sum_columns, make_sum_columns, sums_only),
    Row(volume.change_entries, make_change_entries, exact_but_sums),
    Row(volume.gather_volume, make_gather_volume),
    Row(volume.list_entries, make_list_entries),
]
