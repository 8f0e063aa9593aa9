"""What --json prints: every field of every command, of the type that the page of the commands says."""

import inspect
import json
from pathlib import Path

import numpy as np
import pytest
import tiny
from live_net import free_port

import streamfeat.cli as commands
from streamfeat.cli.rendering import as_markdown, complete, for_people
from streamfeat.cli.results import RESULTS, Field

PAGE = Path(commands.__file__).parent / "README.md"
BEGIN, END = "<!-- fields:", "<!-- end of fields -->"
KINDS = {"text": str, "int": int, "number": (int, float), "bool": bool, "object": dict}


def is_of(kind, value):
    """Whether a value is of a kind, such as `[int]` or `number?`."""
    if kind.endswith("?"):
        return value is None or is_of(kind[:-1], value)
    if kind[0] == "[":
        return isinstance(value, list) and all(is_of(kind[1:-1], one) for one in value)
    if kind[0] == "{":
        return isinstance(value, dict) and all(is_of(kind[1:-1], one) for one in value.values())
    return isinstance(value, KINDS[kind]) and (kind == "bool" or not isinstance(value, bool))


def check(command, said):
    """Hold a result to the fields of its command."""
    assert list(said) == list(RESULTS[command])
    wrong = {name: value for name, value in said.items() if not is_of(RESULTS[command][name].kind, value)}
    assert not wrong


def with_fields(page):
    """The page with the fields as they are now."""
    before, rest = page.split(BEGIN)
    remark, after = rest.split("\n", 1)[0], rest.split(END)[1]
    return f"{before}{BEGIN}{remark}\n{as_markdown()}{END}{after}"


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    folder = tmp_path_factory.mktemp("json")
    tiny.write_digits(folder / "train.mcap", 40, n_held_out=10)
    tiny.encoder().save(folder / "model")
    tiny.classifier(tiny.encoder(), labels=tuple("0123456789")).save(folder / "clf")
    events = tiny.steady(0, 900_000, 3_000)
    tiny.write_items(folder / "plain.mcap", [tiny.packet(part) for part in np.array_split(events, 9)])
    return folder


LEARN = ["--patch", 6, "--stride", 6, "--bins", 2, "--filters", 6, "--volumes", 300, "--iterations", 2]
EVALUATE = ["--method", "counts", "--early-samples", 0]
LATENCY = ["--emit", "10ms", "--seconds", 0.1, "--limit-events", 300, "--warm-up", 50]
CALLS = {
    "info": ["info", "train.mcap"],
    "info REC REC": ["info", "train.mcap", "plain.mcap"],
    "info without labels": ["info", "plain.mcap"],
    "info without noise": ["info", "plain.mcap", "--refractory", "5ms"],
    "convert": ["convert", "plain.mcap", "out.csv"],
    "learn": ["learn", "train.mcap", "-o", "m.safetensors", *LEARN],
    "train": ["train", "train.mcap", "-m", "model", "-o", "c.safetensors", "--folds", 2],
    "replay": ["replay", "train.mcap", "-m", "model", "-c", "clf"],
    "replay alone": ["replay", "plain.mcap", "-m", "model", "--isolated", "1ms"],
    "latency": ["latency", "plain.mcap", "-m", "model", *LATENCY],
    "evaluate": ["evaluate", "train.mcap", *EVALUATE],
    "recover": ["recover", "plain.mcap", "whole.mcap"],
    "topics": ["topics", "--seconds", 0],
    "publish": ["publish", "plain.mcap", "cam/events", "--speed", "max", "--wait", 0],
}


@pytest.mark.parametrize("call", CALLS)
def test_a_command_prints_its_fields(run, home, tmp_path, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    words = [home / word if (home / str(word)).is_file() else word for word in CALLS[call]]
    words += ["--port", free_port()] if call in ("topics", "publish") else []
    result = run(*words, "--json")
    assert result.status == 0, result.err
    assert result.out.count("\n") == 1
    check(call if call in RESULTS else call.partition(" ")[0], result.json)


def test_a_data_set_folder_and_a_recording_have_the_same_fields(run, tmp_path):
    for name in ("a", "b"):
        (tmp_path / "set" / name).mkdir(parents=True)
        lines = ["t_us,x,y,p", *(f"{t * 100},{t % 16},{t % 12},{t % 2}" for t in range(300))]
        (tmp_path / "set" / name / "one.csv").write_text("\n".join(lines))
    result = run("convert", tmp_path / "set", tmp_path / "out.mcap", "--json")
    assert result.status == 0, result.err
    check("convert", result.json)
    assert (result.json["samples"], result.json["labels"]) == (2, None)


def test_view_prints_its_fields(run, home, tmp_path):
    pytest.importorskip("foxglove", reason="the extra `view` is not installed")
    for model in ([], ["-m", home / "model"]):
        result = run(
            "view", home / "plain.mcap", *model, "-o", tmp_path / "out.mcap", "--overwrite", "--json"
        )
        check("view", result.json)


def test_all_fields_are_there_and_none_is_lost():
    said = complete("info", {"new": 1, "resolution": [260, 346]})
    assert list(said) == [*RESULTS["info"], "new"]
    assert (said["topics"], said["unread"], said["first_us"], said["new"]) == ([], {}, None, 1)


def test_people_see_what_says_something():
    fields = RESULTS["info"] | {"late": Field("int", "late")}
    rows = for_people(
        {
            "resolution": [260, 346],
            "events": 571266,
            "late": 0,
            "restarts": 0,
            "jumps": 2,
            "labels": [],
            "splits": ["test", "train"],
            "first_us": None,
            "removed": {"refractory": 1200, "isolated": 0},
        },
        fields,
    )
    assert rows == [
        ("resolution", "346x260"),
        ("events", "571,266"),
        ("late", "0"),
        ("jumps", "2"),
        ("splits", "test, train"),
        ("taken out", "refractory 1,200, isolated 0"),
    ]


def test_a_camera_file_has_a_format_and_no_messages():
    topics = [{"name": "/events", "schema": "evt3", "schema_encoding": "", "messages": 0}]
    assert for_people({"topics": topics}, RESULTS["info"]) == [("topics", "/events (evt3)")]
    topics[0] |= {"schema": "dvs_msgs/msg/EventArray", "schema_encoding": "ros2msg"}
    assert for_people({"topics": topics}, RESULTS["info"])[0][1].endswith("EventArray, 0 messages)")


def test_every_command_with_json_has_its_fields_on_the_page():
    with_json = {
        command.callback.__name__
        for command in commands.app.registered_commands
        if "as_json" in inspect.signature(command.callback).parameters
    }
    assert with_json == {name.partition(" ")[0] for name in RESULTS}
    assert PAGE.read_text() == with_fields(PAGE.read_text()), "run python tests/test_json.py"


if __name__ == "__main__":
    PAGE.write_text(with_fields(PAGE.read_text()))
    print(json.dumps({command: len(fields) for command, fields in RESULTS.items()}))
