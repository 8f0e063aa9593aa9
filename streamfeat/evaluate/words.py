"""The result of an evaluation as rows of text, for the terminal and for the page.

Lives here: columns, cells, notes. Not here: how they are laid out.
"""

from collections.abc import Iterator, Sequence
from typing import Any

from streamfeat.evaluate.plan import METHODS

__all__ = [
    "COLUMNS",
    "base_rows",
    "cells",
    "confusion_table",
    "early_table",
    "notes",
    "online_table",
    "sweep_tables",
]

Lines = tuple[Sequence[str], list[Sequence[str]]]
"""Header and rows of a table."""

COLUMNS = (
    "method",
    "K",
    "geometry",
    "features",
    "accuracy",
    "95 % interval",
    "learn, s",
    "encode, s",
    "train, s",
    "peak, MB",
)


def base_rows(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows that are not of a sweep."""
    return [row for row in result["rows"] if not row["swept"]]


def cells(row: dict[str, Any]) -> list[str]:
    """A row of the accuracy table, as many as `COLUMNS`."""
    setting = row["setting"]
    return [
        row["method"],
        f"{setting['filters']:,}" if setting else "",
        _geometry(setting) if setting else "",
        f"{row['features']:,}",
        f"{row['accuracy']:.3f}",
        _interval(row),
        f"{row['learn_s']:.1f}",
        f"{row['encode_s']:.1f}",
        f"{row['train_s']:.1f}",
        f"{row['peak_mb']:,}",
    ]


def _geometry(setting: dict[str, Any]) -> str:
    return f"{setting['patch']}x{setting['patch']}x{setting['bins']}/{setting['stride']}"


def _interval(row: dict[str, Any]) -> str:
    return f"{row['low']:.3f}-{row['high']:.3f}"


def sweep_tables(result: dict[str, Any]) -> Iterator[tuple[str, Lines]]:
    """For each sweep its name and a table: what was measured, and the paper's figures where it has them."""
    swept = dict.fromkeys(row["swept"] for row in result["rows"] if row["swept"])
    for name in swept:
        rows = [row for row in result["rows"] if row["swept"] == name]
        methods = list(dict.fromkeys(row["method"] for row in rows))
        paper = result["published"]["sweeps"].get(name, {})
        paper = {int(value): figures for value, figures in paper.items()}
        header = [name.replace("_", " "), *methods]
        if paper:
            header += [f"paper's {method}" for method in ("direct", "inverse")]
        values = list(dict.fromkeys(row["setting"][name] for row in rows))
        lines: list[Sequence[str]] = []
        for value in sorted({*values, *paper}):
            mine = {row["method"]: row for row in rows if row["setting"][name] == value}
            line = [f"{value:,}"]
            line += [
                f"{mine[m]['accuracy']:.3f} ({_interval(mine[m])})" if m in mine else "" for m in methods
            ]
            if paper:
                figures = paper.get(value, {})
                line += [f"{figures[m]:.3f}" if m in figures else "" for m in ("direct", "inverse")]
            lines.append(line)
        yield name, (header, lines)


def online_table(result: dict[str, Any]) -> Lines:
    """Prequential accuracy of each method."""
    rows = [row for row in base_rows(result) if "prequential" in row]
    return ("method", "in stream order", "shuffled"), [
        [row["method"], *(f"{row['prequential'][order]['accuracy']:.3f}" for order in ("stream", "shuffled"))]
        for row in rows
    ]


def early_table(result: dict[str, Any]) -> Lines:
    """When each method has most of its final accuracy."""
    rows = [row for row in base_rows(result) if "early" in row]
    share = f"{100 * rows[0]['share_reached']['share']:.0f} %" if rows else ""
    return ("method", "final accuracy", f"{share} of it after, ms", f"{share} of it after, events"), [
        [
            row["method"],
            f"{row['early']['time'][-1]['accuracy']:.3f}",
            f"{row['share_reached']['ms']:g}",
            f"{row['share_reached']['events']:,}",
        ]
        for row in rows
    ]


def confusion_table(row: dict[str, Any], names: Sequence[str]) -> Lines:
    """Counts of true (rows) against predicted labels (columns)."""
    return ("true \\ predicted", *names), [
        [name, *(f"{count:,}" for count in counts)]
        for name, counts in zip(names, row["confusion"], strict=True)
    ]


def notes(result: dict[str, Any]) -> list[str]:
    """What has to be known to read the tables."""
    samples = result["samples"]
    lines = [
        f"{', '.join(result['recordings'])}: {samples['training']:,} samples to learn from, "
        f"{samples['held_out']:,} held out; split: {result['split']}; {result['interval']}.",
        "Every method's features go through the same normalisation and linear SVM. Encoding is of all "
        "samples, training with the choice of C; the peak is that of the whole process in one run.",
    ]
    setting = next((row["setting"] for row in base_rows(result) if row["setting"]), None)
    if setting:
        lines.append(
            f"Geometry is patch x patch x bins/stride, in pixels; downsample {setting['downsample']}, counts "
            f"clipped to {setting['max_count']}, {setting['encoding']} encoding, "
            f"{setting['volumes']:,} volumes, seed {setting['seed']}. "
            "Filters are learned without labels, from samples that are not held out."
        )
    others = [row["method"] for row in base_rows(result) if row["method"] not in ("direct", "inverse")]
    if others:
        lines.append("; ".join(f"{method}: {METHODS[method]}" for method in others) + ".")
    if any(row["swept"] for row in result["rows"]):
        lines.append(
            f"The paper's figures are of {result['published']['data']}, not of these recordings "
            f"({result['published']['citation']}, third table)."
        )
    early = next((row["early"] for row in result["rows"] if "early" in row), None)
    if early:
        lines.append(
            f"Early decision: {early['samples']:,} held-out samples, cut off after some time or some events; "
            "the window ends at the cut, the classifier was trained on whole samples. Times are the first "
            "measured points from which on the accuracy stays above the share."
        )
    online = next((row["prequential"] for row in result["rows"] if "prequential" in row), None)
    if online:
        total = sum(samples.values())
        lines.append(
            f"Online: a classifier from nothing predicts each of {total:,} samples before it learns it. In "
            f"stream order the label changes {online['stream']['label_changes']:,} times, "
            f"shuffled {online['shuffled']['label_changes']:,} times: few changes make it easy."
        )
    return lines
