"""One real sample of N-Caltech101 beside simulations of images like it.

Lives here: counts by polarity and saccade, the event rate over time, how busy pixels are, and the speed.
Not here: the simulation (`streamfeat.simulate`), and data sets: give your own.

    python tools/compare_simulation.py Faces_easy/image_0001.bin caltech/Faces_easy --images 10

The real sample's own image is not needed: the figures of the simulation are medians over images of its class.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from streamfeat.camera_files.event_files import open_events
from streamfeat.convert.simulation import Scene, simulated_image
from streamfeat.events import Events, Resolution

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
    size = int(real["y"].max()) + 1, int(real["x"].max()) + 1
    one = figures(real, size)
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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sample", type=Path, help="a .bin file of N-Caltech101")
    parser.add_argument("images", type=Path, help="folder with images of its class")
    parser.add_argument("--images", dest="n", type=int, default=10, help="how many of them")
    asked = parser.parse_args()
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
