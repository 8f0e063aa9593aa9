"""Slow, obvious twins of the compiled kernels: each `@njit` function has one of the same name here."""

import math
import re

import numpy as np

from streamfeat import events as events_module
from streamfeat.events import EVENT_DTYPE
from streamfeat.kernels.layout import (
    BEFORE_TIME,
    CLOCK_DIRTY,
    CLOCK_NOW,
    CLOCK_ORIGIN,
    CLOCK_PLANE,
    CLOCK_SLOT,
    CLOCK_START,
    CLOCK_TOUCHED,
    CURSOR_CODED,
    CURSOR_ENTRY,
    CURSOR_PROJECTED,
    MOMENT_LINEAR,
    MOMENT_QUADRATIC,
    MOMENT_SQUARES,
    MOMENT_SUM,
    SPLIT,
    TALLY_EVENTS,
    TALLY_LATE,
    TALLY_REJECTED,
    TALLY_ROLLS,
    TALLY_SATURATED,
    TRIANGLE,
)

# streamfeat.kernels.decode


def decode_evt3(words, state, out):
    time_high, time_low, y, base, polarity, seen = (int(v) for v in state)
    events = []
    for word in words.tolist():
        kind, value = word >> 12, word & 0xFFF
        address, top = value & 0x7FF, value >> 11
        time = time_high * 4096 + time_low
        if kind == 0x8:
            ahead = time_high - time_high % 4096 + value
            if ahead < time_high:
                ahead += 4096
            is_late_word = ahead - 4096 >= 0 and time_high - (ahead - 4096) < 2048 and ahead != time_high
            time_high = ahead - 4096 if is_late_word else ahead
            seen = max(seen, 1)
        elif seen >= 1 and kind == 0x6:
            time_low, seen = value, max(seen, 2)
        elif seen >= 2 and kind == 0x0:
            y, seen = address, max(seen, 3)
        elif seen >= 3 and kind == 0x2:
            events.append((address, y, top, time))
        elif seen >= 3 and kind == 0x3:
            base, polarity, seen = address, top, 4
        elif seen >= 4 and kind in (0x4, 0x5):
            width = {0x4: 12, 0x5: 8}[kind]
            for i, bit in enumerate(reversed(f"{value:012b}"[-width:])):
                if bit == "1":
                    events.append(((base + i) % 65536, y, polarity, time))
            base = (base + width) % 65536
    state[:] = time_high, time_low, y, base, polarity, seen
    return _write(events, out)


def decode_libcaer_cmp(words, base_us, state, out):
    x, base, polarity = (int(v) for v in state)
    time = np.zeros(2, int)  # high, low
    events = []
    for i, word in enumerate(words.tolist()):
        kind, value = word >> 12, word & 0xFFF
        address, top = value & 0x7FF, value >> 11
        now = base_us + int(time[0]) * 4096 + int(time[1])
        if kind > 5:
            return -1 - i
        if kind in (0, 1):
            time[kind] = value
        elif kind == 2:
            x = address
        elif kind == 3:
            events.append((x, address, top, now))
        elif kind == 4:
            base, polarity = address, top
        else:
            events += [(x, (base + i) % 65536, polarity, now) for i in range(8) if value >> i & 1]
            base = (base + 8) % 65536
    state[:] = x, base, polarity
    return _write(events, out)


def decode_mono(words, base_us, rest_ns, height, width, out, span):
    events = np.zeros(len(words), EVENT_DTYPE)
    for i, word in enumerate(words.tolist()):
        ns = rest_ns + word % 2**32
        events[i] = word // 2**32 % 2**16, word // 2**48 % 2**15, word // 2**63, base_us + ns // 1000
    out[:] = events.view(np.int64)
    return time_span(events, height, width, span)


def decode_libcaer(words, base_us, height, width, out, span):
    events = np.zeros(len(words), EVENT_DTYPE)
    before = 0
    for i, word in enumerate(words.tolist()):
        data, us = word % 2**32, word // 2**32 % 2**31
        if before - us > 2**30:
            base_us += 2**31
        before = us
        events[i] = data // 2**17, data // 4 % 2**15, data // 2 % 2, base_us + us
    out[:] = events.view(np.int64)
    return time_span(events, height, width, span)


def place_events(events, height, width, reached_us, latest, span):
    usable = events_module.is_valid(events, (height, width))
    now = reached_us
    for i, event in enumerate(events):
        now = max(now, int(event["t"])) if usable[i] else now
        latest[i] = now
    return time_span(events[usable], height, width, span)


def time_span(events, height, width, span):
    t = events["t"][(events["x"] < width) & (events["y"] < height)]
    if len(t):
        span[:] = t.min(), t.max()
    return len(t)


# streamfeat.kernels.file_codes


def turns_between(before, now, bits):
    if before < 0 or abs(now - before) <= 2**bits / 2:
        return 0
    return 1 if now < before else -1


def decode_evt2(words, state, out):
    high, turns = (int(v) for v in state)
    events = []
    for word in words.tolist():
        kind, rest = divmod(word, 2**28)
        if kind == 8:
            turns += turns_between(high, rest, 28)
            high = rest
        elif kind in (0, 1) and high != -1:
            time = (max(turns, 0) * 2**28 + high) * 64 + rest // 2**22
            events.append((rest // 2**11 % 2**11, rest % 2**11, kind, time))
    state[:] = high, turns
    return _write(events, out)


def decode_dat(records, state, out):
    before, turns = (int(v) for v in state)
    for i, (t, word) in enumerate(records.tolist()):
        turns += turns_between(before, t, 32)
        before = t
        out[i] = word % 2**14, word // 2**14 % 2**14, min(word // 2**28, 1), t + max(turns, 0) * 2**32
    state[:] = before, turns


def decode_event_stream(data, is_atis, state, out):
    t, crossings, _ = (int(v) for v in state)
    data, at, events = data.tolist(), 0, []
    bits = 6 if is_atis else 7
    top = 2**bits - 1
    while at < len(data):
        time, rest = divmod(data[at], 2 ** (8 - bits))
        if time == top:
            t += top * rest
            at += 1
            continue
        if len(data) - at < 5:
            break
        t += time
        address = data[at + 1] + 256 * data[at + 2], data[at + 3] + 256 * data[at + 4]
        if is_atis and rest % 2 == 1:
            crossings += 1
        else:
            events.append((*address, rest // 2 if is_atis else rest, t))
        at += 5
    state[:] = t, crossings, at
    return _write(events, out)


def decode_ecf(data, size, out):
    bytes_ = data.tolist()
    at, n = 12, len(out)
    t = int.from_bytes(bytes(bytes_[4:12]), "little", signed=True)
    times = []
    while len(times) < n:
        if at >= size:
            return -1 - at
        step, run = divmod(bytes_[at], 16)
        if step == 15:
            nibbles = []
            while bytes_[at] >= 0xF0 and len(nibbles) < 16:
                nibbles.append(bytes_[at] % 16)
                at += 1
            t += sum(nibble << 4 * k for k, nibble in enumerate(nibbles))
            continue
        t += step
        if run == 15:
            run = bytes_[at + 1] + 256 * bytes_[at + 2]
            at += 2
        if run > n - len(times):
            return -1 - at
        times += run * [(t + 2**63) % 2**64 - 2**63]
        at += 1
    out["t"] = times
    if bytes_[0] // 2 % 2:
        return decode_groups(data, size, at, 24, out)
    at = _ecf_runs(bytes_, size, at, 2, 5, out["y"])
    if at < 0 or bytes_[0] % 2:
        return at if at < 0 else decode_groups(data, size, at, 12, out)
    columns = []
    while len(columns) < n:
        if at >= size:
            return -1 - at
        word = bytes_[at] + 256 * bytes_[at + 1]
        columns += [word // 32] + [word // 32 + k for k in range(1, 6) if word % 32 & 2 ** (5 - k)]
        at += 2
    out["x"] = columns[:n]
    at = _ecf_runs(bytes_, size, at, 1, 7, out["p"])
    return -1 - at if at > size else at


def _ecf_runs(data, size, at, width, bits, column):
    values = []
    while len(values) < len(column):
        if at >= size:
            return -1 - at
        value, run = divmod(data[at] + (256 * data[at + 1] if width == 2 else 0), 2**bits)
        if run == 2**bits - 1:
            run = data[at + width] + 256 * data[at + width + 1]
            at += 2
        if run > len(column) - len(values):
            return -1 - at
        values += run * [value]
        at += width
    column[:] = values
    return at


def decode_groups(data, size, at, bits, out):
    width = bits // 6
    for i in range(0, len(out), 4):
        if at + 3 * width > size:
            return -1 - at
        words = [int.from_bytes(data[at + k * width :][:width].tobytes(), "little") for k in range(3)]
        digits = [f"{word:0{8 * width}b}" for word in words]
        third = bits // 3
        values = (
            digits[0][:bits],
            digits[1][: 2 * third] + digits[0][bits:],
            digits[2][:third] + digits[1][2 * third :],
            digits[2][third:],
        )
        for event, text in zip(out[i : i + 4], values, strict=False):
            value = int(text, 2)
            event["p"], event["x"] = value % 2, value // 2 % 2048
            if bits == 24:
                event["y"] = value // 4096 % 2048
        at += 3 * width
    return at


def parse_rows(text, separator, wanted, digits, decimals):
    n = 0
    for line in bytes(text).split(b"\n"):
        line = line.strip(b" \t")
        if not line:
            continue
        if n == digits.shape[1]:
            return -1
        fields = re.split(re.escape(bytes([separator])) if separator else rb"[ \t]+", line)
        if len(fields) <= max(wanted):
            return -1
        for k, i in enumerate(wanted):
            number = re.fullmatch(rb"([+-]?)([0-9]*)(?:\.([0-9]*))?", fields[i].strip(b" \t"))
            if number is None:
                return -1
            whole, behind = number[2], number[3] or b""
            if not 1 <= len(whole + behind) <= 18 or (behind and int(whole + behind) >= 2**53):
                return -1
            digits[k, n] = int(number[1] + whole + behind)
            decimals[k, n] = len(behind)
        n += 1
    return n


def _write(events, out):
    for i, event in enumerate(events):
        out[i] = event
    return len(events)


# streamfeat.kernels.code


def deviation(moments, entries, eps):
    share = 1 / entries
    mean = int(moments[MOMENT_SUM]) * share
    return math.sqrt(int(moments[MOMENT_SQUARES]) * share - mean * mean + eps)


def whitened_square(moments, sigma, operator):
    quadratic = float(moments[MOMENT_QUADRATIC]) * operator.quadratic_scale / (sigma * sigma)
    linear = float(moments[MOMENT_LINEAR]) * operator.linear_scale / sigma
    return float(np.clip(quadratic - 2 * linear + operator.constant, 0, operator.reach * operator.reach))


def gain(sigma, operator):
    return np.float32(operator.scale * operator.unit / sigma)


def _scores(projection, sigma, operator):
    return projection.astype(np.float32) * gain(sigma, operator) - operator.offset


def soft_code(projection, sigma, operator, code):
    z = _scores(projection, sigma, operator)
    code[:] = np.sign(z) * np.maximum(np.abs(z) - np.float32(operator.threshold), np.float32(0))


def triangle_code(projection, sigma, square, operator, code):
    k = operator.n_filters
    one = np.float32(operator.unit)
    z = _scores(projection, sigma, operator)[:k] / one
    squares = np.float32(square) - np.float32(2) * z + operator.square_norms[:k]
    distances = (np.sqrt(np.maximum(squares, np.float32(0))) * one).astype(np.int64)
    code[:] = 0
    code[:k] = np.maximum(distances.sum() // k - distances, 0)


def pool(code, sign, kind, pooled):
    code = code.astype(np.int64)
    parts = [code, np.abs(code)] if kind == SPLIT else [code]
    pooled += sign * np.concatenate(parts)


def pool_soft(sign, projection, factor, offset, threshold, kind, pooled):
    pool(_soft(projection, factor, offset, threshold), sign, kind, pooled)


def _soft(projection, factor, offset, threshold):
    z = projection.astype(np.float32) * factor - offset
    return (np.sign(z) * np.maximum(np.abs(z) - threshold, np.float32(0))).astype(np.int32)


def move_code(change, column, projection, gain_before, gain_after, offset, threshold, kind, pooled):
    pool(_soft(projection, gain_before, offset, threshold), -1, kind, pooled)
    add_column(change, column, projection)
    pool(_soft(projection, gain_after, offset, threshold), 1, kind, pooled)


def mean_distance(distances, n_filters):
    return int(distances[:n_filters].sum(dtype=np.int64)) // n_filters


def fixed_distance(z, length, square_norm, unit):
    square = np.float32(length) - np.float32(2) * (np.float32(z) / np.float32(unit)) + np.float32(square_norm)
    return int(np.sqrt(np.maximum(square, np.float32(0))) * np.float32(unit))


def move_triangle(change, column, projection, gains, lengths, offset, norms, n_filters, unit, pooled, codes):
    k = n_filters
    for sign, factor, length in zip((-1, 1), gains, lengths, strict=True):
        if sign == 1:
            add_column(change, column, projection)
        z = (projection.astype(np.float32) * factor - offset)[:k]
        distances = np.array(
            [fixed_distance(*pair, unit) for pair in zip(z, [length] * k, norms[:k], strict=True)]
        )
        pooled[:k] += sign * np.maximum(mean_distance(distances, k) - distances, 0)


# streamfeat.kernels.ingest


def advance_to_bin(new, operator, state):
    clock = state.clock
    n_bins, now, plane = len(state.counts), int(clock[CLOCK_NOW]), int(clock[CLOCK_PLANE])
    if new <= now:
        return
    before = set(range(now - n_bins + 1, now + 1))
    for bin_index in set(range(new - n_bins + 1, new + 1)) - before:
        state.counts[bin_index % n_bins] = 0
        state.applied[bin_index % n_bins] = 0
    if now != BEFORE_TIME:
        state.tally[TALLY_ROLLS] += new - now
    clock[CLOCK_NOW] = new
    clock[CLOCK_SLOT] = new % n_bins
    clock[CLOCK_START] = int(clock[CLOCK_ORIGIN]) + new * operator.bin_us
    planes = {0, 1} if len(state.cursors) == 2 else {0}
    (clock[CLOCK_PLANE],) = planes - {plane} or {0}
    looked_ahead = planes - {plane} if new == now + 1 else set()
    for other in planes - looked_ahead:
        state.cursors[other] = 0
        state.pooled[other] = 0


def slot_of(position, state):
    return (int(state.clock[CLOCK_SLOT]) + 1 + position) % len(state.counts)


def is_valid(x, y, p, t, state):
    height, width = len(state.ring_rows), len(state.ring_columns)
    return x < width and y < height and p in (0, 1) and abs(int(t)) < 2**62


def count_event(x, y, p, t, operator, state):
    counts, clock, tally = state.counts, state.clock, state.tally
    n_bins, limit = len(counts), operator.max_count
    if not is_valid(x, y, p, t, state):
        tally[TALLY_REJECTED] += 1
        return -1, 0, 0
    bin_index = (int(t) - int(clock[CLOCK_ORIGIN])) // operator.bin_us
    advance_to_bin(bin_index, operator, state)
    window = range(int(clock[CLOCK_NOW]) - n_bins + 1, int(clock[CLOCK_NOW]) + 1)
    if bin_index not in window:
        tally[TALLY_LATE] += 1
        return -1, 0, 0
    tally[TALLY_EVENTS] += 1
    row, column = y // operator.downsample, x // operator.downsample
    entry = bin_index % n_bins, row, column
    before = np.clip(counts[entry], -limit, limit)
    counts[entry] += {0: -1, 1: 1}[p]
    if np.clip(counts[entry], -limit, limit) == before:
        tally[TALLY_SATURATED] += 1
        return -1, 0, 0
    return window.index(bin_index), row, column


def bin_length(operator, state):
    return 0 if state.clock[CLOCK_NOW] == BEFORE_TIME else operator.bin_us


def count_events(events, operator, state):
    on_stack, clock = state.is_touched, state.clock
    for event in events.tolist():
        position, row, column = count_event(*event, operator, state)
        entry = slot_of(position, state), row, column
        if position >= 0 and not on_stack[entry]:
            on_stack[entry] = 1
            state.touched[clock[CLOCK_TOUCHED]] = np.ravel_multi_index(entry, on_stack.shape)
            clock[CLOCK_TOUCHED] += 1


# streamfeat.kernels.lasso


def duality_gap(residual, right, atoms, square, penalty):
    # With r = x - D l, from primal less dual: 1/2 |r|^2 + lambda |l|_1 - (1/2 |x|^2 - 1/2 |x - s r|^2).
    from_x = square - right @ atoms  # x . r
    rest = max(from_x - residual @ atoms, 0.0)  # |r|^2
    from_x = rest + residual @ atoms
    s = min(1.0, penalty / np.abs(residual).max()) if residual.any() else 1.0
    return rest / 2 + penalty * np.abs(atoms).sum() - (s * from_x - s * s * rest / 2)


def lasso_objective(right, square, penalty, gram, atoms):
    return square / 2 - right @ atoms + atoms @ gram @ atoms / 2 + penalty * np.abs(atoms).sum()


def _shrunken_gradient_steps(right, penalty, gram, atoms):
    """Proximal gradient descent (ISTA) until nothing moves: slow, and sure to arrive."""
    lipschitz = max(float(np.linalg.eigvalsh(gram).max()), 1e-12) if len(gram) else 1.0
    for _ in range(20_000):
        z = atoms + (right - gram @ atoms) / lipschitz
        following = np.sign(z) * np.maximum(np.abs(z) - penalty / lipschitz, 0)
        following[np.diag(gram) == 0] = atoms[np.diag(gram) == 0]
        if np.abs(following - atoms).max(initial=0) < 1e-13:
            return following
        atoms = following
    return atoms


def select_atoms(right, atoms, response, least, chosen):
    found = np.flatnonzero((np.abs(right - response) > least) | (atoms != 0))
    chosen[: len(found)] = found
    return len(found)


def copy_corner(gram, chosen, corner):
    corner[:] = 0
    corner[:, : len(chosen)] = gram[np.ix_(chosen, chosen)]


def respond(gram, kept, work, chosen):
    kept[1] = gram.astype(np.float64) @ kept[0]


def solve_lasso(right, square, penalty, gram, gap, kept, work, chosen, corners):
    kept[0] = _shrunken_gradient_steps(right, penalty, gram.astype(np.float64), kept[0])
    respond(gram, kept, work, chosen)
    return duality_gap(right - kept[1], right, kept[0], square, penalty) / max(square / 2, 1e-300)


def add_rows(steps, moved, gram, response):
    response += steps @ gram[moved].astype(np.float64)


def subtract_row(step, row, residual):
    residual -= step * row.astype(np.float64)


def descend(penalty, corner, atoms, residual):
    n = len(atoms)
    gram = corner[:, :n].astype(np.float64)
    right = residual[:n] + gram @ atoms
    for j in np.flatnonzero(np.diag(gram)):
        rest = atoms.copy()
        rest[j] = 0
        target = right[j] - gram[j] @ rest
        atoms[j] = np.sign(target) * max(abs(target) - penalty, 0) / gram[j, j]
    residual[:n] = right - gram @ atoms


def extrapolate(penalty, corner, before, atoms, residual):
    n = len(atoms)
    gram = corner[:, :n].astype(np.float64)
    direction = atoms - before
    before[:] = direction
    growth = np.where(atoms == 0, np.abs(direction), np.sign(atoms) * direction).sum()
    slope = direction @ residual[:n] - penalty * growth
    if slope <= 0:
        return
    ends = np.full(n + 1, np.inf)
    shrinking = np.flatnonzero(atoms * direction < 0)
    ends[shrinking] = -atoms[shrinking] / direction[shrinking]
    curvature = direction @ gram @ direction
    ends[n] = slope / curvature if curvature > 0 else np.inf
    if np.isfinite(ends.min()):
        atoms += ends.min() * direction
        residual[:n] -= ends.min() * gram @ direction
        if ends.argmin() < n:
            atoms[ends.argmin()] = 0


def lasso_code(projection, sigma, square, operator, kept, work, chosen, corners):
    k = kept.shape[1]
    right = projection[:k] * (operator.scale / sigma) - operator.offset[:k] / operator.unit
    penalty = operator.threshold / operator.unit
    solve_lasso(right, square, penalty, operator.gram, operator.gap, kept, None, None, None)


def fix_atoms(atoms, operator, code):
    largest = operator.reach * operator.reach / (2 * operator.threshold / operator.unit)
    code[:] = 0
    code[: len(atoms)] = np.trunc(atoms.clip(-largest, largest) * operator.unit)


def solve_lasso_rows(right, squares, penalty, gram, gap, codes):
    for b, square, code in zip(right.astype(np.float64), squares, codes, strict=True):
        kept = np.array([code, np.zeros(len(b))], np.float64)
        solve_lasso(b, square, penalty, gram, gap, kept, None, None, None)
        code[:] = kept[0]


# streamfeat.kernels.volume


def add_column(change, column, projection):
    projection += change * column.astype(np.int32)


def sum_columns(n, entries, changes, columns, sums):
    sums[:] = changes[:n].astype(np.int64) @ columns[entries[:n]].astype(np.int64)


def sums_of(values, operator):
    """Projection and moments of a volume, from nothing."""
    v, moments = values.astype(np.int64), np.zeros(4, np.int64)
    moments[MOMENT_SUM], moments[MOMENT_SQUARES] = v.sum(), v @ v
    if operator.quadratic.size:
        moments[MOMENT_QUADRATIC] = v @ operator.quadratic.astype(np.int64) @ v
        moments[MOMENT_LINEAR] = v @ operator.linear.astype(np.int64)
    return (v @ operator.columns.astype(np.int64)).astype(np.int32), moments


def add_moments(n, changes, moments):
    moments[:2] += sum(changes[:n].tolist()), sum(change**2 for change in changes[:n].tolist())


def change_moments(n, entries, changes, values, operator, moments):
    d = len(operator.columns)
    _, before = sums_of(values[:d], operator)
    values[entries[:n]] += changes[:n]
    _, after = sums_of(values[:d], operator)
    moments += after - before


def change_entries(n, entries, changes, values, operator, projection, moments, sums):
    projection += changes[:n].astype(np.int32) @ operator.columns[entries[:n]].astype(np.int32)
    change_moments(n, entries, changes, values, operator, moments)


def gather_volume(ring, first_slot, start, end, top, left, patch, values):
    oldest_first = np.roll(ring, -first_slot, axis=0)
    height, width = patch
    volume = oldest_first[:, top : top + height, left : left + width].reshape(-1)
    first, last = start // width * width, -(-end // width) * width  # whole lines
    values[first:last] = volume[first:last]


def list_entries(values, start, end, entries, changes):
    listed = start + np.flatnonzero(values[start:end])
    entries[: len(listed)], changes[: len(listed)] = listed, values[listed]
    return len(listed)


# streamfeat.kernels.encode


def cell(place, shape, pooling):
    """Row and column of the cell of a volume."""
    return tuple(math.floor(index * pooling / side) for index, side in zip(place, shape, strict=True))


def cell_index(volume, shape, pooling):
    row, column = cell(divmod(volume, shape[1]), shape, pooling)
    return row * pooling + column


def volumes_of(operator):
    rows, columns = operator.shape
    return rows * columns


def encode_volume(projection, moments, atoms, fresh, part, operator, state):
    code = state.code[part, 0]
    if moments[MOMENT_SQUARES] == 0:
        code[:] = 0
        if fresh:
            atoms[:] = 0
        return
    write_code(None, None, None, projection, moments, atoms, fresh, part, operator, state)


def write_code(narrow, wide, lasso, projection, moments, atoms, fresh, part, operator, state):
    code = state.code[part, 0]
    if operator.steps is not None:
        narrow_code(narrow_gain(moments, operator), projection, operator.upper, operator.lower, code)
        return
    sigma = deviation(moments, len(operator.columns), operator.eps)
    square = whitened_square(moments, sigma, operator)
    if operator.inverse:
        if fresh:
            lasso_code(projection, sigma, square, operator, atoms, None, None, None)
        fix_atoms(atoms[0], operator, code)
    elif operator.kind == TRIANGLE:
        triangle_code(projection, sigma, square, operator, code)
    else:
        soft_code(projection, sigma, operator, code)


def pool_volume(plane, row, volume, sign, part, operator, state):
    sums = [state.pooled, *state.partial][part][plane, cell_index(volume, operator.shape, operator.pooling)]
    pool_row_of(None, None, None, plane, row, sign, part, operator, state, sums)
    state.encoded[part] += sign > 0


def read_cell(cell, operator, state, features):
    whole = features.copy()
    read_features(operator, state, whole)
    cells = state.pooled.shape[1]
    features.reshape(cells, -1)[cell] = whole.reshape(cells, -1)[cell]


def pool_row_of(narrow, wide, lasso, plane, row, sign, part, operator, state, sums):
    projection, moments, atoms = (
        field[plane, row] for field in (state.projections, state.moments, state.atoms)
    )
    if operator.steps is None:
        encode_volume(projection, moments, atoms, sign > 0, part, operator, state)
        pool(state.code[part, 0], sign, operator.kind, sums)
    elif moments[MOMENT_SQUARES]:
        pool_narrow(sign, narrow_gain(moments, operator), projection, operator.upper, operator.lower, sums)


def read_features(operator, state, features):
    write_features(None, operator, state.pooled[int(state.clock[CLOCK_PLANE])], features)


def write_features(steps, operator, pooled, features):
    parts = pooled.astype(np.int64).reshape(len(pooled), -1, len(operator.offset))[:, :, : operator.n_filters]
    if operator.steps is not None:
        if operator.kind != SPLIT:
            parts = parts[:, :1] - parts[:, 1:]
        features[:] = (parts * operator.steps[: operator.n_filters]).reshape(-1)
        return
    if operator.kind == SPLIT:
        signed, absolute = parts[:, 0], parts[:, 1]
        parts = np.stack([(absolute + signed) / 2, (absolute - signed) / 2], axis=1)
    features[:] = parts.reshape(-1) / operator.unit


# streamfeat.kernels.narrow


def narrow_gain(moments, operator):
    fraction, exponent = math.frexp(operator.gain / deviation(moments, len(operator.columns), operator.eps))
    factor, shift = math.floor(fraction * 2**15), exponent + 1
    if shift < 0:
        factor, shift = math.floor(factor / 2 ** min(-shift, 15)), 0
    return min(shift, 15) + 2**16 * factor


def _narrow_parts(packed, projection, upper, lower):
    factor, shift = divmod(packed % 2**32, 2**16)
    shifted = projection.astype(np.int64) * 2**shift
    assert (np.abs(shifted) < 2**15).all()  # or the kernel would see another number
    level = np.floor_divide(shifted * factor, 2**16) + 2**15
    return np.maximum(level - upper, 0), np.maximum(lower.astype(np.int64) - level, 0)


def narrow_code(packed, projection, upper, lower, code):
    positive, negative = _narrow_parts(packed, projection, upper, lower)
    code[:] = positive - negative


def pool_narrow(sign, packed, projection, upper, lower, pooled):
    pooled += sign * np.concatenate(_narrow_parts(packed, projection, upper, lower)).astype(np.int32)


def move_rows(n, sign, queue, columns, projections, upper, lower, pooled):
    width = len(upper)
    for column, row, packed in queue[:n].tolist():
        projection = projections[row : row + width]
        pool_narrow(-1, packed % 2**32, projection, upper, lower, pooled)
        projection += (-1 if sign < 0 else 1) * columns[column : column + width]
        pool_narrow(1, packed // 2**32, projection, upper, lower, pooled)


def move_queued(part, operator, state):
    n, plane, cell_of_all, sign = state.queued[part].tolist()
    columns = operator.columns if sign else state.sums[part]
    sums = [state.pooled, *state.partial][part]
    move_rows(
        n,
        sign,
        state.queue[part],
        columns.reshape(-1),
        state.projections.reshape(-1),
        operator.upper,
        operator.lower,
        sums[plane, cell_of_all],
    )
    state.queued[part, 0] = 0


def queue_volume(plane, volume, n, part, operator, state):
    change_volume(plane, volume, n, part, operator, state)


# streamfeat.kernels.planes


def _gather(ring, ahead, volume, operator, state):
    """Entries of a volume as they are after `ahead` more bins."""
    n_bins, (height, width) = len(ring), operator.patch
    top, left = (index * operator.stride for index in divmod(volume, operator.shape[1]))
    oldest_first = np.roll(ring, -slot_of(0, state), axis=0)
    bins = [*oldest_first[ahead:], *np.zeros_like(ring[:ahead])]
    assert len(bins) == n_bins
    return np.array([pixels[top : top + height, left : left + width] for pixels in bins], int).ravel()


def project_volume(plane, volume, ahead, start, most, part, operator, state):
    row = volume if state.projections.shape[1] > 1 else 0
    values = _gather(state.applied, ahead, volume, operator, state)
    (filled,) = np.nonzero(values[start:])
    end = (len(state.applied) - ahead) * math.prod(operator.patch)
    following = int(start + filled[most]) if len(filled) > most else end
    values[following:] = 0
    state.projections[plane, row], state.moments[plane, row] = sums_of(values, operator)
    return min(most, len(filled)), following


def enter_atoms(lasso, plane, row, part, operator, state):
    if operator.inverse:
        atoms = state.atoms[plane, row]
        atoms[1] = operator.gram.astype(np.float64) @ atoms[0]


# streamfeat.kernels.dense


def can_wait(state):
    return state.awaiting.shape[1] > 0


def let_in(plane, volume, ahead, waiting, part, operator, state):
    values = _gather(state.applied, ahead, volume, operator, state)
    n, before = int(np.count_nonzero(values)), state.projections[plane, volume].copy()
    projection, state.moments[plane, volume] = sums_of(values, operator)
    if n <= 0.4 * len(values):
        state.projections[plane, volume] = projection
        return n, waiting
    state.projections[plane, volume] = before
    state.windows[part, waiting] = 0
    state.windows[part, waiting, : len(values)] = values
    state.awaiting[part, waiting] = volume
    return n, waiting + 1


def multiply(plane, waiting, part, operator, state):
    for volume, window in zip(state.awaiting[part, :waiting], state.windows[part], strict=False):
        values = window[: len(operator.columns)].astype(np.int64)
        state.projections[plane, volume] = values @ operator.columns


# streamfeat.kernels.planes, after the projection


def enter_code(plane, volume, part, operator, state):
    row = volume if state.projections.shape[1] > 1 else 0
    if not state.moments[plane, row].any():
        state.atoms[plane, row] = 0
        return False
    pool_volume(plane, row, volume, 1, part, operator, state)
    return True


def count_filled(ring, stride, patch, lines, crowds):
    for row, filled in enumerate(ring.any(axis=0)):
        for c in range(crowds.shape[1]):
            crowds[row, c] = filled[c * stride : c * stride + patch].sum()


def list_missing(operator, state):
    plane, missing = int(state.clock[CLOCK_PLANE]), []
    for volume in range(state.cursors[plane, CURSOR_CODED], volumes_of(operator)):
        held = (
            state.moments.shape[1] == volumes_of(operator)
            and state.moments[plane, volume, MOMENT_SQUARES] != 0
        )
        if held or operator.inverse or _gather(state.applied, 0, volume, operator, state).any():
            missing.append(volume)
    state.dirty[: len(missing)] = missing
    state.clock[CLOCK_DIRTY] = len(missing)
    work = [40 + _filled_pixels(volume, operator, state) for volume in missing]
    state.load[: len(missing) + 1] = np.cumsum([0, *work])


def _filled_pixels(volume, operator, state):
    windows = _gather(state.applied, 0, volume, operator, state).reshape(len(state.applied), -1)
    return int(windows.any(axis=0).sum())


def first_with_load(least, load, n):
    return next((i for i in range(n) if load[i] >= least), n)


def share_of_load(part, parts, state):
    n = int(state.clock[CLOCK_DIRTY])
    load = state.load[: n + 1].astype(float)
    if n == 0:
        return 0, 0
    cuts = [int(np.searchsorted(load[:n], load[n] * i / parts - 1e-6)) for i in range(parts + 1)]
    return cuts[part], cuts[part + 1]


def share_of(part, parts, state):
    n = int(state.clock[CLOCK_DIRTY])
    cuts = [math.floor(n * i / parts) for i in range(parts + 1)]
    return cuts[part], cuts[part + 1]


def complete(part, parts, operator, state):
    plane = int(state.clock[CLOCK_PLANE])
    cursors, everything = state.cursors[plane], len(operator.columns)
    for volume in state.dirty[slice(*share_of_load(part, parts, state))].tolist():
        if volume >= cursors[CURSOR_PROJECTED]:
            project_volume(plane, volume, 0, 0, everything, part, operator, state)
        enter_code(plane, volume, part, operator, state)


def add_up(parts, state):
    state.pooled[:] = state.pooled + state.partial[: parts - 1].sum(axis=0, dtype=np.int32)
    state.partial[: parts - 1] = 0


def finish(parts, operator, state):
    add_up(parts, state)
    state.cursors[int(state.clock[CLOCK_PLANE])] = volumes_of(operator), volumes_of(operator), 0
    state.clock[CLOCK_DIRTY] = 0


def fill_plane(operator, state):
    list_missing(operator, state)
    complete(0, 1, operator, state)
    finish(1, operator, state)


def look_ahead(projected, coded, budget, operator, state):
    current, volumes = int(state.clock[CLOCK_PLANE]), volumes_of(operator)
    if len(state.cursors) == 1 or state.cursors[current, CURSOR_CODED] != volumes:
        return budget
    plane, part = 1 - current, 0
    cursors = state.cursors[plane]
    while budget > 0 and cursors[CURSOR_PROJECTED] < projected:
        volume, start = (int(cursor) for cursor in cursors[[CURSOR_PROJECTED, CURSOR_ENTRY]])
        held = start or state.moments[plane, volume].any()
        n, following = project_volume(plane, volume, 1, start, budget, part, operator, state)
        if held or _gather(state.applied, 0, volume, operator, state).any():
            budget -= 1 + n
        if following == (len(state.applied) - 1) * math.prod(operator.patch):
            volume, following = volume + 1, 0
        cursors[CURSOR_PROJECTED], cursors[CURSOR_ENTRY] = volume, following
    while budget > 0 and cursors[CURSOR_CODED] < min(coded, cursors[CURSOR_PROJECTED]):
        volume = int(cursors[CURSOR_CODED])
        budget -= 6 * enter_code(plane, volume, part, operator, state)
        cursors[CURSOR_CODED] += 1
    return budget


# streamfeat.kernels.update


def _entries_in(plane, volume, state):
    """How many entries of a volume are in its projection in a plane."""
    cursors = state.cursors[plane]
    if volume == cursors[CURSOR_PROJECTED]:
        return int(cursors[CURSOR_ENTRY])
    return state.changes.shape[1] - 1 if volume < cursors[CURSOR_PROJECTED] else 0


def _changed_volumes(after, operator, state):
    """`(plane, volume, entries)` of every volume whose entries are not those that were applied."""
    for plane in range(len(state.cursors)):
        ahead = int(plane != state.clock[CLOCK_PLANE])
        for volume in range(volumes_of(operator)):
            old, new = (_gather(ring, ahead, volume, operator, state) for ring in (state.applied, after))
            end = _entries_in(plane, volume, state)
            new[end:] = 0
            if (new[:end] != old[:end]).any():
                yield plane, volume, new


def _follow_volume(plane, volume, values, part, operator, state):
    coded = volume < state.cursors[plane, CURSOR_CODED]
    if coded:
        pool_volume(plane, volume, volume, -1, part, operator, state)
    state.projections[plane, volume], state.moments[plane, volume] = sums_of(values, operator)
    if coded:
        pool_volume(plane, volume, volume, 1, part, operator, state)


def _clipped(operator, state):
    return state.counts.clip(-operator.max_count, operator.max_count).astype(np.int16)


def mark_dirty(operator, state):
    after, n_volumes = _clipped(operator, state), volumes_of(operator)
    changed = _changed_volumes(after, operator, state)
    dirty = [plane * n_volumes + volume for plane, volume, _ in changed]
    state.touched_slots[:] = (after != state.applied).any(axis=(1, 2))
    state.news[:] = after - state.applied
    state.is_dirty[dirty] = 1
    state.dirty[: len(dirty)] = dirty
    state.clock[CLOCK_DIRTY] = len(dirty)


def touched_bins(state):
    n_bins = len(state.counts)
    touched = [position for position in range(n_bins) if state.touched_slots[slot_of(position, state)]]
    return min(touched, default=n_bins), max(touched, default=-1) + 1


def renew(part, parts, operator, state):
    mine = state.dirty[slice(*share_of(part, parts, state))].tolist()
    for plane, volume, values in list(_changed_volumes(_clipped(operator, state), operator, state)):
        if plane * volumes_of(operator) + volume in mine:
            _follow_volume(plane, volume, values, part, operator, state)


def settle(state):
    state.applied[:] = state.applied + state.news
    state.news[:] = 0
    state.is_touched[:] = 0
    state.is_dirty[:] = 0
    state.clock[[CLOCK_TOUCHED, CLOCK_DIRTY]] = 0


def update(operator, state):
    mark_dirty(operator, state)
    renew(0, 1, operator, state)
    settle(state)
    fill_plane(operator, state)


def read(operator, state, features):
    update(operator, state)
    read_features(operator, state, features)


# streamfeat.kernels.change


def change_volume(plane, volume, n, part, operator, state):
    values = _gather(state.applied, int(plane != state.clock[CLOCK_PLANE]), volume, operator, state)
    values[_entries_in(plane, volume, state) :] = 0
    values[state.entries[part, :n]] += state.changes[part, :n]
    _follow_volume(plane, volume, values, part, operator, state)


def move_volume(plane, volume, n, part, operator, state):
    change_volume(plane, volume, n, part, operator, state)


def follow_changes(narrow, wide, lasso, plane, volume, n, part, operator, state):
    change_volume(plane, volume, n, part, operator, state)


def follow_rest(narrow, part, operator, state):
    if narrow is not None:
        move_queued(part, operator, state)


def change_place(position, row, column, operator, state):
    after, entry = state.applied.copy(), (slot_of(position, state), row, column)
    after[entry] = _clipped(operator, state)[entry]
    for plane, volume, values in list(_changed_volumes(after, operator, state)):
        _follow_volume(plane, volume, values, 0, operator, state)
    state.applied[:] = after


# streamfeat.kernels.follow


def follow(events, operator, state):
    for event in events.tolist():
        follow_event(*event, operator, state)


def follow_event(x, y, p, t, operator, state):
    n_volumes = volumes_of(operator)
    position, row, column = count_event(x, y, p, t, operator, state)
    if state.cursors[int(state.clock[CLOCK_PLANE]), CURSOR_CODED] < n_volumes:
        fill_plane(operator, state)
    if position >= 0:
        change_place(position, row, column, operator, state)
    if len(state.cursors) == 2:
        share = float(np.clip((t - int(state.clock[CLOCK_START])) / operator.bin_us, 0, 1))
        projected = min(n_volumes, int(n_volumes * share / 0.9))
        coded = min(n_volumes, int(n_volumes * max(share - 0.85, 0.0) / (0.975 - 0.85)))
        coming = state.cursors[1 - int(state.clock[CLOCK_PLANE])]
        behind = max(projected - coming[CURSOR_PROJECTED], coded - coming[CURSOR_CODED], 0)
        budget = 24 + 100 * int(behind) // n_volumes
        look_ahead(projected, coded, budget, operator, state)


# streamfeat.kernels.predict


def part_of(feature, n_features):
    return feature // -(-n_features // 16)


def _sum_of_products(one, other):
    """In the order that is promised: 32 lanes, each from its first product on, then halves of the lanes."""
    lanes = np.zeros(32, np.float32)
    for products in (one * other).reshape(-1, 32):
        lanes = lanes + products
    while len(lanes) > 1:
        lanes = lanes[: len(lanes) // 2] + lanes[len(lanes) // 2 :]
    return lanes[0]


def sum_part(part, features, weights, roots, sums):
    places = [i for i in range(len(features)) if part_of(i, len(features)) == part]
    roots[:] = 0
    roots[: len(places)] = np.sign(features[places]) * np.sqrt(np.abs(features[places]))
    sums[part] = [_sum_of_products(roots, row) for row in (*weights.rows[part], roots)]


def score_parts(sums, bias, scores):
    total = np.zeros(sums.shape[1], np.float32)
    for row in sums:
        total = total + row
    scores[:] = total[:-1] / (np.sqrt(total[-1]) or np.float32(1)) + bias


def predict(features, weights, roots, sums, scores):
    for row, found in zip(features, scores, strict=True):
        for part in range(16):
            sum_part(part, row, weights, roots, sums)
        score_parts(sums, weights.bias, found)


# streamfeat.kernels.trace


def mark_cells(x, y, operator, state, is_stale):
    row, column = int(state.ring_rows[y]), int(state.ring_columns[x])
    found = []
    for volume in range(volumes_of(operator)):
        top, left = (place * operator.stride for place in divmod(volume, operator.shape[1]))
        if top <= row < top + operator.patch[0] and left <= column < left + operator.patch[1]:
            found.append(divmod(cell_index(volume, operator.shape, operator.pooling), operator.pooling))
    if found:  # a small grid leaves cells without a volume; those between others are marked, too
        (top, left), (bottom, right) = np.min(found, axis=0), np.max(found, axis=0)
        square = is_stale.reshape(operator.pooling, operator.pooling)
        square[top : bottom + 1, left : right + 1] = 1


def read_stale(operator, state, weights, reading):
    stale = np.flatnonzero(reading.is_stale)
    for cell in stale.tolist():
        read_cell(cell, operator, state, reading.features)
        width = len(reading.features) // len(reading.is_stale)
        for feature in range(cell * width, (cell + 1) * width):
            reading.parts[part_of(feature, len(reading.features))] = 1
    for part in np.flatnonzero(reading.parts).tolist():
        if weights.rows.shape[1]:
            sum_part(part, reading.features, weights, reading.roots, reading.sums)
    reading.is_stale[:] = reading.parts[:] = 0
    return len(stale)


def trace(events, operator, state, weights, reading, features, scores, accepted):
    for i, event in enumerate(events.tolist()):
        follow_event(*event, operator, state)
        read_features(operator, state, reading.features)
        predict(reading.features[np.newaxis], weights, reading.roots, reading.sums, scores[i : i + 1])
        features[i : i + 1] = reading.features
        accepted[i] = state.tally[TALLY_EVENTS]


# The mathematics itself, in float64 and without a quantised operator: what all of the above is for.


def window_counts(events, geometry, resolution, origin_us, t_us):
    """Clipped counts `(n_bins, H, W)` of the window that ends with the bin of `t_us`, oldest bin first."""
    counts = np.zeros((geometry.n_bins, *geometry.ring_shape(resolution)), int)
    first = (t_us - origin_us) // geometry.bin_us - geometry.n_bins + 1
    for x, y, p, t in events.tolist():
        position = (t - origin_us) // geometry.bin_us - first
        inside = x < resolution[1] and y < resolution[0] and p in (0, 1)
        if inside and 0 <= position < geometry.n_bins:
            counts[position, y // geometry.downsample, x // geometry.downsample] += 2 * p - 1
    return counts.clip(-geometry.max_count, geometry.max_count)


def local_volumes(counts, geometry):
    """`(rows, columns, d)` local volumes of a ring of counts."""
    (height, width), (rows, columns) = geometry.sides, counts.shape[1:]
    tops, lefts = (range(0, n + 1, geometry.stride) for n in (rows - height, columns - width))
    blocks = [[counts[:, i : i + height, j : j + width].reshape(-1) for j in lefts] for i in tops]
    return np.array(blocks, np.float64)


def code_of(volume, encoder):
    """Code `(K,)` of one local volume, straight from the filters, the whitening and the mean."""
    filters, whitening, mean = (
        a.astype(np.float64) for a in (encoder.filters, encoder.whitening, encoder.mean)
    )
    if not volume.any():
        return np.zeros(len(filters))
    x = whitening @ ((volume - volume.mean()) / np.sqrt(volume.var() + encoder.operator.eps) - mean)
    if encoder.encoding == "triangle":
        distances = np.linalg.norm(x - filters, axis=1)
        return np.maximum(0, distances.mean() - distances)
    if encoder.formulation == "inverse":
        start = np.zeros(len(filters))
        return _shrunken_gradient_steps(filters @ x, encoder.threshold, filters @ filters.T, start)
    z = filters @ x
    return np.sign(z) * np.maximum(np.abs(z) - encoder.threshold, 0)


def codes_of(counts, encoder):
    """`(rows, columns, K)` codes of a ring of counts."""
    return np.apply_along_axis(code_of, 2, local_volumes(counts, encoder.geometry), encoder)


def features_from(codes, encoding, pooling=2):
    """Codes summed over each cell; positive and negative parts apart for `split`."""
    if encoding == "split":
        codes = np.concatenate([codes.clip(0), (-codes).clip(0)], axis=2)
    cells = np.zeros((pooling, pooling, codes.shape[2]))
    for place in np.ndindex(codes.shape[:2]):
        cells[cell(place, codes.shape[:2], pooling)] += codes[place]
    return cells.ravel()


def features_over_time(counts, encoder):
    """Features of volumes shorter than the window: their codes summed over each cell, and over time."""
    geometry = encoder.geometry
    total = 0
    for end in range(len(counts), geometry.depth - 1, -geometry.time_stride):
        codes = codes_of(counts[end - geometry.depth : end], encoder)
        total = total + features_from(codes, encoder.encoding, geometry.pooling)
    return total


# streamfeat.kernels.denoise


def mark_noise(events, limits, past, level, removed, keep):
    """Three filters, one after the other: the first two know one pixel, the third its neighbours."""
    height, width = level.shape
    x, y, p, t = (events[name].astype(np.int64) for name in "xypt")
    left = np.flatnonzero(
        (x < width) & (y < height) & np.isin(p, (0, 1)) & (t > -(2**62)) & (t < 2**62)
    ).tolist()
    places = list(zip(y.tolist(), x.tolist(), strict=True))
    keep[:] = True
    for reason, noisy in enumerate((_hot, _too_soon, _alone)):
        if limits[reason]:
            noise = noisy(left, places, t.tolist(), int(limits[reason]), past[reason], level)
            keep[noise] = False
            removed[reason] += len(noise)
            left = sorted({*left} - {*noise})


def _by_pixel(left, places):
    found = {}
    for i in left:
        found.setdefault(places[i], []).append(i)
    return found.items()


def _hot(left, places, t, rise, latest, level):
    """A leaky bucket of two seconds for each pixel: full above one."""
    noise = []
    for place, events in _by_pixel(left, places):
        bucket, before = int(level[place]), int(latest[place])
        for i in events:
            leaked = min(bucket, max(t[i] - before, 0))
            bucket, before = min(bucket - leaked + rise, 2_000_000), t[i]
            noise += [i] * (bucket > 1_000_000)
        level[place], latest[place] = bucket, before
    return noise


def _too_soon(left, places, t, period, latest, level):
    """Events less than a period away from the last one of their pixel that was not."""
    noise = []
    for place, events in _by_pixel(left, places):
        passed = [int(latest[place])]
        for i in events:
            if -period < t[i] - passed[-1] < period:
                noise.append(i)
            else:
                passed.append(t[i])
        latest[place] = passed[-1]
    return noise


def _alone(left, places, t, support, latest, level):
    """Events without a latest event of one of the eight pixels around that is near in time."""
    noise = []
    for i in left:
        row, column = places[i]
        around = np.pad(latest, 1, constant_values=np.iinfo(np.int64).min)[row : row + 3, column : column + 3]
        others = np.delete(around.ravel(), 4).tolist()
        noise += [i] * (min(abs(t[i] - other) for other in others) > support)
        latest[row, column] = t[i]
    return noise


# streamfeat.kernels.pixels


def draw_picture(picture, rows, row_weights, columns, column_weights, scratch, out):
    by_row = (row_weights[:, :, None] * picture[rows]).transpose(1, 0, 2)
    by_row = (by_row[0] + by_row[1]) + (by_row[2] + by_row[3])
    by_column = (by_row[:, columns] * column_weights).transpose(2, 0, 1)
    out[:] = (by_column[0] + by_column[1]) + (by_column[2] + by_column[3])
    scratch[:] = by_row[-1]


def fire_pixels(
    before,
    after,
    start,
    end,
    thresholds,
    refractory,
    reference,
    release,
    pixel,
    out_pixel,
    out_polarity,
    out_t,
):
    # All pixels at once, as arrays: what it was before it was a kernel.
    off, on = thresholds
    live = np.arange(len(before)) >= pixel
    slope = (after - before) / (end - start)
    ends = live & (release > start) & (release <= end)
    moved = np.where(ends, before + slope * (release - start), reference)
    change = after - moved
    fires = ((change >= on) | (change <= -off)) & live & (release <= end) & (slope != 0)
    which = np.flatnonzero(fires)
    slopes, rising = slope[which], slope[which] > 0
    step = np.where(rising, on[which], -off[which])
    first = np.clip(start + (moved[which] + step - before[which]) / slopes, start, end)
    period = refractory + step / slopes
    count = np.floor((end - first) / period).astype(np.int64) + 1
    fits = np.cumsum(count) <= len(out_t)
    n_fit = int(np.argmin(fits)) if not fits.all() else len(fits)
    stop = int(which[n_fit]) if n_fit < len(which) else len(before)
    seen = np.arange(len(before)) < stop + (n_fit < len(which))  # that pixel's reset ended as well
    reference[:] = np.where(seen, moved, reference)
    which, count, first, period, rising = (a[:n_fit] for a in (which, count, first, period, rising))
    n = int(count.sum())
    nth = np.arange(n) - np.repeat(np.cumsum(count) - count, count)
    out_pixel[:n], out_polarity[:n] = np.repeat(which, count), np.repeat(rising, count)
    out_t[:n] = (np.repeat(first, count) + nth * np.repeat(period, count)).astype(np.int64)
    release[which] = first + (count - 1) * period + refractory
    reference[which] = before[which] + slope[which] * (release[which] - start)
    return stop, n


# streamfeat.kernels.retina


def describe_events(x, y, places, recent, queue, head, out):
    radius, width = places.shape[0] // 2, recent.shape[1]
    for i, (xi, yi) in enumerate(zip(x.tolist(), y.tolist(), strict=True)):
        if queue[head[0]] >= 0:
            recent.flat[queue[head[0]]] -= 1
        queue[head[0]] = (yi + radius) * width + xi + radius
        recent.flat[queue[head[0]]] += 1
        head[0] = (head[0] + 1) % len(queue)
        around = recent[yi : yi + 2 * radius + 1, xi : xi + 2 * radius + 1]
        on_grid = places >= 0
        counts = np.bincount(places[on_grid], around[on_grid], minlength=out.shape[1]).astype(np.float32)
        out[i] = counts / np.float32(max(counts.sum(), 1))


# streamfeat.kernels.spiking


def _receivers(x, y, weights, height, width):
    """Pixels whose neurons an event reaches, each with its weights: those of the event as seen from there."""
    radius = weights.shape[0] // 2
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            row, column = y - dy, x - dx
            if 0 <= row < height and 0 <= column < width:
                yield row, column, weights[dy + radius, dx + radius]


def spike_first(x, y, p, t, weights, limits, potential, updated, fired, pooled, counts):
    threshold, leak, dead, pooled_dead, cell = limits.tolist()
    for xi, yi, pi, ti in zip(x.tolist(), y.tolist(), p.tolist(), t.tolist(), strict=True):
        for row, column, weight in _receivers(xi, yi, weights, *potential.shape[1:3]):
            if ti - fired[pi, row, column] <= dead:
                continue
            here = potential[pi, row, column].astype(int)
            leaked = leak * (ti - updated[pi, row, column])
            here = np.sign(here) * np.maximum(np.abs(here) - leaked, 0) + weight
            updated[pi, row, column] = ti
            spikes = np.flatnonzero(here > threshold)
            for k in spikes:
                at = row // cell, column // cell, k
                if ti - pooled[at] > pooled_dead:
                    pooled[at] = ti
                    counts[at] += 1
            if len(spikes):
                fired[pi, row, column] = ti
            potential[pi, row, column] = 0 if len(spikes) else here


def spike_leaky(x, y, p, t, weights, threshold, dead, cell, potential, updated, fired, counts):
    for xi, yi, pi, ti in zip(x.tolist(), y.tolist(), p.tolist(), t.tolist(), strict=True):
        for row, column, weight in _receivers(xi, yi, weights, *potential.shape[1:3]):
            here = potential[pi, row, column] * math.exp(updated[pi, row, column] - ti)
            updated[pi, row, column] = ti
            here = here + np.where(ti - fired[pi, row, column] >= dead, weight, 0.0)
            spikes = here >= threshold
            fired[pi, row, column, spikes] = ti
            counts[row // cell, column // cell] += spikes
            potential[pi, row, column] = np.where(spikes, 0.0, here)


# streamfeat.kernels.surfaces


def add_memory_surfaces(x, y, p, t, cell, memory, sums):
    radius = sums.shape[3] // 2
    events = list(zip(x.tolist(), y.tolist(), p.tolist(), t.tolist(), strict=True))
    before = memory.copy()
    for i, (xi, yi, pi, ti) in enumerate(events):
        row, column = yi // cell, xi // cell
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                there = yi + dy, xi + dx
                if (there[0] // cell, there[1] // cell) != (row, column):
                    continue
                if not (0 <= there[0] < memory.shape[1] and 0 <= there[1] < memory.shape[2]):
                    continue
                past = sum(math.exp(tj - ti) for xj, yj, pj, tj in events[:i] if (yj, xj, pj) == (*there, pi))
                past += math.exp(-ti) * before[(pi, *there)]
                sums[row, column, pi, dy + radius, dx + radius] += past
    for xi, yi, pi, ti in events:
        memory[pi, yi, xi] += math.exp(ti)


def time_surfaces(x, y, p, t, latest, out):
    radius = out.shape[2] // 2
    for i in range(len(t)):
        latest[p[i], y[i] + radius, x[i] + radius] = t[i]
        around = latest[:, y[i] : y[i] + 2 * radius + 1, x[i] : x[i] + 2 * radius + 1]
        out[i] = np.exp(around - t[i])
