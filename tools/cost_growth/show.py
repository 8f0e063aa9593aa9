"""Figures for people.

Lives here: the table in the terminal and in Markdown, and the picture.
Not here: the figures.
"""

from pathlib import Path
from typing import Any

__all__ = ["draw", "table"]

_SWEEPS = {
    "filters": "filters K",
    "stride": "stride",
    "resolution": "pixels",
    "rate": "events/s",
    "cameras": "cameras",
}
_BASE = {"filters": 400, "stride": 4, "resolution": (120, 160), "rate": 200_000, "cameras": 1}


def table(report: dict[str, Any]) -> str:
    """Measured against predicted, a line for each setting, as Markdown."""
    lines = [
        "| reading | K | stride | sensor | Mev/s | cameras | ns an event | predicted | ratio | events/s "
        "| late by: p50 | p99 |",
        "| --- |" + " ---: |" * 11,
    ]
    for row in report["rows"]:
        height, width = row["resolution"]
        what = (
            f"{row['emit']} | {row['filters']} | {row['stride']} | {width}x{height} | {row['rate'] / 1e6:g}"
        )
        ns, mark = row["ns"]["p50"], " (fit)" if row["fitted"] else ""
        late = [_duration(row[key]) if key in row else "" for key in ("latency_p50_us", "latency_p99_us")]
        lines.append(
            f"| {what} "
            f"| {row['cameras']} | {ns:,.0f} | {row['predicted_ns']:,.0f}{mark} | {row['ratio']:.2f} "
            f"| {1e9 / ns:,.0f} | {late[0]} | {late[1]} |"
        )
    return "\n".join(lines)


def _duration(us: float) -> str:
    return f"{us / 1e3:.1f} ms" if us >= 1000 else f"{us:.1f} us"


def draw(report: dict[str, Any], target: Path) -> None:
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
