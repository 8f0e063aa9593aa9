"""Learning with one call, for programs.

Lives here: `learn_encoder` as `import streamfeat` offers it, which opens recordings and sums up settings.
Not here: the steps of learning (`fit`), the settings (`settings`).
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from os import PathLike
from typing import Any

from streamfeat.engine.encoder import Encoder
from streamfeat.errors import InputError
from streamfeat.learn import fit
from streamfeat.learn.sensor import suited_to
from streamfeat.learn.settings import DEFAULTS, Setting, preset_with
from streamfeat.recordings.reader import Recording, open_recording

__all__ = ["learn_encoder"]

Source = str | PathLike[str] | Recording


def learn_encoder(
    recordings: Source | Sequence[Source],
    *,
    preset: str = "default",
    resume: Encoder | None = None,
    report: Callable[[str, int, int, str], None] = lambda step, done, total, remark: None,
    **settings: Any,
) -> Encoder:
    """Learn an encoder from recordings, without labels, as `streamfeat learn` does.

    Samples of held-out splits (validation, test) are not looked at. Ctrl-C ends learning: the encoder is that
    of the last whole iteration then, and `provenance["interrupted"]` is true.

    Example:
        >>> encoder = sf.learn_encoder("digits.mcap", patch=10, filters=64, volumes=4000, iterations=3)
        >>> encoder.save("model.safetensors")

    Args:
        recordings: one or several; paths, URLs or open recordings, which stay open.
        preset: name of the settings that hold where nothing is given: `default`, `fast`,
            `accurate` or `paper`.
        resume: an encoder to go on from, learned from the same recordings with the same settings.
        report: called with (step, done, of how many, remark); of how many is 0 where that is unknown.
        settings: of geometry and learning, see `streamfeat.learn.settings.Setting`: `formulation`, `filters`,
            `patch`, `bins`, `window_ms` and so on. Without `stride`, `downsample` and `preset` the grid is
            the finest that one core follows on the sensor, emitting every 10 ms.

    Raises:
        InputError: a recording cannot be read, a setting is unknown or out of range, or there is not enough
            to learn from.
        KeyboardInterrupt: Ctrl-C came before the first iteration was done.
    """
    if unknown := sorted(settings.keys() - DEFAULTS.keys()):
        raise InputError(f"there is no setting {unknown[0]!r}; the settings are {', '.join(DEFAULTS)}")
    setting = Setting(**preset_with(preset, settings))
    sources = [recordings] if isinstance(recordings, str | PathLike | Recording) else list(recordings)
    if not sources:
        raise InputError("give at least one recording to learn from")
    with ExitStack() as files:
        opened = [
            source if isinstance(source, Recording) else files.enter_context(open_recording(source))
            for source in sources
        ]
        if preset == "default" and not settings.keys() & {"stride", "downsample"}:
            setting = suited_to(opened, setting)
        return fit.learn_encoder(opened, setting, resume=resume, report=report)
