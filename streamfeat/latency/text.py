"""A latency report in words and numbers.

Lives here: rows as text, models in one line, and notes for readers of the figures.
Not here: tables and pictures that show them (`cli`, `picture`).
"""

from streamfeat.latency.measure import LatencyReport, Model, Row
from streamfeat.latency.others import Method

__all__ = ["COLUMNS", "cells", "describe", "notes", "spell"]

COLUMNS = ("emit", "what", "n", "mean", "p50", "p90", "p99", "p99.9", "max", "p99/p50", "p99.9/p50")
"""Of a row as text, see `cells`; all but the first two are numbers, times as in `spell`."""


def spell(ns: float | None) -> str:
    """A time to 3 digits: microseconds below 10 ms, from there on with a unit; `-` for None."""
    if ns is None:
        return "-"
    unit, size = ("", 1e3) if ns < 1e7 else ("ms", 1e6) if ns < 1e9 else ("s", 1e9)
    value = ns / size
    digits = 0 if value >= 99.95 else 1 if value >= 9.995 else 2 if value >= 0.9995 else 3
    return f"{value:,.{digits}f}{unit}"


def cells(row: Row) -> list[str]:
    """A row as text, by `COLUMNS`."""
    figures = row.latencies.figures()
    times = [figures[f"{name}_ns"] for name in ("mean", "p50", "p90", "p99", "p99.9", "max")]
    ratios = [figures["p99_to_p50"], figures["p99.9_to_p50"]]
    return [
        row.emit,
        row.what,
        f"{row.latencies.n:,}",
        *[spell(ns) for ns in times],
        *["-" if ratio is None else f"{ratio:.3g}" for ratio in ratios],
    ]


def describe(model: Model | Method) -> str:
    """A model or method in one line."""
    m = model.describe()
    if "method" in m:
        return f"{m['model']}: {m['method']}"
    short = "" if m["volume_bins"] == m["bins"] else f"volumes of {m['volume_bins']} of "
    return (
        f"{m['model']}: {m['formulation']}, {m['encoding']}, K = {m['filters']}, patch {m['patch']}, "
        f"stride {m['stride']}, {short}{m['bins']} bins of {m['bin_us'] / 1000:g} ms"
    )


def notes(report: LatencyReport) -> list[str]:
    """Notes for readers of the figures."""
    result = report.result()
    machine = result["machine"]
    said = [
        "Times in microseconds where no unit is given. Not counted: compilation, and the first "
        f"{result['warm_up_events']:,} events of each measurement.",
        "update: from handing over an event until features are current, timed in a compiled loop; "
        "bin boundary: those events alone that begin a bin. from Python: follow() and features() called for "
        "each event. ingest: feed(), its time shared out among the events of a batch; emission: features(). "
        f"end to end: from when a packet is due, at {result['speed']:g} x the recorded pace, until a sink "
        "holds the emission.",
    ]
    how = "with" if result["look_ahead"] else "without"
    said += [
        f"{row.model.name}: {100 * row.boundary_share:.3f} % of events began a bin, {how} look-ahead."
        for row in report.rows
        if row.boundary_share is not None
    ]
    said.append(
        f"Reading the clock costs {result['clock_ns']:.0f} ns, {result['python_clock_ns']:.0f} ns from "
        "Python; once in each latency, not subtracted. - stands where n is too small for a percentile."
    )
    if result["steal_share"] is not None:
        said.append(
            f"Other virtual machines had {100 * result['steal_share']:.1f} % of the processor time; other "
            f"processes interrupted this one {result['preemptions']:,} times."
        )
    said.append(
        f"{machine['cpu']}, {machine['cores']} cores, {machine['system']}, Python {machine['python']}, "
        f"numba {machine['numba']}, numpy {machine['numpy']}."
    )
    if result["interrupted"]:
        said.append("Interrupted: the last measurement is shorter, and others are missing.")
    return said
