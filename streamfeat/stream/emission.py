"""What comes out of a stream, and when.

Lives here: `Emission`, features at one time with their prediction; `EmitPolicy`, how often they are emitted.
Not here: making emissions (`session`), or where they go (`sinks`).
"""

import re
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from streamfeat.errors import InputError
from streamfeat.messages.packets import Label

__all__ = ["Emission", "EmitPolicy"]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Emission:
    """Features at one stream time, with the prediction that follows from them.

    Example:
        >>> emission.t_us, emission.prediction, emission.features.shape
        (310000, '7', (3200,))

    Attributes:
        t_us: stream time; the features reflect every event before it that has arrived.
        n_events: events counted by the session so far.
        features: `(n_features,)` float32.
        labels: names that the scores belong to; empty without a classifier.
        scores: `(C,)` float32, probabilities where the classifier was calibrated, as `train` does.
        sample: the labelled sample that is open, if any.
        final: this is the emission at the end of that sample, the one that is scored.
        topic: of the camera, where there may be several.
        incomplete: packets are known to be missing from the window.
        active_volumes: local volumes that have events; None where that was not counted.
        source_ns: when the packet that caused this emission was published, by its publisher's clock; 0 where
            that is unknown, or silence caused it.
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
    active_volumes: int | None = None

    def __repr__(self) -> str:
        """One line: when, of what, and the prediction."""
        said = [f"{self.t_us:,} us", f"{self.n_events:,} events", f"{len(self.features):,} features"]
        said += [f"{name!r}" for name in (self.topic, self.prediction) if name]
        said += [name for name in ("final", "incomplete") if getattr(self, name)]
        return f"Emission({', '.join(said)})"

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
    """How often features are emitted; never what they are.

    `events`: after every `every` events. `time`: whenever stream time passes a multiple of `every`
    microseconds, counted from the origin. `bin`: the same at each boundary of the model's time bins. `auto`:
    as often as emissions take no more than a fifth of the time. At the end of a labelled sample there is an
    emission under every policy.

    Example:
        >>> sf.EmitPolicy.parse("10ms")
        EmitPolicy(kind='time', every=10000)
    """

    kind: Literal["events", "time", "bin", "auto"]
    every: int = 1

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `event`, `1000ev`, `10ms` (also `500us`, `2s`), `bin` or `auto`.

        Raises:
            InputError: the text is something else.
        """
        if text == "auto":
            return cls("auto")
        if text == "bin":
            return cls("bin")
        if text == "event":
            return cls("events", 1)
        match = re.fullmatch(r"([1-9][0-9]{0,11})(ev|us|ms|s)", text)
        if not match:
            raise InputError(f"--emit {text!r} is not understood; give event, 1000ev, 10ms, bin or auto")
        unit = {"ev": 1, "us": 1, "ms": 1_000, "s": 1_000_000}[match[2]]
        return cls("events" if match[2] == "ev" else "time", int(match[1]) * unit)

    def __str__(self) -> str:
        """As `parse` reads it."""
        if self.kind == "events":
            return "event" if self.every == 1 else f"{self.every}ev"
        if self.kind == "time":
            return f"{self.every // 1000}ms" if self.every % 1000 == 0 else f"{self.every}us"
        return self.kind

    def with_bins(self, bin_us: int) -> "EmitPolicy":
        """The same for a model with bins of `bin_us` microseconds: `bin` becomes `time`."""
        return EmitPolicy("time", bin_us) if self.kind == "bin" else self
