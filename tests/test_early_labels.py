"""What the intake does with labels before their camera, and with time in which it did not run."""

import itertools
import math

import pytest
import tiny
from test_live_listen import message

from streamfeat.live import intake as intake_module
from streamfeat.live.inbox import Inbox, RawMessage
from streamfeat.live.intake import Intake
from streamfeat.live.topic import MAX_TOPICS
from streamfeat.live.warnings import Warnings
from streamfeat.messages.cdr import EventPacket, LabelMessage
from streamfeat.messages.packets import Label, Packet, Watermark

SECOND_US = 1_000_000


def raw(topic, schema, payload):
    return RawMessage(topic, schema, payload, b"", 0, 0)


def label_for(camera, start_us=10_000):
    payload = LabelMessage(start_us * 1000, "", 50_000_000, "cat", "train", "").to_cdr()
    return raw(f"{camera}/label", LabelMessage.SCHEMA_NAME, payload)


def packet_of(camera, start_us=10_000, seq=0):
    payload = message(tiny.steady(start_us, start_us + 5_000, 50), seq)
    return raw(f"{camera}/events", EventPacket.SCHEMA_NAME, payload)


def items_of(messages, **options):
    inbox, warnings = Inbox(), Warnings()
    for one in messages:
        inbox.put(one)
    inbox.close()
    return list(Intake(inbox, 100_000, warnings, **options)), warnings


def test_an_early_label_waits_for_its_camera():
    items, _ = items_of([label_for("cam/a"), packet_of("cam/a")])
    assert [type(item) for item in items if item] == [Label, Packet]


def test_early_labels_are_bounded_and_the_oldest_goes():
    messages = [label_for(f"cam/{i}") for i in range(MAX_TOPICS + 1)]
    items, _ = items_of([*messages, packet_of("cam/0"), packet_of("cam/1", seq=0)])
    labels = [item.topic for item in items if isinstance(item, Label)]
    assert labels == ["cam/1/events"]


def test_a_label_far_from_its_stream_is_refused():
    items, warnings = items_of([packet_of("cam/a"), label_for("cam/a", 90_000 * SECOND_US)])
    assert not any(isinstance(item, Label) for item in items)
    assert sum(warnings.counts.values()) == 1


@pytest.mark.parametrize("stopped_s", [30.0, 3_000.0])
def test_time_in_which_the_process_was_stopped_is_no_silence(stopped_s, monkeypatch):
    """The clock leaps between two looks; so far a camera cannot have been silent."""
    inbox = Inbox(max_delay_s=math.inf)
    inbox.put(packet_of("cam/a"))
    times = itertools.chain([0.0, 0.0], itertools.repeat(stopped_s))

    class Time:
        monotonic = staticmethod(lambda: next(times))
        monotonic_ns = staticmethod(lambda: 0)

    monkeypatch.setattr(intake_module, "time", Time)
    intake = Intake(inbox, 100_000, Warnings(), silence_s=0.5)
    seen = []
    for item in intake:
        seen.append(item)
        if len(seen) == 3:
            inbox.close()
    assert any(isinstance(item, Packet) for item in seen)
    assert not any(isinstance(item, Watermark) for item in seen)
