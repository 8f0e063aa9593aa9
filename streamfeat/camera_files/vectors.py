"""EVT 2.1 and EVT 4.0: the words of Prophesee sensors that hold up to 32 pixels of a row at once.

Lives here: both word orders of EVT 2.1, and vectors of EVT 4.0, a bounded block at a time.
Not here: headers, EVT 2.0 and EVT 3.0 (`prophesee`), and which format a file has (`event_files`).
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from streamfeat.camera_files.prophesee import HighTimes, blocks_of, header_contents
from streamfeat.camera_files.source import Contents, Losses, TableOptions
from streamfeat.events import Events, make_events

__all__ = ["open_evt4", "open_evt21"]

_EVT21_KINDS = (0x0, 0x1, 0x8, 0xA, 0xE, 0xF)


def open_evt21(path: Path, head: bytes, options: TableOptions) -> Contents:
    """EVT 2.1; of the two orders of its 32-bit halves the one that makes sense, which is said when a header
    says otherwise or nothing.
    """
    fields, contents = header_contents(path, head)
    data = head[contents.start :]
    halves = np.frombuffer(data[: len(data) // 8 * 8], "<u4").reshape(-1, 2)
    said = "endianness=legacy" in fields.get("format", "").lower() or fields.get("endianness") == "legacy"
    faults = [_faults(halves[:, ::step]) for step in (1, -1)]
    is_swapped = faults[1] < faults[0] if faults[0] != faults[1] else said
    assumptions = contents.assumptions
    if is_swapped != said:
        order = "upper" if is_swapped else "lower"
        assumptions = (*assumptions, f"EVT 2.1 words have their {order} half first, by their values")
    return replace(
        contents, read=partial(_read_evt21, path, contents.start, is_swapped), assumptions=assumptions
    )


def _faults(halves: NDArray[np.uint32]) -> int:
    """How much in `(n, 2)` halves, the lower one first, no sensor writes."""
    upper = halves[:, 1]
    kind = upper >> 28
    highs = (upper[kind == 8] & 0xFFFFFFF).astype(np.int64)
    falls = np.count_nonzero(np.diff(highs) < 0)
    return int(np.count_nonzero(~np.isin(kind, _EVT21_KINDS)) + falls + (len(highs) == 0))


def _read_evt21(path: Path, start: int, is_swapped: bool, losses: Losses) -> Iterator[Events]:
    """u64 words: type in bits 60-63; CD words hold time (6), x (11), y (11) and 32 pixels from x on."""
    times = HighTimes()
    for block in blocks_of(path, start, 8, losses):
        halves = np.frombuffer(block, "<u4").reshape(-1, 2)
        mask, word = halves[:, ::-1].T if is_swapped else halves.T
        kind = word >> 28
        high, known = times(kind == 8, word)
        keep = (kind <= 1) & known
        yield _spread(word[keep], kind[keep], mask[keep], high[keep])


def open_evt4(path: Path, head: bytes, options: TableOptions) -> Contents:
    """EVT 4.0."""
    _, contents = header_contents(path, head)
    return replace(contents, read=partial(_read_evt4, path, contents.start))


def _read_evt4(path: Path, start: int, losses: Losses) -> Iterator[Events]:
    """u32 words: CD 0xA, 0xB and, with a word of 32 pixels after it, 0xC, 0xD; TIME_HIGH 0xE."""
    times, carried = HighTimes(), np.empty(0, "<u4")
    for block in blocks_of(path, start, 4, losses):
        words = np.concatenate([carried, np.frombuffer(block, "<u4")])
        kind = words >> 28
        # In a run of words that look like vectors every second one is the pixels of the one before it.
        looks = (kind == 0xC) | (kind == 0xD)
        at = np.arange(len(words))
        run = np.maximum.accumulate(np.where(looks, -1, at))
        is_vector = looks & ((at - run) % 2 == 1)
        carried = words[-1:] if len(words) and is_vector[-1] else words[:0]
        n = len(words) - len(carried)
        words, kind, is_vector = words[:n], kind[:n], is_vector[:n]
        is_mask = np.concatenate([[False], is_vector[:-1]])
        high, known = times((kind == 0xE) & ~is_mask, words)
        keep = known & ~is_mask & (is_vector | (kind == 0xA) | (kind == 0xB))
        mask = np.where(is_vector, np.append(words[1:], 0)[:n], 1).astype("<u4")
        yield _spread(words[keep], kind[keep] & 1, mask[keep], high[keep])
    if len(carried):
        losses.lose(4, "the last word is a vector without its pixels")


def _spread(
    word: NDArray[np.uint32], polarity: NDArray[np.uint32], mask: NDArray[np.uint32], high: NDArray[np.int64]
) -> Events:
    """One event for each bit that is set in `mask`, from the x of its word on."""
    bits = np.unpackbits(
        np.ascontiguousarray(mask, "<u4").view("u1").reshape(-1, 4), axis=1, bitorder="little"
    )
    row, bit = np.nonzero(bits)
    held = word[row]
    t = high[row] << 6 | (held >> 22 & 0x3F)
    return make_events((held >> 11 & 0x7FF) + bit, held & 0x7FF, polarity[row], t)
