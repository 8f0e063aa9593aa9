"""The plan of an evaluation: methods, settings, and the cells of the resulting table.

Lives here: `Cell` and its `Trial`, the settings that each method uses, and sweeps as they are asked for.
Not here: the settings of learning (`learn.settings`), the work of a cell (`cell`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from streamfeat.classify.training import check_kernel
from streamfeat.classify.variants import Variant, parse_cuts, variants_of
from streamfeat.errors import InputError
from streamfeat.evaluate.published import PAPER_SWEEPS
from streamfeat.learn.settings import Setting, parse_patch

__all__ = [
    "METHODS",
    "TRAINING_PRESETS",
    "WITHOUT_KERNELS",
    "Cell",
    "Trial",
    "paper_sweeps",
    "parse_sweep",
    "plan_cells",
    "used_by",
]

METHODS = {
    "direct": "learned transform (direct formulation)",
    "inverse": "learned dictionary (inverse formulation)",
    "kmeans": "spherical k-means filters",
    "random": "random filters",
    "model": "a model that was learned before, the general one that ships without -m",
    "hats": "HATS, averaged time surfaces",
    "hots": "HOTS, three layers of time surfaces",
    "dart": "DART, words of log-polar descriptors",
    "est": "EST, a learned kernel on spikes and a small network trained from nothing, with labels",
    "hfirst": "HFirst, first spikes of oriented neurons",
    "gabor-snn": "Gabor-SNN, spikes of leaky oriented neurons",
    "counts": "count images",
}
"""Every method, and what it is."""

WITHOUT_KERNELS = frozenset({"hats", "hots", "dart", "est", "counts"})
"""Methods that have no encoder, and so nothing to compile first."""

_LEARNING = {"lambda0", "start", "rows", "iterations", "conditioning", "coherence", "log_det"}
_NOT_USED = {"inverse": {"rows", "conditioning", "log_det"}, "kmeans": _LEARNING, "random": _LEARNING}
_TRAINING = ("mirror", "cuts", "shift", "kernel", "test_mirror")
_OTHERS_USE = {
    "model": ("model", *_TRAINING),
    "hats": ("downsample", *_TRAINING),
    "hots": ("downsample", "seed", *_TRAINING),
    "dart": ("downsample", "seed", *_TRAINING),
    "est": ("downsample", "seed", *_TRAINING),
    "hfirst": ("downsample", *_TRAINING),
    "gabor-snn": ("downsample", *_TRAINING),
    "counts": _TRAINING,
}
"""Settings of methods that learn no filters here."""

_MOST_TIMES = 16
"""As many filters that may be learned to choose from."""

_SAME_IN_EVERY_FOLD = ("model", "counts")
"""Methods that take nothing from the samples, so that all folds share their features."""


TRAINING_PRESETS: dict[str, dict[str, Any]] = {"accurate": {"mirror": True, "kernel": "rbf"}}
"""What a preset means for training, beside what it means for learning (`learn.settings.PRESETS`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial(Setting):
    """The settings of a run: those of `learn`, and those of training the classifier.

    Attributes:
        model: path of the model that the method `model` takes; the general model that ships if empty.
        mirror: train on mirror images of the training samples as well.
        cuts: milliseconds after which samples are cut to be trained on as well, such as `33+67`.
        shift: pixels by which samples are moved to each side to be trained on as well.
        kernel: `linear`, `rbf`, or `auto` for the one that folds of the training samples say is better.
        test_mirror: add the scores of the mirror image of a sample that is scored.
        select: so many times as many filters are learned, of which the labels of training samples choose.
    """

    model: str = ""
    mirror: bool = False
    cuts: str = ""
    shift: int = 0
    kernel: str = "auto"
    test_mirror: bool = False
    select: int = 1

    def __post_init__(self) -> None:
        """Check the kernel, and all that `Setting` checks."""
        check_kernel(self.kernel)
        if not 1 <= self.select <= _MOST_TIMES:
            raise InputError(f"select is {self.select}, it must be from 1 to {_MOST_TIMES}")
        if self.select > 1 and self.scales != "none":
            raise InputError("filters are chosen among those of one scale; leave out --select or --scales")
        Setting.__post_init__(self)
        self.variants  # noqa: B018  (refuses what makes no sense)

    @property
    def variants(self) -> tuple[Variant, ...]:
        """What the classifier is trained on beside the samples themselves."""
        return variants_of(mirror=self.mirror, cuts=parse_cuts(self.cuts), shift=self.shift)


_DEFAULTS = {field.name: field.default for field in fields(Trial)}

SWEPT = tuple(name for name in _DEFAULTS if name != "formulation")
"""Settings that can be swept; the formulation is a method."""


def used_by(method: str) -> tuple[str, ...]:
    """Names of the values of a setting that mean something to a method."""
    if method in _OTHERS_USE:
        return _OTHERS_USE[method]
    return tuple(name for name in SWEPT if name not in {"model", *_NOT_USED.get(method, ())})


@dataclass(frozen=True, slots=True)
class Cell:
    """One run: a method in a setting on a fold; `swept` names what differs from the base, if anything.

    Settings that the method does not use have their defaults, so that equal runs are equal cells.
    """

    method: str
    setting: Trial
    fold: int
    swept: str = ""

    @property
    def used(self) -> dict[str, Any]:
        """The values that mean something to the method, for JSON."""
        return {name: getattr(self.setting, name) for name in used_by(self.method)}

    @property
    def key(self) -> dict[str, Any]:
        """JSON values that tell one cell from another."""
        return {"method": self.method, "setting": self.used, "fold": self.fold}

    def has_features_of(self, other: "Cell") -> bool:
        """Whether the same features serve both, so that they need not be made twice."""
        plain: dict[str, Any] = {name: _DEFAULTS[name] for name in _TRAINING}
        mine, others = (replace(cell.setting, **plain) for cell in (self, other))
        same_fold = self.fold == other.fold or self.has_features_of_all_folds
        return same_fold and (self.method, mine) == (other.method, others)

    @property
    def has_features_of_all_folds(self) -> bool:
        """Whether its features do not depend on which samples are held out."""
        return self.method in _SAME_IN_EVERY_FOLD


def parse_sweep(text: str) -> tuple[str, list[Any]]:
    """Name and values of a sweep such as `filters=1000,1500` or `encoding=soft,split`.

    Raises:
        InputError: the name is unknown, or a value is not of its kind.
    """
    name, _, values = text.partition("=")
    name = name.strip().replace("-", "_")
    if name not in SWEPT:
        raise InputError(f"--sweep {text}: {name!r} cannot be swept; choose one of {', '.join(SWEPT)}")
    parse, such_as = _OTHER_KINDS.get(name) or _KINDS[type(_DEFAULTS[name])]
    try:
        return name, list(dict.fromkeys(parse(part.strip()) for part in values.split(",")))
    except (ValueError, KeyError):
        raise InputError(f"--sweep {text}: give {such_as.format(name=name)}") from None


def _name(text: str) -> str:
    if not text:
        raise ValueError
    return text


def _truth(text: str) -> bool:
    return {"yes": True, "no": False}[text]


_KINDS: dict[type, tuple[Any, str]] = {
    int: (int, "integers, such as --sweep {name}=2,4,7"),
    str: (_name, "names, such as --sweep {name}=soft,split"),
    bool: (_truth, "yes and no, such as --sweep {name}=yes,no"),
    float: (float, "numbers, such as --sweep {name}=0.25,0.5"),
    type(None): (float, "numbers, such as --sweep {name}=0.25,0.5"),
}
"""By the type of the default: how a value is read, and what to give; None stands in for a number."""

_OTHER_KINDS: dict[str, tuple[Any, str]] = {
    "patch": (parse_patch, "patches, such as --sweep {name}=8,8x16,sensor"),
    "volume_bins": _KINDS[int],
}
"""By the name of a setting whose kind its default does not tell."""


def paper_sweeps() -> list[tuple[str, list[Any]]]:
    """The sweeps of the paper's third table, as from `parse_sweep`: filters, patch and bins."""
    return [(name, [*figures]) for name, figures in PAPER_SWEEPS.items()]


def plan_cells(
    methods: Sequence[str], base: Mapping[str, Any], sweeps: Sequence[tuple[str, list[Any]]], n_folds: int
) -> list[Cell]:
    """All cells: each method in the base setting, then each value of each sweep, all else as in the base.

    Args:
        methods: names of `METHODS`.
        base: arguments of `Trial`.
        sweeps: as from `parse_sweep`; for methods that use the name.
        n_folds: of the data.

    Raises:
        InputError: a method is unknown, a value is out of range, or nothing uses what is swept.
    """
    for method in methods:
        if method not in METHODS:
            raise InputError(f"method {method!r} is unknown; choose from {', '.join(METHODS)}")
    chosen = list(dict.fromkeys(methods))
    cells = [Cell(method, _setting(method, base), fold) for method in chosen for fold in range(n_folds)]
    for name, values in sweeps:
        users = [method for method in chosen if name in used_by(method)]
        if not users:
            raise InputError(f"--sweep {name}: none of {', '.join(chosen)} uses it")
        cells += [
            Cell(method, _setting(method, {**base, name: value}), fold, name)
            for value in values
            for method in users
            for fold in range(n_folds)
        ]
    return cells


def _setting(method: str, base: Mapping[str, Any]) -> Trial:
    used = {name: value for name, value in base.items() if name in used_by(method)}
    return Trial(formulation="inverse" if method == "inverse" else "direct", **used)
