"""Input from stores over real HTTP: an S3 server, and web servers that refuse, break off or know no parts."""

import contextlib
import http.server
import re
import threading

import pytest
import tiny
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from test_datasets import bin40_bytes, put, sample_events
from test_places import SOURCE, items

from streamfeat.convert.datasets import convert
from streamfeat.engine.encoder import Encoder
from streamfeat.errors import InputError
from streamfeat.evaluate.plan import plan_cells
from streamfeat.evaluate.run import evaluate
from streamfeat.evaluate.splits import DataSet
from streamfeat.files import locations as places
from streamfeat.files.locations import StoreLocation, size_of
from streamfeat.recordings.reader import open_recording

s3fs = pytest.importorskip("s3fs", reason="stores need the extra `store`")
moto = pytest.importorskip("moto.server", reason="an S3 server comes with the extra `test`")
moto_settings = pytest.importorskip("moto.settings")

SECRET = "geheim"
DATA = SOURCE.read_bytes()
FEW = ["--patch", 4, "--bins", 2, "--filters", 12, "--volumes", 600, "--iterations", 2]
CLOCKS = re.compile("seconds|second|_s$|_ms$|_us$|per_s|peak|latency")


class S3Server:
    """A server with one recording, of which this process hears as everybody would."""

    def __init__(self, patch, bucket):
        self._server, self._bucket = moto.ThreadedMotoServer("127.0.0.1", 0, verbose=False), bucket
        self._server.start()
        host, port = self._server.get_host_and_port()
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "anybody")
        patch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        patch.setenv("AWS_MAX_ATTEMPTS", "1")
        s3fs.S3FileSystem.clear_instance_cache()  # of one that was told of another server
        self._files = s3fs.S3FileSystem()
        self._files.mkdir(bucket)
        self.url = self.put(SOURCE)

    def put(self, path):
        """Put a file or folder into the store, and give its URL."""
        url = f"s3://{self._bucket}/a folder/{path.name}"
        self._files.put(str(path), url, recursive=path.is_dir())
        return url

    def stop(self):
        self._server.stop()
        s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture(scope="module")
def store():
    with pytest.MonkeyPatch.context() as patch:
        server = S3Server(patch, "lab")
        yield server
        server.stop()


@pytest.fixture
def refuse(monkeypatch):
    """Have the server ask for credentials that it knows, which are none, from now on."""
    return lambda: monkeypatch.setattr(moto_settings, "INITIAL_NO_AUTH_ACTION_COUNT", 0)


@pytest.fixture
def small_blocks(monkeypatch):
    """Blocks that are much smaller than a recording, so that reading it needs the store until the end."""
    monkeypatch.setattr(places, "_BLOCK_BYTES", 1 << 16)


@pytest.fixture(scope="module")
def digits(tmp_path_factory):
    """Simulated digits, the first twelve of them held out."""
    return tiny.write_digits(tmp_path_factory.mktemp("digits") / "digits.mcap", 60, n_held_out=12)


def is_one_line(error, url):
    return error.startswith(f"error: {url}: ") and error.count("\n") == 1 and SECRET not in error


def test_a_recording_in_s3_is_the_same(store, small_blocks):
    assert items(store.url) == items(SOURCE)
    assert size_of(StoreLocation(store.url)) == SOURCE.stat().st_size
    assert items(f"simplecache::{store.url}") == items(SOURCE)


def test_info_learn_and_replay_give_the_same_from_s3(store, digits, run, tmp_path):
    url = store.put(digits)
    found = []
    for source in (digits, url):
        model, lines = tmp_path / f"{len(found)}.safetensors", tmp_path / f"{len(found)}.jsonl"
        assert run("learn", source, "-o", model, *FEW).status == 0
        done = run(
            "replay", source, "-m", model, "--emit", "10ms", "--json-lines", lines, "--features", "--json"
        )
        assert done.status == 0
        result = {name: value for name, value in done.json.items() if not CLOCKS.search(name)}
        info = run("info", source, "--json").json | {"file": ""}
        encoder = Encoder.load(model)
        found.append((info, encoder.fingerprint, encoder.provenance["recordings"], result, lines.read_text()))
    assert found[0] == found[1]


def test_an_evaluation_that_was_begun_from_s3_goes_on_from_a_copy(store, digits, tmp_path, monkeypatch):
    cells = plan_cells(["counts"], {}, [], 1)
    state = tmp_path / "state"
    begun = evaluate(
        DataSet([StoreLocation(store.put(digits))], None, 5, 0), cells, early_samples=0, state=state
    )
    monkeypatch.setattr("streamfeat.evaluate.run.run_cells", None)  # all is done
    after = evaluate(DataSet([digits], None, 5, 0), cells, early_samples=0, state=state)
    assert begun == after
    assert begun["recordings"] == [digits.name]


def test_a_data_set_in_s3_is_converted_as_one_in_a_folder(store, tmp_path):
    folder = tmp_path / "n-mnist_train"
    for i in range(4):
        put(folder / f"{i % 2}" / f"{i}.bin", bin40_bytes(sample_events(i, width=20)))
    put(folder / "1" / "9.bin", b"")
    url = store.put(folder)
    done = convert(url, tmp_path / "store.mcap")
    expected = convert(folder, tmp_path / "local.mcap")
    assert (tmp_path / "store.mcap").read_bytes() == (tmp_path / "local.mcap").read_bytes()
    assert (done.samples, done.events, done.bytes_in) == (4, 200, expected.bytes_in)
    # The store is named, not where its files were for a moment.
    assert [(str(place), reason) for place, reason in done.failed] == [
        (f"{url}/1/9.bin", f"{url}/1/9.bin: is empty (0 bytes); copy the file again")
    ]
    with pytest.raises(InputError, match="written to local files"):
        convert(folder, "s3://lab/out.mcap")


@pytest.mark.parametrize("url", ["s3://lab/nothing.mcap", "s3://no-such-bucket/a.mcap"])
def test_what_is_not_there_is_one_line(store, run, url):
    done = run("info", url)
    assert done.status == 2
    assert is_one_line(done.err, url)
    assert "there is no such file; check the name, and that of the bucket" in done.err


def test_a_server_that_does_not_know_who_asks_is_one_line(store, refuse, run):
    refuse()
    done = run("info", store.url)
    assert done.status == 2
    assert is_one_line(done.err, store.url)
    assert "the store refuses: " in done.err


def midway(source, happens):
    """What becomes of a recording to which something happens when its first batch has been read."""
    with open_recording(source) as recording:
        batches = iter(recording)
        next(batches)
        happens()
        with pytest.raises(InputError) as error:
            list(batches)
        assert not recording.losses
    assert re.match(rf"{source}: byte \d+: ", str(error.value))
    assert SECRET not in str(error.value)
    return str(error.value)


@pytest.fixture(scope="module")
def many_chunks(tmp_path_factory):
    """The recording in many chunks: a reader is one or two of them ahead of what it gives."""
    path = tmp_path_factory.mktemp("chunks") / "many.mcap"
    with SOURCE.open("rb") as read, path.open("wb") as written:
        writer = Writer(written, chunk_size=1 << 17, compression=CompressionType.NONE)
        writer.start("ros2")
        channels = {}
        for schema, channel, message in make_reader(read).iter_messages():
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", schema_id)
            times = message.log_time, message.data, message.publish_time, message.sequence
            writer.add_message(channels[channel.id], *times)
        writer.finish()
    return path


def test_a_server_that_refuses_midway_does_not_end_the_recording(store, refuse, small_blocks, many_chunks):
    assert "the store refuses: " in midway(store.put(many_chunks), refuse)


def test_a_file_that_is_replaced_midway_is_not_read_on(store, small_blocks, many_chunks, tmp_path):
    data = many_chunks.read_bytes()
    copy = put(tmp_path / "copy.mcap", data)
    url = store.put(copy)
    assert "cannot be read: " in midway(url, lambda: store.put(put(copy, data + b" ")))


def test_a_server_that_stops_midway_does_not_end_the_recording(store, small_blocks, many_chunks):
    with pytest.MonkeyPatch.context() as patch:
        server = S3Server(patch, "other")
        assert "is the store up, and can it be reached?" in midway(server.put(many_chunks), server.stop)


def test_a_conversion_that_a_store_leaves_writes_nothing(store, refuse, tmp_path):
    folder = tmp_path / "half_train"
    for i in range(20):  # more than are fetched ahead
        put(folder / "1" / f"{i}.bin", bin40_bytes(sample_events(i, width=20)))
    url = store.put(folder)
    with pytest.raises(InputError, match=rf"^{url}/1/\d+.bin: .*the store refuses"):
        convert(url, tmp_path / "out.mcap", progress=lambda n, total: n == 2 and refuse())
    assert not (tmp_path / "out.mcap").exists()


class Web(http.server.BaseHTTPRequestHandler):
    """Serves the recording; the folder in the address says how."""

    protocol_version = "HTTP/1.1"
    served = 0
    """Bytes, so far."""

    def do_GET(self):
        how = self.path.split("/")[1]
        if how == "refused":
            self.send_error(403, "not for you")
            return
        if how == "nothing":
            self.send_error(404)
            return
        part = re.match(r"bytes=(\d+)-(\d+)", self.headers["Range"] or "")
        if part and how != "whole":
            start, stop = int(part[1]), int(part[2]) + 1
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{len(DATA)}")
            data = DATA[start:stop]
        else:
            start, data = 0, DATA
            self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command == "GET":
            Web.served += len(data)
            self.close_connection = True
            # A connection that ends before what was promised has come.
            cut = how == "half" or (how == "cut" and 0.5 < start / len(DATA) < 0.8)
            # Who has read what it wanted may be gone before the rest.
            with contextlib.suppress(ConnectionError):
                self.wfile.write(data[: len(data) // 2] if cut else data)

    do_HEAD = do_GET  # noqa: N815  (the same)

    def log_message(self, *_):
        """Say nothing."""


@pytest.fixture(scope="module")
def web():
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Web) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://anna:{SECRET}@127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_a_recording_in_the_web_is_the_same(web, small_blocks):
    assert items(f"{web}/good/a.mcap?sig={SECRET}") == items(SOURCE)


def test_a_pass_fetches_each_byte_once_and_keeps_few(web, small_blocks):
    with open_recording(f"{web}/good/a.mcap") as recording:
        before = Web.served
        list(recording)
        assert Web.served - before <= len(DATA)
        assert recording._source._file._file.cache.cache_info().currsize == 4


@pytest.mark.parametrize(
    ("how", "what"),
    [
        ("refused", "the store refuses: .*403"),
        ("nothing", "there is no such file"),
        ("cut", r"byte \d+: cannot be read: .*; is the store up"),
        ("whole", "the store gives it as a whole only; put simplecache:: before"),
    ],
)
def test_a_web_server_that_does_not_give_all_is_one_line(web, small_blocks, run, how, what):
    url = f"{web}/{how}/a.mcap?sig={SECRET}"
    done = run("info", url)
    assert done.status == 2
    assert is_one_line(done.err, str(StoreLocation(url)))
    assert re.search(what, done.err)


def test_a_replay_that_a_store_leaves_has_no_output(web, small_blocks, run, tmp_path):
    url = f"{web}/cut/a.mcap"
    outputs = [tmp_path / "out.mcap", tmp_path / "out.jsonl"]
    model = SOURCE.with_name("digits.safetensors")
    done = run("replay", url, "-m", model, "-o", outputs[0], "--json-lines", outputs[1], "-q")
    assert (done.status, done.out) == (2, "")
    assert is_one_line(done.err, str(StoreLocation(url)))
    assert [*tmp_path.iterdir()] == []


def test_a_server_that_gives_whole_files_only_is_read_through_a_cache(web, small_blocks):
    assert items(f"simplecache::{web}/whole/a.mcap") == items(SOURCE)


def test_a_part_in_a_cache_is_no_recording(web):
    """What a cache keeps of a file that it could not fetch, it takes for the file the next time."""
    url = f"simplecache::{web}/half/a.mcap"
    for what in ("cannot be read: ", rf"\d+ of {len(DATA)} bytes were fetched; start again"):
        with pytest.raises(InputError, match=rf"^{StoreLocation(url)}: {what}"):
            open_recording(url)
