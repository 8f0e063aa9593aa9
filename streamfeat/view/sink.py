"""From sights and emissions to what is shown.

Lives here: the sink that a view adds to a pipeline, and what its messages say.
Not here: channels (`channels`), pictures (`pictures`), taking sights (`observe`).
"""

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.encoder import Encoder
from streamfeat.stream.emission import Emission
from streamfeat.view.observe import Sight, Slot, Throttle, Watch
from streamfeat.view.pictures import bins_picture, event_picture, feature_columns, volume_picture
from streamfeat.view.tap import EventTap, RecentEvents

__all__ = ["Shows", "ViewSink", "about"]

_DIGITS = 5


class Shows(Protocol):
    """Where things are shown; may be called from two threads."""

    def picture(self, prefix: str, name: str, t_us: int, picture: NDArray[np.uint8], /) -> None:
        """Show a picture."""

    def record(self, prefix: str, name: str, t_us: int, record: dict[str, Any], /) -> None:
        """Show JSON values."""


class ViewSink:
    """Shows the events that pass, the state of engines, and emissions.

    Events are drawn in the thread that they pass in, as often as `rate` says. Where there may be viewers,
    sights of engines wait in a slot for the thread that writes, and are drawn there: engines do not wait.
    Where only a file is written, they are drawn as they come, so that none is missing.

    Args:
        boards: where everything is shown; may be filled later.
        encoder: of the engines; None where there is none, and events are all that is shown.
        rate: pictures a second and camera.
        live: by the clock, for viewers; else by stream time.
        prefix: of the channels, given the topic of the camera.
        drops: what was dropped so far, by reason.
    """

    def __init__(
        self,
        boards: Sequence[Shows],
        encoder: Encoder | None,
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
        self._throttles: dict[str, Throttle] = {}
        self._judged: dict[str, list[int]] = {}
        self.frames = 0

    @property
    def skipped(self) -> int:
        """Sights that were replaced before they could be drawn."""
        return sum(slot.skipped for slot in list(self._slots.values()))

    def tap(self) -> EventTap:
        """What the items of the stream pass through on their way to the engines."""
        return EventTap(self._throttle, self._show_events)

    def watch(self, topic: str) -> Watch:
        """How to watch the engines of a camera."""
        if self._live:
            slot = self._slots.setdefault(topic, Slot())
            return Watch(topic, self._throttle(), slot.put)
        return Watch(topic, self._throttle(), self._draw)

    def _throttle(self) -> Throttle:
        return Throttle(self._rate) if self._live else Throttle(self._rate, clock=None)

    def write(self, emissions: Sequence[Emission]) -> None:
        """Show what is due, and the emission at the end of each sample, which is the one that is scored."""
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
        """Do nothing; boards are closed where they were opened."""

    def _is_due(self, e: Emission) -> bool:
        return self._throttles.setdefault(e.topic, Throttle(self._rate, clock=None)).is_due(e.t_us)

    def _show_events(self, seen: RecentEvents) -> None:
        window_us = seen.now_us - seen.seen_us, seen.now_us + 1
        picture = event_picture(seen.batches, seen.resolution, window_us, seen.now_us, seen.seen_us)
        self.frames += 1
        status = {
            "t_s": seen.now_us / 1e6,
            "frame": seen.frame,
            "camera": seen.topic,
            "width": seen.resolution[1],
            "height": seen.resolution[0],
            "events": seen.events,
            "events_per_s": round(seen.events_per_s),
            "drops": dict(self._drops()) | {"skipped": self.skipped},
        }
        for board in self._boards:
            board.picture(self._prefix(seen.topic), "events", seen.now_us, picture)
            board.record(self._prefix(seen.topic), "status", seen.now_us, status)

    def _draw(self, sight: Sight) -> None:
        assert self._encoder
        bins = bins_picture(sight.counts, self._encoder.geometry.max_count)
        volumes = volume_picture(sight.activity)
        for board in self._boards:
            board.picture(self._prefix(sight.topic), "bins", sight.now_us, bins)
            board.picture(self._prefix(sight.topic), "volumes", sight.now_us, volumes)
            board.record(self._prefix(sight.topic), "engine", sight.now_us, _engine_record(sight))

    def _tell(self, e: Emission) -> None:
        assert self._encoder
        first = e.features[self._encoder.places[0]]
        columns = feature_columns(first, self._encoder.encoding, self._encoder.geometry.pooling)
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


def _engine_record(sight: Sight) -> dict[str, Any]:
    updates = sight.updates
    return {
        "t_s": sight.now_us / 1e6,
        "active_volumes": int(np.count_nonzero(sight.activity)),
        "volumes": sight.activity.size,
        "update_us": {
            "median": round(updates.median_us, 2),
            "max": round(updates.max_us, 2),
            "n": updates.n,
        },
    }


def about(encoder: Encoder | None, labels: Sequence[str]) -> dict[str, str]:
    """What does not change while a view lasts, as text by name; nothing without an encoder."""
    if encoder is None:
        return {}
    geometry = encoder.geometry
    return {
        "formulation": encoder.formulation,
        "encoding": encoder.encoding,
        "filters": str(encoder.n_filters),
        "patch": str(geometry.patch_name),
        "stride": str(geometry.stride),
        "bins": str(geometry.n_bins),
        "volume_bins": str(geometry.depth),
        "bin_us": str(geometry.bin_us),
        "max_count": str(geometry.max_count),
        "downsample": str(geometry.downsample),
        "pooling": str(geometry.pooling),
        "scales": str(len(encoder.scales)),
        "labels": json.dumps(list(labels)),
    }


def _short(values: NDArray[np.float32]) -> list[float]:
    return [float(f"{value:.{_DIGITS}g}") for value in values.tolist()]
