"""Recordings by URL: the same results as from a path, and one line where a store does not give them."""

import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from streamfeat.errors import InputError
from streamfeat.files.locations import StoreLocation, location_of, open_binary, size_of
from streamfeat.recordings.reader import Packet, open_recording
from streamfeat.recordings.writer import recover

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "recordings" / "digits_test.mcap"

fsspec = pytest.importorskip("fsspec", reason="URLs need the extra `store`")


@pytest.fixture
def memory():
    """fsspec's file system in memory, with the recording in it."""
    system = fsspec.filesystem("memory")
    system.pipe("/data/one.mcap", SOURCE.read_bytes())
    yield "memory://data/one.mcap"
    system.store.clear()


def items(source):
    """All that a recording holds, in a form that can be compared."""
    with open_recording(source) as recording:
        found = [
            (item.resolution, item.events.tobytes()) if isinstance(item, Packet) else item
            for item in recording.items()
        ]
        assert not recording.losses
        return found


@pytest.mark.parametrize(
    "text", ["a.mcap", "/data/a.mcap", "C:\\data\\a.mcap", "robot/a::b", "a//b.mcap", "1://x", ":memory:"]
)
def test_a_plain_path_stays_a_path(text):
    assert location_of(text) == Path(text)
    assert location_of(Path(text)) == Path(text)


@pytest.mark.parametrize(
    ("url", "name"),
    [
        ("s3://bucket/folder/a.mcap", "a.mcap"),
        ("simplecache::s3://bucket/folder/a.mcap", "a.mcap"),
        ("zip://in/b.mcap::s3://bucket/a.zip", "b.mcap"),
        ("https://host/a.mcap?X-Amz-Signature=geheim#part", "a.mcap"),
        ("s3://bucket/what?.mcap", "what?.mcap"),
        ("s3://bucket/folder/", "folder"),
    ],
)
def test_a_url_is_a_location_with_the_name_of_its_file(url, name):
    place = location_of(url)
    assert isinstance(place, StoreLocation)
    assert (place.url, place.name, place.suffix) == (url, name, Path(name).suffix)
    assert location_of(place) is place
    assert pickle.loads(pickle.dumps(place)) == place


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("ftp://anna:geheim@host/a.mcap", "ftp://host/a.mcap"),
        ("https://anna:geh@eim@host:80/a@b.mcap", "https://host:80/a@b.mcap"),
        ("https://host/a.mcap?X-Amz-Signature=geheim&b=c", "https://host/a.mcap?..."),
        ("simplecache::https://anna:geheim@host/a.mcap", "simplecache::https://host/a.mcap"),
        ("zip://a.mcap::ftp://anna:geheim@host/a.zip", "zip://a.mcap::ftp://host/a.zip"),
        ("s3://bucket/a@b?.mcap", "s3://bucket/a@b?.mcap"),
    ],
)
def test_what_is_secret_in_a_url_is_not_shown(url, shown):
    assert str(StoreLocation(url)) == shown
    assert repr(StoreLocation(url)) == f"StoreLocation({shown!r})"


def test_errors_do_not_show_what_is_secret(run):
    # Nobody listens on port 1.
    for url in ("http://anna:geheim@127.0.0.1:1/a.mcap?sig=geheim", "ftp://anna:geheim@127.0.0.1:1/a.mcap"):
        done = run("info", url)
        assert done.status == 2
        assert "geheim" not in done.out + done.err
        assert done.err.startswith(f"error: {StoreLocation(url)}: ")
        assert "Traceback" not in done.err
        assert done.err.count("\n") == 1


def test_every_kind_of_url_gives_what_the_path_gives(memory, tmp_path):
    expected = items(SOURCE)
    shutil.make_archive(str(tmp_path / "a"), "zip", SOURCE.parent, SOURCE.name)
    for url in (
        SOURCE.as_uri(),
        memory,
        f"simplecache::{memory}",
        f"zip://{SOURCE.name}::file://{tmp_path}/a.zip",
    ):
        assert items(url) == expected
        assert size_of(StoreLocation(url)) == SOURCE.stat().st_size


def test_two_who_read_one_file_do_not_move_each_other(memory):
    with open_recording(memory) as one, open_recording(memory) as other:
        for left, right in zip(one, other, strict=True):
            assert np.array_equal(left, right)


def test_any_part_of_a_stored_file_can_be_read(memory):
    data = SOURCE.read_bytes()
    with open_binary(StoreLocation(memory)) as file:
        assert file.read(8) == data[:8]
        assert file.seek(-8, 2) == len(data) - 8
        assert file.read() == data[-8:]
        assert file.read(1) == b""
        file.seek(100)
        file.seek(10, 1)
        assert (file.read(0), file.read(20), file.tell()) == (b"", data[110:130], 130)


def test_a_file_that_becomes_shorter_is_an_error_and_no_shorter_recording(tmp_path):
    copy = shutil.copy(SOURCE, tmp_path / "a.mcap")
    with open_recording(copy.as_uri()) as recording:
        with copy.open("rb+") as file:
            file.truncate(SOURCE.stat().st_size // 2)
        with pytest.raises(InputError, match=r"file://.*a.mcap: byte \d+: the store gave \d+ of \d+ bytes"):
            list(recording)


@pytest.mark.parametrize(
    ("url", "what"),
    [
        ("memory://nowhere/a.mcap", "there is no such file; check the name"),
        ("file:///nowhere/a.mcap", "there is no such file; check the name"),
        ("nokind://a/b.mcap", "no such kind of URL: Protocol not known: nokind"),
        ("simplecache::nokind://a/b.mcap", "no such kind of URL"),
    ],
)
def test_what_cannot_be_opened_is_one_line(run, url, what):
    done = run("info", url)
    assert done.status == 2
    assert done.err.startswith(f"error: {url}: {what}")
    assert done.err.count("\n") == 1


@pytest.mark.parametrize("missing", ["fsspec", "s3fs"])
def test_a_missing_package_is_named_with_the_extra_that_has_it(missing):
    code = f"import sys; sys.modules[{missing!r}] = None; import streamfeat; streamfeat.open_recording('s3://a/b.mcap')"
    done = subprocess.run(
        [sys.executable, "-c", code], check=False, timeout=100, capture_output=True, text=True
    )
    *_, line = done.stderr.splitlines()
    assert line.startswith("streamfeat.errors.InputError: s3://a/b.mcap: ")
    assert missing in line
    assert line.endswith("; pip install 'streamfeat[store]'")


def test_a_path_does_not_wait_for_fsspec():
    code = (
        "import sys, streamfeat, streamfeat.cli\n"
        f"with streamfeat.open_recording({str(SOURCE)!r}) as recording: list(recording)\n"
        "sys.exit('fsspec' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=100).returncode == 0


def test_info_of_a_url_is_that_of_the_path(run, memory):
    done = run("info", memory, "--json")
    assert (done.status, done.err) == (0, "")
    expected = run("info", SOURCE, "--json").json
    assert done.json == expected | {"file": memory}


def test_a_recording_is_recovered_from_a_url(memory, tmp_path):
    assert not recover(memory, tmp_path / "out.mcap")
    assert items(tmp_path / "out.mcap") == items(SOURCE)
