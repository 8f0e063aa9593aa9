"""A whole replay against the camera's own pace, and beside it bare reading of the same file.

Lives here: the part `replay`. Not here: what a single event costs.

The file is written again with lz4. Bare reading comes in two kinds: messages handed out by the mcap library
and left undecoded; and our own decoding into events. Emissions come every 10 ms of stream time while there
is any, so their number says how long the camera took.
"""

import tempfile
from pathlib import Path
from typing import Any

from mcap.reader import NonSeekingReader

import streamfeat as sf
from streamfeat.stream.replay import ReplayJob
from tools.bench.material import Setting, encoder_of
from tools.bench.timing import WALL, Contestant, race, summary

__all__ = ["measure_replay"]

EMIT_S = 0.01


def measure_replay(setting: Setting, dense: Path | None) -> dict[str, Any]:
    """Events a second of `replay --emit 10ms` with K = 400 and stride 4, and of reading."""
    geometry = sf.Geometry(patch=12, stride=4, n_bins=3, bin_us=setting.material.bin_us(3))
    encoder = encoder_of(setting, geometry, 40 if setting.quick else 400, "direct", "split")
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "model.safetensors"
        encoder.save(model)
        sources = {setting.material.name: setting.material.path} | ({dense.name: dense} if dense else {})
        for name, source in sources.items():
            path = Path(folder) / "lz4.mcap"
            events = _rewrite(source, path, 20_000 if setting.quick else 600_000)
            setting.say(f"{name}: {events:,} events, {path.stat().st_size / 1e6:.1f} MB")
            figures[name] = _measure(setting, path, model, events)
    return figures


def _rewrite(source: Path, target: Path, most: int) -> int:
    """The first events of a recording, with their labels, as `mono` packets in lz4 chunks."""
    events = 0
    with (
        sf.open_recording(source) as recording,
        sf.RecordingWriter(target, compression="lz4", overwrite=True) as writer,
    ):
        for item in recording.items():
            if hasattr(item, "events"):
                writer.write_events(item.events, item.resolution)
                events += len(item.events)
            elif events < most:
                writer.write_label(item)
            else:
                break
            if events >= most and not recording.labels:
                break
    return events


def _measure(setting: Setting, path: Path, model: Path, events: int) -> dict[str, Any]:
    emissions = 0

    def replay() -> None:
        nonlocal emissions
        job = ReplayJob(path, model, emit="10ms")
        job.run()
        emissions = job.result()["emissions"]

    def read_messages() -> None:
        with path.open("rb") as file:
            for _ in NonSeekingReader(file).iter_messages(log_time_order=False):
                pass

    def read_events() -> None:
        with sf.open_recording(path) as recording:
            for _ in recording:
                pass

    contestants = {
        "replay": Contestant(replay, events, clock=WALL),
        "messages, not decoded": Contestant(read_messages, events, clock=WALL),
        "messages, decoded": Contestant(read_events, events, clock=WALL),
    }
    result = race(contestants, setting.rounds(5))
    stream_s = emissions * EMIT_S
    paces = stream_s / (result.nanoseconds["replay"] * events / 1e9)
    return {
        "events": events,
        "emissions": emissions,
        "pace": summary(paces),
        "race": result.figures(),
        "events_per_s": {name: round(1e9 / result.figure(name)["p50"]) for name in contestants},
        "speed_of_reading": {name: result.ratio(name, "replay") for name in contestants if name != "replay"},
    }
