"""Both engines behind one face, as small as the two jobs need it, and neither engine in its place.

Lives here: how each is started, given tasks, and given functions that run for ever.
"""

import contextlib
import time
from collections.abc import Callable
from typing import Any, Protocol

TIMEOUT_S = 300
STORE_BYTES = 256 * 2**20
"""Of Ray's shared memory; by default it takes 30 % of what the machine has."""

QUICK = {
    "DASK_DISTRIBUTED__COMM__TIMEOUTS__TCP": "12s",
    "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "4s",
    "RAY_health_check_initial_delay_ms": "1000",
    "RAY_health_check_period_ms": "500",
    "RAY_health_check_timeout_ms": "1000",
    "RAY_health_check_failure_threshold": "3",
}
"""Settings with which each should soon notice that a node cannot be reached: Dask refuses less than 11 s for
a connection, and waits for ten heartbeats of half a second whatever the time to live."""


class Engine(Protocol):
    """What is measured."""

    def submit(self, task: Callable[..., Any], *values: Any) -> Any:
        """Give a task to some worker; values may be handles of other tasks."""

    def results(self, handles: list[Any]) -> list[Any]:
        """Wait for all and fetch them."""

    def serve(self, task: Callable[..., Any], *values: Any) -> Any:
        """Have a task run for ever, on another worker when its own dies."""

    def stop(self) -> None: ...


class InProcess:
    """No engine: the same functions, called."""

    def submit(self, task: Callable[..., Any], *values: Any) -> Any:
        return task(*values)

    def results(self, handles: list[Any]) -> list[Any]:
        return handles

    def serve(self, task: Callable[..., Any], *values: Any) -> Any:
        raise NotImplementedError("it would not come back")

    def stop(self) -> None:
        pass


class OnRay:
    """Tasks as tasks; what runs for ever as a method of an actor that is restarted."""

    def __init__(self, workers: int, address: str | None = None) -> None:
        import ray

        self._ray = ray
        here: dict[str, Any] = {"address": address, "_node_ip_address": (address or "").split(":")[0]}
        if address is None:
            here = {"address": "local", "num_cpus": workers, "num_gpus": 0}
            here |= {"include_dashboard": False, "object_store_memory": STORE_BYTES}
        ray.init(log_to_driver=False, logging_level="ERROR", **here)
        if address:
            until(lambda: sum(node["Alive"] for node in ray.nodes()) >= workers, "its nodes")

        class Actor:
            def run(self, task: Callable[..., Any], *values: Any) -> Any:
                return task(*values)

        options = {"max_restarts": -1, "max_task_retries": -1, "num_cpus": 0.5}
        self._actor = ray.remote(scheduling_strategy="SPREAD", **options)(Actor)
        self._tasks: dict[Callable[..., Any], Any] = {}
        self._actors: list[Any] = []

    def submit(self, task: Callable[..., Any], *values: Any) -> Any:
        if task not in self._tasks:
            self._tasks[task] = self._ray.remote(task)
        return self._tasks[task].remote(*values)

    def results(self, handles: list[Any]) -> list[Any]:
        return self._ray.get(handles, timeout=TIMEOUT_S)

    def serve(self, task: Callable[..., Any], *values: Any) -> Any:
        self._actors.append(self._actor.remote())
        return self._actors[-1].run.remote(task, *values)

    def stop(self) -> None:
        self._ray.shutdown()


class OnDask:
    """Tasks as tasks, both those that end and those that do not."""

    def __init__(self, workers: int, address: str | None = None, threads: int = 1) -> None:
        import dask
        from distributed import Client, LocalCluster, wait

        # A key is served however often the worker under it dies.
        dask.config.set({"distributed.scheduler.allowed-failures": 10**6})
        self._stack, self._wait = contextlib.ExitStack(), wait
        if address is None:
            local = LocalCluster(
                n_workers=workers, threads_per_worker=threads, memory_limit=0, dashboard_address=None
            )
            address = self._stack.enter_context(local)
        self.client = self._stack.enter_context(Client(address, timeout=60))
        self.client.wait_for_workers(workers, timeout=TIMEOUT_S)

    def submit(self, task: Callable[..., Any], *values: Any) -> Any:
        return self.client.submit(task, *values, pure=False)

    def results(self, handles: list[Any]) -> list[Any]:
        self._wait(handles, timeout=TIMEOUT_S)
        return self.client.gather(handles)

    def serve(self, task: Callable[..., Any], *values: Any) -> Any:
        return self.client.submit(task, *values, pure=False)

    def stop(self) -> None:
        self._stack.close()


def until(condition: Callable[[], Any], what: str, limit_s: float = 120.0) -> None:
    """Wait for a state.

    Raises:
        TimeoutError: it does not come.
    """
    limit = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > limit:
            raise TimeoutError(f"waited {limit_s:g} s for {what}")
        time.sleep(0.01)


def started(name: str, workers: int, *, address: str | None = None, servers: int = 1) -> Engine:
    """An engine with workers on this machine, or connected to an address.

    Args:
        name: `ray`, `dask` or `none`.
        workers: how many processes.
        address: of a scheduler or head that runs already.
        servers: how many functions that run for ever a worker must be able to hold.
    """
    if name == "ray":
        return OnRay(workers, address)
    if name == "dask":
        return OnDask(workers, address, servers)
    return InProcess()
