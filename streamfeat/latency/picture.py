"""Pictures of a latency report: an interactive page, or a static one.

Lives here: percentile curves, latency over stream time.
Not here: measuring (`measure`), numbers as text (`text`), the skeleton of a page (`streamfeat.report`).
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.files.atomic import write_atomically
from streamfeat.latency.measure import LatencyReport, Row
from streamfeat.latency.text import COLUMNS, cells, describe, notes
from streamfeat.latency.update import Walk
from streamfeat.report.pages import Folded, Section, Table, require, write_report

if TYPE_CHECKING:
    from bokeh.plotting import figure

__all__ = ["check_picture", "draw"]

_LIBRARIES = {".html": "bokeh", ".png": "matplotlib"}
_MOST_POINTS = 6_000
_LONGEST_SILENCE_US = 100_000
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a8f98", "#b5a642")
_DASHES = {
    "update": "solid",
    "bin boundary": "dotted",
    "from Python": "dashdot",
    "ingest": "dotted",
    "emission": "solid",
    "end to end": "dashed",
}
_MATPLOTLIB_DASHES = {"solid": "-", "dotted": ":", "dashed": "--", "dashdot": "-."}
_TICKS = {1: "0 %", 10: "90 %", 100: "99 %", 1_000: "99.9 %", 10_000: "99.99 %", 100_000: "99.999 %"}
_PERCENTILE_AXIS = "percentile"
_LATENCY_AXIS = "latency, µs"
_TIME_AXIS = "stream time, s (silence left out)"

_Line = tuple[str, str, str, NDArray[np.float64], NDArray[np.float64]]


def check_picture(path: Path) -> None:
    """Check that a picture of this name can be drawn.

    Raises:
        InputError: its ending is neither .html nor .png, or the extra `plot` is missing.
    """
    if path.suffix not in _LIBRARIES:
        raise InputError(f"{path}: --plot can draw .html and .png; give a name that ends in one of them")
    require(_LIBRARIES[path.suffix])


def draw(path: Path, report: LatencyReport) -> None:
    """Draw all rows; the file appears whole or not at all, and replaces an earlier one.

    Raises:
        InputError: see `check_picture`; or the folder cannot be written to.
    """
    check_picture(path)
    if path.suffix == ".html":
        _draw_page(path, report)
    else:
        _draw_image(path, report)


def _name(row: Row, several: bool) -> str:
    return f"{row.model.name}, {row.emit}, {row.what}" if several else f"{row.emit}, {row.what}"


def _lines(report: LatencyReport) -> list[_Line]:
    """Name, colour, dash and points (percentile axis, microseconds) of each curve.

    A colour stands for a model and a policy, a dash for what was measured.
    """
    several = len({row.model.name for row in report.rows}) > 1
    lines: list[_Line] = []
    colours: dict[tuple[str, str], str] = {}
    for row in report.rows:
        if row.latencies.n:
            beyond, ns = row.latencies.curve()
            # The last step has no end; drawn a little on, it can be seen.
            beyond, ns = np.append(beyond, 1.5 * beyond[-1]), np.append(ns, ns[-1])
            colour = colours.setdefault((row.model.name, row.emit), _COLOURS[len(colours) % len(_COLOURS)])
            lines.append((_name(row, several), colour, _DASHES[row.what], beyond, ns / 1000))
    return lines


def _walks(report: LatencyReport) -> list[tuple[str, Walk]]:
    """Caption and content of each cloud of events."""
    return [
        (f"{describe(row.model)}; of {len(row.walk.ns):,} events the slowest, and some others", row.walk)
        for row in report.rows
        if row.walk and len(row.walk.ns)
    ]


def _points(
    walk: Walk,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Seconds of stream time, microseconds and whether a bin began, of as many events as one can see.

    Events that began a bin and the slowest are all kept, of the others every n-th.
    """
    steps = np.clip(np.diff(walk.t_us, prepend=walk.t_us[:1]), 0, _LONGEST_SILENCE_US)
    seconds = np.cumsum(steps) / 1e6
    keep = np.zeros(len(walk.ns), np.bool_)
    keep[:: -(-len(walk.ns) // (_MOST_POINTS // 2))] = True
    keep[np.argsort(walk.ns)[-_MOST_POINTS // 4 :]] = True
    keep[np.flatnonzero(walk.begins_bin)[: _MOST_POINTS // 4]] = True
    return seconds[keep], walk.ns[keep] / 1000, walk.begins_bin[keep]


def _draw_page(path: Path, report: LatencyReport) -> None:
    numeric = [False, False] + [True] * (len(COLUMNS) - 2)
    figures: list[Any] = []
    for model in dict.fromkeys(row.model.name for row in report.rows):
        rows = [row for row in report.rows if row.model.name == model]
        figures += [describe(rows[0].model), Table(COLUMNS, [cells(row) for row in rows], numeric)]
    sections = [
        Section("Percentiles", [_curves_of_page(report), "A name in the legend hides its line."]),
        Section("Latency", [*figures, Folded("how this was measured", notes(report))]),
    ]
    if _walks(report):
        shown: list[Any] = []
        for name, walk in _walks(report):
            shown += [name, _cloud_of_page(walk)]
        sections.append(Section("Each update over stream time", shown))
    name = Path(report.result()["recording"]).name
    write_report(path, f"streamfeat latency: {name}", sections)


def _curves_of_page(report: LatencyReport) -> "figure":
    from bokeh.models import FixedTicker, HoverTool, Legend
    from bokeh.plotting import figure

    plot = figure(
        height=520,
        x_axis_type="log",
        y_axis_type="log",
        x_axis_label=_PERCENTILE_AXIS,
        y_axis_label=_LATENCY_AXIS,
        tools="pan,wheel_zoom,box_zoom,reset,save",
    )
    items = []
    for name, colour, dash, beyond, us in _lines(report):
        data = {"beyond": beyond, "us": us, "percent": 100 - 100 / beyond}
        line = plot.step(
            "beyond", "us", source=data, mode="after", color=colour, line_dash=dash, line_width=2
        )
        items.append((name, [line]))
        hover = HoverTool(renderers=[line], tooltips=[(name, "@us{0.000} µs at @percent{0.0000} %")])
        plot.add_tools(hover)
    legend = Legend(items=items, click_policy="hide", label_text_font_size="11px")
    plot.add_layout(legend, "below")
    plot.xaxis.ticker = FixedTicker(ticks=list(_TICKS))
    plot.xaxis.major_label_overrides = dict(_TICKS)
    return plot


def _cloud_of_page(walk: Walk) -> "figure":
    from bokeh.plotting import figure

    plot = figure(
        height=340,
        y_axis_type="log",
        x_axis_label=_TIME_AXIS,
        y_axis_label=_LATENCY_AXIS,
        tools="pan,wheel_zoom,box_zoom,reset,save",
    )
    seconds, us, begins = (part.astype(np.float32) for part in _points(walk))
    for chosen, style in zip((begins == 0, begins == 1), _styles(), strict=True):
        plot.scatter(
            seconds[chosen],
            us[chosen],
            marker=style["marker"],
            size=style["size"],
            color=style["colour"],
            alpha=style["alpha"],
            legend_label=style["name"],
        )
    plot.legend.click_policy = "hide"
    plot.legend.orientation = "horizontal"
    plot.add_layout(plot.legend[0], "above")
    return plot


def _styles() -> Sequence[dict[str, Any]]:
    """How events are drawn that begin no bin, and those that do."""
    return (
        {"name": "event", "marker": "circle", "size": 3, "colour": "#0072b2", "alpha": 0.35},
        {
            "name": "event that begins a bin",
            "marker": "triangle",
            "size": 9,
            "colour": "#d55e00",
            "alpha": 1.0,
        },
    )


def _draw_image(path: Path, report: LatencyReport) -> None:
    from matplotlib.figure import Figure
    from matplotlib.ticker import FixedLocator, NullLocator

    walks = _walks(report)
    heights = [5.0] + [3.0] * len(walks)
    image = Figure(figsize=(11, sum(heights)), dpi=120, layout="constrained")
    axes = image.subplots(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    curves = axes[0]
    lines = _lines(report)
    for name, colour, dash, beyond, us in lines:
        curves.plot(
            beyond, us, color=colour, ls=_MATPLOTLIB_DASHES[dash], lw=1.6, drawstyle="steps-post", label=name
        )
    curves.set(xscale="log", yscale="log", xlabel=_PERCENTILE_AXIS, ylabel=_LATENCY_AXIS)
    widest = max((float(beyond[-1]) for *_, beyond, _ in lines), default=10.0)
    ticks = {tick: name for tick, name in _TICKS.items() if tick <= widest}
    curves.xaxis.set_major_locator(FixedLocator(list(ticks)))
    curves.xaxis.set_minor_locator(NullLocator())
    curves.set_xticklabels(list(ticks.values()))
    curves.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=8, frameon=False)
    curves.set_title(f"streamfeat latency: {report.result()['recording']}", loc="left", fontsize=11)
    for below, (name, walk) in zip(axes[1:], walks, strict=True):
        seconds, us, begins = _points(walk)
        for chosen, style in zip((~begins, begins), _styles(), strict=True):
            below.scatter(
                seconds[chosen],
                us[chosen],
                s=style["size"] ** 2 / 2,
                marker="^" if style["marker"] == "triangle" else "o",
                color=style["colour"],
                alpha=style["alpha"],
                linewidths=0,
                label=style["name"],
            )
        below.set(yscale="log", xlabel=_TIME_AXIS, ylabel=_LATENCY_AXIS)
        below.set_title(name, loc="left", fontsize=9)
        below.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=8, frameon=False)
    for axis in axes:
        axis.grid(alpha=0.3)
    picture = io.BytesIO()
    image.savefig(picture, format="png")
    write_atomically(path, picture.getvalue())
