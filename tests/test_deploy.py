"""What ships for systemd and Kubernetes: taken by their validators, and by the command that they start."""

import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import zenoh
from typer.main import get_command

from streamfeat.cli.live import app
from streamfeat.live.health import parse_address
from streamfeat.live.shard import Shard

DEPLOY = Path(__file__).resolve().parents[1] / "tools" / "deploy"
UNIT = DEPLOY / "streamfeat-listen@.service"
MANIFEST = DEPLOY / "kubernetes.yaml"


def arguments(words):
    """What `streamfeat` understands by these words, which is not run."""
    command = get_command(app).commands[words[0]]
    return command.make_context(words[0], words[1:]).params


def unit_words(index, environment):
    """The words of ExecStart as systemd makes them."""
    (line,) = re.findall(r"^ExecStart=(.*)$", UNIT.read_text(), re.MULTILINE)
    words = []
    for word in line.replace("%i", str(index)).split():
        if word.startswith("$") and not word.startswith("${"):  # becomes several, or none
            words += environment[word[1:]].split()
        else:
            words.append(re.sub(r"\$\{(\w+)\}", lambda found: environment[found[1]], word))
    return words


def test_the_unit_starts_a_share_of_its_own():
    lines = re.findall(r"^#   ([A-Z]+)=(.*)$", UNIT.read_text(), re.MULTILINE)
    environment = dict(lines) | {"STATE_DIRECTORY": "/var/lib/streamfeat/2"}
    assert set(environment) == {"SHARDS", "CAMERAS", "MODEL", "OPTIONS", "STATE_DIRECTORY"}
    program, *words = unit_words(2, environment)
    assert program.endswith("/streamfeat")
    given = arguments(words)
    assert Shard.parse(given["shard"]) == Shard(2, 3)
    assert given["key"] == "robot/*/events"
    assert given["state"] == Path("/var/lib/streamfeat/2/state")
    assert parse_address(given["metrics"]) == ("127.0.0.1", 9472)
    assert (given["classifier"], given["zenoh_config"]) == (
        Path("/etc/streamfeat/classifier.safetensors"),
        Path("/etc/streamfeat/zenoh.json5"),
    )


def verify(path):
    found = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", "--recursive-errors=no", path],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    return found.returncode, found.stderr


def test_systemd_takes_the_unit(tmp_path):
    if not shutil.which("systemd-analyze"):
        pytest.skip("systemd-analyze is not installed")
    # As an instance, with a program that is there.
    text = UNIT.read_text().replace("/opt/streamfeat/bin/streamfeat", sys.executable)
    instance = tmp_path / "streamfeat-listen@0.service"
    instance.write_text(text)
    code, said = verify(instance)
    if "Failed to initialize manager" in said:
        pytest.skip(f"systemd-analyze does not run here: {said.strip()}")
    assert (code, said) == (0, "")
    # It would have said so.
    instance.write_text(text.replace("Restart=always", "Restart=allways\nRestrat=always"))
    _, said = verify(instance)
    assert "allways" in said
    assert "Restrat" in said


@pytest.fixture(scope="module")
def objects():
    yaml = pytest.importorskip("yaml", reason="the extra `test` is not installed")
    return {one["kind"]: one for one in yaml.safe_load_all(MANIFEST.read_text())}


@pytest.mark.parametrize("version", ["1.32", "1.35"])
def test_kubernetes_takes_the_manifest(objects, version):
    kubernetes_validate = pytest.importorskip(
        "kubernetes_validate", reason="the extra `test` is not installed"
    )
    for one in objects.values():
        with warnings.catch_warnings(action="ignore"):
            kubernetes_validate.validate(one, version, strict=True)
    # It would have said so.
    wrong = objects["StatefulSet"] | {"spec": objects["StatefulSet"]["spec"] | {"replica": 3}}
    with pytest.raises(kubernetes_validate.ValidationError, match="replica"):
        kubernetes_validate.validate(wrong, version, strict=True)


def test_the_manifest_fits_together_and_the_command(objects, tmp_path):
    stateful = objects["StatefulSet"]["spec"]
    pod = stateful["template"]
    (container,) = pod["spec"]["containers"]
    environment = {one["name"]: one.get("value") for one in container["env"]}
    # Kubernetes numbers pods from 0 to replicas - 1, and so are shares.
    assert int(environment["SHARDS"]) == stateful["replicas"]
    assert set(environment) >= set(re.findall(r"\$\((\w+)\)", " ".join(container["args"])))
    environment["SHARD"] = str(stateful["replicas"] - 1)
    words = [re.sub(r"\$\((\w+)\)", lambda found: environment[found[1]], word) for word in container["args"]]
    given = arguments(words)
    assert Shard.parse(given["shard"]) == Shard(2, 3)
    assert container["ports"][0]["containerPort"] == parse_address(given["metrics"])[1]
    assert int(pod["metadata"]["annotations"]["prometheus.io/port"]) == parse_address(given["metrics"])[1]
    # What is written lies on the claim, what is read in the config map.
    mounts = {one["name"]: Path(one["mountPath"]) for one in container["volumeMounts"]}
    assert [one["metadata"]["name"] for one in stateful["volumeClaimTemplates"]] == ["state"]
    assert mounts["state"] in given["state"].parents
    assert mounts["state"] in Path(environment["NUMBA_CACHE_DIR"]).parents
    assert given["zenoh_config"].parent == mounts["zenoh"]
    assert pod["spec"]["volumes"] == [{"name": "zenoh", "configMap": {"name": "streamfeat-zenoh"}}]
    assert objects["ConfigMap"]["metadata"]["name"] == "streamfeat-zenoh"
    labels = pod["metadata"]["labels"]
    assert labels == stateful["selector"]["matchLabels"] == objects["Service"]["spec"]["selector"]
    assert stateful["serviceName"] == objects["Service"]["metadata"]["name"]
    # zenoh takes its configuration.
    config = tmp_path / given["zenoh_config"].name
    config.write_text(objects["ConfigMap"]["data"][config.name])
    read = zenoh.Config.from_file(str(config))
    assert read.get_json("mode") == '"client"'
    assert read.get_json("connect/endpoints") == '["tcp/zenoh-router:7447"]'
