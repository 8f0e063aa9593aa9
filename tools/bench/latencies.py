"""The latency of single events, bin boundaries included, as `streamfeat latency` measures it.

Lives here: the part `latency`. Not here: the measurement, which is the program's own.
"""

import importlib.util
import tempfile
from pathlib import Path
from typing import Any

from tools.bench.material import Setting, random_encoder

__all__ = ["measure_latency"]


def measure_latency(setting: Setting) -> dict[str, Any]:
    """Percentiles of single updates in recorded order, stride 4, with and without looking ahead."""
    if importlib.util.find_spec("streamfeat.latency") is None:
        return {"missing": ["streamfeat.latency"]}
    from streamfeat.latency.measure import LatencyReport

    encoder = random_encoder(setting.material, setting.geometry(stride=4), setting.n_filters)
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "direct.safetensors"
        encoder.save(model)
        for look_ahead in (True, False):
            name = "looking ahead" if look_ahead else "one plane"
            setting.say(name)
            report = LatencyReport(
                setting.material.path,
                [model],
                ["event"],
                warm_up=100 if setting.quick else 2000,
                limit_events=500 if setting.quick else 50_000,
                seconds=0.2 if setting.quick else 10.0,
                look_ahead=look_ahead,
            )
            report.run(lambda step, done, total, remark: None, lambda: False)
            result = report.result()
            rows = {row.pop("what"): row for row in result["rows"]}
            for row in rows.values():
                row.pop("histogram")
            figures[name] = {"steal_share": result["steal_share"], "clock_ns": result["clock_ns"]} | rows
    return figures
