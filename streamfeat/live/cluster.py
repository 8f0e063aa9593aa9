"""The main job on live topics, on the workers of a cluster: each camera on one of them.

Lives here: which cameras there are, what runs on a worker, and the sum of what all workers have done.
Not here: which worker serves a camera, and which takes over when that dies (`work.services`). zenoh brings
the data straight to the worker.
"""

import contextlib
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote

from streamfeat.live.listen import ListenJob
from streamfeat.live.names import Names
from streamfeat.live.network import THIS_MACHINE, Network, TopicWatch
from streamfeat.live.topic import MAX_TOPICS
from streamfeat.work.cluster import Cluster
from streamfeat.work.services import Service, Services

__all__ = ["ClusterListen", "ServedCamera"]

_TOLD_EVERY_S = 0.25
_CHECK_EVERY_S = 0.5
_COUNTS = ("packets", "events", "emissions", "samples", "lost", "dropped", "incomplete")


@dataclass(slots=True)
class ServedCamera:
    """One camera, as far as its workers have told.

    Attributes:
        worker: address of the one that serves it now; empty if none has begun.
        starts: how often a worker has begun to serve it.
        past: counts of the workers before.
        now: counts of this one, a quarter of a second old at most.
        missed: packets published between the last that a dead worker told of and the first that the next one
            heard; the dead one may have read some of them without telling. A worker that goes on from a state
            counts them as lost.
        first_unheard: packets that were published before the first worker heard any.
    """

    worker: str = ""
    starts: int = 0
    past: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_COUNTS, 0))
    now: dict[str, int] = field(default_factory=dict)
    missed: int = 0
    first_unheard: int = 0
    _has_gone_on: bool = False

    def hear(self, worker: str, told: dict[str, Any]) -> None:
        """Take in what a worker tells: when it begins what it goes on from, then what it has done."""
        if told.get("begins"):
            self.worker, self.starts, self._has_gone_on = worker, self.starts + 1, False
            if self.starts == 1:
                self.first_unheard = _reached(told)
            if _reached(told) <= self._known():
                # What a state has kept, the worker before has told already, or an earlier run has done.
                self.past = {name: n - told.get(name, 0) for name, n in self.counts().items()}
            self.now = told
        elif worker == self.worker:  # and not one that was given up, and has not noticed
            self.now, before = told, self.now
            if not self._has_gone_on and told["packets"] > before.get("packets", 0):
                self._has_gone_on = True
                self._close_gap(is_new=not before.get("packets"))

    def _close_gap(self, *, is_new: bool) -> None:
        """Count the packets that no worker has, when one hears its first packet."""
        gap = _reached(self.now) - self._known()
        if not is_new:
            # Since its state was kept, the worker before has read what this one takes for lost.
            self.past["lost"] += min(gap, 0)
        elif self.starts == 1:
            self.first_unheard = gap
        self.missed += max(gap, 0) if self.starts > 1 else 0

    def _known(self) -> int:
        return _reached(self.counts()) + self.missed + self.first_unheard

    def counts(self) -> dict[str, int]:
        """All workers together."""
        return {name: self.past[name] + self.now.get(name, 0) for name in _COUNTS}


def _reached(counts: dict[str, Any]) -> int:
    """How many packets were published until then, as far as these counts tell."""
    return sum(counts.get(name, 0) for name in ("packets", "unheard", "lost", "dropped"))


class ClusterListen:
    """Listens on topics, each on some worker, until `stop` or a signal.

    The files that are named here are sent to the workers with their contents.

    Args:
        names: of the topics. Those that a wildcard means are found by their publishers' tokens.
        cluster: the workers.
        model: of the encoder.
        classifier: to predict with; none for features alone.
        network: where to listen, in this process and on the workers; without a configuration file, each
            machine alone.
        state: folder on the workers, best one that all of them see, for what a camera needs to go on after
            its worker died; without it the next worker begins anew, and says what is incomplete.
        say: told about workers, cameras and failures, in lines.
        options: of `ListenJob`.

    Raises:
        InputError: as of `ListenJob`.
    """

    def __init__(
        self,
        names: Names,
        cluster: Cluster,
        model: Path,
        classifier: Path | None = None,
        *,
        network: Network = THIS_MACHINE,
        state: Path | None = None,
        say: Callable[[str], None] = lambda line: None,
        **options: Any,
    ) -> None:
        """Check everything but the network."""
        given = {"model": model, "classifier": classifier, "zenoh": network.config}
        ListenJob(names, model, classifier, network=network, **options)
        self._names, self._cluster, self._say = names, cluster, say
        # zenoh goes by the ending of the name.
        self._files = {
            name: (f"{name}{path.suffix}", path.read_bytes()) for name, path in given.items() if path
        }
        self._options = {"joins_late": True, **options}
        self._network, self._state = network, state
        self._stopped = threading.Event()
        self._lock = threading.Lock()
        self.cameras: dict[str, ServedCamera] = {}
        self.interrupted = False

    def run(self) -> None:
        """Serve until `stop`, SIGINT or SIGTERM.

        Raises:
            InputError: the network or the cluster cannot be used.
        """
        services = Services(self._cluster, self._on_told)

        def serve(topic: str) -> None:
            with self._lock:
                if topic in self.cameras:
                    return
                if len(self.cameras) < MAX_TOPICS:
                    self.cameras[topic] = ServedCamera()
            if topic not in self.cameras:
                self._say(f"{topic}: not served, {MAX_TOPICS} cameras are")
            else:
                services.begin(
                    topic,
                    _serve,
                    self._names.only(topic),
                    self._files,
                    self._network,
                    self._options,
                    self._state,
                )

        with contextlib.ExitStack() as stack:
            stack.callback(services.end)
            if "*" in self._names.expression:
                session = stack.enter_context(self._network.open())
                stack.enter_context(TopicWatch(session, self._names, serve))
            else:
                serve(self._names.expression)
            try:
                while not self._stopped.wait(_CHECK_EVERY_S):
                    for topic, reason in services.check().items():
                        self._say(f"{topic}: {reason}")
            except KeyboardInterrupt:
                self.interrupted = True

    def stop(self) -> None:
        """End it; may be called from any thread."""
        self._stopped.set()

    def result(self) -> dict[str, Any]:
        """What happened, as JSON values."""
        with self._lock:
            cameras = {topic: (served, served.counts()) for topic, served in self.cameras.items()}
        totals = {name: sum(counts[name] for _, counts in cameras.values()) for name in _COUNTS}
        return {
            "cameras": len(cameras),
            **totals,
            "missed": sum(served.missed for served, _ in cameras.values()),
            "unheard": sum(served.first_unheard for served, _ in cameras.values()),
            "restarts": sum(max(0, served.starts - 1) for served, _ in cameras.values()),
            "interrupted": self.interrupted,
            "of_each": {
                topic: counts
                | {"worker": served.worker, "starts": served.starts}
                | {"missed": served.missed, "unheard": served.first_unheard}
                for topic, (served, counts) in sorted(cameras.items())
            },
        }

    def _on_told(self, topic: str, worker: str, told: dict[str, Any]) -> None:
        with self._lock:
            served = self.cameras[topic]
            served.hear(worker, told)
        if told.get("begins"):
            self._say(f"{topic}: {'again ' if served.starts > 1 else ''}on worker {worker}")


def _serve(
    service: Service,
    names: Names,
    files: dict[str, tuple[str, bytes]],
    network: Network,
    options: dict[str, Any],
    state: Path | None,
) -> dict[str, Any]:
    """Listen on one topic on a worker until the service ends, and return what was done."""
    with tempfile.TemporaryDirectory(prefix="streamfeat-") as folder:
        given: dict[str, Any] = {**options}
        for argument, (name, content) in files.items():
            given[argument] = Path(folder, name)
            given[argument].write_bytes(content)
        given["network"] = replace(network, config=given.pop("zenoh", None))
        if state:
            state.mkdir(parents=True, exist_ok=True)
            given["state"] = state / quote(names.expression, safe="")
        job = ListenJob(names, **given)
        service.tell({"begins": True, **job.result()})
        with _Telling(service, job):
            job.run()
        return job.result()


class _Telling:
    """Tells what a job has done so far, and stops it when its service ends; a context manager."""

    def __init__(self, service: Service, job: ListenJob) -> None:
        self._service, self._job = service, job
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="telling", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(_TOLD_EVERY_S):
            if not self._service.is_wanted():
                self._job.stop()
                return
            self._service.tell(self._job.result())
