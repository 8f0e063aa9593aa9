"""The picture of how the cost of events grows.

Lives here: drawing. Not here: the figures (`growth`), their table (`tables`).
"""

from pathlib import Path
from typing import Any

__all__ = ["draw_growth"]

_SWEEPS = {
    "filters": "filters K",
    "stride": "stride",
    "resolution": "pixels",
    "rate": "events/s",
    "cameras": "cameras",
}
_BASE = {"filters": 400, "stride": 4, "resolution": (120, 160), "rate": 200_000, "cameras": 1}


def draw_growth(report: dict[str, Any], target: Path) -> None:
    """Measured points and predicted lines, a panel for each quantity; SVG or PNG."""
    import matplotlib
    from matplotlib.figure import Figure

    # Text stays text, and the same figures give the same file.
    matplotlib.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "streamfeat"})
    figure = Figure(figsize=(12, 2.8), layout="constrained")
    panels = figure.subplots(1, len(_SWEEPS), sharey=True)
    for axes, (name, label) in zip(panels, _SWEEPS.items(), strict=True):
        for emit, colour in (("event", "tab:blue"), ("10ms", "tab:orange")):
            rows = [row for row in report["rows"] if row["emit"] == emit and _is_of(row, name)]
            points = sorted(
                (_number(row[name]), row["ns"]["p50"] / 1e3, row["predicted_ns"] / 1e3) for row in rows
            )
            if not points:
                continue
            x, measured, predicted = zip(*points, strict=True)
            axes.plot(x, measured, "o", markersize=4, color=colour, label=f"{emit}, measured")
            axes.plot(x, predicted, "-", linewidth=1, color=colour, label=f"{emit}, predicted")
            axes.set_xscale("log")
            axes.set_xticks(x, [f"{value:,.0f}" for value in x], fontsize=6)
            axes.set_xticks([], minor=True)
        axes.set_yscale("log")
        axes.set_xlabel(label)
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("us an event")
    panels[0].legend(fontsize=6)
    figure.savefig(target, metadata={"Date": None} if target.suffix == ".svg" else None)


def _is_of(row: dict[str, Any], name: str) -> bool:
    """Whether a row differs from the base in this quantity alone."""
    return all(
        tuple(row[other]) == value if other == "resolution" else row[other] == value
        for other, value in _BASE.items()
        if other != name
    )


def _number(value: Any) -> float:
    return float(value[0] * value[1]) if isinstance(value, tuple | list) else float(value)
