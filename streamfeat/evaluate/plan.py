"""What is to be evaluated: methods, settings, and the cells of the table that follow.

Lives here: `Setting`, `Cell`, and sweeps as they are asked for.
Not here: what is done in a cell.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from streamfeat.encoder import Encoding
from streamfeat.errors import InputError

__all__ = ["FILTER_METHODS", "METHODS", "SWEPT", "Cell", "Setting", "parse_sweep", "plan_cells"]

METHODS = {
    "direct": "learned transform (direct formulation)",
    "inverse": "learned dictionary (inverse formulation)",
    "kmeans": "spherical k-means filters",
    "random": "random filters",
    "hats": "HATS, averaged time surfaces",
    "hots": "HOTS, one layer of time surfaces",
    "counts": "count images",
}
"""Every method, and what it is."""

FILTER_METHODS = ("direct", "inverse", "kmeans", "random")
"""Those with filters over local volumes: settings and sweeps apply to them."""

SWEPT = ("filters", "patch", "stride", "bins", "max_count", "downsample", "volumes")
"""What can be swept."""


@dataclass(frozen=True, slots=True)
class Setting:
    """What `streamfeat learn` can be told of geometry and learning, with its defaults."""

    filters: int = 400
    patch: int = 12
    stride: int = 4
    bins: int = 3
    window_ms: float | None = None
    downsample: int = 1
    max_count: int = 1
    encoding: Encoding = "split"
    threshold: float | None = None
    volumes: int = 50_000
    iterations: int = 20
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Cell:
    """One run: a method in a setting on a fold; `swept` names what differs from the base, if anything."""

    method: str
    setting: Setting
    fold: int
    swept: str = ""

    @property
    def key(self) -> dict[str, Any]:
        """JSON values that tell one cell from another."""
        return {"method": self.method, "setting": asdict(self.setting), "fold": self.fold}


def parse_sweep(text: str) -> tuple[str, list[int]]:
    """Name and values of a sweep such as `filters=1000,1500`.

    Raises:
        InputError: the name is unknown, or a value is no positive integer.
    """
    name, _, values = text.partition("=")
    name = name.strip().replace("-", "_")
    if name not in SWEPT:
        raise InputError(f"--sweep {text}: {name!r} cannot be swept; choose one of {', '.join(SWEPT)}")
    parts = [part.strip() for part in values.split(",")]
    if not all(part.isascii() and part.isdigit() and int(part) > 0 for part in parts):
        raise InputError(f"--sweep {text}: give positive integers, such as --sweep {name}=2,4,7")
    return name, list(dict.fromkeys(int(part) for part in parts))


def plan_cells(
    methods: Sequence[str], base: Setting, sweeps: Sequence[tuple[str, list[int]]], n_folds: int
) -> list[Cell]:
    """All cells: each method in the base setting, then each value of each sweep, all else as in the base.

    Raises:
        InputError: a method is unknown.
    """
    for method in methods:
        if method not in METHODS:
            raise InputError(f"method {method!r} is unknown; choose from {', '.join(METHODS)}")
    chosen = dict.fromkeys(methods)
    cells = [Cell(method, base, fold) for method in chosen for fold in range(n_folds)]
    for name, values in sweeps:
        for value in values:
            setting = replace(base, **{name: value})  # type: ignore[arg-type]
            cells += [
                Cell(method, setting, fold, name)
                for method in chosen
                if method in FILTER_METHODS
                for fold in range(n_folds)
            ]
    return cells
