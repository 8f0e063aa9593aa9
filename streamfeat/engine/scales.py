"""Several scales: encoders of other patches and resolutions beside the first, their features side by side.

Lives here: which scales go together, where the features of each stand, their parts of one file.
Not here: one scale (`encoder`), its state (`engine`).

Each scale has a ring and projections of its own and sees the same events, so whatever holds of one engine
holds of several, bit for bit. Bins are equally long in all scales, and no scale looks further back than the
first: bin boundaries, late events and the window are those of the first.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from numpy.typing import NDArray

from streamfeat.engine.geometry import Geometry
from streamfeat.errors import InputError

__all__ = ["MOST_SCALES", "check_scales", "joined_parts", "places_of", "separate_parts"]

MOST_SCALES = 8

Parts = tuple[dict[str, NDArray[Any]], dict[str, Any]]
"""Arrays and header of one encoder."""


def check_scales(geometries: Sequence[Geometry]) -> None:
    """Refuse scales that do not go together.

    Raises:
        InputError: there are none or too many, bins differ in length, or a scale looks further back than the
            first.
    """
    if not 1 <= len(geometries) <= MOST_SCALES:
        raise InputError(f"{len(geometries)} scales are not possible; give 1 to {MOST_SCALES}")
    first = geometries[0]
    for number, other in enumerate(geometries[1:], 2):
        if other.bin_us != first.bin_us:
            raise InputError(
                f"bins of scale {number} take {other.bin_us} us, those of the first {first.bin_us} us; "
                "scales have bins of one length"
            )
        if other.n_bins > first.n_bins:
            raise InputError(
                f"scale {number} has {other.n_bins} bins, the first {first.n_bins}; put the scale with the "
                "longest window first"
            )


def places_of(lengths: Sequence[int]) -> list[slice]:
    """Where the features of each scale stand, given how many they are."""
    starts = [sum(lengths[:i]) for i in range(len(lengths))]
    return [slice(start, start + length) for start, length in zip(starts, lengths, strict=True)]


def joined_parts(parts: Sequence[Parts]) -> Parts:
    """Arrays and header of one file for all scales: names of arrays begin with the number of the scale."""
    arrays = {f"{i}.{name}": array for i, (mine, _) in enumerate(parts) for name, array in mine.items()}
    return arrays, {"scales": [header for _, header in parts]}


def separate_parts(arrays: Mapping[str, NDArray[Any]], header: Mapping[str, Any]) -> list[Parts]:
    """Undo `joined_parts`.

    Raises:
        InputError: the header has no list of scales, or one that is too long.
    """
    scales = header["scales"]
    if not (isinstance(scales, list) and 2 <= len(scales) <= MOST_SCALES):
        raise InputError(f"its header holds no list of 2 to {MOST_SCALES} scales")
    return [
        (
            {name.removeprefix(f"{i}."): array for name, array in arrays.items() if name.startswith(f"{i}.")},
            mine,
        )
        for i, mine in enumerate(scales)
    ]
