"""Names on a zenoh network, plain or of ROS 2, and the attachment of each message.

Lives here: key expressions, liveliness tokens, type names and hashes, attachments, encodings.
Not here: sessions and messages in flight (`network`, `publisher`).

ROS 2 names follow the design document of rmw_zenoh: topics are `DOMAIN/NAME/TYPE/HASH`, entities announce
themselves by liveliness tokens `@ros2_lv/DOMAIN/ZID/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NODE_NAME/TOPIC/TYPE/
HASH/QOS`, and every message carries 33 bytes: its number, its time and its publisher. Plain zenoh keys are
used as they are. Their messages carry the same CDR and the same 33 bytes, the zenoh encoding is
`application/cdr;TYPE`, and a publisher of `KEY` announces itself as `KEY/@events/ID`.
"""

import struct
from dataclasses import dataclass
from hashlib import blake2b
from typing import NamedTuple, Protocol

from streamfeat.errors import InputError
from streamfeat.messages.cdr import EventPacket, FeaturesMessage, LabelMessage, PredictionMessage
from streamfeat.messages.packets import EVENT_SCHEMAS

__all__ = [
    "ATTACHMENT_BYTES",
    "OUTPUTS",
    "ROS_DISTROS",
    "TYPE_HASHES",
    "Attachment",
    "Names",
    "PlainNames",
    "RosNames",
    "beside",
    "encoding_of",
    "ros_entity_token",
    "schema_of_encoding",
]

OUTPUTS = {"features": FeaturesMessage.SCHEMA_NAME, "prediction": PredictionMessage.SCHEMA_NAME}
"""What is published beside a source, and its type."""

TYPE_HASHES = {
    EventPacket.SCHEMA_NAME: "RIHS01_d6fa176260b1f37e5a40845305315e150a0f18191241eb64f407442aa29844aa",
    FeaturesMessage.SCHEMA_NAME: "RIHS01_2cd533e00e97a59b7a9ffc394166f4b3cbaa81f5e336f67bd4e4112f9c7971f5",
    PredictionMessage.SCHEMA_NAME: "RIHS01_e2fc9e5ff1aef0c89977eb74fd25f67743b9e84bc3acdad0dab4dcf2b0bc564d",
    LabelMessage.SCHEMA_NAME: "RIHS01_8628ace0abeb810e80b9decde2d5e99da336c4a6787679217f24d336bd884632",
}
"""The ROS 2 type hash of each message (REP-2016): SHA-256 of its type description."""
_NO_HASH = "TypeHashNotSupported"
"""What rmw_zenoh writes in place of a hash where ROS 2 has none: in Humble, and for types without one."""

ROS_DISTROS = {"humble": False, "iron": True, "jazzy": True, "kilted": True, "lyrical": True, "rolling": True}
"""Distributions of ROS 2, and whether their keys have type hashes."""

_CDR = "application/cdr"
_UNNAMED = {"zenoh/bytes", "application/octet-stream", _CDR, ""}
_TOKEN = "@events"
_ROS_TOKEN = "@ros2_lv"
_QOS = "::,10:,:,:,,"  # the defaults of rmw_zenoh, with a depth of 10
_ATTACHMENT = struct.Struct("<qqB16s")
ATTACHMENT_BYTES = _ATTACHMENT.size


class Attachment(NamedTuple):
    """What goes with each message: 33 bytes, little-endian.

    Attributes:
        seq: int64, counts the messages of a publisher from 1.
        source_ns: int64, when it was published, nanoseconds since 1970.
        gid: 16 bytes, the publisher; a byte before them says that there are 16.
    """

    seq: int
    source_ns: int
    gid: bytes

    def pack(self) -> bytes:
        """The 33 bytes."""
        return _ATTACHMENT.pack(self.seq, self.source_ns, len(self.gid), self.gid)

    @classmethod
    def unpack(cls, data: bytes) -> "Attachment | None":
        """Read it; None when these bytes are something else."""
        if len(data) != ATTACHMENT_BYTES or data[16] != 16:
            return None
        seq, source_ns, _, gid = _ATTACHMENT.unpack(data)
        return cls(seq, source_ns, gid)


def encoding_of(schema: str) -> str:
    """The zenoh encoding of CDR messages of a type."""
    return f"{_CDR};{schema}"


def schema_of_encoding(encoding: str) -> str | None:
    """The type that a zenoh encoding names, packets of events if it names none, or None if it is no CDR."""
    if encoding in _UNNAMED:
        return EventPacket.SCHEMA_NAME
    kind, _, schema = encoding.partition(";")
    return schema if kind == _CDR else None


def beside(topic: str, kind: str) -> str:
    """The name for an output of a topic: `a/events` has `a/features`, and `a/left` has `a/left/features`."""
    parent, _, last = topic.rpartition("/")
    return (
        f"{parent}/{kind}".removeprefix("" if topic.startswith("/") else "/")
        if last == "events"
        else (f"{topic}/{kind}")
    )


class Names(Protocol):
    """The names of topics on the network."""

    @property
    def expression(self) -> str:
        """The topics, perhaps with wildcards."""

    @property
    def subscriptions(self) -> list[str]:
        """Key expressions of the events, and of labels for them."""

    @property
    def tokens(self) -> str:
        """Key expression of the liveliness tokens of event publishers."""

    def schema(self, key: str, encoding: str) -> str | None:
        """The type of a message, or None if it is no type that is read here."""

    def topic(self, key: str) -> str:
        """The topic of a message, as it is shown."""

    def token_topic(self, token: str) -> str:
        """The topic of a publisher's token."""

    def key(self, topic: str, schema: str) -> str:
        """The key to publish on."""

    def only(self, topic: str) -> "Names":
        """The names of one topic alone."""


@dataclass(frozen=True, slots=True)
class PlainNames:
    """Plain zenoh: a topic is a key."""

    expression: str

    def __post_init__(self) -> None:
        """Check the argument.

        Raises:
            InputError: it begins or ends with a slash, or is empty, as no key is.
        """
        bare = self.expression.strip("/")
        if not bare:
            raise InputError(f"{self.expression!r} is no zenoh key; give one such as robot/cam0/events")
        if bare != self.expression:
            raise InputError(
                f"{self.expression!r} is no zenoh key, for those have no slash at either end; give {bare!r}, "
                "or --ros2 for a ROS 2 topic"
            )

    @property
    def subscriptions(self) -> list[str]:
        """See `Names`."""
        labels = beside(self.expression, "label")
        return [self.expression] if self.expression.endswith("**") else [self.expression, labels]

    @property
    def tokens(self) -> str:
        """See `Names`."""
        return f"{self.expression}/{_TOKEN}/*"

    def schema(self, key: str, encoding: str) -> str | None:
        """See `Names`."""
        return schema_of_encoding(encoding)

    def topic(self, key: str) -> str:
        """See `Names`."""
        return key

    def token(self, topic: str, gid: bytes) -> str:
        """The token of a publisher of events."""
        return f"{topic}/{_TOKEN}/{gid.hex()}"

    def token_topic(self, token: str) -> str:
        """See `Names`."""
        return token.rpartition(f"/{_TOKEN}/")[0]

    def key(self, topic: str, schema: str) -> str:
        """See `Names`."""
        return topic

    def only(self, topic: str) -> "PlainNames":
        """See `Names`."""
        return PlainNames(topic)


@dataclass(frozen=True, slots=True)
class RosNames:
    """ROS 2 over rmw_zenoh: a topic has a leading slash; `expression` may hold wildcards.

    Subscriptions hear keys with any hash. Keys to publish on have none where `has_hashes` is false: in
    Humble, whose subscribers hear no other.
    """

    expression: str
    domain: int = 0
    has_hashes: bool = True

    def __post_init__(self) -> None:
        """Check the arguments.

        Raises:
            InputError: the topic is not fully qualified, or the domain is out of range.
        """
        if not self.expression.startswith("/") or self.expression.endswith("/"):
            raise InputError(f"ROS 2 topic {self.expression!r}: give its full name, such as /camera/events")
        if not 0 <= self.domain <= 232:
            raise InputError(f"ROS 2 domain {self.domain}: it is 0 to 232")

    @property
    def subscriptions(self) -> list[str]:
        """See `Names`."""
        labels = beside(self.expression, "label")
        return [
            *(f"{self._base(self.expression, schema)}/*" for schema in EVENT_SCHEMAS),
            f"{self._base(labels, LabelMessage.SCHEMA_NAME)}/*",
        ]

    @property
    def tokens(self) -> str:
        """See `Names`."""
        # A topic is one chunk of a token, so wildcards within it cannot be told to zenoh.
        return f"{_ROS_TOKEN}/{self.domain}/*/*/*/MP/*/*/*/*/*/*/*"

    def schema(self, key: str, encoding: str) -> str | None:
        """See `Names`."""
        return schema_of_ros(key.rpartition("/")[0].rpartition("/")[2])

    def topic(self, key: str) -> str:
        """See `Names`."""
        return "/" + "/".join(key.split("/")[1:-2])

    def token_topic(self, token: str) -> str:
        """See `Names`; '' for a publisher of anything but events."""
        chunks = token.split("/")
        if len(chunks) != 13 or schema_of_ros(chunks[10]) not in EVENT_SCHEMAS:
            return ""
        return chunks[9].replace("%", "/")

    def key(self, topic: str, schema: str) -> str:
        """See `Names`."""
        return f"{self._base(topic, schema)}/{type_hash(schema, self.has_hashes)}"

    def only(self, topic: str) -> "RosNames":
        """See `Names`."""
        return RosNames(topic, self.domain, self.has_hashes)

    def _base(self, topic: str, schema: str) -> str:
        return f"{self.domain}{topic}/{ros_type(schema)}"


def ros_type(schema: str) -> str:
    """`package/msg/Type` as DDS has it."""
    package, _, name = schema.split("/")
    return f"{package}::msg::dds_::{name}_"


def schema_of_ros(name: str) -> str | None:
    """The schema of a DDS type name; None for a type that is not read here."""
    known = {ros_type(schema): schema for schema in (*EVENT_SCHEMAS, LabelMessage.SCHEMA_NAME)}
    return known.get(name)


def type_hash(schema: str, has_hashes: bool) -> str:
    """The last part of a ROS 2 key."""
    return TYPE_HASHES.get(schema, _NO_HASH) if has_hashes else _NO_HASH


def ros_entity_token(
    domain: int,
    zid: str,
    entity: int,
    kind: str,
    node: str,
    topic: str = "",
    schema: str = "",
    *,
    has_hashes: bool = True,
) -> str:
    """The liveliness token of a node (`NN`), a publisher (`MP`) or a subscription (`MS`)."""
    token = f"{_ROS_TOKEN}/{domain}/{zid}/0/{entity}/{kind}/%/%/{node}"
    if not topic:
        return token
    about = ros_type(schema), type_hash(schema, has_hashes), _QOS
    return "/".join((token, topic.replace("/", "%"), *about))


def gid_of(token: str) -> bytes:
    """16 bytes that identify the publisher with this token."""
    return blake2b(token.encode(), digest_size=16).digest()
