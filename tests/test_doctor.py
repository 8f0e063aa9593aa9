"""What is said of an installation: what is there, what is missing, and when that is a problem."""

import json

import pytest
from test_json import check
from typer.testing import CliRunner

from streamfeat import cli
from streamfeat.cli import installation as doctor

REAL = doctor.requires("streamfeat")


def run(*arguments):
    return CliRunner().invoke(cli.app, ["doctor", *arguments])


@pytest.fixture
def requirements(monkeypatch):
    """Let the package ask for something else, and the work take no second."""

    def ask(*lines):
        examine = doctor.examine
        monkeypatch.setattr(doctor, "requires", lambda name: list(lines))
        monkeypatch.setattr(doctor, "examine", lambda progress: examine(progress, seconds=0.01))

    return ask


def test_a_sound_installation(requirements):
    requirements(*REAL)
    result = run("--json")
    found = json.loads(result.stdout)
    check("doctor", found)
    assert (result.exit_code, found["problems"]) == (0, [])
    assert found["exact"] is True
    assert {"numpy", "numba", "mcap"} <= set(found["required"])
    assert "faery" not in found["required"]
    assert set(doctor.EXTRAS) >= set(found["extras"])
    assert found["threads"]["layer"] in {"tbb", "omp", "workqueue"}
    assert set(found["vectors"]) <= set(found["cpu_features"])
    assert found["kernels"]["digest"] in found["kernels"]["folder"]
    assert found["speed"]["events_per_s"] > 0
    assert found["speed"]["event_us"] > 0
    table = run()
    assert table.exit_code == 0
    assert "all is well" in table.stdout
    assert found["machine"]["python"] in table.stdout
    assert found["kernels"]["digest"] in table.stdout


def test_a_missing_extra_is_no_problem(requirements):
    requirements("numpy<3,>=2", 'no-such-package<2,>=1; extra == "convert"', 'mcap<2,>=1; extra == "plot"')
    found = json.loads(run("--json").stdout)
    assert found["extras"]["convert"]["missing"] == ["no-such-package"]
    assert found["extras"]["plot"]["missing"] == []
    table = run()
    assert table.exit_code == 0
    assert "missing no-such-package; pip install 'streamfeat[convert]'" in " ".join(table.stdout.split())


@pytest.mark.parametrize(
    ("line", "says"),
    [("no-such-package>=1", "no-such-package is missing, wanted >=1"), ("numpy<2,>=1", "wanted <2,>=1")],
)
def test_a_missing_or_outdated_requirement_is_a_problem(requirements, line, says):
    requirements(line)
    result = run("--json")
    assert result.exit_code == 1
    (problem,) = json.loads(result.stdout)["problems"]
    assert says in problem
    table = run()
    assert table.exit_code == 1
    assert says in table.output
    assert "all is well" not in table.output


def test_kernels_that_cannot_be_kept_are_a_problem(requirements, monkeypatch):
    requirements("numpy>=2")
    monkeypatch.setattr(doctor.cache, "folder", lambda: None)
    result = run("--json")
    assert result.exit_code == 1
    assert "set NUMBA_CACHE_DIR" in json.loads(result.stdout)["problems"][0]


@pytest.mark.parametrize(
    ("found", "wanted", "fits"),
    [
        ("2.4.6", "<3,>=2.0", True),
        ("2.0", "<3,>=2.0.0", True),
        ("2", "<3,>=2.0", True),
        ("3.0.0rc1", "<3,>=2.0", False),
        ("1.9.9", "<3,>=2.0", False),
        ("0.10.8", "<0.11,>=0.10.3", True),
        ("0.11.0", "<0.11,>=0.10.3", False),
        ("0.10.2", "<0.11,>=0.10.3", False),
        ("7", "", True),
        ("", ">=1", False),
    ],
)
def test_versions_are_compared_by_number(found, wanted, fits):
    assert doctor._satisfies(found, wanted) == fits
