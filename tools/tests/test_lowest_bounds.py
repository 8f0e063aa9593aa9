"""The lowest versions: one lower and one upper bound each, the same wherever a dependency is named."""

import re

import pytest

from tools import lowest_bounds


@pytest.fixture
def project(tmp_path, monkeypatch):
    def write(*lines, extra=()):
        path = tmp_path / "pyproject.toml"
        path.write_text(
            f"[project]\ndependencies = {list(lines)}\noptional-dependencies = {{ x = {list(extra)} }}\n"
        )
        monkeypatch.setattr(lowest_bounds, "PROJECT", path)

    return write


def test_lower_bounds_are_found(project):
    project("one-two>=1.10.0,<2", "three[some]>=2025.12,<2027", extra=["one-two>=1.10.0,<3"])
    assert lowest_bounds.lowest() == {"one-two": "1.10.0", "three": "2025.12"}


@pytest.mark.parametrize(
    ("line", "extra"),
    [("a>=1", ()), ("a<2", ()), ("a", ()), ("a==1", ()), ("a>1,<2", ()), ("a>=1,<2", ["a>=1.1,<2"])],
)
def test_other_bounds_are_refused(project, line, extra):
    project(line, extra=extra)
    with pytest.raises(ValueError, match=re.escape(extra[0] if extra else line)):
        lowest_bounds.lowest()


def test_the_bounds_of_this_project_are_of_that_kind():
    assert {"numpy", "numba", "packaging"} <= lowest_bounds.lowest().keys()
