"""From sights and emissions to what is shown.

Lives here: the sink that a view adds to a pipeline, and what its messages say.
Not here: channels (`channels`), pictures (`pictures`), taking sights (`observe`).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.encoder import Encoder
from streamfeat.stream.emission import Emission
from streamfeat.view.observe import Pace, Sight, Slot, Watch
from streamfeat.view.pictures import bins_picture, event_picture, feature_columns, volume_picture

__all__ = ["Shows", "ViewSink", "about"]

_DIGITS = 5


class Shows(Protocol):
    """Where things are shown; may be called from two threads."""

    def picture(self, prefix: str, name: str, t_us: int, picture: NDArray[np.uint8], /) -> None:
        """Show a picture."""

    def record(self, prefix: str, name: str, t_us: int, record: dict[str, Any], /) -> None:
        """Show JSON values."""


class ViewSink:
    """Shows what engines see and what is read from them, so many times a second and camera.

    Where somebody looks on, sights wait in a slot for the thread that writes, and are drawn there: engines do
    not wait. Where only a file is written, they are drawn as they come, so that none is missing.

    Args:
        boards: where everything is shown; may be filled later.
        encoder: of the engines.
        rate: looks a second.
        live: of the clock, and for somebody who looks on; else of the stream.
        prefix: of the channels, given the topic of the camera.
        drops: what was dropped so far, by reason.
    """

    def __init__(
        self,
        boards: Sequence[Shows],
        encoder: Encoder,
        *,
        rate: float,
        live: bool,
        prefix: Callable[[str], str],
        drops: Callable[[], Mapping[str, int]],
    ) -> None:
        """Nothing has been seen."""
        self._boards = boards
        self._encoder = encoder
        self._rate, self._live = rate, live
        self._prefix = prefix
        self._drops = drops
        self._slots: dict[str, Slot] = {}
        self._paces: dict[str, Pace] = {}
        self._shown: dict[str, _Shown] = {}
        self._judged: dict[str, list[int]] = {}
        self.frames = 0

    @property
    def skipped(self) -> int:
        """Sights that were replaced before they could be drawn."""
        return sum(slot.skipped for slot in list(self._slots.values()))

    def watch(self, topic: str) -> Watch:
        """How to watch the engines of a camera."""
        if self._live:
            slot = self._slots.setdefault(topic, Slot())
            return Watch(topic, Pace(self._rate), slot.put)
        return Watch(topic, Pace(self._rate, clock=None), self._draw)

    def write(self, emissions: Sequence[Emission]) -> None:
        """Show what is due, and the reading at the end of each sample, which is the one that counts."""
        latest: dict[str, Emission] = {}
        for e in emissions:
            latest[e.topic] = e
            if e.final and e.correct is not None:
                judged = self._judged.setdefault(e.topic, [0, 0])
                judged[0] += 1
                judged[1] += e.correct
            if e.final or (not self._live and self._is_due(e)):
                self._tell(e)
        for topic, slot in list(self._slots.items()):
            sight = slot.take()
            if sight:
                self._draw(sight)
            if sight and topic in latest and not latest[topic].final:
                self._tell(latest[topic])

    def close(self, *, failed: bool) -> None:
        """Nothing is held open; boards belong to whoever opened them."""

    def _is_due(self, e: Emission) -> bool:
        return self._paces.setdefault(e.topic, Pace(self._rate, clock=None)).is_due(e.t_us)

    def _draw(self, sight: Sight) -> None:
        geometry = self._encoder.geometry
        t_us = sight.now_us
        pictures = {
            "events": event_picture(
                sight.batches, sight.resolution, sight.window_us, sight.now_us, geometry.bin_us
            ),
            "bins": bins_picture(sight.counts, geometry.max_count),
            "volumes": volume_picture(sight.activity),
        }
        status = self._status(sight)
        for board in self._boards:
            for name, picture in pictures.items():
                board.picture(self._prefix(sight.topic), name, t_us, picture)
            board.record(self._prefix(sight.topic), "status", t_us, status)

    def _status(self, sight: Sight) -> dict[str, Any]:
        shown = self._shown.setdefault(sight.topic, _Shown())
        rate = shown.rate(sight)
        self.frames += 1
        return {
            "t_s": sight.now_us / 1e6,
            "frame": shown.frame,
            "camera": sight.topic,
            "width": sight.resolution[1],
            "height": sight.resolution[0],
            "events": shown.events,
            "events_per_s": round(rate),
            "active_volumes": int(np.count_nonzero(sight.activity)),
            "volumes": sight.activity.size,
            "update_us": {
                "median": round(sight.updates.median_us, 2),
                "max": round(sight.updates.max_us, 2),
                "n": sight.updates.n,
            },
            "drops": dict(self._drops()) | {"skipped": self.skipped},
        }

    def _tell(self, e: Emission) -> None:
        columns = feature_columns(e.features, self._encoder.encoding, self._encoder.geometry.pooling)
        features = {
            "t_s": e.t_us / 1e6,
            "filters_per_column": columns.filters,
            "cells": [
                {"positive": _short(up), "negative": _short(down)}
                for up, down in zip(columns.positive, columns.negative, strict=True)
            ],
        }
        prediction = self._prediction(e) if e.labels else None
        for board in self._boards:
            board.record(self._prefix(e.topic), "features", e.t_us, features)
            if prediction:
                board.record(self._prefix(e.topic), "prediction", e.t_us, prediction)

    def _prediction(self, e: Emission) -> dict[str, Any]:
        best = np.sort(e.scores)[::-1]
        samples, right = self._judged.get(e.topic, (0, 0))
        sample = None
        if e.sample:
            sample = {"label": e.sample.label, "start_s": e.sample.start_us / 1e6, "final": e.final}
        return {
            "t_s": e.t_us / 1e6,
            "label": e.prediction,
            "scores": _short(e.scores),
            "margin": float(best[0] - best[1]) if len(best) > 1 else 0.0,
            "incomplete": e.incomplete,
            "sample": sample,
            "samples": samples,
            "right": right,
        }


class _Shown:
    """What was last shown of a camera."""

    def __init__(self) -> None:
        self.frame = 0
        self.events = 0
        self._of_engine = 0
        self._now_us: int | None = None

    def rate(self, sight: Sight) -> float:
        """Events a second of stream time since the last sight, which this one becomes."""
        passed_us = sight.now_us - self._now_us if self._now_us is not None else 0
        # A sensor that becomes another one gets another engine, which counts from nothing.
        before = self._of_engine if sight.stats.events >= self._of_engine else 0
        new = sight.stats.events - before
        self.frame += 1
        self.events += new
        self._now_us, self._of_engine = sight.now_us, sight.stats.events
        return 1e6 * new / passed_us if passed_us > 0 else 0.0


def about(encoder: Encoder, labels: Sequence[str]) -> dict[str, str]:
    """What does not change while a view lasts, as text by name."""
    geometry = encoder.geometry
    return {
        "formulation": encoder.formulation,
        "encoding": encoder.encoding,
        "filters": str(encoder.n_filters),
        "patch": str(geometry.patch),
        "stride": str(geometry.stride),
        "bins": str(geometry.n_bins),
        "bin_us": str(geometry.bin_us),
        "max_count": str(geometry.max_count),
        "downsample": str(geometry.downsample),
        "pooling": str(geometry.pooling),
        "labels": "\n".join(labels),
    }


def _short(values: NDArray[np.float32]) -> list[float]:
    return [float(f"{value:.{_DIGITS}g}") for value in values.tolist()]
