"""Real samples beside simulations: one of images like its own, or many of the same images.

Lives here: counts by polarity and saccade, the event rate over time, how busy pixels are, and the speed.
Not here: the simulation (`streamfeat.simulate`), and data sets: give your own.

    python tools/compare_simulation.py Faces_easy/image_0001.bin caltech/Faces_easy --images 10
    python tools/compare_simulation.py recorded.mcap simulated.mcap

The first compares one sample with simulations of images of its class, since its own image is not needed; the
second compares samples whose files had the same names (`tools/mnist_pairs.py` makes such), and says how many
recordings have the simulation of their own image nearest, by the counts of pixels.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from streamfeat.camera_files.event_files import open_events
from streamfeat.convert.simulation import Scene, simulated_image
from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution
from streamfeat.recordings.reader import open_recording

Samples = dict[str, tuple[Events, Resolution]]

SACCADE_US, BIN_US = 100_000, 10_000


def figures(events: Events, resolution: Resolution) -> dict[str, float]:
    """Figures of the 300 ms of one sample, by name."""
    height, width = resolution
    saccade = events["t"] // SACCADE_US
    found: dict[str, float] = {"width": width, "height": height, "events": len(events)}
    for name, p in (("ON", 1), ("OFF", 0)):
        for i in range(3):
            found[f"{name}, saccade {i + 1}"] = int(((saccade == i) & (events["p"] == p)).sum())
    place = events["y"].astype(np.int64) * width + events["x"]
    counts = np.bincount(place, minlength=height * width)
    found["share of pixels that fire"] = round(float((counts > 0).mean()), 3)
    found["events of a pixel that fires, median"] = float(np.median(counts[counts > 0]))
    order = np.lexsort((events["t"], place))
    gaps = np.diff(events["t"][order])[np.diff(place[order]) == 0]
    for share in (1, 10, 50):
        found[f"us between events of a pixel, p{share}"] = round(float(np.percentile(gaps, share)))
    return found


def rate(events: Events) -> list[int]:
    """Events of each 10 ms."""
    counted = np.bincount(np.clip(events["t"] // BIN_US, 0, 29), minlength=30)
    return [int(n) for n in counted]


def table(real: Events, simulated: Sequence[tuple[Events, Resolution]]) -> str:
    """Both sides of everything."""
    one = figures(real, size_of(real))
    many = [figures(events, resolution) for events, resolution in simulated]
    lines = [
        f"| | real, 1 sample | simulated, {len(many)} images: median | least to most |",
        "|---|---:|---:|---:|",
    ]
    for name, value in one.items():
        values = [f[name] for f in many]
        spread = f"{min(values):,g} to {max(values):,g}"
        lines.append(f"| {name} | {value:,g} | {np.median(values):,g} | {spread} |")
    rates = np.median([rate(events) for events, _ in simulated], axis=0)
    lines += ["", "| ms | real, events | simulated, median |", "|---:|---:|---:|"]
    lines += [
        f"| {10 * i} | {n:,} | {m:,.0f} |" for i, (n, m) in enumerate(zip(rate(real), rates, strict=True))
    ]
    alike = np.corrcoef(rate(real), rates)[0, 1]
    return "\n".join([*lines, "", f"correlation of the two rates over time: {alike:.3f}"])


def size_of(events: Events) -> Resolution:
    """The smallest sensor that has them all."""
    return int(events["y"].max()) + 1, int(events["x"].max()) + 1


def samples_by_name(path: Path) -> dict[str, tuple[Events, Resolution]]:
    """Samples by the name of their file without its ending, times from 0."""
    found = {}
    with open_recording(path) as recording:
        for sample in recording.samples():
            events = sample.events.copy()
            events["t"] -= sample.label.start_us
            found[Path(sample.label.source).stem] = events, sample.resolution
    return found


def pair_table(real: Samples, simulated: Samples) -> str:
    """Both sides of samples of the same names, and how many are each other's nearest."""
    names = sorted(real.keys() & simulated.keys())
    if not names:
        raise InputError("no sample of the first recording has the name of one of the second")
    ones, others = ([figures(*samples[name]) for name in names] for samples in (real, simulated))
    lines = [
        f"| {len(names)} images, medians | recorded | simulated | ratio of a pair, p25 to p75 |",
        "|---|---:|---:|---:|",
    ]
    for figure in ones[0]:
        a, b = (np.array([one[figure] for one in many]) for many in (ones, others))
        low, high = np.percentile(b / np.maximum(a, 1e-9), (25, 75))
        lines.append(f"| {figure} | {np.median(a):,g} | {np.median(b):,g} | {low:.2f} to {high:.2f} |")
    rates = [np.mean([rate(samples[name][0]) for name in names], axis=0) for samples in (real, simulated)]
    lines += ["", f"correlation of the two mean rates over time: {np.corrcoef(*rates)[0, 1]:.3f}"]
    sides = [[samples[name] for name in names] for samples in (real, simulated)]
    signed = [np.median(np.diag(likeness(*sides, saccade))) for saccade in range(3)]
    alike = likeness(*sides)
    own = float((alike.argmax(axis=1) == np.arange(len(names))).mean())
    lines.append(f"correlation of the counts of pixels, median of pairs: {np.median(np.diag(alike)):.3f}")
    words = ", ".join(f"{one:.3f}" for one in signed)
    lines.append(f"the same of ON less OFF, in each saccade: {words} (below 0: polarities are turned around)")
    return "\n".join([*lines, f"recordings nearest to their own image's simulation: {own:.3f}"])


def likeness(
    real: Sequence[tuple[Events, Resolution]],
    simulated: Sequence[tuple[Events, Resolution]],
    saccade: int | None = None,
) -> NDArray[np.float64]:
    """Correlation `(n, m)` of the counts of pixels, both polarities alike; or of ON less OFF in a saccade."""
    height, width = np.max([size for _, size in [*real, *simulated]], axis=0)

    def standard(samples: Sequence[tuple[Events, Resolution]]) -> NDArray[np.float64]:
        counts = np.zeros((len(samples), height * width))
        for row, (events, _) in zip(counts, samples, strict=True):
            place, sign = events["y"].astype(np.int64) * width + events["x"], np.ones(len(events))
            if saccade is not None:
                sign = (events["t"] // SACCADE_US == saccade) * (2.0 * events["p"] - 1)
            row += np.bincount(place, sign, height * width)
        counts -= counts.mean(axis=1, keepdims=True)
        return counts / np.maximum(np.linalg.norm(counts, axis=1, keepdims=True), 1e-12)

    return standard(real) @ standard(simulated).T


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sample", type=Path, help="a .bin file of N-Caltech101, or a recording")
    parser.add_argument("images", type=Path, help="folder with images of its class, or a recording")
    parser.add_argument("--images", dest="n", type=int, default=10, help="how many images of a folder")
    asked = parser.parse_args()
    if asked.images.suffix == ".mcap":
        print(pair_table(samples_by_name(asked.sample), samples_by_name(asked.images)))
        return
    paths = sorted(asked.images.iterdir())[: asked.n]
    simulated_image(paths[0], "", Scene())  # compiles
    began, of_processor = time.perf_counter(), time.process_time()
    simulated = [simulated_image(path, f"{path.parent.name}/{path.name}", Scene()) for path in paths]
    took, of_processor = time.perf_counter() - began, time.process_time() - of_processor
    print(table(np.concatenate([*open_events(asked.sample)]), simulated))
    rates = (
        f"{len(paths) / of_processor:.1f} images a second of one core, {len(paths) / took:.1f} of the clock"
    )
    print(f"\nspeed, reading included: {rates}")


if __name__ == "__main__":
    main()
