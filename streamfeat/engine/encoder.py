"""The frozen encoder: geometry, learned matrices, and the integers that make streaming exact.

Lives here: how an encoder is made, checked, saved, loaded, and applied to one whole window (offline).
Not here: learning the matrices (`learn`), and anything that changes as events come (`engine`).
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Protocol, Self, cast

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.geometry import Geometry
from streamfeat.engine.operator import check_operator, fixed_fields, n_features, quantise
from streamfeat.engine.scales import check_scales, joined_parts, places_of, separate_parts
from streamfeat.engine.window import encode_window
from streamfeat.errors import InputError
from streamfeat.events import Events, Resolution, as_events
from streamfeat.files.safetensors_file import one_line, read_safetensors, write_safetensors
from streamfeat.kernels.layout import FEATURE_ENCODINGS, Operator
from streamfeat.report.shown import Shown

__all__ = [
    "GENERAL_VERSION",
    "NARROW_VERSION",
    "WIDE_VERSION",
    "Encoder",
    "Encoding",
    "FeatureMap",
    "Formulation",
]

WIDE_VERSION, NARROW_VERSION, GENERAL_VERSION = 1, 2, 3
"""Format versions of files: the second holds what the first does, and the steps of the narrow state; the
third, either with a geometry that those before could not describe."""

_KIND = "streamfeat-encoder"
_SCALES_KIND = "streamfeat-scales"

Formulation = Literal["direct", "inverse"]
Encoding = Literal["soft", "split", "triangle"]

_MOST_ATOMS = 1 << 12  # their products with each other take 128 MiB while they are made
_LARGEST = 1e8  # of any parameter, so that no product of three and d^2 of them overflows a float32


class FeatureMap(Protocol):
    """What turns the events of one window into features: an encoder, or what it is compared with."""

    @property
    def fingerprint(self) -> str:
        """Of everything that decides what features are."""

    @property
    def n_features(self) -> int:
        """Length of a feature vector."""

    def encode(
        self,
        events: Events,
        resolution: Resolution,
        *,
        origin_us: int | None = None,
        t_us: int | None = None,
    ) -> NDArray[np.float32]:
        """Features of one window; see `Encoder.encode`."""


@dataclass(frozen=True, slots=True, repr=False)
class Encoder(Shown):
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
        further: encoders of one scale whose features stand behind those of this one, see `side_by_side`. All
            other attributes are of the first scale.
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
    further: tuple["Encoder", ...] = ()

    @classmethod
    def side_by_side(cls, scales: "Sequence[Encoder]") -> "Encoder":
        """One encoder of several scales, with the features of each, one behind the other.

        Example:
            >>> both = Encoder.side_by_side([fine, coarse])
            >>> both.n_features == fine.n_features + coarse.n_features
            True

        Args:
            scales: the first is that with the most bins; bins are equally long in all.

        Raises:
            InputError: they do not go together, or one of them has several scales itself.
        """
        check_scales([scale.geometry for scale in scales])
        if any(scale.further for scale in scales):
            raise InputError("a scale of an encoder cannot have several scales itself")
        return replace(scales[0], further=tuple(scales[1:]))

    @property
    def scales(self) -> tuple["Encoder", ...]:
        """An encoder for each scale."""
        return (replace(self, further=()), *self.further) if self.further else (self,)

    @property
    def places(self) -> list[slice]:
        """Where the features of each scale stand."""
        return places_of([n_features(self.operator), *(scale.n_features for scale in self.further)])

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
        narrow: bool = False,
        provenance: Mapping[str, Any] | None = None,
    ) -> Self:
        """Fold whitening and mean removal into one operator and quantise it.

        In the wide state one step serves all filters: an entry of the operator is off by at most
        `max |P| / 65534`, so a code is off by about 1e-4 of the largest. In the narrow state each filter has
        its own, so that sums of 16 bits cannot overflow: a code is off by about 1e-3 of the largest, the
        engine takes half the memory, and an event half the time.

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
            narrow: choose the narrow state where it is exact enough. Where not (`inverse`, `triangle`, large
                volumes of large counts), the encoder has the wide state, and `provenance` says why.
            provenance: JSON values kept with the model.

        Raises:
            InputError: shapes do not fit, a value is not finite, or an integer could overflow.
        """
        filters32 = np.array(filters, np.float32, order="C")  # copies, because they are made read-only
        whitening32 = np.array(whitening, np.float32, order="C")
        mean32 = np.array(mean, np.float32, order="C")
        _check_parameters(geometry, formulation, encoding, threshold, filters32, whitening32, mean32)
        fixed = fixed_fields(geometry, formulation, encoding, threshold, filters32)
        notes = dict(provenance or {})
        parameters = geometry, fixed, filters32, whitening32, mean32, eps, gap
        try:
            operator = quantise(*parameters, narrow=narrow)
        except InputError as error:
            if not narrow:
                raise
            notes["wide_because"] = str(error)
            operator = quantise(*parameters)
        return cls._checked(
            geometry=geometry,
            formulation=formulation,
            encoding=encoding,
            threshold=float(threshold),
            filters=filters32,
            whitening=whitening32,
            mean=mean32,
            operator=operator,
            provenance=notes,
        )

    @classmethod
    def _checked(cls, **fields: Any) -> Self:
        fields["operator"] = check_operator(fields["geometry"], fields["operator"])
        encoder = cls(**fields)
        for array in (encoder.filters, encoder.whitening, encoder.mean, *encoder.operator):
            if isinstance(array, np.ndarray):
                array.flags.writeable = False
        return encoder

    @property
    def fingerprint(self) -> str:
        """SHA-256 over everything that decides what features are."""
        digest = hashlib.sha256(repr((self.geometry, self.encoding, self.formulation)).encode())
        for name, value in zip(Operator._fields, self.operator, strict=True):
            if name in ("shape", "packed", "wide", "lasso", "upper", "lower", "gain"):
                continue  # of the sensor, columns again, or of the narrow state alone
            if name == "steps" and value is None:
                continue  # of the narrow state, too
            if name == "patch":
                value = self.geometry.patch  # a number, where it is a square
            digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
        for scale in self.further:
            digest.update(scale.fingerprint.encode())
        return digest.hexdigest()

    @property
    def is_narrow(self) -> bool:
        """Whether engines keep projections in 16 bits, and not in 32; of the first scale."""
        return self.operator.steps is not None

    @property
    def n_filters(self) -> int:
        """Number of filters or atoms, `K`, of the first scale."""
        return self.operator.n_filters

    @property
    def n_features(self) -> int:
        """Length of a feature vector: `K` for each cell, or `2 K` for `split`; of all scales together."""
        return n_features(self.operator) + sum(scale.n_features for scale in self.further)

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
            events: `(n,)` EVENT_DTYPE in any order, or a structured array of another tool (see `as_events`);
                those outside the sensor or the window are ignored.
            resolution: `(height, width)` of the sensor.
            origin_us: start of bin 0; the time of the first event if not given.
            t_us: a time in the last bin of the window; the time of the last event if not given.

        Returns:
            `(n_features,)` float32.

        Raises:
            InputError: `events` are no events.
        """
        events = as_events(events)
        return np.concatenate(
            [
                encode_window(one.geometry, one.operator, events, resolution, origin_us, t_us)
                for one in (self, *self.further)
            ]
        )

    def save(self, path: str | Path) -> None:
        """Write the model as one safetensors file; the file appears whole or not at all."""
        versions = [scale._version for scale in self.scales]
        if self.further:
            parts = [scale._parts() for scale in self.scales]
            each = [(one[0], one[1] | {"version": v}) for one, v in zip(parts, versions, strict=True)]
            write_safetensors(Path(path), _SCALES_KIND, max(versions), *joined_parts(each))
        else:
            write_safetensors(Path(path), _KIND, versions[0], *self._parts())

    @property
    def _version(self) -> int:
        if self.geometry.is_general:
            return GENERAL_VERSION
        return NARROW_VERSION if self.is_narrow else WIDE_VERSION

    def _parts(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Arrays and header of the first scale."""
        operator = self.operator
        arrays = {"filters": self.filters, "whitening": self.whitening, "mean": self.mean}
        arrays |= {name: getattr(operator, name) for name in _stored_arrays(narrow=self.is_narrow)}
        header = {
            "geometry": self.geometry.as_dict(),
            "formulation": self.formulation,
            "encoding": self.encoding,
            "threshold": self.threshold,
            "scalars": {name: getattr(operator, name) for name in _STORED_SCALARS},
            "provenance": dict(self.provenance),
        }
        return arrays, header

    @classmethod
    def load(cls, path: str | Path) -> "Encoder":
        """Read a model. Every shape, type and range is checked, and nothing in the file is run.

        Raises:
            InputError: the file is missing, cut short, of another version, or not a model.
        """
        versions = WIDE_VERSION, NARROW_VERSION, GENERAL_VERSION
        arrays, header = read_safetensors(Path(path), (_KIND, _SCALES_KIND), *versions)
        try:
            if header["format"] == _KIND:
                return cls._from_parts(arrays, header)
            return cls.side_by_side([cls._from_parts(*parts) for parts in separate_parts(arrays, header)])
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
        fields = fixed_fields(geometry, formulation, encoding, threshold, filters) | scalars
        stored = _stored_arrays(narrow="steps" in arrays)
        operator = Operator(**fields, **{name: cast(Any, arrays[name]) for name in stored})
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


def _stored_arrays(*, narrow: bool) -> tuple[str, ...]:
    arrays = ("columns", "offset", "quadratic", "linear", "square_norms")
    return (*arrays, "steps") if narrow else arrays


_STORED_SCALARS = ("scale", "eps", "quadratic_scale", "linear_scale", "constant", "reach", "gap")


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
    if encoding not in FEATURE_ENCODINGS:
        raise InputError(f"encoding is {encoding!r}, it must be one of {', '.join(FEATURE_ENCODINGS)}")
    if not 0 <= threshold <= _LARGEST or (formulation == "inverse" and threshold == 0):
        raise InputError(f"threshold is {threshold}, it must be above zero and at most {_LARGEST:g}")
    if formulation == "inverse" and filters.ndim == 2 and len(filters) > _MOST_ATOMS:
        raise InputError(
            f"{len(filters)} atoms are too many, their products are kept for at most {_MOST_ATOMS}"
        )
    if filters.ndim != 2 or filters.shape[0] < 1 or filters.shape[1] != d:
        raise InputError(f"filters have shape {filters.shape}, expected (K, {d})")
    for name, array, shape in (("whitening", whitening, (d, d)), ("mean", mean, (d,))):
        if array.shape != shape:
            raise InputError(f"{name} has shape {array.shape}, expected {shape}")
    for name, array in (("filters", filters), ("whitening", whitening), ("mean", mean)):
        if array.dtype != np.float32 or not (np.abs(array) <= _LARGEST).all():
            raise InputError(f"{name} must be finite float32 of at most {_LARGEST:g}")
