"""The frozen encoder: geometry, learned matrices, and the integers that make streaming exact.

Lives here: how an encoder is made, checked, saved, loaded, and applied to one whole window (offline).
Not here: learning the matrices (`learn`), and anything that changes as events come (`engine`).
"""

import dataclasses
import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self, cast

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution
from streamfeat.geometry import Geometry
from streamfeat.kernels.layout import (
    ENCODINGS,
    FIXED_POINT_ONE,
    LANES,
    LARGEST_SQUARE,
    SPLIT,
    TRIANGLE,
    Operator,
)
from streamfeat.safe_arrays import one_line, read_safetensors, write_safetensors
from streamfeat.window import encode_window

__all__ = ["FORMAT_VERSION", "Encoder", "Encoding", "Formulation"]

FORMAT_VERSION = 1

_KIND = "streamfeat-encoder"

Formulation = Literal["direct", "inverse"]
Encoding = Literal["soft", "split", "triangle"]

_INT16, _INT32 = 2**15 - 1, 2**31 - 1
_LARGEST = 1e8  # of any parameter, so that no product of three and d^2 of them overflows a float32


@dataclass(frozen=True, slots=True)
class Encoder:
    """A learned, frozen map from the counts of a window to features.

    Make one with `Encoder.build` or `Encoder.load`; the fields are not to be changed.

    Attributes:
        geometry: of the local volumes.
        formulation: `direct` (rows of `filters` are those of `A`) or `inverse` (columns of `D`).
        encoding: what is pooled.
        threshold: the sparsity penalty lambda0.
        filters: `(K, d)` float32.
        whitening: `(d, d)` float32, `W`.
        mean: `(d,)` float32, `mu`.
        operator: the integers applied online; for kernels.
        provenance: how it was learned (JSON values).
    """

    geometry: Geometry
    formulation: Formulation
    encoding: Encoding
    threshold: float
    filters: NDArray[np.float32]
    whitening: NDArray[np.float32]
    mean: NDArray[np.float32]
    operator: Operator
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def build(
        cls,
        geometry: Geometry,
        *,
        formulation: Formulation,
        encoding: Encoding,
        threshold: float,
        filters: NDArray[np.floating[Any]],
        whitening: NDArray[np.floating[Any]],
        mean: NDArray[np.floating[Any]],
        eps: float = 0.01,
        gap: float = 1e-6,
        provenance: Mapping[str, Any] | None = None,
    ) -> Self:
        """Fold whitening and mean removal into one operator and quantise it.

        One scale serves all filters: an entry of the operator is off by at most `max |P| / 65534`, so a
        code is off by about 1e-5 of the largest, and no array of scales walks through the hot loop.

        Args:
            geometry: of the local volumes, `d` entries each.
            formulation: which problem the filters solve.
            encoding: what is pooled.
            threshold: lambda0, above zero for `inverse`.
            filters: `(K, d)`, rows of `A` or columns of `D`.
            whitening: `(d, d)`, `W`.
            mean: `(d,)`, `mu`.
            eps: added to the variance of a volume.
            gap: relative duality gap at which the lasso stops (inverse formulation).
            provenance: JSON values kept with the model.

        Raises:
            InputError: shapes do not fit, a value is not finite, or an integer could overflow.
        """
        filters32 = np.array(filters, np.float32, order="C")  # copies, because they are made read-only
        whitening32 = np.array(whitening, np.float32, order="C")
        mean32 = np.array(mean, np.float32, order="C")
        _check_parameters(geometry, formulation, encoding, threshold, filters32, whitening32, mean32)
        operator = _quantise(
            geometry, formulation, encoding, threshold, filters32, whitening32, mean32, eps, gap
        )
        return cls._checked(
            geometry=geometry,
            formulation=formulation,
            encoding=encoding,
            threshold=float(threshold),
            filters=filters32,
            whitening=whitening32,
            mean=mean32,
            operator=operator,
            provenance=dict(provenance or {}),
        )

    @classmethod
    def _checked(cls, **fields: Any) -> Self:
        encoder = cls(**fields)
        _check_ranges(encoder.geometry, encoder.operator)
        for array in (encoder.filters, encoder.whitening, encoder.mean, *encoder.operator):
            if isinstance(array, np.ndarray):
                array.flags.writeable = False
        return encoder

    @property
    def fingerprint(self) -> str:
        """SHA-256 over everything that decides what features are."""
        digest = hashlib.sha256(repr((self.geometry, self.encoding, self.formulation)).encode())
        for value in self.operator:
            digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
        return digest.hexdigest()

    @property
    def n_filters(self) -> int:
        """Number of filters or atoms, `K`."""
        return self.operator.n_filters

    @property
    def n_features(self) -> int:
        """Length of a feature vector: `4 K`, or `8 K` for `split`."""
        return 4 * self.n_filters * (2 if self.operator.kind == SPLIT else 1)

    def encode(
        self,
        events: Events,
        resolution: Resolution,
        *,
        origin_us: int | None = None,
        t_us: int | None = None,
    ) -> NDArray[np.float32]:
        """Features of one window, computed from all of its events at once (the offline path).

        Has the bits of an `Engine` with the same origin that was fed the same events and advanced to
        `t_us` (inverse formulation: both are within the duality gap).

        Args:
            events: `(n,)` EVENT_DTYPE in any order; those outside the sensor or the window are ignored.
            resolution: `(height, width)` of the sensor.
            origin_us: start of bin 0; the time of the first event if not given.
            t_us: a time in the last bin of the window; the time of the last event if not given.

        Returns:
            `(n_features,)` float32.
        """
        return encode_window(self.geometry, self.operator, events, resolution, origin_us, t_us)

    def save(self, path: str | Path) -> None:
        """Write the model as one safetensors file; the file appears whole or not at all."""
        operator = self.operator
        arrays = {"filters": self.filters, "whitening": self.whitening, "mean": self.mean}
        arrays |= {name: getattr(operator, name) for name in _STORED_ARRAYS}
        header = {
            "geometry": dataclasses.asdict(self.geometry),
            "formulation": self.formulation,
            "encoding": self.encoding,
            "threshold": self.threshold,
            "scalars": {name: getattr(operator, name) for name in _STORED_SCALARS},
            "provenance": dict(self.provenance),
        }
        write_safetensors(Path(path), _KIND, FORMAT_VERSION, arrays, header)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a model. Every shape, type and range is checked, and nothing in the file is run.

        Raises:
            InputError: the file is missing, cut short, of another version, or not a model.
        """
        arrays, header = read_safetensors(Path(path), _KIND, FORMAT_VERSION)
        try:
            return cls._from_parts(arrays, header)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(f"{path}: not a usable model: {one_line(error)}; learn it again") from error

    @classmethod
    def _from_parts(cls, arrays: dict[str, NDArray[Any]], header: dict[str, Any]) -> Self:
        geometry = Geometry(**header["geometry"])
        formulation, encoding = header["formulation"], header["encoding"]
        threshold = float(header["threshold"])
        filters, whitening, mean = (arrays[name] for name in ("filters", "whitening", "mean"))
        _check_parameters(geometry, formulation, encoding, threshold, filters, whitening, mean)
        scalars = {name: float(header["scalars"][name]) for name in _STORED_SCALARS}
        if not all(math.isfinite(value) for value in scalars.values()):
            raise InputError("a scalar is not finite")
        fields = _fixed_fields(geometry, formulation, encoding, threshold, filters) | scalars
        operator = Operator(**fields, **{name: cast(Any, arrays[name]) for name in _STORED_ARRAYS})
        provenance = header.get("provenance", {})
        if not isinstance(provenance, dict):
            raise InputError("provenance is not a JSON object")
        return cls._checked(
            geometry=geometry,
            formulation=formulation,
            encoding=encoding,
            threshold=threshold,
            filters=filters,
            whitening=whitening,
            mean=mean,
            operator=operator,
            provenance=provenance,
        )


_STORED_ARRAYS = ("columns", "offset", "quadratic", "linear", "square_norms")
_STORED_SCALARS = ("scale", "eps", "quadratic_scale", "linear_scale", "constant", "gap")


def _check_parameters(
    geometry: Geometry,
    formulation: str,
    encoding: str,
    threshold: float,
    filters: NDArray[np.float32],
    whitening: NDArray[np.float32],
    mean: NDArray[np.float32],
) -> None:
    d = geometry.entries
    if formulation not in ("direct", "inverse"):
        raise InputError(f"formulation is {formulation!r}, it must be 'direct' or 'inverse'")
    if encoding not in ENCODINGS:
        raise InputError(f"encoding is {encoding!r}, it must be one of {', '.join(ENCODINGS)}")
    if not 0 <= threshold <= _LARGEST or (formulation == "inverse" and threshold == 0):
        raise InputError(f"threshold is {threshold}, it must be above zero and at most {_LARGEST:g}")
    if filters.ndim != 2 or filters.shape[0] < 1 or filters.shape[1] != d:
        raise InputError(f"filters have shape {filters.shape}, expected (K, {d})")
    for name, array, shape in (("whitening", whitening, (d, d)), ("mean", mean, (d,))):
        if array.shape != shape:
            raise InputError(f"{name} has shape {array.shape}, expected {shape}")
    for name, array in (("filters", filters), ("whitening", whitening), ("mean", mean)):
        if array.dtype != np.float32 or not (np.abs(array) <= _LARGEST).all():
            raise InputError(f"{name} must be finite float32 of at most {_LARGEST:g}")


def _fixed_fields(
    geometry: Geometry,
    formulation: Formulation,
    encoding: Encoding,
    threshold: float,
    filters: NDArray[np.float32],
) -> dict[str, Any]:
    """The fields of an operator that follow exactly from the parameters."""
    kind = ENCODINGS[encoding]
    inverse = formulation == "inverse" and kind != TRIANGLE
    atoms = filters.astype(np.float64)
    return {
        "patch": geometry.patch,
        "stride": geometry.stride,
        "downsample": geometry.downsample,
        "bin_us": geometry.bin_us,
        "max_count": geometry.max_count,
        "n_filters": filters.shape[0],
        "kind": kind,
        "inverse": inverse,
        "threshold": float(np.float32(threshold * FIXED_POINT_ONE)),
        "gram": (atoms @ atoms.T).astype(np.float32) if inverse else np.zeros((0, 0), np.float32),
    }


def _quantise(
    geometry: Geometry,
    formulation: Formulation,
    encoding: Encoding,
    threshold: float,
    filters: NDArray[np.float32],
    whitening: NDArray[np.float32],
    mean: NDArray[np.float32],
    eps: float,
    gap: float,
) -> Operator:
    fixed = _fixed_fields(geometry, formulation, encoding, threshold, filters)
    k, d = filters.shape
    padded = -(-k // LANES) * LANES
    white = whitening.astype(np.float64)
    projector = filters.astype(np.float64) @ white
    offset = projector @ mean
    # Mean removal: P (I - 1 1'/d).
    projector -= projector.mean(axis=1, keepdims=True)
    scale = float(np.abs(projector).max()) / _INT16 or 1.0
    columns = np.zeros((d, padded), np.int16)
    columns[:, :k] = np.rint(projector.T / scale)
    padded_offset = np.zeros(padded, np.float32)
    padded_offset[:k] = offset * FIXED_POINT_ONE
    square_norms = np.zeros(padded, np.float32)
    square_norms[:k] = np.square(filters.astype(np.float64)).sum(axis=1)
    quadratic, linear = np.zeros((0, 0), np.int32), np.zeros(0, np.int32)
    quadratic_scale = linear_scale = 1.0
    if fixed["inverse"] or fixed["kind"] == TRIANGLE:
        centred = white - white.mean(axis=1, keepdims=True)
        form = centred.T @ centred
        form = (form + form.T) / 2
        row = (white @ mean) @ centred
        # The largest scale at which neither an entry nor any sum of them can overflow.
        sum_of_form = float(np.abs(form).sum()) * geometry.max_count**2
        quadratic_scale = max(float(np.abs(form).max()) / _INT32, sum_of_form / 2.0**61, 1e-30)
        linear_scale = max(float(np.abs(row).max()) / _INT32, 1e-30)
        quadratic = np.rint(form / quadratic_scale).astype(np.int32)
        linear = np.rint(row / linear_scale).astype(np.int32)
    return Operator(
        **fixed,
        columns=columns,
        scale=scale,
        eps=float(eps),
        offset=padded_offset,
        quadratic=quadratic,
        quadratic_scale=quadratic_scale,
        linear=linear,
        linear_scale=linear_scale,
        constant=float(np.square(white @ mean).sum()),
        square_norms=square_norms,
        gap=float(gap),
    )


def _check_ranges(geometry: Geometry, operator: Operator) -> None:
    """Refuse an operator whose arrays do not fit, or whose integers could overflow."""
    d, padded = geometry.entries, -(-operator.n_filters // LANES) * LANES
    form = (d, d) if operator.inverse or operator.kind == TRIANGLE else (0, 0)
    expected: dict[str, tuple[type, tuple[int, ...]]] = {
        "columns": (np.int16, (d, padded)),
        "offset": (np.float32, (padded,)),
        "square_norms": (np.float32, (padded,)),
        "quadratic": (np.int32, form),
        "linear": (np.int32, form[:1]),
    }
    for name, (dtype, shape) in expected.items():
        array = getattr(operator, name)
        if array.dtype != dtype or array.shape != shape:
            raise InputError(f"{name} is {array.dtype} {array.shape}, expected {np.dtype(dtype)} {shape}")
    if not (0 < operator.eps < math.inf and operator.scale > 0 and 0 < operator.gap < 1):
        raise InputError("eps, scale and gap must be finite and above zero, and gap below one")
    if operator.columns[:, operator.n_filters :].any():
        raise InputError(f"columns holds more filters than {operator.n_filters}")
    if not (np.isfinite(operator.offset).all() and np.isfinite(operator.square_norms).all()):
        raise InputError("offset and square_norms must be finite")
    magnitude = np.abs(operator.columns.astype(np.int64))
    reach = geometry.max_count * int(magnitude.sum(axis=0).max())
    if reach > _INT32:
        raise InputError(
            f"geometry: a projection could reach max_count {geometry.max_count} x "
            f"{reach // geometry.max_count} (the largest sum of a quantised filter) = {reach}, "
            "which is not below 2^31; lower max_count"
        )
    norms = np.sqrt(np.square(operator.columns.astype(np.float64)).sum(axis=0)) * operator.scale
    # Rounding leaves a trace of the mean in each filter; it weighs most in a volume that is nearly constant.
    leak = np.abs(operator.columns.sum(axis=0, dtype=np.int64)) * operator.scale
    code = float(
        norms.max() * math.sqrt(d)
        + leak.max() * geometry.max_count / math.sqrt(operator.eps)
        + np.abs(operator.offset).max() / FIXED_POINT_ONE
    )
    limit = 2**31 // FIXED_POINT_ONE
    if not code < limit:
        raise InputError(
            f"filters: a code could reach |filter| {norms.max():.4g} x sqrt({d}) + offset = {code:.4g}, "
            f"which is not below {limit}, the range of the fixed point; scale the filters or raise eps_zca"
        )
    if not operator.square_norms.max() < LARGEST_SQUARE:
        raise InputError(f"filters: a squared length is not below {LARGEST_SQUARE}; scale the filters")
    if form[0]:
        _check_form(geometry, operator)


def _check_form(geometry: Geometry, operator: Operator) -> None:
    """Refuse a quadratic or linear form that could overflow."""
    total = np.abs(operator.quadratic.astype(np.float64)).sum() * geometry.max_count**2
    if total >= 2.0**62 or not np.array_equal(operator.quadratic, operator.quadratic.T):
        raise InputError(f"quadratic must be symmetric and sum to less than 2^62, it sums to {total:.4g}")
    if not (operator.quadratic_scale > 0 and operator.linear_scale > 0 and operator.constant >= 0):
        raise InputError("the scales and the constant of the quadratic form must not be negative")
