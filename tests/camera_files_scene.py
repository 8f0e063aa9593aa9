"""The scene of camera files, and writers of it in the forms that people have.

600 events of a dot that moves over 64x48 pixels, at 100, 150, ... 30,050 us.
"""

import struct

import numpy as np

from streamfeat.events import Events, make_events

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
    if chip:
        words = [((259 - y) << 22 | (345 - x) << 12 | p << 11, t) for x, y, p, t in rows]
        words.insert(1, (1 << 31, 0x70))  # a sample of a frame
    else:
        words = [(y << 8 | x << 1 | p, t) for x, y, p, t in rows]
    return header.encode() + b"".join(struct.pack(">II", *word) for word in words)


def aedat3(events: Events) -> bytes:
    header = b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DVS128\r\n#!END-HEADER\r\n"
    packets = [struct.pack("<hhiiiiii", 2, 1, 4, 0, 0, 1, 1, 1) + bytes(4)]  # of another kind
    for at in range(0, len(events), 256):
        part = events[at : at + 256]
        packets.append(struct.pack("<hhiiiiii", 1, 1, 8, 4, 0, 256, len(part), len(part)))
        for x, y, p, t in zip(*(part[name].tolist() for name in "xypt"), strict=True):
            packets.append(struct.pack("<II", x << 17 | y << 2 | p << 1 | 1, t))
    return header + b"".join(packets)
