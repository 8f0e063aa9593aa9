"""Which cases the rows of the kernel table must reach: where no argument does, a row proves nothing.

A case is a name and a condition on one call: the arguments by name, as they were before, and `result`. Where
a kernel goes step by step, it is a condition on one step, from the state that the steps before have left.
"""

import inspect
import math
from types import SimpleNamespace

import naive
import numpy as np

from streamfeat.events import is_valid
from streamfeat.kernels.layout import (
    BEFORE_TIME,
    CLOCK_DIRTY,
    CLOCK_NOW,
    CLOCK_PLANE,
    CLOCK_START,
    CLOCK_TOUCHED,
    CURSOR_CODED,
    CURSOR_ENTRY,
    CURSOR_PROJECTED,
    MOMENT_SQUARES,
    MOMENT_SUM,
    SOFT,
    SPLIT,
    TRIANGLE,
)


def call_of(row, run):
    """One call of a row's kernel, its arguments by name."""
    names = inspect.signature(row.kernel.py_func).parameters
    return SimpleNamespace(**dict(zip(names, run.before, strict=True)), result=run.result)


def reached(row, run):
    """Names of the cases that one call reaches."""
    call = call_of(row, run)
    found = {name for name, holds in CASES.get(row.name, {}).items() if holds(call)}
    if row.name in STEPS:
        steps, cases = STEPS[row.name]
        for step in steps(call):
            found |= {name for name, holds in cases.items() if name not in found and holds(step)}
    return found


def cases_of(row):
    """Names of all cases of a row."""
    _, cases = STEPS.get(row.name, (None, {}))
    return CASES.get(row.name, {}).keys() | cases.keys()


# Packets: what a decoder makes of each word depends on the words before it.


def _evt3_steps(call):
    """Each word, with the state before it."""
    state, out = call.state.copy(), call.out.copy()
    for i, word in enumerate(call.words.tolist()):
        high, _, _, base, _, seen = state.tolist()
        step = (word % 4096 - high) % 4096
        yield SimpleNamespace(kind=word >> 12, value=word % 4096, high=high, base=base, seen=seen, step=step)
        naive.decode_evt3(call.words[i : i + 1], state, out)


EVT3 = {
    "an event before there is a row": lambda s: s.kind == 2 and s.seen < 3,
    "an event": lambda s: s.kind == 2 and s.seen >= 3,
    "a row before there is a time": lambda s: s.kind == 0 and s.seen < 2,
    "a base before there is a row": lambda s: s.kind == 3 and s.seen < 3,
    "12 pixels without a base": lambda s: s.kind == 4 and s.seen == 3,
    "8 pixels without a base": lambda s: s.kind == 5 and s.seen == 3,
    "12 pixels": lambda s: s.kind == 4 and s.seen >= 4 and s.value > 0,
    "8 pixels": lambda s: s.kind == 5 and s.seen >= 4 and s.value % 256 > 0,
    "8 pixels and bits beyond them": lambda s: s.kind == 5 and s.seen >= 4 and s.value > 255,
    "the next column of a vector wraps": lambda s: s.kind in (4, 5) and s.seen >= 4 and s.base > 65535 - 8,
    "a low time before a high one": lambda s: s.kind == 6 and s.seen < 1,
    "a word that carries no event": lambda s: s.kind in (7, 10, 14, 15),
    "time goes on": lambda s: s.kind == 8 and 0 < s.step < 2048,
    "time goes on by half of a turn": lambda s: s.kind == 8 and s.step == 2048,
    "time stands": lambda s: s.kind == 8 and s.step == 0,
    "time goes back a little": lambda s: s.kind == 8 and s.step > 2048 and s.high + s.step >= 4096,
    "time would go back below zero": lambda s: s.kind == 8 and s.step > 2048 and s.high + s.step < 4096,
    "time wraps": lambda s: s.kind == 8 and 0 < s.step < 2048 and s.high % 4096 + s.step >= 4096,
}


def _kinds(*kinds):
    return lambda call: bool(np.isin(call.words >> 12, kinds).any())


LIBCAER_CMP = {
    "a word of an unknown type": lambda call: call.result < 0,
    "all are known": lambda call: call.result > 0,
    "no word": lambda call: len(call.words) == 0,
    "a high time": _kinds(0),
    "a low time": _kinds(1),
    "a column": _kinds(2),
    "an event": _kinds(3),
    "8 pixels": _kinds(5),
    "a vector before its base, from the packet before": lambda call: bool(
        call.state.any() and len(call.words) and call.words[0] >> 12 == 5
    ),
    "the next row of a vector wraps": lambda call: (
        call.state[1] > 65535 - 8 and len(call.words) > 0 and call.words[0] >> 12 == 5
    ),
}

MONO = {
    "no word": lambda call: len(call.words) == 0,
    "OFF": lambda call: (call.words >> np.uint64(63) == 0).any(),
    "ON": lambda call: (call.words >> np.uint64(63) == 1).any(),
    "nanoseconds of the packet carry": lambda call: any(
        (call.rest_ns + int(word) % 2**32) // 1000 > int(word) % 2**32 // 1000 for word in call.words
    ),
    "a row beyond 14 bits": lambda call: (call.words >> np.uint64(62) & np.uint64(1)).any(),
    "whole thousands": lambda call: any(
        (int(word) % 2**32 + call.rest_ns) % 1000 == 0 for word in call.words
    ),
    "no event on the sensor": lambda call: len(call.words) > 0 and call.result == 0,
    "some events on the sensor": lambda call: 0 < call.result < len(call.words),
}


def _libcaer_us(call):
    return (call.words >> np.uint64(32)).astype(np.int64) % 2**31


LIBCAER = {
    "no word": lambda call: len(call.words) == 0,
    "the clock wraps": lambda call: (np.diff(_libcaer_us(call)) < -(2**30)).any(),
    "an event out of order": lambda call: any(-(2**30) < d < 0 for d in np.diff(_libcaer_us(call))),
    "the highest bit is set": lambda call: (call.words >> np.uint64(63)).any(),
    "no event on the sensor": lambda call: len(call.words) > 0 and call.result == 0,
    "some events on the sensor": lambda call: 0 < call.result < len(call.words),
}


def _usable(call):
    return is_valid(call.events, (call.height, call.width))


PLACE_EVENTS = {
    "no event": lambda call: len(call.events) == 0,
    "none can be used": lambda call: len(call.events) > 0 and not _usable(call).any(),
    "all can be used": lambda call: len(call.events) > 0 and _usable(call).all(),
    "the latest cannot be used": lambda call: (
        _usable(call).any() and not _usable(call)[call.events["t"].argmax()]
    ),
    "the earliest cannot be used": lambda call: (
        _usable(call).any() and not _usable(call)[call.events["t"].argmin()]
    ),
    "a polarity below and one above": lambda call: {-1, 2} <= set(call.events["p"].tolist()),
    "none reaches beyond": lambda call: (
        _usable(call).any() and call.events["t"][_usable(call)].max() < call.reached_us
    ),
    "a step back": lambda call: (np.diff(call.events["t"][_usable(call)]) < 0).any(),
}


TURNS_BETWEEN = {
    "nothing before": lambda call: call.before < 0,
    "a fall of half the range": lambda call: (
        call.before >= 0 and call.now - call.before == -(2**call.bits) // 2
    ),
    "a fall of more": lambda call: call.result == 1,
    "a rise of half the range": lambda call: call.before >= 0 and call.now - call.before == 2**call.bits // 2,
    "a rise of more": lambda call: call.result == -1,
}


def _evt2_steps(call):
    """Each word, with the state before it."""
    state, out = call.state.copy(), call.out.copy()
    for i, word in enumerate(call.words.tolist()):
        high, turns = state.tolist()
        yield SimpleNamespace(kind=word >> 28, low=word % 2**28, high=high, turns=turns)
        naive.decode_evt2(call.words[i : i + 1], state, out)


EVT2 = {
    "OFF": lambda s: s.kind == 0 and s.high >= 0,
    "ON": lambda s: s.kind == 1 and s.high >= 0,
    "an event before there is a time": lambda s: s.kind <= 1 and s.high < 0,
    "the first time": lambda s: s.kind == 8 and s.high < 0,
    "a turn": lambda s: s.kind == 8 and s.low - s.high < -(2**27) and s.high >= 0,
    "an event after a turn": lambda s: s.kind <= 1 and s.turns > 0,
    "an event from before the first turn": lambda s: s.kind <= 1 and s.turns < 0 and s.high >= 0,
    "a word that carries no event": lambda s: s.kind in (10, 14),
}


def _dat_steps(call):
    """Each record, with the state before it."""
    state, out = call.state.copy(), call.out.copy()
    for i, (t, word) in enumerate(call.records.tolist()):
        latest, turns = state.tolist()
        yield SimpleNamespace(t=t, word=word, latest=latest, turns=turns)
        naive.decode_dat(call.records[i : i + 1], state, out)


DAT = {
    "the first": lambda s: s.latest < 0,
    "ON": lambda s: s.word >> 28 > 1,
    "OFF": lambda s: s.word >> 28 == 0,
    "a turn": lambda s: s.latest >= 0 and s.t - s.latest < -(2**31),
    "goes on after a turn": lambda s: s.turns > 0 and 0 <= s.t - s.latest < 2**31,
    "from before the first turn": lambda s: s.turns < 0,
}


def _stream_kinds(call):
    """The first byte of each item of an Event Stream, as far as they are whole."""
    at, firsts = 0, []
    while at < len(call.data):
        first = int(call.data[at])
        firsts.append(first)
        at += 1 if first >= (0xFC if call.is_atis else 0xFE) else 5
    return firsts, at > len(call.data)


EVENT_STREAM = {
    "no byte": lambda call: len(call.data) == 0,
    "a long time of a DVS": lambda call: not call.is_atis and 0xFF in _stream_kinds(call)[0],
    "a reset of a DVS": lambda call: not call.is_atis and 0xFE in _stream_kinds(call)[0],
    "a long time of an ATIS": lambda call: call.is_atis and 0xFE in _stream_kinds(call)[0],
    "a threshold crossing": lambda call: (
        call.is_atis and any(f % 2 and f < 0xFC for f in _stream_kinds(call)[0])
    ),
    "an event that is cut": lambda call: _stream_kinds(call)[1],
    "whole events": lambda call: call.result > 0 and not _stream_kinds(call)[1],
}

ECF = {
    "no event": lambda call: len(call.out) == 0,
    "runs of rows, masks of columns": lambda call: call.data[0] & 3 == 0 and call.result > 0,
    "runs of rows, columns in groups": lambda call: call.data[0] & 3 == 1 and call.result > 0,
    "pixels in groups": lambda call: call.data[0] & 2 != 0 and call.result > 0,
    "damaged or cut": lambda call: call.result < 0,
    "the second time is a long step": lambda call: call.result > 0 and call.data[13] >> 4 == 15,
    "the first run of times is long": lambda call: call.result > 0 and call.data[12] % 16 == 15,
}

GROUPS = {
    "no event": lambda call: len(call.out) == 0,
    "12 bits": lambda call: call.bits == 12 and call.result > call.at,
    "24 bits": lambda call: call.bits == 24 and call.result > call.at,
    "a group that is not whole": lambda call: len(call.out) % 4 != 0 and call.result > call.at,
    "cut": lambda call: call.result < 0,
}


def _on_sensor(call):
    return (call.events["x"] < call.width) & (call.events["y"] < call.height)


TIME_SPAN = {
    "no event": lambda call: len(call.events) == 0,
    "events, none on the sensor": lambda call: len(call.events) > 0 and not _on_sensor(call).any(),
    "the first is the latest": lambda call: (
        _on_sensor(call)[:1].any() and call.events["t"][0] == call.events["t"][_on_sensor(call)].max()
    ),
    "the earliest of all is not on the sensor": lambda call: (
        _on_sensor(call).any() and not _on_sensor(call)[call.events["t"].argmin()]
    ),
    "the latest of all is not on the sensor": lambda call: (
        _on_sensor(call).any() and not _on_sensor(call)[call.events["t"].argmax()]
    ),
    "the first column beyond the sensor": lambda call: (call.events["x"] == call.width).any(),
    "the first row beyond the sensor": lambda call: (call.events["y"] == call.height).any(),
}

# Noise: each event is one step from the state that the events before it left.


def _noise_steps(call):
    """Each event with the state before it, its pixel's past, and what became of it."""
    arrays = (call.past.copy(), call.level.copy(), call.removed.copy())
    for i, event in enumerate(call.events.tolist()):
        past, level, removed = (array.copy() for array in arrays)
        keep = np.zeros(1, np.bool_)
        naive.mark_noise(call.events[i : i + 1], call.limits, *arrays, keep)
        x, y, p, t = event
        inside = x < level.shape[1] and y < level.shape[0]
        yield SimpleNamespace(
            x=x,
            y=y,
            p=p,
            t=t,
            inside=inside,
            valid=inside and p in (0, 1) and abs(t) < 2**62,
            limits=call.limits.tolist(),
            past=past,
            own=past[:, y, x].tolist() if inside else None,
            level=level,
            kept=bool(keep[0]),
            reason=next(iter(np.flatnonzero(arrays[2] - removed).tolist()), None),
            level_after=int(arrays[1][y, x]) if inside else 0,
        )


def _valid(holds):
    return lambda step: step.valid and holds(step)


NOISE = {
    "outside the sensor": lambda s: not s.inside,
    "no polarity": lambda s: s.inside and s.p not in (0, 1),
    "an impossible time": lambda s: s.inside and abs(s.t) >= 2**62,
    "the last possible time": lambda s: s.inside and abs(s.t) == 2**62 - 1,
    "hot": _valid(lambda s: s.reason == 0),
    "as hot as it can be": _valid(lambda s: s.level_after == 2_000_000),
    "a level that time has lowered to nothing": _valid(
        lambda s: s.limits[0] and s.level[s.y, s.x] and s.level_after == s.limits[0]
    ),
    "a level that time going back leaves": _valid(
        lambda s: s.limits[0] and s.t < s.own[0] and s.level_after > s.level[s.y, s.x]
    ),
    "refractory": _valid(lambda s: s.reason == 1 and s.t >= s.own[1]),
    "refractory, and time goes back": _valid(lambda s: s.reason == 1 and s.t < s.own[1]),
    "exactly one refractory period later": _valid(
        lambda s: s.limits[1] and s.reason != 0 and s.t - s.own[1] == s.limits[1]
    ),
    "isolated": _valid(lambda s: s.reason == 2),
    "isolated, and only its own pixel is recent": _valid(
        lambda s: s.reason == 2 and abs(s.t - s.own[2]) <= s.limits[2]
    ),
    "supported": _valid(lambda s: s.limits[2] and s.kept),
    "supported, at a corner of the sensor": _valid(
        lambda s: s.limits[2] and s.kept and s.y == s.x == 0 and s.level.size > 1
    ),
    "nothing is asked for": _valid(lambda s: not any(s.limits)),
    "all three are": _valid(lambda s: all(s.limits)),
}

# Events to counts.


def _leap(call):
    return call.new - int(call.state.clock[CLOCK_NOW])


def _bins(call):
    return len(call.state.counts)


ADVANCE = {
    "to a bin before": lambda call: _leap(call) < 0,
    "to the same bin": lambda call: _leap(call) == 0,
    "to the next bin, one plane": lambda call: _leap(call) == 1 and len(call.state.cursors) == 1,
    "to the next bin, and the planes swap": lambda call: _leap(call) == 1 and len(call.state.cursors) == 2,
    "further, two planes": lambda call: _leap(call) > 1 and len(call.state.cursors) == 2,
    "within the window": lambda call: 1 < _leap(call) < _bins(call),
    "by exactly one window": lambda call: 1 < _leap(call) == _bins(call),
    "beyond the window": lambda call: _bins(call) < _leap(call) < 2**40,
    "from before time": lambda call: call.state.clock[CLOCK_NOW] == BEFORE_TIME,
}


def _place(call):
    """Where an event lies: the bin it is in, from the current one, if it is valid."""
    height, width = len(call.state.ring_rows), len(call.state.ring_columns)
    now, start = (int(call.state.clock[slot]) for slot in (CLOCK_NOW, CLOCK_START))
    valid = call.x < width and call.y < height and call.p in (0, 1) and abs(call.t) < 2**62
    if not valid or now == BEFORE_TIME:
        return None
    return (call.t - start) // call.operator.bin_us


def _count_before(call):
    """The count that an event falls on, where its bin is in the window."""
    place = _place(call)
    if place is None or not -_bins(call) < place <= 0:
        return None
    side = call.operator.downsample
    slot = naive.slot_of(_bins(call) - 1 + place, call.state)
    return int(call.state.counts[slot, call.y // side, call.x // side])


def _one(holds):
    return lambda call: (place := _place(call)) is not None and holds(place, _bins(call))


def _on_count(holds):
    return lambda call: (
        (count := _count_before(call)) is not None and holds(count, call.operator.max_count, 2 * call.p - 1)
    )


COUNT_EVENT = {
    "outside, by its column": lambda call: call.x >= len(call.state.ring_columns),
    "outside, by its row": lambda call: call.y >= len(call.state.ring_rows),
    "a polarity below": lambda call: call.p < 0,
    "a polarity above": lambda call: call.p > 1,
    "a time too early": lambda call: call.t <= -(2**62),
    "a time too late": lambda call: call.t >= 2**62,
    "in the current bin": _one(lambda place, bins: place == 0),
    "in a bin before it": _one(lambda place, bins: -bins < place < 0),
    "in the oldest bin": _one(lambda place, bins: place == 1 - bins < 0),
    "just older than the window": _one(lambda place, bins: place == -bins),
    "far too late": _one(lambda place, bins: place < -bins - 1),
    "in the next bin": _one(lambda place, bins: place == 1),
    "in a bin far ahead": _one(lambda place, bins: place > bins),
    "saturated, ON": _on_count(lambda count, limit, step: count >= limit and step > 0),
    "saturated, OFF": _on_count(lambda count, limit, step: count <= -limit and step < 0),
    "back from beyond the limit": _on_count(
        lambda count, limit, step: abs(count) > limit and count * step < 0
    ),
    "back from the limit": _on_count(lambda count, limit, step: count == -step * limit),
}

BIN_LENGTH = {
    "before time": lambda call: call.state.clock[CLOCK_NOW] == BEFORE_TIME,
    "in time": lambda call: call.state.clock[CLOCK_NOW] != BEFORE_TIME,
}
SLOT_OF = {
    "wraps": lambda call: call.result < call.position,
    "does not": lambda call: call.result >= call.position,
    "the current bin": lambda call: call.position == _bins(call) - 1,
}


def _count_steps(call):
    """Each event of a batch as a call of its own."""
    state = type(call.state)(*(field.copy() for field in call.state))
    for i, (x, y, p, t) in enumerate(call.events.tolist()):
        yield SimpleNamespace(x=x, y=y, p=p, t=t, operator=call.operator, state=state)
        naive.count_events(call.events[i : i + 1], call.operator, state)


def _is_touched(step):
    side = step.operator.downsample
    slot = naive.slot_of(_bins(step) - 1 + _place(step), step.state)
    return bool(step.state.is_touched[slot, step.y // side, step.x // side])


def _unchanged(step):
    count = _count_before(step)
    if count is None:
        return False
    limit, step_by = step.operator.max_count, 2 * step.p - 1
    return np.clip(count, -limit, limit) == np.clip(count + step_by, -limit, limit)


COUNT_EVENTS = COUNT_EVENT | {
    "touched in the current bin": lambda s: _place(s) == 0 and not _unchanged(s) and not _is_touched(s),
    "touched again in the current bin": lambda s: _place(s) == 0 and not _unchanged(s) and _is_touched(s),
    "touched before, and saturated now": lambda s: _unchanged(s) and _is_touched(s),
    "touched again in a bin before": lambda s: (
        _count_before(s) is not None and _place(s) < 0 and not _unchanged(s) and _is_touched(s)
    ),
}

# Codes.


def _soft(call):
    z = naive._scores(call.projection, call.sigma, call.operator)[: call.operator.n_filters]
    return z, call.operator.threshold


SOFT_CODE = {
    "above the threshold": lambda call: (_soft(call)[0] > _soft(call)[1]).any(),
    "below minus the threshold": lambda call: (_soft(call)[0] < -_soft(call)[1]).any(),
    "between them": lambda call: (np.abs(_soft(call)[0]) < _soft(call)[1]).any(),
    "padding": lambda call: call.operator.n_filters < len(call.code),
}


def _triangle(call):
    code = call.code.copy()
    naive.triangle_code(call.projection, call.sigma, call.square, call.operator, code)
    return code[: call.operator.n_filters]


TRIANGLE_CODE = {
    "nearer than the mean": lambda call: (_triangle(call) > 0).any(),
    "farther than the mean": lambda call: (_triangle(call) == 0).any() and len(_triangle(call)) > 1,
    "a single filter": lambda call: call.operator.n_filters == 1,
    "padding": lambda call: call.operator.n_filters < len(call.code),
}
MEAN_DISTANCE = {
    "rounded": lambda call: call.distances[: call.n_filters].sum(dtype=np.int64) % call.n_filters > 0,
    "a sum beyond 32 bits": lambda call: call.distances[: call.n_filters].sum(dtype=np.int64) > 2**31,
    "not all filters": lambda call: call.n_filters < len(call.distances),
}


def _square(call):
    return call.length - 2 * call.z / call.unit + call.square_norm


FIXED_DISTANCE = {
    "a square below zero": lambda call: _square(call) < -1e-3,
    "a square above zero": lambda call: _square(call) > 1e-3,
}
DEVIATION = {
    "a mean of zero": lambda call: call.moments[MOMENT_SUM] == 0,
    "a mean that is not zero": lambda call: call.moments[MOMENT_SUM] != 0,
    "all entries alike": lambda call: (
        call.moments[MOMENT_SUM] ** 2 == call.entries * call.moments[MOMENT_SQUARES]
    ),
}
WHITENED_SQUARE = {
    "below zero": lambda call: call.result == 0,
    "inside": lambda call: 0 < call.result < call.operator.reach**2,
    "beyond reach": lambda call: call.result == call.operator.reach**2,
}
POOL = {
    f"{sign_name}, {kind_name}": lambda call, sign=sign, is_split=is_split: (
        call.sign == sign and (call.kind == SPLIT) == is_split and call.code.min() < 0 < call.code.max()
    )
    for sign_name, sign in (("added", 1), ("taken", -1))
    for kind_name, is_split in (("split", True), ("not split", False))
}

# The lasso.


def _subset(call):
    """How the chosen atoms lie among all."""
    return len(call.chosen), len(call.gram)


LASSO = {
    "duality_gap": {
        "the residual is feasible": lambda call: np.abs(call.residual).max() <= call.penalty,
        "it has to be shrunk": lambda call: np.abs(call.residual).max() > call.penalty,
        "no atom in use": lambda call: not call.atoms.any(),
        "a square that rounding has made too small": lambda call: (
            call.square - call.right @ call.atoms - call.residual @ call.atoms < 0
        ),
    },
    "select_atoms": {
        "in use, though its correlation is small": lambda call: (
            (call.atoms != 0) & (np.abs(call.right - call.response) <= call.least)
        ).any(),
        "not in use, and its correlation is large": lambda call: (
            (call.atoms == 0) & (np.abs(call.right - call.response) > call.least)
        ).any(),
        "left out": lambda call: call.result < len(call.right),
        "none": lambda call: call.result == 0,
        "all": lambda call: call.result == len(call.right),
    },
    "copy_corner": {
        "no atom": lambda call: _subset(call)[0] == 0,
        "some atoms": lambda call: 0 < _subset(call)[0] < _subset(call)[1],
        "all atoms": lambda call: _subset(call)[0] == _subset(call)[1],
        "atoms with others between": lambda call: bool((np.diff(call.chosen) > 1).any()),
    },
    "descend": {
        "an atom of length zero": lambda call: (np.diag(call.corner) == 0).any(),
        "an atom leaves": lambda call: ((call.atoms != 0) & (_descended(call) == 0)).any(),
        "an atom enters": lambda call: ((call.atoms == 0) & (_descended(call) != 0)).any(),
        "an atom changes its sign": lambda call: (call.atoms * _descended(call) < 0).any(),
        "an atom stays at zero": lambda call: ((call.atoms == 0) & (_descended(call) == 0)).any(),
    },
    "extrapolate": {
        "uphill": lambda call: call.before.any() and (_extrapolated(call) == call.atoms).all(),
        "to the least objective": lambda call: (_extrapolated(call) != call.atoms).any(),
        "an atom is used up": lambda call: ((call.atoms != 0) & (_extrapolated(call) == 0)).any(),
        "without an end": lambda call: not call.corner.any() and (_extrapolated(call) == call.atoms).all(),
    },
    "add_rows": {
        "no row": lambda call: len(call.moved) == 0,
        "fewer than four": lambda call: 0 < len(call.moved) < 4,
        "fours alone": lambda call: len(call.moved) > 0 and len(call.moved) % 4 == 0,
        "fours and a rest": lambda call: len(call.moved) > 4 and len(call.moved) % 4 > 0,
    },
    "respond": {
        "no atom in use": lambda call: not call.kept[0].any(),
        "some in use": lambda call: call.kept[0].any() and not call.kept[0].all(),
    },
    "solve_lasso": {
        "the solution is zero": lambda call: np.abs(call.right).max() <= call.penalty,
        "it is not": lambda call: np.abs(call.right).max() > call.penalty,
        "it starts from the solution": lambda call: _gap_of(call, call.kept[0]) <= call.gap,
        "it starts from zero": lambda call: not call.kept[0].any(),
        "it starts from another code": lambda call: call.kept[0].any() and _gap_of(call, call.kept[0]) > 0.1,
    },
    "solve_lasso_rows": {
        "one row": lambda call: len(call.right) == 1,
        "several rows": lambda call: len(call.right) > 1,
    },
    "lasso_code": {
        "one atom": lambda call: call.operator.n_filters == 1,
        "padding": lambda call: call.operator.n_filters < len(call.projection),
        "no padding": lambda call: call.operator.n_filters == len(call.projection),
    },
    "fix_atoms": {
        "within the bound": lambda call: (np.abs(call.atoms) < _bound(call.operator)).all(),
        "clipped from above": lambda call: (call.atoms > _bound(call.operator)).any(),
        "clipped from below": lambda call: (call.atoms < -_bound(call.operator)).any(),
        "padding": lambda call: len(call.atoms) < len(call.code),
    },
}


def _descended(call):
    atoms = call.atoms.copy()
    naive.descend(call.penalty, call.corner, atoms, call.residual.copy())
    return atoms


def _extrapolated(call):
    atoms = call.atoms.copy()
    naive.extrapolate(call.penalty, call.corner, call.before.copy(), atoms, call.residual.copy())
    return atoms


def _gap_of(call, atoms):
    residual = call.right - call.gram.astype(np.float64) @ atoms
    return naive.duality_gap(residual, call.right, atoms, call.square, call.penalty) / (call.square / 2)


def _bound(operator):
    """No atom of a solution exceeds it."""
    return operator.reach**2 / (2 * operator.threshold / operator.unit)


# Volumes and planes.


def _is_of(operator, kind):
    return not operator.inverse and operator.kind == kind


ENCODE_VOLUME = {
    "empty, and its lasso code is forgotten": lambda call: (
        call.moments[MOMENT_SQUARES] == 0 and call.fresh and call.atoms.any()
    ),
    "empty, and taken away": lambda call: call.moments[MOMENT_SQUARES] == 0 and not call.fresh,
    "a lasso code shown again": lambda call: (
        call.operator.inverse and call.moments[MOMENT_SQUARES] > 0 and not call.fresh
    ),
} | {
    name: lambda call, kind=kind: call.moments[MOMENT_SQUARES] > 0 and _is_of(call.operator, kind)
    for name, kind in (("soft", SOFT), ("split", SPLIT), ("triangle", TRIANGLE))
}

READ_FEATURES = {
    "split": lambda call: call.operator.kind == SPLIT,
    "not split": lambda call: call.operator.kind != SPLIT,
    "padding": lambda call: call.operator.n_filters < len(call.operator.offset),
    "one cell": lambda call: call.state.pooled.shape[1] == 1,
    "many cells": lambda call: call.state.pooled.shape[1] > 4,
    "the other plane is current": lambda call: call.state.clock[CLOCK_PLANE] == 1,
}

READ_CELL = {name: READ_FEATURES[name] for name in READ_FEATURES if name != "one cell"} | {
    "the last cell": lambda call: 0 < call.cell == call.state.pooled.shape[1] - 1,
}

SCORE_PARTS = {
    "no feature at all": lambda call: not call.sums[:, -1].any(),
    "features": lambda call: call.sums[:, -1].any(),
    "no class": lambda call: len(call.bias) == 0,
}


def _cells_marked(call):
    found = np.zeros_like(call.is_stale)
    naive.mark_cells(call.x, call.y, call.operator, call.state, found)
    return int(found.sum())


MARK_CELLS = {
    "no volume covers it": lambda call: _cells_marked(call) == 0,
    "volumes of one cell": lambda call: _cells_marked(call) == 1 and len(call.is_stale) > 1,
    "volumes of two cells": lambda call: _cells_marked(call) == 2,
    "volumes of cells above, below and beside": lambda call: _cells_marked(call) >= 4,
}


def _shared_part(call):
    """Whether a part that is summed holds features of a cell that is not stale."""
    n, cells = len(call.reading.features), len(call.reading.is_stale)
    stale = {naive.part_of(i, n) for i in range(n) if call.reading.is_stale[i * cells // n]}
    fresh = {naive.part_of(i, n) for i in range(n) if not call.reading.is_stale[i * cells // n]}
    return bool(stale & fresh)


READ_STALE = {
    "nothing": lambda call: not call.reading.is_stale.any() and not call.reading.parts.any(),
    "a part that was asked for": lambda call: not call.reading.is_stale.any() and call.reading.parts.any(),
    "everything": lambda call: call.reading.is_stale.all() and len(call.reading.is_stale) > 1,
    "some cells": lambda call: 0 < call.reading.is_stale.sum() < len(call.reading.is_stale),
    "a part of two cells": _shared_part,
    "no class": lambda call: call.weights.rows.shape[1] == 0,
    "classes": lambda call: call.weights.rows.shape[1] > 1,
}


def _trace_steps(call):
    """Each event, with what it is one of."""
    state = type(call.state)(*(field.copy() for field in call.state))
    for i, event in enumerate(call.events.tolist()):
        before, now = state.tally.copy(), int(state.clock[CLOCK_NOW])
        naive.follow_event(*event, call.operator, state)
        moved = int(state.clock[CLOCK_NOW]) != now
        _, late, rejected, saturated, _ = (state.tally - before).tolist()
        yield SimpleNamespace(
            i=i, moved=moved, quiet=not moved and i > 0, late=late, rejected=rejected, saturated=saturated
        )


TRACE = {
    "a new bin": lambda step: step.moved and step.i > 0,
    "an event that changes a count": lambda s: s.quiet and not (s.late or s.rejected or s.saturated),
    "an event that saturates": lambda s: s.quiet and s.saturated,
    "a late event": lambda s: s.quiet and s.late,
    "an event outside": lambda s: s.quiet and s.rejected,
}


def _news(call):
    """`(plane, volume, entry)` for each touched entry that changed and each volume that covers it.

    Volumes are compared with every place by brute force; `entry` is None where a plane has lost the bin.
    """
    state, operator = call.state, call.operator
    rows, columns = getattr(call, "shape", None) or operator.shape
    n_bins, limit, patch = _bins(call), operator.max_count, operator.patch
    for flat in state.touched[: state.clock[CLOCK_TOUCHED]]:
        slot, row, column = np.unravel_index(int(flat), state.counts.shape)
        if np.clip(state.counts[slot, row, column], -limit, limit) == state.applied[slot, row, column]:
            continue
        position = next(i for i in range(n_bins) if naive.slot_of(i, state) == slot)
        for plane in range(len(state.cursors)):
            there = position - int(plane != state.clock[CLOCK_PLANE])
            for volume in range(rows * columns):
                top, left = (index * operator.stride for index in divmod(volume, columns))
                if top <= row < top + patch[0] and left <= column < left + patch[1]:
                    entry = (there * patch[0] + row - top) * patch[1] + column - left
                    yield plane, volume, int(entry) if there >= 0 else None


def _news_of_volumes(call):
    """Entries that changed, by `(plane, volume)`, with the cursors of the plane."""
    found = {}
    for plane, volume, entry in _news(call):
        if entry is not None:
            found.setdefault((plane, volume), []).append(entry)
    for (plane, volume), entries in found.items():
        cursors = call.state.cursors[plane]
        yield plane, volume, entries, int(cursors[CURSOR_PROJECTED]), int(cursors[CURSOR_ENTRY])


def _any_news(holds):
    return lambda call: any(holds(*news) for news in _news_of_volumes(call))


def _came_back(call):
    state, limit = call.state, call.operator.max_count
    places = state.touched[: state.clock[CLOCK_TOUCHED]]
    clipped = state.counts.reshape(-1)[places].clip(-limit, limit)
    return (clipped == state.applied.reshape(-1)[places]).any()


def _n_changed(call):
    limit = call.operator.max_count
    return int((call.state.counts.clip(-limit, limit) != call.state.applied).sum())


MARK_DIRTY = {
    "nothing changed": lambda call: _n_changed(call) == 0,
    "an entry that came back": _came_back,
    "an entry that no volume covers": lambda call: _n_changed(call) > 0 and not list(_news(call)),
    "a bin that the plane ahead has lost": lambda call: any(entry is None for *_, entry in _news(call)),
    "a volume with its whole projection": _any_news(lambda plane, volume, entries, last, end: volume < last),
    "a volume without projection": _any_news(lambda plane, volume, entries, last, end: volume > last),
    "the partly projected volume, inside its part": _any_news(
        lambda plane, volume, entries, last, end: volume == last and 0 < max(entries) < end
    ),
    "the partly projected volume, beyond its part": _any_news(
        lambda plane, volume, entries, last, end: volume == last and 0 < end <= min(entries)
    ),
    "the partly projected volume, on both sides": _any_news(
        lambda plane, volume, entries, last, end: volume == last and min(entries) < end <= max(entries)
    ),
    "several entries of one volume": _any_news(lambda plane, volume, entries, last, end: len(entries) > 1),
    "both planes": lambda call: len({plane for plane, *_ in _news_of_volumes(call)}) == 2,
    "a plane with projections and no codes": lambda call: any(
        call.state.cursors[plane, CURSOR_CODED] <= volume < last
        for plane, volume, _, last, _ in _news_of_volumes(call)
    ),
}

# Volumes that enter planes, and planes that are filled.


def _n_volumes(state):
    return len(state.cells)


def _shares_rows(call):
    return call.state.projections.shape[1] == 1


def _row_of(call):
    """The moments of a call's volume."""
    row = getattr(call, "row", call.volume)
    return call.state.moments[call.plane, min(int(row), call.state.projections.shape[1] - 1)]


def _is_empty(call):
    return _row_of(call)[MOMENT_SQUARES] == 0


def _has_form(call):
    return call.operator.quadratic.size > 0


def _is_ahead(call):
    return call.plane != call.state.clock[CLOCK_PLANE]


def _cursors(call):
    return call.state.cursors[call.plane].tolist()


def _current(call):
    return call.state.cursors[call.state.clock[CLOCK_PLANE]].tolist()


def _coming(call):
    return call.state.cursors[1 - call.state.clock[CLOCK_PLANE]].tolist()


def _has_two(call):
    return len(call.state.cursors) == 2


FORMS = {"with a quadratic form": _has_form, "without one": lambda call: not _has_form(call)}
ENCODINGS = {
    name: lambda call, kind=kind: call.operator.kind == kind and not call.operator.inverse
    for name, kind in (("soft", SOFT), ("split", SPLIT), ("triangle", TRIANGLE))
}

POOL_VOLUME = ENCODINGS | {
    "added": lambda call: call.sign > 0 and not _is_empty(call),
    "taken": lambda call: call.sign < 0 and not _is_empty(call),
    "empty": _is_empty,
    "of the plane ahead": _is_ahead,
}
ENTER_CODE = ENCODINGS | {
    "empty": lambda call: not call.result,
    "not empty": lambda call: call.result,
    "volumes share a row": _shares_rows,
    "of the plane ahead": _is_ahead,
}
PROJECT_VOLUME = FORMS | {
    "from the first entry, over what the row held": lambda call: call.start == 0 and not _is_empty(call),
    "from the middle": lambda call: call.start > 0,
    "ends at the most that was asked": lambda call: (
        call.result[0] == call.most
        and call.result[1] < (_bins(call) - call.ahead) * math.prod(call.operator.patch)
    ),
    "ends with the volume": lambda call: (
        call.result[1] == (_bins(call) - call.ahead) * math.prod(call.operator.patch)
    ),
    "nothing to let in": lambda call: call.result[0] == 0,
    "ahead": lambda call: call.ahead == 1,
    "volumes share a row": _shares_rows,
}
LET_IN = {
    "waits": lambda call: call.result[1] > call.waiting,
    "projected by columns": lambda call: call.result == (call.result[0], call.waiting) and call.result[0] > 0,
    "an empty volume over one that was not": lambda call: call.result[0] == 0,
    "ahead": lambda call: call.ahead == 1,
    "waits, ahead": lambda call: call.ahead == 1 and call.result[1] > call.waiting,
}
MULTIPLY = {
    "nothing": lambda call: call.waiting == 0,
    "whole tiles": lambda call: call.waiting > 0 and call.waiting % 6 == 0,
    "a tile worth filling up": lambda call: call.waiting % 6 in (4, 5),
    "some by columns": lambda call: call.waiting % 6 in (1, 2, 3),
    "of the plane ahead": lambda call: call.plane != call.state.clock[CLOCK_PLANE],
    "an odd number of entries": lambda call: len(call.operator.columns) % 2 == 1,
    "several blocks of filters": lambda call: call.operator.columns.shape[1] > 32,
}
FIRST_WITH_LOAD = {
    "of none": lambda call: call.n == 0,
    "the first": lambda call: call.n > 0 and call.result == 0,
    "one in the middle": lambda call: 0 < call.result < call.n,
    "no volume has so much before it": lambda call: 0 < call.n == call.result,
}
SHARE_OF_LOAD = {
    "nothing": lambda call: call.state.clock[CLOCK_DIRTY] == 0,
    "all of it": lambda call: call.parts == 1 and call.state.clock[CLOCK_DIRTY] > 0,
    "a part": lambda call: call.parts > 1 and call.result[1] > call.result[0],
    "not where equally many volumes would be cut": lambda call: (
        call.result != naive.share_of(call.part, call.parts, call.state)
    ),
}
COMPLETE = {
    "the upper part": lambda call: call.part == 0,
    "the lower part": lambda call: call.part == 1,
    "nothing is missing": lambda call: _current(call)[CURSOR_CODED] >= _n_volumes(call.state),
    "everything is missing": lambda call: _current(call)[CURSOR_PROJECTED] == 0,
    "a volume that is projected and has no code": lambda call: (
        _current(call)[CURSOR_CODED] < _current(call)[CURSOR_PROJECTED]
    ),
    "a volume that is projected in part": lambda call: _current(call)[CURSOR_ENTRY] > 0,
    "volumes share a row": _shares_rows,
}
LOOK_AHEAD = {
    "one plane": lambda call: not _has_two(call),
    "the current plane is not complete": lambda call: (
        _has_two(call) and _current(call)[CURSOR_CODED] < _n_volumes(call.state)
    ),
    "no budget": lambda call: call.budget <= 0,
    "the budget is spent": lambda call: call.budget > 0 >= call.result,
    "the goals are reached": lambda call: call.result > 0 and _has_two(call),
    "goes on in the middle of a volume": lambda call: (
        _has_two(call) and call.budget > 0 and _coming(call)[CURSOR_ENTRY] > 0
    ),
    "more codes than projections are asked for": lambda call: _has_two(call) and call.coded > call.projected,
    "all are projected already": lambda call: (
        _has_two(call) and _coming(call)[CURSOR_PROJECTED] == _n_volumes(call.state)
    ),
}

# One entry that changes, and volumes that changed.


def _after(call):
    return np.clip(
        call.state.counts[naive.slot_of(call.position, call.state), call.row, call.column],
        -call.operator.max_count,
        call.operator.max_count,
    )


def _covering(call):
    """Volumes over the entry of a call, and the entry of each in the plane that looks ahead."""
    state, operator = call.state, call.operator
    columns = (getattr(call, "shape", None) or operator.shape)[1]
    patch, stride = operator.patch, operator.stride
    for volume in range(len(state.cells)):
        row, column = call.row - volume // columns * stride, call.column - volume % columns * stride
        if 0 <= row < patch[0] and 0 <= column < patch[1]:
            yield volume, ((call.position - 1) * patch[0] + row) * patch[1] + column


def _partly_ahead(holds):
    """Whether it holds of an entry in the volume that is projected in part ahead, and of where that ends."""
    return lambda call: (
        _has_two(call)
        and any(
            volume == _coming(call)[CURSOR_PROJECTED]
            and call.position > 0
            and holds(entry, _coming(call)[CURSOR_ENTRY])
            for volume, entry in _covering(call)
        )
    )


CHANGE_PLACE = FORMS | {
    "no volume covers it": lambda call: not list(_covering(call)),
    "several volumes cover it": lambda call: len(list(_covering(call))) > 1,
    "in the oldest bin, which the plane ahead has lost": lambda call: _has_two(call) and call.position == 0,
    "inside what is projected ahead of a volume": _partly_ahead(lambda entry, end: entry < end),
    "beyond what is projected ahead of a volume": _partly_ahead(lambda entry, end: 0 < end <= entry),
    "a count becomes zero": lambda call: _after(call) == 0,
    "a count becomes the largest": lambda call: abs(_after(call)) == call.operator.max_count,
}
CHANGE_VOLUME = FORMS | {
    "with a code": lambda call: call.volume < _cursors(call)[CURSOR_CODED],
    "empty before": _is_empty,
    "not empty before": lambda call: not _is_empty(call),
    "of the plane ahead": _is_ahead,
}
MOVE_VOLUME = ENCODINGS | {"of the plane ahead": _is_ahead}
MOVE_CODE = {
    f"{name}, {kind_name}": lambda call, sign=sign, kind=kind: call.change == sign and call.kind == kind
    for name, sign in (("up", 1), ("down", -1))
    for kind_name, kind in (("soft", SOFT), ("split", SPLIT))
}


def _dirty(holds):
    """Whether it holds of a dirty volume: `(volume, is ahead, cursors of its plane)`."""

    def any_holds(call):
        n, state = _n_volumes(call.state), call.state
        found = [divmod(int(index), n) for index in state.dirty[: state.clock[CLOCK_DIRTY]]]
        return any(
            holds(volume, plane != state.clock[CLOCK_PLANE], state.cursors[plane].tolist())
            for plane, volume in found
        )

    return any_holds


RENEW = FORMS | {
    "nothing is dirty": lambda call: call.state.clock[CLOCK_DIRTY] == 0,
    "a volume with a code": _dirty(lambda volume, ahead, cursors: volume < cursors[CURSOR_CODED]),
    "a volume without a code": _dirty(
        lambda volume, ahead, cursors: cursors[CURSOR_CODED] <= volume < cursors[CURSOR_PROJECTED]
    ),
    "a volume that is projected in part": _dirty(
        lambda volume, ahead, cursors: volume == cursors[CURSOR_PROJECTED]
    ),
    "a volume of the plane ahead": _dirty(lambda volume, ahead, cursors: ahead),
    "the upper part": lambda call: call.part == 0,
    "the lower part": lambda call: call.part == 1,
}
FOLLOW_EVENT = {
    name: COUNT_EVENT[name]
    for name in (
        "outside, by its column",
        "a polarity above",
        "in the current bin",
        "in the next bin",
        "far too late",
    )
} | {
    "one plane": lambda call: not _has_two(call),
    "two planes": _has_two,
}

# Lists of entries.


def _line(call):
    return math.prod(call.patch)


GATHER_VOLUME = {
    "the ring wraps": lambda call: call.first_slot > 0,
    "the ring does not": lambda call: call.first_slot == 0,
    "all entries": lambda call: call.end == len(call.values),
    "none": lambda call: call.end == 0,
    "a patch wider than it is tall": lambda call: call.patch[0] < call.patch[1] and call.start < call.end,
    "a patch taller than it is wide": lambda call: call.patch[0] > call.patch[1] and call.start < call.end,
    "an end within a bin": lambda call: call.end % _line(call) > 0,
    "lines that are copied entry by entry": lambda call: call.patch[1] < 8 and call.start < call.end,
    "lines of vectors that overlap": lambda call: call.patch[1] > 8 and call.start < call.end,
    "an end between bins": lambda call: 0 < call.end < len(call.values) and call.end % _line(call) == 0,
}

# Pixels of a simulated camera.


FIRE_PIXELS = {
    "nothing fires": lambda call: call.result[1] == 0 and call.result[0] == len(call.before),
    "some fire": lambda call: call.result[1] > 0,
    "there is no room for one": lambda call: call.result[0] < len(call.before),
    "there is no room after some": lambda call: call.result[1] > 0 and call.result[0] < len(call.before),
    "a reset that ends between the frames": lambda call: (
        (call.release > call.start) & (call.release < call.end)
    ).any(),
    "a reset that ends with the frame": lambda call: (call.release == call.end).any(),
    "a reset that goes on": lambda call: (call.release > call.end).any(),
    "light that stays": lambda call: (call.before == call.after).any(),
    "light that rises and light that falls": lambda call: (
        (call.before < call.after).any() and (call.before > call.after).any()
    ),
    "more events than pixels": lambda call: call.result[1] > len(call.before),
    "not from the first pixel on": lambda call: call.pixel > 0,
}

# Spiking neurons. The calls' counts are those of before: the events decide.


def _reaches(call, holds):
    radius = call.weights.shape[0] // 2
    return any(holds(x - radius, x + radius, call.potential.shape[2]) for x in call.x.tolist())


SPIKING = {
    "no event": lambda call: len(call.t) == 0,
    "two events of one pixel": lambda call: len(set(zip(call.x, call.y, call.p, strict=True))) < len(call.t),
    "a filter of one pixel": lambda call: call.weights.shape[0] == 1 and len(call.t) > 0,
    "neurons beyond the sensor": lambda call: _reaches(call, lambda first, last, width: last >= width),
    "neurons before it": lambda call: _reaches(call, lambda first, last, width: first < 0),
    "a neuron that spikes at once": lambda call: (
        len(call.t) > 0 and call.weights.max() > call.threshold
        if hasattr(call, "threshold")
        else len(call.t) > 0 and call.weights.max() > call.limits[0]
    ),
}
FIRST = {
    "without a leak": lambda call: call.limits[1] == 0 and len(call.t) > 0,
    "potentials of both signs that leak": lambda call: (
        call.limits[1] > 0 and (call.potential > 0).any() and (call.potential < 0).any() and len(call.t) > 0
    ),
    "no refractory time of S1": lambda call: call.limits[2] == 0 and len(call.t) > 1,
    "no refractory time of C1": lambda call: call.limits[3] == 0 and len(call.t) > 1,
    "a second event in the refractory time": lambda call: (
        call.limits[2] > 0 and len(call.t) > 1 and np.diff(call.t).min() <= call.limits[2]
    ),
}
LEAKY = {
    "no refractory time": lambda call: call.dead == 0 and len(call.t) > 1,
    "a second event in the refractory time": lambda call: (
        call.dead > 0 and len(call.t) > 1 and np.diff(call.t).min() < call.dead
    ),
}

# Time surfaces.


def _neighbours(call, radius, holds):
    """Whether it holds for an event and one place around it: `(x, y, dx, dy)`."""
    offsets = range(-radius, radius + 1)
    events = set(zip(call.x.tolist(), call.y.tolist(), strict=True))
    return any(holds(x, y, dx, dy) for x, y in events for dy in offsets for dx in offsets)


def _around(holds):
    return lambda call: _neighbours(
        call, call.sums.shape[3] // 2, lambda x, y, dx, dy: holds(call, x, y, x + dx, y + dy)
    )


MEMORY_SURFACES = {
    "no event": lambda call: len(call.t) == 0,
    "two events of one pixel": lambda call: len(set(zip(call.x, call.y, call.p, strict=True))) < len(call.t),
    "no radius": lambda call: call.sums.shape[3] == 1,
    "a neighbour in another cell": _around(
        lambda call, x, y, i, j: (x // call.cell, y // call.cell) != (i // call.cell, j // call.cell)
    ),
    "beyond the sensor, in a cell that it cuts": _around(
        lambda call, x, y, i, j: i >= call.memory.shape[2] and i // call.cell == x // call.cell
    ),
}
TIME_SURFACES = {
    "no event": lambda call: len(call.t) == 0,
    "no radius": lambda call: call.out.shape[2] == 1,
    "polarities of a layer": lambda call: len(call.p) > 0 and call.p.max() > 1,
    "a pixel that was never seen": lambda call: call.out.size > 0 and call.latest.shape[1] > len(call.t),
    "two events of one pixel": lambda call: len(set(zip(call.x, call.y, call.p, strict=True))) < len(call.t),
}
DESCRIBE_EVENTS = {
    "no event": lambda call: len(call.x) == 0,
    "an event is forgotten": lambda call: len(call.x) > 0 and call.queue.min() >= 0,
    "nothing is forgotten": lambda call: len(call.x) > 0 and call.queue.min() < 0,
    "nothing lies around an event": lambda call: len(call.x) > 0 and call.out.sum(axis=1).min() == 0,
    "a place of the grid for no offset": lambda call: call.places.max() + 1 < call.out.shape[1],
}

ROWS = {
    "no row": lambda call: call.result == 0,
    "rows": lambda call: call.result > 1,
    "blanks separate": lambda call: call.separator == 0 and call.result > 0,
    "points": lambda call: call.result > 0 and b"." in bytes(call.text),
    "signs": lambda call: call.result > 0 and b"-" in bytes(call.text),
    "an empty line": lambda call: call.result > 0 and b"\n  \n" in bytes(call.text),
    "no end of the last line": lambda call: call.result > 0 and not bytes(call.text).endswith(b"\n"),
    "no number": lambda call: call.result < 0 and b"x" in bytes(call.text),
    "an exponent": lambda call: call.result < 0 and b"e" in bytes(call.text),
    "19 digits": lambda call: call.result < 0 and b"1234567890123456789" in bytes(call.text),
    "more than a float holds": lambda call: call.result < 0 and b"0.123456789012345678" in bytes(call.text),
    "more rows than room": lambda call: (
        call.result < 0 and bytes(call.text).count(b"\n") >= call.digits.shape[1]
    ),
}

NO_EVENT = {"no event": lambda call: len(call.events) == 0}


def _coded(call):
    return call.state.cursors[call.plane, CURSOR_CODED]


FOLLOW_CHANGES = {
    "its code moves": lambda call: (
        not call.operator.inverse
        and call.volume < _coded(call)
        and call.state.moments[call.plane, call.volume, MOMENT_SQUARES] > 0
    ),
    "it was empty": lambda call: call.state.moments[call.plane, call.volume, MOMENT_SQUARES] == 0,
    "it becomes empty": lambda call: (
        call.n == np.count_nonzero(call.state.values[call.part, 0])
        and call.n > 0
        and (
            call.state.values[call.part, 0, call.state.entries[call.part, : call.n]]
            == -call.state.changes[call.part, : call.n]
        ).all()
    ),
}

NARROW_GAIN = {
    "a shift": lambda call: call.result % 2**16 > 0,
    "no shift": lambda call: call.result % 2**16 == 0 and call.result >> 16 >= 2**14,
    "less than a quarter": lambda call: call.result >> 16 < 2**14,
}

MOVE_QUEUED = {
    "no volume waits": lambda call: call.state.queued[call.part, 0] == 0,
    "sums of columns": lambda call: (
        call.state.queued[call.part, 0] > 0 and call.state.queued[call.part, 3] == 0
    ),
    "columns that are added": lambda call: (
        call.state.queued[call.part, 0] > 0 < call.state.queued[call.part, 3]
    ),
    "columns that are subtracted": lambda call: call.state.queued[call.part, 3] < 0,
    "several volumes": lambda call: call.state.queued[call.part, 0] > 1,
    "of another part": lambda call: call.state.queued[call.part, 0] > 0 < call.part,
}

QUEUE_VOLUME = {
    "no volume waits": lambda call: call.state.queued[call.part, 0] == 0,
    "those of another cell wait": lambda call: (
        call.state.queued[call.part, 0] > 0
        and call.state.queued[call.part, 2] != call.state.cells[call.volume]
    ),
    "those of its cell wait": lambda call: (
        call.state.queued[call.part, 0] > 0
        and call.state.queued[call.part, 2] == call.state.cells[call.volume]
    ),
    "for other columns": lambda call: (
        call.n == 1
        and call.state.queued[call.part, 0] > 0
        and call.state.queued[call.part, 3] != call.state.changes[call.part, 0]
    ),
    "one column": lambda call: call.n == 1 and abs(call.state.changes[call.part, 0]) == 1,
    "several": lambda call: call.n > 1,
}


def _states(more=None):
    return {
        "narrow": lambda call: call.operator.steps is not None,
        "wide": lambda call: call.operator.steps is None,
        **(more or {}),
    }


LIST_MISSING = {
    "nothing is missing": lambda call: _current(call)[CURSOR_CODED] >= _n_volumes(call.state),
    "all are missing": lambda call: _current(call)[CURSOR_CODED] == 0,
    "some are there": lambda call: 0 < _current(call)[CURSOR_CODED] < _n_volumes(call.state),
    "every one, for the inverse": lambda call: call.operator.inverse,
    "no event at all": lambda call: not call.state.applied.any(),
}

LIST_ENTRIES = {
    "nothing": lambda call: call.start >= call.end,
    "all are zero": lambda call: call.start < call.end and not call.values[call.start : call.end].any(),
    "none is zero": lambda call: call.start < call.end and call.values[call.start : call.end].all(),
    "entries before the first": lambda call: call.values[: call.start].any(),
    "entries behind the last": lambda call: call.values[call.end :].any(),
}

TOUCHED_BINS = {
    "nothing changed": lambda call: not call.state.touched_slots.any(),
    "one bin of several": lambda call: np.count_nonzero(call.state.touched_slots) == 1 and _bins(call) > 1,
    "all bins": lambda call: call.state.touched_slots.all(),
}

POOL_SOFT = {
    "soft": lambda call: call.kind == SOFT,
    "split": lambda call: call.kind == SPLIT,
    "added": lambda call: call.sign > 0,
    "taken": lambda call: call.sign < 0,
}

SUM_COLUMNS = {
    "no column": lambda call: call.n == 0,
    "an even number": lambda call: call.n > 0 and call.n % 2 == 0,
    "an odd number": lambda call: call.n % 2 == 1,
}

CASES = {
    "follow_changes": FOLLOW_CHANGES,
    "narrow_gain": NARROW_GAIN,
    "move_queued": MOVE_QUEUED,
    "queue_volume": QUEUE_VOLUME,
    "follow_rest": _states(),
    "enter_atoms": _states({"inverse": lambda call: call.operator.inverse}),
    "write_code": _states({"inverse": lambda call: call.operator.inverse}),
    "pool_row_of": _states(
        {
            "empty": lambda call: not call.state.moments[call.plane, call.row, MOMENT_SQUARES],
            "triangle": lambda call: call.operator.kind == TRIANGLE,
        }
    ),
    "write_features": _states(
        {
            "soft": lambda call: call.operator.kind == SOFT,
            "split": lambda call: call.operator.kind == SPLIT,
        }
    ),
    "list_missing": LIST_MISSING,
    "list_entries": LIST_ENTRIES,
    "touched_bins": TOUCHED_BINS,
    "pool_soft": POOL_SOFT,
    "sum_columns": SUM_COLUMNS,
    "decode_evt3": {"no word": lambda call: len(call.words) == 0},
    "decode_libcaer_cmp": LIBCAER_CMP,
    "decode_mono": MONO,
    "decode_libcaer": LIBCAER,
    "place_events": PLACE_EVENTS,
    "turns_between": TURNS_BETWEEN,
    "decode_evt2": {"no word": lambda call: len(call.words) == 0},
    "decode_dat": {"no record": lambda call: len(call.records) == 0},
    "decode_event_stream": EVENT_STREAM,
    "decode_ecf": ECF,
    "decode_groups": GROUPS,
    "time_span": TIME_SPAN,
    "mark_noise": NO_EVENT,
    "parse_rows": ROWS,
    "advance_to_bin": ADVANCE,
    "count_event": COUNT_EVENT,
    "bin_length": BIN_LENGTH,
    "slot_of": SLOT_OF,
    "deviation": DEVIATION,
    "whitened_square": WHITENED_SQUARE,
    "soft_code": SOFT_CODE,
    "triangle_code": TRIANGLE_CODE,
    "mean_distance": MEAN_DISTANCE,
    "fixed_distance": FIXED_DISTANCE,
    "pool": POOL,
    **LASSO,
    "encode_volume": ENCODE_VOLUME,
    "read_cell": READ_CELL,
    "read_features": READ_FEATURES,
    "score_parts": SCORE_PARTS,
    "mark_cells": MARK_CELLS,
    "read_stale": READ_STALE,
    "trace": {
        "no event": lambda call: len(call.events) == 0,
        "features are not wanted": lambda call: len(call.events) > 0 and len(call.features) == 0,
        "no class": lambda call: call.weights.rows.shape[1] == 0,
        "a class": lambda call: call.weights.rows.shape[1] > 0,
    },
    "mark_dirty": MARK_DIRTY,
    "pool_volume": POOL_VOLUME,
    "enter_code": ENTER_CODE,
    "project_volume": PROJECT_VOLUME,
    "let_in": LET_IN,
    "multiply": MULTIPLY,
    "first_with_load": FIRST_WITH_LOAD,
    "share_of_load": SHARE_OF_LOAD,
    "complete": COMPLETE,
    "look_ahead": LOOK_AHEAD,
    "change_place": CHANGE_PLACE,
    "change_volume": CHANGE_VOLUME,
    "move_volume": MOVE_VOLUME,
    "move_code": MOVE_CODE,
    "change_moments": FORMS,
    "renew": RENEW | _states(),
    "follow_event": FOLLOW_EVENT,
    "gather_volume": GATHER_VOLUME,
    "fire_pixels": FIRE_PIXELS,
    "describe_events": DESCRIBE_EVENTS,
    "spike_first": SPIKING | FIRST,
    "spike_leaky": SPIKING | LEAKY,
    "add_memory_surfaces": MEMORY_SURFACES,
    "time_surfaces": TIME_SURFACES,
}
"""By kernel: the name of each case, and when a call is one."""

STEPS = {
    "decode_evt3": (_evt3_steps, EVT3),
    "decode_evt2": (_evt2_steps, EVT2),
    "decode_dat": (_dat_steps, DAT),
    "mark_noise": (_noise_steps, NOISE),
    "count_events": (_count_steps, COUNT_EVENTS),
    "trace": (_trace_steps, TRACE),
}
"""By kernel that goes step by step: the steps of a call, and the cases that one of them is."""
