"""What a publisher's sequence numbers say about what arrived.

Lives here: gaps, duplicates, reordering, restarts, and two publishers on one key, counted for one topic.
Not here: clocks and sockets: times are given; nor what a packet holds.
"""

from dataclasses import asdict, astuple, dataclass, fields
from typing import Any, NamedTuple

from streamfeat.errors import InputError
from streamfeat.files.json_fields import Fields
from streamfeat.messages.cdr import EventPacket

__all__ = ["Delivery", "DeliveryStats", "Verdict", "fingerprint_of"]

_REMEMBERED = 1024
"""Missing numbers that a late packet can still fill in."""
_FAR = 1 << 20
"""A step of more than this many numbers is not loss: the publisher counts from somewhere else."""
_NUMBERS = 1 << 64
"""No number is as large."""
_SILENCE_NS = 500_000_000
"""A second publisher takes over when the first has been silent for so long."""
_OLD_IN_A_ROW = 4
"""So many old numbers in a row, from a publisher without an identity, are one that started anew."""


@dataclass(slots=True)
class DeliveryStats:
    """What happened to the packets of one topic.

    Attributes:
        received: packets that arrived and were used.
        lost: numbers that never arrived.
        unheard: numbers before the first packet that reached us: its publisher, or its link to us, was there
            before we were, or late.
        dropped: packets that arrived and were dropped because nobody had time for them.
        duplicates: packets that had arrived before.
        reordered: packets that arrived after one with a higher number.
        restarts: publishers that took over from another, or started to count anew.
        foreign: packets of a second publisher on the same key, which were not used.
    """

    received: int = 0
    lost: int = 0
    unheard: int = 0
    dropped: int = 0
    duplicates: int = 0
    reordered: int = 0
    restarts: int = 0
    foreign: int = 0

    def __add__(self, other: "DeliveryStats") -> "DeliveryStats":
        """Both together."""
        return DeliveryStats(*map(sum, zip(astuple(self), astuple(other), strict=True)))


class Verdict(NamedTuple):
    """What to do with a packet.

    Attributes:
        use: False for duplicates and packets of a second publisher.
        lost: packets missing right before it.
        broken: it does not follow the one before, so a decoder cannot rely on what it remembers.
        restarted: its publisher is new or counts anew.
        anew: it is the first since every publisher had left.
        foreign: it is of a second publisher.
        late: it comes after one with a higher number.
        unheard: numbers before it, if it is the first that reached us.
    """

    use: bool
    lost: int = 0
    broken: bool = False
    restarted: bool = False
    anew: bool = False
    foreign: bool = False
    late: bool = False
    unheard: int = 0


_NEXT = Verdict(use=True)
"""Of a packet that follows the one before, as nearly all do."""


def fingerprint_of(packet: EventPacket) -> int:
    """A number that two packets share if one is a copy of the other, and hardly ever otherwise."""
    events = packet.events
    ends = bytes(events[:64]), bytes(events[-64:])
    about = (
        packet.stamp_ns,
        packet.time_base,
        packet.encoding,
        packet.height,
        packet.width,
        packet.is_bigendian,
    )
    return hash((*about, len(events), *ends))


class Delivery:
    """Follows the numbers of one topic, whoever publishes it."""

    def __init__(self) -> None:
        """Nothing has arrived."""
        self.stats = DeliveryStats()
        self._gid: bytes | None = None
        self._other: bytes | None = None
        self._heard_ns = 0
        self._is_announced = True
        self._has_come = False
        self._have_left = False
        self._next = 0
        self._began: int | None = None
        self._missing: dict[int, None] = {}
        self._old: list[int] = []
        self._marks: dict[int, int] = {}
        self._stamp_ns = 0

    def see(
        self,
        gid: bytes,
        seq: int,
        now_ns: int,
        dropped: int = 0,
        *,
        mark: int | None = None,
        stamp_ns: int = 0,
    ) -> Verdict:
        """Judge the next packet.

        Args:
            gid: of the publisher; empty when it does not say.
            seq: number of the packet.
            now_ns: when it arrived, by any clock that does not go back.
            dropped: packets of this topic that were dropped since the one before.
            mark: of its content, see `fingerprint_of`; tells a duplicate from a new beginning at once.
            stamp_ns: time in its header, with a mark.
        """
        verdict = self._judge(gid, seq, now_ns, dropped, mark, stamp_ns)
        if mark is not None and verdict.use:
            self._marks.pop(seq, None)
            self._marks[seq] = mark
            self._stamp_ns = stamp_ns
            while len(self._marks) > _REMEMBERED:
                del self._marks[next(iter(self._marks))]
        return verdict

    def see_unnumbered(self, now_ns: int, dropped: int = 0) -> Verdict:
        """Use the next packet, which has no number to be judged by."""
        self._heard_ns = now_ns
        self.stats.dropped += dropped
        self.stats.received += 1
        return Verdict(use=True, lost=dropped, broken=dropped > 0)

    def _judge(
        self, gid: bytes, seq: int, now_ns: int, dropped: int, mark: int | None, stamp_ns: int
    ) -> Verdict:
        self.stats.dropped += dropped
        is_other = self._gid is not None and gid != self._gid
        if is_other and not self._have_left and now_ns - self._heard_ns < _SILENCE_NS:
            self._other = gid
            self.stats.foreign += 1
            return Verdict(use=False, lost=dropped, foreign=True)
        if gid != self._gid or self._counts_anew(seq, mark, stamp_ns):
            return self._take_over(gid, seq, now_ns, dropped)
        self._heard_ns = now_ns
        # The last packets of those who have left may come after word of it.
        self._have_left &= not self._is_announced
        gap = seq - self._next
        if gap < 0:
            return self._see_old(seq, dropped, is_first_come=self._is_before_the_first(seq, mark))
        self._old.clear()
        self._next = seq + 1
        self.stats.received += 1
        if gap == 0 and dropped == 0:
            return _NEXT
        lost = max(gap - dropped, 0)
        self.stats.lost += lost
        for missing in range(seq - min(lost, _REMEMBERED), seq):
            self._missing[missing] = None
        while len(self._missing) > _REMEMBERED:
            del self._missing[next(iter(self._missing))]
        return Verdict(use=True, lost=lost + dropped, broken=lost + dropped > 0)

    def snapshot(self, now_ns: int) -> dict[str, Any]:
        """What is known, as JSON values; times of ours as what has passed since."""
        return {
            "stats": asdict(self.stats),
            "gid": None if self._gid is None else self._gid.hex(),
            "passed_ns": max(now_ns - self._heard_ns, 0),
            "next": self._next,
            "missing": list(self._missing),
            "stamp_ns": self._stamp_ns,
        }

    def restore(self, values: Fields, now_ns: int) -> None:
        """Go on from a snapshot; whether publishers are there is for them to say.

        Raises:
            InputError: the values are not those of a topic's numbers.
        """
        stats = values.inner("stats")
        # Packets that come late after all are taken from those that were lost.
        counts = {field.name: stats.whole(field.name, -_FAR, _NUMBERS) for field in fields(DeliveryStats)}
        self.stats = DeliveryStats(**counts)
        try:
            self._gid = bytes.fromhex(values.text("gid", 64)) if "gid" in values else None
        except ValueError:
            raise InputError(f"{values.where}: gid is not hexadecimal") from None
        self._heard_ns = now_ns - values.whole("passed_ns")
        self._next = values.whole("next", -_NUMBERS, _NUMBERS)
        self._missing = dict.fromkeys(values.wholes("missing", _REMEMBERED, -_NUMBERS, _NUMBERS))
        # A file that lacks it must not make every old number a new beginning.
        stamp_ns = values.maybe("stamp_ns", -_NUMBERS, _NUMBERS)
        self._stamp_ns = _NUMBERS if stamp_ns is None else stamp_ns

    def announced(self, *, here: bool) -> None:
        """The first publisher has come, or the last has left: whoever comes next takes over at once."""
        self._is_announced = here
        self._has_come |= here
        self._have_left |= not here

    def _counts_anew(self, seq: int, mark: int | None, stamp_ns: int) -> bool:
        if self._gid is not None and abs(seq - self._next) > _FAR:
            return self._marks.get(seq, not mark) != mark
        if self._gid or seq >= self._next or seq in self._missing:
            return False
        if mark is not None and seq in self._marks:
            return self._marks[seq] != mark
        if mark is not None and stamp_ns > self._stamp_ns:
            return True
        # Without an identity an old number is a duplicate or a new beginning; a row of them is the latter.
        self._old = [*self._old, seq] if not self._old or seq == self._old[-1] + 1 else [seq]
        return len(self._old) >= _OLD_IN_A_ROW

    def _take_over(self, gid: bytes, seq: int, now_ns: int, dropped: int) -> Verdict:
        first = self._gid is None
        # Publishers count from 1, so of one that is new here the numbers before are missing.
        known = first or not gid or gid in (self._gid, self._other) or not 0 < seq <= _REMEMBERED
        lost = 0 if known else max(seq - 1 - dropped, 0)
        anew = self._have_left and not first
        # Word that this one came and left may have overtaken all that it sent.
        self._have_left &= not self._is_announced and (first or self._has_come)
        self._has_come = False
        self._gid, self._heard_ns, self._next = gid, now_ns, seq + 1
        self._began = seq if first else None
        self._missing.clear()
        self._marks.clear()
        self._old.clear()
        self.stats.received += 1
        self.stats.lost += lost
        unheard = max(seq - 1 - dropped, 0) if first and gid else 0
        self.stats.unheard += unheard
        self.stats.restarts += not first
        return Verdict(
            use=True,
            lost=lost + dropped,
            broken=not first,
            restarted=not first,
            anew=anew,
            unheard=unheard,
        )

    def _is_before_the_first(self, seq: int, mark: int | None) -> bool:
        """Whether it should have come right before the very first packet, and has not come yet."""
        is_new = mark is not None and seq not in self._marks
        return is_new and self._began is not None and 0 < self._began - seq < _OLD_IN_A_ROW

    def _see_old(self, seq: int, dropped: int, *, is_first_come: bool) -> Verdict:
        if seq in self._missing:
            del self._missing[seq]
            self.stats.lost -= 1
        elif not is_first_come:
            self.stats.duplicates += 1
            return Verdict(use=False, lost=dropped)
        self.stats.reordered += 1
        self.stats.received += 1
        return Verdict(use=True, lost=dropped, broken=True, late=True)
