"""Publishing on a zenoh network: events as a camera does, and features and predictions of them.

Lives here: numbered messages with attachments, announced by liveliness tokens; the sinks that write them.
Not here: names and attachments (`names`), what is published (`stream`, `recordings`).
"""

import os
import time
from collections.abc import Callable, Sequence

import zenoh
import zenoh.ext

from streamfeat.errors import InputError
from streamfeat.live.names import (
    OUTPUTS,
    Attachment,
    Names,
    PlainNames,
    RosNames,
    beside,
    encoding_of,
    gid_of,
    ros_entity_token,
)
from streamfeat.live.network import first_line
from streamfeat.messages.cdr import EventPacket, FeaturesMessage, LabelMessage, PredictionMessage
from streamfeat.stream.cameras import MAX_CAMERAS
from streamfeat.stream.emission import Emission

__all__ = ["CameraSink", "MessagePublisher", "OutputSink"]

_CACHED = 256
"""Messages that a reliable publisher keeps for subscribers that missed them."""
_HEARTBEAT_S = 0.1
_FIRST_ENTITY = 10


class MessagePublisher:
    """Publishes messages of one type on one topic, numbered from 1.

    Args:
        session: open; not closed here.
        names: plain or ROS 2.
        topic: to publish on.
        schema: type of the messages.
        block: wait when the network is slower than this program; otherwise zenoh drops messages, and
            subscribers see the gap.
        reliable: keep messages for subscribers that missed them, see `Subscription`.
        entity: number of this publisher within the session, for ROS 2.
    """

    def __init__(
        self,
        session: zenoh.Session,
        names: Names,
        topic: str,
        schema: str,
        *,
        block: bool = False,
        reliable: bool = False,
        entity: int = _FIRST_ENTITY,
    ) -> None:
        """Declare it.

        Raises:
            InputError: zenoh refuses the key.
        """
        key = names.key(topic, schema)
        self.seq = 0
        self._open: list[object] = []
        self._publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher
        congestion = zenoh.CongestionControl.BLOCK if block else zenoh.CongestionControl.DROP
        try:
            if reliable:
                self._publisher = zenoh.ext.declare_advanced_publisher(
                    session,
                    key,
                    encoding=encoding_of(schema),
                    congestion_control=congestion,
                    express=True,
                    cache=zenoh.ext.CacheConfig(_CACHED),
                    sample_miss_detection=zenoh.ext.MissDetectionConfig(
                        heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None
                    ),
                    publisher_detection=True,
                )
            else:
                self._publisher = session.declare_publisher(
                    key, encoding=encoding_of(schema), congestion_control=congestion, express=True
                )
            self._open.append(self._publisher)
            tokens, self.gid = _identity(session, names, topic, schema, entity)
            self._open += [session.liveliness().declare_token(token) for token in tokens]
        except zenoh.ZError as error:
            self.close()
            raise InputError(f"{key!r} cannot be published on: {first_line(error)}") from None

    def put(self, data: bytes) -> None:
        """Publish one message."""
        self.seq += 1
        attachment = Attachment(self.seq, time.time_ns(), self.gid).pack()
        self._publisher.put(data, attachment=attachment)

    def close(self) -> None:
        """Undeclare it; a second call does nothing."""
        for declared in reversed(self._open):
            declared.undeclare()  # type: ignore[attr-defined]
        self._open.clear()


def _identity(
    session: zenoh.Session, names: Names, topic: str, schema: str, entity: int
) -> tuple[list[str], bytes]:
    """Tokens of a publisher, and the 16 bytes that name it."""
    if isinstance(names, RosNames):
        zid = str(session.zid())
        about = "MP", "streamfeat", topic, schema
        token = ros_entity_token(names.domain, zid, entity, *about, has_hashes=names.has_hashes)
        return [ros_entity_token(names.domain, zid, 0, "NN", "streamfeat"), token], gid_of(token)
    gid = os.urandom(16)
    if isinstance(names, PlainNames) and schema == EventPacket.SCHEMA_NAME:
        return [names.token(topic, gid)], gid
    return [], gid


class OutputSink:
    """Publishes features and predictions beside the topics they come from.

    Args:
        session: open; not closed here.
        names: plain or ROS 2.
        on_published: given `source_ns` of the emission and the time now, both since 1970.
        on_refusal: told topic and error where an emission cannot be published; the others are.
    """

    def __init__(
        self,
        session: zenoh.Session,
        names: Names,
        on_published: Callable[[int, int], None] = lambda source_ns, now_ns: None,
        on_refusal: Callable[[str, str], None] = lambda topic, error: None,
    ) -> None:
        """Nothing is declared before there is something to publish."""
        self._on_refusal = on_refusal
        self._session = session
        self._names = names
        self._on_published = on_published
        self._publishers: dict[tuple[str, str], MessagePublisher] = {}
        self._entity = _FIRST_ENTITY

    def write(self, emissions: Sequence[Emission]) -> None:
        """Publish features for each emission, and a prediction where there is one."""
        for e in emissions:
            try:
                self._publish(e)
            except InputError as error:
                self._on_refusal(e.topic, str(error))

    def _publish(self, e: Emission) -> None:
        stamp_ns = e.t_us * 1000
        features = FeaturesMessage(stamp_ns, "", e.n_events, e.features, e.incomplete)
        self._publisher(e.topic, "features").put(features.to_cdr())
        if e.prediction is not None:
            prediction = PredictionMessage(stamp_ns, "", e.prediction, e.labels, e.scores)
            self._publisher(e.topic, "prediction").put(prediction.to_cdr())
        self._on_published(e.source_ns, time.time_ns())

    def close(self, *, failed: bool) -> None:
        """Undeclare everything."""
        for publisher in self._publishers.values():
            publisher.close()
        self._publishers.clear()

    def _publisher(self, topic: str, kind: str) -> MessagePublisher:
        which = topic, kind
        if which not in self._publishers:
            if len(self._publishers) >= 2 * len(OUTPUTS) * MAX_CAMERAS:
                self._publishers.pop(next(iter(self._publishers))).close()
            self._entity += 1
            self._publishers[which] = MessagePublisher(
                self._session, self._names, beside(topic, kind), OUTPUTS[kind], entity=self._entity
            )
        return self._publishers[which]


class CameraSink:
    """Publishes messages of events and labels as a camera would.

    Args:
        session: open; not closed here.
        names: plain or ROS 2.
        topic: of the events; labels go beside it.
        block: see `MessagePublisher`.
        reliable: see `MessagePublisher`.
    """

    def __init__(
        self, session: zenoh.Session, names: Names, topic: str, *, block: bool = False, reliable: bool = False
    ) -> None:
        """Declare the events; labels when there are some."""
        self._session, self._names, self._topic = session, names, topic
        self._block, self._reliable = block, reliable
        self.events = self._declare(topic, EventPacket.SCHEMA_NAME, _FIRST_ENTITY)
        self._labels: MessagePublisher | None = None
        self.n_bytes = 0

    def write(self, messages: Sequence[EventPacket | LabelMessage]) -> None:
        """Publish them in order."""
        for message in messages:
            data = message.to_cdr()
            self.n_bytes += len(data)
            if isinstance(message, EventPacket):
                self.events.put(data)
                continue
            if self._labels is None:
                name = beside(self._topic, "label")
                self._labels = self._declare(name, LabelMessage.SCHEMA_NAME, _FIRST_ENTITY + 1)
            self._labels.put(data)

    def _declare(self, topic: str, schema: str, entity: int) -> MessagePublisher:
        return MessagePublisher(
            self._session,
            self._names,
            topic,
            schema,
            block=self._block,
            reliable=self._reliable,
            entity=entity,
        )

    def close(self, *, failed: bool) -> None:
        """Undeclare them."""
        self.events.close()
        if self._labels:
            self._labels.close()
