"""Work on other processes and machines, by Dask.

Lives here: pieces of work that end, and what is said when they fail.
Not here: work that does not end by itself (`services`), and what the work is; which worker does it, and what
is done again when one dies, Dask decides.

Every function that is sent is a function of its arguments alone, and what goes into the first is kept by the
scheduler: what a worker that dies has held is computed again on another from there.
"""

import functools
import itertools
import os
import platform
import signal
import uuid
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from itertools import islice
from multiprocessing import resource_tracker
from types import FunctionType
from typing import Any, TypeVar

from streamfeat.errors import InputError
from streamfeat.work.workers import Sums, add_sums, one_blas_thread

try:
    import dask
    from distributed import Client, Future, LocalCluster, get_worker
    from distributed.client import FutureCancelledError
    from distributed.comm import CommClosedError
    from distributed.scheduler import KilledWorker
except ImportError as error:  # pragma: no cover
    raise InputError(
        f"{error}; other processes and machines need: pip install 'streamfeat[cluster]'"
    ) from error

__all__ = ["Cluster", "check_versions", "connected", "local", "one_line", "versions_here"]

R = TypeVar("R")

_PATIENCE_S = 10.0
_AHEAD = 3
"""Pieces of work for each thread that are with the workers or waiting for them."""
_FAN_IN = 4
_PACKAGES = ("streamfeat", "numpy", "numba")
"""Packages that results depend on, beside Python."""

_SETTINGS = {
    "distributed.comm.timeouts.connect": f"{_PATIENCE_S}s",
    "distributed.admin.large-graph-warning-threshold": "1GB",
    # Dask has workers give memory back at once; arrays of megabytes then come from the system, page by page.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 28,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 25,
}


class Cluster:
    """Workers of a Dask cluster; see `streamfeat.work.workers.Workers`.

    Args:
        client: connected.

    Attributes:
        client: the same.
        versions: of the packages here that results depend on.
    """

    def __init__(self, client: Client) -> None:
        """Refuse workers that would compute something else.

        Raises:
            InputError: there is no worker, or one has another version of what computes.
        """
        self.client = client
        self.versions = versions_here()
        with one_line():
            client.wait_for_workers(1, timeout=_PATIENCE_S)
            workers = client.get_versions(packages=list(_PACKAGES))["workers"]
        for address, found in workers.items():
            check_versions(self.versions, found["packages"], address)

    @property
    def description(self) -> str:
        """How many work, and where Dask shows what they do."""
        threads = self.client.nthreads().values()
        return f"{len(threads)} workers, {sum(threads)} threads; dashboard: {self.client.dashboard_link}"

    def processes(self) -> dict[str, int]:
        """The process number of each worker, by its address."""
        return dict(self.client.run(os.getpid))

    def map(
        self, function: Callable[..., R], pieces: Iterable[tuple[Any, ...]], *common: Any
    ) -> Generator[R, None, None]:
        """See `Workers`."""
        source = iter(pieces)
        with one_line():
            n = _AHEAD * self._threads()

            def begin(n: int) -> Iterator[Future]:
                return (self._submit(function, *piece, *common) for piece in islice(source, n))

            ahead = deque(begin(n))
            try:
                while ahead:
                    yield self._result(ahead.popleft())
                    ahead.extend(begin(1))
            finally:
                self.client.cancel(list(ahead))

    def hold(self, value: Any) -> Any:
        """Put a value where work is done: with the scheduler, which gives it to the workers that ask."""
        if isinstance(value, Future | FunctionType | int | float | str | None):
            return value
        with one_line():
            return self.client.submit(_itself, value, pure=False)

    def fetch(self, held: Sequence[Any]) -> list[Any]:
        """See `Workers`."""
        with one_line():
            return [self._result(one) for one in held]

    def total(self, function: Callable[..., Sums], held: Sequence[tuple[Any, ...]], *common: Any) -> Sums:
        """See `Workers`; sums are added on the workers, and those that can be are added first."""
        with one_line():
            together = _FAN_IN if len(held) >= _AHEAD * _FAN_IN * self._threads() else 1
            level = [self._part_of_total(function, group, common) for group in _groups(held, together)]
            while len(level) > 1:
                level = [self._sum(group) for group in _groups(level, _FAN_IN)]
            sums: Sums = self._result(level[0])
            return sums

    def each(self, function: Callable[..., R], held: Sequence[tuple[Any, ...]], *common: Any) -> list[Any]:
        """See `Workers`."""
        with one_line():
            return [self._submit(function, *values, *common) for values in held]

    def _threads(self) -> int:
        threads: int = sum(self.client.nthreads().values())
        return max(1, threads)

    def _result(self, future: Future) -> Any:
        """Wait for a result, as long as there is a worker."""
        while True:
            try:
                return future.result(timeout=_PATIENCE_S)
            except TimeoutError:
                if future.status == "pending" and not self.client.nthreads():
                    raise InputError("no worker is left; their logs tell why") from None

    def _part_of_total(
        self, function: Callable[..., Sums], group: Sequence[tuple[Any, ...]], common: Sequence[Any]
    ) -> Future:
        own = itertools.chain(*group)
        return self._submit(_total, function, len(group), len(group[0]), *own, *common)

    def _sum(self, parts: Sequence[Future]) -> Future:
        if len(parts) == 1:
            return parts[0]
        return self.client.submit(add_sums, *parts, pure=False, priority=1)

    def _submit(self, function: Callable[..., R], *values: Any) -> Future:
        # The dashboard groups by what is before the number.
        key = f"{function.__name__.strip('_')}-{uuid.uuid4()}"
        # A piece that cannot be read on one machine may be read on another.
        return self.client.submit(_worked, self.versions, function, *values, key=key, retries=2)


@contextmanager
def connected(address: str) -> Iterator[Cluster]:
    """The workers of the scheduler at an address, such as `tcp://10.0.0.1:8786`.

    Raises:
        InputError: no scheduler answers there, it has no workers, or they have other versions.
    """
    with dask.config.set(_SETTINGS):
        try:
            client = Client(address, timeout=_PATIENCE_S, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise InputError(
                f"no scheduler answers at {address} ({_reason(error)}); start one with `dask scheduler`, and "
                "workers with `dask worker ADDRESS`"
            ) from error
        with client:
            yield Cluster(client)


@contextmanager
def local(n_workers: int, threads: int | None = None) -> Iterator[Cluster]:
    """Workers on this machine, each a process, until the block ends.

    Args:
        n_workers: how many.
        threads: of each; together as many as there are cores if not given.

    Raises:
        InputError: they cannot be started.
    """
    if n_workers < 1:
        raise InputError(f"{n_workers} workers cannot do anything; give at least one")
    threads = threads or max(1, dask.system.CPU_COUNT // n_workers)
    with dask.config.set(_SETTINGS), one_line():
        with _ctrl_c_ignored():
            cluster = LocalCluster(
                n_workers=n_workers,
                threads_per_worker=threads,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                silence_logs="CRITICAL",
            )
        with cluster, Client(cluster, set_as_default=False) as client:
            yield Cluster(client)


@contextmanager
def _ctrl_c_ignored() -> Iterator[None]:
    """Processes that are started here do not hear Ctrl-C of the terminal; this process does, and ends them.

    They inherit what the thread blocks that starts them, now or later: that of the cluster, which inherits it
    from this one. The resource tracker of multiprocessing unblocks signals as it starts, so it starts before.
    """
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@functools.cache
def versions_here() -> dict[str, str]:
    """Of all that decides what comes out."""
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in _PACKAGES},
    }


def check_versions(wanted: dict[str, str], found: dict[str, Any], address: str) -> None:
    """Refuse a worker with other versions.

    Args:
        wanted: of the client, by name.
        found: of the worker; None for what it does not have.
        address: of the worker.

    Raises:
        InputError: one differs.
    """
    for name, right in wanted.items():
        there = found.get(name)
        if name == "python":
            there, right = ".".join(str(there).split(".")[:3]), ".".join(right.split(".")[:3])
        if there != right:
            has = f"has {name} {there}" if there else f"does not have {name}"
            raise InputError(f"worker {address} {has}, here it is {right}; install the same on both")


def _groups(values: Sequence[R], size: int) -> Iterator[Sequence[R]]:
    return (values[i : i + size] for i in range(0, len(values), size))


def _total(function: Callable[..., Sums], n: int, width: int, *values: Any) -> Sums:
    """Add up `n` neighbours in the tree; of `values`, `width` are of each, and the others of all."""
    own, common = values[: n * width], values[n * width :]
    return add_sums(*(function(*one, *common) for one in _groups(own, width)))


def _itself(value: Any) -> Any:
    return value


def _worked(asked: dict[str, str], function: Callable[..., R], *values: Any) -> R:
    """Call a function on a worker; what goes wrong there is told with its address."""
    worker = get_worker().address
    check_versions(asked, versions_here(), worker)
    try:
        with one_blas_thread():
            return function(*values)
    except (InputError, OSError) as error:
        raise InputError(f"{error} (on worker {worker})") from error


@contextmanager
def one_line() -> Iterator[None]:
    """The failure of a cluster as one line."""
    try:
        yield
    except KilledWorker as error:
        raise InputError(
            f"work was given up after {error.allowed_failures + 1} workers died of it or while they did it; "
            "their logs tell why (too little memory?)"
        ) from error
    except (ModuleNotFoundError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "deserialization" not in str(error):
            raise
        raise InputError(
            f"a worker or the scheduler lacks a package: {_reason(error)}; install the same there as here"
        ) from error
    except (FutureCancelledError, CommClosedError, TimeoutError) as error:
        raise InputError(f"the cluster is lost: {_reason(error)}") from error


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
