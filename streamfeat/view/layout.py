"""A Foxglove layout that shows every channel of a view.

Lives here: panels, what they show, how they share the window; the JSON that Foxglove exports and imports.
Not here: the channels themselves (`channels`).
"""

import json
from collections.abc import Sequence
from typing import Any

__all__ = ["foxglove_layout"]

_MOST_CELLS = 4
_MOST_SERIES = 16
"""Scores in one plot; its legend has no room for more."""


def foxglove_layout(prefix: str, labels: Sequence[str], pooling: int) -> str:
    """The layout as JSON, for "Import from file" in Foxglove's menu of layouts.

    Args:
        prefix: of the channels.
        labels: that the scores belong to; empty without a classifier.
        pooling: cells along each side of the grid.
    """
    panels: dict[str, dict[str, Any]] = {
        f"Image!{name}": {"foxglovePanelTitle": title, "imageMode": {"imageTopic": f"{prefix}/{name}"}}
        for name, title in (
            ("events", "Events: ON white, OFF black"),
            ("bins", "Bins of the window, oldest left"),
            ("volumes", "Active volumes"),
        )
    }
    panels["Plot!features"] = _plot(
        "Features of the first cells, row by row",
        "feature",
        [
            (f"{prefix}/features.cells[{cell}].{part}[:]", f"cell {cell + 1}, {part}")
            for cell in range(min(pooling**2, _MOST_CELLS))
            for part in ("positive", "negative")
        ],
        xAxisVal="index",
    )
    scores = [(f"{prefix}/prediction.scores[{i}]", label) for i, label in enumerate(labels[:_MOST_SERIES])]
    panels["Plot!scores"] = _plot("Scores", "score", scores)
    panels["Plot!latency"] = _plot(
        "Update latency",
        "microseconds",
        [(f"{prefix}/engine.update_us.{name}", name) for name in ("median", "max")],
    )
    panels["Plot!rate"] = _plot(
        "Event rate", "events a second", [(f"{prefix}/status.events_per_s", "events a second")]
    )
    panels["RawMessages!status"] = {"topicPath": f"{prefix}/status", "foxglovePanelTitle": "Drops and counts"}
    return json.dumps(
        {
            "configById": panels,
            "globalVariables": {},
            "userNodes": {},
            "playbackConfig": {"speed": 1},
            "layout": _column(
                _row("Image!events", _row("Image!bins", "Image!volumes", 65), 25),
                _column(
                    _row("Plot!features", "Plot!scores"),
                    _row("Plot!latency", _row("Plot!rate", "RawMessages!status"), 34),
                    60,
                ),
                40,
            ),
        },
        indent=1,
    )


def _plot(title: str, y_label: str, series: Sequence[tuple[str, str]], **more: Any) -> dict[str, Any]:
    return {
        "foxglovePanelTitle": title,
        "paths": [{"value": value, "label": label, "enabled": True} for value, label in series],
        "yAxisLabel": y_label,
        "showLegend": True,
        "legendDisplay": "top",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
    } | more


def _split(direction: str, first: Any, second: Any, percent: int) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percent}


def _row(first: Any, second: Any, percent: int = 50) -> dict[str, Any]:
    return _split("row", first, second, percent)


def _column(first: Any, second: Any, percent: int = 50) -> dict[str, Any]:
    return _split("column", first, second, percent)
