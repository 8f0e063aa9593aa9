"""One cell of the table: learn, encode, train, score, and what that cost.

Lives here: the steps for one method in one setting on one fold. Not here: the table (`run`).
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.classify.calibration import confidence_bins
from streamfeat.classify.classifier import Classifier, train_classifier
from streamfeat.classify.features import EncodedSamples, encode_recordings, training_set
from streamfeat.classify.folds import assign_folds
from streamfeat.classify.kernel import KernelClassifier
from streamfeat.classify.selection import with_best_filters
from streamfeat.classify.training import train
from streamfeat.classify.variants import PLAIN, Variant
from streamfeat.engine.encoder import Encoder, FeatureMap
from streamfeat.evaluate.codes import code_statistics
from streamfeat.evaluate.costs import update_us
from streamfeat.evaluate.feature_files import FeatureFiles
from streamfeat.evaluate.methods import Report, make_features
from streamfeat.evaluate.plan import Cell
from streamfeat.evaluate.scores import confusion, early_decision, predict_all, prequential
from streamfeat.evaluate.splits import DataSet
from streamfeat.recordings.reader import Recording, Sample
from streamfeat.report.machine import PeakMemory
from streamfeat.work.workers import THIS_PROCESS, Workers

__all__ = ["run_cells"]

_SHOWN_FILTERS = 48

_CODED_SAMPLES = 200
"""Held-out samples whose codes are looked at."""

_MIRRORED = Variant(mirror=True)

_INNER_FOLDS = 3
"""Of the training samples, by which the classifier's regularisation is chosen."""


def run_cells(
    data: DataSet,
    cells: Sequence[Cell],
    report: Report,
    *,
    early_samples: int,
    workers: Workers = THIS_PROCESS,
    costs: bool = False,
    kept: FeatureFiles | None = None,
) -> Iterator[tuple[Cell, dict[str, Any]]]:
    """Run cells that the same features serve; results are JSON values.

    Early decision is of the base setting, prequential accuracy and filters are of its first fold.

    Args:
        data: the recordings.
        cells: what to run; features are made once, also for several folds where those do not change them.
        report: told about progress.
        early_samples: held-out samples for early decision, from all folds together; none if 0.
        workers: learn and encode; see `make_features`.
        costs: time an update of one event, where the method has an encoder.
        kept: features that do not depend on the fold are kept there.

    Yields:
        each cell and its result as soon as it is done.

    Raises:
        InputError: something in the setting does not fit the data.
    """
    cell = cells[0]
    fold = None if cell.has_features_of_all_folds else cell.fold
    encode = kept.encoded if kept and fold is None else encode_recordings
    with data.open(fold) as recordings:
        with PeakMemory() as making:
            started = time.perf_counter()
            features = _features(cell, data, recordings, report, workers)
            learned = time.perf_counter()
            _compile(features, recordings)
            cost = (
                update_us(features, _samples(recordings)) if costs and isinstance(features, Encoder) else None
            )
            encoding = time.perf_counter()
            samples = encode(features, recordings, report, workers=workers)
            seconds = {PLAIN: time.perf_counter() - encoding}
            others: dict[Variant, EncodedSamples] = {}
            images: EncodedSamples | None = None
            if any(cell.setting.test_mirror for cell in cells):
                started_one = time.perf_counter()
                images = encode(
                    features, recordings, report, variant=_MIRRORED, held_out_too=True, workers=workers
                )
                seconds[_MIRRORED] = time.perf_counter() - started_one
                others[_MIRRORED] = _of(images, ~samples.held_out)
            wanted = dict.fromkeys(v for cell in cells for v in cell.setting.variants)
            for variant in [v for v in wanted if v not in others]:
                started_one = time.perf_counter()
                others[variant] = encode(features, recordings, report, variant=variant, workers=workers)
                seconds[variant] = time.perf_counter() - started_one
        trained: tuple[Any, ...] = ()
        for cell in sorted(cells, key=_training):
            with PeakMemory() as training:
                variants = cell.setting.variants
                split = _split(samples, [others[v] for v in variants], data, cell if fold is None else None)
                if _training(cell) not in trained:
                    trained = (_training(cell), *_trained(cell, data, features, *split, report))
                _, classifier, train_s = trained
                result = _scored(cell, data, features, split[0], classifier, images)
                if not cell.swept:
                    result |= _early(
                        cell, data, features, classifier, split[0], recordings, report, early_samples
                    )
                    if cell.fold == 0:
                        result |= _looked_into(cell, features, split[0], recordings, report)
            if cost is not None:
                result["update_us"] = round(cost, 3)
            result["train_s"] = round(train_s, 3)
            result["learn_s"] = round(learned - started, 3)
            encoded = {PLAIN, *variants} | ({_MIRRORED} if cell.setting.test_mirror else set())
            result["encode_s"] = round(sum(seconds[v] for v in encoded), 3)
            result["peak_mb"] = max(making.peak_mb, training.peak_mb)
            yield cell, result


def _features(
    cell: Cell, data: DataSet, recordings: Sequence[Recording], report: Report, workers: Workers
) -> FeatureMap:
    """Learn what the method learns; of more filters than are wanted, labels choose."""
    setting, times = cell.setting, cell.setting.select
    if times == 1:
        return make_features(cell.method, recordings, setting, report, workers)
    many = replace(setting, filters=times * setting.filters, select=1)
    features = make_features(cell.method, recordings, many, report, workers)
    assert isinstance(features, Encoder)  # of the methods that are told how many filters
    samples = encode_recordings(features, recordings, report, workers=workers)
    rows, labels, _ = training_set(samples)
    parts = assign_folds(
        labels, samples.sources[~samples.held_out].tolist(), _INNER_FOLDS, data.groups, data.seed
    )
    report("choosing filters", 0, 1, f"{setting.filters:,} of {features.n_filters:,}")
    chosen = with_best_filters(
        features, train_classifier(rows, labels, features, parts=parts), setting.filters
    )
    report("choosing filters", 1, 1, "")
    return chosen


def _split(
    samples: EncodedSamples, others: Sequence[EncodedSamples], data: DataSet, cell: Cell | None
) -> tuple[EncodedSamples, list[EncodedSamples]]:
    """Samples and variants as a cell's fold holds some of them out; as they are, without a cell."""
    held_out = data.held_out(cell.fold) if cell else None
    if held_out is None:
        return samples, [*others]
    return replace(samples, held_out=held_out), [_of(other, ~held_out) for other in others]


def _of(samples: EncodedSamples, some: NDArray[np.bool_]) -> EncodedSamples:
    """Some of the samples."""
    rows, labels, sources = samples.rows[some], samples.labels[some], samples.sources[some]
    return EncodedSamples(rows, labels, sources, samples.held_out[some])


def _training(cell: Cell) -> tuple[int, str]:
    """Equal for cells of the same features that one classifier serves."""
    return cell.fold, repr(replace(cell.setting, test_mirror=False))


def _trained(
    cell: Cell,
    data: DataSet,
    features: FeatureMap,
    samples: EncodedSamples,
    others: Sequence[EncodedSamples],
    report: Report,
) -> tuple[Classifier | KernelClassifier, float]:
    """The classifier of a cell, and the seconds that it took."""
    started = time.perf_counter()
    rows, labels, numbers = training_set(samples, others)
    sources = samples.sources[~samples.held_out].tolist()
    parts = assign_folds(labels[: len(sources)], sources, _INNER_FOLDS, data.groups, data.seed)
    classifier = train(cell.setting.kernel, rows, labels, features, parts[numbers], alone=True, report=report)
    seconds = time.perf_counter() - started
    report("training", 1, 1, "")
    return classifier, seconds


def _scored(
    cell: Cell,
    data: DataSet,
    features: FeatureMap,
    samples: EncodedSamples,
    classifier: Classifier | KernelClassifier,
    images: EncodedSamples | None,
) -> dict[str, Any]:
    """How well a classifier does on the held-out samples; with mirror images there are no probabilities."""
    rows, true = samples.rows[samples.held_out], samples.labels[samples.held_out].tolist()
    result: dict[str, Any] = {}
    if images and cell.setting.test_mirror:
        predicted = predict_all(classifier, rows, images.rows[samples.held_out])
    else:
        likely = classifier.emitted(rows)
        predicted = [classifier.labels[i] for i in likely.argmax(axis=-1)]
        result["confidence"] = _confidence(classifier.labels, likely, true)
    return result | {
        "samples": [int(np.sum(~samples.held_out)), len(true)],
        # A digit for each held-out sample in stored order: settings are compared sample by sample.
        "hits": "".join("01"[a == b] for a, b in zip(true, predicted, strict=True)),
        "confusion": confusion(true, predicted, data.names),
        "features": features.n_features,
        "C": classifier.provenance.get("C"),
        "kernel": "rbf" if isinstance(classifier, KernelClassifier) else "linear",
    }


def _confidence(labels: Sequence[str], likely: NDArray[np.float32], true: Sequence[str]) -> list[list[float]]:
    """For the error of calibration over all folds: bins of the held-out samples whose label is known."""
    known = np.isin(true, labels)
    places = np.searchsorted(labels, np.array(true)[known])
    found: list[list[float]] = confidence_bins(likely[known], places).round(4).tolist()
    return found


def _early(
    cell: Cell,
    data: DataSet,
    features: FeatureMap,
    classifier: Classifier | KernelClassifier,
    samples: EncodedSamples,
    recordings: Sequence[Recording],
    report: Report,
    early_samples: int,
) -> dict[str, Any]:
    """Early decision on a fold's part of so many samples."""
    wanted = early_samples // data.n_folds + (cell.fold < early_samples % data.n_folds)
    chosen = _evenly(recordings, samples.held_out.tolist(), wanted, report) if wanted else []
    if not chosen:
        return {}
    report("early decision", 0, 1, f"{len(chosen)} samples")
    longest = max(label.duration_us for labels in data.labels for label in labels)
    found = early_decision(features, classifier, chosen, longest)
    report("early decision", 1, 1, "")
    return {"early": {"samples": len(chosen), **found}}


def _looked_into(
    cell: Cell,
    features: FeatureMap,
    samples: EncodedSamples,
    recordings: Sequence[Recording],
    report: Report,
) -> dict[str, Any]:
    """Results that are made for the base setting and the first fold only."""
    report("prequential", 0, 1, "")
    order = np.random.default_rng(cell.setting.seed).permutation(len(samples.labels))
    labels = samples.labels.tolist()
    result: dict[str, Any] = {
        "prequential": {
            "stream": prequential(features, samples.rows, labels),
            "shuffled": prequential(features, samples.rows[order], [labels[i] for i in order]),
        }
    }
    report("prequential", 1, 1, "")
    if isinstance(features, Encoder):
        some = _evenly(recordings, samples.held_out.tolist(), _CODED_SAMPLES, report)
        result["learned"] = _learned(features) | code_statistics(features, some, cell.setting.seed)
    return result


def _compile(features: FeatureMap, recordings: Sequence[Recording]) -> None:
    """Encode one sample, so that what is timed is not the compiler."""
    sample = next(_samples(recordings))
    features.encode(sample.events, sample.resolution, origin_us=sample.label.start_us)


def _evenly(
    recordings: Iterable[Recording], held_out: Sequence[bool], most: int, report: Callable[..., None]
) -> list[Sample]:
    """So many held-out samples, spread evenly over the stream."""
    places = np.flatnonzero(held_out)
    wanted = set(places[np.unique(np.linspace(0, len(places) - 1, most).astype(int))].tolist())
    report("looking into samples", 0, 0, "reading")
    return [sample for i, sample in enumerate(_samples(recordings)) if i in wanted]


def _samples(recordings: Iterable[Recording]) -> Iterator[Sample]:
    for recording in recordings:
        yield from recording.samples()


def _learned(encoder: Encoder) -> dict[str, Any]:
    """For the report: some filters in the whitened domain, and the course of learning."""
    geometry = encoder.geometry
    shown = np.unique(np.linspace(0, encoder.n_filters - 1, _SHOWN_FILTERS).astype(int))
    return {
        "shape": list(geometry.volume_shape),
        "n_filters": encoder.n_filters,
        "filters": [[round(float(v), 4) for v in encoder.filters[k]] for k in shown],
        **{
            name: encoder.provenance[name]
            for name in ("objective", "condition", "coherence", "unused")
            if name in encoder.provenance
        },
    }
