"""Images of MNIST for the recorded digits of N-MNIST: which image belongs to which recording."""

import json

import numpy as np
import pytest
from PIL import Image

from tools.mnist_pairs import SIDE, images_of, recorded_of, write_pairs


@pytest.fixture
def data(tmp_path):
    """Digits of which the grey value says which they are, and recordings 1 to 40 of 0, 1, ..., 9, 0, ..."""
    digits, samples = tmp_path / "digits", tmp_path / "Train"
    digits.mkdir()
    for digit in range(10):
        values = np.repeat([(10 * digit + k) / 255 for k in range(7)], SIDE**2)
        (digits / f"{digit}.json").write_text(json.dumps({"data": values.round(4).tolist()}))
        (samples / str(digit)).mkdir(parents=True)
        for k in range(4):
            (samples / str(digit) / f"{10 * k + digit + 1:05d}.bin").write_bytes(bytes([digit, k]))
    return digits, samples


def test_each_recording_of_the_earlier_half_has_its_image(data, tmp_path):
    out = tmp_path / "pairs"
    counted = write_pairs(*data, out, 2)
    assert counted == {"recorded_first": 20, "recorded_second": 20, "images_first": 20, "images_others": 20}
    assert (out / "recorded_first/7/00018.bin").read_bytes() == bytes([7, 1])
    assert (out / "recorded_second/7/00028.bin").read_bytes() == bytes([7, 2])
    assert np.asarray(Image.open(out / "images_first/7/00018.png")).tolist() == [[255 - 71] * SIDE] * SIDE
    others = sorted((out / "images_others/7").iterdir())
    assert sorted(int(np.asarray(Image.open(path))[0, 0]) for path in others) == [255 - 75, 255 - 74]


def test_where_a_number_is_missing_ranks_say_nothing(data):
    digits, samples = data
    assert images_of(digits, 3).shape == (7, SIDE, SIDE)
    (samples / "3/00004.bin").unlink()
    with pytest.raises(ValueError, match="without a gap"):
        recorded_of(samples)
