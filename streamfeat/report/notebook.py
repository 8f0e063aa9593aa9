"""How encoders, engines, recordings and classifiers are shown in a notebook.

Lives here: one line, and HTML with a small picture, of each kind; PNG without any library.
Not here: reports with plots (`pages`).

Objects are asked for what they have at hand. Nothing is read from files for this: a recording tells of counts
only if they are known.
"""

import base64
import math
import struct
import zlib
from collections.abc import Callable
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["html_of", "line_of", "mosaic", "png"]

_MOST_FILTERS = 64
_LABELS = 6


def line_of(shown: Any) -> str:
    """Kind and size in one line."""
    name, facts = _described(shown)
    return f"{name}({', '.join(facts['line'])})"


def html_of(shown: Any) -> str:
    """A table of facts, and a picture where there is one; safe whatever names say."""
    name, facts = _described(shown)
    rows = "".join(
        f'<tr><td style="text-align:left;opacity:.7">{escape(key)}</td>'
        f'<td style="text-align:left">{escape(str(value))}</td></tr>'
        for key, value in facts["rows"].items()
    )
    picture = facts.get("picture")
    image = ""
    if picture is not None:
        data = base64.b64encode(png(picture)).decode("ascii")
        image = (
            f'<img alt="{escape(facts["caption"])}" title="{escape(facts["caption"])}" '
            f'style="image-rendering:pixelated;width:{min(2 * picture.shape[1], 480)}px" '
            f'src="data:image/png;base64,{data}">'
        )
    return f"<div><b>{escape(name)}</b><table>{rows}</table>{image}</div>"


def _described(shown: Any) -> tuple[str, dict[str, Any]]:
    kinds = (kind.__name__ for kind in type(shown).__mro__)
    return type(shown).__name__, next(_KINDS[kind] for kind in kinds if kind in _KINDS)(shown)


def _encoder(encoder: Any) -> dict[str, Any]:
    g = encoder.geometry
    filters = f"{encoder.n_filters:,} {'filters' if encoder.formulation == 'direct' else 'atoms'}"
    volume = "x".join(map(str, g.volume_shape))
    rows = {
        "formulation": encoder.formulation,
        "encoding": f"{encoder.encoding}, threshold {encoder.threshold:g}",
        "filters": f"{filters} of {volume} (bins, rows, columns)",
        "window": f"{g.n_bins} bins of {g.bin_us / 1000:g} ms{_times(g)}",
        "volumes": f"stride {g.stride}, downsample {g.downsample}, counts up to {g.max_count}",
        "features": f"{encoder.n_features:,} in {g.pooling}x{g.pooling} cells",
        "state": "narrow, sums of 16 bits" if encoder.is_narrow else "wide, sums of 32 bits",
        "learned from": ", ".join(map(str, encoder.provenance.get("recordings", []))) or "unknown",
    }
    shown = encoder.filters[:_MOST_FILTERS].reshape(-1, *g.volume_shape)
    # Bins beside each other, the oldest on the left.
    images = shown.transpose(0, 2, 1, 3).reshape(len(shown), g.sides[0], -1)
    line = [encoder.formulation, encoder.encoding, *["narrow"] * encoder.is_narrow]
    line += [f"{filters} of {volume}", f"{g.window_us / 1000:g} ms"]
    return {
        "line": [*line, f"{encoder.n_features:,} features"],
        "rows": rows,
        "picture": mosaic(images),
        "caption": f"the first {len(shown)} filters, bins side by side",
    }


def _times(geometry: Any) -> str:
    if geometry.depth == geometry.n_bins:
        return ""
    return f"; volumes of {geometry.depth}, {geometry.time_stride} apart, summed over time"


def _engine(engine: Any) -> dict[str, Any]:
    stats = engine.stats()
    height, width = engine.resolution
    rows = {
        "sensor": f"{width}x{height} pixels",
        "volumes": "{}x{}".format(*engine.grid_shape),
        "events": f"{stats.events:,}",
        "late, rejected": f"{stats.late:,}, {stats.rejected:,}",
        "window": "{:,} to {:,} us".format(*engine.window_us) if stats.events else "empty",
    }
    counts = engine.counts()
    picture = mosaic(counts.sum(axis=0, dtype=np.float64)[np.newaxis]) if counts.any() else None
    return {
        "line": [f"{width}x{height}", f"{stats.events:,} events", f"{engine.encoder.n_features:,} features"],
        "rows": rows,
        "picture": picture,
        "caption": "counts of the window, summed over its bins",
    }


def _recording(recording: Any) -> dict[str, Any]:
    height, width = recording.resolution
    rows = {
        "path": recording.path,
        "topic": recording.topic,
        "encoding": recording.encoding or "unknown",
        "sensor": f"{width}x{height} pixels",
        "messages": ", ".join(f"{topic.name}: {topic.n_messages:,}" for topic in recording.topics),
        "labels": "yes" if recording.is_labelled else "no",
    }
    return {"line": [repr(str(recording.path)), recording.topic, f"{width}x{height}"], "rows": rows}


def _classifier(classifier: Any) -> dict[str, Any]:
    labels = list(classifier.labels)
    some = ", ".join(labels[:_LABELS]) + (", ..." if len(labels) > _LABELS else "")
    n_features = len(getattr(classifier, "linear", classifier).centre)
    rows = {
        "labels": f"{len(labels)}: {some}",
        "features": f"{n_features:,}",
        **{
            key: value for key, value in classifier.provenance.items() if isinstance(value, str | int | float)
        },
    }
    return {"line": [f"{len(labels)} labels", f"{n_features:,} features"], "rows": rows}


_KINDS: dict[str, Callable[[Any], dict[str, Any]]] = {
    "Encoder": _encoder,
    "Engine": _engine,
    "Recording": _recording,
    "Classifier": _classifier,
    "KernelClassifier": _classifier,
}


def mosaic(images: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Images in a grid that is about square: zero is grey, the largest of each white, its negative black.

    Args:
        images: `(n, h, w)`, n > 0; not changed.

    Returns:
        `(H, W)` uint8, with a pixel between images.
    """
    n, height, width = images.shape
    largest = np.abs(images).max(axis=(1, 2), keepdims=True)
    scaled = images / np.where(largest > 0, largest, 1)
    columns = min(n, max(1, round(math.sqrt(n * height / width))))
    rows = -(-n // columns)
    grid = np.full((rows * (height + 1) - 1, columns * (width + 1) - 1), 255, np.uint8)
    for i, image in enumerate(scaled):
        top, left = i // columns * (height + 1), i % columns * (width + 1)
        grid[top : top + height, left : left + width] = np.round(127.5 + 127.5 * image)
    return grid


def png(pixels: NDArray[np.uint8]) -> bytes:
    """A PNG file, as in RFC 2083: header, one deflated block of unfiltered rows, end.

    Args:
        pixels: `(h, w)` uint8 for greys, or `(h, w, 4)` for red, green, blue and alpha; not changed.
    """
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, -1)
    raw = np.zeros((height, rows.shape[1] + 1), np.uint8)  # each row begins with its filter, 0 for none
    raw[:, 1:] = rows

    def chunk(kind: bytes, content: bytes) -> bytes:
        checked = kind + content
        return struct.pack(">I", len(content)) + checked + struct.pack(">I", zlib.crc32(checked))

    kind_of_colour = 0 if pixels.ndim == 2 else 6
    header = struct.pack(">IIBBBBB", width, height, 8, kind_of_colour, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(raw.tobytes(), 6))
        + chunk(b"IEND", b"")
    )
