"""The general model: filters for any camera, where nothing was learned from one's own.

Lives here: loading it. Not here: who takes it for want of another (`stream.models`, `cli`).
"""

from pathlib import Path

from streamfeat.engine.encoder import Encoder

__all__ = ["GENERAL_MODEL", "general_encoder"]

GENERAL_MODEL = Path(__file__).with_name("general.safetensors")
"""The file; `streamfeat/shipped/README.md` says what it was learned from."""


def general_encoder() -> Encoder:
    """The general model that ships with streamfeat, which commands take where no `-m` is given.

    Its filters were learned without labels from simulated scenes: a camera that moves before photographs, and
    digits that move before a camera, at many speeds and contrasts. Filters learned from one's own recordings
    fit them better.

    Example:
        >>> encoder = sf.general_encoder()
        >>> encoder.n_filters
        200
    """
    return Encoder.load(GENERAL_MODEL)
