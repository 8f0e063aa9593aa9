"""zenoh sessions: opened safely, and asked what is there.

Lives here: `Network`, which opens sessions; finding topics by the liveliness of their publishers.
Not here: subscribing (`subscription`), publishing (`publisher`), names (`names`), messages (`intake`).

Without a configuration file a session is on this machine alone: the first listens on 127.0.0.1:7447, later
ones connect to it and keep trying, and there is no multicast scouting. Sessions find each other through those
that they know. A ROS 2 router (`rmw_zenohd`) on this machine is found in the same way.
"""

import json
import re
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import zenoh
from zenoh.handlers import Callback

from streamfeat.errors import InputError
from streamfeat.live.names import Names, PlainNames, RosNames

__all__ = [
    "DEFAULT_PORT",
    "THIS_MACHINE",
    "FoundTopic",
    "Network",
    "TopicWatch",
    "find_topics",
    "first_line",
    "is_of",
    "open_session",
]

DEFAULT_PORT = 7447
_MAX_MESSAGE_BYTES = 16 << 20
"""What zenoh puts together from fragments; a message of more never reaches us."""
_QUEUED_BATCHES = 16
"""Of 64 kB, the most that zenoh allows: a reader that hesitates costs a camera nothing yet."""
_PATIENCE = {"drop": {"wait_before_drop": 50_000}, "block": {"wait_before_close": 60_000_000}}
"""Microseconds: how long a full queue may stay full before zenoh drops a message, or closes the link."""
_NO_SHARED_MEMORY = '{"enabled": false}'
"""zenoh puts messages above 3 kB there by itself, and takes them back from a reader that hesitates for some
seconds, without a word to either side. Sockets wait; up to 64 kB they are as quick."""
_MEETING_S = 8.0
"""How long a busy machine may take to answer a session that connects, before the port is taken for another
program's."""
_POLL_S = 0.01
_MOST_TOKENS = 1 << 14
"""Announcements that are kept; anybody can make more."""
_DOMAIN = re.compile("[0-9]{1,3}")
_RUST_PLACE = re.compile(r",? at /\S+\.rs(:\d+)?\.?")


@dataclass(frozen=True, slots=True)
class Network:
    """Where live topics are.

    Attributes:
        config: JSON5 configuration of zenoh, used as it is, but that messages are given timestamps, which
            recovering lost ones needs, and that none go through shared memory; None for this machine alone.
        port: where sessions on this machine meet; without `config` only.
        reliable: recover lost messages, between two ends that both ask for it.

    Raises:
        InputError: there is no such port.
    """

    config: Path | None = None
    port: int = DEFAULT_PORT
    reliable: bool = False

    def __post_init__(self) -> None:
        """Check the port."""
        if not 1 <= self.port <= 65535:
            raise InputError(f"--port {self.port}: there is no such port; give one from 1 to 65535")

    def open(self) -> zenoh.Session:
        """Open a session.

        Raises:
            InputError: the file cannot be read or does not hold a configuration, zenoh cannot open with it,
                or another program holds the port.
        """
        if self.config:
            try:
                chosen = zenoh.Config.from_file(self.config)
                chosen.insert_json5("timestamping", "{enabled: true}")
                chosen.insert_json5("transport/shared_memory", _NO_SHARED_MEMORY)
                return zenoh.open(chosen)
            except (zenoh.ZError, OSError) as error:
                raise InputError(
                    f"{self.config}: zenoh cannot use this configuration: {first_line(error)}"
                ) from None
        meeting = f"tcp/127.0.0.1:{self.port}"
        with suppress(zenoh.ZError):
            return zenoh.open(_loopback([meeting], []))
        try:
            session = zenoh.open(_loopback(["tcp/127.0.0.1:0"], [meeting]))
        except zenoh.ZError as error:
            raise InputError(f"zenoh cannot open a session here: {first_line(error)}") from None
        if _has_met(session):
            return session
        session.close()  # type: ignore[no-untyped-call]
        with suppress(zenoh.ZError):  # the session that held the port may have left meanwhile
            return zenoh.open(_loopback([meeting], []))
        raise InputError(
            f"port {self.port} of this machine is held by a program that does not speak zenoh; give --port "
            "another one, here and wherever these topics are published or heard"
        )


THIS_MACHINE = Network()
"""Sessions on this machine, at the usual port."""


def open_session(config: Path | None = None, *, port: int = DEFAULT_PORT) -> zenoh.Session:
    """Open a session, as `Network.open`."""
    return Network(config, port).open()


def _has_met(session: zenoh.Session) -> bool:
    """Whether a session finds another one, which takes milliseconds where there is one."""
    until = time.monotonic() + _MEETING_S
    while time.monotonic() < until:
        if session.info.peers_zid() or session.info.routers_zid():
            return True
        time.sleep(_POLL_S)
    return False


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


def first_line(error: Exception) -> str:
    """What zenoh says of an error, without where in its sources."""
    return _RUST_PLACE.sub("", str(error).splitlines()[0][:600])[:300]


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
                if topic and sample.kind == zenoh.SampleKind.PUT and is_of(wanted, topic):
                    on_topic(topic)

            self._watching = session.liveliness().declare_subscriber(
                names.tokens, Callback(on_token, indirect=False), history=True
            )
        except zenoh.ZError as error:
            raise InputError(f"{names.expression!r} is no key expression: {first_line(error)}") from None

    def __enter__(self) -> Self:
        """Give the watch itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop watching."""
        self._watching.undeclare()  # type: ignore[no-untyped-call]


def is_of(wanted: zenoh.KeyExpr, topic: str) -> bool:
    """Whether a token is of a topic that is wanted, for ROS 2 tells of all; tokens have no wildcards."""
    try:
        return "*" not in topic and wanted.includes(zenoh.KeyExpr(topic.strip("/")))
    except zenoh.ZError:
        return False


@dataclass(frozen=True, slots=True, order=True)
class FoundTopic:
    """A topic with publishers of events.

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
    """Find topics that events are published on; those of plain keys if their publishers declare a token.

    At most 16,384 announcements are looked at; those that name no topic are passed over.

    Args:
        session: open.
        seconds: how long; sessions need some milliseconds to find one another.
    """
    tokens: dict[str, None] = {}

    def on_token(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            if len(tokens) < _MOST_TOKENS:
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
            if topic.strip("/") and _DOMAIN.fullmatch(domain):
                found[topic, "ros2", int(domain)] += 1
        elif topic := plain.token_topic(token):
            found[topic, "zenoh", -1] += 1
    return sorted(FoundTopic(*which, n) for which, n in found.items())
