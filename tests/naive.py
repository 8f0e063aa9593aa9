"""Slow, obvious twins of the compiled kernels: each `@njit` function has one of the same name here."""

import numpy as np

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
            is_late_word = ahead - 4096 >= 0 and time_high - (ahead - 4096) <= 10 and ahead != time_high
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


def _write(events, out):
    for i, event in enumerate(events):
        out[i] = event
    return len(events)
