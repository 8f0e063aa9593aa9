"""Every goal of real time with what is seen of it: this version against an earlier one that lies beside it.

    python -m tools.bench.goals ../streamfeat-before --samples ../shared/data/samples --recording ncars.mcap
    python -m tools.bench.goals ../streamfeat-before ... --only features,replay --rounds 3

Versions take turns, each in a process of its own; ratios are taken inside a round. What is left out is a row
with the reason. Each row has processor time first and the time of the clock behind it: on a machine that
others use, the first is the one to go by, but for threads.

Lives here: the rows and their goals. Not here: tasks (`tree_worker`), streams (`camera_streams`).
"""

import argparse
import importlib.util
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import streamfeat as sf
from streamfeat.latency.update import walk
from streamfeat.recordings.reader import Packet
from tools.bench import material
from tools.bench.camera_streams import CAMERAS, EMIT_US, CameraStream, at_rate, sampled
from tools.bench.ingest import measure_ingest
from tools.bench.inverse import GAP
from tools.bench.trees import ROOT, Tree, TreeError, compared, pair

__all__ = ["ROWS", "Bench", "Row", "main"]

RATES = (0.4e6, 1e6, 3e6, 9e6, 27e6)
"""Events a second of the 346x260 camera, for boundaries."""

K = 400


@dataclass(frozen=True)
class Row:
    """One goal: the figure, the bound, what was seen (or why not), and whether it is met (None: not seen)."""

    figure: str
    goal: str
    seen: str
    met: bool | None = None


@dataclass
class Bench:
    """What rows are measured with.

    Attributes:
        trees: `before` and `now`.
        samples: folder of camera samples.
        recording: labelled crops.
        folder: for models and streams.
        rounds: of each comparison.
        emissions: of each stream, every 10 ms.
    """

    trees: dict[str, Tree]
    samples: Path
    recording: Path
    folder: Path
    rounds: int
    emissions: int

    def model(self, name: str, by: str = "before", **task: Any) -> Path:
        """A model of the default geometry made by one of the versions, once."""
        path = self.folder / f"{name}-{by}.safetensors"
        if not path.exists():
            self.trees[by].do(do="model", model=path, **task)
        return path

    def camera(self, stream: CameraStream, k: int = K) -> dict[str, Any]:
        """Fields of a task for a stream: events, and a model that both versions read."""
        path = self.folder / f"{stream.name}.npz"
        if not path.exists():
            sampled(stream, self.samples, self.recording, self.emissions).save(path)
        geometry = {"stride": stream.stride, "downsample": stream.downsample}
        model = self.model(f"{stream.name}-{k}", geometry=geometry, filters=k)
        return {"do": "emissions", "stream": path, "model": model, "resolution": stream.resolution}

    def narrow_model(self, name: str) -> Path:
        """A model of the narrow state for a camera, which this version alone can read."""
        geometry = {"stride": CAMERAS[name].stride, "downsample": CAMERAS[name].downsample}
        return self.model(f"{name}-narrow", "now", geometry=geometry, filters=K, narrow=True)

    def recorded(self, name: str, emissions: int) -> Path:
        """The events of a stream as `mono` packets in an MCAP file."""
        path = self.folder / f"{name}.mcap"
        if not path.exists():
            stream = sampled(CAMERAS[name], self.samples, self.recording, emissions)
            with sf.RecordingWriter(path, compression="lz4") as writer:
                for part in np.array_split(stream.events, max(1, len(stream.events) // 20_000)):
                    writer.write_events(part, CAMERAS[name].resolution)
        return path


def features(bench: Bench) -> Iterator[Row]:
    """`features()` every 10 ms."""
    for name, goal in {"DAVIS": 4.0, "VGA": 4.0, "HD": 3.5, "N-CARS": 2.5}.items():
        task = bench.camera(CAMERAS[name])
        tasks = {"before": task, "now": task, "now, narrow": task | {"model": bench.narrow_model(name)}}
        found = compared(bench.trees, bench.rounds, tasks)
        digests = {result["digest"] for name in ("before", "now") for result in found[name]}
        bits = "same bits" if len(digests) == 1 else "BITS DIFFER"
        yield _ratio(
            f"`features()` every 10 ms, {name}", goal, found, "features.", f", {bits}", len(digests) == 1
        )
        narrow = {"before": found["before"], "now": found["now, narrow"]}
        yield _ratio(f"the same with a model of the narrow state, {name}", goal, narrow, "features.")


def replays(bench: Bench) -> Iterator[Row]:
    """Whole replays, one thread and two."""
    for name, goal in {"DAVIS": 3.5, "VGA": 2.5, "HD": 2.7}.items():
        model = bench.camera(CAMERAS[name])["model"]
        path = bench.recorded(name, 200 if name == "DAVIS" else 50)
        task = {"do": "replay", "recording": path, "model": model, "emit": "10ms"}
        alone = task | {"threads": 1}
        narrow = alone | {"model": bench.narrow_model(name)}
        tasks = {"before": task, "now": alone, "now, two": task | {"threads": 2}, "now, narrow": narrow}
        found = compared(bench.trees, bench.rounds, tasks)
        yield _ratio(f"whole `replay --emit 10ms`, one thread, {name}", goal, found, "")
        narrow_found = {"before": found["before"], "now": found["now, narrow"]}
        yield _ratio(f"the same with a model of the narrow state, {name}", goal, narrow_found, "")
        if name != "DAVIS":
            both = pair(found, "clock", "now", "now, two").ratio
            spent = pair(found, "processor", "now, two", "now").ratio
            yield Row(
                f"the same with `--threads 2`, {name}",
                "1.6x more",
                f"{_times(both)} by the clock, for {spent['p50']:.2f} times the processor",
                both["p50"] >= 1.6,
            )


def single_events(bench: Bench) -> Iterator[Row]:
    """Updates of one event, with the model that each version makes by itself."""
    events = material.Material(bench.recording)
    for k in (400, 1700):
        geometry = sf.Geometry(stride=4)
        burst = events.burst(geometry, 2000)
        task = _burst(bench, "follow", burst) | {"repeats": 20}
        tasks = {
            name: task
            | {"model": bench.model(f"own-{k}", name, geometry={"stride": 4}, filters=k, narrow=True)}
            for name in ("before", "now")
        }
        found = compared(bench.trees, bench.rounds, tasks)
        yield _ratio(f"update of one event, K = {k}", 1.8, found, "", f"; {_micro(found)}")


def classified(bench: Bench) -> Iterator[Row]:
    """The whole job `--emit event` with a classifier."""
    path, classifier = bench.folder / "some.mcap", bench.folder / "classifier"
    if not path.exists():
        with sf.open_recording(bench.recording) as recording, sf.RecordingWriter(path) as writer:
            events = 0
            for item in recording.items():
                if not isinstance(item, Packet):
                    writer.write_label(item)
                elif events < 60_000:
                    writer.write_events(item.events, item.resolution)
                    events += len(item.events)
                else:
                    break
    model = bench.model("classified", geometry={"stride": 4}, filters=K, classifier=classifier)
    task = {"do": "replay", "recording": path, "model": model, "classifier": classifier, "emit": "event"}
    found = compared(bench.trees, bench.rounds, {"before": task, "now": task | {"threads": 1}})
    n = found["now"][0]["events"]
    per_event = f"; {_micro(found, n)}"
    yield _ratio("`replay --emit event` with a classifier, whole job", 3.0, found, "", per_event)


def boundaries(bench: Bench) -> Iterator[Row]:
    """What a boundary takes, from few events a second to many, on the 346x260 camera."""
    stream, taken = CAMERAS["DAVIS"], []
    model = bench.camera(stream)["model"]
    for rate in RATES:
        path = bench.folder / f"rate-{rate:g}.npz"
        if not path.exists():
            at_rate(bench.samples, rate, 30).save(path)
        task = {"do": "emissions", "stream": path, "model": model, "resolution": stream.resolution}
        results = [bench.trees["now"].do(**task, steps=True) for _ in range(bench.rounds)]
        crossed = results[0]["emissions"] * EMIT_US / sf.Geometry().bin_us
        taken.append(float(np.median([r["boundary"]["processor"] for r in results])) / crossed)
    shown = ", ".join(f"{ms * 1e3:.2f}" for ms in taken)
    growth = max(taken) / min(taken)
    yield Row(
        "a boundary, 346x260, 0.4, 1, 3, 9, 27 M events/s",
        "grows by at most 2x",
        f"{growth:.2f}x: {shown} ms of the processor",
        growth <= 2,
    )


def ingest(bench: Bench) -> Iterator[Row]:
    """Counting events against eventcv's voxel grid."""
    if not importlib.util.find_spec("eventcv"):
        yield Row("ingest over eventcv voxel", ">= 0.45x", "left out: pip install eventcv")
        return
    ratio = measure_ingest(_setting(bench))["over_ours"]["eventcv voxel"]
    yield Row("ingest over eventcv voxel", ">= 0.45x", _times(ratio), ratio["p50"] >= 0.45)


def inverse(bench: Bench) -> Iterator[Row]:
    """The lasso at K = 1,700."""
    setting = _setting(bench)
    geometry = setting.geometry(stride=4)
    encoder = material.encoder_of(setting, geometry, 1700, "inverse", "soft")
    arrays = bench.folder / "inverse.npz"
    fields = {name: getattr(encoder, name) for name in ("filters", "whitening", "mean", "threshold")}
    np.savez(arrays, **fields, eps=encoder.operator.eps, gap=GAP)
    usual = sf.Geometry()  # only what differs from it: the version before has fewer fields
    shape = {name: getattr(geometry, name) for name in geometry.__dataclass_fields__}
    shape = {name: value for name, value in shape.items() if value != getattr(usual, name)}
    model = bench.model("inverse", geometry=shape, arrays=arrays)
    task = _burst(bench, "inverse", setting.material.burst(geometry, 60)) | {"model": model, "repeats": 3}
    found = compared(bench.trees, bench.rounds, {"before": task, "now": task})
    yield _ratio("inverse, K = 1700, lambda0 = 1", 1.5, found, "", f"; {_micro(found)}")


def tails(bench: Bench) -> Iterator[Row]:
    """Percentiles of single events with boundaries, looking ahead."""
    for name, source in (("N-CARS", bench.recording), ("DAVIS, stride 4", bench.recorded("DAVIS", 200))):
        encoder = sf.Encoder.load(bench.model("own-400", "now", geometry={"stride": 4}, filters=K))
        items, left = [], 125_000
        with sf.open_recording(source) as recording:
            for item in recording.items():
                items.append(item)
                left -= len(item.events) if isinstance(item, Packet) else 0
                if left < 0:
                    break
        runs = [walk(encoder, items, look_ahead=True, warm_up=5000).ns for _ in range(max(3, bench.rounds))]
        p50, p999 = np.percentile(np.median(np.stack(runs), axis=0), [50, 99.9])
        yield Row(
            f"p99.9 over p50 of one event with boundaries, {name}",
            "<= 8x",
            f"{p999 / p50:.1f}x: {p50 / 1e3:.2f} and {p999 / 1e3:.1f} us, each event's median of runs",
            p999 <= 8 * p50,
        )


ROWS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    "features": features,
    "replay": replays,
    "update": single_events,
    "classifier": classified,
    "boundary": boundaries,
    "ingest": ingest,
    "inverse": inverse,
    "tail": tails,
}


def _setting(bench: Bench) -> material.Setting:
    events = material.Material(bench.recording)
    return material.Setting(events, False, 1700, 7, material.DEFAULT_MODELS, lambda text: None)


def _burst(bench: Bench, name: str, burst: material.Burst) -> dict[str, Any]:
    path = bench.folder / f"{name}-burst.npz"
    np.savez(path, before=burst.before, burst=burst.there_and_back, origin=burst.origin_us)
    return {"do": "follow", "burst": path, "resolution": burst.resolution}


def _ratio(
    figure: str, goal: float, found: dict[str, Any], what: str, more: str = "", good: bool = True
) -> Row:
    processor = pair(found, f"{what}processor").ratio
    clock = pair(found, f"{what}clock").ratio
    seen = f"{_times(processor)}, by the clock {clock['p50']:.2f}x{more}"
    return Row(figure, f">= {goal:g}x", seen, good and processor["p50"] >= goal)


def _times(figure: dict[str, float]) -> str:
    return f"{figure['p50']:.2f}x ({figure['p10']:.2f} to {figure['p90']:.2f})"


def _micro(found: dict[str, Any], n: int = 1) -> str:
    both = pair(found, "processor")
    return " to ".join(f"{1e6 * np.median(seconds) / n:.2f}" for seconds in (both.before, both.now)) + " us"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench.goals",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("before", type=Path, help="checkout of the version to compare with")
    parser.add_argument("--samples", type=Path, required=True, help="folder of the camera samples")
    parser.add_argument("--recording", type=Path, required=True, help="labelled crops, N-CARS")
    parser.add_argument("--only", default=",".join(ROWS), help="of " + ", ".join(ROWS))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--emissions", type=int, default=40, help="of each stream (default: %(default)s)")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.only.split(",") if name not in ROWS]
    if unknown:
        parser.error(f"--only {','.join(unknown)}: rows are {', '.join(ROWS)}")
    trees = {"before": Tree(options.before, anew=True), "now": Tree(ROOT, anew=True)}
    print(f"load of the machine {os.getloadavg()[0]:.1f}\n\n| figure | goal | seen | |\n|---|---:|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(
            trees, options.samples, options.recording, Path(folder), options.rounds, options.emissions
        )
        try:
            for name in options.only.split(","):
                _print_rows(bench, name)
        finally:
            for tree in trees.values():
                tree.close()
    print(f"\nload of the machine {os.getloadavg()[0]:.1f}")
    return 0


def _print_rows(bench: Bench, name: str) -> None:
    try:
        for row in ROWS[name](bench):
            verdict = {True: "met", False: "missed", None: ""}[row.met]
            print(f"| {row.figure} | {row.goal} | {row.seen} | {verdict} |", flush=True)
    except (TreeError, sf.InputError, OSError) as error:
        print(f"| {name} | | left out: {error} | |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
