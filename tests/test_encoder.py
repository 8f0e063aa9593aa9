"""Models: made, saved, loaded, quantised as finely as promised, and refused in one line if not right."""

import dataclasses
import json
from pathlib import Path

import naive
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file
from streams import KINDS, LASSO_KINDS, random_encoder, random_events

from streamfeat.engine.encoder import Encoder
from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.operator import with_fixed_point
from streamfeat.engine.window import count_window
from streamfeat.errors import InputError
from streamfeat.files import safetensors_file as safe_arrays
from streamfeat.kernels.layout import TRIANGLE

ids = "-".join

GEOMETRY = Geometry(patch=3, stride=2, n_bins=2, bin_us=1000, max_count=2)
RESOLUTION = (9, 12)
EVENTS = random_events(np.random.default_rng(1), GEOMETRY, RESOLUTION, 150, n_windows=1)


def known_encoder(kind=("direct", "soft"), **parameters):
    return random_encoder(np.random.default_rng(0), GEOMETRY, 5, *kind, **parameters)


def refused(function, *arguments, match=None, **parameters):
    """The one line that says why."""
    with pytest.raises(InputError, match=match) as error:
        function(*arguments, **parameters)
    message = str(error.value)
    assert "\n" not in message
    assert len(message) > 15
    return message


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "model.safetensors"
    known_encoder().save(path)
    return path


def rewrite(path, arrays=None, header=None, text=None):
    """Change some arrays (None takes one away) and header fields of a saved model."""
    stored = load_file(path) | (arrays or {})
    with safe_arrays.safe_open(path, framework="numpy") as file:
        old = json.loads(file.metadata()["streamfeat"])
    new = json.dumps(old | (header or {})) if text is None else text
    save_file({k: v for k, v in stored.items() if v is not None}, path, metadata={"streamfeat": new})


# There and back


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_a_saved_model_is_the_same_model(kind, tmp_path):
    encoder = known_encoder(kind, provenance={"seed": 3, "data": ["a", "b"]})
    path = tmp_path / "model.safetensors"
    encoder.save(path)
    loaded = Encoder.load(str(path))
    assert loaded.fingerprint == encoder.fingerprint
    assert (loaded.geometry, loaded.formulation, loaded.encoding) == (GEOMETRY, *kind)
    assert loaded.threshold == encoder.threshold
    assert loaded.provenance == encoder.provenance
    for name, mine in encoder.operator._asdict().items():
        np.testing.assert_array_equal(getattr(loaded.operator, name), mine, err_msg=name)
    for name in ("filters", "whitening", "mean"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(encoder, name), strict=True)
    features = encoder.encode(EVENTS, RESOLUTION)
    assert features.any()
    np.testing.assert_array_equal(loaded.encode(EVENTS, RESOLUTION), features, strict=True)


def test_saving_twice_gives_the_same_bytes(saved):
    first = saved.read_bytes()
    Encoder.load(saved).save(saved)
    assert saved.read_bytes() == first


def test_the_fingerprint_tells_models_apart():
    encoder = known_encoder()
    others = [
        known_encoder(("direct", "split")),
        known_encoder(("inverse", "soft")),
        known_encoder(threshold=0.11),
        known_encoder(eps=0.02),
        random_encoder(np.random.default_rng(0), dataclasses.replace(GEOMETRY, bin_us=1001), 5),
        random_encoder(np.random.default_rng(2), GEOMETRY, 5),
    ]
    assert len({e.fingerprint for e in (encoder, *others)}) == 1 + len(others)
    assert known_encoder(provenance={"a": 1}).fingerprint == encoder.fingerprint


def test_a_model_cannot_be_changed():
    encoder = known_encoder(("inverse", "soft"))
    for array in (encoder.filters, encoder.operator.columns, encoder.operator.gram):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_build_leaves_its_arguments_alone():
    d = GEOMETRY.entries
    arrays = {"filters": np.eye(d, dtype=np.float32), "whitening": np.eye(d), "mean": np.zeros(d)}
    before = {name: array.copy() for name, array in arrays.items()}
    encoder = Encoder.build(GEOMETRY, formulation="direct", encoding="soft", threshold=0.1, **arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, before[name])
        array[0] = 7
    assert encoder.filters[0, 0] == 1


# Quantisation


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_the_operator_is_within_half_a_step_of_what_it_stands_for(kind):
    encoder = known_encoder(kind)
    operator, d, k = encoder.operator, GEOMETRY.entries, 5
    centring = np.eye(d) - 1 / d
    whitening = encoder.whitening.astype(np.float64)
    exact = encoder.filters.astype(np.float64) @ whitening @ centring
    columns = operator.columns.astype(np.float64) * operator.scale
    assert np.abs(columns[:, :k].T - exact).max() <= operator.scale / 2 * (1 + 1e-9)
    assert not operator.columns[:, k:].any()
    assert np.abs(operator.columns).max() == 2**15 - 1
    if operator.quadratic.size:
        form = centring @ whitening.T @ whitening @ centring
        assert np.abs(operator.quadratic * operator.quadratic_scale - form).max() <= operator.quadratic_scale
        row = (whitening @ encoder.mean) @ whitening @ centring
        assert np.abs(operator.linear * operator.linear_scale - row).max() <= operator.linear_scale
        assert operator.constant == pytest.approx(np.square(whitening @ encoder.mean).sum())


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_volumes_of_one_entry_have_nothing_but_a_mean(kind):
    """One entry less its mean is zero: nothing is left to project, whatever the count."""
    geometry = Geometry(patch=1, stride=1, n_bins=1, bin_us=10)
    encoder = random_encoder(np.random.default_rng(0), geometry, 3, *kind)
    assert not encoder.operator.columns.any()
    events = EVENTS[:5]
    assert np.isfinite(encoder.encode(events, RESOLUTION)).all()


# The fixed point


def test_the_unit_is_the_largest_power_of_two_that_fits():
    operator = known_encoder().operator._replace(largest=5000.0)
    # 5 x 6 volumes: at most 3 x 3 share a sum, 45000 together. 2^15 x 45000 = 1474560000 < 2^31 - 1.
    pooling = with_fixed_point(operator, (5, 6))
    assert pooling.unit == 2.0**15
    np.testing.assert_array_equal(pooling.offset, operator.offset * np.float32(2**15), strict=True)
    assert pooling.threshold == operator.threshold * 2**15
    assert not pooling.offset.flags.writeable
    assert operator.unit == 1.0
    assert with_fixed_point(operator, (1, 1)).unit == 2.0**16  # never finer
    assert with_fixed_point(operator._replace(largest=1e-9), (1, 1)).unit == 2.0**16


def test_no_pooled_sum_can_overflow_and_no_bit_is_given_away():
    rng = np.random.default_rng(4)
    operator = known_encoder().operator
    for _ in range(200):
        rows, columns = (int(side) for side in rng.integers(1, 60, 2))
        largest = float(10 ** rng.uniform(-2, 3.5))
        unit = with_fixed_point(operator._replace(largest=largest), (rows, columns)).unit
        volumes = ((rows + 1) // 2) * ((columns + 1) // 2)
        assert unit * largest * volumes <= 2**31 - 1
        assert unit == 2.0**16 or 2 * unit * max(largest, 1.0) * volumes > 2**31 - 1
        assert unit >= 2.0**8
        assert np.log2(unit).is_integer()


def test_fewer_than_eight_bits_are_refused_with_the_arithmetic():
    operator = known_encoder().operator
    most = (2**31 - 1) / 2**8 / 9
    assert with_fixed_point(operator._replace(largest=0.999 * most), (5, 6)).unit == 2.0**8
    message = refused(with_fixed_point, operator._replace(largest=1.001 * most), (5, 6))
    assert f"could reach {1.001 * most:.4g} x 9 volumes of a cell" in message
    assert "leaves 7 bits behind the point of an int32, 8 are needed; raise the stride" in message
    assert "leaves -3 bits" in refused(with_fixed_point, operator._replace(largest=2.0**30), (5, 6))
    for largest in (float("inf"), float("nan")):
        refused(with_fixed_point, operator._replace(largest=largest), (5, 6))


def test_a_sensor_of_too_many_volumes_is_refused():
    encoder = build(filters=3e4 * np.eye(D)[:5], threshold=1.0)
    build_engine = lambda side: Engine(encoder, (side, side))  # noqa: E731
    assert build_engine(8)._operator.unit >= 2.0**8
    for make in (build_engine, lambda side: encoder.encode(EVENTS, (side, side))):
        assert "volumes of a cell" in refused(make, 400)


def extreme_volumes(rng, operator, geometry):
    """Volumes that reach as far as volumes can: all at the limit, one, half, along a filter."""
    limit, d = geometry.max_count, geometry.entries
    yield from limit * np.eye(d, dtype=np.int64)
    yield np.full(d, limit)
    yield np.full(d, -limit)
    nearly = np.full(d, limit)
    nearly[0] = limit - 1
    yield nearly
    for k in range(operator.n_filters):
        along = operator.columns[:, k].astype(np.int64)
        yield limit * np.sign(along)
        yield -limit * np.sign(along)
        yield np.rint(limit * along / max(np.abs(along).max(), 1)).astype(np.int64)
    for _ in range(40):
        yield rng.integers(-limit, limit + 1, d) * (rng.random(d) < rng.random())
    for _ in range(20):
        yield np.where(rng.random(d) < rng.random(), limit, -limit)


@pytest.mark.parametrize("max_count", [1, 200])
@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_no_code_and_no_number_on_the_way_to_it_exceeds_the_largest(kind, max_count):
    geometry = dataclasses.replace(GEOMETRY, max_count=max_count)
    rng = np.random.default_rng(6)
    reached = 0.0
    for eps in (1e-6, 0.01):
        encoder = random_encoder(rng, geometry, 5, *kind, eps=eps, threshold=0.02)
        operator, square = encoder.operator, 0.0
        assert 1 <= operator.largest < np.inf
        for values in extreme_volumes(rng, operator, geometry):
            if not values.any():
                continue
            projection, moments = naive.sums_of(values, operator)
            sigma = naive.deviation(moments, geometry.entries, eps)
            numbers = np.abs(naive._scores(projection, sigma, operator)).max()
            if operator.quadratic.size:
                square = naive.whitened_square(moments, sigma, operator._replace(reach=1e9))
                assert square <= operator.reach**2 * (1 + 1e-6)
            if operator.kind == TRIANGLE:
                z = naive._scores(projection, sigma, operator)[:5]
                numbers = max(numbers, np.sqrt(max((square - 2 * z + operator.square_norms[:5]).max(), 0)))
            if operator.inverse:
                kept = np.zeros((2, 5))
                naive.lasso_code(projection, sigma, square, operator, kept, None, None, None)
                numbers = max(numbers, np.abs(kept[0]).max())
            assert numbers <= operator.largest * (1 + 1e-6)
            reached = max(reached, numbers / operator.largest)
    if kind not in LASSO_KINDS and max_count == 1:
        assert reached > 0.2  # no bits are wasted


# What cannot be built

D = GEOMETRY.entries


def build(geometry=GEOMETRY, **parameters):
    fields = {
        "formulation": "direct",
        "encoding": "soft",
        "threshold": 0.1,
        "filters": np.eye(D)[:5],
        "whitening": np.eye(D),
        "mean": np.zeros(D),
    }
    return Encoder.build(geometry, **(fields | parameters))


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ({"formulation": "forward"}, "formulation is 'forward', it must be 'direct' or 'inverse'"),
        ({"encoding": "hard"}, "encoding is 'hard', it must be one of soft, split, triangle"),
        ({"threshold": -0.1}, "threshold is -0.1"),
        ({"threshold": float("nan")}, "threshold is nan"),
        ({"threshold": float("inf")}, "threshold is inf"),
        ({"threshold": 0.0, "formulation": "inverse"}, "threshold is 0.0"),
        ({"threshold": 1e36}, "threshold is 1e"),
        ({"threshold": 1e36, "formulation": "inverse"}, "threshold is 1e"),
        ({"filters": np.zeros((5, D + 1))}, r"filters have shape \(5, 19\), expected \(K, 18\)"),
        ({"filters": np.zeros((0, D))}, "filters have shape"),
        ({"filters": np.zeros(D)}, "filters have shape"),
        ({"whitening": np.eye(D + 1)}, r"whitening has shape \(19, 19\), expected \(18, 18\)"),
        ({"mean": np.zeros((D, 1))}, "mean has shape"),
        ({"filters": np.full((5, D), np.nan)}, "filters must be finite"),
        ({"whitening": np.full((D, D), np.inf)}, "whitening must be finite"),
        ({"mean": np.full(D, np.nan)}, "mean must be finite"),
        ({"eps": 0.0}, "eps, scale and gap"),
        ({"eps": float("nan")}, "eps, scale and gap"),
        ({"eps": float("inf")}, "eps, scale and gap"),
        ({"gap": 0.0}, "eps, scale and gap"),
        ({"gap": 1.0}, "eps, scale and gap"),
        ({"filters": 1e7 * np.eye(D)}, "code could reach"),
        ({"filters": 1e30 * np.eye(D)}, "finite|squared length|code could reach"),
        ({"filters": 1e30 * np.eye(D), "formulation": "inverse"}, "finite|squared|code could reach"),
        ({"whitening": 1e30 * np.eye(D), "encoding": "triangle"}, "whitening must be finite"),
        ({"mean": np.full(D, 1e30)}, "mean must be finite"),
        ({"mean": np.full(D, 1e7)}, "code could reach"),
        (
            {name: np.full((D, D)[: 1 + (name != "mean")], 1e8) for name in ("filters", "whitening", "mean")},
            "code could reach",
        ),
    ],
)
def test_what_is_no_encoder_is_refused(parameters, says):
    refused(build, match=says, **parameters)


def test_a_column_that_cannot_be_negated_is_refused(saved):
    """A count that goes down takes its column away: -32768 has no negative in int16."""
    columns = load_file(saved)["columns"].copy()
    columns[0, 0] = -(2**15)
    rewrite(saved, {"columns": columns})
    assert "columns must lie between -32767 and 32767" in refused(Encoder.load, saved)


def test_an_integer_that_could_overflow_is_refused_with_the_arithmetic():
    geometry = dataclasses.replace(GEOMETRY, max_count=16_000)
    filters = np.tile([1.0, -1.0], (5, D // 2))
    message = refused(build, geometry, filters=filters)
    assert f"max_count 16000 x {D * 32767}" in message
    assert f"= {16_000 * D * 32767}, which is not below 2^31; lower max_count" in message
    largest = (2**31 - 1) // (D * 32767)
    build(dataclasses.replace(GEOMETRY, max_count=largest), filters=filters)
    refused(build, dataclasses.replace(GEOMETRY, max_count=largest + 1), filters=filters)


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(Geometry)])
@pytest.mark.parametrize("value", [0, -1, 2**41, 1.0, "3", None, True])
def test_a_geometry_out_of_range_is_refused(name, value):
    if (name, value) == ("volume_bins", None):
        return  # as long as the window
    message = refused(Geometry, **{name: value})
    assert name in message


# What cannot be loaded


def test_a_missing_file_is_refused(tmp_path):
    assert "no such file" in refused(Encoder.load, tmp_path / "nothing.safetensors")


def test_a_folder_is_refused(tmp_path):
    refused(Encoder.load, tmp_path)


def test_a_file_cut_short_anywhere_is_refused(saved):
    whole = saved.read_bytes()
    for size in [0, 1, 7, 8, 9, 100, len(whole) // 2, len(whole) - 1]:
        saved.write_bytes(whole[:size])
        assert str(saved) in refused(Encoder.load, saved)
    saved.write_bytes(whole + b"\0")
    refused(Encoder.load, saved)


def test_random_bytes_are_refused(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "model.safetensors"
    for size in (8, 64, 4096):
        for _ in range(10):
            path.write_bytes(rng.bytes(size))
            refused(Encoder.load, path)
            path.write_bytes(size.to_bytes(8, "little") + rng.bytes(size))
            refused(Encoder.load, path)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        (name, change)
        for name in ("filters", "whitening", "mean", "columns", "offset", "square_norms")
        for change in ("missing", "short", "wide", "float64", "int8")
    ]
    + [(name, "nan") for name in ("filters", "whitening", "mean", "offset", "square_norms")],
)
def test_arrays_of_another_shape_or_kind_are_refused(saved, name, change):
    array = load_file(saved)[name]
    nan = np.full(array.shape, np.nan, np.float32)
    to = {
        "missing": lambda: None,
        "short": lambda: array[:-1].copy(),
        "wide": lambda: array[..., None].copy(),
        "float64": lambda: array.astype(np.float64),
        "int8": lambda: array.astype(np.int8),
        "nan": lambda: nan,
    }
    rewrite(saved, {name: to[change]()})
    message = refused(Encoder.load, saved)
    assert str(saved) in message
    assert name in message


HUGE = 10**400  # an integer in JSON, and no float


def short(value):
    return ascii(value)[:60]


@pytest.mark.parametrize(
    "header",
    [
        {"format": "something-else"},
        {"format": None},
        {"version": 4},
        {"version": "1\n2"},
        {"geometry": None},
        {"geometry": []},
        {"geometry": {"patch": 3}},
        {"geometry": dataclasses.asdict(GEOMETRY) | {"more": 1}},
        {"geometry": dataclasses.asdict(GEOMETRY) | {"max_count": 30_000}},
        {"geometry": dataclasses.asdict(GEOMETRY) | {"max_count": True}},
        {"geometry": dataclasses.asdict(GEOMETRY) | {"n_bins": HUGE}},
        {"geometry": dataclasses.asdict(GEOMETRY) | {"n_bins": "2\n"}},
        {"formulation": 3},
        {"formulation": ["direct"]},
        {"encoding": {}},
        {"encoding": "triangle"},
        {"encoding": "soft\nhard"},
        {"threshold": "much"},
        {"threshold": None},
        {"threshold": HUGE},
        {"threshold": 1e300},
        {"threshold": float("nan")},
        {"scalars": None},
        {"scalars": {}},
        {"scalars": {"scale": 1.0}},
        {"provenance": 3},
    ],
    ids=short,
)
def test_a_header_that_is_not_right_is_refused(saved, header):
    rewrite(saved, header=header)
    assert str(saved) in refused(Encoder.load, saved)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf"), HUGE, None, "one", [1]], ids=short)
@pytest.mark.parametrize("name", ["scale", "eps", "quadratic_scale", "linear_scale", "constant", "gap"])
def test_a_scalar_that_is_not_right_is_refused(tmp_path, name, value):
    saved = tmp_path / "model.safetensors"
    known_encoder(("direct", "triangle")).save(saved)
    with safe_arrays.safe_open(saved, framework="numpy") as file:
        scalars = json.loads(file.metadata()["streamfeat"])["scalars"]
    rewrite(saved, header={"scalars": scalars | {name: value}})
    if name == "constant" and value == 0.0:
        Encoder.load(saved)  # a mean of zero
    else:
        assert str(saved) in refused(Encoder.load, saved)


@pytest.mark.parametrize("text", ["", "{", "3", "null", "[]", '"text"', "[" * 10**5, "9" * 5000])
def test_a_header_that_is_no_json_object_is_refused(saved, text):
    rewrite(saved, text=text)
    assert str(saved) in refused(Encoder.load, saved)


def test_a_safetensors_file_of_something_else_is_refused(tmp_path):
    path = tmp_path / "weights.safetensors"
    save_file({"weights": np.zeros(3)}, path)
    assert "not a streamfeat-encoder file" in refused(Encoder.load, path)


def test_atoms_too_long_for_their_inner_products_are_refused(tmp_path):
    saved = tmp_path / "model.safetensors"
    known_encoder(("inverse", "soft")).save(saved)
    filters = load_file(saved)["filters"]
    filters[0, 0] = 1e30  # finite, its square is not
    rewrite(saved, {"filters": filters})
    refused(Encoder.load, saved)


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_a_model_with_damaged_bytes_is_refused_or_runs(kind, tmp_path):
    path = tmp_path / "model.safetensors"
    known_encoder(kind, gap=1e-3).save(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    outcomes = {"refused": 0, "runs": 0}
    for _ in range(40):
        damaged = bytearray(whole)
        # Half of the damage is in the header, most bytes are in the arrays.
        end = 8 + int.from_bytes(whole[:8], "little") if rng.random() < 0.5 else len(whole)
        for place in rng.integers(0, end, rng.integers(1, 4)):
            damaged[place] ^= 1 << rng.integers(0, 8)
        path.write_bytes(damaged)
        try:
            encoder = Encoder.load(path)
            engine = Engine(encoder, RESOLUTION)
        except InputError as error:
            outcomes["refused"] += "\n" not in str(error)
            continue
        engine.feed(EVENTS)
        features = engine.features()
        engine.feed(EVENTS[:20])
        assert engine.features().shape == features.shape == (encoder.n_features,)
        assert np.isfinite(features).all()
        outcomes["runs"] += 1
    assert sum(outcomes.values()) == 40
    assert min(outcomes.values()) > 3


# Files appear whole or not at all


def only(folder):
    return [path.name for path in folder.iterdir()]


def test_a_failed_save_leaves_the_earlier_model(saved, monkeypatch):
    before = saved.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("streamfeat.files.atomic.os.fsync", full)
    with pytest.raises(InputError, match="No space left"):
        known_encoder(("direct", "split")).save(saved)
    assert saved.read_bytes() == before
    assert only(saved.parent) == [saved.name]


def test_what_no_json_can_hold_leaves_the_earlier_model(saved):
    before = saved.read_bytes()
    with pytest.raises(TypeError):
        known_encoder(provenance={"when": object()}).save(saved)
    assert saved.read_bytes() == before
    assert only(saved.parent) == [saved.name]


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    target = tmp_path / "no" / "model.safetensors"
    assert "cannot write there" in refused(known_encoder().save, Path(target))


@pytest.mark.parametrize("seed", range(5))
def test_counts_of_a_window_are_those_that_are_counted_one_by_one(seed):
    """More events than a count holds, of either polarity, and events that are not of the window."""
    geometry = Geometry(patch=2, stride=1, n_bins=3, bin_us=100, downsample=2, max_count=2)
    events = random_events(np.random.default_rng(seed), geometry, (6, 8), 400)
    counts = count_window(geometry, events, (6, 8), origin_us=-50, t_us=140)
    np.testing.assert_array_equal(counts, naive.window_counts(events, geometry, (6, 8), -50, 140))
    assert (counts.min(), counts.max()) == (-2, 2)
