"""Events: the one array layout that all of streamfeat speaks, and events of other tools.

Lives here: `EVENT_DTYPE`, making such arrays from columns or from the structured arrays of other tools, and
the one rule of what a valid event is.
Not here: files, messages, clocks, or anything that knows what the events are for.

| from | fields, in order |
|---|---|
| Metavision EventCD | x u2, y u2, p i2, t i8, aligned: `EVENT_DTYPE` itself |
| faery 0.7 | t u8, x u2, y u2, on bool, packed |
| tonic 1.7 | x i2, y i2, t i8, p bool; some data sets x, y, t, p i8, or x i2, y i2, p bool, t i8 |
| expelliarmus 1.1 | t i8, x i2, y i2, p u1, aligned |
| dv-processing 2.0, `EventStore.numpy()` | timestamp i8, x i2, y i2, polarity i1, aligned |
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from streamfeat.errors import InputError

__all__ = [
    "EVENT_DTYPE",
    "FIELD_NAMES",
    "TIME_LIMIT",
    "Events",
    "Resolution",
    "as_events",
    "is_valid",
    "make_events",
]

EVENT_DTYPE = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")], align=True)
"""One event, 16 bytes, the layout of Metavision's EventCD.

`x`, `y`: pixel, origin top-left; `p`: polarity, 0 (OFF) or 1 (ON); `t`: stream time in microseconds.
"""

Events = NDArray[np.void]
"""A batch: `(n,)` array of `EVENT_DTYPE`. Where a batch ends carries no meaning."""

Resolution = tuple[int, int]
"""`(height, width)` in pixels, always in this order."""

TIME_LIMIT = 1 << 62
"""Stream times lie between minus and plus this many microseconds, both excluded."""


def is_valid(events: Events, resolution: Resolution) -> NDArray[np.bool_]:
    """Which events may be counted: inside the sensor, polarity 0 or 1, time within `TIME_LIMIT`.

    This is the one rule; kernels, which see events one by one, have it in `kernels.ingest.is_valid`.

    Args:
        events: `(n,)` EVENT_DTYPE, not changed.
        resolution: `(height, width)` of the sensor.

    Returns:
        `(n,)` bool.
    """
    height, width = resolution
    p, t = events["p"], events["t"]
    inside = (events["x"] < width) & (events["y"] < height)
    valid: NDArray[np.bool_] = inside & ((p == 0) | (p == 1)) & (t > -TIME_LIMIT) & (t < TIME_LIMIT)
    return valid


def make_events(x: ArrayLike, y: ArrayLike, p: ArrayLike, t: ArrayLike) -> Events:
    """Make a batch from four columns of equal length.

    Args:
        x: `(n,)` column in pixels.
        y: `(n,)` row in pixels.
        p: `(n,)` polarity, 0 or 1 (bool allowed).
        t: `(n,)` stream time in microseconds.

    Returns:
        `(n,)` array of `EVENT_DTYPE`, a copy; values are cast, not checked.
    """
    t = np.asarray(t)
    events = np.zeros(t.shape, EVENT_DTYPE)
    events["x"], events["y"], events["p"], events["t"] = x, y, p, t
    return events


FIELD_NAMES = {
    "x": ("x",),
    "y": ("y",),
    "p": ("p", "pol", "polarity", "on"),
    "t": ("t", "ts", "timestamp"),
}
"""What each field of `EVENT_DTYPE` is called elsewhere."""

_RANGE = {"x": (0, 0xFFFF), "y": (0, 0xFFFF), "p": (-1, 1), "t": (-TIME_LIMIT, TIME_LIMIT)}
_WANTED = {"x": "columns", "y": "rows", "p": "polarity", "t": "microseconds"}
_UNUSABLE = 2
"""A polarity that every kernel rejects, and counts."""


def as_events(batch: Any) -> Events:
    """Give any structured array of events the layout that streamfeat speaks.

    Fields may stand in any order, have any width and byte order, and go by any of `FIELD_NAMES`; others are
    left out. Times are whole microseconds. Polarity is 0 and 1, False and True, or -1 and +1; in an array
    that is already of `EVENT_DTYPE`, 0 and 1 only. An event with a value that no event can have becomes one
    that an engine rejects and counts. Each array is looked at by itself: which polarities mean what is not
    remembered from one to the next.

    Args:
        batch: `(n,)` structured array, not changed.

    Returns:
        `(n,)` array of `EVENT_DTYPE`. No copy where the layout is the same but for the names and no polarity
        is -1, so it may be a view of `batch`.

    Raises:
        InputError: no structured array; a field is missing, there twice, or no whole number; or polarity is
            -1 here and 0 there, so that nobody can tell which of them is OFF.
    """
    if type(batch) is np.ndarray and batch.ndim == 1 and batch.dtype == EVENT_DTYPE:
        return batch
    if not isinstance(batch, np.ndarray) or batch.ndim != 1 or batch.dtype.names is None:
        raise InputError(
            "a batch must be a one-dimensional structured array with fields x, y, p and t, "
            f"not {_described(batch)}"
        )
    names = {field: _name_of(field, batch.dtype.names) for field in FIELD_NAMES}
    columns = {field: np.asarray(batch[name]) for field, name in names.items()}
    for field, column in columns.items():
        if column.ndim != 1 or column.dtype.kind not in ("iu" if field != "p" else "biu"):
            raise InputError(
                f"field {names[field]!r} is {column.dtype}, but {_WANTED[field]} must be whole numbers; "
                "convert it first"
            )
    is_signed = _counts_from_minus_one(columns["p"])
    if not is_signed and _is_same_layout(batch.dtype, names):
        return batch.view(EVENT_DTYPE, np.ndarray)
    return _copied(columns, is_signed=is_signed)


def _described(batch: Any) -> str:
    if isinstance(batch, np.ndarray):
        return f"an array of {batch.ndim} dimensions and {batch.dtype!s:.60}"
    name = type(batch).__name__
    return f"{name}; give its .numpy()" if callable(getattr(batch, "numpy", None)) else name


def _name_of(field: str, names: tuple[str, ...]) -> str:
    found = [name for name in FIELD_NAMES[field] if name in names]
    if len(found) == 1:
        return found[0]
    if found:
        raise InputError(f"fields {' and '.join(found)} could both be {_WANTED[field]}; leave one out")
    wanted = " or ".join(FIELD_NAMES[field])
    raise InputError(f"a batch needs a field {wanted}, but has {', '.join(names):.100}")


def _counts_from_minus_one(p: NDArray[Any]) -> bool:
    """Whether OFF is -1 in this column."""
    if p.dtype.kind != "i":
        return False
    is_minus = p == -1
    if not is_minus.any():
        return False
    if (p == 0).any():
        first, other = int(np.argmax(is_minus)), int(np.argmax(p == 0))
        raise InputError(
            f"polarity is -1 at event {first} and 0 at event {other}: one of them is OFF, but which? "
            "Give 0 and 1, or -1 and +1"
        )
    return True


def _is_same_layout(dtype: np.dtype[Any], names: dict[str, str]) -> bool:
    mine, theirs = EVENT_DTYPE.fields, dtype.fields
    assert mine is not None
    assert theirs is not None
    return dtype.itemsize == EVENT_DTYPE.itemsize and all(
        mine[field] == theirs[name][:2] for field, name in names.items()
    )


def _copied(columns: dict[str, NDArray[Any]], *, is_signed: bool) -> Events:
    """Columns of any integers as events; what does not fit a field makes its event unusable."""
    events = np.zeros(len(columns["t"]), EVENT_DTYPE)
    unusable = np.zeros(len(events), np.bool_)
    for field, column in columns.items():
        least, largest = _RANGE[field]
        fits = np.can_cast(column.dtype, EVENT_DTYPE[field]) or not len(column)
        # Two reductions are half as dear as the masks, which are hardly ever needed.
        if not fits and (column.min() < least or column.max() > largest):
            unusable |= (column < least) | (column > largest)
        events[field] = column
    if is_signed:
        events["p"][events["p"] == -1] = 0
    events["p"][unusable] = _UNUSABLE
    return events
