"""What is read from a stream, and when.

Lives here: `Emission`, one reading of the features; `EmitPolicy`, how often to read.
Not here: the reading itself (`session`), or where it goes (`sinks`).
"""

import re
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.messages.packets import Label

__all__ = ["Emission", "EmitPolicy"]


@dataclass(frozen=True, slots=True, eq=False)
class Emission:
    """One reading of the features, with the prediction that follows from it.

    Attributes:
        t_us: stream time; the reading reflects every event before it that has arrived.
        n_events: events counted by the session so far.
        features: `(n_features,)` float32.
        labels: names that the scores belong to; empty without a classifier.
        scores: `(C,)` float32.
        sample: the labelled sample that is open, if any.
        final: this is the reading at the end of that sample, the one that counts.
        topic: of the camera, where there may be several.
        incomplete: packets are known to be missing from the window.
        source_ns: when the packet that brought about this reading was published, by its publisher's clock; 0
            if that is unknown, or silence brought it about.
    """

    t_us: int
    n_events: int
    features: NDArray[np.float32]
    labels: tuple[str, ...]
    scores: NDArray[np.float32]
    sample: Label | None
    final: bool
    topic: str = ""
    incomplete: bool = False
    source_ns: int = 0

    @property
    def prediction(self) -> str | None:
        """The label with the highest score, or None without a classifier."""
        return self.labels[int(self.scores.argmax())] if self.labels else None

    @property
    def correct(self) -> bool | None:
        """Whether the prediction is the sample's label; None where either is missing."""
        return self.prediction == self.sample.label if self.sample and self.labels else None


@dataclass(frozen=True, slots=True)
class EmitPolicy:
    """How often features are read; never what they are.

    `events`: after every `every` events. `time`: whenever stream time passes a multiple of `every`
    microseconds, counted from the origin. `auto`: as often as reading takes no more than a fifth of the
    time. At the end of a labelled sample there is a reading under every policy.
    """

    kind: Literal["events", "time", "auto"]
    every: int = 1

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `event`, `1000ev`, `10ms` (also `500us`, `2s`) or `auto`.

        Raises:
            InputError: the text is none of these.
        """
        if text == "auto":
            return cls("auto")
        if text == "event":
            return cls("events", 1)
        match = re.fullmatch(r"([1-9][0-9]{0,11})(ev|us|ms|s)", text)
        if not match:
            raise InputError(f"--emit {text!r} is not understood; give event, 1000ev, 10ms or auto")
        unit = {"ev": 1, "us": 1, "ms": 1_000, "s": 1_000_000}[match[2]]
        return cls("events" if match[2] == "ev" else "time", int(match[1]) * unit)
