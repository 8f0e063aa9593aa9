"""Commands that look at recordings and make them: info, convert.

Lives here: their arguments, and how their results are shown.
Not here: reading and writing (`recordings`, `convert`).
"""

from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from streamfeat.cli.overview import has_several, print_overview
from streamfeat.cli.program import (
    AnyLocation,
    ClusterOption,
    JsonOption,
    OverwriteOption,
    QuietOption,
    RecordingsArgument,
    TopicOption,
    WorkersOption,
    app,
    err,
    print_losses,
    print_result,
    working,
)
from streamfeat.cli.progress import progress_bars
from streamfeat.cli.reading import print_assumptions, reads_recordings
from streamfeat.errors import InputError
from streamfeat.files.locations import Location, location_of

if TYPE_CHECKING:
    from streamfeat.recordings.options import ReadOptions

__all__ = [
    "GapOption",
    "HoldOutOption",
    "InterleavedOption",
    "LimitOption",
    "convert",
    "info",
    "listed_faults",
    "print_faults",
]

_FAULTS_SHOWN = 20

Faults = dict[str, list[tuple[Location, str]]]
"""By what became of them, files and the reason of each."""

HoldOutOption = Annotated[
    str | None,
    typer.Option(metavar="I/N", help="Block I of N of each class is split 'validation', else 'train'."),
]
InterleavedOption = Annotated[
    int | None, typer.Option(help="Every n-th sample is 'validation': only where neighbours differ.")
]
LimitOption = Annotated[int | None, typer.Option(help="Take only so many samples, classes in balance.")]
GapOption = Annotated[float, typer.Option(help="Silence between samples; at least one window.")]


@app.command(epilog="Example: streamfeat info recordings/digits_test.mcap")
@reads_recordings()
def info(
    recordings: RecordingsArgument,
    reading: "ReadOptions",
    topic: TopicOption = None,
    as_json: JsonOption = False,
) -> None:
    """Topics, encoding, resolution, events, duration, rate, labels and integrity of a recording.

    Of several recordings, or of one with several cameras, a table with a row for each camera.
    """
    from streamfeat.messages.timeline import TIMELINE_COUNTS
    from streamfeat.recordings.reader import open_recording

    if has_several(recordings, topic, reading):
        print_overview(recordings, topic, reading, as_json=as_json)
        return
    recording = recordings[0]
    with open_recording(recording, topic, reading) as rec:
        print_assumptions(rec.assumptions)
        with progress_bars() as report:
            report("reading", 0, 0, "")
            n_events = rec.n_events  # reads the whole file
        labels = sorted({label.label for label in rec.labels})
        splits = sorted({label.split for label in rec.labels if label.split})
        result = {
            "file": str(recording),
            "topics": [
                {
                    "name": t.name,
                    "schema": t.schema,
                    "schema_encoding": t.schema_encoding,
                    "messages": t.n_messages,
                }
                for t in rec.topics
            ],
            "read": rec.topic,
            "encoding": rec.encoding,
            "resolution": list(rec.resolution),
            "other_resolutions": [
                {"resolution": list(size), "packets": n}
                for size, n in rec.resolutions.items()
                if size != rec.resolution
            ],
            "events": n_events,
            "on": rec.n_on,
            "off": rec.n_off,
            "rejected": rec.n_outside,
            "first_us": rec.first_us,
            "duration_s": rec.duration_us / 1e6,
            "events_per_s": round(n_events / max(rec.duration_us / 1e6, 1e-6)),
            "samples": len(rec.labels),
            "labels": labels,
            "splits": splits,
            "digest": rec.digest,
            **{name.replace(" ", "_"): rec.counts[name] for name in TIMELINE_COUNTS},
            "unread": dict(rec.losses.counts),
            "integrity": "damaged" if rec.losses else "intact",
            "removed": rec.removed,
        }
        print_result(result, str(recording), as_json=as_json, command="info")
        print_losses(rec.losses)


@app.command(epilog="Example: streamfeat convert n-cars_train ncars.mcap --hold-out 1/5")
@reads_recordings()
def convert(
    source: Annotated[
        AnyLocation,
        typer.Argument(metavar="IN", help="Data set folder or recording, or its URL.", parser=location_of),
    ],
    target: Annotated[
        AnyLocation,
        typer.Argument(metavar="OUT", help=".mcap, .raw, .h5, .npz or .csv.", parser=location_of),
    ],
    reading: "ReadOptions",
    topic: TopicOption = None,
    start: Annotated[float | None, typer.Option(help="Seconds after the first event to begin at.")] = None,
    end: Annotated[float | None, typer.Option(help="Seconds after the first event to end at.")] = None,
    crop: Annotated[
        str | None, typer.Option(metavar="X,Y,W,H", help="Take these pixels only; X,Y becomes 0,0.")
    ] = None,
    hold_out: HoldOutOption = None,
    interleaved: InterleavedOption = None,
    split: Annotated[str | None, typer.Option(help="Split of all samples, whatever folders say.")] = None,
    limit: LimitOption = None,
    gap_ms: GapOption = 1000.0,
    encoding: Annotated[str, typer.Option(help="Payload: mono, libcaer_cmp, libcaer or evt3.")] = "mono",
    compression: Annotated[str, typer.Option(help="Chunks: zstd, lz4 or none.")] = "zstd",
    cluster: ClusterOption = None,
    workers: WorkersOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="List every file with a fault.")] = False,
    as_json: JsonOption = False,
) -> None:
    """A data set folder to MCAP, with labels and splits; or a recording, or some of it, to another format.

    Files of a data set that cannot be read are reported, and the others converted; the exit status is 1 then.
    """
    from streamfeat.convert import datasets
    from streamfeat.convert.export import convert_recording
    from streamfeat.convert.selection import Selection
    from streamfeat.convert.splits import parse_hold_out

    if not 0 < gap_ms < 1e9:
        raise InputError(f"a gap of {gap_ms} ms is not possible; give at least one window")
    selection = Selection.parse(start, end, crop)
    block = parse_hold_out(hold_out) if hold_out is not None else None
    formats = {"overwrite": overwrite, "encoding": encoding, "compression": compression}
    if not datasets.is_data_set(source):
        if block or interleaved or split or limit:
            raise InputError(
                f"{source}: is one recording; --hold-out, --interleaved, --split and --limit are for folders "
                "of samples"
            )
        with progress_bars(quiet=quiet) as report:
            exported = convert_recording(
                source,
                target,
                topic,
                reading,
                selection,
                progress=lambda n, total: report("converting", n, total, ""),
                **formats,  # type: ignore[arg-type]
            )
        print_assumptions(exported.assumptions)
        result: dict[str, Any] = {"written": str(target)} | exported.result()
        print_result(result, "converted", as_json=as_json, command="convert")
        print_losses(exported.losses)
        if exported.losses:
            raise typer.Exit(1)
        return
    if selection or reading.labels or topic:
        raise InputError(
            f"{source}: is a folder of samples; --start, --end, --crop, --topic and --labels are for one "
            "recording"
        )
    if interleaved:
        err.print(
            "[yellow]interleaved:[/] where samples were cut from video, neighbours are near copies and none "
            "is held out; --hold-out 1/5 takes blocks",
            soft_wrap=True,
        )
    with working(cluster, workers, quiet=quiet) as place, progress_bars(quiet=quiet) as report:
        done = datasets.convert(
            source,
            target,
            gap_us=round(gap_ms * 1000),
            split=split,
            hold_out=block,
            interleaved=interleaved,
            limit=limit,
            denoising=reading.denoising,
            progress=lambda n, total: report("converting", n, total, ""),
            workers=place,
            **formats,  # type: ignore[arg-type]
        )
    result = {
        "written": str(target),
        "samples": done.samples,
        "events": done.events,
        "bytes_in": done.bytes_in,
        "bytes_out": done.bytes_out,
        "failed": len(done.failed),
        "damaged": len(done.damaged),
        "removed": done.removed,
    }
    faults = {"failed": done.failed, "damaged": done.damaged}
    if as_json:
        result["faults"] = listed_faults(faults)
    print_result(result, "converted", as_json=as_json, command="convert")
    print_faults(faults, verbose=verbose)
    if done.failed or done.damaged:
        raise typer.Exit(1)


def listed_faults(faults: Faults) -> list[dict[str, str]]:
    """Faults as JSON has them."""
    return [
        {"file": str(path), "what": what, "reason": reason}
        for what, files in faults.items()
        for path, reason in files
    ]


def print_faults(faults: Faults, *, verbose: bool) -> None:
    """Say on standard error what is wrong with which file; the first of each kind only, unless `verbose`."""
    for what, files in faults.items():
        shown = files if verbose else files[:_FAULTS_SHOWN]
        for path, reason in shown:
            # What the reason begins with is the file already.
            where = reason if reason.startswith(str(path)) else f"{path}: {reason}"
            err.print(f"[yellow]{what}:[/] {escape(where)}", soft_wrap=True)
        if len(shown) < len(files):
            err.print(f"[yellow]{what}:[/] {len(files) - len(shown):,} more; --verbose lists all")
