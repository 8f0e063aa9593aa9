"""The result of an evaluation as rows of text, for the terminal and for the page.

Lives here: columns, cells, notes. Not here: how they are laid out.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from streamfeat.evaluate.plan import METHODS

__all__ = [
    "COLUMNS",
    "against_table",
    "all_numbers",
    "base_rows",
    "cells",
    "confusion_table",
    "early_table",
    "fold_table",
    "in_order",
    "notes",
    "online_table",
    "published_table",
    "sweep_tables",
    "value_text",
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
    "to the first",
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
    setting, learned = row["setting"], row.get("learned")
    filters = setting.get("filters") or (learned["n_filters"] if learned else None)
    return [
        row["method"],
        f"{filters:,}" if filters else "",
        _geometry(setting) if "patch" in setting else _shape(learned) if learned else "",
        f"{row['features']:,}",
        f"{row['accuracy']:.3f}",
        _interval(row),
        _to_base(row) if "difference" in row else "",
        f"{row['learn_s']:.1f}",
        f"{row['encode_s']:.1f}",
        f"{row['train_s']:.1f}",
        f"{row['peak_mb']:,}",
    ]


def _geometry(setting: dict[str, Any]) -> str:
    patch = setting["patch"]
    area = f"{patch}x{patch}" if isinstance(patch, int) else patch
    first = f"{area}x{setting['bins']}/{setting['stride']}"
    if setting.get("volume_bins"):
        first = first.replace(f"x{setting['bins']}/", f"x{setting['volume_bins']}/")
    return first if setting["scales"] == "none" else f"{first}+{setting['scales']}"


def _times(setting: dict[str, Any]) -> str:
    if not setting.get("volume_bins"):
        return ""
    return (
        f"volumes of {setting['volume_bins']} of {setting['bins']} bins, {setting['time_stride']} apart in "
        "time, codes summed over it; "
    )


def _shape(learned: dict[str, Any]) -> str:
    bins, rows, columns = learned["shape"]
    return f"{rows}x{columns}x{bins}"


def _interval(row: dict[str, Any]) -> str:
    return f"{row['low']:.3f}-{row['high']:.3f}"


def sweep_tables(result: dict[str, Any]) -> Iterator[tuple[str, Lines]]:
    """For each sweep its name and a table of measured figures, beside the paper's where it has them."""
    swept = dict.fromkeys(row["swept"] for row in result["rows"] if row["swept"])
    for name in swept:
        rows = [row for row in result["rows"] if row["swept"] == name]
        methods = list(dict.fromkeys(row["method"] for row in rows))
        paper = result["published"]["sweeps"].get(name, {})
        paper = {int(value): figures for value, figures in paper.items()}
        header = [name.replace("_", " ")]
        for method in methods:
            header += [method, "to base"]
        costs = {row["method"] for row in rows if "update_us" in row}
        timed = [method for method in methods if method in costs]
        header += [f"update of {method}, us" for method in timed]
        if paper:
            header += [f"paper's {method}" for method in ("direct", "inverse")]
        lines: list[Sequence[str]] = []
        for value in in_order([*(row["setting"][name] for row in rows), *paper]):
            mine = {row["method"]: row for row in rows if row["setting"][name] == value}
            line = [value_text(value)]
            for method in methods:
                line += _measured(mine[method]) if method in mine else ["", ""]
            for method in timed:
                cost = mine[method].get("update_us") if method in mine else None
                line.append("" if cost is None else f"{cost:,.2f}")
            if paper:
                figures = paper.get(value, {})
                line += [f"{figures[m]:.3f}" if m in figures else "" for m in ("direct", "inverse")]
            lines.append(line)
        yield name, (header, lines)


def in_order(values: Iterable[Any]) -> list[Any]:
    """Each value of a sweep once: numbers sorted, others as they come."""
    distinct = list(dict.fromkeys(values))
    return sorted(distinct) if all_numbers(distinct) else distinct


def all_numbers(values: Iterable[Any]) -> bool:
    """Whether values can be put on an axis of numbers."""
    return all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)


def value_text(value: Any) -> str:
    """A value of a sweep."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:,}" if isinstance(value, int | float) else str(value)


def _measured(row: dict[str, Any]) -> list[str]:
    """Accuracy, and the difference to the base setting, each with its interval."""
    return [f"{row['accuracy']:.3f} ({_interval(row)})", _to_base(row)]


def _to_base(row: dict[str, Any]) -> str:
    difference = row["difference"]
    return f"{difference['accuracy']:+.3f} ({difference['low']:+.3f} to {difference['high']:+.3f})"


def fold_table(result: dict[str, Any]) -> Lines:
    """Accuracy of each method in each fold; no row where there is but one."""
    rows = [row for row in result["rows"] if len(row["folds"]) > 1]
    header = ("method", *(f"fold {i + 1}" for i in range(len(rows[0]["folds"]) if rows else 0)))
    return header, [[_name(row), *(f"{accuracy:.3f}" for accuracy in row["folds"])] for row in rows]


def _name(row: dict[str, Any]) -> str:
    """The method, and what is varied."""
    if not row["swept"]:
        return str(row["method"])
    return f"{row['method']}, {row['swept'].replace('_', ' ')} {value_text(row['setting'][row['swept']])}"


def against_table(result: dict[str, Any]) -> Lines:
    """The difference of each row to the first row of an earlier result; no rows without one."""
    return ("what", "accuracy", "difference", "95 % interval"), [
        [
            _name(row),
            f"{row['accuracy']:.4f}",
            f"{row['against']['accuracy']:+.4f}",
            f"{row['against']['low']:+.4f} to {row['against']['high']:+.4f}",
        ]
        for row in result["rows"]
        if "against" in row
    ]


def online_table(result: dict[str, Any]) -> Lines:
    """Prequential accuracy of each method."""
    rows = [row for row in base_rows(result) if "prequential" in row]
    return ("method", "in stream order", "shuffled"), [
        [row["method"], *(f"{row['prequential'][order]['accuracy']:.3f}" for order in ("stream", "shuffled"))]
        for row in rows
    ]


def early_table(result: dict[str, Any]) -> Lines:
    """When each method has most of its final accuracy; never, where that is nothing."""
    rows = [row for row in base_rows(result) if "early" in row]
    share = f"{100 * rows[0]['share_reached']['share']:.0f} %" if rows else ""
    return ("method", "final accuracy", f"{share} of it after, ms", f"{share} of it after, events"), [
        [
            row["method"],
            f"{row['early']['time'][-1]['accuracy']:.3f}",
            *(
                (f"{row['share_reached']['ms']:g}", f"{row['share_reached']['events']:,}")
                if row["early"]["time"][-1]["accuracy"]
                else ("-", "-")
            ),
        ]
        for row in rows
    ]


def published_table(result: dict[str, Any]) -> Lines:
    """Accuracy here beside what was published of each method on recorded data; no rows where nothing was."""
    published = result["published"].get("accuracies", {})
    names = list(dict.fromkeys(name for figures in published.values() for name in figures))
    lines: list[Sequence[str]] = []
    for row in base_rows(result):
        if figures := published.get(row["method"]):
            theirs = [f"{figures[name]:.3f}" if name in figures else "" for name in names]
            lines.append([row["method"], f"{row['accuracy']:.3f}", _interval(row), *theirs])
    return ("method", "here", "95 % interval", *(f"published, {name}" for name in names)), lines


def confusion_table(row: dict[str, Any], names: Sequence[str]) -> Lines:
    """Counts of true (rows) against predicted labels (columns)."""
    return ("true \\ predicted", *names), [
        [name, *(f"{count:,}" for count in counts)]
        for name, counts in zip(names, row["confusion"], strict=True)
    ]


def notes(result: dict[str, Any]) -> list[str]:
    """Notes for reading the tables."""
    samples = result["samples"]
    lines = [
        f"{', '.join(result['recordings'])}: {samples['training']:,} samples to learn from, "
        f"{samples['held_out']:,} held out; split: {result['split']}; {result['interval']}.",
        "Every method's features go through the same classifiers: a linear SVM, or with kernel rbf Gaussian "
        "kernel ridge; with kernel auto, the one that folds of training samples say is better. Encoding is "
        "of all samples, training with the choice of C; the peak is that of the whole process in one run.",
    ]
    if chosen := [
        f"{_name(row)} rbf in {row['kernel'].count('rbf')} of {len(row['kernel'])} folds"
        for row in result["rows"]
        if row["setting"].get("kernel") == "auto" and "kernel" in row
    ]:
        lines.append(f"Kernel auto took: {', '.join(chosen)}.")
    if errors := [
        f"{_name(row)} {row['calibration_error']:.3f}" for row in result["rows"] if "calibration_error" in row
    ]:
        lines.append(f"Error of calibration of the probabilities, expected, ten bins: {', '.join(errors)}.")
    if leakage := result["leakage"]:
        lines.append(_leakage_note(leakage))
    if len(base_rows(result)) > 1:
        lines.append(
            "To the first: the difference in accuracy to the first method on the same samples, with its "
            "paired interval."
        )
    setting = next((row["setting"] for row in base_rows(result) if "patch" in row["setting"]), None)
    if setting:
        lines.append(
            "Geometry is patch x patch x bins/stride, in pixels, and further scales, each patch@downsample; "
            f"{_times(setting)}"
            f"downsample {setting['downsample']}, counts "
            f"clipped to {setting['max_count']}, {setting['encoding']} encoding, "
            f"{setting['volumes']:,} volumes, seed {setting['seed']}. "
            "Filters are learned without labels, from samples that are not held out."
        )
    setting = base_rows(result)[0]["setting"]
    more = ["mirror images"] if setting["mirror"] else []
    if cuts := setting["cuts"].strip():
        more += [f"beginnings of {cuts} ms"]
    more += [f"copies moved by {setting['shift']} pixels"] if setting["shift"] else []
    if more:
        lines.append(f"Trained, for every method, on {', '.join(more)} of the training samples as well.")
    others = [row["method"] for row in base_rows(result) if row["method"] not in ("direct", "inverse")]
    if others:
        lines.append("; ".join(f"{method}: {METHODS[method]}" for method in others) + ".")
    swept = {row["swept"] for row in result["rows"] if row["swept"]}
    if swept:
        lines.append(
            "To base: the difference in accuracy to the base setting on the same samples, with its paired "
            "interval."
        )
    if swept & result["published"]["sweeps"].keys():
        lines.append(
            f"The paper's figures are of {result['published']['data']}, not of these recordings "
            f"({result['published']['citation']}, third table)."
        )
    if any("update_us" in row for row in result["rows"]):
        lines.append(
            "Update: one event, features current after it, median over runs of 25 events. For each volume "
            "that holds the event the direct formulation takes O(K) steps, whatever patch and bins are, and "
            "a product from scratch O(K d), d = patch^2 bins; a larger patch lies in more volumes at the "
            "same stride. The inverse formulation solves its problem anew and pays for its active atoms."
        )
    early = next((row["early"] for row in result["rows"] if "early" in row), None)
    if early:
        whole = "" if setting["cuts"] else ", and training was on whole samples (--cuts any decides earlier)"
        lines.append(
            f"Early decision: {early['samples']:,} held-out samples, cut off after some time or some events; "
            f"the window ends at the cut{whole}. Times are the first measured points from which on the "
            "accuracy stays above the share."
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


def _leakage_note(leakage: dict[str, Any]) -> str:
    """The accuracy of a nearest neighbour in pixels, as a check of how samples are held out."""
    text = (
        f"Near copies: a nearest neighbour on 12x12 counts is right for {leakage['shuffled']:.1%} of samples "
        f"under shuffled folds, {leakage['blocks']:.1%} under blocks, {leakage['scored']:.1%} as scored here."
    )
    if leakage["leaks"]:
        return (
            f"WARNING: {text} Neighbours are near copies and stand on both sides of this split: the figures "
            "are too high for new data. Score folds with --groups block, or hold out blocks."
        )
    return f"{text} Neighbours are near copies, and are kept on one side." if leakage["copies"] else text
