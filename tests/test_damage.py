"""Damage: a few of what `python tests/torture --only damage` does by the thousand."""

import random

import pytest
from torture.damage import flipped, make_specimen, try_damage


@pytest.fixture(scope="module", params=["libcaer_cmp", "evt3"])
def specimen(request, tmp_path_factory):
    return make_specimen(tmp_path_factory.mktemp("specimen"), request.param, n_samples=3)


def test_cut_short(specimen, tmp_path):
    rng = random.Random(1)
    for length in (0, 7, 8, len(specimen.data) - 1, *(rng.randrange(len(specimen.data)) for _ in range(8))):
        try_damage(specimen, specimen.data[:length], tmp_path)


def test_a_bit_flipped(specimen, tmp_path):
    rng = random.Random(2)
    for _ in range(8):
        at = rng.randrange(len(specimen.data))
        try_damage(specimen, flipped(specimen.data, at, rng.randrange(8)), tmp_path)


def test_a_bit_flipped_in_the_head_of_a_record(specimen, tmp_path):
    rng = random.Random(3)
    try_damage(specimen, flipped(specimen.data, 5, 0), tmp_path)  # the version
    for _ in range(12):
        at = rng.choice(specimen.frames)
        try_damage(specimen, flipped(specimen.data, at, rng.randrange(8)), tmp_path)


def test_what_is_promised_is_looked_for(specimen, tmp_path):
    """A file with other content where nothing is damaged is noticed."""
    chunk = specimen.chunks[2]
    without = specimen.data[: chunk.start] + specimen.data[chunk.end :]
    other = type(specimen)(**{name: getattr(specimen, name) for name in specimen.__dataclass_fields__})
    other.data = without
    other.chunks = [type(chunk)(0, 0, chunk.messages)]
    with pytest.raises(AssertionError):
        try_damage(other, without, tmp_path)
