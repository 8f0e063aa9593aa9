"""Short reprs, and HTML for notebooks."""

import base64
import io
import re

import numpy as np
import pytest
import tiny

import streamfeat as sf
from streamfeat.classify.kernel import train_kernel_classifier
from streamfeat.report.notebook import mosaic, png

MODEL = tiny.encoder(k=5)


def things(tmp_path):
    engine = sf.Engine(MODEL, tiny.RESOLUTION)
    yield MODEL, ["direct", "split", "5 filters of 2x4x4", "100 ms", "40 features"]
    yield engine, ["16x12", "0 events"]
    fed = sf.Engine(MODEL, tiny.RESOLUTION)
    fed.feed(tiny.steady(0, 90_000, 500))
    yield fed, ["16x12", "500 events", "40 features"]
    with sf.open_recording(tiny.write_items(tmp_path / "<in>.mcap", tiny.labelled_items(2))) as recording:
        yield recording, ["<in>.mcap", "/events", "16x12"]
    yield tiny.classifier(MODEL, [f"<b>{i}" for i in range(9)]), ["9 labels", "40 features"]
    rows = np.abs(np.random.default_rng(0).standard_normal((20, 40))).astype(np.float32)
    linear = tiny.classifier(MODEL, ["a", "b"])
    yield train_kernel_classifier(rows, linear, np.array(["a", "b"] * 10)), ["2 labels"]


def test_reprs_are_one_short_line_and_html_is_safe(tmp_path):
    for thing, words in things(tmp_path):
        line, html = repr(thing), thing._repr_html_()
        assert len(line) < 300
        assert line.startswith(f"{type(thing).__name__}(")
        assert "\n" not in line
        assert all(word in line for word in words), line
        assert len(html) < 50_000
        assert "<b>0" not in html
        assert "<in>" not in html


def test_the_picture_of_an_encoder_is_that_of_its_filters():
    image = pytest.importorskip("PIL.Image")
    (data,) = re.findall(r'src="data:image/png;base64,([^"]+)"', MODEL._repr_html_())
    found = np.array(image.open(io.BytesIO(base64.b64decode(data))))
    first = MODEL.filters[0].reshape(2, 4, 4)
    expected = np.round(127.5 + 127.5 * np.hstack(list(first)) / np.abs(first).max())
    assert np.array_equal(found[:4, :8], expected.astype(np.uint8))


@pytest.mark.parametrize(("n", "h", "w"), [(1, 1, 1), (5, 3, 9), (64, 12, 36), (3, 7, 2)])
def test_a_mosaic_holds_every_image_once(n, h, w):
    images = np.arange(1, n + 1)[:, None, None] * np.ones((n, h, w))
    found = mosaic(images)
    assert np.count_nonzero(found == 255) == found.size  # each is its own largest
    found = mosaic(-images)
    assert np.count_nonzero(found == 0) == n * h * w
    assert mosaic(np.zeros((n, h, w))).min() == 128
    assert png(found).startswith(b"\x89PNG")


def test_a_kind_of_engine_is_shown_as_an_engine():
    class Watched(sf.Engine):
        pass

    assert repr(Watched(MODEL, tiny.RESOLUTION)).startswith("Watched(16x12")


def test_an_emission_is_one_line():
    session = sf.Session(MODEL, sf.EmitPolicy.parse("10ms"), tiny.classifier(MODEL))
    (first, *_) = session.process(tiny.packet(tiny.steady(0, 15_000, 100)))
    assert re.fullmatch(r"Emission\(10,000 us, \d+ events, 40 features, '(cat|dog|owl)'\)", repr(first))
