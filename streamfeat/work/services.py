"""Work on a cluster that does not end by itself.

Lives here: beginning it, hearing of it, ending it, and how it learns that it is not wanted any more.
Not here: which worker does it, and which goes on when that dies: Dask decides (`cluster`).
"""

import uuid
from collections.abc import Callable
from typing import Any

from distributed import Event, Future, get_client, get_worker, secede, wait
from distributed.scheduler import KilledWorker

from streamfeat.errors import InputError
from streamfeat.work.cluster import Cluster, check_versions, one_line, versions_here

__all__ = ["Service", "Services", "UnansweredError"]


class UnansweredError(InputError):
    """A worker lost its scheduler and ended its services, which their owner had not ended."""


class Services:
    """Functions that run on workers until they are ended; one whose worker dies begins again on another.

    Args:
        cluster: connected.
        on_told: called from a thread with an service's name, its worker's address and what it told.
    """

    def __init__(self, cluster: Cluster, on_told: Callable[[str, str, dict[str, Any]], None]) -> None:
        """Hear what services tell."""
        self._client, self._versions = cluster.client, cluster.versions
        self._id = f"streamfeat-{uuid.uuid4()}"
        self._futures: dict[str, Future] = {}
        self._end = Event(self._id, client=self._client)
        self._client.subscribe_topic(self._id, lambda event: on_told(*event[1]))

    def begin(self, name: str, function: Callable[..., Any], *values: Any) -> None:
        """Run `function(service, *values)` on some worker, with a `Service`.

        Args:
            name: of the service; one that has begun is not begun again.
            function: of a module; what it returns is told as the last.
            values: small.
        """
        if name not in self._futures:
            given = self._versions, self._id, name, function, *values
            self._futures[name] = self._client.submit(_service, *given, pure=False)

    def check(self) -> dict[str, str]:
        """Why services failed that were not ended, by name.

        Those whose workers all died, or could not reach the scheduler, are begun again.
        """
        failed = {name: future for name, future in self._futures.items() if future.status == "error"}
        found = {}
        for name, future in failed.items():
            try:
                with one_line():
                    future.result()
            except InputError as error:
                found[name] = str(error)
                if isinstance(error, UnansweredError) or isinstance(error.__cause__, KilledWorker):
                    future.retry()
                else:
                    del self._futures[name]
        return found

    def end(self, timeout_s: float = 20.0) -> None:
        """End all services, and wait until they have."""
        with one_line():
            self._end.set()
            with self._client.as_current():
                wait(list(self._futures.values()), timeout=timeout_s)
            self._client.unsubscribe_topic(self._id)


class Service:
    """The view that a service's function has of its run.

    Args:
        run_id: of the services that it is one of.
        name: its own.
    """

    def __init__(self, run_id: str, name: str) -> None:
        """On a worker, in the thread of a task."""
        self._worker = get_worker()
        self._key = self._worker.get_current_task()
        self._id, self._name = run_id, name
        self._end = Event(run_id, client=get_client())
        self.is_unanswered = False
        """It ended because the scheduler did not answer: that may be there again, and take it for done."""

    def is_wanted(self) -> bool:
        """Whether it goes on: neither its owner nor the scheduler has ended it, and neither is lost."""
        task = self._worker.state.tasks.get(self._key)
        if task is None or task.state == "cancelled":
            return False
        try:
            return not self._end.is_set()
        except (OSError, TimeoutError):
            self.is_unanswered = True
            return False

    def tell(self, what: dict[str, Any]) -> None:
        """Tell its owner."""
        self._worker.log_event(self._id, (self._name, self._worker.address, what))


def _service(
    asked: dict[str, str], run_id: str, name: str, function: Callable[..., Any], *values: Any
) -> None:
    check_versions(asked, versions_here(), get_worker().address)
    service = Service(run_id, name)
    secede()  # a worker has room for many: they wait most of the time
    service.tell(function(service, *values))
    if service.is_unanswered:
        raise UnansweredError(f"the scheduler did not answer worker {get_worker().address} for a while")
