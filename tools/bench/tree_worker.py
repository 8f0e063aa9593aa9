"""What is measured in a tree of this project, this one or an earlier one: a task a line, a result a line.

Lives here: tasks as they can be done with either version, so nothing of `tools` is imported.
Not here: the tasks' streams (`camera_streams`), taking turns (`trees`).

Names that moved are looked for in both places. What is timed is the clock and the processor time of the
process, seconds.
"""

import gc
import hashlib
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

EMIT_US = 10_000


class Watch:
    """Seconds of the clock and of the processor, added up by name."""

    def __init__(self) -> None:
        self.spent: dict[str, list[float]] = {}

    def time(self, name: str, work: Callable[[], Any]) -> Any:
        """Do some work, and add what it took."""
        clock, processor = time.perf_counter(), time.process_time()
        done = work()
        both = self.spent.setdefault(name, [0.0, 0.0])
        both[1] += time.process_time() - processor
        both[0] += time.perf_counter() - clock
        return done

    def result(self, name: str) -> dict[str, float]:
        """`clock` and `processor` of a name."""
        clock, processor = self.spent.get(name, (0.0, 0.0))
        return {"clock": clock, "processor": processor}


def make_model(task: dict[str, Any]) -> dict[str, Any]:
    """Write a direct model, and an untrained classifier for it where one is asked for.

    The state is narrow where that is asked for and the version has one.
    Filters are random; or an inverse model is made of the `arrays` of one that was learned.
    """
    import numpy as np

    import streamfeat as sf

    geometry = sf.Geometry(**task["geometry"])
    if "arrays" in task:
        with np.load(task["arrays"]) as file:
            arrays = {name: file[name] for name in ("filters", "whitening", "mean")}
            numbers = {name: float(file[name]) for name in ("threshold", "eps", "gap")}
        kind = {"formulation": "inverse", "encoding": "soft"} | numbers
    else:
        filters = np.random.default_rng(0).standard_normal((task["filters"], geometry.entries))
        filters /= np.linalg.norm(filters, axis=1, keepdims=True)
        eye, zeros = np.eye(geometry.entries, dtype=np.float32), np.zeros(geometry.entries, np.float32)
        arrays = {"filters": filters.astype(np.float32), "whitening": eye, "mean": zeros}
        kind = {"formulation": "direct", "encoding": "split", "threshold": 1.0}
    if task.get("narrow") and hasattr(sf.Encoder, "is_narrow"):
        kind["narrow"] = True
    encoder = sf.Encoder.build(geometry, **kind, **arrays)
    encoder.save(task["model"])
    if "classifier" in task:
        sf.Classifier.untrained(["a", "b"], encoder).save(task["classifier"])
    return {}


def emissions(task: dict[str, Any]) -> dict[str, Any]:
    """Feed a stream and read features every 10 ms: seconds of each kind of work, per emission.

    With `steps`, the kernels of an emission are called one by one, to see what each takes.
    """
    import numpy as np

    import streamfeat as sf

    encoder, resolution = sf.Encoder.load(Path(task["model"])), tuple(task["resolution"])
    with np.load(task["stream"]) as file:
        events, starts = file["events"], file["starts"]
    options = {"threads": task["threads"]} if task.get("threads", 1) > 1 else {}
    engine = sf.Engine(encoder, resolution, **options)
    engine.feed(events[:1000])
    engine.features()
    engine = sf.Engine(encoder, resolution, **options)
    watch, digest, n = Watch(), hashlib.sha256(), 0
    edges = [*starts[1:].tolist(), int(events["t"][-1]) // EMIT_US * EMIT_US + EMIT_US]
    warm = 0 if len(starts) > 1 else task.get("warm", 10)
    for first, last in zip(starts.tolist(), edges, strict=True):
        engine.restart(first)
        for start in range(first, last, EMIT_US):
            if n == warm:
                watch.spent.clear()
            part = events[slice(*np.searchsorted(events["t"], [start, start + EMIT_US]))]
            watch.time("feed", lambda part=part: engine.feed(part))
            engine.advance(start + EMIT_US - 1)
            if task.get("steps"):
                features = _in_steps(engine, watch)
            else:
                features = watch.time("features", engine.features)
            digest.update(features.tobytes())
            n += 1
    names = list(watch.spent)
    found: dict[str, Any] = {name: watch.result(name) for name in names}
    return found | {"emissions": n - warm, "digest": digest.hexdigest()}


def _in_steps(engine: Any, watch: Watch) -> Any:
    """An emission of one thread, kernel by kernel: `boundary`, `renewing` and `marking`."""
    from streamfeat.kernels import planes, update

    operator, state, shape = engine._operator, engine._state, engine.grid_shape
    if hasattr(operator, "shape"):
        watch.time("marking", lambda: update.mark_dirty(operator, state))
        watch.time("renewing", lambda: update.renew(update.FIRST, update.ALONE, operator, state))
        watch.time("marking", lambda: update.settle(state))
        watch.time("boundary", lambda: planes.fill_plane(operator, state))
    else:
        watch.time("marking", lambda: update.mark_dirty(shape, operator, state))
        for part in range(2):
            watch.time("renewing", lambda part=part: update.renew(part, shape, operator, state))
        watch.time("marking", lambda: update.settle(operator, state))
        for part in range(2):
            watch.time("boundary", lambda part=part: planes.complete(part, shape, operator, state))
        watch.time("boundary", lambda: update.finish(shape, state))
    return engine.features()


def replay(task: dict[str, Any]) -> dict[str, Any]:
    """A whole replay of a recording in this process, from opening to the last emission."""
    try:
        from streamfeat.stream.replay import ReplayJob as Job
    except ImportError:
        from streamfeat.replay import Replay as Job

    options = {"threads": task["threads"]} if task.get("threads") else {}
    classifier = Path(task["classifier"]) if task.get("classifier") else None
    watch, found = Watch(), {}

    def whole() -> None:
        job = Job(Path(task["recording"]), Path(task["model"]), classifier, emit=task["emit"], **options)
        job.run()
        found.update(job.result())

    watch.time("replay", whole)
    return watch.result("replay") | {"events": found["events"], "emissions": found["emissions"]}


def follow(task: dict[str, Any]) -> dict[str, Any]:
    """Follow a burst there and back, again and again: seconds an event, the median."""
    import numpy as np

    import streamfeat as sf

    encoder = sf.Encoder.load(Path(task["model"]))
    with np.load(task["burst"]) as file:
        before, burst, origin = file["before"], file["burst"], int(file["origin"])
    engine = sf.Engine(encoder, tuple(task["resolution"]), origin_us=origin)
    engine.feed(before)
    engine.advance(int(burst["t"].max()))
    engine.features()
    engine.follow(burst)
    taken = []
    for _ in range(task["repeats"]):
        clock, processor = time.perf_counter(), time.thread_time()
        engine.follow(burst)
        taken.append((time.perf_counter() - clock, time.thread_time() - processor))
    clock_s, processor_s = np.median(taken, axis=0) / len(burst)
    return {"clock": float(clock_s), "processor": float(processor_s)}


TASKS: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "model": make_model,
    "emissions": emissions,
    "replay": replay,
    "follow": follow,
}


def compile_kernels() -> None:
    """Compile as a command does before its first packet, where the version has a way to."""
    try:
        from streamfeat.stream.compiling import STATES, compile_together
    except ImportError:
        return
    for state in STATES:
        compile_together(state)


def main() -> None:
    """Do tasks until there are no more."""
    if "compile" in sys.argv[1:]:
        compile_kernels()
    for line in sys.stdin:
        task = json.loads(line)
        gc.collect()
        try:
            result = TASKS[task["do"]](task)
        except Exception as error:  # of either version; the row says it
            result = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
