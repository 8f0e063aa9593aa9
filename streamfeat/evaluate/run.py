"""All cells, each kept as soon as it is done, and the result that they add up to.

Lives here: the loop, the state file that an interrupted run goes on from, sums over folds.
Not here: the work of a cell (`cell`), the result as text or page (`tables`, `page`).
"""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.classify.calibration import error_of_bins
from streamfeat.engine.encoder import Encoder
from streamfeat.errors import InputError
from streamfeat.evaluate.cell import run_cells
from streamfeat.evaluate.feature_files import FeatureFiles
from streamfeat.evaluate.leakage import check_leakage
from streamfeat.evaluate.methods import Report, model_path
from streamfeat.evaluate.plan import Cell
from streamfeat.evaluate.published import ACCURACIES, PAPER, PAPER_SWEEPS, SWEEP_DATA
from streamfeat.evaluate.scores import (
    SHARE,
    accuracy_interval,
    joined_decisions,
    paired_interval,
    time_to_share,
)
from streamfeat.evaluate.splits import DataSet
from streamfeat.files.atomic import unwritable, write_atomically
from streamfeat.files.outputs import locked_file
from streamfeat.report.machine import describe_machine
from streamfeat.work.workers import THIS_PROCESS, Workers

__all__ = ["StateFile", "evaluate", "read_result", "save_result", "state_path"]

_VERSION = 6

_UNITS_IN_WORDS = {
    "block": "runs of neighbouring samples, 25 of each class",
    "source": "sources",
    "none": "samples",
}


def state_path(output: Path) -> Path:
    """The state file of a run whose result goes to `output`."""
    return output.with_name(output.name + ".part")


class StateFile:
    """Finished cells as JSON lines; the first line says of what. Appended to, so a crash costs one line.

    Args:
        path: the file; None keeps nothing.
        header: what has to be the same for cells to be used again (JSON values).

    Raises:
        InputError: the file is of another run, is being written by one, or cannot be written.
    """

    def __init__(self, path: Path | None, header: dict[str, Any]) -> None:
        """Read what is there, or begin."""
        self._path = path
        self._done: dict[str, dict[str, Any]] = {}
        if path is None:
            return
        self._begun = False
        self._file = locked_file(path)
        with ExitStack() as opening:
            opening.callback(self.close)
            self._read(path, header)
            opening.pop_all()

    def _read(self, path: Path, header: dict[str, Any]) -> None:
        lines = self._file.read().splitlines(keepends=True)
        self._begun = bool(lines)
        # A line without its end was being written when the run was cut off.
        whole = [line for line in lines if line.endswith(b"\n")]
        records = [_parsed(path, i, line) for i, line in enumerate(whole)]
        if records and records[0] != header:
            raise InputError(
                f"{path}: is of a run with other recordings, folds or version; give the same arguments, "
                "or delete it to start anew"
            )
        for record in records[1:]:
            self._done[_name(record["cell"])] = record["result"]
        self._file.truncate(sum(map(len, whole)))
        self._file.seek(0, os.SEEK_END)
        if not records:
            self._append(header)
            self._begun = True

    def __len__(self) -> int:
        """How many cells are done."""
        return len(self._done)

    def get(self, cell: Cell) -> dict[str, Any] | None:
        """The result of a cell if it is done."""
        return self._done.get(_name(cell.key))

    def add(self, cell: Cell, result: dict[str, Any]) -> None:
        """Keep a result; it is on disk when this returns.

        Raises:
            InputError: there is no room for it.
        """
        self._done[_name(cell.key)] = result
        if self._path is not None:
            self._append({"cell": cell.key, "result": result})

    def close(self) -> None:
        """Let another run write to the file; it is removed if not even its first line could be written."""
        if self._path is not None and not self._file.closed:
            if not self._begun:
                self._path.unlink(missing_ok=True)
            with suppress(OSError):  # what there was no room for was told of
                self._file.close()

    def _append(self, record: dict[str, Any]) -> None:
        assert self._path is not None
        try:
            self._file.write(_line(record))
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise unwritable(self._path, error) from None


def _name(key: dict[str, Any]) -> str:
    return json.dumps(key, sort_keys=True)


def _line(record: dict[str, Any]) -> bytes:
    return json.dumps(record).encode() + b"\n"


def _parsed(path: Path, number: int, line: bytes) -> dict[str, Any]:
    try:
        record = json.loads(line)
        if number and not (record["cell"] and record["result"].keys() >= {"hits", "samples", "confusion"}):
            raise ValueError("it is not a finished cell")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: line {number + 1} cannot be read ({error}); delete the file") from error
    return dict(record)


def evaluate(
    data: DataSet,
    cells: Sequence[Cell],
    *,
    early_samples: int = 500,
    state: Path | None = None,
    report: Report = lambda step, done, total, remark: None,
    finished: Callable[[dict[str, Any]], None] = lambda row: None,
    workers: Workers = THIS_PROCESS,
    against: Mapping[str, Any] | None = None,
    costs: bool = False,
    features: Path | None = None,
) -> dict[str, Any]:
    """Run all cells that are not done, and add up the result (JSON values).

    Args:
        data: labelled recordings.
        cells: from `plan.plan_cells`.
        early_samples: held-out samples for early decision.
        state: file of finished cells, read and written.
        report: told about progress.
        finished: called with each row of the result when its last fold is done.
        workers: learn and encode.
        against: an earlier result, from `read_result`; each row has its difference to the first row there.
        costs: time updates, see `run_cells`.
        features: directory in which features of models are kept, for other runs.

    Raises:
        InputError: see `run_cells` and `StateFile`; or the earlier result is of other samples.
        KeyboardInterrupt: Ctrl-C; what is finished is in `state`.
    """
    header = {
        "format": "streamfeat-evaluate",
        "version": _VERSION,
        "folds": data.n_folds,
        "scored": data.scored,
        "groups": data.groups,
        "early_samples": early_samples,
        "models": _models(cells),
    } | data.identity
    kept_features = FeatureFiles(features, data) if features else None
    rows: list[dict[str, Any]] = []
    earlier = _hits_of(against, data) if against else ""
    with closing(StateFile(state, header)) as kept:
        leakage = check_leakage(data, report, workers)
        for i, cell in enumerate(cells):
            report("cells", i, len(cells), cell.method + (f", {_swept(cell)}" if cell.swept else ""))
            if kept.get(cell) is None:
                alike: dict[str, Cell] = {}
                for other in cells[i:]:
                    if other.has_features_of(cell) and kept.get(other) is None:
                        alike.setdefault(_name(other.key), other)
                for one, result in run_cells(
                    data,
                    [*alike.values()],
                    report,
                    early_samples=early_samples,
                    workers=workers,
                    costs=costs,
                    kept=kept_features,
                ):
                    kept.add(one, result)
            if cell.fold == data.n_folds - 1:
                rows.append(_row(cell, [kept.get(c) or {} for c in _folds_of(cell, cells)], data.units))
                first = next(row for row in rows if row["method"] == cell.method) if cell.swept else rows[0]
                if rows[-1] is not first:
                    rows[-1]["difference"] = _difference(rows[-1]["hits"], first["hits"], data.units)
                if earlier:
                    rows[-1]["against"] = _difference(rows[-1]["hits"], earlier, data.units)
                finished(rows[-1])
    report("cells", len(cells), len(cells), "")
    return {
        "recordings": [path.name for path in data.paths],
        "labels": data.names,
        "samples": {"training": rows[0]["samples"][0], "held_out": rows[0]["samples"][1]},
        "split": data.scored,
        "interval": f"95 % bootstrap interval over {_UNITS_IN_WORDS[data.groups]}",
        "leakage": leakage,
        "rows": rows,
        "published": {
            "citation": PAPER,
            "data": SWEEP_DATA,
            "sweeps": PAPER_SWEEPS,
            "accuracies": ACCURACIES,
        },
        "machine": describe_machine(),
    }


def _models(cells: Sequence[Cell]) -> dict[str, str]:
    """The models that cells take, and a digest of each: a state of other files is of another run."""
    paths = {model_path(cell.setting) for cell in cells if cell.method == "model"}
    return {str(path): Encoder.load(path).fingerprint for path in sorted(paths)}


def read_result(path: Path) -> dict[str, Any]:
    """A result that `save_result` wrote.

    Raises:
        InputError: the file cannot be read, or is no result.
    """
    try:
        result = json.loads(path.read_bytes())
        hits = result["rows"][0]["hits"]
        if not (isinstance(hits, str) and hits and set(hits) <= {"0", "1"}):
            raise ValueError("its first row has no hits")
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: not a result of `streamfeat evaluate`: {error}") from None
    return dict(result)


def _hits_of(against: Mapping[str, Any], data: DataSet) -> str:
    """The hits of the first row of an earlier result, if it is of the same samples."""
    mine = [path.name for path in data.paths], data.names, data.scored
    theirs = against.get("recordings"), against.get("labels"), against.get("split")
    hits = str(against["rows"][0]["hits"])
    if mine != theirs or len(hits) != len(data.units):
        raise InputError(
            f"the earlier result is of {theirs[0]}, {theirs[2]}, {len(hits):,} samples; this is {mine[0]}, "
            f"{mine[2]}, {len(data.units):,} samples: only the same samples are compared in pairs"
        )
    return hits


def save_result(path: Path, result: dict[str, Any]) -> None:
    """Write a result as JSON, whole or not at all; the state that it came from is not needed any more."""
    write_atomically(path, json.dumps(result, indent=1).encode() + b"\n")
    state_path(path).unlink(missing_ok=True)


def _difference(hits: str, base: str, units: NDArray[np.int64]) -> dict[str, float]:
    """To the first method, or of a swept setting to the base setting, on the same samples."""
    low, high = paired_interval(hits, base, units)
    difference = (hits.count("1") - base.count("1")) / len(hits)
    return {name: round(v, 4) for name, v in (("accuracy", difference), ("low", low), ("high", high))}


def _swept(cell: Cell) -> str:
    return f"{cell.swept} {cell.used[cell.swept]}"


def _folds_of(cell: Cell, cells: Sequence[Cell]) -> list[Cell]:
    same = (cell.method, cell.setting, cell.swept)
    return [other for other in cells if (other.method, other.setting, other.swept) == same]


def _row(cell: Cell, folds: Sequence[dict[str, Any]], units: NDArray[np.int64]) -> dict[str, Any]:
    """One row of the result from the folds of one method and setting."""
    accuracies = [fold["hits"].count("1") / fold["samples"][1] for fold in folds]
    hits = "".join(fold["hits"] for fold in folds)
    low, high = accuracy_interval(hits, units)
    row: dict[str, Any] = {
        "method": cell.method,
        "swept": cell.swept,
        "setting": cell.used,
        "accuracy": round(hits.count("1") / len(hits), 4),
        "low": round(low, 4),
        "high": round(high, 4),
        "folds": [round(a, 4) for a in accuracies],
        "hits": hits,
        "samples": folds[0]["samples"],
        "features": folds[0]["features"],
        "C": [fold["C"] for fold in folds],
        "kernel": [fold["kernel"] for fold in folds],
        **{
            name: round(float(np.mean([fold[name] for fold in folds])), 3)
            for name in ("learn_s", "encode_s", "train_s")
        },
        "peak_mb": max(fold["peak_mb"] for fold in folds),
        "confusion": np.sum([fold["confusion"] for fold in folds], axis=0).tolist(),
    }
    if all("confidence" in fold for fold in folds):
        bins = np.sum([fold["confidence"] for fold in folds], axis=0)
        row["calibration_error"] = round(error_of_bins(bins), 4)
    if all("update_us" in fold for fold in folds):
        row["update_us"] = round(float(np.median([fold["update_us"] for fold in folds])), 3)
    for name in ("prequential", "learned"):
        if name in folds[0] and not cell.swept:
            row[name] = folds[0][name]
    if early := [fold["early"] for fold in folds if "early" in fold]:
        row["early"] = joined = joined_decisions(early)
        row["share_reached"] = {
            "share": SHARE,
            "ms": time_to_share(joined["time"], "ms"),
            "events": time_to_share(joined["events"], "events"),
        }
    return row
