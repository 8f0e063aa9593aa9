"""Commands that make models and classifiers: learn, train.

Lives here: their arguments, and how their results are shown.
Not here: the learning itself (`learn`, `classifier`).
"""

import contextlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from streamfeat.cli import options
from streamfeat.cli.program import (
    ClusterOption,
    JsonOption,
    ModelOption,
    OverwriteOption,
    QuietOption,
    RecordingsArgument,
    StepsOption,
    TopicOption,
    WorkersOption,
    app,
    compile_first,
    completing,
    err,
    model_or_general,
    print_losses,
    print_result,
    refuse_existing,
    working,
)
from streamfeat.cli.progress import progress_bars
from streamfeat.cli.reading import print_assumptions, print_removed, reads_recordings
from streamfeat.errors import InputError
from streamfeat.work import interrupts

if TYPE_CHECKING:
    from streamfeat.engine.encoder import Encoder
    from streamfeat.learn.fit import Keep
    from streamfeat.learn.settings import Setting
    from streamfeat.recordings.options import ReadOptions
    from streamfeat.recordings.reader import Recording

__all__ = ["learn", "train"]

_KEEP_REST = 19
"""Time that passes after a model was kept, in multiples of what that took."""


@app.command(epilog="Example: streamfeat learn recordings/digits_train.mcap -o model.safetensors")
@reads_recordings()
def learn(
    context: typer.Context,
    recordings: RecordingsArgument,
    reading: "ReadOptions",
    model: Annotated[Path, typer.Option("--output", "-o", help="Model to write.")],
    formulation: Annotated[
        str | None,
        typer.Option(
            help="direct or inverse.",
            show_default="direct",
            autocompletion=completing("direct", "inverse"),
        ),
    ] = None,
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
    resume: Annotated[
        Path | None,
        typer.Option(help="Go on from this model; recordings and all other options as it was learned with."),
    ] = None,
    topic: TopicOption = None,
    cluster: ClusterOption = None,
    workers: WorkersOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    verbose: StepsOption = False,
    as_json: JsonOption = False,
) -> None:
    """Learn features without labels; samples of validation and test splits are not looked at.

    Without --stride, --downsample and --preset the grid is the finest that one core follows on the sensor.

    Ctrl-C writes the model of the last whole iteration, from which --resume goes on; the exit status is 130.
    After a crash there is the file MODEL.part, which --resume takes as well.
    """
    from streamfeat.engine.encoder import Encoder
    from streamfeat.learn.fit import learn_encoder
    from streamfeat.learn.settings import Setting
    from streamfeat.recordings.reader import open_recording

    refuse_existing(model, *recordings, overwrite=overwrite or model == resume)
    setting = Setting(**options.setting_given(context))
    before = Encoder.load(resume) if resume else None
    part = model.with_name(model.name + ".part")
    interrupts.last_words("interrupted before an iteration was done; nothing was written")
    try:
        with contextlib.ExitStack() as files:
            opened = [files.enter_context(open_recording(path, topic, reading)) for path in recordings]
            for rec in opened:
                print_assumptions(rec.assumptions)
            place = files.enter_context(working(cluster, workers, quiet=quiet))
            if preset == "default" and stride is None and downsample is None:
                setting = _suited(opened, setting)
            report = files.enter_context(progress_bars(quiet=quiet, as_lines=verbose))
            encoder = learn_encoder(
                opened, setting, resume=before, report=report, keep=_keeper(part), workers=place
            )
    except KeyboardInterrupt:
        err.print(f"[yellow]{escape(interrupts.take_last_words())}[/]", soft_wrap=True)
        raise typer.Exit(130) from None
    encoder.save(model)
    part.unlink(missing_ok=True)
    result = {
        "written": str(model),
        "formulation": encoder.formulation,
        "filters": encoder.n_filters,
        "features": encoder.n_features,
        "scales": len(encoder.scales),
        "volumes": encoder.provenance["volumes"],
        "empty_share": encoder.provenance["empty_share"],
        "iterations": encoder.provenance["iterations"],
        "objective": [encoder.provenance["objective"][0], encoder.provenance["objective"][-1]],
        "condition": encoder.provenance["condition"][-1],
        "coherence": encoder.provenance["coherence"][-1],
        "unused": encoder.provenance["unused"],
        "bytes": model.stat().st_size,
        "state": "narrow" if encoder.is_narrow else "wide",
        "wide_because": encoder.provenance.get("wide_because"),
    }
    entries = encoder.geometry.entries
    if encoder.provenance["rows"] == "free" and encoder.n_filters < entries:
        result["log_determinant"] = "A XX' A'"
    print_result(result, "learned", as_json=as_json, command="learn")
    for rec in opened:
        print_removed(rec.losses)
        print_losses(rec.losses)
    if encoder.provenance["volumes"] < setting.volumes:
        err.print(
            f"[yellow]{encoder.provenance['volumes']:,} volumes[/] were learned from, not "
            f"{setting.volumes:,}: no more with events were found in the recordings' "
            f"{encoder.provenance['windows']:,} windows",
            soft_wrap=True,
        )
    if encoder.provenance["interrupted"]:
        err.print(
            f"[yellow]interrupted[/] after {encoder.provenance['iterations']} iterations; "
            f"the same command with --resume {escape(str(model))} goes on from there",
            soft_wrap=True,
        )
        raise typer.Exit(130)


def _suited(opened: "Sequence[Recording]", setting: "Setting") -> "Setting":
    """The grid for the sensor, and a line where that is not the default one."""
    from streamfeat.learn.sensor import suited_to

    found = suited_to(opened, setting)
    if (found.stride, found.downsample) != (setting.stride, setting.downsample):
        err.print(
            f"[dim]geometry:[/] --stride {found.stride} --downsample {found.downsample}, the finest that one "
            "core follows with --emit 10ms on a sensor of this size; give either for another",
            soft_wrap=True,
        )
    return found


def _keeper(path: Path) -> "Keep":
    """Keep what was learned so far in a file, as often as that takes no more than a twentieth of the time."""
    due = 0.0

    def keep(make: Callable[[], "Encoder"]) -> None:
        nonlocal due
        started = time.monotonic()
        if started >= due:
            make().save(path)
            due = time.monotonic() + _KEEP_REST * (time.monotonic() - started)

    return keep


@app.command(
    epilog="Example: streamfeat train recordings/digits_train.mcap -m model.safetensors -o clf.safetensors"
)
@reads_recordings()
def train(
    recordings: RecordingsArgument,
    reading: "ReadOptions",
    classifier: Annotated[Path, typer.Option("--output", "-o", help="Classifier to write.")],
    model: ModelOption = None,
    folds: Annotated[int, typer.Option(help="Folds of the cross-validation.")] = 3,
    groups: options.Groups = "block",
    mirror: options.Mirror = False,
    cuts: options.Cuts = "",
    shift: options.Shift = 0,
    kernel: options.Kernel = "auto",
    select: Annotated[
        int | None,
        typer.Option(
            help="Keep so many filters of the model, those that a linear classifier leans on; needs "
            "--selected-model.",
            show_default="all",
        ),
    ] = None,
    selected_model: Annotated[
        Path | None,
        typer.Option(help="With --select: the model of those filters, which the classifier is for."),
    ] = None,
    topic: TopicOption = None,
    cluster: ClusterOption = None,
    workers: WorkersOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    verbose: StepsOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train a classifier on labelled samples; splits named validation or test are only scored."""
    import numpy as np

    from streamfeat.classify.calibration import calibration_error
    from streamfeat.classify.classifier import train_classifier
    from streamfeat.classify.features import encode_recordings, training_set
    from streamfeat.classify.folds import assign_folds, groups_named
    from streamfeat.classify.kernel import KERNEL_SHARE, KernelClassifier
    from streamfeat.classify.selection import with_best_filters
    from streamfeat.classify.training import check_kernel
    from streamfeat.classify.training import train as train_best
    from streamfeat.classify.variants import parse_cuts, variants_of
    from streamfeat.engine.encoder import Encoder
    from streamfeat.recordings.reader import open_recording
    from streamfeat.stream.compiling import state_of

    refuse_existing(classifier, *recordings, model, overwrite=overwrite)
    if (select is None) != (selected_model is None):
        raise InputError(
            "--select and --selected-model go together: how many filters, and the model to write"
        )
    if selected_model:
        refuse_existing(selected_model, *recordings, model, classifier, overwrite=overwrite)
    kind = groups_named(groups)
    variants = variants_of(mirror=mirror, cuts=parse_cuts(cuts), shift=shift)
    check_kernel(kernel)
    encoder = Encoder.load(model_or_general(model))
    with contextlib.ExitStack() as files:
        opened = [files.enter_context(open_recording(path, topic, reading)) for path in recordings]
        for rec in opened:
            print_assumptions(rec.assumptions)
            if not rec.is_labelled:
                raise InputError(
                    f"{rec.path}: has no labelled samples; give them with --labels FILE.csv, "
                    "or write them with `streamfeat convert`"
                )
        compile_first([state_of(encoder)], quiet=quiet)
        place = files.enter_context(working(cluster, workers, quiet=quiet))
        report = files.enter_context(progress_bars(quiet=quiet, as_lines=verbose))
        samples = encode_recordings(encoder, opened, report, workers=place)
        if samples.held_out.all():
            raise InputError(f"{recordings[0]}: every sample is of a held-out split; nothing to train on")
        if select is not None and selected_model:
            rows, labels, _ = training_set(samples)
            parts = assign_folds(labels, samples.sources[~samples.held_out].tolist(), folds, kind)
            report("choosing filters", 0, 1, f"{select:,} of {encoder.n_filters:,}")
            ranking = train_classifier(rows, labels, encoder, parts=parts)
            encoder = with_best_filters(encoder, ranking, select)
            report("choosing filters", 1, 1, "")
            samples = encode_recordings(encoder, opened, report, workers=place)
        others = [encode_recordings(encoder, opened, report, variant=v, workers=place) for v in variants]
        rows, labels, numbers = training_set(samples, others)
        sources = samples.sources[~samples.held_out].tolist()
        parts = assign_folds(labels[: len(sources)], sources, folds, kind)
        made_from = {"variants": [str(v) for v in variants], "groups": kind}
        found = train_best(kernel, rows, labels, encoder, parts[numbers], provenance=made_from, report=report)
        report("training", 1, 1, "")
    found.save(classifier)
    if selected_model:
        encoder.save(selected_model)
    held_out = samples.rows[samples.held_out]
    result: dict[str, Any] = {
        "written": str(classifier),
        "selected_model": str(selected_model) if selected_model else None,
        "labels": list(found.labels),
        "kernel": "rbf" if isinstance(found, KernelClassifier) else "linear",
        "samples": len(samples.rows) - len(held_out),
        "C": found.provenance["C"],
        "cross_validation": found.provenance[KERNEL_SHARE]
        if isinstance(found, KernelClassifier)
        else max(found.provenance["cross_validation"].values()),
    }
    if len(held_out):
        likely, true = found.emitted(held_out), samples.labels[samples.held_out]
        share = (true == np.array(found.labels)[likely.argmax(axis=1)]).mean()
        result |= {"held_out_samples": len(held_out), "held_out_accuracy": round(float(share), 4)}
        known = np.isin(true, found.labels)
        if known.any():
            places = np.searchsorted(found.labels, true[known])
            result["held_out_calibration_error"] = round(calibration_error(likely[known], places), 4)
    print_result(result, "trained", as_json=as_json, command="train")
    for rec in opened:
        print_removed(rec.losses)
        print_losses(rec.losses)
