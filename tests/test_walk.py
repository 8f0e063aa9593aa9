"""From a camera of one's own, here a file of digits, to a live classifier: record, label, train, listen."""

import numpy as np
import pytest
import tiny
from live_net import ListSink, compiled, free_port, running, until
from test_json import check

from streamfeat.cli.rendering import complete
from streamfeat.live.listen import ListenJob
from streamfeat.live.names import PlainNames
from streamfeat.live.network import Network
from streamfeat.live.publish import PublishJob
from streamfeat.live.record import RecordJob
from streamfeat.messages.packets import Label
from streamfeat.recordings.reader import open_recording
from streamfeat.stream.outputs import Outputs
from streamfeat.view.labelling import LabelSheet, label_path
from streamfeat.view.player import Timeline

NEVER = 1e9
KEY = "robot/cam0/events"
N = 40


def publish(recording, port):
    """A camera: a recording of digits, as fast as it is taken."""
    job = PublishJob([(recording, KEY)], PlainNames(KEY), speed=None, network=Network(port=port), wait_s=60)
    job.run()
    return job.result()


@pytest.mark.real_time
def test_from_ones_own_camera_to_a_live_classifier(run, tmp_path):
    labelled = tiny.write_digits(tmp_path / "digits.mcap", N)
    with open_recording(labelled) as rec:
        truth, items = rec.labels, [item for item in rec.items() if not isinstance(item, Label)]
    scene = tiny.write_items(tmp_path / "scene.mcap", items)
    tiny.encoder(k=12).save(tmp_path / "model")
    compiled(tmp_path)

    # 1. record
    port, drive = free_port(), tmp_path / "drive.mcap"
    recorder = RecordJob(PlainNames("robot/*/events"), drive, network=Network(port=port))
    with running(recorder):
        packets = publish(scene, port)["packets"]
        until(lambda: recorder.result()["messages"] == packets, "all packets")
    check("record", complete("record", recorder.result()))
    with open_recording(drive) as rec:
        assert not rec.is_labelled

    # 2. label, as the page asks for it: in seconds that were played
    table = label_path(str(drive))
    with open_recording(drive) as rec:
        sheet, first_us = LabelSheet(rec, table), next(iter(rec))["t"][0]
    told = []
    timeline = Timeline(lambda: open_recording(drive), told.append, sheet.read_to)
    until(lambda: told and told[-1]["done"])
    timeline.close()
    for label in truth:
        start_s = max(label.start_us - first_us, 0) / 1e6
        end_s = (label.start_us + label.duration_us - first_us) / 1e6
        sheet.do({"op": "label", "start": start_s, "end": end_s, "label": label.label})
        assert sheet.record()["problem"] == ""
    assert sheet.result()["samples"] == N

    # 3. train
    model, classifier = tmp_path / "model", tmp_path / "classifier"
    trained = run("train", drive, "-m", model, "-o", classifier, "--labels", table, "--json")
    assert trained.status == 0, trained.err
    assert trained.json["samples"] == N

    # The labels can be put into a recording, too.
    written = run("convert", drive, tmp_path / "with_labels.mcap", "--labels", table, "--json")
    assert written.status == 0, written.err
    assert written.json["labels"] == N
    with open_recording(tmp_path / "with_labels.mcap") as rec:
        assert [label.label for label in rec.labels] == [label.label for label in truth]

    # 4. listen
    port, sink = free_port(), ListSink()
    listener = ListenJob(
        PlainNames("robot/*/events"),
        model,
        classifier,
        emit="10ms",
        network=Network(port=port),
        silence_s=NEVER,
        patience_s=NEVER,
        max_delay_s=NEVER,
    )
    with running(listener, Outputs(more=sink)):
        packets = publish(scene, port)["packets"]
        until(lambda: listener.result()["packets"] == packets, "all packets")
    check("listen", complete("listen", listener.result()))
    assert listener.result()["lost"] == listener.result()["dropped"] == 0
    at = np.array([emission.t_us for emission in sink.emissions])
    right = 0
    for label in truth:
        last = int(np.searchsorted(at, label.start_us + label.duration_us, "right")) - 1
        right += sink.emissions[last].prediction == label.label
    assert right > N / 2, "far more than one in ten"
