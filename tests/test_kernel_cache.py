"""Compiled kernels on disk: never of earlier sources, kept wherever that is possible, and bounded."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import streamfeat

PACKAGE = Path(streamfeat.__file__).parent

CALLEE = """
from streamfeat.kernels.compiled import kernel

@kernel
def callee(x):
    return x + {}
"""

CALLER = """
from streamfeat.kernels.callee import callee
from streamfeat.kernels.compiled import kernel

@kernel
def caller(x):
    return 10 * callee(x)
"""

RUN = """
import json, sys
from streamfeat.kernels import cache
from streamfeat.kernels.caller import caller
results = [caller(eval(x)) for x in sys.argv[1:] or ["1"]]
folder = cache.folder()
print(json.dumps({"results": results, "hits": sum(caller.stats.cache_hits.values()), "digest": cache.digest(),
                  "folder": folder and str(folder), "given": caller.stats.cache_path}))
"""


@pytest.fixture
def copy(tmp_path):
    """The kernels of this package in a folder of their own, and two more: one calls the other."""
    package = tmp_path / "copy" / "streamfeat"
    shutil.copytree(PACKAGE / "kernels", package / "kernels", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("__init__.py", "events.py", "errors.py"):
        shutil.copy(PACKAGE / name, package)
    (package / "kernels" / "callee.py").write_text(CALLEE.format(1))
    (package / "kernels" / "caller.py").write_text(CALLER)
    return package


def run(package, *arguments, **environment):
    """What a process of its own says that runs the kernel; it must print nothing else."""
    cleared = {"NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "NUMBA_BOUNDSCHECK", "NUMBA_DISABLE_JIT"}
    done = subprocess.run(
        [sys.executable, "-B", "-c", RUN, *arguments],
        env={k: v for k, v in os.environ.items() if k not in cleared}
        | {"PYTHONPATH": str(package.parent)}
        | {name: str(value) for name, value in environment.items()},
        capture_output=True,
        text=True,
        cwd=package.parent,
        timeout=200,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads(done.stdout)


def test_a_caller_has_the_callee_as_it_is_now(copy):
    first, again = run(copy), run(copy)
    assert [(r["results"], r["hits"]) for r in (first, again)] == [([20], 0), ([20], 1)]
    (copy / "kernels" / "callee.py").write_text(CALLEE.format(2))
    edited = run(copy)
    assert (edited["results"], edited["hits"]) == ([30], 0)
    assert edited["digest"] != first["digest"]
    (copy / "kernels" / "callee.py").write_text(CALLEE.format(1))
    assert run(copy) == again  # as when branches are switched


@pytest.mark.parametrize("changed", ["kernels/layout.py", "events.py"])
def test_every_source_counts(copy, changed):
    before = run(copy)["digest"]
    with (copy / changed).open("a") as file:
        file.write("\n# changed\n")
    assert run(copy)["digest"] != before


def test_settings_that_change_machine_code_count(copy):
    assert run(copy, NUMBA_BOUNDSCHECK=1)["folder"] != run(copy)["folder"]


def test_types_have_files_of_their_own(copy):
    """Numbers that several processes give at once could name one file for two types (numba #4807)."""
    for x in ("1", "1.0", "True"):
        run(copy, x)
    names = {path.stem for path in (copy / "kernels" / "__pycache__").glob("kernels-*/caller.caller*.nbi")}
    assert len(names) == 3
    assert run(copy, "1", "1.0", "True")["hits"] == 3


def test_folders_of_earlier_sources_are_removed(copy):
    parent = copy / "kernels" / "__pycache__"
    for i in range(6):
        (parent / f"kernels-{i:016x}").mkdir(parents=True)
        os.utime(parent / f"kernels-{i:016x}", (i, i))
    (parent / "kernels-notes").mkdir()
    last = Path(run(copy)["folder"])
    names = {f"kernels-{i:016x}" for i in (3, 4, 5)}
    assert {path.name for path in parent.iterdir()} == {*names, last.name, "kernels-notes"}


def test_a_damaged_cache_is_compiled_again(copy):
    folder = Path(run(copy)["folder"])
    for cut in (0, 20):
        for path in folder.iterdir():
            path.write_bytes(path.read_bytes()[:cut])
        assert run(copy)["results"] == [20]
        assert run(copy)["hits"] == 1  # and is whole again


def test_the_folder_that_is_asked_for_is_used(copy, tmp_path):
    found = run(copy, NUMBA_CACHE_DIR=tmp_path / "mine")
    assert Path(found["folder"]).parent == tmp_path / "mine"
    assert found["given"] == found["folder"]


def nowhere_in_tree(copy):
    """A file stands where the folder would be made; permissions would not keep root out."""
    (copy / "kernels" / "__pycache__").write_bytes(b"")


def test_an_installation_that_is_read_only_uses_the_users_cache(copy, tmp_path):
    nowhere_in_tree(copy)
    (tmp_path / "home").mkdir()
    found = run(copy, HOME=tmp_path / "home")
    assert Path(found["folder"]).parent == tmp_path / "home" / ".cache" / "streamfeat"
    assert run(copy, HOME=tmp_path / "home")["hits"] == 1


def test_without_a_home_a_private_temporary_folder_is_used(copy, tmp_path):
    nowhere_in_tree(copy)
    (tmp_path / "tmp").mkdir()
    without = {"HOME": "/dev/null", "TMPDIR": tmp_path / "tmp"}
    (parent,) = {Path(run(copy, **without)["folder"]).parent for _ in range(2)}
    assert parent.parent == tmp_path / "tmp"
    assert re.fullmatch(r"streamfeat(-\d+)?", parent.name)
    if hasattr(os, "getuid"):
        assert parent.stat().st_mode & 0o077 == 0
    assert run(copy, **without)["hits"] == 1


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="temporary folders are private here")
def test_a_temporary_folder_that_others_can_write_to_is_not_believed(copy, tmp_path):
    """What lies in it would be run."""
    nowhere_in_tree(copy)
    theirs = tmp_path / "tmp" / f"streamfeat-{os.getuid()}"
    theirs.mkdir(parents=True)
    theirs.chmod(0o777)
    found = run(copy, HOME="/dev/null", TMPDIR=tmp_path / "tmp")
    assert (found["results"], found["folder"], found["given"]) == ([20], None, None)
    assert list(theirs.iterdir()) == []
