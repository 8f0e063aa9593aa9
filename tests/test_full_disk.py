"""A disk with no room: one clear line, and nothing half done under the name asked for or beside it."""

import importlib.util
import json
import subprocess
import sys

import pytest
import tiny

from streamfeat.stream.replay import ReplayJob

resource = pytest.importorskip("resource", reason="this system has no limits for files")

ROOM = 2_000
"""Bytes that a file may have: less than any output needs, for a limit is met as a full disk is."""

PROGRAM = """
import contextlib, io, json, resource, sys
from streamfeat.cli import main
room, *commands = json.loads(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
for words in commands:
    sys.argv = ["streamfeat", *words]
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            main()
    except SystemExit as end:
        print(json.dumps([end.code, said.getvalue()]))
"""

OUTPUTS = {
    "out.mcap": ("replay", "-o", None),
    "out.jsonl": ("replay", "--json-lines", None),
    "out.parquet": ("replay", "--table", "pyarrow"),
    "out.arrow": ("replay", "--table", "pyarrow"),
    "view.mcap": ("view", "-o", "foxglove"),
    "layout.json": ("view", "--layout", "foxglove"),
}


def test_no_room(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    model = tiny.encoder()
    model.save(tmp_path / "model")
    tiny.classifier(model).save(tmp_path / "classifier")
    tiny.write_items(tmp_path / "samples.mcap", tiny.labelled_items(6))
    # What is compiled is in the cache then, which cannot be added to where there is no room.
    ReplayJob(tmp_path / "samples.mcap", tmp_path / "model", tmp_path / "classifier", emit="1ms").run()
    common = ["samples.mcap", "-m", "model", "-c", "classifier", "--emit", "1ms"]
    possible = {
        name: [command, *common, option, f"out/{name}"]
        for name, (command, option, needs) in OUTPUTS.items()
        if needs is None or importlib.util.find_spec(needs)
    }
    done = subprocess.run(
        [sys.executable, "-B", "-c", PROGRAM, json.dumps([ROOM, *possible.values()])],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=True,
        timeout=300,
    )
    results = [json.loads(line) for line in done.stdout.splitlines()]
    for (status, said), name in zip(results, possible, strict=True):
        (line,) = said.splitlines()
        assert status == 2, line
        assert line.startswith(f"error: out/{name}")
        assert "cannot be written" in line
    assert done.stderr == ""
    assert list(out.iterdir()) == []
