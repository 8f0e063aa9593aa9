"""Camera files as people have them: orders, names, units, layouts, streams; each says what was assumed."""

import bz2
import gzip

import camera_files_scene as scenes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import streamfeat as sf
from streamfeat.camera_files.event_files import open_events, read_events
from streamfeat.camera_files.source import TableOptions
from streamfeat.errors import InputError
from streamfeat.events import make_events

SCENE = scenes.scene()
NAMES = {"x": ["x", "X", "x@64", "xs"], "y": ["y", "Y", "y@48", "ys"], "p": ["p", "pol", "on", "Polarity"]}
NAMES |= {"t": ["t", "T", "ts", "timestamp", "t_us", "t [us]"]}


def read(path, data, **options):
    path.write_bytes(data)
    return read_events(path, options=TableOptions(**options)).events


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("tables")


@settings(deadline=None, max_examples=40)
@given(
    order=st.permutations("txyp").map("".join),
    names=st.fixed_dictionaries({field: st.sampled_from(names) for field, names in NAMES.items()}),
    separator=st.sampled_from([",", ";", "\t"]),
    start=st.sampled_from(["", "\ufeff", "# "]),
    ending=st.sampled_from(["\n", "\r\n"]),
)
def test_names_decide_whatever_their_order(folder, order, names, separator, start, ending):
    header = start + separator.join(names[field] for field in order) + ending
    np.testing.assert_array_equal(read(folder / "a.csv", scenes.text(SCENE, order, separator, header)), SCENE)


def test_one_step_back_in_a_short_table_does_not_swap_its_columns(tmp_path):
    events = read(tmp_path / "a.txt", b"20 1 2 1\n10 1 2 1\n")
    assert [events[name].tolist() for name in "txyp"] == [[20, 10], [1, 1], [2, 2], [1, 1]]


@pytest.mark.parametrize("order", ["txyp", "xytp", "xypt", "tpxy", "pxyt", "ptxy"])
@pytest.mark.parametrize("separator", [" ", ",", "\t", ";"])
def test_order_is_found_by_values_and_said(tmp_path, order, separator):
    path = tmp_path / "a.txt"
    np.testing.assert_array_equal(read(path, scenes.text(SCENE, order, separator)), SCENE)
    assert any(" ".join(order) in line for line in open_events(path).assumptions)
    np.save(tmp_path / "a.npy", scenes.table(SCENE, order))
    np.testing.assert_array_equal(read_events(tmp_path / "a.npy").events, SCENE)


@pytest.mark.parametrize(
    ("factor", "unit", "written"),
    [(1, "microseconds", "{}"), (1, "microseconds", "{}.0"), (1000, "nanoseconds", "{}000")],
)
def test_unit_is_found_and_said(tmp_path, factor, unit, written):
    path = tmp_path / "a.txt"
    np.testing.assert_array_equal(read(path, scenes.text(SCENE, "txyp", time=written)), SCENE)
    assert any(unit in line for line in open_events(path).assumptions)
    columns = {name: SCENE[name] for name in "xyp"} | {"t": SCENE["t"].astype(float) * factor}
    np.savez(tmp_path / "a.npz", **columns)
    np.testing.assert_array_equal(read_events(tmp_path / "a.npz").events, SCENE)


def test_options_set_order_unit_and_resolution(tmp_path):
    data = scenes.text(SCENE, "ytxp", time="{}000")
    with pytest.raises(InputError, match=r"sort its rows|p = "):
        read(tmp_path / "a.txt", data)
    options = {"columns": "y,t,x,p", "time_unit": "ns", "resolution": (48, 64)}
    np.testing.assert_array_equal(read(tmp_path / "a.txt", data, **options), SCENE)
    assert open_events(tmp_path / "a.txt", options=TableOptions(**options)).assumptions == ()


def test_times_that_fall_are_refused_with_the_order_that_fits(tmp_path):
    with pytest.raises(InputError, match=r"times fall in .* --columns x,y,t,p would fit"):
        read(tmp_path / "a.txt", scenes.text(SCENE, "xytp"), columns="t,x,y,p")


def test_words_index_columns_and_sizes(tmp_path):
    rows = "".join(f"{e['t']},{e['x']},{e['y']},{bool(e['p'])}\n" for e in SCENE)
    np.testing.assert_array_equal(read(tmp_path / "a.csv", b"t,x,y,on\n" + rows.encode()), SCENE)
    indexed = "".join(f"{i},{e['t']},{e['x']},{e['y']},{e['p']}\n" for i, e in enumerate(SCENE))
    np.testing.assert_array_equal(read(tmp_path / "a.csv", b",t,x,y,p\n" + indexed.encode()), SCENE)
    for header in ("%geometry:64,48\n", "# width: 64, height: 48\n", "64 48\n", "t,x@64,y@48,on\n"):
        order, separator = ("txyp", ",") if "@" in header else ("txyp", " ")
        path = tmp_path / "a.txt"
        path.write_bytes(scenes.text(SCENE, order, separator, header))
        assert open_events(path).declared == (48, 64)


FORMS = {
    "a.tsv": ("t\tx\ty\tp", "{t}\t{x}\t{y}\t{p}"),
    "no_ending": ("", "{t} {x} {y} {p}"),
    "spaces.txt": ("", "  {t:10d}   {x:4d} {y:4d}  {p}   "),
    "pipe.csv": ("t|x|y|p", "{t}|{x}|{y}|{p}"),
    "decimal_commas.csv": ("t;x;y;p", "{seconds};{x};{y};{p}"),
    "decimal_commas_and_tabs.txt": ("", "{seconds}\t{x}\t{y}\t{p}"),
    "comma_and_space.txt": ("", "{t}, {x}, {y}, {p}"),
    "trailing_comma.csv": ("", "{t},{x},{y},{p},"),
    "all_quoted.csv": ('"t","x","y","p"', '"{t}","{x}","{y}","{p}"'),
    "signed.csv": ("t,x,y,p", "{t},{x},{y},{signed:+d}"),
    "on_off.txt": ("", "{t} {x} {y} {on}"),
    "positive.csv": ("t,x,y,p", "{t},{x},{y},{positive}"),
    "scientific.txt": ("", "{t:.9e} {x:.3e} {y:.3e} {p:.3e}"),
    "notes.txt": ("# made by hand", "{t} {x} {y} {p} # seen"),
    "classic_mac.csv": ("t,x,y,p\r", "{t},{x},{y},{p}\r"),
    "rows_and_columns.csv": ("timestamp,row,col,polarity", "{t},{y},{x},{p}"),
    "camel.csv": ("timestampUs,xCoord,yCoord,isOn", "{t},{x},{y},{p}"),
    "prefixes.csv": ("t_ns,pixel_x,pixel_y,event_p", "{t}000,{x},{y},{p}"),
    "unit_alone.csv": ("x,y,pol,micros", "{x},{y},{p},{t}"),
    "other_columns.csv": ("id,t,x,y,p,label", "7,{t},{x},{y},{p},car"),
}


@pytest.mark.parametrize("name", FORMS)
def test_tables_as_people_write_them(tmp_path, name):
    header, row = FORMS[name]
    rows = [header] if header else []
    for t, x, y, p in zip(*(SCENE[field].tolist() for field in "txyp"), strict=True):
        words = {"on": "ON" if p else "OFF", "positive": "positive" if p else "negative", "signed": 2 * p - 1}
        rows.append(row.format(t=t, x=x, y=y, p=p, seconds=f"{t / 1e6:.6f}".replace(".", ","), **words))
    end = "" if name == "classic_mac.csv" else "\n"
    np.testing.assert_array_equal(
        read(tmp_path / name, "".join(f"{row}{end}" for row in rows).encode()), SCENE
    )


@settings(deadline=None, max_examples=60)
@given(
    st.lists(
        st.decimals(0, 2_000_000_000, places=9).map(str)
        | st.from_regex(r"[0-9]{1,9}\.[0-9]{0,8}", fullmatch=True),
        min_size=1,
        max_size=30,
    ),
    st.sampled_from([",", ";", " ", "\t", " ; "]),
)
def test_seconds_are_the_nearest_microseconds_of_the_floats_they_are(folder, times, separator):
    times.sort(key=float)
    data = "".join(separator.join([t, "3", "4", "1"]) + "\n" for t in times)
    events = read(folder / "seconds.txt", data.encode(), columns="t,x,y,p", time_unit="s")
    assert events["t"].tolist() == [int(np.rint(float(t) * 1e6)) for t in times]


def test_plain_numbers_and_others_in_one_file(tmp_path):
    """Blocks of plain numbers take another way than those with exponents, words or damage."""
    rows = [f"{t},3,4,1" for t in range(400_000)]
    rows[300_000] = "3e5,3,4,1"
    rows.insert(200_000, "# again")
    events = read(tmp_path / "a.csv", "\n".join(["t,x,y,p", *rows]).encode())
    assert events["t"].tolist() == [*range(400_000)]
    rows[350_000] = "350000,3,oh,1"
    with pytest.raises(InputError, match="could not convert string 'oh'"):
        read(tmp_path / "a.csv", "\n".join(["t,x,y,p", *rows]).encode())


def test_seconds_and_their_rest_in_columns_of_their_own_are_refused(tmp_path):
    with pytest.raises(InputError, match="sec,usec,x,y,p lack one of"):
        read(tmp_path / "a.csv", b"sec,usec,x,y,p\n1,5,2,3,1\n")


def test_two_conventions_of_off_in_one_file_are_refused(tmp_path):
    with pytest.raises(InputError, match="one of them is OFF"):
        read(tmp_path / "a.txt", b"10 1 2 1\n20 1 2 0\n30 1 2 -1\n")


def test_arrays_under_other_names_and_with_labels(tmp_path):
    np.savez(tmp_path / "a.npz", events=SCENE, label=3)
    assert open_events(tmp_path / "a.npz").labels == ("label = 3",)
    names = {"ts": SCENE["t"] / 1e6, "xs": SCENE["x"], "ys": SCENE["y"], "ps": SCENE["p"]}
    np.savez(tmp_path / "b.npz", **names)
    for name in ("a.npz", "b.npz"):
        np.testing.assert_array_equal(read_events(tmp_path / name).events, SCENE)


@pytest.mark.parametrize(
    ("make", "ending"),
    [
        (lambda: scenes.table(SCENE, "txyp").T, "npy"),
        (lambda: scenes.table(SCENE, "xytp").astype(">i4"), "npy"),
        (lambda: scenes.table(SCENE, "txyp").astype("f4"), "npy"),
        (lambda: SCENE.astype([("x", ">u2"), ("y", ">u2"), ("p", "?"), ("t", ">i8")])[:, None], "npy"),
        (lambda: {"arr_0": SCENE.astype([("x", "u1"), ("y", "u1"), ("p", "i1"), ("t", "<u4")])}, "npz"),
        (lambda: {**columns(), "t": SCENE["t"].astype("datetime64[us]")}, "npz"),
        (lambda: {**columns(), "t": SCENE["t"].astype("timedelta64[us]").astype("m8[ns]")}, "npz"),
        (lambda: {"t": SCENE["t"], "p": SCENE["p"], "xy": np.stack([SCENE["x"], SCENE["y"]], 1)}, "npz"),
        (lambda: {f"{name}s": column[:, None] for name, column in columns().items()}, "npz"),
        (lambda: {**columns(), "about": np.array({"a": 1}, dtype=object)}, "npz"),
    ],
)
def test_arrays_as_people_keep_them(tmp_path, make, ending):
    made = make()
    np.savez(tmp_path / "a.npz", **made) if ending == "npz" else np.save(tmp_path / "a.npy", made)
    np.testing.assert_array_equal(read_events(tmp_path / f"a.{ending}").events, SCENE)


def columns():
    return {name: SCENE[name] for name in "xypt"}


def test_a_small_file_that_unpacks_to_much_is_refused(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", t=np.zeros((1 << 27) + 1000, np.int64))
    with pytest.raises(InputError, match="when unpacked, more than"):
        open_events(tmp_path / "a.npz")


@pytest.mark.parametrize("is_swapped", [False, True])
def test_evt21_in_both_word_orders(tmp_path, is_swapped):
    data = scenes.evt21(SCENE, b"% evt 2.1\n% geometry 64x48\n% end\n", is_swapped=is_swapped)
    np.testing.assert_array_equal(read(tmp_path / "a.raw", data), SCENE)
    assert bool(open_events(tmp_path / "a.raw").assumptions) == is_swapped


def test_evt4_with_vectors(tmp_path):
    np.testing.assert_array_equal(read(tmp_path / "a.raw", scenes.evt4(SCENE, b"% evt 4.0\n% end\n")), SCENE)


@pytest.mark.parametrize("bit", range(11))
def test_a_flipped_bit_of_time_high_is_no_wrap(tmp_path, bit):
    late = SCENE.copy()
    late["t"] += 1 << 23 | 1 << 22
    events = read(tmp_path / "a.raw", scenes.evt3(late, {300: 1 << bit}))
    np.testing.assert_array_equal(np.delete(events, 300), np.delete(late, 300))


def test_dat_goes_on_when_its_32_bits_wrap(tmp_path):
    late = SCENE.copy()
    late["t"] += (1 << 32) - 10_000
    words = np.empty((600, 2), "<u4")
    words[:, 0] = late["t"] & 0xFFFFFFFF
    words[:, 1] = SCENE["x"] | SCENE["y"].astype("<u4") << 14 | SCENE["p"].astype("<u4") << 28
    np.testing.assert_array_equal(read(tmp_path / "a.dat", b"% Version 2\n\x0c\x08" + words.tobytes()), late)


def test_aedat_2_and_3(tmp_path):
    for data in (scenes.aedat2(SCENE), scenes.aedat2(SCENE, "Davis346red"), scenes.aedat3(SCENE)):
        np.testing.assert_array_equal(read(tmp_path / "a.aedat", data), SCENE)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (scenes.aedat2(SCENE), "2.0 addresses of a DVS128, as they stand, because the header names no chip"),
        (scenes.aedat2(SCENE, "DVS128"), "ON where bit 0 is clear, as jAER has it"),
        (scenes.aedat1(SCENE), "1.0 addresses of a DVS128, as they stand"),
        (scenes.aedat1(SCENE, b"# made by hand\r\n"), "it names no version"),
        (scenes.aedat1(SCENE, b""), "it names no version"),
        (
            scenes.aedat1(SCENE, b"#!AER-DAT1.0\r\n# AEChip: ch.unizh.ini.jaer.DVS128\r\n", is_turned=True),
            "x is mirrored, y from the bottom",
        ),
    ],
)
def test_a_dvs128_is_turned_where_it_is_named_and_that_is_said(tmp_path, data, said):
    np.testing.assert_array_equal(read(tmp_path / "a.aedat", data), SCENE)
    file = open_events(tmp_path / "a.aedat")
    assert any(said in line for line in file.assumptions)
    assert file.declared == (128, 128)


def test_an_address_that_begins_like_a_header_line_is_no_header(tmp_path):
    rows = make_events([5] * 90, [0x23] * 90, [1] * 90, range(10, 100))  # 10 is the end of a line
    for data in (scenes.aedat1(rows), scenes.aedat1(rows, b"")):
        np.testing.assert_array_equal(read(tmp_path / "a.aedat", data), rows)


def test_aedat_1_that_is_something_else_is_refused(tmp_path):
    garbage = np.random.default_rng(1).bytes(6_000)
    with pytest.raises(InputError, match="time goes back"):
        read(tmp_path / "a.aedat", garbage)
    with pytest.raises(InputError, match="hold none of a davis346"):
        read(tmp_path / "a.aedat", b"#!AER-DAT1.0\r\n# AEChip: x.Davis346red\r\n")


class TestEventStream:
    @pytest.mark.parametrize("is_atis", [False, True])
    def test_events_of_both_kinds_in_blocks(self, tmp_path, is_atis):
        n = 230_000  # more than one block
        rng = np.random.default_rng(2)
        t = np.cumsum(rng.choice([0, 1, 62, 63, 126, 127, 128, 400], n))
        events = make_events(rng.integers(0, 64, n), rng.integers(0, 48, n), rng.integers(0, 2, n), t)
        (tmp_path / "a.es").write_bytes(scenes.event_stream(events, is_atis=is_atis))
        batches = [*open_events(tmp_path / "a.es")]
        assert len(batches) > 1
        np.testing.assert_array_equal(np.concatenate(batches), events)
        assert open_events(tmp_path / "a.es").declared == (48, 64)

    def test_an_event_cut_in_two_is_counted(self, tmp_path):
        (tmp_path / "a.es").write_bytes(scenes.event_stream(SCENE)[:-2])
        cut = read_events(tmp_path / "a.es")
        np.testing.assert_array_equal(cut.events, SCENE[:-1])
        assert cut.lost_bytes == 3

    @pytest.mark.parametrize(
        ("change", "match"),
        [
            (lambda data: data[:17], "17 of 20 bytes"),
            (lambda data: data[:12] + b"\x01" + data[13:], r"version 1\.0\.0; only 2"),
            (lambda data: data[:15] + b"\x00" + data[16:], "holds generic events"),
            (lambda data: data[:15] + b"\x63" + data[16:], "events of kind 99"),
            (lambda data: data[:16] + bytes(4) + data[20:], "0 x 0 pixels"),
        ],
    )
    def test_headers_that_cannot_be_used(self, tmp_path, change, match):
        with pytest.raises(InputError, match=match):
            read(tmp_path / "a.es", change(scenes.event_stream(SCENE)))

    def test_an_event_outside_the_sensor_is_counted(self, tmp_path):
        data = scenes.event_stream(SCENE)
        (tmp_path / "a.es").write_bytes(
            data[:18] + b"\x17\x00" + data[20:]
        )  # 23 rows: the upper 25 are not there
        read = read_events(tmp_path / "a.es")
        lower = SCENE[SCENE["y"] >= 25]
        np.testing.assert_array_equal(read.events["y"], lower["y"] - 25)
        np.testing.assert_array_equal(read.events["t"], lower["t"])
        assert read.damage == (f"{len(SCENE) - len(lower)} events outside 64x23 left out",)

    def test_faery_reads_and_writes_the_same(self, tmp_path):
        faery = pytest.importorskip("faery")
        (tmp_path / "a.es").write_bytes(scenes.event_stream(SCENE))
        theirs = np.concatenate([*faery.events_stream_from_file(tmp_path / "a.es")])
        for mine, field in zip("xypt", ("x", "y", "on", "t"), strict=True):
            np.testing.assert_array_equal(theirs[field], SCENE[mine])
        faery.events_stream_from_array(theirs, (64, 48)).to_file(tmp_path / "b.es")
        again = read_events(tmp_path / "b.es").events
        again["t"] += SCENE["t"][0]  # it writes times from 0
        np.testing.assert_array_equal(again, SCENE)


def test_aedat_3_cut_short_keeps_what_came_before(tmp_path):
    data = scenes.aedat3(SCENE)
    for length in range(len(data) - 100, len(data), 7):
        (tmp_path / "a.aedat").write_bytes(data[:length])
        cut = read_events(tmp_path / "a.aedat")
        np.testing.assert_array_equal(cut.events, SCENE[: len(cut.events)])
        assert len(cut.events) > 580
        assert "cut short" in cut.damage[0]


class TestHdf5:
    @pytest.fixture
    def h5py(self):
        return pytest.importorskip("h5py")

    def test_layouts_of_data_sets(self, tmp_path, h5py):
        pytest.importorskip("hdf5plugin")
        with h5py.File(tmp_path / "dsec.h5", "w") as root:
            for name in "xypt":
                root[f"events/{name}"] = SCENE[name].astype("<u4")
            root["t_offset"] = 49_599_300_000
        events = read_events(tmp_path / "dsec.h5").events
        np.testing.assert_array_equal(events["t"], SCENE["t"] + 49_599_300_000)
        with h5py.File(tmp_path / "halves.h5", "w") as root:
            for name in "xyp":
                root[f"events/{name}"] = SCENE[name].astype("<u4")
            root["events/t"], root["t_offset"] = SCENE["t"] + 0.5, 49_599_300_000
        with pytest.raises(InputError, match=r"event 0: t = 100\.5, but must be whole"):
            read_events(tmp_path / "halves.h5")
        with h5py.File(tmp_path / "e2vid.h5", "w") as root:
            root["events/ts"], root["events/ps"] = SCENE["t"] / 1e6, SCENE["p"].astype(bool)
            root["events/xs"], root["events/ys"] = SCENE["x"], SCENE["y"]
            root.attrs["sensor_resolution"] = (48, 64)
        assert open_events(tmp_path / "e2vid.h5").declared == (48, 64)
        with h5py.File(tmp_path / "v2e.h5", "w") as root:
            root["events"] = scenes.table(SCENE, "txyp").astype("<u4")
        with h5py.File(tmp_path / "mvsec.h5", "w") as root:
            for side in ("left", "right"):
                root[f"davis/{side}/events"] = scenes.table(SCENE, "xytp").astype(float)
        for name in ("e2vid.h5", "v2e.h5", "mvsec.h5"):
            np.testing.assert_array_equal(read_events(tmp_path / name).events, SCENE)
        assert "davis/right/events" in open_events(tmp_path / "mvsec.h5").assumptions[0]

    @pytest.mark.parametrize("layout", ["rvt", "m3ed", "columns", "big endian"])
    def test_other_layouts(self, tmp_path, h5py, layout):
        with h5py.File(tmp_path / "a.h5", "w") as root:
            if layout == "m3ed":
                root["prophesee/left/calib/resolution"], root["prophesee/left/ms_map_idx"] = [64, 48], [0, 20]
            elif layout == "rvt":
                root["events/ms_to_idx"], root["events/t_offset"] = np.arange(31) * 20, 0
            folder = "prophesee/left" if layout == "m3ed" else "events"
            for name, column in columns().items():
                column = column.astype("?") if name == "p" else column
                column = column.astype(">i8") if layout == "big endian" else column
                root[f"{folder}/{name}"] = column[:, None] if layout == "columns" else column
        np.testing.assert_array_equal(read_events(tmp_path / "a.h5").events, SCENE)

    @pytest.mark.parametrize("mode", [0, 1, 2])
    def test_ecf_of_prophesee_in_every_packing(self, tmp_path, h5py, mode):
        path = scenes.ecf_file(
            h5py, tmp_path / "a.h5", [scenes.ecf(SCENE[i : i + 250], mode) for i in (0, 250)]
        )
        file = open_events(path)
        np.testing.assert_array_equal(np.concatenate([*file]), SCENE[:500])
        assert (file.declared, file.damage, len([*file])) == ((48, 64), [], 2)

    def test_the_last_chunk_of_ecf_holds_more_than_the_table(self, tmp_path, h5py):
        padded = np.concatenate([SCENE[250:400], np.zeros(100, SCENE.dtype)])  # as the HDF5 library writes it
        chunks = [scenes.ecf(SCENE[:250], 2), scenes.ecf(padded, 2)]
        path = scenes.ecf_file(h5py, tmp_path / "a.h5", chunks, n=400)
        np.testing.assert_array_equal(read_events(path).events, SCENE[:400])

    @pytest.mark.parametrize("cut", [4, 11, 12, 300, 700])
    def test_ecf_that_is_cut_short_keeps_the_chunks_before(self, tmp_path, h5py, cut):
        chunks = [scenes.ecf(SCENE[:250], 1), scenes.ecf(SCENE[250:500], 1)[:cut]]
        cut_short = read_events(scenes.ecf_file(h5py, tmp_path / "a.h5", chunks))
        np.testing.assert_array_equal(cut_short.events, SCENE[:250])
        assert "after event 250 is lost: a chunk of ECF" in cut_short.damage[0]
        with pytest.raises(InputError, match="copy it anew: a chunk of ECF"):
            open_events(scenes.ecf_file(h5py, tmp_path / "b.h5", chunks[::-1]))

    def test_ecf_together_with_another_filter_is_refused(self, tmp_path, h5py):
        path = scenes.ecf_file(h5py, tmp_path / "a.h5", [scenes.ecf(SCENE[:250], 1)], is_shuffled=True)
        with pytest.raises(InputError, match="with this filter alone"):
            open_events(path)

    def test_half_of_the_tables(self, tmp_path, h5py):
        with h5py.File(tmp_path / "a.h5", "w") as root:
            root["events/x"], root["events/y"] = SCENE["x"], SCENE["y"]
        with pytest.raises(InputError, match="events has x, y, but no t, p"):
            open_events(tmp_path / "a.h5")

    def test_several_streams_need_a_choice(self, tmp_path, h5py):
        with h5py.File(tmp_path / "a.h5", "w") as root:
            for camera in ("one", "two", "three"):
                root[f"{camera}/events"] = SCENE
        with pytest.raises(InputError, match=r"3 event streams \(.*--stream"):
            open_events(tmp_path / "a.h5")
        file = open_events(tmp_path / "a.h5", options=TableOptions(stream="two/events"))
        np.testing.assert_array_equal(np.concatenate([*file]), SCENE)


@pytest.mark.parametrize(("ending", "pack"), [("gz", gzip.compress), ("bz2", bz2.compress)])
def test_packed_files_are_unpacked_for_the_while_and_damage_is_counted(tmp_path, ending, pack):
    packed = pack(scenes.text(SCENE, "txyp", ",", "t,x,y,p\n"))
    path = tmp_path / f"a.csv.{ending}"
    path.write_bytes(packed)
    with sf.open_recording(path) as recording:
        np.testing.assert_array_equal(np.concatenate([*recording]), SCENE)
        assert not recording.losses
        assert all(str(path) in line for line in recording.assumptions)
    if ending == "gz":
        path.write_bytes(packed[:-300])
        with sf.open_recording(path) as recording:
            events = np.concatenate([*recording])
            np.testing.assert_array_equal(events, SCENE[: len(events)])
            assert "cannot be unpacked after its byte" in recording.losses.first["damaged file"]
    path.write_bytes(packed[:3])
    with pytest.raises(InputError, match="nothing in it can be unpacked"):
        sf.open_recording(path)


def lived(path, t):
    """A recording of a table with these times, and what its clock did."""
    rows = np.stack([t, np.arange(len(t)) % 16, np.arange(len(t)) % 12, np.arange(len(t)) % 2], axis=1)
    np.save(path, rows)
    with sf.open_recording(path) as recording:
        n = sum(len(batch) for batch in recording)
        return n, recording.duration_us, recording.first_us, dict(recording.counts)


def test_a_clock_that_starts_anew_each_second_is_not_folded_into_one_second(tmp_path):
    t = np.arange(20_000) * 1_000
    assert lived(tmp_path / "a.npy", t % 1_000_000) == (20_000, 20 * 999_000, 0, {"restarts": 19})
    t[12_000:] -= t[12_000]
    assert lived(tmp_path / "b.npy", t) == (20_000, 11_999_000 + 7_999_000, 0, {"restarts": 1})


@pytest.mark.parametrize("where", [1, 5_000, 8_191, 8_192, 8_193, 19_998])
@pytest.mark.parametrize("absurd", [0, 10**13])
def test_one_absurd_time_costs_its_event_alone(tmp_path, where, absurd):
    t = 5_000_000 + np.arange(20_000) * 1_000
    expected = lived(tmp_path / "whole.npy", np.delete(t, where))
    assert expected == (19_999, 19_999_000, 5_000_000, {})
    t[where] = absurd
    n, duration_us, first_us, counts = lived(tmp_path / "a.npy", t)
    assert (n, duration_us, first_us, counts) == (*expected[:3], {"stray events": 1})


@pytest.mark.parametrize(("factor", "unit"), [(1, "microseconds"), (1_000, "nanoseconds")])
def test_a_few_absurd_times_do_not_change_the_unit(tmp_path, factor, unit):
    t = 5_000_000 + np.arange(20_000) * 1_000
    t[15_000:] += 3_600_000_000  # a pause
    t *= factor
    t[[300, 7_000]] = 10**15, 0
    np.save(tmp_path / "a.npy", np.stack([t, t % 16, t % 12, t % 2], axis=1))
    options = TableOptions(columns="t,x,y,p")
    assert any(
        f"times are {unit}" in said for said in open_events(tmp_path / "a.npy", options=options).assumptions
    )


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("a.raw", bytes(100), r"no header says .*cat - a\.raw"),
        ("a.raw", b"% evt 3.0\n% geometry 64x48\n% end\n", r"a\.raw: holds no events"),
        ("a.npy", b"\x93NUMPY\x01\x00", "copy it again"),
    ],
    ids=["no header", "no events", "cut short"],
)
def test_what_cannot_be_read_says_what_to_do(tmp_path, name, data, said):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=said):
        sf.open_recording(tmp_path / name)
