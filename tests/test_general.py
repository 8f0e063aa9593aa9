"""The general model: the file that ships, and every command that takes it for want of another."""

import hashlib
import json

import pytest
import tiny
from typer.testing import CliRunner

import streamfeat as sf
from streamfeat import cli
from streamfeat.shipped.general import GENERAL_MODEL
from streamfeat.stream.models import open_models

SAID = "the general one that ships"


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Labelled digits, and a classifier trained without a word on the model."""
    home = tmp_path_factory.mktemp("home")
    tiny.write_digits(home / "train.mcap", 40, n_held_out=10)
    found = CliRunner().invoke(
        cli.app, ["train", str(home / "train.mcap"), "-o", str(home / "clf"), "--json"]
    )
    assert found.exit_code == 0, found.output
    assert SAID in found.stderr
    assert json.loads(found.stdout)["held_out_accuracy"] > 0.2  # chance is 0.1
    return home


def test_the_file_is_the_one_that_was_made_and_small():
    digest, name = GENERAL_MODEL.with_name("SHA256SUMS").read_text().split()
    assert (hashlib.sha256(GENERAL_MODEL.read_bytes()).hexdigest(), GENERAL_MODEL.name) == (digest, name)
    assert GENERAL_MODEL.stat().st_size < 400_000


def test_the_model_says_where_it_comes_from():
    encoder = sf.general_encoder()
    known = encoder.provenance
    assert known["made_by"] == "tools/make_general_model.py"
    assert known["scenes"]["photographs"] + known["scenes"]["digits"] == known["windows"]
    text = GENERAL_MODEL.with_name("README.md").read_text()
    assert f"{known['volumes']:,} local volumes of {known['windows']:,} simulated scenes" in text
    assert f"seed {known['seed']}" in text
    assert f"{encoder.n_filters} filters of {encoder.geometry.patch}x{encoder.geometry.patch} pixels" in text


def test_no_model_means_the_general_one():
    encoder, classifier = open_models(None, None)
    assert (encoder.fingerprint, classifier) == (sf.general_encoder().fingerprint, None)


def test_replay_takes_it_and_says_so_in_one_line(run, home):
    result = run("replay", home / "train.mcap", "-c", home / "clf", "--split", "test", "--json")
    assert (result.status, result.json["samples"]) == (0, 10)
    assert [line for line in result.err.splitlines() if SAID in line] == result.err.splitlines()
    same = run(
        "replay", home / "train.mcap", "-m", GENERAL_MODEL, "-c", home / "clf", "--split", "test", "--json"
    )
    assert same.err == ""
    assert same.json["accuracy"] == result.json["accuracy"]


def test_latency_takes_it(run, home):
    result = run(
        "latency",
        home / "train.mcap",
        "--emit",
        "1000ev",
        "--seconds",
        "0.05",
        "--limit-events",
        "300",
        "--json",
    )
    assert (result.status, SAID in result.err) == (0, True)


def test_view_shows_its_features_when_asked_to(run, home):
    pytest.importorskip("foxglove")
    view = ["view", home / "train.mcap", "--emit", "50ms", "--json", "-o"]
    alone = run(*view, home / "alone.mcap")
    shown = run(*view, home / "shown.mcap", "--features")
    assert (alone.status, shown.status) == (0, 0)
    assert (SAID in alone.err, SAID in shown.err) == (False, True)
    names = [topics_of(home / name) for name in ("alone.mcap", "shown.mcap")]
    assert names[0] < names[1]


def topics_of(path):
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return {channel.topic for channel in make_reader(file).get_summary().channels.values()}


def test_evaluate_compares_a_model_with_what_is_learned(run, home):
    tiny.encoder(k=3).save(home / "tiny")
    command = [
        "evaluate",
        home / "train.mcap",
        "--method",
        "counts",
        "--method",
        "model",
        "--early-samples",
        "0",
    ]
    command += ["--json", "--quiet"]
    general, given = run(*command), run(*command, "-m", home / "tiny")
    assert [row["features"] for row in general.json["rows"]] == [512, sf.general_encoder().n_features]
    assert given.json["rows"][1]["features"] == tiny.encoder(k=3).n_features
    assert given.json["rows"][1]["setting"]["model"] == str(home / "tiny")
    swept = run(*command, "--sweep", f"model={home / 'tiny'}")
    assert swept.json["rows"][2]["hits"] == given.json["rows"][1]["hits"]


def test_evaluate_refuses_a_model_that_nothing_takes_and_a_state_of_another(run, home, tmp_path):
    tiny.encoder(k=3).save(home / "tiny")
    command = ["evaluate", home / "train.mcap", "--early-samples", "0", "--quiet"]
    refused = run(*command, "-m", home / "tiny", "--method", "counts")
    assert (refused.status, "is for --method model" in refused.err) == (2, True)
    assert run(*command, "-m", home / "missing").status == 2
    part = tmp_path / "result.json.part"
    assert run(*command, "-m", home / "tiny", "-o", tmp_path / "result.json").status == 0
    header = {"format": "streamfeat-evaluate", "models": {}}
    part.write_text(json.dumps(header) + "\n")
    (tmp_path / "result.json").unlink()
    assert "is of a run with other" in run(*command, "-m", home / "tiny", "-o", tmp_path / "result.json").err
