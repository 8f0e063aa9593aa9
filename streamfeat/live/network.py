"""zenoh sessions: opened safely, subscribed to, asked what is there.

Lives here: configuration, subscriptions that fill an inbox, liveliness of publishers.
Not here: publishing (`publisher`), names (`names`), what messages mean (`intake`).

Without a configuration file a session is on this machine alone: the first to come listens on 127.0.0.1:7447,
later ones connect to it and keep trying, and nobody scouts by multicast. Sessions that know one another find
the others through it. A ROS 2 router (`rmw_zenohd`) on this machine is found in the same way.
"""

import json
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Full, Queue
from types import TracebackType
from typing import Any, Self

import zenoh
import zenoh.ext
from zenoh.handlers import Callback

from streamfeat.errors import InputError
from streamfeat.live.inbox import Announcement, Inbox, RawMessage
from streamfeat.live.intake import MAX_PAYLOAD_BYTES
from streamfeat.live.names import ATTACHMENT_BYTES, OUTPUTS, Names, PlainNames, RosNames, ros_entity_token
from streamfeat.live.shard import Shard
from streamfeat.live.topic import MAX_TOPICS
from streamfeat.messages.packets import EVENT_SCHEMAS

__all__ = ["DEFAULT_PORT", "FoundTopic", "Subscription", "TopicWatch", "find_topics", "open_session"]

DEFAULT_PORT = 7447
_MAX_MESSAGE_BYTES = 16 << 20
"""What zenoh puts together from fragments; a message of more never reaches us."""
_QUEUED_BATCHES = 16
_MAX_TOKENS = 1 << 14
"""Publishers that are known at a time; announcements of further ones are refused and counted."""
_MAX_COME = 1 << 10
"""Announced topics that may wait for a subscription."""
"""Of 64 kB, the most that zenoh allows: a reader that hesitates costs a camera nothing yet."""
_PATIENCE = {"drop": {"wait_before_drop": 50_000}, "block": {"wait_before_close": 60_000_000}}
"""Microseconds: how long a full queue may stay full before zenoh drops a message, or closes the link."""
_NO_SHARED_MEMORY = '{"enabled": false}'
"""zenoh puts messages above 3 kB there by itself, and takes them back from a reader that hesitates for some
seconds, without a word to either side. Sockets wait; up to 64 kB they are as quick."""
_HISTORY = 256
"""Packets that a reliable subscriber asks a publisher for when it joins late."""


def open_session(config: Path | None = None, *, port: int = DEFAULT_PORT) -> zenoh.Session:
    """Open a session.

    Args:
        config: JSON5 configuration of zenoh, used as it is, but that messages are given timestamps, which
            recovering lost ones needs, and that none go through shared memory; without it, this machine
            alone.
        port: where sessions on this machine meet; only without `config`.

    Raises:
        InputError: the file cannot be read or does not hold a configuration, or zenoh cannot open with it.
    """
    if config:
        try:
            chosen = zenoh.Config.from_file(config)
            chosen.insert_json5("timestamping", "{enabled: true}")
            chosen.insert_json5("transport/shared_memory", _NO_SHARED_MEMORY)
            return zenoh.open(chosen)
        except (zenoh.ZError, OSError) as error:
            raise InputError(f"{config}: zenoh cannot use this configuration: {_first_line(error)}") from None
    meeting = f"tcp/127.0.0.1:{port}"
    try:
        return zenoh.open(_loopback([meeting], []))
    except zenoh.ZError:
        try:
            return zenoh.open(_loopback(["tcp/127.0.0.1:0"], [meeting]))
        except zenoh.ZError as error:
            raise InputError(f"zenoh cannot open a session on this machine: {_first_line(error)}") from None


def _loopback(listen: list[str], connect: list[str]) -> zenoh.Config:
    return zenoh.Config.from_json5(
        json.dumps(
            {
                "mode": "peer",
                "listen": {"endpoints": listen, "exit_on_failure": True},
                "connect": {
                    "endpoints": connect,
                    "timeout_ms": -1,
                    "exit_on_failure": False,
                    "retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
                },
                "scouting": {"multicast": {"enabled": False}},
                "timestamping": {"enabled": True},
                "transport": {
                    "shared_memory": json.loads(_NO_SHARED_MEMORY),
                    "link": {
                        "rx": {"max_message_size": _MAX_MESSAGE_BYTES},
                        "tx": {"queue": {"size": {"data": _QUEUED_BATCHES}, "congestion_control": _PATIENCE}},
                    },
                },
            }
        )
    )


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:300]


class Subscription:
    """Puts what arrives on some names into an inbox; a context manager.

    Callbacks run in zenoh's own threads and do as little as they can. Our own outputs are not taken for
    events, whatever wildcard matches them.

    Args:
        session: open; not closed here.
        names: of the topics.
        inbox: filled.
        reliable: use zenoh's advanced subscriber, which recovers what was missed and asks for history; works
            with publishers that do the same.
        shard: the cameras to hear; all others are left out, and their packets counted, before their bytes
            are copied.
        announced: hear those only that announce themselves by a token, each by a subscription of its own, so
            that packets of other shards do not come over the network at all. A wildcard hears everybody.
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
        self._tokens: dict[str, set[str]] = {}
        self._n_tokens = 0
        self._open: list[object] = []
        try:
            wanted = [] if announced else names.subscriptions
            self._wanted = zenoh.KeyExpr(names.expression.strip("/"))
            if announced:
                self._follower.start()
            # First the tokens: who leaves was there before.
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
                f"{names.subscriptions[0]!r} is no key expression: {_first_line(error)}"
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
        for declared in reversed(self._open):
            declared.undeclare()  # type: ignore[attr-defined]
        self._open.clear()
        if self._follower.is_alive():
            self._come.put(None)
            self._follower.join()

    def _follow(self) -> None:
        """Subscribe to each topic that is announced; who left may have packets under way."""
        followed: dict[str, list[Any]] = {}
        while (topic := self._come.get()) is not None:
            if topic in followed:
                continue
            with suppress(zenoh.ZError, InputError):  # no topic: somebody made that token up
                names = self._names.only(topic).subscriptions
                followed[topic] = [self._subscribe(expression) for expression in names]
            gone = [one for one in followed if one not in self._tokens]
            for one in gone[: max(len(followed) - MAX_TOPICS, 0)]:
                for declared in followed.pop(one):
                    declared.undeclare()
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
            tokens.append(ros_entity_token(names.domain, zid, 10, "MS", "streamfeat_listener", *subscribed))
        self._open += [liveliness.declare_token(token) for token in tokens]

    def _on_sample(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        topic = self._names.topic(key)
        if sample.kind != zenoh.SampleKind.PUT or topic.rpartition("/")[2] in OUTPUTS:
            return
        if self._shard and not self._shard.has(topic):
            self._inbox.leave()
            return
        size = len(sample.payload)
        problem = "too large" if size > MAX_PAYLOAD_BYTES else ""
        attachment = sample.attachment
        attached = attachment.to_bytes() if attachment and len(attachment) <= ATTACHMENT_BYTES else b""
        self._inbox.put(
            RawMessage(
                topic,
                self._names.schema(key, str(sample.encoding)) or "",
                b"" if problem else sample.payload.to_bytes(),
                attached,
                time.monotonic_ns(),
                time.time_ns(),
                problem,
            )
        )

    def _on_token(self, sample: zenoh.Sample) -> None:
        topic = self._names.token_topic(str(sample.key_expr))
        if not topic or (self._shard and not self._shard.has(topic)):
            return
        # As sets: of a token that comes while the subscription is made, zenoh may tell twice.
        token, tokens = str(sample.key_expr), self._tokens.get(topic, set())
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
                if self._follower.is_alive() and _is_of(self._wanted, topic):
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


class TopicWatch:
    """Finds the topics that publishers announce, as long as it is open; a context manager.

    Args:
        session: open; not closed here.
        names: of the topics.
        on_topic: told each topic that is there or appears, perhaps several times, from a thread of zenoh.
    """

    def __init__(self, session: zenoh.Session, names: Names, on_topic: Callable[[str], None]) -> None:
        """Start watching.

        Raises:
            InputError: zenoh refuses the key expression.
        """
        try:
            wanted = zenoh.KeyExpr(names.expression.strip("/"))

            def on_token(sample: zenoh.Sample) -> None:
                topic = names.token_topic(str(sample.key_expr))
                if topic and sample.kind == zenoh.SampleKind.PUT and _is_of(wanted, topic):
                    on_topic(topic)

            self._watching = session.liveliness().declare_subscriber(
                names.tokens, Callback(on_token, indirect=False), history=True
            )
        except zenoh.ZError as error:
            raise InputError(f"{names.expression!r} is no key expression: {_first_line(error)}") from None

    def __enter__(self) -> Self:
        """Give the watch itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop watching."""
        self._watching.undeclare()  # type: ignore[no-untyped-call]


def _is_of(wanted: zenoh.KeyExpr, topic: str) -> bool:
    """Whether a token is of a topic that is wanted: ROS 2 tells of all, and nobody's token is a wildcard."""
    try:
        return "*" not in topic and wanted.includes(zenoh.KeyExpr(topic.strip("/")))
    except zenoh.ZError:
        return False


@dataclass(frozen=True, slots=True, order=True)
class FoundTopic:
    """A topic that somebody publishes events on.

    Attributes:
        name: key, or ROS 2 topic.
        kind: `zenoh` or `ros2`.
        domain: of ROS 2; -1 for plain zenoh.
        publishers: how many.
    """

    name: str
    kind: str
    domain: int
    publishers: int


def find_topics(session: zenoh.Session, seconds: float = 1.0) -> list[FoundTopic]:
    """Listen to who publishes events; publishers of plain keys are found if they declare a token.

    Args:
        session: open.
        seconds: how long; sessions need some milliseconds to find one another.
    """
    tokens: dict[str, None] = {}

    def on_token(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            tokens[str(sample.key_expr)] = None
        else:
            tokens.pop(str(sample.key_expr), None)

    plain, ros = PlainNames("**"), RosNames("/any")
    expressions = (plain.tokens, ros.tokens.replace(f"/{ros.domain}/", "/*/", 1))
    callback = Callback(on_token, indirect=False)
    watching = [
        session.liveliness().declare_subscriber(expression, callback, history=True)
        for expression in expressions
    ]
    time.sleep(seconds)
    for one in watching:
        one.undeclare()  # type: ignore[no-untyped-call]
    found: Counter[tuple[str, str, int]] = Counter()
    for token in list(tokens):
        if token.startswith("@ros2_lv/"):
            domain = token.split("/")[1]
            topic = ros.token_topic(token)
            if topic and domain.isdecimal():
                found[topic, "ros2", int(domain)] += 1
        else:
            found[plain.token_topic(token), "zenoh", -1] += 1
    return sorted(FoundTopic(*which, n) for which, n in found.items())
