"""Messages in order of log time, whatever their order in the file.

Lives here: what the times of a file's chunks say about their order, and the bounded buffer that sorts.
Not here: reading (`records`), and decoding, which must come after this: evt3 carries state along.

A message is given out once no later chunk can hold an earlier one, as the chunk index says. So a file in
order waits for one chunk at a time, and chunks that overlap are held together. No more than `BUFFER_BYTES`
of messages are held; one that is still earlier is given out at once, and counted as out of order
(`streamfeat.messages.timeline`).
"""

import heapq
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate, pairwise

from streamfeat.recordings.records import Block
from streamfeat.recordings.sources import StoredMessage

__all__ = ["BUFFER_BYTES", "are_in_order", "clean_cuts", "in_log_order"]

BUFFER_BYTES = 64 << 20
_OVERHEAD = 512
"""Bytes that a message takes besides its data."""

_Waiting = tuple[int, int, int, StoredMessage]
"""Log time, number of arrival, byte, message: sorts by the first two."""


def clean_cuts(blocks: Sequence[Block]) -> list[int]:
    """Bytes of the blocks before which everything is earlier than all that follows.

    Args:
        blocks: in order of their bytes.
    """
    if not blocks:
        return []
    latest = list(accumulate((block.last_ns for block in blocks), max))
    earliest = _earliest_from(blocks)
    pairs = zip(blocks[1:], latest, earliest[1:], strict=False)
    return [blocks[0].at, *(block.at for block, before, after in pairs if before <= after)]


def are_in_order(blocks: Sequence[Block]) -> bool:
    """Whether reading the blocks as they stand is reading them by their first times."""
    return all(one.first_ns <= other.first_ns for one, other in pairwise(blocks))


def in_log_order(
    messages: Iterable[tuple[int, StoredMessage]],
    blocks: Sequence[Block],
    limit_bytes: int = BUFFER_BYTES,
) -> Iterator[tuple[int, StoredMessage]]:
    """Sort messages by log time; those of equal time stay as they are.

    Args:
        messages: each with the byte of its block, block by block.
        blocks: in the order in which their messages come; empty if the file does not tell.
        limit_bytes: hold no more than this.

    Yields:
        byte and message; one that came too late for its place is given at once.
    """
    ranks = {block.at: rank for rank, block in enumerate(blocks)}
    starts, earliest = sorted(ranks), _earliest_from(blocks)
    waiting: list[_Waiting] = []
    is_heap = False
    held, count, given_ns = 0, 0, -1
    block_at = rank = -1
    for at, message in messages:
        if starts and at != block_at:
            block_at, before = at, rank
            known = bisect_right(starts, at) - 1
            rank = ranks[starts[known]] if known >= 0 else -1
            if rank != before:
                # Nothing of this block or of those behind it is earlier than this.
                waiting.sort()
                is_heap = False
                ready, waiting = _split(waiting, earliest[rank])
                for time_ns, _, place, item in ready:
                    given_ns = time_ns
                    yield place, item
                waiting = [_on_its_own(entry) for entry in waiting]
                held = sum(len(item.data) + _OVERHEAD for *_, item in waiting)
        if message.log_time_ns < given_ns:
            yield at, message
            continue
        count += 1
        if is_heap:
            heapq.heappush(waiting, (message.log_time_ns, count, at, message))
        else:
            waiting.append((message.log_time_ns, count, at, message))
        held += len(message.data) + _OVERHEAD
        if held > limit_bytes and not is_heap:
            heapq.heapify(waiting)
            is_heap = True
        while held > limit_bytes:
            given_ns, _, place, item = heapq.heappop(waiting)
            held -= len(item.data) + _OVERHEAD
            yield place, item
    waiting.sort()
    for *_, place, item in waiting:
        yield place, item


def _earliest_from(blocks: Sequence[Block]) -> list[int]:
    """For each block, the earliest time in it and in all behind it."""
    return list(accumulate((block.first_ns for block in reversed(blocks)), min))[::-1]


def _split(waiting: list[_Waiting], safe_ns: int) -> tuple[list[_Waiting], list[_Waiting]]:
    """A sorted list before and after a time; what is of that time comes before."""
    place = bisect_right(waiting, safe_ns, key=lambda entry: entry[0])
    return waiting[:place], waiting[place:]


def _on_its_own(entry: _Waiting) -> _Waiting:
    """The same with bytes of its own: a view would keep all of its chunk in memory."""
    time_ns, count, at, message = entry
    if isinstance(message.data, memoryview):
        message = message._replace(data=bytes(message.data))
    return time_ns, count, at, message
