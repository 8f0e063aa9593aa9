"""The command that compares: evaluate.

Lives here: its arguments, and how its result is shown.
Not here: the evaluation (`streamfeat.evaluate`).
"""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from streamfeat.cli import options
from streamfeat.cli.program import (
    ClusterOption,
    JsonOption,
    OverwriteOption,
    QuietOption,
    RecordingsArgument,
    StepsOption,
    TopicOption,
    WorkersOption,
    app,
    compile_first,
    err,
    out,
    print_json,
    refuse_existing,
    working,
)
from streamfeat.cli.progress import progress_bars
from streamfeat.cli.reading import print_assumptions, reads_recordings
from streamfeat.cli.tables import print_table
from streamfeat.errors import InputError
from streamfeat.work import interrupts

if TYPE_CHECKING:
    from streamfeat.recordings.options import ReadOptions

__all__ = ["evaluate"]

_WIDEST_CONFUSION = 12
"""Labels that fit into a terminal; the JSON and the page have all."""


@app.command(
    epilog="Example: streamfeat evaluate recordings/digits_train.mcap recordings/digits_test.mcap "
    "--patch 8 --method direct --method hats --sweep filters=50,200 -o result.json --report result.html"
)
@reads_recordings()
def evaluate(
    context: typer.Context,
    recordings: RecordingsArgument,
    reading: "ReadOptions",
    methods: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            help="direct, inverse, kmeans, random, model, hats, hots, dart, est, hfirst, gabor-snn, counts; "
            "repeat it.",
            show_default="direct and inverse; model with -m",
        ),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            "--model",
            "-m",
            help="What --method model takes: a model, whose filters are not learned anew.",
            show_default="the general one",
        ),
    ] = None,
    sweeps: Annotated[
        list[str] | None,
        typer.Option(
            "--sweep",
            help="Vary one option, such as filters=1000,1500 or encoding=soft,split; may be repeated.",
        ),
    ] = None,
    paper: Annotated[
        bool,
        typer.Option(
            "--paper",
            help="The paper's third table: its preset, both formulations, sweeps of filters, patch and bins, "
            "beside its figures, with what an update costs.",
        ),
    ] = False,
    preset: options.Preset = "default",
    encoding: options.Encoding = None,
    filters: options.Filters = None,
    patch: options.Patch = None,
    stride: options.Stride = None,
    bins: options.Bins = None,
    window_ms: options.WindowMs = None,
    downsample: options.Downsample = None,
    max_count: options.MaxCount = None,
    pooling: options.Pooling = None,
    volume_bins: options.VolumeBins = None,
    time_stride: options.TimeStride = None,
    lambda0: options.Lambda0 = None,
    threshold: options.Threshold = None,
    start: options.Start = None,
    rows: options.Rows = None,
    conditioning: options.Conditioning = None,
    coherence: options.Coherence = None,
    log_det: options.LogDet = None,
    volumes: options.Volumes = None,
    iterations: options.Iterations = None,
    seed: options.Seed = None,
    scales: options.Scales = None,
    mirror: options.Mirror = False,
    cuts: options.Cuts = "",
    shift: options.Shift = 0,
    kernel: options.Kernel = "auto",
    select: Annotated[
        int,
        typer.Option(help="Learn so many times as many filters, and let labels choose those that are kept."),
    ] = 1,
    test_mirror: Annotated[
        bool,
        typer.Option(
            "--test-mirror", help="Add the scores of the mirror image of each sample that is scored."
        ),
    ] = False,
    on: Annotated[
        str,
        typer.Option(
            help="What is scored: held-out, or train, folds of the samples that are not held out; to choose "
            "settings without a look at those that are."
        ),
    ] = "held-out",
    folds: Annotated[int, typer.Option(help="Folds, where no held-out split is scored.")] = 5,
    groups: options.Groups = "block",
    early_samples: Annotated[
        int, typer.Option(help="Held-out samples for early decision, at most; 0 leaves it out.")
    ] = 500,
    against: Annotated[
        Path | None,
        typer.Option(help="An earlier result of the same samples, .json: differences to its first row."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Result to write, as JSON; makes runs resume.")
    ] = None,
    features: Annotated[
        Path | None,
        typer.Option(
            help="Directory in which features of --method model are kept: runs on the same samples take them "
            "from there.",
            show_default="kept nowhere",
        ),
    ] = None,
    page: Annotated[Path | None, typer.Option("--report", help="Page to write, .html; extra `plot`.")] = None,
    topic: TopicOption = None,
    cluster: ClusterOption = None,
    workers: WorkersOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    verbose: StepsOption = False,
    as_json: JsonOption = False,
) -> None:
    """Accuracy of learned features and of baselines on labelled recordings, over settings and time.

    Samples of validation and test splits are scored; without such a split, folds over all samples, each a
    block of neighbours: samples that were cut from one video are near copies. With -o every finished run is
    kept beside the result: the same command goes on after an interruption.
    """
    from streamfeat.evaluate.methods import needs
    from streamfeat.evaluate.page import check_page, write_page
    from streamfeat.evaluate.plan import (
        TRAINING_PRESETS,
        WITHOUT_KERNELS,
        Trial,
        paper_sweeps,
        parse_sweep,
        plan_cells,
    )
    from streamfeat.evaluate.run import evaluate as run
    from streamfeat.evaluate.run import read_result, save_result, state_path
    from streamfeat.evaluate.splits import DataSet

    if early_samples < 0:
        raise InputError(f"--early-samples {early_samples} is not possible; give 0 or more")
    for path in (output, page):
        if path:
            refuse_existing(path, *recordings, overwrite=overwrite)
    if page:
        check_page(page)
    earlier = read_result(against) if against else None
    if paper and _by_default(context, "preset"):
        context.params["preset"] = preset = "paper"
    base = options.setting_given(context) | {
        "mirror": mirror,
        "cuts": cuts,
        "shift": shift,
        "kernel": kernel,
        "test_mirror": test_mirror,
        "select": select,
        "model": str(model or ""),
    }
    for name, value in TRAINING_PRESETS.get(preset, {}).items():
        if _by_default(context, name):
            base[name] = value
    methods = methods or (["model"] if model else ["direct", "inverse"])
    if model and "model" not in methods:
        raise InputError(f"-m {model} is for --method model; add that, or leave out -m")
    needs(methods)
    parsed = (paper_sweeps() if paper else []) + [parse_sweep(text) for text in sweeps or []]
    plan_cells(methods, base, parsed, 1)  # refuses what cannot be before labels are read
    how = (
        f"the same command goes on from {state_path(output)}: {_this_command()}"
        if output
        else "give -o RESULT.json, and the same command goes on where it was interrupted"
    )
    interrupts.last_words(f"interrupted; {how}")
    try:
        with (
            working(cluster, workers, quiet=quiet) as place,
            progress_bars(quiet=quiet, as_lines=verbose) as report,
        ):
            report("reading labels", 0, 0, "")
            data = DataSet(recordings, topic, folds, Trial(**base).seed, on, groups, reading)
            print_assumptions(data.assumptions)
            report("reading labels", 1, 1, "")
            kinds = {"lasso" if method == "inverse" else "narrow" for method in {*methods} - WITHOUT_KERNELS}
            compile_first(kinds, quiet=quiet)
            result = run(
                data,
                plan_cells(methods, base, parsed, data.n_folds),
                early_samples=early_samples,
                state=state_path(output) if output else None,
                report=report,
                workers=place,
                against=earlier,
                costs=paper,
                features=features,
                finished=lambda row: None if quiet else err.print(_in_short(row), soft_wrap=True),
            )
    except KeyboardInterrupt:
        err.print(f"[yellow]{escape(interrupts.take_last_words())}[/]", soft_wrap=True)
        raise typer.Exit(130) from None
    if page:
        write_page(page, result)
    if output:
        save_result(output, result)
    if as_json:
        print_json("evaluate", result)
    else:
        _print(result)


def _by_default(context: typer.Context, name: str) -> bool:
    """Whether an option was not given."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "DEFAULT"


def _this_command() -> str:
    return shlex.join(["streamfeat", *sys.argv[1:]])


def _in_short(row: dict[str, Any]) -> str:
    what = f"{row['method']} {row['swept']} {row['setting'][row['swept']]}" if row["swept"] else row["method"]
    line = f"{what}: {row['accuracy']:.4f} ({row['low']:.4f} to {row['high']:.4f})"
    if "difference" in row:
        to, difference = "base" if row["swept"] else "the first", row["difference"]
        low, high = difference["low"], difference["high"]
        line += f", to {to} {difference['accuracy']:+.4f} ({low:+.4f} to {high:+.4f})"
    if "against" in row:
        difference = row["against"]
        low, high = difference["low"], difference["high"]
        line += f", to the earlier one {difference['accuracy']:+.4f} ({low:+.4f} to {high:+.4f})"
    return f"[dim]{escape(line)}[/]"


def _print(result: dict[str, Any]) -> None:
    from streamfeat.evaluate.tables import (
        COLUMNS,
        against_table,
        base_rows,
        cells,
        confusion_table,
        early_table,
        fold_table,
        notes,
        online_table,
        sweep_tables,
    )

    columns = [column.replace(", ", ",\n").replace("% ", "%\n") for column in COLUMNS]
    print_table(out, "accuracy", columns, [cells(row) for row in base_rows(result)], left=(0, 2))
    header, rows = fold_table(result)
    if rows:
        print_table(out, "accuracy of each fold", header, rows)
    for name, (header, rows) in sweep_tables(result):
        print_table(out, f"sweep of {name.replace('_', ' ')}", header, rows)
    header, rows = against_table(result)
    if rows:
        print_table(out, "to the first row of the earlier result", header, rows)
    header, rows = early_table(result)
    if rows:
        print_table(out, "early decision", header, rows)
    header, rows = online_table(result)
    if rows:
        print_table(out, "online, predicting before learning", header, rows)
    for row in base_rows(result) if len(result["labels"]) <= _WIDEST_CONFUSION else []:
        print_table(out, f"confusion of {row['method']}", *confusion_table(row, result["labels"]))
    for note in notes(result):
        out.print(f"[yellow]{escape(note)}[/]" if note.startswith("WARNING") else f"[dim]{escape(note)}[/]")
