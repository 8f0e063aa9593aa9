"""Emissions as a table, for pandas, polars, DuckDB and whatever else reads Arrow.

Lives here: the columns, and a sink that writes them as an Arrow or Parquet file.
Not here: other sinks (`sinks`), and features of samples in memory (`features`).
"""

import importlib
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from streamfeat.errors import InputError
from streamfeat.files.atomic import unwritable
from streamfeat.files.outputs import OutputFile
from streamfeat.stream.batch import EmissionBatch, batches_of
from streamfeat.stream.emission import Emission

__all__ = ["TableSink"]

_GROUP_BYTES = 16 << 20
"""Rows are written in groups of about so many bytes of features: what waits in memory is bounded, and a group
is worth compressing."""


class TableSink:
    """A row for each emission: Parquet (`.parquet`), or an Arrow file (`.arrow`, `.feather`).

    Columns: `t_us`, `n_events`, `topic`, `incomplete`, `prediction` (null without a classifier), `scores` (in
    the order of the labels that the table's metadata have under `labels`), `label`, `split`, `source` and
    `elapsed_us` of the labelled sample (null outside of one), `final` (the emission at the end of a sample,
    the one that is scored), and `features`, a list of fixed size. The file appears when it is complete.

    Args:
        path: of the file; replaced if it exists.
        n_features: length of a feature vector.
        labels: names that the scores belong to.

    Raises:
        InputError: the ending is another, pyarrow is not there, or the file cannot be written.
    """

    def __init__(self, path: Path, n_features: int, labels: Sequence[str] = ()) -> None:
        """Open the file."""
        self._n_features = n_features
        self._waiting: list[EmissionBatch] = []
        self._pa = _library("pyarrow", path)
        self._schema = self._make_schema(labels)
        is_parquet = path.suffix.lower() == ".parquet"
        open_table = _library("pyarrow.parquet", path).ParquetWriter if is_parquet else self._pa.ipc.new_file
        self._output = OutputFile(path)
        try:
            self._writer = open_table(self._output.file, self._schema)
        except OSError as error:
            self._output.abandon()
            raise unwritable(path, error) from None

    def write(self, emissions: Sequence[Emission]) -> None:
        """Keep the emissions until there are enough for a group of rows.

        Raises:
            InputError: the disk is full, or whatever else keeps the file from being written.
        """
        self._waiting += batches_of(emissions)
        if sum(map(len, self._waiting)) * self._n_features * 4 >= _GROUP_BYTES:
            with self._explaining():
                self._write_group()

    def close(self, *, failed: bool) -> None:
        """Put the file in its place, or remove it.

        Raises:
            InputError: as for `write`; the file is removed then.
        """
        if failed:
            with suppress(OSError):
                self._writer.close()
            self._output.abandon()
            return
        try:
            with self._explaining():
                if self._waiting:
                    self._write_group()
                self._writer.close()
                self._output.close()
        finally:
            self._output.abandon()

    @contextmanager
    def _explaining(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise unwritable(self._output.path, error) from None

    def _make_schema(self, labels: Sequence[str]) -> Any:
        pa = self._pa
        columns = {
            "t_us": pa.int64(),
            "n_events": pa.int64(),
            "topic": pa.string(),
            "incomplete": pa.bool_(),
            "prediction": pa.string(),
            "scores": pa.list_(pa.float32()),
            "label": pa.string(),
            "split": pa.string(),
            "source": pa.string(),
            "elapsed_us": pa.int64(),
            "final": pa.bool_(),
            "features": pa.list_(pa.float32(), self._n_features),
        }
        return pa.schema(list(columns.items()), metadata={"labels": json.dumps(list(labels))})

    def _write_group(self) -> None:
        pa, batches = self._pa, self._waiting
        self._waiting = []
        lengths = list(map(len, batches))

        def same(values: Iterable[Any]) -> list[Any]:
            """What is the same for all rows of a batch, row by row."""
            return [value for value, n in zip(values, lengths, strict=True) for _ in range(n)]

        samples = [b.sample for b in batches]
        starts = [s.start_us if s else None for s in samples]
        values: dict[str, Any] = {
            "t_us": np.concatenate([b.t_us for b in batches]),
            "n_events": np.concatenate([b.n_events for b in batches]),
            "topic": same(b.topic for b in batches),
            "incomplete": np.concatenate([b.incomplete for b in batches]),
            "prediction": [name for b in batches for name in b.predictions],
            "scores": [row for b in batches for row in b.scores],
            "label": same(s and s.label for s in samples),
            "split": same(s and s.split for s in samples),
            "source": same(s and s.source for s in samples),
            "elapsed_us": [
                None if start is None else t_us - start
                for b, start in zip(batches, starts, strict=True)
                for t_us in b.t_us.tolist()
            ],
            "final": same(b.final for b in batches),
        }
        arrays = [pa.array(column, self._schema.field(name).type) for name, column in values.items()]
        flat = pa.array(np.concatenate([b.features.ravel() for b in batches]))
        arrays.append(pa.FixedSizeListArray.from_arrays(flat, self._n_features))
        self._writer.write_batch(pa.record_batch(arrays, schema=self._schema))


def _library(name: str, path: Path) -> Any:
    if path.suffix.lower() not in (".parquet", ".arrow", ".feather"):
        raise InputError(f"{path}: tables end in .parquet, .arrow or .feather")
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(f"{path}: writing it needs pyarrow: pip install 'streamfeat[export]'") from error
