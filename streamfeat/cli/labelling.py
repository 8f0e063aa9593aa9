"""The command that labels a recording: label.

Lives here: its arguments, and what it says while it runs.
Not here: the page (`streamfeat.view`), the label file (`streamfeat.recordings.labels`).
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from streamfeat.cli.program import (
    JsonOption,
    OpenOption,
    OverwriteOption,
    QuietOption,
    RecordingArgument,
    TopicOption,
    WebPortOption,
    app,
    err,
    print_losses,
    print_result,
    refuse_existing,
)
from streamfeat.cli.progress import progress_bars
from streamfeat.cli.reading import print_assumptions, reads_recordings

if TYPE_CHECKING:
    from streamfeat.recordings.options import ReadOptions

__all__ = ["label"]


@app.command(epilog="Example: streamfeat label drive.mcap --classes wave,rest")
@reads_recordings(labels=False, noise=False)
def label(
    recording: RecordingArgument,
    reading: "ReadOptions",
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The label file; drive.labels.csv for drive.mcap if not given."),
    ] = None,
    classes: Annotated[
        str, typer.Option(metavar="NAMES", help="Classes to begin with, such as wave,rest; more on the page.")
    ] = "",
    mcap: Annotated[
        Path | None,
        typer.Option("--mcap", help="At the end, write events and labels to this recording, too."),
    ] = None,
    web_port: WebPortOption = 8766,
    open_browser: OpenOption = None,
    topic: TopicOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Mark intervals of a recording in the browser and name them, for `train --labels`.

    Press the key of a class where it begins and again where it ends, or drag over the timeline. Every change
    is saved; a label file that is there is gone on from. Ctrl-C ends.
    """
    from streamfeat.convert.export import convert_recording
    from streamfeat.recordings.options import ReadOptions
    from streamfeat.recordings.reader import open_recording
    from streamfeat.view.job import View, has_display
    from streamfeat.view.labelling import LabelSheet, label_path

    path = output or label_path(str(recording))
    if mcap:
        refuse_existing(mcap, recording, path, overwrite=overwrite)
    if not path.exists():
        refuse_existing(path, recording, overwrite=False)
    with open_recording(recording, topic, reading) as rec:
        print_assumptions(rec.assumptions)
        sheet = LabelSheet(rec, path, [name for name in classes.split(",") if name.strip()])
    view = View(
        recording,
        labels=sheet,
        web_port=web_port,
        open_browser=has_display() if open_browser is None else open_browser,
        say=lambda line: None if quiet else err.print(escape(line), soft_wrap=True),
        topic=topic,
        reading=reading,
    )
    view.run()
    sheet.check_saved()
    result = sheet.result()
    if mcap and result["labels"] is not None:
        read = ReadOptions(reading.columns, reading.time_unit, reading.resolution, str(path))
        with progress_bars(quiet=quiet) as report:
            done = convert_recording(
                recording,
                mcap,
                topic,
                read,
                overwrite=overwrite,
                progress=lambda n, total: report("writing", n, total, ""),
            )
        print_losses(done.losses)
    result["written"] = str(mcap) if mcap and result["labels"] is not None else None
    print_result(result, str(recording), as_json=as_json, command="label")
