"""Learned features from event cameras: event by event, exact, and never behind."""

from streamfeat.errors import InputError
from streamfeat.events import EVENT_DTYPE, make_events

__all__ = ["EVENT_DTYPE", "InputError", "make_events"]
