"""What sequence numbers tell: gaps, duplicates, reordering, restarts, two publishers; and camera clocks."""

import random

import pytest

from streamfeat.messages.clock import CameraClock
from streamfeat.messages.delivery import Delivery, DeliveryStats, Verdict

ONE, TWO = b"1" * 16, b"2" * 16
SECOND = 1_000_000_000


def feed(numbers, gid=ONE, delivery=None):
    delivery = delivery or Delivery()
    verdicts = [delivery.see(gid, n, i) for i, n in enumerate(numbers)]
    return delivery, verdicts


def test_in_order_nothing_is_wrong():
    delivery, verdicts = feed(range(1, 100))
    assert delivery.stats == DeliveryStats(received=99)
    assert all(v.use and not v.lost and not v.broken for v in verdicts)


def test_who_joins_late_has_lost_nothing():
    assert feed([5_000, 5_001])[0].stats == DeliveryStats(received=2, unheard=4_999)
    assert feed([5_000, 5_001], gid=b"")[0].stats == DeliveryStats(received=2)


def test_what_we_dropped_first_was_heard():
    delivery = Delivery()
    assert delivery.see(ONE, 31, 0, dropped=20).lost == 20
    assert delivery.stats == DeliveryStats(received=1, dropped=20, unheard=10)


def test_a_gap_is_lost_and_breaks_decoders():
    delivery, verdicts = feed([1, 2, 6, 7])
    assert delivery.stats == DeliveryStats(received=4, lost=3)
    assert [(v.lost, v.broken) for v in verdicts] == [(0, False), (0, False), (3, True), (0, False)]


def test_a_late_packet_is_not_lost_after_all():
    delivery, verdicts = feed([1, 4, 2, 5, 3])
    assert delivery.stats == DeliveryStats(received=5, reordered=2)
    assert [v.use for v in verdicts] == [True] * 5
    assert [v.broken for v in verdicts] == [False, True, True, False, True]


def test_a_duplicate_is_not_used():
    delivery, verdicts = feed([1, 2, 2, 1, 5, 3, 3])
    assert delivery.stats == DeliveryStats(received=4, lost=1, duplicates=3, reordered=1)
    assert [v.use for v in verdicts] == [True, True, False, False, True, True, False]


@pytest.mark.parametrize("seed", range(20))
def test_counts_are_true_for_any_order(seed):
    rng = random.Random(seed)
    sent = list(range(1, 400))
    kept = [n for n in sent if rng.random() < 0.8 or n in (1, 399)]
    arriving = sorted(kept + rng.choices(kept[1:-1], k=20), key=lambda n: n + rng.random() * 8)
    arriving.remove(1)
    delivery, verdicts = feed([1, *arriving])
    stats = delivery.stats
    assert stats.received == len(set(kept)) == sum(v.use for v in verdicts)
    assert stats.lost == len(sent) - len(kept)
    assert stats.duplicates == len(arriving) + 1 - len(kept)


def test_what_we_dropped_is_not_lost_on_the_way():
    delivery = Delivery()
    delivery.see(ONE, 1, 0)
    assert delivery.see(ONE, 1, 1) == Verdict(use=False)
    assert delivery.see(TWO, 1, 1) == Verdict(use=False, foreign=True)
    verdict = delivery.see(ONE, 10, 1, dropped=5)
    assert (verdict.lost, verdict.broken) == (8, True)
    assert delivery.stats == DeliveryStats(received=2, lost=3, dropped=5, duplicates=1, foreign=1)


def test_a_publisher_that_restarts_is_followed():
    delivery, _ = feed([1, 2, 3])
    verdict = delivery.see(TWO, 3, SECOND)
    assert (verdict.use, verdict.restarted, verdict.broken, verdict.lost) == (True, True, True, 2)
    assert delivery.stats == DeliveryStats(received=4, lost=2, restarts=1)


def test_a_publisher_whose_predecessor_left_need_not_wait():
    delivery, _ = feed([1, 2, 3])
    assert not delivery.see(TWO, 1, 4).use
    delivery.announced(here=False)
    # Word that it left may overtake its last packets.
    assert delivery.see(ONE, 4, 5) == Verdict(use=True)
    delivery.announced(here=True)
    assert delivery.see(TWO, 2, 6) == Verdict(use=True, broken=True, restarted=True, anew=True)
    assert delivery.stats == DeliveryStats(received=5, foreign=1, restarts=1)


def test_word_of_leaving_may_overtake_everything():
    """However early, whoever comes next is followed at once, and two who stay do not take turns."""
    delivery = Delivery()
    delivery.announced(here=False)
    assert not delivery.see(ONE, 1, 0).anew
    for now, gid in enumerate((TWO, ONE, TWO), 1):
        delivery.announced(here=True)
        delivery.announced(here=False)
        assert delivery.see(gid, 1, now).anew
    delivery.announced(here=True)
    assert delivery.see(ONE, 1, 5).anew
    assert delivery.see(TWO, 2, 6).foreign


def test_a_publisher_that_was_cut_off_and_is_back_stays():
    delivery, _ = feed([1, 2, 3])
    delivery.announced(here=False)
    delivery.announced(here=True)
    assert delivery.see(ONE, 4, 4) == Verdict(use=True)
    assert delivery.see(TWO, 1, 5) == Verdict(use=False, foreign=True)
    assert delivery.see(TWO, 2, SECOND).anew is False


def test_two_publishers_on_one_key_the_first_stays():
    delivery = Delivery()
    used = [
        (delivery.see(ONE, n, 10 * n).use, delivery.see(TWO, 500 + n, 10 * n + 5).use) for n in range(1, 50)
    ]
    assert used == [(True, False)] * 49
    assert delivery.stats == DeliveryStats(received=49, foreign=49)
    # When the first falls silent, the second takes over; its earlier numbers are not counted as lost.
    assert delivery.see(TWO, 600, SECOND).use
    assert delivery.stats == DeliveryStats(received=50, foreign=49, restarts=1)


def test_a_publisher_without_identity_that_counts_anew():
    delivery, verdicts = feed(range(100, 200), gid=b"")
    assert not any(v.restarted for v in verdicts)
    _, verdicts = feed(range(20), gid=b"", delivery=delivery)
    assert [v.use for v in verdicts] == [False] * 3 + [True] * 17
    assert [v.restarted for v in verdicts].index(True) == 3
    assert (delivery.stats.restarts, delivery.stats.lost) == (1, 0)


def test_numbers_far_away_are_no_loss():
    delivery, _ = feed([1, 2, 2**62, -(2**62), 2**63 - 1])
    assert delivery.stats.lost == 0
    assert delivery.stats.restarts == 3


# --- clocks


def placed(times, every_ns=10_000_000):
    clock = CameraClock()
    return [clock.place(t, t + 1_000, i * every_ns) for i, t in enumerate(times)]


def test_a_sound_clock():
    assert {(p.offset_us, p.epoch, p.event) for p in placed(range(0, 10**7, 10**4))} == {(0, 0, "")}


def test_events_out_of_order_are_of_the_same_clock():
    assert {p.event for p in placed([5_000_000, 4_502_000, 5_100_000])} == {""}


@pytest.mark.parametrize("period", [1 << 31, 1 << 24])
def test_a_wrap_is_undone(period):
    places = placed([period - 30_000, period - 10_000, 10_000, 30_000])
    assert [p.event for p in places] == ["", "", "wrapped", ""]
    assert [p.offset_us for p in places] == [0, 0, period, period]
    assert {p.epoch for p in places} == {0}


def test_a_restart_is_a_new_epoch_at_once():
    places = placed([500_000_000, 500_010_000, 0, 10_000])
    assert [p.event for p in places] == ["", "", "restarted", ""]
    assert [p.epoch for p in places] == [0, 0, 1, 1]
    assert {p.offset_us for p in places} == {0}


def test_a_jump_of_hours_and_back():
    hour = 3_600_000_000
    places = placed([10_000, 20_000, 5 * hour, 5 * hour + 10_000, 40_000])
    assert [p.event for p in places] == ["", "", "jumped", "", "restarted"]
    assert [p.epoch for p in places] == [0, 0, 1, 1, 2]


def test_a_camera_that_was_silent_for_hours_has_not_jumped():
    clock, hour = CameraClock(), 3_600_000_000
    clock.place(0, 1_000, 0)
    assert clock.place(5 * hour, 5 * hour, 5 * hour * 1000).event == ""


def test_the_very_first_packets_may_come_in_another_order_too():
    delivery = Delivery()
    marks = {6: 60, 5: 50, 7: 70}
    seen = [delivery.see(b"", seq, 0, mark=marks[seq], stamp_ns=seq) for seq in (6, 5, 7, 5, 6)]
    assert [verdict.use for verdict in seen] == [True, True, True, False, False]
    assert (seen[1].late, seen[1].lost) == (True, 0)
    stats = delivery.stats
    assert (stats.reordered, stats.duplicates, stats.lost, stats.restarts) == (1, 2, 0, 0)
    assert not delivery.see(b"", 2, 0, mark=20, stamp_ns=2).use  # too old to be of the beginning
