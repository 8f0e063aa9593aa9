"""Playing a recording under control: pause, step, seek, speed, again from the start.

Lives here: `Player`, the items of a recording as they are due; `Timeline`, the event rate over played time.
Not here: what is done with the items, and the page whose buttons steer them.

Played time starts at 0 and goes on by what the stream's own time does. A step back, or ahead by more than ten
seconds, counts as none, so that a camera's clock that starts anew neither stops nor rushes the player.
"""

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from threading import Condition, Thread
from typing import Any, Literal

import numpy as np

from streamfeat.events import Events
from streamfeat.messages.packets import Label, Packet, Watermark
from streamfeat.recordings.reader import Losses, Recording

__all__ = ["Piece", "Player", "Timeline", "items_between"]

_SLICE_US = 10_000
"""Packets are cut to this length of the clock, so that a picture never waits for the end of a long one."""
_STEP_US = 33_000
_JUMP_US = 10_000_000
_NEW_EPOCH = 1 << 20
"""Added to the epoch of each packet once for each seek: more than a recording has restarts."""
_MOST_COLUMNS = 1024
_MOST_PIECES = 4_096

Item = Packet | Label
Outcome = Literal["go", "seek", "stop", "end"]


@dataclass(slots=True)
class Piece:
    """Played time in which it goes on as stream time does.

    Attributes:
        played_us: at its start.
        stream_us: at its start.
        stream_end_us: as far as it goes.
    """

    played_us: int
    stream_us: int
    stream_end_us: int


class PlayedTime:
    """Time that has been played when a batch has been shown, in microseconds.

    Attributes:
        us: played so far.
        pieces: which stream time was played when, in order; of a stream that jumps on and on the first 4,096.
    """

    def __init__(self) -> None:
        """Nothing was played."""
        self.us = 0
        self.pieces: list[Piece] = []
        self._last_us: int | None = None

    def add(self, events: Events) -> int:
        """Go on to the end of a batch, which has an event at least."""
        latest = int(events["t"].max())
        before = int(events["t"].min()) if self._last_us is None else self._last_us
        step = latest - before
        goes_on = 0 <= step <= _JUMP_US
        if self._last_us is None:
            self.pieces.append(Piece(0, before, latest))
        elif goes_on:
            self.pieces[-1].stream_end_us = latest
        elif len(self.pieces) < _MOST_PIECES:
            self.pieces.append(Piece(self.us, latest, latest))
        self.us += step if goes_on else 0
        self._last_us = latest
        return self.us


def items_between(items: Iterator[Item], slice_us: int) -> Iterator[Item]:
    """The same items, with packets cut where they are longer than `slice_us`."""
    for item in items:
        if not isinstance(item, Packet) or len(item.events) == 0:
            yield item
            continue
        latest = np.maximum.accumulate(item.events["t"])
        start = 0
        while start < len(latest):
            stop = int(np.searchsorted(latest, latest[start] + slice_us))
            yield item if stop - start == len(latest) else replace(item, events=item.events[start:stop])
            start = stop


class Player:
    """The items of a recording, each when it is due. Steered from any thread, iterated by one.

    Args:
        opening: opens the recording, which is read from its start again for each seek.
        choose: makes the items that are played of those of the recording.
        speed: played seconds for each second of the clock; None for as fast as possible.
        loop: start again at the end.
        stays: wait at the end until `stop`, because a viewer may seek.
        on_change: called with what the page shows of the player, whenever that changes.
    """

    def __init__(
        self,
        opening: Callable[[], Recording],
        choose: Callable[[Iterator[Item]], Iterator[Item]] = lambda items: items,
        *,
        speed: float | None = 1.0,
        loop: bool = False,
        stays: bool = False,
        on_change: Callable[[dict[str, Any]], None] = lambda state: None,
    ) -> None:
        """Nothing is read before iteration."""
        self._opening, self._choose, self._loop, self._stays = opening, choose, loop, stays
        self.losses = Losses()
        self._on_change = on_change
        self._changed = Condition()
        self._speed = speed
        self._paused = self._stopped = self._ended = False
        self._seek_us: int | None = None
        self._step_to_us: int | None = None
        self._seeks = 0
        self._at_us = 0
        self._due: tuple[float, int] | None = None
        self._open_label: Label | None = None

    def pause(self, paused: bool) -> None:
        """Stand still, or go on."""
        with self._changed:
            self._paused, self._due, self._step_to_us = paused, None, None
            self._changed.notify_all()

    def step(self) -> None:
        """Play one picture's length, and stand still."""
        with self._changed:
            self._paused, self._due, self._step_to_us = False, None, self._at_us + _STEP_US
            self._changed.notify_all()

    def set_speed(self, speed: float | None) -> None:
        """Play so many times as fast as it was recorded; None for as fast as possible."""
        with self._changed:
            self._speed, self._due = speed, None
            self._changed.notify_all()

    def seek(self, played_us: int) -> None:
        """Go on from another time, counted from the start."""
        with self._changed:
            self._seek_us = self._at_us = max(played_us, 0)
            self._due = None
            self._changed.notify_all()

    def stop(self) -> None:
        """End the items."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def state(self) -> dict[str, Any]:
        """What the page shows: played seconds, whether it stands still or has ended, and the speed."""
        return {
            "at_s": self._at_us / 1e6,
            "paused": self._paused,
            "ended": self._ended,
            "speed": self._speed,
        }

    def __iter__(self) -> Iterator[Item | Watermark | None]:
        """Yield items when they are due; None before a wait, so that what was given is not held back."""
        with self._opening() as recording:
            yield from self._items(recording)

    def _items(self, recording: Recording) -> Iterator[Item | Watermark | None]:
        start_us = 0
        while (outcome := (yield from self._play(recording, start_us))) != "stop":
            if outcome == "end" and not self._loop:
                self._ended = True
                self._on_change(self.state())
                if not self._stays:
                    return
                if self._open_label:
                    # Nothing else says that the last sample is over.
                    label = self._open_label
                    yield Watermark(recording.topic, label.start_us + label.duration_us)
                yield None
                with self._changed:
                    self._changed.wait_for(lambda: self._seek_us is not None or self._stopped)
            with self._changed:
                start_us, self._seek_us = self._seek_us or 0, None
                self._seeks += 1
                self._ended, self._due, self._open_label = False, None, None

    def _play(self, recording: Recording, start_us: int) -> Generator[Item | None, None, Outcome]:
        """Play from a time to the end, or until told otherwise: how it ended."""
        played = PlayedTime()
        slice_us = round(_SLICE_US * max(self._speed or 1.0, 1.0))
        for item in items_between(self._choose(iter(recording.items())), slice_us):
            self.losses = recording.losses
            if self._stopped:
                return "stop"
            if isinstance(item, Label):
                if start_us <= played.us or start_us == 0:
                    self._open_label = item
                    yield item
                continue
            if len(item.events):
                at_us = played.add(item.events)
                if at_us < start_us:
                    if self._seek_us is not None:
                        return "seek"
                    continue
                outcome = yield from self._wait_until(at_us)
                if outcome != "go":
                    return outcome
            yield replace(item, epoch=item.epoch + self._seeks * _NEW_EPOCH) if self._seeks else item
        return "end"

    def _wait_until(self, at_us: int) -> Generator[None, None, Outcome]:
        """Wait until a time is due: go, seek or stop."""
        told = False
        while True:
            with self._changed:
                outcome = self._outcome(at_us)
                if isinstance(outcome, str):
                    if outcome == "go":
                        self._at_us = at_us
                        self._on_change(self.state())
                    return outcome
                if told:
                    if self._paused:
                        self._on_change(self.state())
                    self._changed.wait(min(outcome, 0.25))
            if not told:
                told = True
                yield None

    def _outcome(self, at_us: int) -> Outcome | float:
        """What to do with what ends at a time, or for how many seconds to wait."""
        if self._stopped:
            return "stop"
        if self._seek_us is not None:
            return "seek"
        if self._step_to_us is not None and at_us >= self._step_to_us:
            self._paused, self._step_to_us = True, None
            return "go"
        if self._paused:
            return 0.25
        if self._speed is None or self._step_to_us is not None:
            return "go"
        now = time.monotonic()
        if self._due is None:
            self._due = now, at_us
        wait = self._due[0] + (at_us - self._due[1]) / (1e6 * self._speed) - now
        return "go" if wait <= 0 else wait


class Timeline:
    """The event rate over all of a recording, counted by a thread that takes half of a core at most.

    Args:
        opening: opens the recording once more.
        tell: called now and then with seconds of a column, counts of events, and whether that is all.
        place: called before it with which stream time is played when, and the played time that was read.
    """

    def __init__(
        self,
        opening: Callable[[], Recording],
        tell: Callable[[dict[str, Any]], None],
        place: Callable[[Sequence[Piece], int], None] = lambda pieces, end_us: None,
    ) -> None:
        """Begin to count."""
        self._opening, self._tell, self._place = opening, tell, place
        self._stopped = False
        self._thread = Thread(target=self._count, name="timeline", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End counting."""
        self._stopped = True
        self._thread.join()

    def _count(self) -> None:
        counts = np.zeros(_MOST_COLUMNS, np.int64)
        column_us, played, told = 1_000, PlayedTime(), 0.0
        with self._opening() as recording:
            for item in recording.items():
                started = time.monotonic()
                if self._stopped:
                    return
                if not isinstance(item, Packet) or len(item.events) == 0:
                    continue
                at_us = played.add(item.events)
                while at_us // column_us >= _MOST_COLUMNS:
                    counts[: _MOST_COLUMNS // 2] = counts.reshape(-1, 2).sum(axis=1)
                    counts[_MOST_COLUMNS // 2 :] = 0
                    column_us *= 2
                t = item.events["t"]
                columns = (at_us - (t.max() - t)).clip(0) // column_us
                counts += np.bincount(columns, minlength=_MOST_COLUMNS)
                if started > told + 0.5:
                    told = started
                    self._place([replace(piece) for piece in played.pieces], at_us)
                    self._tell(self._record(counts, column_us, at_us, done=False))
                time.sleep(min(time.monotonic() - started, 0.1))
        self._place(played.pieces, played.us)
        self._tell(self._record(counts, column_us, played.us, done=True))

    @staticmethod
    def _record(counts: Any, column_us: int, at_us: int, *, done: bool) -> dict[str, Any]:
        n = at_us // column_us + 1
        return {"column_s": column_us / 1e6, "counts": counts[:n].tolist(), "done": done}
