"""Names on the network; everything ROS 2 is taken from the design document of rmw_zenoh, not from us."""

import hashlib
import json

import pytest

from streamfeat.errors import InputError
from streamfeat.live.names import (
    TYPE_HASHES,
    Attachment,
    PlainNames,
    RosNames,
    beside,
    encoding_of,
    ros_entity_token,
    schema_of_encoding,
)

EVENTS = "event_camera_msgs/msg/EventPacket"
EVENTS_HASH = "RIHS01_d6fa176260b1f37e5a40845305315e150a0f18191241eb64f407442aa29844aa"


@pytest.mark.parametrize(
    ("topic", "features"),
    [
        ("robot/cam0/events", "robot/cam0/features"),
        ("robot/left", "robot/left/features"),
        ("events", "features"),
        ("/event_camera/events", "/event_camera/features"),
        ("/events", "/features"),
    ],
)
def test_outputs_go_beside_their_source(topic, features):
    assert beside(topic, "features") == features


def test_ros_keys():
    """`<domain_id>/<fully_qualified_name>/<type_name>/<type_hash>`, type names as DDS has them."""
    names = RosNames("/event_camera/events", 2)
    key = f"2/event_camera/events/event_camera_msgs::msg::dds_::EventPacket_/{EVENTS_HASH}"
    assert names.key("/event_camera/events", EVENTS) == key
    assert "2/event_camera/events/event_camera_msgs::msg::dds_::EventPacket_/*" in names.subscriptions
    assert names.topic(key) == "/event_camera/events"
    assert names.schema(key, "zenoh/bytes") == EVENTS
    assert names.schema("0/chatter/std_msgs::msg::dds_::String_/RIHS01_df66", "") is None


def test_ros_tokens():
    """The document's own example of a publisher, with our type in place of its."""
    zid = "8b20917502ee955ac4476e0266340d5c"
    assert ros_entity_token(2, zid, 0, "NN", "talker") == f"@ros2_lv/2/{zid}/0/0/NN/%/%/talker"
    expected = (
        f"@ros2_lv/2/{zid}/0/10/MP/%/%/talker/%event_camera%events/"
        f"event_camera_msgs::msg::dds_::EventPacket_/{EVENTS_HASH}/::,10:,:,:,,"
    )
    assert ros_entity_token(2, zid, 10, "MP", "talker", "/event_camera/events", EVENTS) == expected
    names = RosNames("/event_camera/events", 2)
    assert names.token_topic(expected) == "/event_camera/events"
    chatter = (
        f"@ros2_lv/2/{zid}/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
        "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,7:,:,:,,"
    )
    assert names.token_topic(chatter) == names.token_topic("@ros2_lv/2/x") == ""


def test_attachments():
    """8 bytes number, 8 bytes nanoseconds, both little-endian, the byte 16, 16 bytes of GID."""
    data = (
        b"\x2a\0\0\0\0\0\0\0"
        + b"\x15\xcd\x5b\x07\0\0\0\0"
        + b"\x10"
        + b"\x00\x01\x02\x03\x04\x05\x06\x07" * 2
    )
    expected = Attachment(42, 123456789, bytes(range(8)) * 2)
    assert len(data) == 33
    assert Attachment.unpack(data) == expected
    assert expected.pack() == data
    for bad in (b"", data[:-1], data + b"\0", data[:16] + b"\x0f" + data[17:]):
        assert Attachment.unpack(bad) is None


def test_type_hashes_follow_rep_2016():
    """SHA-256 of the type description as JSON; type ids from type_description_interfaces/msg/FieldType."""
    ids = {"nested": 1, "uint32": 7, "int32": 6, "uint64": 9, "bool": 15, "string": 17}
    ids |= {"uint8[]": 147, "float32[]": 154, "string[]": 161}

    def fields(text):
        for line in text.strip().splitlines():
            kind, name = line.split()
            nested = kind if "/" in kind else ""
            type_id = ids["nested" if nested else kind]
            about = {"type_id": type_id, "capacity": 0, "string_capacity": 0, "nested_type_name": nested}
            yield {"name": name, "type": about}

    def description(name, text):
        return {"type_name": name, "fields": list(fields(text))}

    header = description("std_msgs/msg/Header", "builtin_interfaces/msg/Time stamp\nstring frame_id")
    time = description("builtin_interfaces/msg/Time", "int32 sec\nuint32 nanosec")
    texts = {
        EVENTS: "uint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
        "bool is_bigendian\nuint8[] events",
        "streamfeat_msgs/msg/Features": "uint64 n_events\nfloat32[] data\nbool incomplete",
        "streamfeat_msgs/msg/Prediction": "string label\nstring[] labels\nfloat32[] scores",
        "streamfeat_msgs/msg/Label": "uint64 duration_ns\nstring label\nstring split\nstring source",
    }
    assert set(TYPE_HASHES) == set(texts)
    assert TYPE_HASHES[EVENTS] == EVENTS_HASH
    for name, text in texts.items():
        whole = {
            "type_description": description(name, "std_msgs/msg/Header header\n" + text),
            "referenced_type_descriptions": [time, header],
        }
        digest = hashlib.sha256(json.dumps(whole, separators=(", ", ": ")).encode()).hexdigest()
        assert TYPE_HASHES[name] == f"RIHS01_{digest}"


def test_encodings_name_types():
    assert schema_of_encoding(encoding_of(EVENTS)) == EVENTS
    for unnamed in ("zenoh/bytes", "application/cdr", "application/octet-stream"):
        assert schema_of_encoding(unnamed) == EVENTS
    assert schema_of_encoding("image/jpeg") is None
    assert schema_of_encoding("text/plain;x") is None


@pytest.mark.parametrize(
    ("topic", "domain"), [("events", 0), ("/events/", 0), ("/events", -1), ("/events", 233)]
)
def test_ros_names_that_are_none(topic, domain):
    with pytest.raises(InputError, match="ROS 2"):
        RosNames(topic, domain)


def test_plain_tokens():
    names = PlainNames("robot/*/events")
    token = names.token("robot/cam0/events", bytes(16))
    assert token == "robot/cam0/events/@events/" + "00" * 16
    assert names.token_topic(token) == "robot/cam0/events"
    assert names.subscriptions == ["robot/*/events", "robot/*/label"]
    assert PlainNames("robot/**").subscriptions == ["robot/**"]
