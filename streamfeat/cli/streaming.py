"""Commands that run the main job: replay.

Lives here: their arguments, and how their results are shown.
Not here: the job (`stream.replay`).
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from streamfeat.cli.program import (
    EmitOption,
    JsonOption,
    ModelOption,
    OverwriteOption,
    QuietOption,
    RecordingArgument,
    SpeedOption,
    ThreadsOption,
    TopicOption,
    VerboseOption,
    app,
    err,
    model_or_general,
    out,
    print_losses,
    print_result,
    refuse_existing,
    tell_compiling,
)
from streamfeat.cli.progress import progress_bars
from streamfeat.cli.reading import print_assumptions, reads_recordings

if TYPE_CHECKING:
    from streamfeat.recordings.options import ReadOptions

__all__ = ["replay"]


@app.command(
    epilog="Example: streamfeat replay recordings/digits_test.mcap -m recordings/digits.safetensors "
    "-c recordings/digits_classifier.safetensors"
)
@reads_recordings()
def replay(
    recording: RecordingArgument,
    reading: "ReadOptions",
    model: ModelOption = None,
    classifier: Annotated[
        Path | None, typer.Option("--classifier", "-c", help="Classifier, from `streamfeat train`.")
    ] = None,
    emit: EmitOption = "bin",
    speed: SpeedOption = "max",
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write features and predictions to this MCAP file.")
    ] = None,
    json_lines: Annotated[
        Path | None,
        typer.Option(help="Write a JSON line for each emission to this file; - is stdout."),
    ] = None,
    features: Annotated[bool, typer.Option("--features", help="Include features in JSON lines.")] = False,
    table: Annotated[
        Path | None,
        typer.Option(help="Write features and predictions to this .parquet or .arrow file; extra `export`."),
    ] = None,
    split: Annotated[str | None, typer.Option(help="Replay only samples of this split.")] = None,
    learn_online: Annotated[
        bool, typer.Option("--learn-online", help="Learn from each label after predicting it.")
    ] = False,
    topic: TopicOption = None,
    threads: ThreadsOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    as_json: JsonOption = False,
) -> None:
    """A recording to features and predictions, scored where there are labels."""
    from streamfeat.stream.outputs import Outputs
    from streamfeat.stream.replay import ReplayJob, parse_speed

    for path in (output, json_lines, table):
        if path and str(path) != "-":
            refuse_existing(path, recording, model, classifier, overwrite=overwrite)
    job = ReplayJob(
        recording,
        model_or_general(model),
        classifier,
        emit=emit,
        speed=parse_speed(speed),
        topic=topic,
        reading=reading,
        split=split,
        learn_online=learn_online,
        threads=threads,
    )
    print_assumptions(job.assumptions)
    to_terminal = str(json_lines) == "-"
    tell_compiling(quiet=quiet or err.is_terminal)  # where there is a terminal, there is a bar
    with progress_bars(quiet=quiet or (to_terminal and out.is_terminal), below=out) as report:
        job.run(
            Outputs(
                console=None if quiet or as_json or to_terminal else out,
                every_sample=verbose,
                recording=output,
                json_lines=sys.stdout if to_terminal else json_lines,
                with_features=features,
                table=table,
            ),
            report,
        )
    if not to_terminal:
        print_result(job.result(), "replayed", as_json=as_json, command="replay")
    print_losses(job.losses)
    for line in job.advice:
        err.print(f"[yellow]too much work:[/] {escape(line)}", soft_wrap=True)
    if job.interrupted:
        raise typer.Exit(130)
