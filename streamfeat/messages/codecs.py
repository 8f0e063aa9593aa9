"""Packet payloads to events and back, for the four encodings of event_camera_msgs.

Lives here: `mono`, `libcaer`, `libcaer_cmp` and `evt3`, bytes in and arrays out.
Not here: how events become 16-bit words (`words`); messages around the payload, files, and the resolution:
events outside it are decoded like any other, and counted where they are fed.

Payloads are hostile until proven otherwise. What a payload can make us allocate is bounded by 96 times its
length (a 16-bit word holds at most 12 events of 16 bytes), twice that where the room is kept for packets to
come, and by `MAX_PACKET_EVENTS` events.
"""

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE, Events, Resolution
from streamfeat.kernels.decode import (
    LIBCAER_WRAP_US,
    decode_evt3,
    decode_libcaer,
    decode_libcaer_cmp,
    decode_mono,
    time_span,
)
from streamfeat.messages.words import EVT3_WRAP_US, Words, check_sorted, encode_evt3, libcaer_cmp_words

__all__ = [
    "EVT3_WRAP_US",
    "MAX_PACKET_EVENTS",
    "PAYLOAD_ENCODINGS",
    "Decoder",
    "Evt3Decoder",
    "encode",
    "make_decoder",
]

MAX_PACKET_EVENTS = 1 << 24
"""No payload may hold more events than this (268 MB of them); real packets hold 100 to 100,000."""

_KEPT_EVENTS = 1 << 19
"""A decoder of words keeps room for so many events, 8 MB, of which memory is taken for those that came."""

EVERY_PIXEL: Resolution = (1 << 16, 1 << 16)
"""A sensor that no coordinate lies outside of."""


_LIBCAER = np.dtype([("data", "<u4"), ("us", "<u4")])


class Decoder(Protocol):
    """The decoder of one topic; it may carry state from packet to packet.

    Attributes:
        n_inside: how many events of the latest payload are on the sensor.
        span: `(2,)` int64, their earliest and latest time; as it was where there are none.
    """

    n_inside: int
    span: NDArray[np.int64]

    def decode(
        self, payload: bytes | memoryview, time_base_ns: int, resolution: Resolution = EVERY_PIXEL
    ) -> Events:
        """Decode one payload.

        Args:
            payload: the bytes of the packet, not changed.
            time_base_ns: `time_base` of the packet, nanoseconds.
            resolution: of the sensor, for the span of times; events outside of it are decoded, too.

        Returns:
            `(n,)` array of `EVENT_DTYPE`, stream time in microseconds, in stored order.

        Raises:
            InputError: the payload cannot be what its encoding says; no state has changed.
        """

    def resync(self) -> None:
        """Forget what packets before a gap said about the ones after it."""

    def snapshot(self) -> list[int]:
        """The state that is carried on; empty where packets stand alone."""

    def restore(self, state: list[int]) -> None:
        """Go on from a snapshot.

        Args:
            state: numbers from 0 to 2^62.

        Raises:
            InputError: there are more or fewer than this decoder has.
        """


class _Stateful:
    """What all decoders share: a limit, and what they carry on from packet to packet, which may be nothing.

    Args:
        max_events: packets of more events are refused.
    """

    _n_state = 0

    def __init__(self, max_events: int = MAX_PACKET_EVENTS) -> None:
        """Start with nothing seen."""
        self._max_events = max_events
        self.n_inside, self.span = 0, np.zeros(2, np.int64)
        self._state = np.zeros(self._n_state, np.int64)

    def resync(self) -> None:
        """See `Decoder.resync`: a packet says by itself where it begins."""

    def snapshot(self) -> list[int]:
        """See `Decoder.snapshot`."""
        return [int(value) for value in self._state]

    def restore(self, state: list[int]) -> None:
        """See `Decoder.restore`."""
        if len(state) != len(self._state):
            raise InputError(f"the snapshot of a decoder holds {len(state)} numbers, not {len(self._state)}")
        self._state[:] = state


class _OfWords(_Stateful):
    """What the decoders of 16-bit words share: no length tells how many events will come.

    Short payloads are decoded into room that is kept, and their events copied: counting them first is slower.
    """

    _encoding: str
    _single: int  # the type of word that is one event
    _vectors: dict[int, int]  # types that are one event for each set bit, and how many bits count
    _kept: Events = np.zeros(0, EVENT_DTYPE)

    def _room_for(self, words: Words) -> Events:
        """Room for all events that these words can hold, at least.

        Raises:
            InputError: they hold more than are allowed.
        """
        most = len(words) * max(self._vectors.values())
        if most > min(_KEPT_EVENTS, self._max_events):
            n = _count_events(words, self._single, self._vectors)
            _check_count(n, self._max_events, self._encoding)
            return np.zeros(n, EVENT_DTYPE)
        if most > len(self._kept):
            self._kept = np.zeros(1 << (most - 1).bit_length(), EVENT_DTYPE)
        return self._kept

    def _events(self, room: Events, n: int, resolution: Resolution) -> Events:
        """The first n events of a room, measured, in memory that nothing else uses."""
        events = room[:n]
        self.n_inside = time_span(events, *resolution, self.span)
        if room is not self._kept:
            return events
        # As numbers: of records NumPy copies field by field, in ten times the time.
        return events.view(np.int64).copy().view(EVENT_DTYPE)


class _OfRecords(_Stateful):
    """What the decoders of 64-bit records share: the length of a payload is the number of its events."""

    _encoding: str

    def _read(self, payload: bytes | memoryview) -> tuple[NDArray[np.uint64], NDArray[np.int64]]:
        """The records of a payload, and room for their events.

        A copy, so that a kernel meets one array type, whatever address the bytes had.
        """
        words = _records(payload, np.dtype(np.uint64), self._encoding, self._max_events).copy()
        return words, np.empty(2 * len(words), np.int64)


class MonoDecoder(_OfRecords):
    """`mono`: u64 words of `dt` ns (32 bits), x (16), y (15) and polarity (1)."""

    _encoding = "mono"

    def decode(
        self, payload: bytes | memoryview, time_base_ns: int, resolution: Resolution = EVERY_PIXEL
    ) -> Events:
        """See `Decoder.decode`."""
        words, room = self._read(payload)
        # time_base may use all 64 bits, so the sum is taken apart instead of overflowing
        base_us, rest_ns = divmod(time_base_ns, 1000)
        self.n_inside = decode_mono(words, base_us, rest_ns, *resolution, room, self.span)
        return room.view(EVENT_DTYPE)


class LibcaerDecoder(_OfRecords):
    """`libcaer`: u32 address and polarity, then u32 microseconds that wrap at 31 bits within a packet."""

    _encoding = "libcaer"

    def decode(
        self, payload: bytes | memoryview, time_base_ns: int, resolution: Resolution = EVERY_PIXEL
    ) -> Events:
        """See `Decoder.decode`."""
        words, room = self._read(payload)
        self.n_inside = decode_libcaer(words, time_base_ns // 1000, *resolution, room, self.span)
        return room.view(EVENT_DTYPE)


class LibcaerCmpDecoder(_OfWords):
    """`libcaer_cmp`: u16 words, addresses carried over from the packet before."""

    _n_state, _encoding, _single, _vectors = 3, "libcaer_cmp", 3, {5: 8}

    def decode(
        self, payload: bytes | memoryview, time_base_ns: int, resolution: Resolution = EVERY_PIXEL
    ) -> Events:
        """See `Decoder.decode`."""
        words = _words(payload, "libcaer_cmp")
        room = self._room_for(words)
        n = decode_libcaer_cmp(words, time_base_ns // 1000, self._state, room)
        if n < 0:
            at = -1 - n
            raise InputError(f"libcaer_cmp payload: unknown word 0x{words[at]:04x} at byte {2 * at}")
        return self._events(room, n, resolution)


class Evt3Decoder(_OfWords):
    """`evt3`, also the words of a Prophesee EVT 3.0 camera file: u16 words, all state carried over.

    Stream time is that of the camera, from its 24-bit microseconds with their wraps counted; `time_base` is
    not used. Events before the first TIME_HIGH, TIME_LOW and ADDR_Y, in this order, are skipped.
    """

    _n_state, _encoding, _single, _vectors = 6, "evt3", 0x2, {0x4: 12, 0x5: 8}

    def decode(
        self, payload: bytes | memoryview, time_base_ns: int = 0, resolution: Resolution = EVERY_PIXEL
    ) -> Events:
        """See `Decoder.decode`."""
        words = _words(payload, "evt3")
        room = self._room_for(words)
        return self._events(room, decode_evt3(words, self._state, room), resolution)

    def resync(self) -> None:
        """See `Decoder.resync`: wait for time and address again; the wraps counted so far stay."""
        self._state[-1] = 0

    def count_wraps(self, n: int) -> None:
        """Time has wrapped so often more than the packets that were decoded could show."""
        self._state[0] += n << 12


_DECODERS: dict[str, Callable[[int], Decoder]] = {
    "mono": MonoDecoder,
    "libcaer": LibcaerDecoder,
    "libcaer_cmp": LibcaerCmpDecoder,
    "evt3": Evt3Decoder,
}

PAYLOAD_ENCODINGS = tuple(_DECODERS)
"""The names that `make_decoder` and `encode` take."""


def make_decoder(encoding: str, max_events: int = MAX_PACKET_EVENTS) -> Decoder:
    """Make the decoder of one topic, which refuses packets of more than `max_events` events.

    Raises:
        InputError: the encoding is none of `PAYLOAD_ENCODINGS`.
    """
    if encoding not in _DECODERS:
        raise InputError(
            f"unknown event encoding {encoding[:40]!r}; known are {', '.join(PAYLOAD_ENCODINGS)}"
        )
    return _DECODERS[encoding](max_events)


def encode(events: Events, encoding: str, after_us: int = 0) -> tuple[bytes, int]:
    """Encode the events of one packet.

    Args:
        events: `(n,)` array of `EVENT_DTYPE`, not changed; for `libcaer` and `evt3` sorted by time.
        encoding: one of `PAYLOAD_ENCODINGS`.
        after_us: `evt3` only: time of the last event that the reader of this packet has decoded, 0 at the
            start of a stream; silent gaps after it are bridged with TIME_HIGH words.

    Returns:
        The payload, and the `time_base` in nanoseconds that belongs to it.

    Raises:
        InputError: the encoding is unknown, or cannot represent these events: a coordinate has too many
            bits, a polarity is not 0 or 1, time is negative, out of order, or spans too much for a packet.
    """
    make_decoder(encoding)
    if len(events) == 0:
        return b"", 0
    _check_fields(events, encoding)
    if encoding == "evt3":
        return encode_evt3(events, after_us), 0
    first_us = int(events["t"].min())
    offset_us = events["t"] - first_us
    if encoding == "mono":
        _check_span(offset_us, ((1 << 32) - 1) // 1000, "mono")
        x, y, p, dt_ns = (c.astype("<u8") for c in (events["x"], events["y"], events["p"], offset_us * 1000))
        payload = dt_ns | x << 32 | y << 48 | p << 63
    elif encoding == "libcaer":
        check_sorted(events, "libcaer")
        _check_span(offset_us, LIBCAER_WRAP_US - 1, "libcaer")
        x, y, p = (events[name].astype("<u4") for name in ("x", "y", "p"))
        payload = np.empty(len(events), _LIBCAER)
        payload["data"] = x << 17 | y << 2 | p << 1 | 1  # bit 0: libcaer's mark of a valid event
        payload["us"] = offset_us
    else:
        _check_span(offset_us, (1 << 24) - 1, "libcaer_cmp")
        payload = libcaer_cmp_words(events, offset_us)
    return payload.tobytes(), first_us * 1000


_Record = TypeVar("_Record", bound=np.generic)


def _records(
    payload: bytes | memoryview, dtype: np.dtype[_Record], encoding: str, limit: int
) -> NDArray[_Record]:
    """View a payload as whole records."""
    if len(payload) % dtype.itemsize:
        raise InputError(
            f"{encoding} payload: {len(payload)} bytes are not a multiple of {dtype.itemsize}; "
            "the packet is cut short or of another encoding"
        )
    records = np.frombuffer(payload, dtype)
    _check_count(len(records), limit, encoding)
    return records


def _words(payload: bytes | memoryview, encoding: str) -> Words:
    """Copy a payload out, so that a kernel meets one array type, whatever address the bytes had."""
    return _records(payload, np.dtype(np.uint16), encoding, MAX_PACKET_EVENTS).copy()


def _count_events(words: Words, single: int, vectors: dict[int, int]) -> int:
    """How many events words of these types can hold, see `_OfWords`."""
    kind = words >> 12
    n = int(np.count_nonzero(kind == single))
    for code, width in vectors.items():
        is_vector = kind == code
        if is_vector.any():
            bits = words[is_vector] & ((1 << width) - 1)
            n += int(np.bitwise_count(bits).sum(dtype=np.int64))
    return n


def _check_count(n: int, limit: int, encoding: str) -> None:
    if n > limit:
        raise InputError(f"{encoding} payload: {n} records or events in one packet, more than {limit}")


_ADDRESS_BITS = {"mono": (16, 15), "libcaer": (15, 15), "libcaer_cmp": (11, 11), "evt3": (11, 11)}


def _check_fields(events: Events, encoding: str) -> None:
    for name, bits in zip("xy", _ADDRESS_BITS[encoding], strict=True):
        largest = int(events[name].max())
        if largest >> bits:
            raise InputError(f"{encoding} has {bits} bits for {name}, but an event has {name} = {largest}")
    if ((events["p"] != 0) & (events["p"] != 1)).any():
        raise InputError(f"{encoding} needs polarities of 0 and 1; map other values before writing")
    if events["t"].min() < 0:
        raise InputError(f"{encoding} has no negative time, but an event has t = {events['t'].min()} us")


def _check_span(offset_us: NDArray[np.int64], limit_us: int, encoding: str) -> None:
    if offset_us.max() > limit_us:
        raise InputError(
            f"a {encoding} packet spans at most {limit_us} us, these events {offset_us.max()} us; "
            "write them as several packets"
        )
