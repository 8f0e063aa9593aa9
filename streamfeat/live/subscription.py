"""Subscriptions that fill an inbox.

Lives here: which messages are taken in, by whose callbacks, and the cameras that come and leave.
Not here: sessions (`network`), names (`names`), what messages mean (`intake`).
"""

import threading
import time
from contextlib import suppress
from queue import Full, Queue
from types import TracebackType
from typing import Any, Self

import zenoh
import zenoh.ext
from zenoh.handlers import Callback

from streamfeat.errors import InputError
from streamfeat.live.inbox import Announcement, Inbox, RawMessage
from streamfeat.live.names import ATTACHMENT_BYTES, OUTPUTS, Names, RosNames, ros_entity_token
from streamfeat.live.network import first_line, is_of
from streamfeat.live.refusals import MAX_NAME, problem_of
from streamfeat.live.shard import Shard
from streamfeat.live.topic import MAX_TOPICS
from streamfeat.messages.packets import EVENT_SCHEMAS

__all__ = ["Subscription"]

_HISTORY = 256
"""Packets that a reliable subscriber asks a publisher for when it joins late."""
_MAX_TOKENS = 1 << 14
"""Publishers that are known at a time; announcements of further ones are refused and counted."""
_LONGEST_TOKEN = 4096
_LONGEST_TYPE = 256
"""Characters; longer tokens are refused and counted, longer types are cut."""
_MAX_COME = 1 << 10
"""Announced topics that may wait for a subscription."""


class Subscription:
    """Puts what arrives on some names into an inbox; a context manager.

    Callbacks run in zenoh's own threads and do as little as they can. Features and predictions are not taken
    for events, whatever wildcard matches them.

    Args:
        session: open; not closed here.
        names: of the topics.
        inbox: filled.
        reliable: use zenoh's advanced subscriber, which recovers what was missed and asks for history; works
            with publishers that do the same.
        shard: the cameras to hear; all others are left out, and their packets counted, before their bytes
            are copied.
        announced: hear only cameras that announce themselves by a token, each by a subscription of its own,
            so that packets of other shards do not come over the network, as they do with a wildcard.
    """

    def __init__(
        self,
        session: zenoh.Session,
        names: Names,
        inbox: Inbox,
        *,
        reliable: bool = False,
        shard: Shard | None = None,
        announced: bool = False,
    ) -> None:
        """Subscribe.

        Raises:
            InputError: zenoh refuses a key expression.
        """
        self._names = names
        self._inbox = inbox
        self._shard = shard
        self._session, self._reliable = session, reliable
        # zenoh may not be asked for a subscription from within its own callbacks.
        self._come: Queue[str | None] = Queue(_MAX_COME)
        self._follower = threading.Thread(target=self._follow, name="streamfeat follower", daemon=True)
        self._is_closing = False
        self._tokens: dict[str, set[str]] = {}
        self._n_tokens = 0
        self._open: list[object] = []
        try:
            wanted = [] if announced else names.subscriptions
            self._wanted = zenoh.KeyExpr(names.expression.strip("/"))
            if announced:
                self._follower.start()
            # First the tokens: a publisher that leaves must have been seen before.
            self._open.append(
                session.liveliness().declare_subscriber(
                    names.tokens, Callback(self._on_token, indirect=False), history=True
                )
            )
            self._open += [self._subscribe(expression) for expression in wanted]
            if isinstance(names, RosNames):
                self._announce(session, names)
        except zenoh.ZError as error:
            self.close()
            raise InputError(
                f"{names.subscriptions[0]!r} is no key expression: {first_line(error)}"
            ) from None

    def __enter__(self) -> Self:
        """Give the subscription itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Unsubscribe."""
        self.close()

    def close(self) -> None:
        """Unsubscribe; what is in the inbox stays there."""
        self._is_closing = True
        for declared in reversed(self._open):
            declared.undeclare()  # type: ignore[attr-defined]
        self._open.clear()
        if self._follower.is_alive():
            with suppress(Full):  # what waits there wakes the follower as well
                self._come.put_nowait(None)
            self._follower.join()

    def _follow(self) -> None:
        """Subscribe to each topic that is announced; a publisher that left may have packets under way."""
        followed: dict[str, list[Any]] = {}
        while (topic := self._come.get()) is not None and not self._is_closing:
            if topic in followed or topic not in self._tokens:
                continue
            gone = [one for one in followed if one not in self._tokens]
            if len(followed) >= MAX_TOPICS:
                if not gone:
                    self._inbox.refuse()
                    continue
                for declared in followed.pop(gone[0]):
                    declared.undeclare()
            with suppress(zenoh.ZError, InputError):  # no topic: the token was made up
                names = self._names.only(topic).subscriptions
                followed[topic] = [self._subscribe(expression) for expression in names]
        for several in followed.values():
            for declared in several:
                declared.undeclare()

    def _subscribe(self, expression: str) -> object:
        callback = Callback(self._on_sample, indirect=False)
        if not self._reliable:
            return self._session.declare_subscriber(expression, callback)
        return zenoh.ext.declare_advanced_subscriber(
            self._session,
            expression,
            callback,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=_HISTORY),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )

    def _announce(self, session: zenoh.Session, names: RosNames) -> None:
        zid = str(session.zid())
        liveliness = session.liveliness()
        tokens = [ros_entity_token(names.domain, zid, 0, "NN", "streamfeat_listener")]
        if "*" not in names.expression:
            subscribed = (names.expression, EVENT_SCHEMAS[0])
            about = names.domain, zid, 10, "MS", "streamfeat_listener", *subscribed
            tokens.append(ros_entity_token(*about, has_hashes=names.has_hashes))
        self._open += [liveliness.declare_token(token) for token in tokens]

    def _on_sample(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        topic = self._names.topic(key)
        if sample.kind != zenoh.SampleKind.PUT or topic.rpartition("/")[2] in OUTPUTS:
            return
        if self._shard and not self._shard.has(topic):
            self._inbox.leave()
            return
        problem = problem_of(key, topic, len(sample.payload))
        attachment = sample.attachment
        attached = attachment.to_bytes() if attachment and len(attachment) <= ATTACHMENT_BYTES else b""
        self._inbox.put(
            RawMessage(
                topic[:MAX_NAME],
                (self._names.schema(key, str(sample.encoding)) or "")[:_LONGEST_TYPE],
                b"" if problem else sample.payload.to_bytes(),
                attached,
                time.monotonic_ns(),
                time.time_ns(),
                problem,
            )
        )

    def _on_token(self, sample: zenoh.Sample) -> None:
        token = str(sample.key_expr)
        topic = self._names.token_topic(token)
        if len(token) > _LONGEST_TOKEN or len(topic) > MAX_NAME:
            self._inbox.refuse()
            return
        if not topic or (self._shard and not self._shard.has(topic)):
            return
        # As sets: of a token that comes while the subscription is made, zenoh may tell twice.
        tokens = self._tokens.get(topic, set())
        if sample.kind == zenoh.SampleKind.PUT:
            if token in tokens:
                return
            if self._n_tokens >= _MAX_TOKENS:
                self._inbox.refuse()
                return
            self._tokens.setdefault(topic, tokens).add(token)
            self._n_tokens += 1
            if len(tokens) == 1:
                self._inbox.put(Announcement(topic, here=True))
                if self._follower.is_alive() and is_of(self._wanted, topic):
                    self._ask_for(topic)
        elif token in tokens:
            tokens.discard(token)
            self._n_tokens -= 1
            if not tokens:
                del self._tokens[topic]
                self._inbox.put(Announcement(topic, here=False))

    def _ask_for(self, topic: str) -> None:
        """Have the follower subscribe to a topic, unless too many wait for that already."""
        try:
            self._come.put_nowait(topic)
        except Full:
            self._inbox.refuse()
