"""What takes bytes that nobody has vouched for, each as one function: messages and what comes live.

Lives here: `Target`, the checks that any result must stand, and the targets that need no file.
Not here: files (`file_targets`), mutation (`mutate`), running (`fuzz`).

A target takes bytes and gives bytes that stand for what came out; it raises InputError where the input is
refused, and anything else is a failure.
"""

import functools
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE, Events, make_events
from streamfeat.live.inbox import Announcement, Inbox, RawMessage
from streamfeat.live.intake import Intake
from streamfeat.live.names import (
    Attachment,
    Names,
    PlainNames,
    RosNames,
    beside,
    encoding_of,
    gid_of,
    ros_entity_token,
)
from streamfeat.live.warnings import Warnings
from streamfeat.messages.cdr import EventArray, EventPacket, FeaturesMessage, LabelMessage, PredictionMessage
from streamfeat.messages.codecs import PAYLOAD_ENCODINGS, encode, make_decoder
from streamfeat.messages.packets import EVENT_SCHEMAS, Packet
from streamfeat.stream.cameras import Cameras
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.session import Session

__all__ = [
    "STREAM_TARGETS",
    "Target",
    "check_events",
    "check_line",
    "feed_engine",
    "some_events",
    "tiny_encoder",
]

_LONGEST_LINE = 1_000


@dataclass(frozen=True)
class Target:
    """One decoder.

    Attributes:
        name: as in the table.
        seeds: inputs that are whole.
        run: the decoder; gives bytes that stand for the result.
        runs: executions at scale one.
        mend: makes sums right after a change; applied to most inputs.
        words: of the format.
        most: bytes of an input.
        memory: bytes that the process may grow by, at most.
        kernels: whether compiled kernels see the input.
    """

    name: str
    seeds: Callable[[], Sequence[bytes]]
    run: Callable[[bytes], bytes]
    runs: int
    mend: Callable[[bytes], bytes] = bytes
    words: Sequence[bytes] = field(default=())
    most: int = 4096
    memory: int = 64 << 20
    kernels: bool = False


@functools.cache
def tiny_encoder() -> Encoder:
    """A small encoder of random filters: patches of 4x4 in two bins of 50 ms."""
    geometry = Geometry(patch=4, stride=4, n_bins=2, bin_us=50_000, max_count=2)
    return random_encoder(0, geometry, 5, encoding="split", threshold=0.3)


@functools.cache
def _engine() -> Engine:
    return Engine(tiny_encoder(), (12, 16))


def some_events(n: int = 40, seed: int = 0, *, width: int = 16, height: int = 12) -> Events:
    """Sorted random events of 80 ms."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, 80_000, n))
    return make_events(rng.integers(0, width, n), rng.integers(0, height, n), rng.integers(0, 2, n), t)


def check_events(events: Events) -> bytes:
    """Events are what every part relies on, and an engine of a small sensor takes them; gives their sums.

    The engine takes every eighth: it needs longer than most decoders.
    """
    assert events.dtype == EVENT_DTYPE
    assert events.ndim == 1
    if not len(events):
        return b""
    assert not (events["p"] >> 1).any()
    # Field by field: nobody sets the bytes between p and t.
    what = zlib.crc32(events["t"].tobytes())
    for name in "xyp":
        what = zlib.crc32(events[name].tobytes(), what)
    return struct.pack("<I", what) + (b"" if what % 8 else feed_engine(events))


def feed_engine(events: Events) -> bytes:
    """What an engine makes of them."""
    engine = _engine()
    engine.restart(0)
    before = engine.n_events
    engine.feed(events)
    features = engine.features()
    assert np.isfinite(features).all()
    return struct.pack("<Iq", zlib.crc32(features), engine.n_events - before)


def check_line(error: InputError | str) -> None:
    """What is said is one line that a terminal can show."""
    text = str(error)
    assert text.isprintable(), f"not one printable line: {text[:200]!r}"
    assert 0 < len(text) <= _LONGEST_LINE, f"a line of {len(text)} characters"


# --- payloads: (u8 what to do first, u16 length, payload) again and again

_BASES = (0, 1_700_000_000_123_456_789, (1 << 64) - 1, 999)
_HEAD = struct.Struct("<BH")


def _payload(encoding: str, data: bytes) -> bytes:
    decoder, seen, at = make_decoder(encoding), b"", 0
    refused: InputError | None = None
    while at + _HEAD.size <= len(data):
        flags, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        if flags & 1:
            decoder.resync()
        try:
            events = decoder.decode(memoryview(data)[at : at + length], _BASES[flags >> 1 & 3])
        except InputError as error:
            check_line(error)
            refused = error
            seen += b"-"
        else:
            seen += check_events(events)
        at += length
    if refused:
        raise refused
    return seen


def _payload_seeds(encoding: str) -> list[bytes]:
    parts = [encode(some_events(n, n), encoding)[0] for n in (0, 1, 30)]
    if encoding == "evt3":  # our own writer makes no vectors
        parts.append(struct.pack("<8H", 0x8001, 0x6002, 0x0003, 0x3804, 0x4FFF, 0x50FF, 0x4801, 0x2805))
    if encoding == "libcaer_cmp":
        parts.append(struct.pack("<7H", 0x0001, 0x1002, 0x2003, 0x4804, 0x50FF, 0x5081, 0x3005))
    packed = [_HEAD.pack(flags, len(part)) + part for part in parts for flags in (0, 1, 2, 4)]
    return [*packed, b"".join(packed[-6:])]


# --- CDR

_MESSAGES: tuple[Any, ...] = (EventPacket, EventArray, LabelMessage, FeaturesMessage, PredictionMessage)
_TEXT_WORDS = (b"mono", b"evt3", b"libcaer", b"libcaer_cmp", b"\0", b"\xff\xff\xff\xff", b"\0\1\0\0")


def _cdr(kind: Any, data: bytes) -> bytes:
    message = kind.from_cdr(data)
    seen = check_events(message.events) if kind is EventArray else b""
    try:
        again = message.to_cdr()
    except InputError as error:  # such as a stamp before 1970, which can be read and is not written
        check_line(error)
        return seen + b"-"
    assert kind.from_cdr(again).to_cdr() == again
    return seen + again


def _cdr_seeds(kind: Any) -> list[bytes]:
    about = (1_234_567_890, "camera")
    if kind is EventPacket:
        return [_event_packet(encoding) for encoding in PAYLOAD_ENCODINGS]
    if kind is EventArray:
        return [EventArray(*about, 12, 16, some_events(n)).to_cdr() for n in (0, 1, 2, 20)]
    if kind is LabelMessage:
        return [LabelMessage(*about, 10**9, "cat", "train", "a/b.dat").to_cdr()]
    values = np.arange(5, dtype=np.float32)
    if kind is FeaturesMessage:
        return [FeaturesMessage(*about, 7, values, True).to_cdr()]
    return [PredictionMessage(*about, "cat", ["cat", "dog"], values[:2]).to_cdr()]


def _event_packet(encoding: str, seq: int = 1) -> bytes:
    payload, base_ns = encode(some_events(20, seq), encoding)
    return EventPacket(5_000, "camera", 12, 16, seq, base_ns, encoding, False, payload).to_cdr()


# --- live: (u8 schema and topic, u8 attachment, u16 length, payload) again and again, up to sessions

_LIVE_HEAD = struct.Struct("<BBH")
_SCHEMAS = (*EVENT_SCHEMAS, LabelMessage.SCHEMA_NAME, "")
_TOPICS = ("a/events", "events", "b", "/c/events", "a", "a/label", "", "/")


def _live(data: bytes) -> bytes:
    inbox, warnings = Inbox(), Warnings()
    for message in _messages(data):
        inbox.put(message)
    inbox.close()
    encoder = tiny_encoder()
    cameras = Cameras(lambda topic: Session(encoder, EmitPolicy.parse("20ms"), topic=topic), limit=4)
    seen = []
    emissions = 0
    for item in Intake(inbox, encoder.geometry.window_us, warnings):
        if isinstance(item, Packet):
            seen.append(check_events(item.events))
            # An engine of any sensor is the affair of whoever chose the model; here the sensors are small.
            if item.resolution[0] * item.resolution[1] > 1 << 14:
                continue
        if item is not None:
            for emission in cameras.process(item):
                assert np.isfinite(emission.features).all()
                emissions += 1
    emissions += sum(1 for _ in cameras.finish())
    return repr((seen, emissions, sorted(warnings.counts.items()), cameras.stats())).encode()


def _messages(data: bytes) -> Iterator[RawMessage | Announcement]:
    at, now_ns = 0, 1_000_000_000
    while at + _LIVE_HEAD.size <= len(data):
        what, extra, length = _LIVE_HEAD.unpack_from(data, at)
        at += _LIVE_HEAD.size
        schema, topic = _SCHEMAS[what & 3], _TOPICS[what >> 2 & 7]
        attachment = data[at : at + (33 if extra & 1 else extra >> 1 & 63)]
        at += len(attachment)
        now_ns += (what >> 5) * 100_000_000
        if extra == 0xFF:
            yield Announcement(topic, here=bool(what & 1))
            continue
        yield RawMessage(topic, schema, data[at : at + length], attachment, now_ns, now_ns)
        at += length


def _live_seeds() -> list[bytes]:
    label = LabelMessage(0, "", 50_000_000, "cat", "", "").to_cdr()
    array = EventArray(0, "", 12, 16, some_events()).to_cdr()
    gids = (bytes(range(16)), bytes(16))

    def put(payload: bytes, schema: int, topic: int, seq: int = 0, gid: bytes | None = None) -> bytes:
        attachment = Attachment(seq, 5, gid).pack() if gid else b""
        head = _LIVE_HEAD.pack(schema | topic << 2 | 1 << 5, bool(gid), len(payload))
        return head + attachment + payload

    packets = [_event_packet(encoding, seq) for seq, encoding in enumerate(PAYLOAD_ENCODINGS)]
    stream = [put(packet, 0, 0, seq + 1, gids[0]) for seq, packet in enumerate(packets)]
    return [
        b"".join(stream),
        b"".join([put(label, 2, 5), *stream, put(packets[0], 0, 0, 1, gids[1])]),
        put(array, 1, 1, 3, gids[1]) + put(label, 2, 5) + _LIVE_HEAD.pack(1, 0xFF, 0),
        b"".join(put(packet, 0, 2) for packet in packets) + _LIVE_HEAD.pack(8, 0xFF, 0),
    ]


# --- names: key, encoding and attachment, apart by zero bytes


def _names(data: bytes) -> bytes:
    attachment = Attachment.unpack(data[-33:])
    if attachment:
        assert Attachment.unpack(attachment.pack()) == attachment
    texts = [*data.decode("utf-8", "replace").split("\0"), "", ""]
    key, encoding = texts[:2]
    seen: list[object] = [beside(key, "features"), gid_of(key), attachment]
    kinds: list[Names] = [PlainNames(key)]
    try:
        kinds.append(RosNames(key))
    except InputError as error:
        check_line(error)
    for names in (*kinds, RosNames("/a/events")):
        seen += [names.subscriptions, names.tokens, names.schema(key, encoding), names.topic(key)]
        seen.append(names.token_topic(key))
    return repr(seen).encode()


def _names_seeds() -> list[bytes]:
    ros = RosNames("/camera/events")
    token = ros_entity_token(0, "ab12", 3, "MP", "node", "/camera/events", EventPacket.SCHEMA_NAME)
    keys = [ros.key("/camera/events", EventPacket.SCHEMA_NAME), token, "/camera/events", "camera/events"]
    keys.append(PlainNames("a").token("camera/events", bytes(16)))
    codes = [encoding_of(EventPacket.SCHEMA_NAME), "zenoh/bytes", "application/cdr"]
    seeds = [f"{key}\0{code}\0".encode() for key in keys for code in codes]
    return [*seeds, Attachment(5, 6, bytes(range(16))).pack()]


_NAME_WORDS = (b"/", b"@events", b"%", b"**", b"*", b";", b"\0", b"events", b"::msg::dds_::", b"@ros2_lv")

STREAM_TARGETS = [
    *(
        Target(
            f"payload {encoding}",
            functools.partial(_payload_seeds, encoding),
            functools.partial(_payload, encoding),
            170_000,
            kernels=True,
        )
        for encoding in PAYLOAD_ENCODINGS
    ),
    *(
        Target(
            f"CDR {kind.SCHEMA_NAME.rpartition('/')[2]}",
            functools.partial(_cdr_seeds, kind),
            functools.partial(_cdr, kind),
            40_000,
            words=_TEXT_WORDS,
            kernels=kind is EventArray,
        )
        for kind in _MESSAGES
    ),
    Target("live intake", _live_seeds, _live, 6_000, words=_TEXT_WORDS, kernels=True),
    Target("names and attachments", _names_seeds, _names, 60_000, words=_NAME_WORDS, most=512),
]
