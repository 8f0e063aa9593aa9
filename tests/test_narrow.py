"""The narrow state: how near its codes are to the mathematics, and that no number of it overflows."""

import naive
import numpy as np
import pytest

from streamfeat.engine.encoder import NARROW_VERSION, WIDE_VERSION, Encoder
from streamfeat.engine.engine import Engine
from streamfeat.engine.geometry import Geometry
from streamfeat.engine.narrow import with_narrow_codes
from streamfeat.engine.random_encoder import random_encoder
from streamfeat.errors import InputError
from streamfeat.events import make_events
from streamfeat.files.safetensors_file import read_safetensors, write_safetensors
from streamfeat.kernels.layout import MOST_CODE

GEOMETRY = Geometry(patch=8, stride=3, n_bins=3, bin_us=1000)
RESOLUTION = (22, 27)


def encoder_of(encoding="split", geometry=GEOMETRY, **parameters):
    return random_encoder(5, geometry, 33, "direct", encoding, threshold=0.3, narrow=True, **parameters)


def events_of(volume, geometry):
    """Events whose counts at the top left are a volume `(n_bins, patch, patch)`, and zero elsewhere."""
    position, row, column = np.nonzero(volume)
    counts = volume[position, row, column].astype(int)
    many = np.abs(counts)
    t = np.repeat(position * geometry.bin_us, many)
    return make_events(
        np.repeat(column, many), np.repeat(row, many), np.repeat(counts > 0, many).astype(int), t
    )


def float_codes(encoder, engine):
    counts = engine.counts().clip(-encoder.geometry.max_count, encoder.geometry.max_count)
    return naive.codes_of(counts, encoder)


def read_codes(encoder, events):
    engine = Engine(encoder, RESOLUTION)
    engine.feed(events)
    engine.advance((encoder.geometry.n_bins - 1) * encoder.geometry.bin_us)
    return engine.codes(), float_codes(encoder, engine)


@pytest.mark.parametrize("encoding", ["soft", "split"])
@pytest.mark.parametrize("n_events", [1, 40, 2000])
def test_codes_are_within_two_thousandths_of_the_largest(encoding, n_events):
    encoder, rng = encoder_of(encoding), np.random.default_rng(n_events)
    height, width = RESOLUTION
    x, y, p = (
        rng.integers(0, width, n_events),
        rng.integers(0, height, n_events),
        rng.integers(0, 2, n_events),
    )
    codes, exact = read_codes(encoder, make_events(x, y, p, rng.integers(0, 3000, n_events)))
    assert encoder.is_narrow
    assert np.abs(codes - exact).max() <= 2e-3 * max(np.abs(exact).max(), 4.0)


@pytest.mark.parametrize("max_count", [1, 2])
def test_the_volume_that_is_worst_for_a_filter_overflows_nothing(max_count):
    geometry = Geometry(patch=6, stride=3, n_bins=3, bin_us=1000, max_count=max_count)
    encoder = encoder_of(geometry=geometry)
    columns = encoder.operator.columns.astype(int)
    assert encoder.is_narrow
    for k in range(encoder.n_filters):
        for sign in (1, -1):
            volume = sign * max_count * np.sign(columns[:, k]).reshape(geometry.n_bins, 6, 6)
            codes, exact = read_codes(encoder, events_of(volume, geometry))
            assert abs(codes[0, 0, k]) > 1
            np.testing.assert_allclose(codes, exact, atol=2e-3 * np.abs(exact).max())


def test_a_projection_fits_into_16_bits_and_a_code_into_its_part_whatever_the_volume():
    for seed in range(20):
        encoder = random_encoder(seed, GEOMETRY, 9, narrow=True, eps=10.0 ** -(seed % 5), whitening=seed / 10)
        operator = with_narrow_codes(encoder.operator, 1)
        columns = operator.columns.astype(np.int64)
        assert np.abs(columns).sum(axis=0).max() < 2**15
        rng = np.random.default_rng(seed)
        for share in (0.01, 0.3, 1.0):
            values = (rng.random((200, len(columns))) < share) * rng.choice([-1, 1], (200, len(columns)))
            values[0], values[1:10] = 1, np.sign(columns.T[:9])
            for volume in values[values.any(1)]:
                moments = np.array([volume.sum(), volume @ volume, 0, 0])
                packed = naive.narrow_gain(moments, operator)
                code = np.zeros(len(operator.upper), np.int64)
                naive.narrow_code(packed, volume @ columns, operator.upper, operator.lower, code)
                assert np.abs(code).max() <= MOST_CODE


@pytest.mark.parametrize(
    ("kind", "geometry", "reason"),
    [
        (("inverse", "soft"), GEOMETRY, "32 bits"),
        (("direct", "triangle"), GEOMETRY, "32 bits"),
        (("direct", "soft"), Geometry(patch=8, stride=3, n_bins=3, bin_us=1000, max_count=100), "1.2 levels"),
        (("direct", "soft"), Geometry(patch=12, stride=3, n_bins=3, bin_us=1000, max_count=9), "off by"),
    ],
)
def test_what_needs_the_wide_state_has_it_and_says_why(kind, geometry, reason, tmp_path):
    narrow, wide = (random_encoder(1, geometry, 5, *kind, narrow=narrow) for narrow in (True, False))
    assert not narrow.is_narrow
    assert reason in narrow.provenance["wide_because"]
    assert narrow.fingerprint == wide.fingerprint
    narrow.save(tmp_path / "model")
    assert read_safetensors(tmp_path / "model", "streamfeat-encoder", WIDE_VERSION)


def test_a_file_of_the_narrow_state_has_a_version_of_its_own_and_comes_back_whole(tmp_path):
    encoder, path = encoder_of(), tmp_path / "model"
    encoder.save(path)
    _, header = read_safetensors(path, "streamfeat-encoder", NARROW_VERSION)
    assert header["version"] == 2
    loaded = Encoder.load(path)
    assert loaded.is_narrow
    assert loaded.fingerprint == encoder.fingerprint
    assert "narrow" in repr(loaded)


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("columns", lambda a: np.minimum(a.astype(int) * 3, 32767).astype(np.int16), r"below 2\^15"),
        ("steps", lambda a: -a, "above zero"),
        ("steps", lambda a: a * np.nan, "above zero"),
        ("steps", lambda a: a[:5], "steps is"),
        ("steps", lambda a: a.astype(np.float32), "steps is"),
    ],
)
def test_a_file_whose_sums_could_overflow_is_refused_with_the_arithmetic(name, damage, message, tmp_path):
    path = tmp_path / "model"
    encoder_of().save(path)
    arrays, header = read_safetensors(path, "streamfeat-encoder", NARROW_VERSION)
    arrays[name] = damage(arrays[name])
    more = {key: value for key, value in header.items() if key not in ("format", "version")}
    write_safetensors(path, "streamfeat-encoder", NARROW_VERSION, arrays, more)
    with pytest.raises(InputError, match=message):
        Encoder.load(path)


def test_so_many_volumes_that_an_int32_cannot_hold_their_codes_are_refused():
    operator = encoder_of().operator
    assert with_narrow_codes(operator, 2**20).gain < with_narrow_codes(operator, 1).gain
    with pytest.raises(InputError, match="the 9000000 codes of a cell"):
        with_narrow_codes(operator, 9_000_000)
