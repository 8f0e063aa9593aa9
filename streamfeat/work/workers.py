"""Where work is done that can be cut into pieces: on the cores of this process, or elsewhere.

Lives here: what a place to work can do, this process as one, and the order in which sums are added.
Not here: other processes and machines (`cluster`), and what the work is.

What comes out does not depend on the place: pieces are the same everywhere, each is computed with one BLAS
thread, and sums of pieces are added as one and the same binary tree.
"""

import functools
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import islice
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

__all__ = ["THIS_PROCESS", "Sums", "ThreadWorkers", "Workers", "add_sums", "one_blas_thread"]

R = TypeVar("R")
Sums = tuple[NDArray[np.float64], ...]
"""Sums: arrays that are added up one by one."""


class Workers(Protocol):
    """A place to work. Functions and what they are given can be pickled, if that place is elsewhere."""

    def map(self, function: Callable[..., R], pieces: Iterable[tuple[Any, ...]], *common: Any) -> Iterator[R]:
        """Yield `function(*piece, *common)` in order; pieces are taken a few ahead of what was yielded."""

    def hold(self, value: Any) -> Any:
        """Put a value where work is done, for any number of functions; `fetch` gives it back."""

    def fetch(self, held: Sequence[Any]) -> list[Any]:
        """The values that are held."""

    def total(self, function: Callable[..., Sums], held: Sequence[tuple[Any, ...]], *common: Any) -> Sums:
        """Add up `function(*values, *common)` over tuples of what is held, as a tree; at least one."""

    def each(self, function: Callable[..., R], held: Sequence[tuple[Any, ...]], *common: Any) -> list[Any]:
        """Hold `function(*values, *common)` for each tuple of what is held."""


class ThreadWorkers:
    """This process: a thread for each core.

    Args:
        threads: how many; as many as there are cores if not given.
    """

    def __init__(self, threads: int | None = None) -> None:
        """Start nothing yet."""
        self._threads = threads or os.cpu_count() or 1

    def map(
        self, function: Callable[..., R], pieces: Iterable[tuple[Any, ...]], *common: Any
    ) -> Generator[R, None, None]:
        """See `Workers`."""
        source = iter(pieces)
        with one_blas_thread(), ThreadPoolExecutor(self._threads, thread_name_prefix="work") as pool:

            def begin(n: int) -> Iterator[Future[R]]:
                return (pool.submit(function, *piece, *common) for piece in islice(source, n))

            ahead = deque(begin(2 * self._threads))
            try:
                while ahead:
                    yield ahead.popleft().result()
                    ahead.extend(begin(1))
            finally:
                for one in ahead:
                    one.cancel()

    def hold(self, value: Any) -> Any:
        """The value itself."""
        return value

    def fetch(self, held: Sequence[Any]) -> list[Any]:
        """The values themselves."""
        return list(held)

    def total(self, function: Callable[..., Sums], held: Sequence[tuple[Any, ...]], *common: Any) -> Sums:
        """See `Workers`; no more sums wait to be added than the tree is high."""
        waiting: list[tuple[int, Sums]] = []
        for sums in self.map(function, held, *common):
            height = 0
            while waiting and waiting[-1][0] == height:
                sums = add_sums(waiting.pop()[1], sums)
                height += 1
            waiting.append((height, sums))
        return functools.reduce(lambda right, left: add_sums(left[1], right), waiting[-2::-1], waiting[-1][1])

    def each(self, function: Callable[..., R], held: Sequence[tuple[Any, ...]], *common: Any) -> list[Any]:
        """See `Workers`."""
        return list(self.map(function, held, *common))


THIS_PROCESS = ThreadWorkers()
"""Where work is done by default."""


def add_sums(*parts: Sums) -> Sums:
    """Add up to four parts as a binary tree: `(a + b) + (c + d)`."""
    while len(parts) > 1:
        pairs = [
            tuple(x + y for x, y in zip(a, b, strict=True))
            for a, b in zip(parts[::2], parts[1::2], strict=False)
        ]
        parts = (*pairs, *parts[2 * len(pairs) :])
    return parts[0]


@functools.cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """One thread for each matrix product: the cores have other pieces, and the bits do not change."""
    with _libraries().limit(limits=1, user_api="blas"):
        yield
