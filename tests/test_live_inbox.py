"""The inbox: bounded, never waits to be filled, drops the oldest and says so."""

import threading
import time

import pytest

from streamfeat.live.inbox import Announcement, Inbox, RawMessage
from streamfeat.stream.cameras import CameraLeft

SECOND = 1_000_000_000


def raw(topic="a", size=1000, arrived_ns=0, number=0):
    return RawMessage(topic, "", bytes(size), number.to_bytes(4, "little"), arrived_ns, 0)


def numbers(items):
    return [int.from_bytes(item.attachment, "little") for item in items if isinstance(item, RawMessage)]


def test_what_goes_in_comes_out_in_order_and_in_parts():
    inbox = Inbox()
    for i in range(100):
        inbox.put(raw(number=i))
    assert inbox.depth == 100
    assert numbers(inbox.take(0)) == list(range(64))
    assert numbers(inbox.take(0)) == list(range(64, 100))
    assert inbox.take(0) == []
    assert inbox.dropped == 0


def test_full_of_bytes_it_drops_the_oldest_and_tells_the_next_of_the_topic():
    inbox = Inbox(max_bytes=10 * 1512)
    for i in range(30):
        inbox.put(raw("ab"[i % 2], number=i))
    inbox.put(CameraLeft("c"))
    inbox.put(raw("a", number=30))
    taken = inbox.take(0)
    assert numbers(taken) == list(range(21, 31))
    assert taken[-2] == CameraLeft("c")
    assert [m.dropped for m in taken[:3]] == [10, 11, 0]
    assert inbox.dropped == 21
    # Who leaves is told of, however full it is.
    inbox.put(CameraLeft("a"))
    for i in range(20):
        inbox.put(raw("b", number=i))
    assert inbox.take(0)[0] == CameraLeft("a")


@pytest.mark.real_time
def test_what_has_waited_too_long_is_dropped():
    inbox, now = Inbox(max_delay_s=1000.0), time.monotonic_ns()
    for i in range(10):
        inbox.put(raw(arrived_ns=now + (i - 10) * 250 * SECOND, number=i))
    # As the newest came, those of 1,000 s before it were dropped; as they are taken, those of before now.
    assert inbox.depth == 5
    taken = inbox.take(0)
    assert numbers(taken) == [7, 8, 9]
    assert taken[0].dropped == inbox.dropped == 7


def test_long_names_take_their_room():
    inbox = Inbox(max_bytes=50_000)
    for _ in range(100):
        inbox.put(raw("x" * 1024, size=0))
    assert inbox.depth == 50_000 // 2048


def test_a_message_larger_than_all_is_not_kept():
    inbox = Inbox(max_bytes=5000)
    inbox.put(raw(size=10_000))
    assert (inbox.depth, inbox.dropped) == (0, 1)
    inbox.put(raw(size=10))
    assert inbox.take(0)[0].dropped == 1


@pytest.mark.real_time
def test_closing_wakes_who_waits_and_keeps_what_is_there():
    inbox, got = Inbox(), []
    thread = threading.Thread(target=lambda: got.append(inbox.take(30)))
    thread.start()
    inbox.close()
    thread.join(30)
    assert got == [None]
    inbox = Inbox()
    inbox.put(raw())
    inbox.close()
    inbox.put(raw())
    assert len(inbox.take(0)) == 1
    assert inbox.take(0) is None


def test_announcements_without_end_are_refused_and_counted():
    inbox = Inbox()
    for i in range(300_000):
        inbox.put(Announcement(f"made-up/{i}", here=True))
    inbox.put(raw(number=7))
    assert inbox.depth == 4097
    assert inbox.refused == 300_000 - 4096
    taken = [item for _ in range(65) for item in inbox.take(0)]
    assert numbers(taken) == [7]
    inbox.put(Announcement("made-up/last", here=True))
    assert inbox.take(0) == [Announcement("made-up/last", here=True)]


def test_topics_without_end_cost_no_memory_when_their_messages_are_dropped():
    inbox = Inbox(max_bytes=1512)
    for i in range(20_000):
        inbox.put(raw(f"made-up/{i}"))
    assert inbox.dropped == 19_999
    assert len(inbox._dropped) == 4096
