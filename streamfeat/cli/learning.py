"""Commands that make models and classifiers: learn, train.

Lives here: their arguments, and how their results are shown.
Not here: the learning itself (`learn`, `classifier`).
"""

import contextlib
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from streamfeat.cli.program import (
    JsonOption,
    ModelOption,
    OverwriteOption,
    RecordingsArgument,
    TopicOption,
    app,
    err,
    print_losses,
    print_result,
    progress_bars,
    refuse_existing,
)
from streamfeat.errors import InputError

__all__ = ["learn", "train"]


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
    resume: Annotated[
        Path | None,
        typer.Option(help="Go on from this model; recordings and all other options as it was learned with."),
    ] = None,
    topic: TopicOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Learn features without labels; samples of validation and test splits are not looked at.

    Ctrl-C writes the model of the last whole iteration, from which --resume goes on; the exit status is 130.
    """
    from streamfeat.encoder import Encoder
    from streamfeat.geometry import Geometry
    from streamfeat.learn.fit import bin_length, learn_encoder
    from streamfeat.recording import open_recording

    refuse_existing(model, overwrite=overwrite or model == resume)
    before = Encoder.load(resume) if resume else None
    try:
        with contextlib.ExitStack() as files, progress_bars() as report:
            opened = [files.enter_context(open_recording(path, topic)) for path in recordings]
            bin_us = bin_length(opened, bins, window_ms)
            encoder = learn_encoder(
                opened,
                Geometry(patch, stride, bins, bin_us, downsample, max_count),
                formulation=formulation,  # type: ignore[arg-type]
                encoding=encoding,  # type: ignore[arg-type]
                n_filters=filters,
                threshold=threshold,
                n_volumes=volumes,
                max_iter=iterations,
                seed=seed,
                resume=before,
                report=report,
            )
    except KeyboardInterrupt:
        err.print("[yellow]interrupted[/] before an iteration was done; nothing was written")
        raise typer.Exit(130) from None
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
        "condition": encoder.provenance["condition"][-1],
        "coherence": encoder.provenance["coherence"][-1],
        "unused": encoder.provenance["unused"],
        "bytes": model.stat().st_size,
    }
    entries = encoder.geometry.entries
    if formulation == "direct" and filters < entries:
        result["log_determinant"] = f"that of A XX' A': {filters} filters are fewer than {entries} entries"
    print_result(result, "learned", as_json=as_json)
    for rec in opened:
        print_losses(rec.losses)
    if encoder.provenance["interrupted"]:
        err.print(
            f"[yellow]interrupted[/] after {encoder.provenance['iterations']} iterations; "
            f"the same command with --resume {escape(str(model))} goes on from there",
            soft_wrap=True,
        )
        raise typer.Exit(130)


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
        for rec in opened:
            if not rec.labels:
                raise InputError(f"{rec.path}: has no labelled samples; `streamfeat convert` writes labels")
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
