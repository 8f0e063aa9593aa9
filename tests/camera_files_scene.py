"""The scene of camera files, and writers of it in the forms that people have.

600 events of a dot that moves over 64x48 pixels, at 100, 150, ... 30,050 us.
"""

import struct

import numpy as np

from streamfeat.events import EVENT_DTYPE, Events, make_events

RESOLUTION = (48, 64)


def scene() -> Events:
    rng = np.random.default_rng(3)
    step = np.arange(600)
    x = np.clip(50 - step // 14 + rng.integers(-3, 4, 600), 0, 63)
    y = np.clip(22 + step // 40 + rng.integers(-3, 4, 600), 0, 47)
    return make_events(x, y, rng.integers(0, 2, 600), 100 + 50 * step)


def text(events: Events, order: str, separator: str = " ", header: str = "", time: str = "{}") -> bytes:
    rows = ({name: int(event[name]) for name in "xypt"} for event in events)
    lines = (
        separator.join(time.format(row[name]) if name == "t" else str(row[name]) for name in order)
        for row in rows
    )
    return (header + "".join(f"{line}\n" for line in lines)).encode()


def table(events: Events, order: str) -> np.ndarray:
    return np.stack([events[name].astype(np.int64) for name in order], axis=1)


def evt21(events: Events, header: bytes, *, is_swapped: bool = False) -> bytes:
    halves = []
    for x, y, p, t in zip(*(events[name].tolist() for name in "xypt"), strict=True):
        halves += [(0, 8 << 28 | t >> 6)]
        halves += [(1 << x % 32, p << 28 | (t & 63) << 22 | (x - x % 32) << 11 | y)]
    words = (low << 32 | high if is_swapped else high << 32 | low for low, high in halves)
    return header + b"".join(struct.pack("<Q", word) for word in words)


def evt4(events: Events, header: bytes) -> bytes:
    words = []
    for i, (x, y, p, t) in enumerate(zip(*(events[name].tolist() for name in "xypt"), strict=True)):
        words.append(0xE << 28 | t >> 6)
        cd = (t & 63) << 22 | y
        if i % 2:
            words.append((0xA | p) << 28 | cd | x << 11)
        else:  # a vector whose word of pixels looks like another vector's beginning
            words += [(0xC | p) << 28 | cd | (x - x % 32) << 11, 1 << x % 32]
    return header + struct.pack(f"<{len(words)}I", *words)


def evt3(events: Events, highs: dict[int, int]) -> bytes:
    """EVT 3.0 in which the word of some event's TIME_HIGH is `xor`ed."""
    words = []
    for i, (x, y, p, t) in enumerate(zip(*(events[name].tolist() for name in "xypt"), strict=True)):
        high = (t >> 12 & 0xFFF) ^ highs.get(i, 0)
        words += [0x8000 | high, 0x6000 | t & 0xFFF, y, 0x2000 | p << 11 | x]
    return b"% evt 3.0\n% end\n" + struct.pack(f"<{len(words)}H", *words)


def aedat2(events: Events, chip: str = "") -> bytes:
    header = "#!AER-DAT2.0\r\n# This is a raw AE data file - do not edit\r\n"
    header += f"# AEChip: eu.seebetter.ini.chips.davis.{chip}\r\n" if chip else ""
    rows = zip(*(events[name].tolist() for name in "xypt"), strict=True)
    if "avis" in chip:
        words = [((259 - y) << 22 | (345 - x) << 12 | p << 11, t) for x, y, p, t in rows]
        words.insert(1, (1 << 31, 0x70))  # a sample of a frame
    else:
        words = dvs128(events, is_turned=bool(chip))
    return header.encode() + b"".join(struct.pack(">II", *word) for word in words)


def aedat1(events: Events, header: bytes = b"#!AER-DAT1.0\r\n", *, is_turned: bool = False) -> bytes:
    return header + b"".join(struct.pack(">HI", *word) for word in dvs128(events, is_turned=is_turned))


def dvs128(events: Events, *, is_turned: bool) -> list[tuple[int, int]]:
    """Addresses, as they stand or as jAER takes them, and times; a second word is of no pixel."""
    rows = zip(*(events[name].tolist() for name in "xypt"), strict=True)
    if is_turned:
        rows = ((127 - x, 127 - y, 1 - p, t) for x, y, p, t in rows)
    words = [(y << 8 | x << 1 | p, t) for x, y, p, t in rows]
    return [*words[:1], (0x8000, words[0][1] if words else 0), *words[1:]]


def aedat3(events: Events) -> bytes:
    header = b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DVS128\r\n#!END-HEADER\r\n"
    packets = [struct.pack("<hhiiiiii", 2, 1, 4, 0, 0, 1, 1, 1) + bytes(4)]  # of another kind
    for at in range(0, len(events), 256):
        part = events[at : at + 256]
        packets.append(struct.pack("<hhiiiiii", 1, 1, 8, 4, 0, 256, len(part), len(part)))
        for x, y, p, t in zip(*(part[name].tolist() for name in "xypt"), strict=True):
            packets.append(struct.pack("<II", x << 17 | y << 2 | p << 1 | 1, t))
    return header + b"".join(packets)


def event_stream(events: Events, *, is_atis: bool = False, resolution=RESOLUTION) -> bytes:
    """Event Stream 2.0; of ATIS with a threshold crossing and a reset before each hundredth event."""
    bits = 6 if is_atis else 7
    top = (1 << bits) - 1
    head = b"Event Stream\x02\x00\x00" + bytes([2 if is_atis else 1]) + struct.pack("<HH", *resolution[::-1])
    parts, last = [head], 0
    for i, (x, y, p, t) in enumerate(zip(*(events[name].tolist() for name in "xypt"), strict=True)):
        overflows, rest = divmod(t - last, top)
        last, y = t, resolution[0] - 1 - y
        if is_atis:
            threes, ones = divmod(overflows, 3)
            parts.append(b"\xff" * threes + (bytes([0xFC | ones]) if ones else b""))
        else:
            parts.append(b"\xff" * overflows)
        if i % 100 == 0:
            parts.append(b"\xfc" * 5 + struct.pack("<BHH", rest << 2 | 1, x, y) if is_atis else b"\xfe" * 5)
            rest = 0 if is_atis else rest
        parts.append(struct.pack("<BHH", rest << 2 | p << 1 if is_atis else rest << 1 | p, x, y))
    return b"".join(parts)


def ecf(events: Events, mode: int) -> bytes:
    """One chunk of ECF: mode 2 packs whole pixels, 1 columns, 0 has masks of columns."""
    x, y, p, t = (events[name].tolist() for name in "xypt")
    out = bytearray(struct.pack("<IQ", len(t) << 2 | mode, t[0] if t else 0))

    def runs(values, bits, width):
        i = 0
        while i < len(values):
            n = 1
            while i + n < len(values) and values[i + n] == values[i]:
                n += 1
            full = (1 << bits) - 1
            out.extend((values[i] << bits | min(n, full)).to_bytes(width, "little"))
            out.extend(n.to_bytes(2, "little") if n >= full else b"")
            i += n

    def groups(values, bits):
        width = bits // 3
        for i in range(0, len(values), 4):
            a, b, c, d = [*values[i : i + 4], 0, 0, 0][:4]
            words = (
                a << width | b & (1 << width) - 1,
                (b >> width) << 2 * width | c & (1 << 2 * width) - 1,
                (c >> 2 * width) << 3 * width | d,
            )
            out.extend(b"".join(word.to_bytes(bits // 6, "little") for word in words))

    now, i = t[0] if t else 0, 0
    while i < len(t):
        if t[i] - now >= 15:
            left = t[i] - now
            while left:
                out.append(0xF0 | left & 15)
                left >>= 4
            now = t[i]
        n = 1
        while i + n < len(t) and t[i + n] == t[i]:
            n += 1
        out.append(max(t[i] - now, 0) << 4 | min(n, 15))  # a fall cannot be written

        out.extend(n.to_bytes(2, "little") if n >= 15 else b"")
        now, i = max(t[i], now), i + n
    if mode == 2:
        groups([b << 12 | a << 1 | c for a, b, c in zip(x, y, p, strict=True)], 24)
        return bytes(out)
    runs(y, 5, 2)
    if mode == 1:
        groups([a << 1 | c for a, c in zip(x, p, strict=True)], 12)
        return bytes(out)
    i = 0
    while i < len(x):
        start, mask = x[i], 0
        i += 1
        for k in range(1, 6):
            if i < len(x) and x[i] == start + k:
                mask |= 1 << 5 - k
                i += 1
        out.extend((start << 5 | mask).to_bytes(2, "little"))
    runs(p, 7, 1)
    return bytes(out)


def ecf_file(h5py, path, chunks, *, n=None, is_shuffled=False):
    """A file of Metavision: a table whose chunks of 250 events are stored as they are given."""
    with h5py.File(path, "w") as root:
        filters = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        filters.set_chunk((250,))
        if is_shuffled:
            filters.set_shuffle()
        filters.set_filter(0x8ECF, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple((n or 250 * len(chunks),))
        kind = h5py.h5t.py_create(EVENT_DTYPE)
        table = h5py.h5d.create(root.create_group("CD").id, b"events", kind, space, filters)
        for i, chunk in enumerate(chunks):
            table.write_direct_chunk((250 * i,), chunk)
        root.attrs["geometry"] = "64x48"
    return path
