"""The pictures of the parts `growth` and `scaling`, and of `profile`.

Lives here: drawing. Not here: the figures (`growth`, `scaling`), their tables (`tables`).
"""

from pathlib import Path
from typing import Any

__all__ = ["draw_curves", "draw_growth", "draw_scaling"]

_SWEEPS = {
    "filters": "filters K",
    "stride": "stride",
    "resolution": "pixels",
    "rate": "events/s",
    "cameras": "cameras",
}
_BASE = {"filters": 400, "stride": 4, "resolution": (120, 160), "rate": 200_000, "cameras": 1}


def _figure(width: float, n: int, **options: Any) -> tuple[Any, Any]:
    """A figure and its panels; text stays text, and the same figures give the same file."""
    import matplotlib
    from matplotlib.figure import Figure

    matplotlib.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "streamfeat"})
    figure = Figure(figsize=(width, 2.8), layout="constrained")
    return figure, figure.subplots(1, n, **options)


def draw_growth(report: dict[str, Any], target: Path) -> None:
    """Nanoseconds an event as SVG, a panel for each quantity."""
    figure, panels = _figure(12, len(_SWEEPS), sharey=True)
    for axes, (name, label) in zip(panels, _SWEEPS.items(), strict=True):
        for emit, colour in (("event", "tab:blue"), ("10ms", "tab:orange")):
            rows = [row for row in report["rows"] if row["emit"] == emit and _is_of(row, name)]
            points = sorted((_number(row[name]), row["ns"]["p50"] / 1e3) for row in rows)
            if not points:
                continue
            x, measured = zip(*points, strict=True)
            axes.plot(x, measured, "o-", markersize=4, linewidth=1, color=colour, label=emit)
            axes.set_xscale("log")
            axes.set_xticks(x, [f"{value:,.0f}" for value in x], fontsize=6)
            axes.set_xticks([], minor=True)
        axes.set_yscale("log")
        axes.set_xlabel(label)
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("us an event")
    panels[0].legend(fontsize=6)
    figure.savefig(target, format="svg", metadata={"Date": None})


def _is_of(row: dict[str, Any], name: str) -> bool:
    """Whether a row differs from the base in this quantity alone."""
    return all(
        tuple(row[other]) == value if other == "resolution" else row[other] == value
        for other, value in _BASE.items()
        if other != name
    )


def _number(value: Any) -> float:
    return float(value[0] * value[1]) if isinstance(value, tuple | list) else float(value)


def draw_scaling(figures: dict[str, Any], target: Path) -> None:
    """Four small panels as SVG: microseconds an update, or an event, against each quantity."""
    figure, panels = _figure(10, 4)
    series = {
        "K": {
            "direct": figures["K"]["ns"],
            "inverse": figures["inverse"]["inverse"],
            "from scratch": figures["K"]["from_scratch_ns"],
        }
    } | {
        name: {"direct": figures[name]["ns"], "from scratch": figures[name]["from_scratch_ns"]}
        for name in ("patch", "bins", "stride")
    }
    colours = {"direct": "tab:blue", "inverse": "tab:orange", "from scratch": "tab:grey"}
    for axes, (name, lines) in zip(panels, series.items(), strict=True):
        for label, points in lines.items():
            if not points:
                continue
            x = [int(value) for value in points]
            factor = [figures[name]["updates_per_event"][v] if name == "stride" else 1.0 for v in points]
            middle, low, high = (
                [point[p] * f / 1e3 for point, f in zip(points.values(), factor, strict=True)]
                for p in ("p50", "p10", "p90")
            )
            axes.plot(x, middle, marker="o", markersize=3, label=label, color=colours[label])
            axes.fill_between(x, low, high, alpha=0.2, linewidth=0, color=colours[label])
        axes.set_yscale("log")
        axes.set_xlabel(
            {"K": "filters K", "patch": "patch, pixels", "bins": "bins", "stride": "stride, pixels"}[name]
        )
        axes.set_title("us an event" if name == "stride" else "us an event and volume", fontsize=9)
        axes.grid(alpha=0.3)
    panels[0].set_xscale("log")
    panels[0].legend(fontsize=7)
    figure.savefig(target, format="svg", metadata={"Date": None})


def draw_curves(found: dict[str, list[tuple[float, float, float]]], target: Path) -> None:
    """Milliseconds of an emission before and now as SVG, a panel for each quantity."""
    figure, panels = _figure(12, len(found), sharey=True)
    for axes, (quantity, points) in zip(panels, found.items(), strict=True):
        values, *both = zip(*points, strict=True)
        for name, colour, measured in zip(("before", "now"), ("tab:grey", "tab:orange"), both, strict=True):
            axes.plot(values, measured, "o-", markersize=4, linewidth=1, color=colour, label=name)
        axes.set_xscale("log")
        axes.set_xticks(values, [f"{value:,g}" for value in values], fontsize=6)
        axes.set_xticks([], minor=True)
        axes.set_yscale("log")
        axes.set_xlabel(quantity)
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("ms an emission")
    panels[0].legend(fontsize=6)
    figure.savefig(target, format="svg", metadata={"Date": None})
