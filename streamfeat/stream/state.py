"""Where a session is in its stream, and all that it needs to go on from there.

Lives here: `SessionState`, what a session has counted, `SessionSnapshot`; reading them from JSON, checked.
Not here: the rules by which a session moves on (`session`), files.
"""

from dataclasses import dataclass, fields
from typing import Self

from streamfeat.engine.engine import Snapshot
from streamfeat.errors import InputError
from streamfeat.events import Resolution
from streamfeat.files.json_fields import Fields
from streamfeat.kernels.layout import BEFORE_TIME
from streamfeat.messages.packets import Label

__all__ = ["SessionSnapshot", "SessionState", "SessionStats"]

_LATEST_US = 1 << 52
"""No live stream gets there: message stamps have 31 bits of seconds."""


@dataclass(slots=True)
class SessionStats:
    """What a session has done.

    Attributes:
        events: accepted.
        late: older than the window, or than the labelled sample that was open.
        rejected: outside the sensor, or malformed.
        saturated: accepted without changing a clipped count.
        emissions: readings made.
        incomplete: of those, how many lacked packets known to be missing from the window.
        samples: labelled samples that ended.
        correct: of those, how many were predicted rightly; None without a classifier.
        unknown_labels: samples that could not be learned from, because the classifier lacks their label.
    """

    events: int = 0
    late: int = 0
    rejected: int = 0
    saturated: int = 0
    emissions: int = 0
    incomplete: int = 0
    samples: int = 0
    correct: int | None = None
    unknown_labels: int = 0

    @classmethod
    def from_json(cls, values: Fields) -> Self:
        """Read what `asdict` wrote.

        Raises:
            InputError: it is not that.
        """
        names = [field.name for field in fields(cls) if field.name != "correct"]
        return cls(**{name: values.whole(name) for name in names}, correct=values.maybe("correct"))


@dataclass(slots=True)
class SessionState:
    """Where a session is in its stream.

    Attributes:
        origin_us: stream time at which bin 0 starts.
        last_us: that events have reached.
        next_us: of the next reading by time, or in silence; None if that follows from `last_us`.
        every_us: between such readings.
        unread: events since the latest reading.
        epoch: of the camera's clock; None before the first packet.
        silent_us: up to which silence was read.
        incomplete_us: up to which packets are known to be missing from the window.
        lost: packets are missing before the next one.
        seen_label: labelled samples come with this stream.
        sample: the one that is open.
    """

    origin_us: int = 0
    last_us: int = 0
    next_us: int | None = None
    every_us: int = 0
    unread: int = 0
    epoch: int | None = None
    silent_us: int = BEFORE_TIME
    incomplete_us: int = BEFORE_TIME
    lost: bool = False
    seen_label: bool = False
    sample: Label | None = None

    @classmethod
    def from_json(cls, values: Fields) -> Self:
        """Read what `asdict` wrote, of a live stream.

        Raises:
            InputError: it is not that, or no session could be there.
        """
        origin_us, last_us = (
            values.whole("origin_us", -_LATEST_US, _LATEST_US),
            values.whole("last_us", -_LATEST_US, _LATEST_US),
        )
        every_us = values.whole("every_us")
        # One that lay far back would be followed by a reading for each step from there to now.
        next_us = values.maybe("next_us", last_us + 1, _LATEST_US)
        if next_us is not None and (every_us == 0 or (next_us - origin_us) % every_us):
            raise InputError(f"{values.where}: no reading is due at {next_us} us")
        return cls(
            origin_us=origin_us,
            last_us=last_us,
            next_us=next_us,
            every_us=every_us,
            unread=values.whole("unread"),
            epoch=values.maybe("epoch"),
            silent_us=values.whole("silent_us", BEFORE_TIME, _LATEST_US),
            incomplete_us=values.whole("incomplete_us", BEFORE_TIME, _LATEST_US),
            lost=values.flag("lost"),
            seen_label=values.flag("seen_label"),
            sample=_label(values.inner("sample")) if "sample" in values else None,
        )


def _label(values: Fields) -> Label:
    return Label(
        start_us=values.whole("start_us", -_LATEST_US, _LATEST_US),
        duration_us=values.whole("duration_us", 0, _LATEST_US),
        **{name: values.text(name, 1 << 20) for name in ("label", "split", "source", "topic")},
    )


@dataclass(frozen=True, slots=True)
class SessionSnapshot:
    """All that a session needs to go on as if nothing had happened.

    Attributes:
        state: where it is.
        stats: what it has counted, without what its engine has.
        resolution: `(height, width)` of the sensor; None before the first packet.
        engine: None before the first packet.
    """

    state: SessionState
    stats: SessionStats
    resolution: Resolution | None
    engine: Snapshot | None
