"""Learned features from event cameras: event by event, exact, and never behind.

The public names are imported when first used, so that `streamfeat --help` does not wait for numba.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from streamfeat.classifier import Classifier, OnlineClassifier
    from streamfeat.conventions import as_events
    from streamfeat.encoder import Encoder
    from streamfeat.engine import Engine
    from streamfeat.errors import InputError
    from streamfeat.events import EVENT_DTYPE, make_events
    from streamfeat.features import EventFeatures
    from streamfeat.geometry import Geometry
    from streamfeat.learn.dictionary import DictionaryLearner
    from streamfeat.learn.transform import TransformLearner
    from streamfeat.recorder import RecordingWriter
    from streamfeat.recording import open_recording

__all__ = [
    "EVENT_DTYPE",
    "Classifier",
    "DictionaryLearner",
    "Encoder",
    "Engine",
    "EventFeatures",
    "Geometry",
    "InputError",
    "OnlineClassifier",
    "RecordingWriter",
    "TransformLearner",
    "as_events",
    "make_events",
    "open_recording",
]

_HOMES = {
    "EVENT_DTYPE": "events",
    "Classifier": "classifier",
    "DictionaryLearner": "learn.dictionary",
    "Encoder": "encoder",
    "Engine": "engine",
    "EventFeatures": "features",
    "Geometry": "geometry",
    "InputError": "errors",
    "OnlineClassifier": "classifier",
    "RecordingWriter": "recorder",
    "TransformLearner": "learn.transform",
    "as_events": "conventions",
    "make_events": "events",
    "open_recording": "recording",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
