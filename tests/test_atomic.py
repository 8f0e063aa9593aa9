"""Whole files or none, and only one's own leftovers are removed."""

import pytest

from streamfeat.files import atomic
from streamfeat.files.atomic import sweep, write_atomically


def test_writing_that_fails_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_text("before")

    def fail(descriptor):
        raise RuntimeError

    monkeypatch.setattr(atomic.os, "fsync", fail)
    with pytest.raises(RuntimeError):
        write_atomically(path, b"half")
    assert [other.name for other in tmp_path.iterdir()] == ["a"]
    assert path.read_text() == "before"


def test_leftovers_of_another_file_stay(tmp_path, monkeypatch):
    """What a killed writer leaves is named after its target; that of a neighbour may still be written."""
    names = []
    monkeypatch.setattr(atomic.os, "fsync", lambda _: names.extend(one.name for one in tmp_path.iterdir()))
    for name in ("a", "b"):
        write_atomically(tmp_path / name, b"")
        (tmp_path / name).unlink()
    for name in names:
        (tmp_path / name).write_text("left by a writer that was killed")
    assert len(names) == 2
    sweep(tmp_path / "a")
    (stays,) = tmp_path.iterdir()
    assert stays.name.startswith(".b.")
