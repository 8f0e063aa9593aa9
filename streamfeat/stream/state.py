"""Where a session is in its stream, how it moves on, and all that it needs to go on from there.

Lives here: `SessionState` and its transitions, what a session has counted, `SessionSnapshot`; reading them
from JSON, checked.
Not here: engines, policies and what is emitted (`session`), files.
"""

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from streamfeat.engine.snapshot import Snapshot
from streamfeat.errors import InputError
from streamfeat.events import TIME_LIMIT, Events, Resolution
from streamfeat.files.json_fields import Fields
from streamfeat.kernels.decode import place_events
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
        emissions: emissions made.
        incomplete: of those, how many lacked packets known to be missing from the window.
        samples: labelled samples that ended.
        correct: of those, how many were predicted correctly; None without a classifier.
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
            InputError: the values are not such counts.
        """
        names = [field.name for field in fields(cls) if field.name != "correct"]
        return cls(**{name: values.whole(name) for name in names}, correct=values.maybe("correct"))


@dataclass(slots=True)
class SessionState:
    """Where a session is in its stream, and the rules by which it moves on.

    Stream time never goes back within an epoch; an emission is due, under a policy of time and in silence, at
    multiples of `every_us` from the origin.

    Attributes:
        origin_us: stream time at which bin 0 starts.
        last_us: stream time that events have reached.
        next_us: when the next emission is due by time, or in silence; None if that follows from `last_us`.
        every_us: stream time between such emissions.
        unread: events since the latest emission.
        epoch: of the camera's clock; None before the first packet.
        silent_us: stream time up to which there were emissions in silence.
        incomplete_us: stream time up to which packets are known to be missing from the window.
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
    silent_us: int = -TIME_LIMIT
    incomplete_us: int = -TIME_LIMIT
    lost: bool = False
    seen_label: bool = False
    sample: Label | None = None

    def begin(self, origin_us: int) -> None:
        """Start with an empty window whose bins start at the origin."""
        self.origin_us = self.last_us = origin_us
        self.next_us = None
        self.unread = 0
        self.silent_us = self.incomplete_us = -TIME_LIMIT

    def open_sample(self, sample: Label) -> None:
        """A labelled sample starts, with an empty window and its own origin."""
        self.sample, self.seen_label = sample, True
        self.begin(sample.start_us)

    def close_sample(self) -> None:
        """The labelled sample has ended."""
        self.sample = self.next_us = None

    @property
    def sample_end_us(self) -> int | None:
        """Where the open sample ends; None outside of one."""
        return self.sample.start_us + self.sample.duration_us if self.sample else None

    @property
    def is_between_samples(self) -> bool:
        """Whether labelled samples come with this stream and none is open: silence tells nothing then."""
        return self.seen_label and self.sample is None

    @property
    def is_untouched(self) -> bool:
        """Whether a sample is open, and nothing has come or been emitted since."""
        return self.sample is not None and self.silent_us < self.sample.start_us

    def touch(self) -> None:
        """Events come, be they of the open sample or not."""
        if self.sample:
            # Nothing is emitted before the start of the sample, so that this moves no emission.
            self.silent_us = max(self.silent_us, self.sample.start_us)

    def begin_epoch(self, epoch: int) -> None:
        """Start anew with the camera's clock: an empty window, with nothing known of what came before.

        A sample that is still open has been labelled in the new clock: of its window nothing is missing.
        """
        self.begin(self.sample.start_us if self.sample else 0)
        self.lost = self.sample is None
        self.epoch = epoch

    def place(self, events: Events, resolution: Resolution, window_us: int) -> tuple[NDArray[np.int64], int]:
        """Stream time after each event of a packet: it never goes back, and invalid events have no say.

        What is missing came before this packet, so it has left the window one window after its first event.

        Args:
            events: `(n,)` of the packet, n > 0; not changed.
            resolution: of the sensor.
            window_us: length of the window.

        Returns:
            stream time `(n,)` int64 microseconds, and the time of the earliest event that can be used.
        """
        if not (events.flags.writeable and events.flags.c_contiguous):
            events = events.copy()  # one compiled kernel serves all
        latest, span = np.empty(len(events), np.int64), np.full(2, TIME_LIMIT, np.int64)
        place_events(events, *resolution, self.last_us, latest, span)
        if self.lost:
            self.incomplete_us = max(self.incomplete_us, int(latest[0]) + window_us)
            self.lost = False
        return latest, int(span[0])

    def take(self, n_events: int, last_us: int) -> None:
        """Events were fed that reach so far."""
        self.unread += n_events
        self.last_us = max(self.last_us, last_us)

    def due(self, t_us: int, window_us: int) -> int:
        """When the next emission is due, given stream time; those of an empty window are passed over."""
        following = self._following(t_us)
        if self.next_us is None:
            self.next_us = following
        # After this nothing changes until the next event; between labelled samples nothing is of interest.
        quiet_us = self.last_us + (0 if self.is_between_samples else window_us + self.every_us)
        if self.next_us > quiet_us and not self.unread:
            self.next_us = following
        return self.next_us

    def due_in_silence(self, t_us: int, window_us: int) -> int:
        """As `due`, where time passes without events: from the latest event on."""
        if self.next_us is None:
            self.next_us = self._following(self.last_us)
        return self.due(t_us, window_us)

    def pass_due(self, due_us: int, *, in_silence: bool = False) -> None:
        """An emission was made when it was due."""
        self.next_us = due_us + self.every_us
        if in_silence:
            self.silent_us = due_us

    def forget_due(self) -> None:
        """What follows is not emitted by time; the next due emission follows from stream time."""
        self.next_us = None

    def emit(self, t_us: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Stream times of emissions `(n,)`, and whether packets are known to be missing from each."""
        # After emissions in silence, stream time as told by events may lie behind them.
        t_us = np.maximum(t_us, self.silent_us)
        return t_us, t_us <= self.incomplete_us

    def resumed(self, every_us: int) -> Self:
        """A copy for a session with its own time between emissions."""
        return replace(self, every_us=every_us, next_us=self.next_us if every_us == self.every_us else None)

    def _following(self, t_us: int) -> int:
        return t_us - (t_us - self.origin_us) % self.every_us + self.every_us

    @classmethod
    def from_json(cls, values: Fields) -> Self:
        """Read what `asdict` wrote, of a live stream.

        Raises:
            InputError: the values are not a state, or not one that a session can be in.
        """
        origin_us, last_us = (
            values.whole("origin_us", -_LATEST_US, _LATEST_US),
            values.whole("last_us", -_LATEST_US, _LATEST_US),
        )
        every_us = values.whole("every_us")
        # One that lay far back would be followed by an emission for each step from there to now.
        next_us = values.maybe("next_us", last_us + 1, _LATEST_US)
        if next_us is not None and (every_us == 0 or (next_us - origin_us) % every_us):
            raise InputError(f"{values.where}: no emission is due at {next_us} us")
        return cls(
            origin_us=origin_us,
            last_us=last_us,
            next_us=next_us,
            every_us=every_us,
            unread=values.whole("unread"),
            epoch=values.maybe("epoch"),
            silent_us=values.whole("silent_us", -TIME_LIMIT, _LATEST_US),
            incomplete_us=values.whole("incomplete_us", -TIME_LIMIT, _LATEST_US),
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
