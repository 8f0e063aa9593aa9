"""Several cameras side by side: one session for each topic, made when it appears and released when it leaves.

Lives here: which session an item goes to, how many there may be, and how one that fails is replaced.
Not here: what a session does (`session`), where items come from (`live`).
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields

from streamfeat.errors import InputError
from streamfeat.messages.packets import Label, Packet
from streamfeat.stream.batch import EmissionBatch, Emitter
from streamfeat.stream.session import Session, StreamItem
from streamfeat.stream.state import SessionSnapshot, SessionStats

__all__ = ["MAX_CAMERAS", "CameraLeft", "Cameras"]

MAX_CAMERAS = 64
"""Topics served at a time; each holds an engine."""

_REST_S = 0.001
"""How long cameras work ahead before the next packet is looked for; the last of them may take longer."""


@dataclass(frozen=True, slots=True)
class CameraLeft:
    """The last publisher of a topic has left."""

    topic: str


class Cameras(Emitter):
    """A session for each topic; takes items of all of them, in any order.

    An item that a session cannot use is refused and counted by reason, and the session starts anew with the
    next: other cameras do not notice.

    Args:
        make_session: makes the session of a topic.
        limit: topics served at a time; packets of more are refused.
        on_refusal: told topic, reason and error.
        clock: seconds, monotonic.
    """

    def __init__(
        self,
        make_session: Callable[[str], Session],
        *,
        limit: int = MAX_CAMERAS,
        on_refusal: Callable[[str, str, str], None] = lambda topic, reason, error: None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Start with no camera."""
        self._clock, self._rested = clock, 0
        self._make_session = make_session
        self._limit = limit
        self._on_refusal = on_refusal
        self._sessions: dict[str, Session] = {}
        self._past = SessionStats()
        self.refused: Counter[str] = Counter()
        self.seen = 0

    @property
    def topics(self) -> list[str]:
        """The topics that are served, in order of appearance."""
        return list(self._sessions)

    def stats(self) -> SessionStats:
        """Totals of all cameras, past and present."""
        return _sum([self._past, *(session.stats() for session in list(self._sessions.values()))])

    def stats_by_topic(self) -> dict[str, SessionStats]:
        """What the session of each topic that is served has done."""
        return {topic: session.stats() for topic, session in list(self._sessions.items())}

    def snapshots(self) -> dict[str, SessionSnapshot]:
        """What each session needs to go on."""
        return {topic: session.snapshot() for topic, session in self._sessions.items()}

    def restore(self, topic: str, snapshot: SessionSnapshot) -> None:
        """Serve a camera as it was served when its snapshot was taken.

        Raises:
            InputError: no session can go on from there.
        """
        session = self._make_session(topic)
        session.restore(snapshot)
        self._sessions[topic] = session
        self.seen += 1

    def batches(self, item: StreamItem | CameraLeft, /) -> Iterator[EmissionBatch]:
        """Hand an item to the session of its topic, and yield the emissions on the way in columns."""
        if isinstance(item, CameraLeft):
            yield from self._release(item.topic)
            return
        session = self._sessions.get(item.topic)
        if session is None and isinstance(item, Packet | Label):
            if len(self._sessions) >= self._limit:
                self._refuse(item.topic, "too many cameras", f"{self._limit} are served already")
                return
            session = self._sessions[item.topic] = self._make_session(item.topic)
            self.seen += 1
        if session is None:
            return
        try:
            yield from session.batches(item)
        except (InputError, MemoryError) as error:
            self._refuse(item.topic, _reason(error), str(error))
            self._past = _sum([self._past, session.stats()])
            del self._sessions[item.topic]

    def rest(self) -> None:
        """Let cameras work ahead in turns, as many as there is time for: packets of all of them wait."""
        sessions = list(self._sessions.values())
        until = self._clock() + _REST_S
        for _ in sessions:
            self._rested = (self._rested + 1) % len(sessions)
            sessions[self._rested].rest()
            if self._clock() >= until:
                break

    def last_batches(self) -> Iterator[EmissionBatch]:
        """End every stream."""
        for topic in self.topics:
            yield from self._release(topic)

    def _release(self, topic: str) -> Iterator[EmissionBatch]:
        session = self._sessions.get(topic)
        if session is None:
            return
        try:
            yield from session.last_batches()
        except (InputError, MemoryError) as error:
            self._refuse(topic, _reason(error), str(error))
        finally:
            self._past = _sum([self._past, session.stats()])
            del self._sessions[topic]

    def _refuse(self, topic: str, reason: str, error: str) -> None:
        self.refused[reason] += 1
        self._on_refusal(topic, reason, error)


def _reason(error: BaseException) -> str:
    """Why a camera is refused; one for which there is no memory leaves that of the others alone."""
    return "out of memory" if isinstance(error, MemoryError) else "unusable"


def _sum(parts: list[SessionStats]) -> SessionStats:
    total = SessionStats()
    for part in parts:
        for field in fields(SessionStats):
            one, more = getattr(total, field.name), getattr(part, field.name)
            if more is not None:
                setattr(total, field.name, (one or 0) + more)
    return total
