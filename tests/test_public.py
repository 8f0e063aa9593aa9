"""What `import streamfeat` offers: each name described, its example run."""

import ast
import asyncio
import doctest
import inspect
import time
from pathlib import Path

import pytest
import tiny

import streamfeat as sf

NAMES = [
    name for name in sf.__all__ if inspect.isclass(getattr(sf, name)) or inspect.isfunction(getattr(sf, name))
]
NEW = ["Emission", "EmitPolicy", "EventFeatures", "Pipeline", "Session", "learn_encoder", "listen", "replay"]
NEW += ["general_encoder"]


@pytest.mark.parametrize("name", NAMES)
def test_a_public_name_is_described(name):
    assert inspect.getdoc(getattr(sf, name))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("examples")
    items = tiny.labelled_items(6, names=("7", "8"), events=2000)
    tiny.write_items(folder / "digits.mcap", items)
    model = tiny.encoder(k=3)
    model.save(folder / "model")
    tiny.classifier(model, ["7", "8", "9"]).save(folder / "classifier")
    return folder


@pytest.mark.parametrize("name", NEW)
def test_the_example_of_a_public_name_runs(name, folder, monkeypatch):
    """As it stands in the docstring; only `listen`, which would go on for ever, is compiled and not run."""
    monkeypatch.chdir(folder)
    examples = doctest.DocTestParser().get_examples(inspect.getdoc(getattr(sf, name)))
    assert examples
    session = sf.Session(sf.Encoder.load("model"), sf.EmitPolicy.parse("10ms"))
    (first, *_) = session.process(tiny.packet(tiny.steady(0, 20_000, 200)))
    known = {
        "sf": sf,
        "asyncio": asyncio,
        "time": time,
        "encoder": sf.Encoder.load("model"),
        "emission": first,
        "EventFeatures": sf.EventFeatures,
        "events": tiny.steady(0, 90_000, 300, resolution=(34, 34)),
        "more_events": tiny.steady(0, 50_000, 100, resolution=(34, 34)),
    }
    for example in examples:
        source = example.source
        ast.parse(source)
        if name == "listen" and "asyncio.run" in source:
            continue
        if name == "learn_encoder":
            source = source.replace("patch=10", "patch=4").replace("volumes=4000", "volumes=400")
        value = run(source, known)
        if example.want and name in ("EmitPolicy", "Pipeline", "general_encoder"):
            assert value == example.want
    if name == "learn_encoder":
        assert sf.Encoder.load(Path("model.safetensors")).n_filters == 64


def run(source, known):
    import contextlib
    import io

    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(compile(source, "example", "single"), known)
    return said.getvalue()


def test_learning_takes_paths_and_open_recordings_and_refuses_the_rest(folder):
    options = {"patch": 4, "filters": 6, "volumes": 300, "iterations": 1, "bins": 2}
    by_path = sf.learn_encoder(folder / "digits.mcap", **options)
    with sf.open_recording(folder / "digits.mcap") as recording:
        opened = sf.learn_encoder([recording], **options)
        assert len(list(recording)) > 0
    assert by_path.fingerprint == opened.fingerprint
    with pytest.raises(sf.InputError, match="no setting 'patches'"):
        sf.learn_encoder(folder / "digits.mcap", patches=3)
    with pytest.raises(sf.InputError, match="at least one recording"):
        sf.learn_encoder([])
    with pytest.raises(sf.InputError, match="no preset"):
        sf.learn_encoder(folder / "digits.mcap", preset="best")


def test_the_page_of_the_room_shows_programs_that_run(monkeypatch, capsys):
    root = Path(__file__).parents[1]
    page = (root / "streamfeat" / "stream" / "README.md").read_text()
    first, second = (part.split("```")[0] for part in page.split("```python\n")[1:])
    monkeypatch.chdir(root)
    known = {}
    exec(compile(first, "page", "exec"), known)
    said = capsys.readouterr().out.splitlines()
    assert len(said) == known["asyncio"].run(counted(known)) + 1
    assert said[-1].startswith("StreamStats(")
    known |= {"encoder": sf.Encoder.load("recordings/digits.safetensors"), "classifier": None}
    exec(compile(second.replace("drive.mcap", "recordings/digits_test.mcap"), "page", "exec"), known)
    asyncio.run(known["main"]())
    assert capsys.readouterr().out.splitlines()[-1] == "done"


async def counted(known):
    with sf.open_recording("recordings/digits_test.mcap") as recording:
        return len(recording.labels)
