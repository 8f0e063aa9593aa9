"""The result of an evaluation as one page.

Lives here: which tables and figures it has, in which order, and the figures.
Not here: the skeleton of a page (`streamfeat.report.pages`), numbers as text (`words`).
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.evaluate.tables import (
    COLUMNS,
    all_numbers,
    base_rows,
    cells,
    early_table,
    fold_table,
    in_order,
    notes,
    online_table,
    published_table,
    sweep_tables,
    value_text,
)
from streamfeat.report.pages import Folded, Grid, Section, Table, Wide, require, write_report

if TYPE_CHECKING:
    from bokeh.plotting import figure

__all__ = ["check_page", "tiled", "write_page"]

_COLOURS = ("#1f83c9", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a8f98")
_TOOLS = "pan,wheel_zoom,box_zoom,reset,save"
_TILE_COLUMNS = 8
_SMALL = 260
_MOST_COUNTS = 30
"""Classes that a confusion shows with their counts; more have room for their names only."""
_PAIRS_SHOWN = 10
_SHORT_NAME = 2
"""Letters of a name that has room beside others."""

_PUBLISHED = (
    "Beside what was published, of recorded data, each on its own split and with its own classifier: figures "
    "in one row are not of the same samples unless these recordings are that data set."
)

Parts = list[Any]


def check_page(path: Path) -> None:
    """Check that a page of this name can be written.

    Raises:
        InputError: its ending is not .html, or the extra `plot` is missing.
    """
    if path.suffix != ".html":
        raise InputError(f"{path}: --report writes a page; give a name that ends in .html")
    require("bokeh")


def write_page(path: Path, result: dict[str, Any]) -> None:
    """Write the page; it appears whole or not at all, and replaces an earlier one.

    Raises:
        InputError: see `check_page`; or the folder cannot be written to.
    """
    check_page(path)
    rows = base_rows(result)
    machine = ", ".join(f"{name} {value}" for name, value in result["machine"].items())
    numeric = [name not in ("method", "geometry") for name in COLUMNS]
    table = Table(COLUMNS, [cells(row) for row in rows], numeric)
    best = max(rows, key=lambda row: row["accuracy"])
    accuracy: Parts = [
        f"Best: {best['method']}, {100 * best['accuracy']:.1f} % of held-out samples right "
        f"({100 * best['low']:.1f} to {100 * best['high']:.1f})."
    ]
    warnings = [note for note in notes(result) if note.startswith("WARNING")]
    said = [note for note in notes(result) if note not in warnings]
    accuracy += [*warnings, _accuracies(rows), table]
    header, beside = published_table(result)
    if beside:
        accuracy += [_PUBLISHED, Table(header, beside, [False] + [True] * (len(header) - 1))]
    header, folds = fold_table(result)
    if folds:
        folded = Table(header, folds, [False] + [True] * (len(header) - 1))
        accuracy.append(Folded("accuracy of each fold", [folded]))
    accuracy.append(Folded("how this was measured", [*said, f"Measured on: {machine}."]))
    sections = [Section("Accuracy", accuracy)]
    if sweeps := list(_sweeps(result)):
        figures = [part for part in sweeps if not isinstance(part, Table)]
        tables = [part for part in sweeps if isinstance(part, Table)]
        sections.append(Section("Sweeps", [Grid(figures), Folded("figures of the sweeps", tables)]))
    if early := [row for row in rows if "early" in row]:
        sections.append(Section("Early decision", _early(result, early)))
    if online := [row for row in rows if "prequential" in row]:
        sections.append(Section("Online: predicting before learning", _online(result, online)))
    sections.append(Section("Confusion", _confusions(rows, result["labels"])))
    learned = [row for row in rows if "learned" in row]
    if learned:
        said_of_filters, *pictures = _filters(learned)
        sections.append(Section("Filters", [said_of_filters, Grid(pictures)]))
    if history := [row for row in learned if "objective" in row["learned"]]:
        said_of_it, *pictures = _convergence(history)
        sections.append(Section("Convergence", [Folded("how learning went", [said_of_it, Grid(pictures)])]))
    write_report(path, f"streamfeat evaluate: {', '.join(result['recordings'])}", sections)


def _plot(x: str, y: str, *, height: int = 340, **options: Any) -> "figure":
    from bokeh.plotting import figure

    plot = figure(height=height, x_axis_label=x, y_axis_label=y, tools=_TOOLS, **options)
    for axis in plot.axis:
        axis.axis_label_text_font_size = "13px"
        axis.major_label_text_font_size = "12px"
    return plot


def _accuracies(rows: Sequence[dict[str, Any]]) -> "figure":
    """Each method's accuracy, with its interval: the result in one picture."""
    names = list(reversed([row["method"] for row in rows]))
    plot = _plot("accuracy", "", height=70 + 30 * len(rows), y_range=names)
    shown = {name: [row[name] for row in rows] for name in ("method", "low", "high", "accuracy")}
    plot.segment(
        shown["low"], shown["method"], shown["high"], shown["method"], color=_COLOURS[0], line_width=3
    )
    plot.scatter(shown["accuracy"], shown["method"], color=_COLOURS[0], size=9)
    return plot


def _with_legend(plot: "figure") -> "figure":
    plot.add_layout(plot.legend[0], "below")
    plot.legend.ncols = 1
    plot.legend.click_policy = "hide"
    plot.legend.label_text_font_size = "12px"
    return plot


def _line(
    plot: "figure", xs: Sequence[float | str], ys: Sequence[float], name: str, i: int, **style: Any
) -> None:
    colour = _COLOURS[i % len(_COLOURS)]
    plot.line(xs, ys, color=colour, line_width=2, legend_label=name, **style)
    plot.scatter(xs, ys, color=colour, size=5, legend_label=name)


def _sweeps(result: dict[str, Any]) -> Iterator["str | Table | figure"]:
    for name, (header, lines) in sweep_tables(result):
        title = "number of filters K" if name == "filters" else name.replace("_", " ")
        yield Table(header, lines, [True] * len(header))
        rows = [row for row in result["rows"] if row["swept"] == name]
        values = in_order(row["setting"][name] for row in rows)
        numbers = all_numbers(values)
        axis: dict[str, Any] = {} if numbers else {"x_range": [value_text(value) for value in values]}
        plot = _plot({"patch": "patch, pixels"}.get(name, title), "accuracy", height=_SMALL + 80, **axis)
        methods = list(dict.fromkeys(row["method"] for row in rows))
        for i, method in enumerate(methods):
            mine = {row["setting"][name]: row for row in rows if row["method"] == method}
            shown = [value for value in values if value in mine]
            places = shown if numbers else [value_text(value) for value in shown]
            accuracies, lows, highs = (
                [mine[value][figure] for value in shown] for figure in ("accuracy", "low", "high")
            )
            _line(plot, places, accuracies, method, i)
            plot.segment(places, lows, places, highs, color=_COLOURS[i % len(_COLOURS)], legend_label=method)
        paper = result["published"]["sweeps"].get(name, {})
        for i, method in enumerate(("direct", "inverse") if paper else ()):
            label = f"paper's {method}, {result['published']['data']}"
            published = [figures[method] for figures in paper.values()]
            _line(plot, list(map(int, paper)), published, label, len(methods) + i, line_dash="dashed")
        yield _with_legend(plot)
        timed = [row for row in rows if "update_us" in row]
        if timed and numbers:
            yield _update_costs(name, title, timed)


def _update_costs(name: str, title: str, rows: Sequence[dict[str, Any]]) -> "figure":
    """What an update costs over the values of a sweep."""
    plot = _plot(title, "update of one event, us", height=_SMALL + 80, y_axis_type="log")
    for i, method in enumerate(dict.fromkeys(row["method"] for row in rows)):
        mine = sorted((row["setting"][name], row["update_us"]) for row in rows if row["method"] == method)
        _line(plot, [value for value, _ in mine], [cost for _, cost in mine], method, i)
    return _with_legend(plot)


def _early(result: dict[str, Any], rows: Sequence[dict[str, Any]]) -> Parts:
    from bokeh.models import NumeralTickFormatter

    header, lines = early_table(result)
    by_time = _plot("time since the sample began, ms", "accuracy")
    by_events = _plot("events since the sample began", "accuracy", x_axis_type="log")
    for i, row in enumerate(rows):
        for plot, axis, unit in ((by_time, "time", "ms"), (by_events, "events", "events")):
            points = row["early"][axis]
            _line(plot, [p[unit] for p in points], [p["accuracy"] for p in points], row["method"], i)
    by_events.xaxis.formatter = NumeralTickFormatter(format="0,0")
    by_events.xaxis.ticker = sorted({p["events"] for row in rows for p in row["early"]["events"]})
    table = Table(header, lines, [False, True, True, True])
    return [Grid([_with_legend(by_time), _with_legend(by_events)]), table]


def _online(result: dict[str, Any], rows: Sequence[dict[str, Any]]) -> Parts:
    header, lines = online_table(result)
    plot = _plot("samples seen", "accuracy so far", x_axis_type="log", y_range=(0, 1))
    for i, row in enumerate(rows):
        for order, dash in (("stream", "solid"), ("shuffled", "dotted")):
            curve = row["prequential"][order]["curve"]
            name = f"{row['method']}, {'stream order' if order == 'stream' else order}"
            xs, ys = [p["samples"] for p in curve], [p["accuracy"] for p in curve]
            _line(plot, xs, ys, name, i, line_dash=dash)
    return [_with_legend(plot), Table(header, lines, [False, True, True])]


def _confusions(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> Parts:
    """Small ones beside each other; of many classes one below the other, with what is mixed up most."""
    if len(names) <= _MOST_COUNTS:
        return [Grid([_confusion(row, names) for row in rows])]
    parts: Parts = []
    for row in rows:
        counts = np.array(row["confusion"])
        np.fill_diagonal(counts, 0)
        worst = np.argsort(-counts, axis=None, kind="stable")[:_PAIRS_SHOWN]
        places = [divmod(int(at), len(names)) for at in worst if counts.flat[at]]
        pairs = [[names[i], names[j], f"{counts[i, j]:,}"] for i, j in places]
        header = [f"{row['method']}: is", "taken for", "samples"]
        parts += [Table(header, pairs, [False, False, True])] if pairs else []
        parts.append(Wide(_confusion(row, names), 180 + 11 * len(names)))
    return parts


def _confusion(row: dict[str, Any], names: Sequence[str]) -> "figure":
    counts = np.array(row["confusion"])
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    true, predicted = (index.tolist() for index in np.nonzero(counts))
    data = {
        "true": [names[i] for i in true],
        "predicted": [names[i] for i in predicted],
        "share": shares[true, predicted],
        "count": [f"{count:,}" for count in counts[true, predicted]],
        "ink": ["white" if share > 0.5 else "#767e87" for share in shares[true, predicted]],
    }
    has_counts = len(names) <= _MOST_COUNTS
    plot = _plot(
        "predicted label",
        "true label",
        height=max(_SMALL, 120 + (26 if has_counts else 11) * len(names)),
        x_range=list(names),
        y_range=list(reversed(names)),
        title=f"{row['method']}: samples by label",
    )
    plot.rect(
        "predicted", "true", 1, 1, source=data, fill_color=_COLOURS[0], fill_alpha="share", line_color=None
    )
    if has_counts:
        plot.text(
            "predicted",
            "true",
            text="count",
            source=data,
            text_color="ink",
            text_align="center",
            text_baseline="middle",
            text_font_size="12px",
        )
    else:
        for axis in plot.axis:
            axis.major_label_text_font_size = "9px"
    if len(names) > 6 and max(map(len, names)) > _SHORT_NAME:
        plot.xaxis.major_label_orientation = "vertical"
    return plot


def _by_iteration(label: str) -> "figure":
    plot = _plot("iteration", label, height=280)
    plot.xaxis[0].ticker.min_interval = 1  # there is no iteration 1.2
    return plot


def _convergence(rows: Sequence[dict[str, Any]]) -> Iterator["str | Table | figure"]:
    yield (
        "The objective after each half-step, codes and then filters, which may not rise; the condition "
        "number (ratio of singular values); the coherence (largest |cos| between two filters)."
    )
    for i, row in enumerate(rows):
        objective = row["learned"]["objective"]
        plot = _by_iteration("mean objective")
        _line(plot, (np.arange(len(objective)) / 2 + 0.5).tolist(), objective, row["method"], i)
        yield _with_legend(plot)
    for name, label in (
        ("condition", "condition number"),
        ("coherence", "coherence"),
    ):
        plot = _by_iteration(label)
        for i, row in enumerate(rows):
            values = [np.nan if value is None else value for value in row["learned"][name]]
            _line(plot, list(range(1, len(values) + 1)), values, row["method"], i)
        yield _with_legend(plot)


def _filters(rows: Sequence[dict[str, Any]]) -> Iterator["str | Table | figure"]:
    from bokeh.models import LinearColorMapper
    from bokeh.palettes import Greys256

    grey = LinearColorMapper(palette=Greys256, low=0, high=255, nan_color="rgba(0, 0, 0, 0)")
    yield (
        "What filters answer to, in whitened volumes (rows of A, columns of D): some of all. Each tile is "
        "a filter with its time bins side by side, the oldest first; grey is zero, and each has its own "
        "contrast. Kurtosis is that of answers to volumes of held-out samples, 3 where they are Gaussian: "
        "the higher, the sparser."
    )
    for row in rows:
        shown = row["learned"]["filters"]
        image = tiled(np.array(shown), row["learned"]["shape"])
        height, width = image.shape
        plot = _plot(
            "column, pixels; bins side by side",
            "row, pixels",
            height=int(80 + 980 * height / width),
            x_range=(0, width),
            y_range=(height, 0),
            title=f"{row['method']}: {len(shown)} of {row['learned']['n_filters']:,} filters"
            + _sparsity(row["learned"]),
        )
        # Rows of an image are drawn upwards; the axis runs downwards.
        plot.image(image=[image], x=0, y=0, dw=width, dh=height, color_mapper=grey)
        plot.grid.visible = False
        yield plot


def _sparsity(learned: dict[str, Any]) -> str:
    """Kurtosis and share of codes, behind a title."""
    if "kurtosis" not in learned:
        return ""
    return f"; kurtosis {learned['kurtosis']:.1f}, {learned['used']:.1%} of codes are not zero"


def tiled(filters: NDArray[np.float64], shape: Sequence[int]) -> NDArray[np.float32]:
    """One picture of `(n, d)` filters of `shape` (bins, rows, columns): 128 is zero, gaps are NaN."""
    bins, rows, columns = shape
    scale = np.maximum(np.abs(filters).max(axis=1, keepdims=True), 1e-12)
    grey = np.round(128 + 127 * filters / scale)
    tiles = grey.reshape(-1, bins, rows, columns).transpose(0, 2, 1, 3)
    lines = -(-len(tiles) // _TILE_COLUMNS)
    step = rows + 2, bins * (columns + 1) + 2
    picture = np.full((lines * step[0], _TILE_COLUMNS * step[1]), np.nan, np.float32)
    for i, tile in enumerate(tiles):
        top, left = i // _TILE_COLUMNS * step[0], i % _TILE_COLUMNS * step[1]
        for b in range(bins):
            at = left + b * (columns + 1)
            picture[top : top + rows, at : at + columns] = tile[:, b]
    return picture
