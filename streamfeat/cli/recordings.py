"""Commands that look at recordings and make them: info, convert.

Lives here: their arguments, and how their results are shown.
Not here: reading and writing (`recording`, `recorder`, `foreign`).
"""

from typing import Annotated, Any

import typer
from rich.markup import escape

from streamfeat.cli.program import (
    AnyLocation,
    ClusterOption,
    JsonOption,
    OverwriteOption,
    QuietOption,
    RecordingArgument,
    TopicOption,
    WorkersOption,
    app,
    err,
    print_losses,
    print_result,
    progress_bars,
    working,
)
from streamfeat.errors import InputError
from streamfeat.files.locations import location_of

__all__ = ["convert", "info"]

_FAULTS_SHOWN = 20


@app.command(epilog="Example: streamfeat info recordings/digits_test.mcap")
def info(recording: RecordingArgument, topic: TopicOption = None, as_json: JsonOption = False) -> None:
    """Topics, encoding, resolution, events, duration, rate, labels and integrity of a recording."""
    from streamfeat.recordings.reader import open_recording

    with open_recording(recording, topic) as rec:
        with progress_bars() as report:
            report("reading", 0, 0, "")
            n_events = rec.n_events  # reads the whole file
        height, width = rec.resolution
        labels = sorted({label.label for label in rec.labels})
        splits = sorted({label.split for label in rec.labels if label.split})
        result = {
            "file": str(recording),
            "topics": ", ".join(
                f"{t.name} ({t.schema}, {t.schema_encoding}, {t.n_messages})" for t in rec.topics
            ),
            "read": rec.topic,
            "encoding": rec.encoding,
            "resolution": f"{width}x{height}",
            "events": n_events,
            "on": rec.n_on,
            "off": rec.n_off,
            "first_us": rec.first_us,
            "duration_s": rec.duration_us / 1e6,
            "events_per_s": round(n_events / max(rec.duration_us / 1e6, 1e-6)),
            "samples": len(rec.labels),
            "labels": ", ".join(labels),
            "splits": ", ".join(splits),
            "integrity": "damaged" if rec.losses else "intact",
        }
        print_result(result, str(recording), as_json=as_json)
        print_losses(rec.losses)


@app.command(epilog="Example: streamfeat convert n-cars_train ncars.mcap --split-every 5")
def convert(
    source: Annotated[
        AnyLocation,
        typer.Argument(metavar="IN", help="Data set folder or camera file, or its URL.", parser=location_of),
    ],
    target: Annotated[
        AnyLocation, typer.Argument(metavar="OUT.mcap", help="Recording to write.", parser=location_of)
    ],
    split_every: Annotated[
        int | None,
        typer.Option(help="Every n-th sample is split 'validation', the others 'train'."),
    ] = None,
    split: Annotated[str | None, typer.Option(help="Split of all samples, whatever folders say.")] = None,
    limit: Annotated[int | None, typer.Option(help="Convert only so many, classes in balance.")] = None,
    gap_ms: Annotated[float, typer.Option(help="Silence between samples; at least one window.")] = 1000.0,
    encoding: Annotated[str, typer.Option(help="Payload: mono, libcaer_cmp, libcaer or evt3.")] = "mono",
    compression: Annotated[str, typer.Option(help="Chunks: zstd, lz4 or none.")] = "zstd",
    cluster: ClusterOption = None,
    workers: WorkersOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="List every file with a fault.")] = False,
    as_json: JsonOption = False,
) -> None:
    """A data set folder or a camera file to MCAP, with labels and splits from the folder layout.

    Files that cannot be read are reported, and the others converted; the exit status is 1 then.
    """
    from streamfeat.convert import datasets

    if not 0 < gap_ms < 1e9:
        raise InputError(f"a gap of {gap_ms} ms is not possible; give at least one window")
    with working(cluster, workers, quiet=quiet) as place, progress_bars(quiet=quiet) as report:
        done = datasets.convert(
            source,
            target,
            overwrite=overwrite,
            gap_us=round(gap_ms * 1000),
            split=split,
            split_every=split_every,
            encoding=encoding,
            compression=compression,  # type: ignore[arg-type]
            limit=limit,
            progress=lambda n, total: report("converting", n, total, ""),
            workers=place,
        )
    result: dict[str, Any] = {
        "written": str(target),
        "samples": done.samples,
        "events": done.events,
        "bytes_in": done.bytes_in,
        "bytes_out": done.bytes_out,
        "failed": len(done.failed),
        "damaged": len(done.damaged),
    }
    faults = {"failed": done.failed, "damaged": done.damaged}
    if as_json:
        result["faults"] = [
            {"file": str(path), "what": what, "reason": reason}
            for what, files in faults.items()
            for path, reason in files
        ]
    print_result(result, "converted", as_json=as_json)
    for what, files in faults.items():
        shown = files if verbose else files[:_FAULTS_SHOWN]
        for path, reason in shown:
            # What the reason begins with is the file already.
            where = reason if reason.startswith(str(path)) else f"{path}: {reason}"
            err.print(f"[yellow]{what}:[/] {escape(where)}", soft_wrap=True)
        if len(shown) < len(files):
            err.print(f"[yellow]{what}:[/] {len(files) - len(shown):,} more; --verbose lists all")
    if done.failed or done.damaged:
        raise typer.Exit(1)
