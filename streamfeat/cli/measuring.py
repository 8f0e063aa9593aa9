"""Commands that measure: latency.

Lives here: their arguments, and how their results are shown.
Not here: the measurements (`latency`).
"""

from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from streamfeat.cli.program import (
    JsonOption,
    OverwriteOption,
    QuietOption,
    RecordingArgument,
    StepsOption,
    ThreadsOption,
    TopicOption,
    app,
    compile_first,
    completing,
    err,
    model_or_general,
    out,
    print_json,
    refuse_existing,
)
from streamfeat.cli.progress import progress_bars
from streamfeat.cli.reading import print_assumptions, reads_recordings
from streamfeat.cli.tables import print_table
from streamfeat.work import interrupts

if TYPE_CHECKING:
    from streamfeat.latency.measure import LatencyReport
    from streamfeat.recordings.options import ReadOptions

__all__ = ["latency"]

_NOTABLE_STEAL = 0.05


@app.command(
    epilog="Example: streamfeat latency recordings/digits_test.mcap -m recordings/digits.safetensors "
    "--plot latency.html"
)
@reads_recordings()
def latency(
    recording: RecordingArgument,
    reading: "ReadOptions",
    models: Annotated[
        list[Path] | None,
        typer.Option(
            "--model",
            "-m",
            help="Model, from `streamfeat learn`; may be repeated.",
            show_default="the general one",
        ),
    ] = None,
    emit: Annotated[
        list[str],
        typer.Option(
            help="When to emit features: event, 1000ev, 10ms or auto; may be repeated.",
            autocompletion=completing("event", "1000ev", "10ms", "auto"),
        ),
    ] = ["event", "10ms", "auto"],  # noqa: B006  (Typer's way; it is never changed)
    look_ahead: Annotated[
        bool, typer.Option(help="Prepare bin boundaries beforehand where every event is followed.")
    ] = True,
    seconds: Annotated[float, typer.Option(help="Clock seconds for each measurement, at most.")] = 2.0,
    limit_events: Annotated[
        int, typer.Option(help="Events counted in each measurement of updates, at most.")
    ] = 50_000,
    warm_up: Annotated[int, typer.Option(help="Events that run before any is counted.")] = 2_000,
    speed: Annotated[
        float, typer.Option(help="Pace of end to end: 1 is the recorded one, 2 twice that.")
    ] = 1.0,
    split: Annotated[str | None, typer.Option(help="Measure on samples of this split only.")] = None,
    methods: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            help="Updates of others beside: hats, hots, dart, hfirst, gabor-snn or counts; may be repeated.",
            autocompletion=completing("hats", "hots", "dart", "hfirst", "gabor-snn", "counts"),
        ),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Draw to this file: .html (interactive) or .png; extra `plot`.")
    ] = None,
    topic: TopicOption = None,
    threads: ThreadsOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    verbose: StepsOption = False,
    as_json: JsonOption = False,
) -> None:
    """Per-event update latency and that of end to end: percentiles for each model and policy."""
    from streamfeat.latency.measure import LatencyReport
    from streamfeat.latency.picture import check_picture, draw

    if plot:
        check_picture(plot)
        refuse_existing(plot, recording, *(models or ()), overwrite=overwrite)
    report = LatencyReport(
        recording,
        models or [model_or_general(None)],
        emit,
        topic=topic,
        reading=reading,
        split=split,
        warm_up=warm_up,
        limit_events=limit_events,
        seconds=seconds,
        speed=speed,
        look_ahead=look_ahead,
        threads=threads,
        methods=methods or (),
    )
    print_assumptions(report.assumptions)
    compile_first(report.states, quiet=quiet)
    try:
        with progress_bars(from_a_thread=False, quiet=quiet, as_lines=verbose) as progress:
            progress("compiling", 0, 0, "not counted")
            report.compile()
            progress("compiling", 1, 1, "")
            stopped = Event()
            with interrupts.kept_by(stopped.set):
                report.run(progress, stopped.is_set)
    except KeyboardInterrupt:  # before there is anything to show
        raise typer.Exit(130) from None
    if as_json:
        print_json("latency", report.result())
    else:
        _print(report)
    if plot and report.rows:
        draw(plot, report)
    if report.interrupted:
        raise typer.Exit(130)


def _print(report: "LatencyReport") -> None:
    from streamfeat.latency.text import COLUMNS, cells, describe, notes

    for name in dict.fromkeys(row.model.name for row in report.rows):
        rows = [row for row in report.rows if row.model.name == name]
        columns = [column.replace("/", "\n/") for column in COLUMNS]
        print_table(out, describe(rows[0].model), columns, [cells(row) for row in rows], left=(0, 1), keys=2)
    for note in notes(report):
        out.print(f"[dim]{escape(note)}[/]")
    if report.steal is not None and report.steal > _NOTABLE_STEAL:
        err.print(
            f"[yellow]steal:[/] {100 * report.steal:.0f} % of the processor time went to other virtual "
            "machines; the tails are theirs too",
            soft_wrap=True,
        )
