"""Events of other tools go straight into an engine, and mean there what they mean at home."""

import importlib

import numpy as np
import pytest
import tiny

import streamfeat as sf
from streamfeat.events import EVENT_DTYPE
from streamfeat.recordings.reader import open_recording

LAYOUTS = {
    "metavision": [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")],
    "faery": [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), (("p", "on"), "?")],
    "tonic files": [("x", "<i2"), ("y", "<i2"), ("t", "<i8"), ("p", "?")],
    "tonic N-MNIST": [("x", "<i8"), ("y", "<i8"), ("t", "<i8"), ("p", "<i8")],
    "tonic gestures": [("x", "<i2"), ("y", "<i2"), ("p", "?"), ("t", "<i8")],
    "expelliarmus": [("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1")],
    "dv-processing": [("timestamp", "<i8"), ("x", "<i2"), ("y", "<i2"), ("polarity", "i1")],
    "big-endian": [("ts", ">i8"), ("pol", ">i4"), ("y", ">u4"), ("x", ">u4"), ("label", ">f8")],
    "narrow": [("t", "<u4"), ("x", "u1"), ("y", "u1"), ("p", "i1")],
}


def events(n=400):
    return tiny.steady(0, 90_000, n)


def as_layout(events, layout, *, align=False):
    """The same events in another layout."""
    other = np.zeros(len(events), np.dtype(layout, align=align))
    for name in other.dtype.names:
        field = next((f for f, names in FIELDS.items() if name in names), None)
        if field:
            other[name] = events[field]
    return other


FIELDS = {"x": ("x",), "y": ("y",), "p": ("p", "pol", "polarity", "on"), "t": ("t", "ts", "timestamp")}


@pytest.mark.parametrize("align", [False, True], ids=["packed", "aligned"])
@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_any_order_width_and_name(layout, align):
    expected, other = events(), as_layout(events(), layout, align=align)
    before = other.tobytes()
    found = sf.as_events(other)
    np.testing.assert_array_equal(found, expected, strict=True)
    assert other.tobytes() == before


@pytest.mark.parametrize("way", ["feed", "follow", "trace"])
def test_an_engine_takes_them_however_the_stream_is_cut(way):
    expected = sf.Engine(tiny.encoder(), tiny.RESOLUTION)
    expected.feed(events())
    engine = sf.Engine(tiny.encoder(), tiny.RESOLUTION)
    for i, layout in enumerate(LAYOUTS.values()):
        getattr(engine, way)(as_layout(events()[i::9], layout))
    assert engine.stats().events == 400
    np.testing.assert_array_equal(engine.features(), expected.features())


def test_offline_features_and_recordings_take_them_as_well(tmp_path):
    other = as_layout(events(), LAYOUTS["faery"])
    offline = tiny.encoder().encode(other, tiny.RESOLUTION)
    np.testing.assert_array_equal(offline, tiny.encoder().encode(events(), tiny.RESOLUTION))
    with sf.RecordingWriter(tmp_path / "other.mcap") as writer:
        writer.write_events(other, tiny.RESOLUTION)
    with open_recording(tmp_path / "other.mcap") as recording:
        np.testing.assert_array_equal(np.concatenate(list(recording)), events())


@pytest.mark.parametrize(
    ("names", "shares"),
    [
        (("x", "y", "p", "t"), True),
        (("x", "y", "polarity", "timestamp"), True),
        (("y", "x", "p", "t"), False),
    ],
    ids=["the same", "other names", "another order"],
)
def test_nothing_is_copied_where_the_layout_is_the_same(names, shares):
    renamed = [(name, EVENT_DTYPE[i]) for i, name in enumerate(names)]
    other = as_layout(events(), renamed, align=True)
    found = sf.as_events(other)
    assert np.shares_memory(found, other) == shares
    np.testing.assert_array_equal(found, events(), strict=True)


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_an_empty_batch_is_empty(layout):
    np.testing.assert_array_equal(sf.as_events(as_layout(events()[:0], layout)), events()[:0], strict=True)


def test_a_record_array_is_an_array():
    engine = sf.Engine(tiny.encoder(), tiny.RESOLUTION)
    engine.feed(events().view(np.recarray))
    assert engine.stats().events == 400


@pytest.mark.parametrize(
    ("p", "dtype", "expected"),
    [
        ([0, 1, 1], "?", [0, 1, 1]),
        ([0, 1, 1], "u1", [0, 1, 1]),
        ([-1, 1, 1], "i1", [0, 1, 1]),
        ([-1, 1, -1], "<i8", [0, 1, 0]),
        ([-1, -1, -1], "<i2", [0, 0, 0]),
        ([1, 1, 1], "<i8", [1, 1, 1]),
    ],
)
@pytest.mark.parametrize("align", [False, True])
def test_polarity_conventions(p, dtype, expected, align):
    fields = [("x", "<u2"), ("y", "<u2"), ("polarity", dtype), ("t", "<i8")]
    other = np.zeros(3, np.dtype(fields, align=align))
    other["polarity"] = p
    assert sf.as_events(other)["p"].tolist() == expected
    assert other["polarity"].tolist() == p


@pytest.mark.parametrize(
    ("field", "value"),
    [("x", 65536), ("x", -1), ("y", 1 << 40), ("p", 2), ("p", 65536), ("p", -2), ("t", 1 << 62)],
)
def test_what_no_event_can_be_is_rejected_and_changes_nothing(field, value):
    expected, engine = (sf.Engine(tiny.encoder(), tiny.RESOLUTION) for _ in range(2))
    other = as_layout(events(), LAYOUTS["tonic N-MNIST"])
    other[field][7] = value
    expected.feed(np.delete(events(), 7))
    engine.feed(other)
    assert (engine.stats().rejected, engine.stats().events) == (1, 399)
    np.testing.assert_array_equal(engine.features(), expected.features())


def test_a_time_beyond_what_fits_is_rejected():
    other = as_layout(events(), LAYOUTS["faery"])
    other["t"][3] = (1 << 64) - 1
    engine = sf.Engine(tiny.encoder(), tiny.RESOLUTION)
    engine.feed(other)
    assert engine.stats().rejected == 1


XY = [("x", "<u2"), ("y", "<u2")]
REFUSED = {
    "polarity -1 and 0": (
        np.array([(1, 1, 1, 0), (1, 1, -1, 0), (1, 1, 0, 0)], [*XY, ("p", "i1"), ("t", "<i8")]),
        "polarity is -1 at event 1 and 0 at event 2",
    ),
    "two polarities": (
        np.zeros(2, [*XY, ("p", "i1"), ("on", "?"), ("t", "<i8")]),
        "p and on could both be polarity",
    ),
    "no time": (np.zeros(2, [*XY, ("p", "i1")]), "needs a field t or ts or timestamp, but has x, y, p"),
    "seconds": (np.zeros(2, [*XY, ("p", "i1"), ("t", "<f8")]), "'t' is float64, but microseconds must be"),
    "dates": (np.zeros(2, [*XY, ("p", "i1"), ("t", "<M8[us]")]), "microseconds must be whole"),
    "places between pixels": (
        np.zeros(2, [("x", "<f4"), *XY[1:], ("p", "i1"), ("t", "<i8")]),
        "'x' is float32",
    ),
    "polarity of floats": (np.zeros(2, [*XY, ("p", "<f4"), ("t", "<i8")]), "'p' is float32"),
    "pairs": (np.zeros(2, [*XY, ("p", "i1", (2,)), ("t", "<i8")]), "'p' is int8"),
    "columns without names": (np.zeros((5, 4), np.int64), "an array of 2 dimensions and int64"),
    "a list": ([(1, 2, 3, 4)], "not list"),
}


@pytest.mark.parametrize(("batch", "says"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_understood_is_refused_in_one_line(batch, says):
    engine = sf.Engine(tiny.encoder(), tiny.RESOLUTION)
    with pytest.raises(sf.InputError) as error:
        engine.feed(batch)
    assert says in str(error.value)
    assert "\n" not in str(error.value)
    assert engine.stats().events == 0


# The libraries themselves


def library(name):
    try:
        return importlib.import_module(name)
    except ImportError as error:
        pytest.skip(f"{name} is not installed (extras convert and bench): {error}")


def of_faery(path, sample):
    faery = library("faery")
    columns = as_layout(sample, faery.EVENTS_DTYPE.descr)
    faery.events_stream_from_array(columns, dimensions=(16, 12)).to_file(path.with_suffix(".aedat4"))
    return list(faery.events_stream_from_file(path.with_suffix(".aedat4")))


def of_expelliarmus(path, sample):
    wizard = library("expelliarmus").Wizard("dat")
    wizard.save(str(path), as_layout(sample, LAYOUTS["expelliarmus"]))
    return [wizard.read(str(path))]


def of_tonic(path, sample):
    make = library("tonic.io").make_structured_array
    return [make(sample["x"], sample["y"], sample["t"], sample["p"])]


def of_dv_processing(path, sample):
    store = library("dv_processing").EventStore()
    for x, y, p, t in sample.tolist():
        store.push_back(t, x, y, bool(p))
    return [store.numpy()]


@pytest.mark.parametrize("make", [of_faery, of_expelliarmus, of_tonic, of_dv_processing])
def test_what_a_library_hands_out_goes_in(make, tmp_path):
    batches = make(tmp_path / "events.dat", events())
    assert batches[0].dtype != EVENT_DTYPE
    expected, engine = (sf.Engine(tiny.encoder(), tiny.RESOLUTION) for _ in range(2))
    expected.feed(events())
    for batch in batches:
        engine.feed(batch)
    assert engine.stats().events == 400
    np.testing.assert_array_equal(engine.features(), expected.features())


def test_a_store_of_dv_processing_is_told_how():
    store = library("dv_processing").EventStore()
    with pytest.raises(sf.InputError, match=r"not EventStore; give its \.numpy\(\)"):
        sf.as_events(store)
