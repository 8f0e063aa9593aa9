"""The settings of learning, in one place.

Lives here: `Setting`, its checks, its presets. Not here: learning itself (`fit`).
Imports nothing that is slow to import, so that a command line can show its defaults.
"""

import math
import re
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, get_args

from streamfeat.errors import InputError

if TYPE_CHECKING:
    from streamfeat.engine.encoder import Encoding, Formulation

__all__ = ["DEFAULTS", "PRESETS", "SENSOR", "THRESHOLD", "Setting", "parse_patch", "preset_with"]

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    # A quarter of the volumes, and of the cost of an event.
    "fast": {"stride": 4},
    # Beside the default's 12x12 pixels at stride 2, patches of 8x8 and 12x12 at half the resolution.
    "accurate": {"scales": "8@2+12@2"},
    # Kostadinov and Scaramuzza (ICPR 2020/21): a quarter of the pixels. Counts are not clipped there; 127 is
    # what a byte holds.
    "paper": {
        "filters": 1700,
        "stride": 4,
        "bins": 7,
        "downsample": 2,
        "max_count": 127,
        "encoding": "triangle",
        "volumes": 50_000,
        "iterations": 20,
    },
}
"""Values in which each preset differs from the defaults of `Setting`."""

LAMBDAS = {("direct", "unit"): 2.0, ("direct", "free"): 0.5, ("inverse", "unit"): 1.0}
"""Default sparsity penalty in learning, of each formulation and kind of rows."""

THRESHOLD = 1.0
"""Default threshold of encoding."""


SENSOR = "sensor"
"""Instead of a patch: one as large as the sensor."""


def parse_patch(value: Any) -> int | str:
    """A patch as it is given, in its one spelling: 12, `8x16` or `sensor`.

    Raises:
        InputError: it is none of these.
    """
    text = "x".join(map(str, value)) if isinstance(value, list | tuple) else str(value).strip().lower()
    found = re.fullmatch(r"([1-9]\d{0,3})(?:x([1-9]\d{0,3}))?", text)
    if text == SENSOR:
        return SENSOR
    if not found:
        raise InputError(
            f"patch {str(value)!r} is not understood; give pixels such as 12, ROWSxCOLUMNS such as 8x16, or "
            "sensor"
        )
    return int(found[1]) if found[2] in (None, found[1]) else text


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """The settings of `streamfeat learn`: geometry and learning, with their defaults.

    Names that `Geometry` has as well are handed on to it.

    Attributes:
        formulation: which of the paper's problems is solved, `direct` or `inverse`.
        encoding: what is pooled, `soft`, `split` or `triangle`.
        filters: number of filters or atoms, `K`.
        patch: ring pixels along each side of a local volume; `8x16`, or two numbers, for rows and columns;
            `sensor` for all of the largest sensor in the recordings (a fully connected layer).
        stride: ring pixels between neighbouring volumes.
        bins: time bins in the window.
        window_ms: length of the window; None for one that holds 95 % of the labelled
            samples whole, 100 ms without labels.
        downsample: sensor pixels along each side of a ring pixel.
        max_count: counts are clipped to `[-max_count, max_count]`.
        pooling: cells along each side of the grid of volumes; codes are summed over each cell.
        volume_bins: bins of a local volume; None for all of the window. Codes of shorter ones are summed over
            time, too. A further scale of no more bins than that has volumes as long as its window.
        time_stride: bins between volumes at the same place; 1 where `volume_bins` is None.
        lambda0: sparsity penalty in learning; None for that of `LAMBDAS`.
        threshold: of encoding, in units of unit-length filters.
        start: of learning, `kmeans` or `random`.
        rows: whether filters have unit length as they are learned, `unit` or `free`; `free` is direct only.
        conditioning: weight in `Omega`; None for the learner's own, as for the next two. Free rows only.
        coherence: weight in `Omega`. Free rows or inverse only.
        log_det: weight in `Omega`. Free rows only.
        volumes: local volumes to learn from.
        iterations: alternations at most.
        seed: of every random choice.
        scales: further scales, `PATCH[/STRIDE][@DOWNSAMPLE][:BINS]` each, joined by `+`, such as `8@2+12@2`;
            filters of each are learned by themselves. `none` for one scale. Where nothing is said the stride
            and the bins are those of the setting, and downsample is 1.

    Raises:
        InputError: a value is out of range, or there are too few volumes for the others.
    """

    formulation: "Formulation" = "direct"
    encoding: "Encoding" = "split"
    filters: int = 400
    patch: int | str = 12
    stride: int = 2
    bins: int = 3
    window_ms: float | None = None
    downsample: int = 1
    max_count: int = 1
    pooling: int = 2
    volume_bins: int | None = None
    time_stride: int = 1
    lambda0: float | None = None
    threshold: float = THRESHOLD
    start: str = "kmeans"
    rows: str = "unit"
    conditioning: float | None = None
    coherence: float | None = None
    log_det: float | None = None
    volumes: int = 12_500
    iterations: int = 10
    seed: int = 0
    scales: str = "none"

    def __post_init__(self) -> None:
        """Check what can be checked without a recording."""
        from streamfeat.engine.encoder import Encoding, Formulation
        from streamfeat.engine.geometry import Geometry

        for name, kind in (("formulation", Formulation), ("encoding", Encoding)):
            if getattr(self, name) not in get_args(kind):
                raise InputError(
                    f"{name} is {getattr(self, name)!r}, it must be one of {', '.join(get_args(kind))}"
                )
        if self.bins < 1:
            raise InputError(f"{self.bins} bins are not possible; give at least one")
        if self.window_ms is not None and not 0 < self.window_ms < 1e9:
            raise InputError(f"a window of {self.window_ms} ms is not possible")
        for name, kinds in (("start", ("kmeans", "random")), ("rows", ("unit", "free"))):
            if getattr(self, name) not in kinds:
                raise InputError(f"{name} is {getattr(self, name)!r}, it must be one of {', '.join(kinds)}")
        if self.formulation == "inverse" and self.rows != "unit":
            raise InputError("free rows are for the direct formulation; atoms have unit length")
        for name, value in (("lambda0", self.penalty), ("threshold", self.threshold)):
            if not 0 <= value < math.inf or (self.formulation == "inverse" and value == 0):
                raise InputError(f"{name} is {value}, it must be finite and above zero")
        for name, weight in self.weights.items():
            if not 0 <= weight < math.inf:
                raise InputError(f"{name} is {weight}, it must be finite and not negative")
            if self.formulation == "inverse" and name != "coherence":
                raise InputError(
                    f"{name} is a weight of the direct formulation; the inverse has coherence only, since "
                    "its atoms have unit length"
                )
            if self.formulation == "direct" and self.rows == "unit":
                raise InputError(f"{name} is a weight for filters of any length; give --rows free with it")
        if self.volumes < 2 or self.iterations < 1 or self.filters < 1:
            raise InputError("at least two volumes, one iteration and one filter are needed to learn")
        times = Geometry(n_bins=self.bins, volume_bins=self.volume_bins, time_stride=self.time_stride)
        object.__setattr__(self, "patch", parse_patch(self.patch))
        rows, columns = (1, 1) if self.patch == SENSOR else self.sides((0, 0))
        self.check_volumes(times.depth * rows * columns)
        if not 0 <= self.seed < 2**32:
            raise InputError(f"seed is {self.seed}, it must be from 0 to 2^32 - 1")
        if self.scales != "none":
            self.each  # noqa: B018  (refuses what makes no sense)

    def sides(self, resolution: tuple[int, int]) -> tuple[int, int]:
        """Rows and columns of a local volume, in ring pixels.

        Args:
            resolution: `(height, width)` of the largest sensor; it matters for `sensor` only.
        """
        if self.patch == SENSOR:
            height, width = (-(-side // self.downsample) for side in resolution)
            return height, width
        rows, _, columns = str(self.patch).partition("x")
        return int(rows), int(columns or rows)

    def check_volumes(self, entries: int) -> None:
        """Refuse to learn from too few volumes of so many entries.

        Raises:
            InputError: with the number that is enough.
        """
        if self.volumes < max(self.filters, entries + 1):
            raise InputError(
                f"{self.volumes} volumes are too few for {self.filters} filters and a covariance of "
                f"{entries} entries; learn from at least {max(self.filters, entries + 1)}"
                + (", or with a higher downsample" if self.patch == SENSOR else "")
            )

    @property
    def each(self) -> "tuple[Setting, ...]":
        """A setting of one scale for each scale."""
        texts = [] if self.scales == "none" else self.scales.split("+")
        return (replace(self, scales="none"), *(self._scale(text.strip()) for text in texts))

    def _scale(self, text: str) -> "Setting":
        found = re.fullmatch(r"(\d{1,4})(?:/(\d{1,4}))?(?:@(\d{1,4}))?(?::(\d{1,4}))?", text)
        if not found:
            raise InputError(
                f"scale {text!r} is not understood; give PATCH[/STRIDE][@DOWNSAMPLE][:BINS], several joined "
                "by +, such as 8@2+12/2@2, or none"
            )
        patch = int(found[1])
        stride, downsample, bins = (int(part) if part else None for part in found.groups()[1:])
        if (bins or self.bins) > self.bins:
            raise InputError(
                f"scale {text!r} has more bins than the {self.bins} of the first; give those to it"
            )
        fewer = self.bins if bins is None else bins
        depth = self.volume_bins or fewer
        is_short = depth < fewer
        return replace(
            self,
            volume_bins=depth if is_short else None,
            time_stride=min(self.time_stride, fewer - depth) if is_short else 1,
            patch=patch,
            stride=self.stride if stride is None else stride,
            downsample=1 if downsample is None else downsample,
            bins=fewer,
            scales="none",
        )

    @property
    def penalty(self) -> float:
        """`lambda0`."""
        return LAMBDAS[self.formulation, self.rows] if self.lambda0 is None else self.lambda0

    @property
    def weights(self) -> dict[str, float]:
        """Weights in `Omega` that were given."""
        named = {name: getattr(self, name) for name in ("conditioning", "coherence", "log_det")}
        return {name: weight for name, weight in named.items() if weight is not None}


DEFAULTS = {field.name: field.default for field in fields(Setting)}
"""Of each name of a setting."""


def preset_with(preset: str, changes: dict[str, Any]) -> dict[str, Any]:
    """Arguments of `Setting` by a preset's name; a change that is None changes nothing.

    Raises:
        InputError: there is no such preset.
    """
    if preset not in PRESETS:
        raise InputError(f"there is no preset {preset!r}; choose from {', '.join(PRESETS)}")
    return PRESETS[preset] | {name: value for name, value in changes.items() if value is not None}
