"""Draw how it works, in one figure: a sample of the recording that comes with the project, step by step.

Lives here: the layout of the figure. What it shows is computed, by an engine that was fed the sample.
Not here: the computation (`streamfeat`).

    python tools/make_figure.py
"""

from collections.abc import Iterable
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import streamfeat as sf
from streamfeat.recordings.reader import Sample

ROOT = Path(__file__).resolve().parent.parent
FIGURE = ROOT / "tools" / "how_it_works.svg"
SAMPLE = 16
SIDE, GAP, TOP, LEFT = 124, 34, 46, 24
WIDTH, HEIGHT = 2 * LEFT + 6 * SIDE + 5 * GAP, 278

STYLE = """
text { font: 12px system-ui, sans-serif; fill: #555c66; }
.name { font-weight: 600; font-size: 14px; fill: #1c2128; }
.paper { fill: #ffffff; stroke: #d5dae0; }
.well { fill: #f1f3f5; stroke: #d5dae0; }
.on { fill: #1f6fd6; } .off { fill: #d8480f; } .heat { fill: #0b7d74; } .best { fill: #1a7f37; }
.rest { fill: #9aa3ad; }
.frame { fill: none; stroke: #1c2128; stroke-width: 1.5; }
.arrow { fill: none; stroke: #555c66; stroke-width: 1.5; }
@media (prefers-color-scheme: dark) {
  text { fill: #a0a8b3; } .name { fill: #eef1f4; }
  .paper { fill: #12161b; stroke: #343b44; } .well { fill: #1b2027; stroke: #343b44; }
  .on { fill: #58a6ff; } .off { fill: #ff8a4c; } .heat { fill: #3fc7bc; } .best { fill: #3fb950; }
  .rest { fill: #6b7480; } .frame { stroke: #eef1f4; } .arrow { stroke: #a0a8b3; }
}
"""


def main() -> None:
    with sf.open_recording(ROOT / "recordings" / "digits_test.mcap") as recording:
        sample = next(s for i, s in enumerate(recording.samples()) if i == SAMPLE)
    encoder = sf.Encoder.load(ROOT / "recordings" / "digits.safetensors")
    classifier = sf.Classifier.load(ROOT / "recordings" / "digits_classifier.safetensors")
    engine = sf.Engine(encoder, sample.resolution, origin_us=sample.label.start_us)
    engine.feed(sample.events)
    features, activity = engine.features(), engine.activity()
    busiest = np.unravel_index(int(activity.argmax()), activity.shape)
    steps = [
        ("events", ["x, y, polarity, time;", "from MCAP or zenoh"], events(sample)),
        (
            "ring of bins",
            ["signed counts of", "each pixel, T slots"],
            bins(engine.counts(), encoder, busiest),
        ),
        ("active volumes", ["the few over a pixel add", "one column per event"], grid(activity, busiest)),
        ("codes", ["of a volume: K numbers,", "few of them not zero"], one_code(engine.codes()[busiest])),
        ("pooled features", ["codes summed in cells,", "exact integers"], cells(features, encoder)),
        ("prediction", ["a linear classifier,", "trained or online"], scores(classifier, features)),
    ]
    parts = [f'<rect class="paper" x="0.5" y="0.5" width="{WIDTH - 1}" height="{HEIGHT - 1}" rx="10"/>']
    for i, (name, lines, drawn) in enumerate(steps):
        x = LEFT + i * (SIDE + GAP)
        parts.append(f'<g transform="translate({x},{TOP})">{text(0, -14, name, "name")}{"".join(drawn)}')
        parts += [text(0, SIDE + 22 + 16 * j, line) for j, line in enumerate(lines)]
        if i:
            parts.append(f'<path class="arrow" d="M{5 - GAP} {SIDE / 2}h{GAP - 10}m-6 -5l6 5l-6 5"/>')
        parts.append("</g>")
    same = (
        "An event changes one count, and the codes of the few volumes over its pixel; a new bin moves all.",
        "What is summed are integers: the features have the same bits as those computed offline.",
    )
    parts += [text(LEFT, HEIGHT - 38 + 18 * i, line) for i, line in enumerate(same)]
    title = "Events become counts in a ring of bins, active volumes, codes, pooled features and a prediction"
    FIGURE.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" '
        f'height="{HEIGHT}" role="img"><title>{title}</title><style>{STYLE}</style>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )
    print(f"{FIGURE.relative_to(ROOT)}: {FIGURE.stat().st_size:,} bytes")


def text(x: float, y: float, line: str, kind: str = "line") -> str:
    return f'<text class="{kind}" x="{x:g}" y="{y:g}">{escape(line)}</text>'


def well(x: float = 0, y: float = 0, side: float = SIDE, height: float | None = None) -> str:
    return f'<rect class="well" x="{x:g}" y="{y:g}" width="{side:g}" height="{height or side:g}"/>'


def frame(x: float, y: float, side: float) -> str:
    return f'<rect class="frame" x="{x:.1f}" y="{y:.1f}" width="{side:.1f}" height="{side:.1f}"/>'


def pixels(kind: str, where: NDArray[np.bool_], step: float, x: float = 0, y: float = 0) -> str:
    """Squares at the places that are true, as one path."""
    d = "".join(
        f"M{x + column * step:.1f} {y + row * step:.1f}h{step:.1f}v{step:.1f}h-{step:.1f}z"
        for row, column in np.argwhere(where).tolist()
    )
    return f'<path class="{kind}" d="{d}"/>' if d else ""


def bars(
    up: NDArray[np.float32], down: NDArray[np.float32], x: float, y: float, width: float, height: float
) -> str:
    """Bars on either side of a middle line, as two paths."""
    step, scale = width / len(up), height / 2 / max(float(up.max()), float(down.max()), 1e-9)
    found = []
    for kind, values, sign in (("on", up, -1), ("off", down, 1)):
        d = "".join(
            f"M{x + i * step:.1f} {y + height / 2:.1f}v{sign * value * scale:.1f}h{0.8 * step:.1f}"
            f"v{-sign * value * scale:.1f}z"
            for i, value in enumerate(values.tolist())
            if value > 0
        )
        found.append(f'<path class="{kind}" d="{d}"/>')
    return "".join(found)


def events(sample: Sample) -> Iterable[str]:
    latest = np.zeros(sample.resolution, np.int8)
    for x, y, p, _ in sample.events[-450:].tolist():
        latest[y, x] = 1 if p > 0 else -1
    step = SIDE / sample.resolution[1]
    return [well(), pixels("on", latest > 0, step), pixels("off", latest < 0, step)]


def bins(counts: NDArray[np.int32], encoder: sf.Encoder, busiest: tuple[int, int]) -> Iterable[str]:
    """The bins one behind the other, the latest in front, and what one volume sees of each."""
    geometry, side = encoder.geometry, SIDE * 0.68
    step, shift = side / counts.shape[2], (SIDE - side) / (len(counts) - 1)
    parts = []
    for i, of_bin in enumerate(counts):
        x = y = shift * i
        parts.append(well(x, y, side))
        parts += [pixels("on", of_bin > 0, step, x, y), pixels("off", of_bin < 0, step, x, y)]
        top, left = (place * geometry.stride * step for place in busiest)
        patch = geometry.patch * step
        parts.append(frame(x + left, y + top, patch))
    return parts


def grid(activity: NDArray[np.int64], busiest: tuple[int, int]) -> Iterable[str]:
    step = SIDE / activity.shape[1]
    strength = np.sqrt(activity / activity.max())
    parts = [well()]
    for (row, column), share in np.ndenumerate(strength):
        parts.append(
            f'<rect class="heat" opacity="{share:.2f}" x="{column * step:.1f}" y="{row * step:.1f}" '
            f'width="{step - 1:.1f}" height="{step - 1:.1f}"/>'
        )
    row, column = busiest
    return [*parts, frame(column * step - 1, row * step - 1, step + 1)]


def one_code(code: NDArray[np.float32]) -> Iterable[str]:
    return [well(), bars(np.maximum(code, 0), np.maximum(-code, 0), 4, 4, SIDE - 8, SIDE - 8)]


def cells(features: NDArray[np.float32], encoder: sf.Encoder) -> Iterable[str]:
    """What is pooled of each cell: positive parts up, negative parts down."""
    side = (SIDE - 4) / 2
    split = features.reshape(4, 2, encoder.n_filters)
    parts = []
    for i, (positive, negative) in enumerate(split):
        x, y = i % 2 * (side + 4), i // 2 * (side + 4)
        parts += [well(x, y, side), bars(positive, negative, x + 2, y + 2, side - 4, side - 4)]
    return parts


def scores(classifier: sf.Classifier, features: NDArray[np.float32]) -> Iterable[str]:
    values = classifier.scores(features)
    low, step = float(values.min()), SIDE / len(values)
    best, parts = int(values.argmax()), [well()]
    for i, (label, value) in enumerate(zip(classifier.labels, values.tolist(), strict=True)):
        length = 4 + (value - low) / (float(values.max()) - low) * (SIDE - 34)
        kind = "best" if i == best else "rest"
        y, height = i * step + 2, step - 4
        parts += [
            f'<rect class="{kind}" x="20" y="{y:.1f}" width="{length:.1f}" height="{height:.1f}"/>',
            text(6, i * step + step - 2.5, label, "name" if i == best else "line"),
        ]
    return parts


if __name__ == "__main__":
    main()
