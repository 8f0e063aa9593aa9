"""NumPy files: `.npy` and `.npz`, with columns, structured arrays, or `(n, 4)` arrays.

Lives here: opening them without pickles and within bounds, and finding the array that holds events.
Not here: what columns mean (`columns`), and recognising such a file (`event_files`).
"""

import zipfile
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from streamfeat.camera_files.columns import Rows, field_of, layout_of, named_fields
from streamfeat.camera_files.source import (
    TIME_UNITS,
    Contents,
    Losses,
    TableOptions,
    checked_resolution,
    chosen_stream,
    one_line,
)
from streamfeat.errors import InputError
from streamfeat.events import Events

__all__ = ["open_numpy"]

LARGEST_UNPACKED = 1 << 30
"""Bytes of a member of an `.npz` when unpacked, 45 million events of 24 bytes."""

_ROWS = 1 << 20  # events in a batch

_Table = tuple[list[NDArray[Any]], list[str] | None]


def open_numpy(path: Path, head: bytes, options: TableOptions) -> Contents:
    """Find the events among the arrays of a file; the arrays stay in memory (`.npy`: mapped) until read."""
    try:
        loaded = _npy(path) if head.startswith(b"\x93NUMPY") else _npz(path)
    except InputError:
        raise
    except Exception as error:  # zip, zlib and header parsers raise a dozen unrelated types on damage
        raise InputError(
            f"{path}: not a readable NumPy file without pickles ({one_line(error)}); copy it again if it is "
            "cut short, or save plain arrays of numbers"
        ) from error
    tables, others = _tables(loaded)
    if not tables:
        fields, _ = named_fields([*loaded])
        held = ", ".join(f"{name} {array.shape}" for name, array in loaded.items())
        lacking = ", ".join(field for field in "txyp" if field not in fields)
        raise InputError(
            f"{path}: needs columns x, y, p, t of one length, or an array (n, 4), but holds {held:.200}"
            + (f"; there is no {lacking}" if 0 < len(fields) < 4 else "")
        )
    streams = tuple(tables)
    columns, names = tables[streams[chosen_stream(path, streams, options.stream)]]
    is_dated = any(column.dtype.kind in "mM" for column in columns)
    columns = [_in_microseconds(column) for column in columns]
    if any(column.dtype.kind not in "biuf" for column in columns):
        raise InputError(f"{path}: columns x, y, p, t must be numbers")
    said_unit = "us" if is_dated else str(others.pop("t_unit", ""))
    size = others.pop("resolution", np.empty(0))
    layout = layout_of(path, columns, names, options, unit=said_unit if said_unit in TIME_UNITS else "")
    t, x, y, p = (columns[i] for i in layout.order)
    return Contents(
        partial(_read, path, layout.unit, {"t": t, "x": x, "y": y, "p": p}),
        checked_resolution(path, *size) if size.shape == (2,) else None,
        streams=streams if len(streams) > 1 else (),
        assumptions=layout.assumptions,
        labels=tuple(
            f"{name:.60} = {array.ravel()[0]!s:.60}" for name, array in others.items() if array.size == 1
        ),
    )


def _npy(path: Path) -> dict[str, NDArray[Any]]:
    """The array, mapped, so that a header that claims too much is noticed and nothing is held in memory."""
    loaded = np.load(path, mmap_mode="r", allow_pickle=False)
    return {"events": loaded}


def _npz(path: Path) -> dict[str, NDArray[Any]]:
    """All members that are arrays of numbers or text; of others those are left out that are no columns.

    Raises:
        InputError: one unpacks to more than is allowed.
    """
    with zipfile.ZipFile(path) as archive:
        size = sum(member.file_size for member in archive.infolist())
        if size > LARGEST_UNPACKED:
            raise InputError(
                f"{path}: not a readable NumPy file: {size} bytes when unpacked, more than "
                f"{LARGEST_UNPACKED}; "
                "save its arrays as .npy, or in several files"
            )
    arrays = {}
    with np.load(path, allow_pickle=False) as loaded:
        for name in loaded.files:
            try:
                arrays[name] = loaded[name]
            except ValueError as error:
                if "allow_pickle" not in str(error) or field_of(name)[0]:
                    raise
                # Something about the recording, perhaps; it is not needed, and never unpickled.
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise ValueError("a member is no array")
    return arrays


def _tables(arrays: Mapping[str, NDArray[Any]]) -> tuple[dict[str, _Table], dict[str, NDArray[Any]]]:
    """The arrays that are tables of events, by name, and the other arrays."""
    if (pixels := arrays.get("xy")) is not None and pixels.ndim == 2 and pixels.shape[1] == 2:
        x, y = pixels.T
        arrays = {**{name: array for name, array in arrays.items() if name != "xy"}, "x": x, "y": y}
    fields, _ = named_fields([*arrays])
    if len(fields) == 4:
        by_name = {field: [*arrays][i] for field, i in fields.items()}
        columns = [arrays[name].squeeze() for name in by_name.values()]
        if all(column.shape == columns[0].shape and column.ndim == 1 for column in columns):
            rest = {name: array for name, array in arrays.items() if name not in by_name.values()}
            return {"columns": (columns, [*by_name.values()])}, rest
    tables: dict[str, _Table] = {}
    others: dict[str, NDArray[Any]] = {}
    for name, array in arrays.items():
        kinds, is_plain = array.dtype.names, array.ndim == 2 and array.dtype.kind in "biuf"
        if kinds is not None and array.shape[:1] == (array.size,) and len(named_fields(kinds)[0]) == 4:
            tables[name] = [array[kind].reshape(-1) for kind in kinds], [*kinds]
        elif (
            kinds is None
            and array.ndim == 2
            and array.shape[1] in (4, 5)
            and len(array)
            and array.dtype.kind in "biuf"
        ):
            tables[name] = [*array.T], None
        elif is_plain and array.shape[0] == 4:
            tables[name] = [*array], None
        else:
            others[name] = array
    return tables, others


def _in_microseconds(column: NDArray[Any]) -> NDArray[Any]:
    """Dates and spans of time as whole microseconds, other columns as they are."""
    return (
        column.astype(f"{column.dtype.kind}8[us]").astype(np.int64) if column.dtype.kind in "mM" else column
    )


def _read(path: Path, unit: str, columns: dict[str, NDArray[Any]], losses: Losses) -> Iterator[Events]:
    rows = Rows(path, unit)
    for start in range(0, max(len(columns["t"]), 1), _ROWS):
        yield rows.events({name: column[start : start + _ROWS] for name, column in columns.items()})
