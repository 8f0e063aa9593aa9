"""CDR messages: there and back, through two independent libraries, and with lying lengths."""

import contextlib
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.messages import cdr
from streamfeat.messages.cdr import EventArray, EventPacket, FeaturesMessage, LabelMessage, PredictionMessage

EVENTS = make_events([1, 500, 3], [7, 2, 400], [1, 0, 1], [2_000_001, 2_000_000, 3_999_999])
F32 = np.array([1.5, -2.0, np.inf], np.float32)

# odd string lengths put every later field on an alignment boundary of its own
MESSAGES = [
    EventPacket(2_000_000_001, "cam", 260, 346, 2**40, 2**60, "mono", False, bytes(range(16))),
    EventPacket(0, "", 1, 1, 0, 0, "evt3", True, b""),
    EventArray(3, "c", 480, 640, EVENTS),
    EventArray(3, "ca", 480, 640, EVENTS[:1]),
    EventArray(3, "", 480, 640, EVENTS[:0]),
    LabelMessage(5_000_000_000, "f", 100_000_000, "car", "train", "ncars/Ω.dat"),
    FeaturesMessage(1, "fr", 2**33, F32),
    PredictionMessage(1, "", "b", ["a", "b", "ccc"], F32),
]
each_message = pytest.mark.parametrize("message", MESSAGES, ids=lambda m: type(m).__name__)


def contents(message):
    """Fields in one form, whoever read them."""
    values = {name: getattr(message, name) for name in message.__slots__}
    for name, value in values.items():
        if isinstance(value, memoryview):
            values[name] = bytes(value)
        elif isinstance(value, np.ndarray):
            values[name] = value.tolist()
    return values


@each_message
def test_round_trip(message):
    assert contents(type(message).from_cdr(message.to_cdr())) == contents(message)


def assert_equal_in_ros(ros, message):
    """Compare with a message as ROS names it."""
    assert ros.header.stamp.sec * 10**9 + ros.header.stamp.nanosec == message.stamp_ns
    assert ros.header.frame_id == message.frame_id
    for name in set(message.__slots__) - {"stamp_ns", "frame_id"}:
        theirs, ours = getattr(ros, name), getattr(message, name)
        if isinstance(message, EventArray) and name == "events":
            assert [(e.x, e.y, e.polarity, e.ts.sec * 10**6 + e.ts.nanosec // 1000) for e in theirs] == [
                (e["x"], e["y"], e["p"], e["t"]) for e in ours
            ]
        elif isinstance(ours, bytes | np.ndarray):
            assert list(theirs) == list(ours)
        else:
            assert theirs == ours, name


@each_message
def test_mcap_ros2_reads_what_we_write(message):
    decoders = generate_dynamic(message.SCHEMA_NAME, message.SCHEMA)
    assert_equal_in_ros(decoders[message.SCHEMA_NAME](message.to_cdr()), message)


@each_message
def test_rosbags_reads_and_writes_the_same(message):
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(message.SCHEMA, message.SCHEMA_NAME))
    ros = store.deserialize_cdr(message.to_cdr(), message.SCHEMA_NAME)
    assert_equal_in_ros(ros, message)
    theirs = bytes(store.serialize_cdr(ros, message.SCHEMA_NAME))
    assert contents(type(message).from_cdr(theirs)) == contents(message)


@each_message
def test_cut_short_at_every_byte(message):
    data = message.to_cdr()
    for length in range(len(data)):
        with pytest.raises(InputError, match=r"^\w+: .*(too few|are left)"):
            type(message).from_cdr(data[:length])


@each_message
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_damage_is_read_or_refused(message, data):
    raw = bytearray(message.to_cdr())
    at = data.draw(st.integers(0, len(raw) - 4))
    raw[at : at + 4] = data.draw(st.binary(min_size=4, max_size=4))
    with contextlib.suppress(InputError):
        type(message).from_cdr(bytes(raw))


@given(st.data())
@settings(max_examples=300, deadline=None)
def test_a_packet_read_at_once_is_that_which_is_read_field_by_field(data):
    texts = st.text(max_size=9)
    about = data.draw(st.integers(0, 2**60)), data.draw(texts), 260, 346, data.draw(st.integers(0, 2**64 - 1))
    payload = data.draw(st.binary(max_size=20))
    raw = bytearray(EventPacket(*about, 2**60, data.draw(texts), True, payload).to_cdr())
    for _ in range(data.draw(st.integers(0, 2))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    raw = bytes(raw[: data.draw(st.integers(0, len(raw)))]) if data.draw(st.booleans()) else bytes(raw)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cdr, "_packet_fields", lambda raw: None)
        slowly = read_or_refused(raw)
    assert read_or_refused(raw) == slowly


def read_or_refused(raw):
    try:
        return contents(EventPacket.from_cdr(raw))
    except InputError as error:
        return str(error)


def test_sound_packets_are_read_at_once():
    for message in MESSAGES[:2]:
        assert cdr._packet_fields(message.to_cdr()) is not None


def test_lying_length_names_field_and_byte():
    data = bytearray(MESSAGES[0].to_cdr())
    struct.pack_into("<I", data, len(data) - 20, 2**32 - 1)
    with pytest.raises(
        InputError, match=f"'events' at byte {len(data) - 16} needs 4294967295 bytes, 16 are left"
    ):
        EventPacket.from_cdr(bytes(data))


def test_lying_count_of_events():
    data = bytearray(MESSAGES[2].to_cdr())
    at = data.index(struct.pack("<III", 480, 640, 3)) + 8
    struct.pack_into("<I", data, at, 4)
    with pytest.raises(InputError, match=f"'events' at byte {at + 4} claims 4 events"):
        EventArray.from_cdr(bytes(data))


def test_lying_count_of_labels():
    data = MESSAGES[7].to_cdr().replace(struct.pack("<II", 3, 2), struct.pack("<II", 2**32 - 1, 2))
    with pytest.raises(InputError, match=r"'labels\[\d+\]' at byte"):
        PredictionMessage.from_cdr(data)


def test_text_that_is_not_utf8():
    with pytest.raises(InputError, match="'label' at byte 32 is not UTF-8"):
        LabelMessage.from_cdr(LabelMessage(0, "", 1, "car", "", "").to_cdr().replace(b"car", b"\xff\xfe\xff"))


@pytest.mark.parametrize("encapsulation", [b"\0\0", b"\0\3", b"\0\7"])
def test_other_encapsulations(encapsulation):
    with pytest.raises(InputError, match=f"encapsulation {encapsulation.hex()} at byte 0"):
        EventPacket.from_cdr(encapsulation + MESSAGES[0].to_cdr()[2:])


@pytest.mark.parametrize("stamp_ns", [-1, 2**31 * 10**9])
def test_stamp_that_ros_cannot_hold(stamp_ns):
    with pytest.raises(InputError, match=r"less than 2\^31 s"):
        LabelMessage(stamp_ns, "", 1, "", "", "").to_cdr()


def test_duration_that_cannot_be():
    with pytest.raises(InputError, match="duration of -1 ns"):
        LabelMessage(0, "", -1, "", "", "").to_cdr()
