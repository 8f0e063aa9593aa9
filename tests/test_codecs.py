"""Payload encodings: against real cameras, against slow twins, there and back, and with hostile bytes."""

import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE, make_events
from streamfeat.kernels import decode as kernels
from streamfeat.messages.codecs import PAYLOAD_ENCODINGS, Evt3Decoder, LibcaerCmpDecoder, encode, make_decoder

WORDS = arrays(np.uint16, st.integers(0, 60), elements=st.integers(0, 0xFFFF))


def words(*values):
    return np.array(values, "<u2").tobytes()


def rows(events):
    return [tuple(row) for row in events.tolist()]


def decode(encoding, payload, time_base_ns=0):
    return make_decoder(encoding).decode(payload, time_base_ns)


@st.composite
def packets(draw, encoding, longest_us):
    n = draw(st.integers(1, 40))
    side = 0x7FF if encoding in ("libcaer_cmp", "evt3") else 0x7FFF
    column = lambda top: draw(arrays(np.int64, n, elements=st.integers(0, top)))  # noqa: E731
    start = draw(st.integers(0, (1 << 24) - 1 if encoding == "evt3" else 1 << 50))
    offsets = np.sort(column(longest_us))
    return make_events(column(side), column(side), column(1), start + offsets)


# --- real cameras


def test_evt3_file_matches_an_independent_decoder(shared_data):
    raw = (shared_data / "samples/evt3_1280x720.raw").read_bytes()
    while raw.startswith(b"%"):
        raw = raw[raw.index(b"\n") + 1 :]
    golden = np.load(shared_data / "samples/evt3_1280x720_golden.npz")
    events = Evt3Decoder().decode(raw)

    assert len(events) == len(golden["t"]) == 219_596
    for name in "xyp":
        np.testing.assert_array_equal(events[name], golden[name])
    # That decoder also counts 4096 us for each TIME_LOW that is smaller than the one before, on top of the
    # TIME_HIGH that says so; the camera sends a TIME_HIGH every 16 us, and its 551 of them agree with us.
    assert events["t"][-1] - events["t"][0] == pytest.approx(551 * 16, abs=16)
    stream = np.frombuffer(raw, "<u2")
    lows = np.flatnonzero(stream >> 12 == 6)
    falls = np.zeros(len(stream), np.int64)
    falls[lows[1:]] = np.diff((stream[lows] & 0xFFF).astype(int)) < 0
    emitted = [
        {2: 1, 4: (w & 0xFFF).bit_count(), 5: (w & 0xFF).bit_count()}.get(w >> 12, 0) for w in stream.tolist()
    ]
    np.testing.assert_array_equal(events["t"], golden["t"] - 4096 * np.repeat(np.cumsum(falls), emitted))


def test_evt3_file_in_pieces_is_the_file(shared_data):
    raw = (shared_data / "samples/evt3_1280x720.raw").read_bytes()[166:]
    whole = Evt3Decoder().decode(raw)
    pieces = Evt3Decoder()
    cut = [pieces.decode(raw[i : i + 998]) for i in range(0, len(raw), 998)]
    np.testing.assert_array_equal(np.concatenate(cut), whole)


# --- the words of each encoding, by hand


def test_mono_word():
    payload = np.array([2_500 | 3 << 32 | 0x7FFE << 48 | 1 << 63], "<u8").tobytes()
    assert rows(decode("mono", payload, 1_000_600)) == [(3, 0x7FFE, 1, 1003)]


def test_mono_time_uses_all_64_bits():
    payload = np.array([0xFFFFFFFF], "<u8").tobytes()
    (event,) = decode("mono", payload, 2**64 - 1)
    assert event["t"] == (2**64 - 1 + 0xFFFFFFFF) // 1000


def test_libcaer_record_and_its_wrap():
    record = 3 << 17 | 2 << 2 | 1 << 1
    top = (1 << 31) - 1
    payload = np.array([record, top, record, 4, record, 2, record, top], "<u4").tobytes()
    times = [top, (1 << 31) + 4, (1 << 31) + 2, (1 << 31) + top]
    assert rows(decode("libcaer", payload, 7_000_999)) == [(3, 2, 1, 7_000 + t) for t in times]


def test_libcaer_cmp_words():
    decoder = LibcaerCmpDecoder()
    first = decoder.decode(words(0x0002, 0x1003, 0x2809, 0x3804, 0x4005, 0x5081, 0x5001), 10_000)
    t = 10 + 2 * 4096 + 3
    assert rows(first) == [(9, 4, 1, t), (9, 5, 0, t), (9, 12, 0, t), (9, 13, 0, t)]
    # the time starts again with the packet, the address does not
    assert rows(decoder.decode(words(0x3001), 20_000)) == [(9, 1, 0, 20)]


def test_evt3_words():
    stream = words(
        0x8001, 0x6002, 0x0803, 0x2805, 0x3810, 0x4801, 0x5082, 0xA101, 0xE000, 0x7001, 0xF001, 0x2001
    )
    t = 4096 + 2
    expected = [(5, 3, 1, t), (16, 3, 1, t), (27, 3, 1, t), (29, 3, 1, t), (35, 3, 1, t), (1, 3, 0, t)]
    assert rows(Evt3Decoder().decode(stream)) == expected


def test_evt3_skips_until_time_and_row_are_known():
    skipped = [0x2001, 0x0001, 0x6001, 0x2001, 0x4FFF, 0x8001, 0x2001, 0x0009, 0x6004, 0x2001, 0x4FFF]
    events = Evt3Decoder().decode(words(*skipped, 0x0002, 0x4FFF, 0x2001))
    assert rows(events) == [(1, 2, 0, 4096 + 4)]


def test_evt3_counts_wraps_but_not_late_words():
    highs = [0xFFF, 0x003, 0xFFE, 0x002, 0x7FF, 0xFFF, 0x00B]
    decoder = Evt3Decoder()
    times = [decoder.decode(words(0x8000 | h, 0x6000, 0x0000, 0x2000))["t"][0] >> 12 for h in highs]
    assert times == [0xFFF, 0x1003, 0xFFE, 0x1002, 0x17FF, 0x1FFF, 0x200B]


def test_evt3_resync_keeps_the_wraps():
    decoder = Evt3Decoder()
    decoder.decode(words(0x8FFF, 0x6000, 0x0001, 0x8005))
    decoder.resync()
    assert rows(decoder.decode(words(0x2001, 0x6001, 0x2001, 0x8006, 0x6001, 0x0001, 0x2001))) == [
        (1, 1, 0, (0x1006 << 12) + 1)
    ]


@pytest.mark.parametrize(
    ("encoding", "first", "second"),
    [
        ("libcaer_cmp", (0x2009, 0x3001, 0x4003, 0x50FF), (0x2001, 0x3FFF)),
        ("evt3", (0x8001, 0x6002, 0x0003, 0x2805, 0x3810, 0x4FFF), (0x6009, 0x2001)),
    ],
)
def test_events_stay_as_they_are_while_the_next_packet_is_decoded(encoding, first, second):
    decoder, exact = make_decoder(encoding), make_decoder(encoding, max_events=14)
    events = decoder.decode(words(*first), 0)
    before = rows(events)
    later = rows(decoder.decode(words(*second), 0))
    assert rows(events) == before
    # 14 events are fewer than the words could hold if all were vectors, so this decoder counts them first.
    assert (rows(exact.decode(words(*first), 0)), rows(exact.decode(words(*second), 0))) == (before, later)
    events["t"] += 5
    assert rows(decoder.decode(words(*second), 0)) == later


# --- kernels against their twins


@settings(deadline=None)
@given(st.lists(WORDS, max_size=4))
def test_decode_evt3_is_its_twin(pieces):
    state, twin_state = np.zeros(6, np.int64), np.zeros(6, np.int64)
    for piece in pieces:
        out, twin_out = np.zeros(12 * 60, EVENT_DTYPE), np.zeros(12 * 60, EVENT_DTYPE)
        n = kernels.decode_evt3(piece, state, out)
        assert n == naive.decode_evt3(piece, twin_state, twin_out)
        np.testing.assert_array_equal(out, twin_out)
        np.testing.assert_array_equal(state, twin_state)


@settings(deadline=None)
@given(st.lists(WORDS.map(lambda w: w % 0x6001), max_size=4), st.integers(0, 2**54))
def test_decode_libcaer_cmp_is_its_twin(pieces, base_us):
    state, twin_state = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for piece in pieces:
        out, twin_out = np.zeros(8 * 60, EVENT_DTYPE), np.zeros(8 * 60, EVENT_DTYPE)
        n = kernels.decode_libcaer_cmp(piece, base_us, state, out)
        assert n == naive.decode_libcaer_cmp(piece, base_us, twin_state, twin_out)
        if n >= 0:
            np.testing.assert_array_equal(out, twin_out)
        np.testing.assert_array_equal(state, twin_state)


# --- there and back


@pytest.mark.parametrize(
    ("encoding", "longest_us"),
    [("mono", 4_294_967), ("libcaer", 2**31 - 1), ("libcaer_cmp", 2**24 - 1), ("evt3", 2**33)],
)
@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_round_trip(encoding, longest_us, data):
    events = data.draw(packets(encoding, longest_us))
    payload, time_base_ns = encode(events, encoding)
    np.testing.assert_array_equal(decode(encoding, payload, time_base_ns), events)


def test_evt3_round_trip_over_packets_and_silence():
    t = np.array([5, 40_000_000, 40_000_001, 2_000_000_000, 30_000_000_000])
    events = make_events(np.arange(5), 5, 1, t)
    decoder, before, back = Evt3Decoder(), 0, []
    for i in range(5):
        payload, _ = encode(events[i : i + 1], "evt3", before)
        back.append(decoder.decode(payload))
        before = int(t[i])
    np.testing.assert_array_equal(np.concatenate(back), events)


@pytest.mark.parametrize("encoding", PAYLOAD_ENCODINGS)
def test_empty_payload(encoding):
    assert encode(np.zeros(0, EVENT_DTYPE), encoding) == (b"", 0)
    assert len(decode(encoding, b"")) == 0


@pytest.mark.parametrize("encoding", ["mono", "libcaer_cmp"])
def test_disorder_is_kept(encoding):
    events = make_events([1, 2, 3], 4, [0, 1, 0], [30, 10, 20])
    np.testing.assert_array_equal(decode(encoding, *encode(events, encoding)), events)


# --- what cannot be


@pytest.mark.parametrize(("encoding", "odd"), [("mono", 7), ("libcaer", 12), ("libcaer_cmp", 3), ("evt3", 1)])
def test_payload_of_broken_length(encoding, odd):
    with pytest.raises(InputError, match=f"{encoding} payload: {odd} bytes are not a multiple"):
        decode(encoding, bytes(odd))


def test_unknown_encoding():
    with pytest.raises(InputError, match="unknown event encoding 'evt4'; known are mono"):
        make_decoder("evt4")


def test_unknown_libcaer_cmp_word_changes_nothing():
    decoder = LibcaerCmpDecoder()
    decoder.decode(words(0x2007), 0)
    with pytest.raises(InputError, match="unknown word 0x6001 at byte 4"):
        decoder.decode(words(0x2001, 0x3001, 0x6001), 0)
    assert rows(decoder.decode(words(0x3001), 0)) == [(7, 1, 0, 0)]


@pytest.mark.parametrize(
    ("encoding", "payload"),
    [
        ("evt3", words(0x4FFF, 0x4FFF)),
        ("libcaer_cmp", words(0x50FF, 0x50FF, 0x50FF)),
        ("mono", bytes(24 * 8)),
        ("libcaer", bytes(24 * 8)),
    ],
)
def test_payload_of_too_many_events(encoding, payload):
    make_decoder(encoding, 24).decode(payload, 0)
    with pytest.raises(InputError, match="24 records or events in one packet, more than 23"):
        make_decoder(encoding, 23).decode(payload, 0)


@pytest.mark.parametrize(
    ("encoding", "event", "reason"),
    [
        ("mono", ([1], [0x8000], [0], [0]), "15 bits for y"),
        ("libcaer", ([0x8000], [1], [0], [0]), "15 bits for x"),
        ("libcaer_cmp", ([0x800], [1], [0], [0]), "11 bits for x"),
        ("evt3", ([1], [0x800], [0], [0]), "11 bits for y"),
        ("mono", ([1], [1], [-1], [0]), "polarities of 0 and 1"),
        ("mono", ([1], [1], [1], [-5]), "no negative time.*-5"),
        ("mono", ([1, 1], [1, 1], [1, 1], [0, 4_294_968]), "spans at most 4294967 us"),
        ("libcaer", ([1, 1], [1, 1], [1, 1], [0, 2**31]), "spans at most"),
        ("libcaer_cmp", ([1, 1], [1, 1], [1, 1], [0, 2**24]), "spans at most"),
        ("libcaer", ([1, 1], [1, 1], [1, 1], [5, 4]), "event 1 is earlier"),
        ("evt3", ([1, 1], [1, 1], [1, 1], [5, 4]), "event 1 is earlier"),
        ("evt3", ([1], [1], [1], [2**50]), "cannot jump from 0"),
    ],
)
def test_events_that_an_encoding_cannot_hold(encoding, event, reason):
    with pytest.raises(InputError, match=reason):
        encode(make_events(*event), encoding)


def test_evt3_refuses_to_go_back_between_packets():
    with pytest.raises(InputError, match="5 us follows 6 us"):
        encode(make_events([1], [1], [1], [5]), "evt3", after_us=6)


@pytest.mark.parametrize("encoding", PAYLOAD_ENCODINGS)
@settings(deadline=None, max_examples=60)
@given(payload=st.binary(max_size=200), time_base_ns=st.integers(0, 2**64 - 1))
def test_any_bytes_decode_or_are_refused(encoding, payload, time_base_ns):
    try:
        events = decode(encoding, payload, time_base_ns)
    except InputError:
        return
    assert events.dtype == EVENT_DTYPE
    assert len(events) <= 6 * len(payload)
    assert set(np.unique(events["p"])) <= {0, 1}


@pytest.mark.parametrize("encoding", PAYLOAD_ENCODINGS)
def test_a_snapshot_of_another_length_is_refused_and_changes_nothing(encoding):
    decoder = make_decoder(encoding)
    good = decoder.snapshot()
    for bad in [*([0] * n for n in range(len(good))), [*good, 0], [*good, *good, 1]]:
        with pytest.raises(InputError, match="snapshot of a decoder holds"):
            decoder.restore(bad)
        assert decoder.snapshot() == good
