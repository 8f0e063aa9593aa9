"""Labelling: intervals of a recording that get a name on the page, and the file that keeps them.

Lives here: the labels of one recording while they are made, what may be changed, undo, saving.
Not here: the format of the file (`streamfeat.recordings.labels`), the page and its player.

The page counts played seconds, see `player`; the file holds stream time in microseconds, which `--labels`
reads. Every change is saved at once, to a file that is replaced as a whole.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from threading import Lock
from typing import Any

from streamfeat.errors import InputError
from streamfeat.files.atomic import write_atomically
from streamfeat.messages.packets import Label
from streamfeat.recordings.labels import LabelTable, label_text, read_labels
from streamfeat.recordings.reader import Recording
from streamfeat.view.player import Piece

__all__ = ["LabelSheet", "identity_of", "label_path"]

_MOST_LABELS = 10_000
_MOST_CLASSES = 200
_MOST_LETTERS = 80
_MOST_UNDONE = 1_000
_HASHED_EVENTS = 1_000
_JITTER_US = 100_000
"""Packets that come out of order by less set no clock back."""
_REMARK = "recording"


def label_path(source: str) -> Path:
    """Where the labels of a recording are kept if nothing else is said: `drive.labels.csv` for `drive.mcap`.

    Raises:
        InputError: the recording is a URL or a pattern, beside which there is no such place.
    """
    if "://" in source or any(letter in source for letter in "*?["):
        raise InputError(f"{source}: say where its labels are kept, with -o LABELS.csv")
    path = Path(source)
    return path.with_name(f"{path.name if path.is_dir() else path.stem}.labels.csv")


def identity_of(recording: Recording) -> str:
    """Text by which a recording is known again: size, first event, and a hash of its first 1,000 events."""
    digest, left, first_us = hashlib.blake2b(digest_size=8), _HASHED_EVENTS, None
    for events in recording:
        first_us = int(events["t"][0]) if first_us is None else first_us
        for name in "xypt":
            digest.update(events[name][:left].astype("<i8").tobytes())
        left -= len(events)
        if left <= 0:
            break
    height, width = recording.resolution
    return f"{width}x{height} pixels, first event at {first_us} us, beginning {digest.hexdigest()}"


class LabelSheet:
    """The labels of a recording, changed by what the page asks for. Safe to use from several threads.

    Args:
        recording: what is labelled; read from here, and not closed.
        path: the label file; labels that are there already are gone on from.
        classes: names that the page offers from the start.

    Attributes:
        path: of the label file.
        OPERATIONS: what `do` can be asked for.

    Raises:
        InputError: the file is of another recording, or cannot be read.
    """

    OPERATIONS = frozenset({"label", "relabel", "unlabel", "undo", "class"})

    def __init__(self, recording: Recording, path: Path, classes: Sequence[str] = ()) -> None:
        """Read what is there; nothing is written before the first change."""
        self.path = path
        self._lock = Lock()
        self._identity = identity_of(recording)
        self._name = Path(str(recording.path)).name
        self._first_us = _first_us(recording)
        self._pieces: Sequence[Piece] = ()
        self._end_us = 0
        self._undo: list[tuple[Label, ...]] = []
        self._problem = self._failed = ""
        self._saved: bytes | None = None
        self._labels: tuple[Label, ...] = ()
        if path.exists():
            self._labels = self._read(path)
            self._saved = path.read_bytes()
        elif recording.is_labelled:
            self._labels = tuple(sorted(recording.labels, key=lambda label: label.start_us))
        if len(self._labels) > _MOST_LABELS:
            raise InputError(
                f"{path if self._saved else recording.path}: has {len(self._labels):,} labels; a page shows "
                f"up to {_MOST_LABELS:,}"
            )
        known = dict.fromkeys([*classes, *(label.label for label in self._labels)])
        self._classes = [_class_name(name) for name in known][:_MOST_CLASSES]

    def read_to(self, pieces: Sequence[Piece], end_us: int) -> None:
        """Take in how played time becomes stream time, as far as the recording has been read.

        Args:
            pieces: played time and stream time from which both go on alike, in order.
            end_us: played time that has been read.
        """
        with self._lock:
            self._pieces, self._end_us = pieces, end_us

    def do(self, asked: dict[str, Any]) -> None:
        """Make a change that the page asks for; what is refused is said in the next `record`.

        Args:
            asked: `op` is one of `label` (`start`, `end`, `label`), `relabel` (the same, and `at`), `unlabel`
                (`at`), `undo` and `class` (`label`). Times are played seconds; `at` is the label's key.
        """
        does: dict[str, Callable[[dict[str, Any]], None]] = {
            "label": self._add,
            "relabel": self._change,
            "unlabel": self._remove,
            "undo": self._take_back,
            "class": self._offer,
        }
        with self._lock:
            self._problem = ""
            try:
                does[asked["op"]](asked)
            except InputError as error:
                self._problem = str(error)

    def record(self) -> dict[str, Any]:
        """What the page shows, as JSON values; labels of times that are not read yet are left out."""
        with self._lock:
            labels = []
            for label in self._labels:
                start = self._played_us(label.start_us)
                if start is not None:
                    labels.append(
                        {
                            "at": label.start_us,
                            "start_s": start / 1e6,
                            "end_s": (start + label.duration_us) / 1e6,
                            "label": label.label,
                        }
                    )
            return {
                "file": self.path.name,
                "classes": self._classes,
                "labels": labels,
                "can_undo": bool(self._undo),
                "saved": self._saved is not None and not self._failed,
                "problem": self._failed or self._problem,
            }

    def result(self) -> dict[str, Any]:
        """How much was labelled, as JSON values."""
        with self._lock:
            seconds = Counter[str]()
            for label in self._labels:
                seconds[label.label] += label.duration_us
            return {
                "labels": str(self.path) if self._saved is not None else None,
                "samples": len(self._labels),
                "seconds_by_class": {name: round(us / 1e6, 3) for name, us in sorted(seconds.items())},
            }

    def check_saved(self) -> None:
        """See that the last change is in the file.

        Raises:
            InputError: it could not be written.
        """
        if self._failed:
            raise InputError(self._failed)

    def _read(self, path: Path) -> tuple[Label, ...]:
        table = read_labels(path)
        known = table.remarks.get(_REMARK)
        if known is not None and known.partition(": ")[2] != self._identity:
            raise InputError(
                f"{path}: holds labels of another recording, {known.partition(': ')[0]}; give another file "
                "with -o"
            )
        shift_us = self._first_us if table.clock == "first" else 0
        return tuple(self._placed(table, shift_us))

    def _placed(self, table: LabelTable, shift_us: int) -> Iterable[Label]:
        for label in table.labels:
            own = label.source.startswith(f"{table.path.name}:")
            label = replace(label, start_us=label.start_us + shift_us, source="" if own else label.source)
            if label.start_us + label.duration_us <= self._first_us:
                raise InputError(
                    f"{table.path}: {label.label!r} ends before the recording's first event; is it the file "
                    "of another recording? Give another with -o"
                )
            yield label

    def _add(self, asked: dict[str, Any]) -> None:
        if len(self._labels) >= _MOST_LABELS:
            raise InputError(f"there are {_MOST_LABELS:,} labels, as many as a page shows")
        self._put(self._interval(asked), self._labels)

    def _change(self, asked: dict[str, Any]) -> None:
        old = self._at(asked)
        new = self._interval(asked)
        others = tuple(label for label in self._labels if label is not old)
        self._put(replace(new, split=old.split, source=old.source), others)

    def _remove(self, asked: dict[str, Any]) -> None:
        old = self._at(asked)
        self._become(tuple(label for label in self._labels if label is not old))

    def _take_back(self, asked: dict[str, Any]) -> None:
        if not self._undo:
            raise InputError("there is nothing to take back")
        self._labels = self._undo.pop()
        self._save()

    def _offer(self, asked: dict[str, Any]) -> None:
        name = _class_name(asked.get("label"))
        if name not in self._classes:
            if len(self._classes) >= _MOST_CLASSES:
                raise InputError(f"there are {_MOST_CLASSES} classes, as many as a page offers")
            self._classes.append(name)

    def _at(self, asked: dict[str, Any]) -> Label:
        for label in self._labels:
            if label.start_us == asked.get("at"):
                return label
        raise InputError("that label is gone already")

    def _interval(self, asked: dict[str, Any]) -> Label:
        start_us, end_us = (self._stream_us(asked.get(name)) for name in ("start", "end"))
        if end_us <= start_us:
            raise InputError("an interval ends after its start, and within one run of the camera's clock")
        self._offer(asked)
        return Label(start_us, end_us - start_us, _class_name(asked.get("label")), "", "")

    def _put(self, new: Label, others: tuple[Label, ...]) -> None:
        labels = tuple(sorted((*others, new), key=lambda label: label.start_us))
        for first, second in pairwise(labels):
            if second.start_us < first.start_us + first.duration_us:
                other = first if second is new else second
                start = (self._played_us(other.start_us) or 0) / 1e6
                raise InputError(
                    f"{new.label} would overlap {other.label}, {start:.2f} to "
                    f"{start + other.duration_us / 1e6:.2f} s; a moment has one label"
                )
        self._become(labels)

    def _become(self, labels: tuple[Label, ...]) -> None:
        self._undo = [*self._undo[1 - _MOST_UNDONE :], self._labels]
        self._labels = labels
        self._save()

    def _save(self) -> None:
        text = label_text(self._labels, {_REMARK: f"{self._name}: {self._identity}"}).encode()
        self._failed = ""
        try:
            there = self.path.read_bytes() if self.path.exists() else None
            if there != self._saved:
                raise InputError(
                    f"{self.path}: was changed by another program; not saved. End, and begin again"
                )
            write_atomically(self.path, text)
            self._saved = text
        except (InputError, OSError) as error:
            self._failed = str(error)

    def _stream_us(self, played_s: Any) -> int:
        """Stream time of a played second."""
        if not isinstance(played_s, int | float) or not 0 <= played_s < 1e9:
            raise InputError("an interval has a start and an end")
        played_us = min(round(played_s * 1e6), self._end_us)
        earlier = [piece for piece in self._pieces if piece.played_us <= played_us]
        if not earlier:
            raise InputError("the recording has not been read so far yet; try again in a moment")
        stream_us = earlier[-1].stream_us + played_us - earlier[-1].played_us
        if any(before.stream_end_us > stream_us + _JITTER_US for before in earlier[:-1]):
            raise InputError(
                "the camera's clock was set back before this; convert this part alone, with --start, and "
                "label that"
            )
        return stream_us

    def _played_us(self, stream_us: int) -> int | None:
        """Played time of a stream time; None if that has not been read yet."""
        for piece in self._pieces:
            if stream_us < piece.stream_end_us:
                return max(piece.played_us + max(stream_us - piece.stream_us, 0), 0)
        return None


def _class_name(text: Any) -> str:
    name = " ".join(text.split()) if isinstance(text, str) else ""
    if not name:
        raise InputError("a class has a name")
    if len(name) > _MOST_LETTERS or not name.isprintable():
        raise InputError(f"the name of a class has up to {_MOST_LETTERS} letters")
    return name


def _first_us(recording: Recording) -> int:
    for events in recording:
        return int(events["t"][0])
    return 0
