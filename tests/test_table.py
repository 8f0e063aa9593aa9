"""Emissions as Arrow and Parquet files, read back with the library that everybody reads them with."""

import json

import numpy as np
import pytest
import tiny

from streamfeat.errors import InputError
from streamfeat.recordings.reader import Label
from streamfeat.stream import table
from streamfeat.stream.batch import EmissionBatch
from streamfeat.stream.emission import Emission
from streamfeat.stream.outputs import Outputs

pa = pytest.importorskip("pyarrow", reason="extra export is not installed")
pq = pytest.importorskip("pyarrow.parquet", reason="extra export is not installed")

LABELS = ("cat", "dog")
ROWS = ("t_us", "n_events", "features", "scores", "incomplete")
SAMPLE = Label(1000, 500, "dog", "test", "a/b.dat")


def emission(i, *, sample=None, labels=LABELS):
    rng = np.random.default_rng(i)
    scores = rng.standard_normal(len(labels)).astype(np.float32)
    features = rng.standard_normal(6).astype(np.float32)
    return Emission(1000 + i, i, features, labels, scores, sample, bool(sample), "/cam", i % 2 == 0)


def read(path):
    if path.suffix == ".parquet":
        return pq.read_table(path)
    with pa.ipc.open_file(path) as file:
        return file.read_all()


@pytest.mark.parametrize("name", ["out.parquet", "out.arrow", "out.feather"])
def test_every_emission_is_a_row(tmp_path, name, monkeypatch):
    monkeypatch.setattr(table, "_GROUP_BYTES", 4 * 6 * 4)  # four rows
    emissions = [emission(i, sample=SAMPLE if i % 3 == 0 else None) for i in range(11)]
    sink = table.TableSink(tmp_path / name, 6, LABELS)
    for start in range(0, 8, 3):
        sink.write(emissions[start : start + 3])
    same = EmissionBatch(
        **{name: np.array([getattr(e, name) for e in emissions[9:]]) for name in ROWS},
        labels=LABELS,
        topic="/cam",
        sample=SAMPLE,
        final=True,
    )
    emissions[9:] = list(same)
    sink.write(same)
    assert not (tmp_path / name).exists()
    sink.close(failed=False)
    found = read(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert json.loads(found.schema.metadata[b"labels"]) == list(LABELS)
    for row, e in zip(found.to_pylist(), emissions, strict=True):
        assert (row["t_us"], row["n_events"], row["topic"]) == (e.t_us, e.n_events, "/cam")
        assert (row["incomplete"], row["final"], row["prediction"]) == (e.incomplete, e.final, e.prediction)
        sample = (row["label"], row["split"], row["source"], row["elapsed_us"])
        assert sample == (("dog", "test", "a/b.dat", e.t_us - 1000) if e.sample else (None,) * 4)
        assert np.array_equal(np.float32(row["scores"]), e.scores)
        assert np.array_equal(np.float32(row["features"]), e.features)


@pytest.mark.parametrize("name", ["out.parquet", "out.arrow"])
def test_no_emission_makes_an_empty_table_and_none_has_a_prediction_without_a_classifier(tmp_path, name):
    table.TableSink(tmp_path / name, 6).close(failed=False)
    assert read(tmp_path / name).num_rows == 0
    sink = table.TableSink(tmp_path / name, 6)
    sink.write([emission(1, labels=())])
    sink.close(failed=False)
    (row,) = read(tmp_path / name).to_pylist()
    assert (row["prediction"], row["scores"]) == (None, [])


def test_what_fails_leaves_no_file_and_keeps_an_earlier_one(tmp_path):
    (tmp_path / "out.parquet").write_bytes(b"mine")
    sink = table.TableSink(tmp_path / "out.parquet", 6)
    sink.write([emission(1)])
    sink.close(failed=True)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"mine"]


def test_what_cannot_be_written_is_refused_in_one_line(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"out\.csv: tables end in \.parquet, \.arrow or \.feather"):
        table.TableSink(tmp_path / "out.csv", 6)
    with pytest.raises(InputError, match="cannot write there: No such file or directory"):
        table.TableSink(tmp_path / "none" / "out.arrow", 6)
    monkeypatch.setitem(table.importlib.sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"needs pyarrow: pip install 'streamfeat\[export\]'"):
        table.TableSink(tmp_path / "out.arrow", 6)
    assert list(tmp_path.iterdir()) == []


def test_a_replay_writes_a_table(tmp_path):
    from streamfeat.stream.replay import ReplayJob

    model = tiny.encoder()
    model.save(tmp_path / "model")
    recording = tiny.write_items(tmp_path / "in.mcap", tiny.labelled_items(4))
    clf = tiny.classifier(model)
    clf.save(tmp_path / "clf")
    job = ReplayJob(recording, tmp_path / "model", tmp_path / "clf", emit="20ms")
    job.run(Outputs(table=tmp_path / "out.parquet"))
    found = pq.read_table(tmp_path / "out.parquet")
    assert found.num_rows == job.result()["emissions"]
    finals = [row for row in found.to_pylist() if row["final"]]
    assert [row["label"] for row in finals] == ["cat", "dog", "owl", "cat"]
    assert json.loads(found.schema.metadata[b"labels"]) == list(clf.labels)
    assert [row["prediction"] for row in finals] == [
        clf.predict(np.float32(row["features"])) for row in finals
    ]
