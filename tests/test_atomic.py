"""Whole files or none, and only one's own leftovers are removed."""

import pytest

from streamfeat.files.atomic import replacing, sweep


def test_a_block_that_fails_leaves_what_was_there(tmp_path):
    path = tmp_path / "a"
    path.write_text("before")
    with pytest.raises(RuntimeError), replacing(path) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise RuntimeError
    assert [other.name for other in tmp_path.iterdir()] == ["a"]
    assert path.read_text() == "before"


def test_leftovers_of_another_file_stay(tmp_path):
    """What a killed writer leaves is named after its target; that of a neighbour may still be written."""
    for name in ("a", "b"):
        with pytest.raises(KeyboardInterrupt), replacing(tmp_path / name) as temporary:  # noqa: PT012
            left = tmp_path / temporary.name
            keep = left.with_name(left.name)
            raise KeyboardInterrupt
        keep.write_text("left by a writer that was killed")
    sweep(tmp_path / "a")
    (stays,) = tmp_path.iterdir()
    assert stays.name.startswith(".b.")
