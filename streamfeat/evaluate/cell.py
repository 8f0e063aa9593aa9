"""One cell of the table: learn, encode, train, score, and what that cost.

Lives here: the steps for one method in one setting on one fold. Not here: the table (`run`).
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.classifier import train_classifier
from streamfeat.encoder import Encoder, FeatureMap
from streamfeat.evaluate.methods import Report, make_features
from streamfeat.evaluate.plan import Cell
from streamfeat.evaluate.scores import confusion, early_decision, predict_all, prequential
from streamfeat.evaluate.splits import DataSet
from streamfeat.features import encode_samples
from streamfeat.machine import PeakMemory
from streamfeat.recording import HELD_OUT_SPLITS, Recording, Sample

__all__ = ["run_cell"]

_SHOWN_FILTERS = 48


@dataclass(slots=True)
class _Encoded:
    """Features of all samples in the order of the stream, and what they are."""

    rows: list[NDArray[np.float32]] = field(default_factory=list)
    labels: list[str] = field(default_factory=list)
    held_out: list[bool] = field(default_factory=list)


def run_cell(data: DataSet, cell: Cell, report: Report, *, early_samples: int) -> dict[str, Any]:
    """Run one cell; the result is JSON values.

    Early decision, prequential accuracy and filters are of the base setting and the first fold.

    Args:
        data: the recordings.
        cell: what to run.
        report: told about progress.
        early_samples: held-out samples for early decision; none if 0.

    Raises:
        InputError: something in the setting does not fit the data.
    """
    with data.open(cell.fold) as recordings, PeakMemory() as memory:
        started = time.perf_counter()
        features = make_features(cell.method, recordings, cell.setting, report)
        learned = time.perf_counter()
        _compile(features, recordings)
        compiled = time.perf_counter()
        found = _encode(features, recordings, report)
        encoded = time.perf_counter()
        report("training", 0, 0, "3-fold cross-validation")
        held_out = np.array(found.held_out)
        rows = np.stack(found.rows)
        labels = np.array(found.labels)
        classifier = train_classifier(rows[~held_out], labels[~held_out].tolist(), features)
        trained = time.perf_counter()
        report("training", 1, 1, "")
        predicted = predict_all(classifier, rows[held_out])
        true = labels[held_out].tolist()
        result: dict[str, Any] = {
            "samples": [int(np.sum(~held_out)), len(true)],
            "right": sum(map(str.__eq__, true, predicted)),
            "confusion": confusion(true, predicted, data.names),
            "features": features.n_features,
            "C": classifier.provenance["C"],
            "learn_s": round(learned - started, 3),
            "encode_s": round(encoded - compiled, 3),
            "train_s": round(trained - encoded, 3),
        }
        if cell.fold == 0 and not cell.swept:
            report("prequential", 0, 1, "")
            result["prequential"] = {
                "stream": prequential(features, rows, found.labels),
                "shuffled": _prequential_shuffled(features, rows, found.labels, cell.setting.seed),
            }
            report("prequential", 1, 1, "")
            chosen = _evenly(recordings, found.held_out, early_samples, report) if early_samples else []
            if chosen:
                report("early decision", 0, 1, f"{len(chosen)} samples")
                result["early"] = {"samples": len(chosen), **early_decision(features, classifier, chosen)}
                report("early decision", 1, 1, "")
            if isinstance(features, Encoder):
                result["learned"] = _learned(features)
    result["peak_mb"] = memory.peak_mb
    return result


def _compile(features: FeatureMap, recordings: Sequence[Recording]) -> None:
    """Encode one sample, so that what is timed is not the compiler."""
    sample = next(_samples(recordings))
    features.encode(sample.events, sample.resolution, origin_us=sample.label.start_us)


def _encode(features: FeatureMap, recordings: Sequence[Recording], report: Report) -> _Encoded:
    total = sum(len(recording.labels) for recording in recordings)
    found = _Encoded()
    for recording in recordings:
        for label, row in encode_samples(features, recording.samples()):
            found.rows.append(row)
            found.labels.append(label.label)
            found.held_out.append(label.split in HELD_OUT_SPLITS)
            report("encoding", len(found.rows), total, recording.path.name)
    return found


def _prequential_shuffled(
    features: FeatureMap, rows: NDArray[np.float32], labels: Sequence[str], seed: int
) -> dict[str, Any]:
    order = np.random.default_rng(seed).permutation(len(labels))
    return prequential(features, rows[order], [labels[i] for i in order])


def _evenly(
    recordings: Iterable[Recording], held_out: Sequence[bool], most: int, report: Callable[..., None]
) -> list[Sample]:
    """So many held-out samples, spread evenly over the stream."""
    places = np.flatnonzero(held_out)
    wanted = set(places[np.unique(np.linspace(0, len(places) - 1, most).astype(int))].tolist())
    report("early decision", 0, 0, "reading samples")
    return [sample for i, sample in enumerate(_samples(recordings)) if i in wanted]


def _samples(recordings: Iterable[Recording]) -> Iterator[Sample]:
    for recording in recordings:
        yield from recording.samples()


def _learned(encoder: Encoder) -> dict[str, Any]:
    """What the report draws of an encoder: some filters in the whitened domain, and how learning went."""
    geometry = encoder.geometry
    shown = np.unique(np.linspace(0, encoder.n_filters - 1, _SHOWN_FILTERS).astype(int))
    return {
        "shape": [geometry.n_bins, geometry.patch, geometry.patch],
        "filters": [[round(float(v), 4) for v in encoder.filters[k]] for k in shown],
        **{
            name: encoder.provenance[name]
            for name in ("objective", "condition", "coherence", "unused")
            if name in encoder.provenance
        },
    }
