"""The command line: arguments and wiring.

Lives here: one function for each command, which reads its arguments, calls the package and prints.
Not here: anything another program might want to call. Modules are imported inside the commands, so that
`--help` does not wait for them.
"""

import contextlib
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from streamfeat.errors import InputError

if TYPE_CHECKING:
    from streamfeat.mcap_records import Losses

__all__ = ["app", "main"]

app = typer.Typer(
    name="streamfeat",
    help="Learned features from event cameras: event by event, exact, and never behind.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)

out = Console(highlight=False, emoji=False)
err = Console(stderr=True, highlight=False, emoji=False)

RecordingArgument = Annotated[Path, typer.Argument(metavar="REC", help="MCAP recording of events.")]
RecordingsArgument = Annotated[
    list[Path], typer.Argument(metavar="REC...", help="MCAP recordings of events.")
]
TopicOption = Annotated[str | None, typer.Option(help="Event topic, where a recording has several.")]
ModelOption = Annotated[Path, typer.Option("--model", "-m", help="Model, from `streamfeat learn`.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an existing output file.")]


def main() -> NoReturn:
    """Run the command line; what the user can mend ends with one line and exit status 2."""
    try:
        app()
    except InputError as error:
        err.print(f"[bold red]error:[/] {escape(' '.join(str(error).split()))}", soft_wrap=True)
        sys.exit(2)
    except MemoryError as error:
        err.print(f"[bold red]error:[/] out of memory, ask for less: {escape(str(error))}", soft_wrap=True)
        sys.exit(2)
    sys.exit(0)


@contextlib.contextmanager
def progress_bars() -> Iterator[Callable[[str, int, int, str], None]]:
    """A function (step, done, of how many, remark) that keeps a bar for each step on standard error."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(compact=True, elapsed_when_finished=True),
        TextColumn("[dim]{task.fields[remark]}"),
    )
    with Progress(*columns, console=err, disable=not err.is_terminal) as progress:
        tasks: dict[str, Any] = {}

        def report(step: str, done: int, total: int, remark: str) -> None:
            if step not in tasks:
                tasks[step] = progress.add_task(step, total=total or None, remark="")
            progress.update(tasks[step], completed=done, total=total or None, remark=escape(remark))

        yield report


def print_losses(losses: "Losses") -> None:
    """Say what of a recording could not be read."""
    for reason, count in losses.counts.items():
        err.print(
            f"[yellow]lost:[/] {count:,} x {reason}, {losses.bytes[reason]:,} bytes; "
            f"first at {escape(losses.first[reason])}",
            soft_wrap=True,
        )


def print_result(result: dict[str, Any], title: str, *, as_json: bool) -> None:
    """Print a result as a table of two columns, or as JSON."""
    if as_json:
        typer.echo(json.dumps(result))
        return
    table = Table(title=title, show_header=False, title_justify="left", box=None, pad_edge=False)
    table.add_column(style="dim")
    table.add_column()
    for name, value in result.items():
        text = f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
        table.add_row(name.replace("_", " "), escape(text))
    out.print(table)


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Refuse to replace a file unless asked to, before any work is done."""
    if path.exists() and not overwrite:
        raise InputError(f"{path}: exists already; give another name or --overwrite")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")


@app.command(epilog="Example: streamfeat info recordings/digits_test.mcap")
def info(recording: RecordingArgument, topic: TopicOption = None, as_json: JsonOption = False) -> None:
    """Topics, encoding, resolution, events, duration, rate, labels and integrity of a recording."""
    from streamfeat.recording import open_recording

    with open_recording(recording, topic) as rec:
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
            "events": rec.n_events,
            "on": rec.n_on,
            "off": rec.n_off,
            "first_us": rec.first_us,
            "duration_s": rec.duration_us / 1e6,
            "events_per_s": round(rec.n_events / max(rec.duration_us / 1e6, 1e-6)),
            "samples": len(rec.labels),
            "labels": ", ".join(labels),
            "splits": ", ".join(splits),
            "integrity": "damaged" if rec.losses else "intact",
        }
        print_result(result, str(recording), as_json=as_json)
        print_losses(rec.losses)


@app.command(epilog="Example: streamfeat convert n-cars_train ncars.mcap --split-every 5")
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Data set folder or camera file.")],
    target: Annotated[Path, typer.Argument(metavar="OUT.mcap", help="Recording to write.")],
    split_every: Annotated[
        int | None,
        typer.Option(help="Every n-th sample is split 'validation', the others 'train'."),
    ] = None,
    split: Annotated[str | None, typer.Option(help="Split of all samples, whatever folders say.")] = None,
    limit: Annotated[int | None, typer.Option(help="Convert only so many, classes in balance.")] = None,
    gap_ms: Annotated[float, typer.Option(help="Silence between samples; at least one window.")] = 1000.0,
    encoding: Annotated[str, typer.Option(help="Payload: mono, libcaer_cmp, libcaer or evt3.")] = "mono",
    compression: Annotated[str, typer.Option(help="Chunks: zstd, lz4 or none.")] = "zstd",
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """A data set folder or a camera file to MCAP, with labels and splits from the folder layout."""
    from streamfeat.foreign import datasets

    if not 0 < gap_ms < 1e9:
        raise InputError(f"a gap of {gap_ms} ms is not possible; give at least one window")
    with progress_bars() as report:
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
        )
    result = {
        "written": str(target),
        "samples": done.samples,
        "events": done.events,
        "bytes_in": done.bytes_in,
        "bytes_out": done.bytes_out,
        "failed": len(done.failed),
        "damaged": len(done.damaged),
    }
    print_result(result, "converted", as_json=as_json)
    for what, files in (("failed", done.failed), ("damaged", done.damaged)):
        for path, reason in files[:20]:
            err.print(f"[yellow]{what}:[/] {escape(f'{path}: {reason}')}", soft_wrap=True)
    if done.failed or done.damaged:
        raise typer.Exit(1)


@app.command(epilog="Example: streamfeat learn recordings/digits_train.mcap -o model.safetensors")
def learn(
    recordings: RecordingsArgument,
    model: Annotated[Path, typer.Option("--output", "-o", help="Model to write.")],
    formulation: Annotated[str, typer.Option(help="direct or inverse.")] = "direct",
    encoding: Annotated[str, typer.Option(help="What is pooled: soft, split or triangle.")] = "split",
    filters: Annotated[int, typer.Option(help="Number of filters or atoms, K.")] = 400,
    patch: Annotated[int, typer.Option(help="Pixels along a side of a local volume.")] = 12,
    stride: Annotated[int, typer.Option(help="Pixels between neighbouring volumes.")] = 4,
    bins: Annotated[int, typer.Option(help="Time bins in the window.")] = 3,
    window_ms: Annotated[
        float | None, typer.Option(help="Length of the window; the median sample if not given, else 100.")
    ] = None,
    downsample: Annotated[int, typer.Option(help="Sensor pixels along a side of a ring pixel.")] = 1,
    max_count: Annotated[int, typer.Option(help="Counts are clipped to plus and minus this.")] = 1,
    threshold: Annotated[float | None, typer.Option(help="Sparsity penalty lambda0.")] = None,
    volumes: Annotated[int, typer.Option(help="Local volumes to learn from.")] = 50_000,
    iterations: Annotated[int, typer.Option(help="Alternations at most.")] = 20,
    seed: Annotated[int, typer.Option(help="Of every random choice.")] = 0,
    topic: TopicOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Learn features without labels; samples of validation and test splits are not looked at."""
    from streamfeat.geometry import Geometry
    from streamfeat.learn.fit import bin_length, learn_encoder
    from streamfeat.recording import open_recording

    refuse_existing(model, overwrite=overwrite)
    with contextlib.ExitStack() as files, progress_bars() as report:
        opened = [files.enter_context(open_recording(path, topic)) for path in recordings]
        geometry = Geometry(patch, stride, bins, bin_length(opened, bins, window_ms), downsample, max_count)
        encoder = learn_encoder(
            opened,
            geometry,
            formulation=formulation,  # type: ignore[arg-type]
            encoding=encoding,  # type: ignore[arg-type]
            n_filters=filters,
            threshold=threshold,
            n_volumes=volumes,
            max_iter=iterations,
            seed=seed,
            report=report,
        )
    encoder.save(model)
    result = {
        "written": str(model),
        "formulation": formulation,
        "filters": encoder.n_filters,
        "features": encoder.n_features,
        "volumes": encoder.provenance["volumes"],
        "empty_share": encoder.provenance["empty_share"],
        "iterations": encoder.provenance["iterations"],
        "objective": f"{encoder.provenance['objective'][0]} to {encoder.provenance['objective'][-1]}",
        "bytes": model.stat().st_size,
    }
    print_result(result, "learned", as_json=as_json)
    for rec in opened:
        print_losses(rec.losses)


@app.command(
    epilog="Example: streamfeat train recordings/digits_train.mcap -m model.safetensors -o clf.safetensors"
)
def train(
    recordings: RecordingsArgument,
    model: ModelOption,
    classifier: Annotated[Path, typer.Option("--output", "-o", help="Classifier to write.")],
    folds: Annotated[int, typer.Option(help="Folds of the cross-validation.")] = 3,
    topic: TopicOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train a linear SVM on labelled samples; splits named validation or test are only scored."""
    import numpy as np

    from streamfeat.classifier import train_classifier
    from streamfeat.encoder import Encoder
    from streamfeat.features import encode_samples
    from streamfeat.recording import HELD_OUT_SPLITS, open_recording

    refuse_existing(classifier, overwrite=overwrite)
    encoder = Encoder.load(model)
    rows: list[tuple[bool, str, Any]] = []
    with contextlib.ExitStack() as files, progress_bars() as report:
        opened = [files.enter_context(open_recording(path, topic)) for path in recordings]
        total = sum(len(rec.labels) for rec in opened)
        if total == 0:
            raise InputError(f"{recordings[0]}: has no labelled samples; `streamfeat convert` writes labels")
        for rec in opened:
            for label, features in encode_samples(encoder, rec.samples()):
                rows.append((label.split in HELD_OUT_SPLITS, label.label, features))
                report("encoding", len(rows), total, rec.path.name)
        report("training", 0, 0, f"{folds}-fold cross-validation")
        seen = [row for row in rows if not row[0]]
        if not seen:
            raise InputError(f"{recordings[0]}: every sample is of a held-out split; nothing to train on")
        features = np.stack([row[2] for row in seen])
        trained = train_classifier(features, [row[1] for row in seen], encoder, folds=folds)
    trained.save(classifier)
    held_out = [row for row in rows if row[0]]
    result: dict[str, Any] = {
        "written": str(classifier),
        "labels": ", ".join(trained.labels),
        "samples": len(seen),
        "C": trained.provenance["C"],
        "cross_validation": max(trained.provenance["cross_validation"].values()),
    }
    if held_out:
        right = sum(trained.predict(row[2]) == row[1] for row in held_out)
        result |= {"held_out_samples": len(held_out), "held_out_accuracy": round(right / len(held_out), 4)}
    print_result(result, "trained", as_json=as_json)
    for rec in opened:
        print_losses(rec.losses)


@app.command(
    epilog="Example: streamfeat replay recordings/digits_test.mcap -m recordings/digits.safetensors "
    "-c recordings/digits_classifier.safetensors"
)
def replay(
    recording: RecordingArgument,
    model: ModelOption,
    classifier: Annotated[
        Path | None, typer.Option("--classifier", "-c", help="Classifier, from `streamfeat train`.")
    ] = None,
    emit: Annotated[str, typer.Option(help="When to read features: event, 1000ev, 10ms or auto.")] = "auto",
    speed: Annotated[str, typer.Option(help="1 is the recorded pace, 2 twice that, or max.")] = "max",
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write features and predictions to this MCAP file.")
    ] = None,
    json_lines: Annotated[
        Path | None,
        typer.Option(help="Write a JSON line for each emission to this file; - is stdout."),
    ] = None,
    features: Annotated[bool, typer.Option("--features", help="Include features in JSON lines.")] = False,
    split: Annotated[str | None, typer.Option(help="Replay only samples of this split.")] = None,
    learn_online: Annotated[
        bool, typer.Option("--learn-online", help="Learn from each label after predicting it.")
    ] = False,
    topic: TopicOption = None,
    overwrite: OverwriteOption = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show the summary only.")] = False,
    as_json: JsonOption = False,
) -> None:
    """The main job on a recording: events to features to predictions, scored where there are labels."""
    from streamfeat.replay import Replay

    for path in (output, json_lines):
        if path and str(path) != "-":
            refuse_existing(path, overwrite=overwrite)
    job = Replay(
        recording,
        model,
        classifier,
        emit=emit,
        speed=speed,
        topic=topic,
        split=split,
        learn_online=learn_online,
    )
    to_terminal = str(json_lines) == "-"
    job.run(
        console=None if quiet or as_json or to_terminal else out,
        recording_out=output,
        json_lines=sys.stdout if to_terminal else json_lines,
        with_features=features,
    )
    if not to_terminal:
        print_result(job.result(), "replayed", as_json=as_json)
    print_losses(job.losses)
    if job.interrupted:
        raise typer.Exit(130)
