"""JSON of unknown origin: each value is of its type and inside its bounds, or it is one clear line."""

import pytest

from streamfeat.errors import InputError
from streamfeat.files.json_fields import Fields


@pytest.mark.parametrize(
    ("values", "take"),
    [
        ({"a": True}, lambda f: f.whole("a")),
        ({"a": 1.0}, lambda f: f.whole("a")),
        ({"a": -1}, lambda f: f.whole("a")),
        ({"a": 9}, lambda f: f.whole("a", 0, 8)),
        ({"a": 1}, lambda f: f.flag("a")),
        ({"a": "abcd"}, lambda f: f.text("a", 3)),
        ({"a": [1, 2, 3]}, lambda f: f.wholes("a", 2)),
        ({"a": [1, True]}, lambda f: f.wholes("a", 2)),
        ({"a": [{}, {}]}, lambda f: f.inners("a", 1)),
        ({"a": 1}, lambda f: f.inner("a")),
        ({}, lambda f: f.whole("a")),
    ],
)
def test_what_is_not_of_its_type_or_bounds_is_one_line(values, take):
    with pytest.raises(InputError, match=r"^file") as error:
        take(Fields(values, "file"))
    assert "\n" not in str(error.value)


def test_what_is_inside_its_bounds_is_given():
    fields = Fields({"a": 8, "b": [0, 2], "c": "abc", "d": False, "e": None}, "file")
    assert fields.whole("a", 0, 8) == 8
    assert fields.wholes("b", 2) == [0, 2]
    assert fields.text("c", 3) == "abc"
    assert fields.flag("d") is False
    assert fields.maybe("e") is None
