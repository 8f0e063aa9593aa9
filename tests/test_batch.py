"""Emissions in columns are the emissions: as objects, in every sink, with the bits of the offline path."""

import io
import json

import numpy as np
import pytest
import tiny

from streamfeat.classify.classifier import Classifier
from streamfeat.messages.packets import Label, Watermark
from streamfeat.stream.batch import EmissionBatch, batches_of
from streamfeat.stream.emission import Emission, EmitPolicy
from streamfeat.stream.outputs import Outputs
from streamfeat.stream.session import Session
from streamfeat.stream.sinks import JsonLinesSink

MODEL = tiny.encoder(k=3)
FIELDS = [name for name in Emission.__slots__ if name not in ("features", "scores")]


def batches(items, policy="event", labels=("cat", "dog", "owl"), **options):
    clf = tiny.classifier(MODEL, labels) if labels else None
    session = Session(MODEL, EmitPolicy.parse(policy), clf, topic="cam", **options)
    found = [b for item in items for b in session.batches(item)]
    return [*found, *session.last_batches()], session


def told(e):
    return [getattr(e, name) for name in FIELDS] + [e.features.tolist(), e.scores.tolist()]


def items():
    silent = [tiny.packet(tiny.steady(2_000_000, 2_050_000, 300)), Watermark("cam", 2_400_000)]
    return [*tiny.labelled_items(3), *silent]


@pytest.mark.parametrize("policy", ["event", "7ev", "10ms", "bin"])
def test_a_batch_is_a_sequence_of_its_emissions(policy):
    found, session = batches(items(), policy)
    plain = Session(MODEL, session.policy, tiny.classifier(MODEL), topic="cam")
    one_by_one = [e for item in items() for e in plain.process(item)] + list(plain.finish())
    assert [told(e) for b in found for e in b] == [told(e) for e in one_by_one]
    assert session.stats() == plain.stats()
    assert sum(map(len, found)) == session.stats().emissions == len(one_by_one)
    longest = max(found, key=len)
    assert [e.prediction for e in longest] == longest.predictions
    assert told(longest[-1]) == told(list(longest)[-1])
    assert [told(e) for e in longest[1:3]] == [told(e) for e in list(longest)[1:3]]
    for again in (EmissionBatch.of(longest[0]), *batches_of([longest[0]])):
        assert (len(again), told(again[0])) == (1, told(longest[0]))
    assert batches_of(longest) == [longest]
    with pytest.raises(IndexError):
        longest[len(longest)]


@pytest.mark.parametrize("labels", [("cat", "dog"), ("cat", "dog", "owl")])
@pytest.mark.parametrize("temperature", [None, 0.7])
def test_scores_after_each_event_are_those_of_its_features(labels, temperature):
    """Summed from what the event changed, they have the bits of the whole feature vector's."""
    one = tiny.classifier(MODEL, labels)
    clf = Classifier(
        **{name: getattr(one, name) for name in Classifier.__slots__[:7]}, temperature=temperature
    )
    session = Session(MODEL, EmitPolicy.parse("event"), clf)
    found = [b for item in items() for b in session.batches(item)]
    assert max(map(len, found)) > 30
    for batch in found:
        expected = [clf.emitted(row) for row in batch.features]
        np.testing.assert_array_equal(batch.scores, expected)
        np.testing.assert_array_equal(batch.scores, clf.emitted(batch.features))
        assert batch.predictions == [clf.predict(row) for row in batch.features]


@pytest.mark.parametrize("labels", [(), ("cat", "dog", "owl")])
def test_scores_are_the_same_where_features_are_not_kept(labels):
    kept, _ = batches(items(), labels=labels)
    scores, session = batches(items(), labels=labels, keep_features=False)
    for one, other in zip([e for b in kept for e in b], [e for b in scores for e in b], strict=True):
        assert told(one)[:-2] + told(one)[-1:] == told(other)[:-2] + told(other)[-1:]
        assert len(other.features) == (MODEL.n_features if other.final else 0)
        if other.final:
            np.testing.assert_array_equal(one.features, other.features)
    assert session.stats().emissions == sum(map(len, kept))


def test_a_classifier_that_learns_predicts_with_what_it_has_learned():
    start = Classifier.untrained(("cat", "dog", "owl"), MODEL)
    session = Session(MODEL, EmitPolicy.parse("event"), start, learn_online=True)
    n_known = 0
    for item in tiny.labelled_items(40):
        for batch in session.batches(item):
            if batch.final:
                continue  # it has been learned from since
            np.testing.assert_array_equal(batch.scores, session.classifier.emitted(batch.features))
            n_known += np.count_nonzero(batch.scores.any(axis=1))
    assert n_known > 100


@pytest.mark.parametrize("features", [False, True])
def test_lines_of_a_batch_are_those_of_its_emissions(features):
    incomplete = tiny.packet(tiny.steady(2_600_000, 2_650_000, 50))
    found, _ = batches([*items(), incomplete])
    texts = []
    for written in (found, [list(b) for b in found]):
        sink = JsonLinesSink(text := io.StringIO(), features=features)
        for emissions in written:
            sink.write(emissions)
        texts.append(text.getvalue().splitlines())
    assert texts[0] == texts[1]
    for line, e in zip(texts[0], [e for b in found for e in b], strict=True):
        record = json.loads(line)
        assert (record["t_us"], record["n_events"], record["topic"]) == (e.t_us, e.n_events, "cam")
        assert record["prediction"] == e.prediction
        assert record["scores"] == {n: round(float(s), 6) for n, s in zip(e.labels, e.scores, strict=True)}
        assert record.get("incomplete", False) == e.incomplete
        assert record.get("features") == (e.features.tolist() if features else None)
        assert record.get("sample", {}).get("final", False) == e.final
        if isinstance(e.sample, Label):
            assert record["sample"]["elapsed_us"] == e.t_us - e.sample.start_us


def test_features_are_kept_for_outputs_that_read_them(tmp_path):
    out = tmp_path / "out"
    assert not Outputs().reads_features(has_classifier=True)
    assert not Outputs(json_lines=out).reads_features(has_classifier=True)
    assert Outputs(json_lines=out, with_features=True).reads_features(has_classifier=True)
    for reader in ({"recording": out}, {"table": out}, {"more": JsonLinesSink(io.StringIO())}):
        assert Outputs(**reader).reads_features(has_classifier=True)
