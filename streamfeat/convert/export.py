"""One recording to a file of another kind, or some of it.

Lives here: what is counted on the way, and what a kind of file cannot hold.
Not here: reading (`streamfeat.recordings`), the kinds of files (`outputs`), data sets of many files
(`datasets`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from streamfeat.convert.outputs import Output
from streamfeat.convert.selection import Selection
from streamfeat.errors import InputError
from streamfeat.messages.packets import Label
from streamfeat.recordings.reader import Recording

__all__ = ["Exported", "export"]


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written.

    Attributes:
        events: in the file.
        labels: in the file.
        labels_left_out: for they reach beyond the selection, or the kind of file holds no labels.
        shift_us: subtracted from every time, where the kind of file cannot hold them as they are.
    """

    events: int
    labels: int
    labels_left_out: int
    shift_us: int


def export(
    recording: Recording,
    out: Output,
    selection: Selection,
    *,
    path: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Exported:
    """Write a recording, or some of it.

    Args:
        recording: an open one.
        out: from `open_output`.
        selection: what of it.
        path: of the output, named in errors.
        progress: called with items read and how many there are, 0 if that is unknown.

    Raises:
        InputError: nothing is left to write, or the kind of file cannot hold it.
    """
    n_events = n_labels = left_out = 0
    for item in selection.items(recording.played(loop=False, report=progress)):
        if isinstance(item, Label):
            n_labels += out.holds_labels
            left_out += not out.holds_labels
            out.label(item)
        else:
            n_events += len(item.events)
            out.write(item.events, item.resolution)
    if n_events == 0:
        raise InputError(f"{path}: not written: no event of {recording.path} is left")
    return Exported(n_events, n_labels, left_out + selection.labels_left_out, out.shift_us)
