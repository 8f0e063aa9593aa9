"""Options for what learning can be told, as `learn` and `evaluate` have them.

Lives here: each option once, and a setting made of those that were given.
Not here: what they mean (`learn.settings`).
"""

from typing import Annotated, Any

import typer

from streamfeat.cli.program import completing
from streamfeat.learn.settings import DEFAULTS, PRESETS, preset_with

__all__ = [
    "Bins",
    "Coherence",
    "Conditioning",
    "Cuts",
    "Downsample",
    "Encoding",
    "Filters",
    "Groups",
    "Iterations",
    "Kernel",
    "Lambda0",
    "LogDet",
    "MaxCount",
    "Mirror",
    "Patch",
    "Pooling",
    "Preset",
    "Rows",
    "Scales",
    "Seed",
    "Shift",
    "Start",
    "Stride",
    "Threshold",
    "TimeStride",
    "VolumeBins",
    "Volumes",
    "WindowMs",
    "setting_given",
]


def _shown(name: str) -> str:
    """The default of an option as `--help` shows it."""
    return str((DEFAULTS | PRESETS["default"])[name])


Preset = Annotated[
    str,
    typer.Option(
        help=f"Values of all options that are not given: {', '.join(PRESETS)}.",
        autocompletion=completing(*PRESETS),
    ),
]
Encoding = Annotated[
    str | None,
    typer.Option(
        help="What is pooled: soft, split or triangle.",
        show_default=_shown("encoding"),
        autocompletion=completing("soft", "split", "triangle"),
    ),
]
Filters = Annotated[
    int | None, typer.Option(help="Number of filters or atoms, K.", show_default=_shown("filters"))
]
Patch = Annotated[
    str | None,
    typer.Option(
        metavar="PIXELS",
        help="Pixels along a side of a local volume; ROWSxCOLUMNS such as 8x16; or sensor, for all of the "
        "largest sensor.",
        show_default=_shown("patch"),
    ),
]
Stride = Annotated[
    int | None, typer.Option(help="Pixels between neighbouring volumes.", show_default=_shown("stride"))
]
Bins = Annotated[int | None, typer.Option(help="Time bins in the window.", show_default=_shown("bins"))]
WindowMs = Annotated[
    float | None,
    typer.Option(help="Length of the window.", show_default="holds 95 % of labelled samples, or 100"),
]
Downsample = Annotated[
    int | None,
    typer.Option(help="Sensor pixels along a side of a ring pixel.", show_default=_shown("downsample")),
]
MaxCount = Annotated[
    int | None,
    typer.Option(help="Counts are clipped to plus and minus this.", show_default=_shown("max_count")),
]
Pooling = Annotated[
    int | None,
    typer.Option(
        help="Cells along each side, in each of which codes are summed.", show_default=_shown("pooling")
    ),
]
VolumeBins = Annotated[
    int | None,
    typer.Option(
        help="Bins of a local volume, fewer than the window has; codes are summed over time then, too.",
        show_default="those of the window",
    ),
]
TimeStride = Annotated[
    int | None,
    typer.Option(
        help="Bins between volumes at the same place, with --volume-bins.", show_default=_shown("time_stride")
    ),
]
Lambda0 = Annotated[
    float | None,
    typer.Option(
        help="Sparsity penalty in learning.", show_default="2 if direct (0.5 with free rows), 1 if inverse"
    ),
]
Threshold = Annotated[
    float | None,
    typer.Option(
        help="Threshold of encoding, in units of unit-length filters.", show_default=_shown("threshold")
    ),
]
Start = Annotated[
    str | None,
    typer.Option(
        help="Of learning: kmeans or random.",
        show_default=_shown("start"),
        autocompletion=completing("kmeans", "random"),
    ),
]
Rows = Annotated[
    str | None,
    typer.Option(
        help="Length of the filters while they are learned: unit, or free; direct only.",
        show_default=_shown("rows"),
        autocompletion=completing("unit", "free"),
    ),
]
Conditioning = Annotated[
    float | None, typer.Option(help="Weight of |A|^2 / 2; free rows only.", show_default="0.1")
]
Coherence = Annotated[
    float | None,
    typer.Option(
        help="Weight of |A'A - I|^2 / 4; free rows or inverse only.",
        show_default="0.02 if direct, 0.1 if inverse",
    ),
]
LogDet = Annotated[
    float | None, typer.Option(help="Weight of -log|det A'A|; free rows only.", show_default="0.1")
]
Volumes = Annotated[
    int | None, typer.Option(help="Local volumes to learn from.", show_default=_shown("volumes"))
]
Iterations = Annotated[
    int | None, typer.Option(help="Alternations at most.", show_default=_shown("iterations"))
]
Seed = Annotated[int | None, typer.Option(help="Of every random choice.", show_default=_shown("seed"))]

Scales = Annotated[
    str | None,
    typer.Option(
        metavar="PATCH@DOWNSAMPLE+...",
        help="Further scales, whose features stand behind those of the first: 8@2+12@2 are patches of 8 and "
        "of 12 pixels at half the resolution, 8/4@2:2 one at stride 4 with two bins; none for one scale.",
        show_default=_shown("scales"),
    ),
]

Mirror = Annotated[
    bool, typer.Option("--mirror", help="Train the classifier on mirror images of its samples as well.")
]

Cuts = Annotated[
    str,
    typer.Option(
        metavar="any+any|MS+MS",
        help="Train the classifier on beginnings of its samples as well, so that it decides early: one of "
        "each sample, of any length (any), two (any+any), or the first 33 and 67 ms of all (33+67).",
    ),
]
Shift = Annotated[
    int,
    typer.Option(
        min=0, help="Train the classifier on samples moved by so many pixels to each of four sides as well."
    ),
]

Kernel = Annotated[
    str,
    typer.Option(
        help="Of the classifier: linear; rbf, which is more accurate and takes about a millisecond for an "
        "emission (--emit event and --learn-online use the linear one beside it); or auto, rbf where samples "
        "are few enough and folds of them say that it is better.",
        autocompletion=completing("auto", "linear", "rbf"),
    ),
]

Groups = Annotated[
    str,
    typer.Option(
        help="Samples that stay on one side of a fold: block, neighbours in the order of their sources; "
        "source, those of one source; or none."
    ),
]


def setting_given(context: typer.Context) -> dict[str, Any]:
    """Arguments of `Setting` that a command's options amount to; those not given are the preset's.

    Raises:
        InputError: there is no such preset.
    """
    given = {name: context.params[name] for name in DEFAULTS if name in context.params}
    return preset_with(context.params["preset"], given)
