"""What `info` shows of several recordings, or of one with several cameras: a row for each.

Lives here: the rows, as a table and as JSON. Not here: all that is told of one topic (`recordings`).
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from streamfeat.cli.program import err, out, print_json
from streamfeat.cli.progress import progress_bars
from streamfeat.errors import InputError, printable
from streamfeat.files.locations import Location, location_of

if TYPE_CHECKING:
    from streamfeat.recordings.options import ReadOptions

__all__ = ["has_several", "print_overview"]


def has_several(recordings: Sequence[Location], topic: str | None, reading: "ReadOptions") -> bool:
    """Whether there is more than one topic of events to tell of.

    Raises:
        InputError: there is but one recording, and it cannot be opened.
    """
    from streamfeat.recordings.event_topics import event_topics

    return len(recordings) > 1 or (topic is None and len(event_topics(recordings[0], reading)) > 1)


def print_overview(
    recordings: Sequence[Location], topic: str | None, reading: "ReadOptions", *, as_json: bool
) -> None:
    """Print a row for each topic of events of each recording; what cannot be read is a line, and status 1."""
    rows: list[dict[str, Any]] = []
    with progress_bars() as report:
        for done, place in enumerate(recordings):
            report("reading", done, len(recordings), str(place))
            rows += _rows_of(place, topic, reading)
    if as_json:
        print_json("info REC REC", {"recordings": rows})
    else:
        _print_table([row for row in rows if "error" not in row])
        for row in rows:
            if "error" in row:
                err.print(f"[red]error:[/] {escape(row['error'])}", soft_wrap=True)
    if any("error" in row for row in rows):
        raise typer.Exit(1)


def _rows_of(place: Location, topic: str | None, reading: "ReadOptions") -> list[dict[str, Any]]:
    from streamfeat.recordings.event_topics import event_topics
    from streamfeat.recordings.reader import open_recording

    rows: list[dict[str, Any]] = []
    names: Sequence[str | None] = [topic]
    try:
        if topic is None:
            names = event_topics(place, reading) or [None]
        for name in names:
            with open_recording(place, name, reading) as rec:
                n_events = rec.n_events  # reads the whole file
                rows.append(
                    {
                        "file": str(place),
                        "topic": rec.topic,
                        "encoding": rec.encoding,
                        "resolution": list(rec.resolution),
                        "events": n_events,
                        "duration_s": rec.duration_us / 1e6,
                        "samples": len(rec.labels),
                        "digest": rec.digest,
                        "integrity": "damaged" if rec.losses else "intact",
                    }
                )
    except InputError as error:
        rows.append({"file": str(place), "error": str(error)})
    return rows


def _print_table(rows: Sequence[dict[str, Any]]) -> None:
    table = Table(box=None, pad_edge=False)
    right = {"events", "seconds", "samples"}
    for name in ("file", "topic", "encoding", "size", "events", "seconds", "samples", "", "digest"):
        table.add_column(name, justify="right" if name in right else "left", no_wrap=not out.is_terminal)
    for row in rows:
        height, width = row["resolution"]
        cells = (
            location_of(row["file"]).name,
            row["topic"],
            row["encoding"],
            f"{width}x{height}",
            f"{row['events']:,}",
        )
        more = f"{row['duration_s']:.3f}", f"{row['samples']:,}", row["integrity"], row["digest"][:12]
        table.add_row(*(escape(printable(cell)) for cell in (*cells, *more)))
    if not rows:
        return
    if out.is_terminal:
        out.print(table)
    else:
        # Nothing is cut where a program reads it, or a file.
        widest = table.__rich_measure__(out, out.options.update(max_width=10_000)).maximum
        Console(width=widest, highlight=False, emoji=False).print(table)
