"""The command that compares: evaluate.

Lives here: its arguments, and how its result is shown.
Not here: the evaluation (`streamfeat.evaluate`).
"""

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from streamfeat.cli.program import (
    JsonOption,
    OverwriteOption,
    RecordingsArgument,
    TopicOption,
    app,
    err,
    out,
    progress_bars,
    refuse_existing,
)
from streamfeat.errors import InputError

__all__ = ["evaluate"]

_WIDEST_CONFUSION = 12
"""Labels that fit into a terminal; the JSON and the page have all."""


@app.command(
    epilog="Example: streamfeat evaluate recordings/digits_train.mcap recordings/digits_test.mcap "
    "--patch 8 --method direct --method hats --sweep filters=50,200 -o result.json --report result.html"
)
def evaluate(
    recordings: RecordingsArgument,
    methods: Annotated[
        list[str],
        typer.Option("--method", help="direct, inverse, kmeans, random, hats, hots, counts; repeat it."),
    ] = ["direct", "inverse"],  # noqa: B006  (Typer's way; it is never changed)
    sweeps: Annotated[
        list[str] | None,
        typer.Option(
            "--sweep", help="Vary one option, such as filters=1000,1500 or bins=2,4,7; may be repeated."
        ),
    ] = None,
    encoding: Annotated[str, typer.Option(help="What is pooled: soft, split or triangle.")] = "split",
    filters: Annotated[int, typer.Option(help="Number of filters or atoms, K.")] = 400,
    patch: Annotated[int, typer.Option(help="Pixels along a side of a local volume.")] = 12,
    stride: Annotated[int, typer.Option(help="Pixels between neighbouring volumes.")] = 4,
    bins: Annotated[int, typer.Option(help="Time bins in the window.")] = 3,
    window_ms: Annotated[
        float | None, typer.Option(help="Length of the window; the median sample if not given.")
    ] = None,
    downsample: Annotated[int, typer.Option(help="Sensor pixels along a side of a ring pixel.")] = 1,
    max_count: Annotated[int, typer.Option(help="Counts are clipped to plus and minus this.")] = 1,
    threshold: Annotated[float | None, typer.Option(help="Sparsity penalty lambda0.")] = None,
    volumes: Annotated[int, typer.Option(help="Local volumes to learn from.")] = 50_000,
    iterations: Annotated[int, typer.Option(help="Alternations at most.")] = 20,
    seed: Annotated[int, typer.Option(help="Of every random choice.")] = 0,
    folds: Annotated[int, typer.Option(help="Folds, where no sample is of a held-out split.")] = 5,
    early_samples: Annotated[
        int, typer.Option(help="Held-out samples for early decision, at most; 0 leaves it out.")
    ] = 500,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Result to write, as JSON; makes runs resume.")
    ] = None,
    page: Annotated[Path | None, typer.Option("--report", help="Page to write, .html; extra `plot`.")] = None,
    topic: TopicOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Accuracy of learned features and of baselines on labelled recordings, over settings and time.

    Samples of validation and test splits are scored; without such a split, folds over all samples. With -o
    every finished run is kept beside the result: the same command goes on after an interruption.
    """
    from streamfeat.evaluate.page import check_page, write_page
    from streamfeat.evaluate.plan import Setting, parse_sweep, plan_cells
    from streamfeat.evaluate.run import evaluate as run
    from streamfeat.evaluate.run import save_result, state_path
    from streamfeat.evaluate.splits import DataSet

    if early_samples < 0:
        raise InputError(f"--early-samples {early_samples} is not possible; give 0 or more")
    if not 0 <= seed < 2**32:
        raise InputError(f"--seed {seed} is not possible; give 0 to 2^32 - 1")
    for path in (output, page):
        if path:
            refuse_existing(path, overwrite=overwrite)
    if page:
        check_page(page)
    base = Setting(
        filters,
        patch,
        stride,
        bins,
        window_ms,
        downsample,
        max_count,
        encoding,  # type: ignore[arg-type]
        threshold,
        volumes,
        iterations,
        seed,
    )
    parsed = [parse_sweep(text) for text in sweeps or []]
    plan_cells(methods, base, parsed, 1)  # refuses an unknown method before labels are read
    try:
        with progress_bars() as report:
            report("reading labels", 0, 0, "")
            data = DataSet(recordings, topic, folds, seed)
            report("reading labels", 1, 1, "")
            result = run(
                data,
                plan_cells(methods, base, parsed, data.n_folds),
                early_samples=early_samples,
                state=state_path(output) if output else None,
                report=report,
                finished=lambda row: err.print(_in_short(row), soft_wrap=True),
            )
    except KeyboardInterrupt:
        how = (
            f"the same command goes on from {state_path(output)}: {_this_command()}"
            if output
            else "give -o RESULT.json, and the same command goes on where it was interrupted"
        )
        err.print(f"[yellow]interrupted;[/] {escape(how)}", soft_wrap=True)
        raise typer.Exit(130) from None
    if page:
        write_page(page, result)
    if output:
        save_result(output, result)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        _print(result)


def _this_command() -> str:
    return shlex.join(["streamfeat", *sys.argv[1:]])


def _in_short(row: dict[str, Any]) -> str:
    what = f"{row['method']} {row['swept']} {row['setting'][row['swept']]}" if row["swept"] else row["method"]
    return f"[dim]{escape(what)}: {row['accuracy']:.4f} ({row['low']:.4f} to {row['high']:.4f})[/]"


def _print(result: dict[str, Any]) -> None:
    from streamfeat.evaluate.words import (
        COLUMNS,
        base_rows,
        cells,
        confusion_table,
        early_table,
        notes,
        online_table,
        sweep_tables,
    )

    columns = [column.replace(", ", ",\n").replace("% ", "%\n") for column in COLUMNS]
    _show("accuracy", columns, [cells(row) for row in base_rows(result)], left=(0, 2))
    for name, (header, rows) in sweep_tables(result):
        _show(f"sweep of {name.replace('_', ' ')}", header, rows)
    header, rows = early_table(result)
    if rows:
        _show("early decision", header, rows)
    header, rows = online_table(result)
    if rows:
        _show("online, predicting before learning", header, rows)
    for row in base_rows(result) if len(result["labels"]) <= _WIDEST_CONFUSION else []:
        _show(f"confusion of {row['method']}", *confusion_table(row, result["labels"]))
    for note in notes(result):
        out.print(f"[dim]{escape(note)}[/]")


def _show(
    title: str, header: Sequence[str], rows: Sequence[Sequence[str]], left: Sequence[int] = (0,)
) -> None:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for i, column in enumerate(header):
        table.add_column(escape(column), justify="left" if i in left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*map(escape, row))
    out.print(table)
