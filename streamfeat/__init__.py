"""Learned features from event cameras: event by event, exact, and never behind.

The public names are imported when first used, so that `streamfeat --help` does not wait for numba.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from streamfeat.classify.classifier import Classifier
    from streamfeat.classify.features import EventFeatures
    from streamfeat.classify.online import OnlineClassifier
    from streamfeat.engine.encoder import Encoder
    from streamfeat.engine.engine import Engine
    from streamfeat.engine.geometry import Geometry
    from streamfeat.errors import InputError
    from streamfeat.events import EVENT_DTYPE, as_events, make_events
    from streamfeat.learn.dictionary import DictionaryLearner
    from streamfeat.learn.from_files import learn_encoder
    from streamfeat.learn.transform import TransformLearner
    from streamfeat.live.listen import listen
    from streamfeat.recordings.reader import open_recording
    from streamfeat.recordings.writer import RecordingWriter
    from streamfeat.shipped.general import general_encoder
    from streamfeat.stream.emission import Emission, EmitPolicy
    from streamfeat.stream.pipeline import Pipeline
    from streamfeat.stream.replay import replay
    from streamfeat.stream.session import Session
    from streamfeat.view.drawing import draw

    __version__: str

__all__ = [
    "EVENT_DTYPE",
    "Classifier",
    "DictionaryLearner",
    "Emission",
    "EmitPolicy",
    "Encoder",
    "Engine",
    "EventFeatures",
    "Geometry",
    "InputError",
    "OnlineClassifier",
    "Pipeline",
    "RecordingWriter",
    "Session",
    "TransformLearner",
    "__version__",
    "as_events",
    "draw",
    "general_encoder",
    "learn_encoder",
    "listen",
    "make_events",
    "open_recording",
    "replay",
]

_HOMES = {
    "EVENT_DTYPE": "events",
    "Classifier": "classify.classifier",
    "DictionaryLearner": "learn.dictionary",
    "Emission": "stream.emission",
    "EmitPolicy": "stream.emission",
    "Encoder": "engine.encoder",
    "Engine": "engine.engine",
    "EventFeatures": "classify.features",
    "Geometry": "engine.geometry",
    "InputError": "errors",
    "OnlineClassifier": "classify.online",
    "Pipeline": "stream.pipeline",
    "RecordingWriter": "recordings.writer",
    "Session": "stream.session",
    "TransformLearner": "learn.transform",
    "as_events": "events",
    "draw": "view.drawing",
    "general_encoder": "shipped.general",
    "learn_encoder": "learn.from_files",
    "listen": "live.listen",
    "make_events": "events",
    "open_recording": "recordings.reader",
    "replay": "stream.replay",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    if name == "__version__":
        from importlib.metadata import version

        return version(__name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """The public names, whether imported yet or not."""
    return sorted({*globals(), *__all__})
