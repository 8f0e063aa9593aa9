"""Results as the tables of `tools/bench/README.md`.

Lives here: Markdown from the JSON of a run, and the place in the page where it goes.
Not here: measuring; verdicts (`targets`).
"""

from pathlib import Path
from typing import Any

from tools.bench.targets import Verdict, judge

__all__ = ["BEGIN", "END", "TABLES", "insert", "markdown", "read_between", "verdict_lines"]

BEGIN, END = "<!-- bench:begin -->", "<!-- bench:end -->"


def insert(readme: str, results: dict[str, Any]) -> str:
    """The page with the part between the markers made anew.

    Raises:
        ValueError: the markers are not there.
    """
    before, begin, rest = readme.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"the page has no {BEGIN} ... {END}")
    return f"{before}{BEGIN}\n{markdown(results)}\n{END}{after}"


def read_between(readme: Path) -> str:
    """What stands between the markers."""
    return readme.read_text(encoding="utf-8").partition(BEGIN)[2].partition(END)[0].strip("\n")


def markdown(results: dict[str, Any]) -> str:
    """Everything that the page shows of a run."""
    parts = results["parts"]
    blocks = [_machine(results), _targets(results)]
    blocks += [table(parts[name]) for name, table in TABLES.items() if name in parts]
    if "scaling" in parts:
        blocks.append(
            "![Latency against K, patch, bins and stride](scaling.svg)\n\n"
            "The paper's table of complexity, measured: an update of the direct formulation costs O(K), "
            "whatever the patch and the bins; from scratch O(K d); the inverse formulation pays for its "
            "active atoms."
        )
    return "\n\n".join(block for block in blocks if block)


def verdict_lines(results: dict[str, Any]) -> list[str]:
    """One line a target, for the terminal."""
    return [
        f"{_verdict(v):>9}  {v.target.figure.replace('`', '')}: {_value(v)}, floor {v.target.text}"
        for v in judge(results)
    ]


def _machine(results: dict[str, Any]) -> str:
    machine, setting = results["machine"], results["setting"]
    caches = ", ".join(f"{name} {size}" for name, size in machine["caches"].items())
    return (
        f"Measured on {machine['cores']} cores of {machine['processor']}"
        f"{' (a shared virtual machine)' if machine['hypervisor'] else ''}, {caches}, with "
        f"`{setting['recording']}` at K = {setting['n_filters']}, patch 12, {setting['n_bins']} bins. "
        "Contestants run in turns in one process; medians (10th to 90th percentile) of times, or of ratios "
        "inside a round; compilation and warm-up are not counted. `python tools/bench` measures it on "
        "your machine; [`results.json`](results.json) has every figure." + _elsewhere(results)
    )


def _elsewhere(results: dict[str, Any]) -> str:
    """A sentence for each other machine that parts were measured on."""
    here, others = results["machine"]["processor"], dict[str, list[str]]()
    for name, run in results["runs"].items():
        if run["processor"] != here:
            others.setdefault(run["processor"], []).append(f"`{name}`")
    return "".join(f" Measured on {place}: {', '.join(names)}." for place, names in others.items())


def _targets(results: dict[str, Any]) -> str:
    rows = [(v.target.figure, v.target.text, _value(v), _verdict(v), v.target.why) for v in judge(results)]
    return _table(("figure", "floor", "measured", "", "why this much"), rows)


def _verdict(verdict: Verdict) -> str:
    return {True: "met", False: "not met", None: "no figure"}[verdict.met]


def _value(verdict: Verdict) -> str:
    if verdict.value is None:
        return "not measured"
    return _spread(verdict.found) if isinstance(verdict.found, dict) else f"{verdict.value:.3g}"


def _floors(part: dict[str, Any]) -> str:
    ns = part["race"]["ns"]
    rows = [("streamfeat", _time(ns["ours"]), "1")]
    if part["floor"]:
        rows.append(
            (f"the same update in {part['floor']}", _time(ns[part["floor"]]), _over(part["ours_over_floor"]))
        )
    if part["bytes"]:
        size = f"{part['bytes']['bytes'] / 1e3:.0f} kB"
        rows.append(
            (f"the bytes alone: {size}", _time(part["bytes"]["ns"]), _over(part["bytes"]["ours_over_bytes"]))
        )
    return (
        "**Floors**: one event and volume, `soft`. The C is compiled with `-O3 -march=native`, its features "
        f"{_same_features(part['floor_equals_ours'])}; the bytes are one column read, the projection and the "
        "pooled sums read and written, the offsets read, each array walked over alone in the order of the "
        "same events.\n\n"
        + _table(
            ("", "time", "streamfeat takes"), [(a, b, c if c == "1" else f"{c} x that") for a, b, c in rows]
        )
    )


def _same_features(equal: bool | None) -> str:
    return {True: "are those of the engine, bit for bit", False: "DIFFER", None: "were not compared"}[equal]


def _peers(part: dict[str, Any]) -> str:
    rows = [
        (
            name.replace("ours", "streamfeat"),
            _time(figure),
            _over(part["over_ours"][name]) + " x" if name in part["over_ours"] else "",
        )
        for name, figure in part["race"]["ns"].items()
    ]
    return (
        "**Direct formulation**: one event and volume.\n\n"
        + _table(("", "time", "slower than `soft`"), rows)
        + _missing(part)
    )


def _cameras(part: dict[str, Any]) -> str:
    if set(part) == {"missing"}:
        return ""
    rows = [
        (
            f"{found['resolution'][1]}x{found['resolution'][0]}",
            name.replace("ours", "streamfeat"),
            _time(figure),
            _over(found["over_ours"][name]) + " x" if name in found["over_ours"] else "",
        )
        for found in part.values()
        for name, figure in found["race"]["ns"].items()
    ]
    events = ", ".join(f"{found['events_per_emission']:,}" for found in part.values())
    differences = [found["largest_difference"] for found in part.values() if found["largest_difference"]]
    agreement = f" Its features are ours to {max(differences):.1g} of the largest." if differences else ""
    return (
        f"**Cameras**: an emission every 10 ms, K = 400, stride 4, `split`, {events} events each. PyTorch is "
        f"given its frames; one thread is timed by the processor, several by the clock.{agreement}\n\n"
        + _table(("sensor", "", "time an emission", "slower"), rows)
        + _missing(next(iter(part.values())))
    )


def _inverse(part: dict[str, Any]) -> str:
    rows = [
        (
            f"{found['threshold']:g}",
            f"{found['nonzero']}",
            name.replace("ours", "streamfeat"),
            _time(figure),
            _over(found["over_ours"][name]) + " x" if name in found["over_ours"] else "",
            f"{found['largest_relative_gap'][name]:.1g}" if name in found["largest_relative_gap"] else "",
        )
        for found in part.values()
        for name, figure in found["race"]["ns"].items()
    ]
    return (
        "**Inverse formulation**: one event and volume, for three penalties; how many atoms a code uses "
        "decides the time of each.\n\n"
        + _table(("lambda0", "atoms in use", "", "time", "slower", "largest relative gap"), rows)
        + _missing(next(iter(part.values())))
    )


def _ingest(part: dict[str, Any]) -> str:
    rows = [
        (name.replace("ours", "`Engine.feed`"), f"{rate:g}")
        for name, rate in part["million_events_per_s"].items()
    ]
    return "**Ingest alone**: million events a second.\n\n" + _table(("", "Mev/s"), rows) + _missing(part)


def _learning(part: dict[str, Any]) -> str:
    rows = [
        (name.replace("ours", "streamfeat"), _time(figure)) for name, figure in part["race"]["ns"].items()
    ]
    return (
        f"**One online learning step**: a sample of {part['features']:,} features; from nothing, ours learns "
        "15 earlier samples again with each.\n\n" + _table(("", "time a sample"), rows) + _missing(part)
    )


def _replay(part: dict[str, Any]) -> str:
    rows = [
        (
            name,
            *(f"{figures['events_per_s'][kind]:,}" for kind in figures["events_per_s"]),
            f"{figures['emissions']:,}",
        )
        for name, figures in part.items()
    ]
    return "**Replay**: events a second, lz4, `--emit 10ms`, K = 400, stride 4.\n\n" + _table(
        ("recording", "replay", "reading messages", "reading and decoding", "emissions"), rows
    )


def _latency(part: dict[str, Any]) -> str:
    if "missing" in part:
        return ""
    rows = []
    for mode, figures in part.items():
        for kind, what in (("update", "each event's median"), ("as they came", "all runs as they came")):
            tails = [_microseconds(figures[kind][f"{p}_ns"]) for p in ("p50", "p90", "p99", "p99.9", "max")]
            rows.append((f"{mode}, {what}", *tails))
    share = 100 * part["looking ahead"]["update"]["boundary_share"]
    return (
        "**Latency of single events**, stride 4, in microseconds, the same stream several times; "
        f"{share:.2f} % of the events begin a bin.\n\n"
        + _table(("", "p50", "p90", "p99", "p99.9", "max"), rows)
    )


def _memory(part: dict[str, Any]) -> str:
    rows = [
        (
            mode,
            f"{f['least_bytes'] / 1e6:.1f}",
            f"{f['state_bytes'] / 1e6:.1f}",
            f"{f['resident_bytes'] / 1e6:.1f}",
        )
        for mode, f in part.items()
    ]
    operator = next(iter(part.values()))["operator_bytes"] / 1e6
    return (
        "**Memory** of an engine for 640x480, downsample 4, stride 4, in MB. The minimum: `4 T H W` for "
        "counts, `4 V K` for projections, looking ahead twice that, `16 K` for pooled sums. The operator, "
        f"{operator:.1f} MB, is shared and read-only.\n\n"
        + _table(("", "minimum", "state", "resident"), rows)
    )


def _overload(part: dict[str, Any]) -> str:
    return (
        f"**Overload**: `--emit event` takes in {part['event_carries_per_s']:,} events a second here. "
        f"Offered {part['offered_per_s']:,} a second, `--emit auto` took in {part['accepted']:,} of "
        f"{part['events']:,} in {part['seconds']:g} s (offered in {part['seconds_offered']:g} s), with "
        f"{part['emissions']:,} emissions; {part['with_the_bits_of_the_offline_encoder']} of "
        f"{part['compared']} that were compared have the bits of the offline encoder."
    )


def _cluster(part: dict[str, Any]) -> str:
    if "missing" in part:
        return ""
    places = part["places"] | {
        f"a worker of two killed while {step}": found for step, found in part["killed"].items()
    }
    rows = [
        (
            name,
            f"{found['learn_s']:.1f}",
            f"{found['encode_s']:.1f}",
            f"{found.get('most_mb') or ''}",
            "yes" if found["same"] else "NO",
        )
        for name, found in places.items()
    ]
    return f"**Workers**: {part['samples']:,} samples, K = 400.\n\n" + _table(
        ("where", "learn, s", "encode, s", "most MB of a worker", "same bits"), rows
    )


def _growth(part: dict[str, Any]) -> str:
    rows = []
    for row in part["rows"]:
        height, width = row["resolution"]
        tails = [row.get(f"latency_{p}_us") for p in ("p50", "p99")]
        rows.append(
            (
                f"`{row['emit']}`",
                *(str(row[name]) for name in ("filters", "stride", "cameras")),
                f"{width}x{height}",
                f"{row['rate'] / 1e6:g}",
                f"{row['ns']['p50']:,.0f}",
                *("" if tail is None else _short(tail) for tail in tails),
            )
        )
    return (
        "**Growth**: nanoseconds of the processor an event, and the latency of an event, or of an emission, "
        "in microseconds.\n\n"
        + _table(("emit", "K", "stride", "cameras", "sensor", "Mev/s", "ns", "p50", "p99"), rows)
        + "\n\n![Cost of an event against K, stride, resolution, rate and cameras](growth.svg)"
    )


def _missing(part: dict[str, Any]) -> str:
    return f"\n\nNot measured: `pip install {' '.join(part['missing'])}`." if part.get("missing") else ""


TABLES = {
    "floors": _floors,
    "peers": _peers,
    "cameras": _cameras,
    "inverse": _inverse,
    "ingest": _ingest,
    "latency": _latency,
    "replay": _replay,
    "learning": _learning,
    "memory": _memory,
    "overload": _overload,
    "cluster": _cluster,
    "growth": _growth,
}


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" if i == 0 else "---:" for i in range(len(head))), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _time(figure: dict[str, float]) -> str:
    """A time in nanoseconds, microseconds or milliseconds, with its spread."""
    unit, size = next(
        (u, s) for u, s in (("ms", 1e6), ("us", 1e3), ("ns", 1.0)) if figure["p50"] >= s or s == 1.0
    )
    p50, p10, p90 = (_short(figure[name] / size) for name in ("p50", "p10", "p90"))
    return f"{p50} {unit} ({p10} to {p90})"


def _microseconds(ns: float | None) -> str:
    return "" if ns is None else _short(ns / 1e3)


def _over(figure: dict[str, float]) -> str:
    return _short(figure["p50"])


def _spread(figure: dict[str, float]) -> str:
    return f"{_short(figure['p50'])} ({_short(figure['p10'])} to {_short(figure['p90'])})"


def _short(value: float) -> str:
    """Three digits that count."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
