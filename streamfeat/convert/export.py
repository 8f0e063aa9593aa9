"""One recording to a file of another kind, or some of it.

Lives here: the counts of a conversion, and the limits of each kind of file.
Not here: reading (`streamfeat.recordings`), the kinds of files (`outputs`), data sets of many files
(`datasets`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from streamfeat.convert.outputs import open_output
from streamfeat.convert.selection import Selection
from streamfeat.errors import InputError
from streamfeat.files.atomic import refuse_input
from streamfeat.files.locations import Location, StoreLocation
from streamfeat.messages.packets import Label
from streamfeat.recordings.options import AS_IT_IS, ReadOptions
from streamfeat.recordings.reader import open_recording
from streamfeat.recordings.records import Losses

__all__ = ["Exported", "convert_recording"]


@dataclass(slots=True)
class Exported:
    """Counts of a conversion.

    Attributes:
        events: in the file.
        labels: in the file.
        labels_left_out: those that reach beyond the selection, or that the kind of file cannot hold.
        subtracted_us: from every time, where the kind of file cannot hold them as they are.
        removed: events taken out as noise, by reason.
        losses: what of the source could not be read.
        assumptions: what the source leaves open, a line for each.
        bytes_out: of the file.
    """

    events: int = 0
    labels: int = 0
    labels_left_out: int = 0
    subtracted_us: int = 0
    removed: dict[str, int] = field(default_factory=dict)
    losses: Losses = field(default_factory=Losses)
    assumptions: list[str] = field(default_factory=list)
    bytes_out: int = 0

    def result(self) -> dict[str, Any]:
        """The counts, as JSON values."""
        names = ("events", "labels", "labels_left_out", "subtracted_us", "bytes_out", "removed")
        return {name: getattr(self, name) for name in names}


def convert_recording(
    source: Location,
    target: Location,
    topic: str | None = None,
    reading: ReadOptions = AS_IT_IS,
    selection: Selection | None = None,
    *,
    overwrite: bool = False,
    encoding: str = "mono",
    compression: Literal["zstd", "lz4", "none"] = "zstd",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Exported:
    """Write a recording, or some of it, in the format that the ending of `target` says.

    Args:
        source: any recording, see `open_recording`.
        target: a local file: .mcap, .raw, .h5, .npz or .csv. It appears only when all is written.
        topic: of the events.
        reading: how to read it.
        selection: what of it; all if not given.
        overwrite: replace `target` where it exists.
        encoding: of the packets in MCAP, see `streamfeat.messages.codecs.PAYLOAD_ENCODINGS`.
        compression: of the chunks in MCAP.
        progress: called with items read and how many there are, 0 if that is unknown.

    Raises:
        InputError: the source cannot be read, nothing of it is left to write, or the kind of file cannot hold
            it.
    """
    if isinstance(target, StoreLocation):
        raise InputError(f"{target}: output is local; give a file, and copy it to the store")
    refuse_input(Path(target), [source])
    selection, done = selection or Selection(), Exported()
    formats: dict[str, Any] = {"overwrite": overwrite, "encoding": encoding, "compression": compression}
    with open_recording(source, topic, reading) as recording:
        with open_output(Path(target), **formats) as out:
            for item in selection.items(recording.played(loop=False, report=progress)):
                try:
                    if isinstance(item, Label):
                        out.label(item)
                        done.labels += out.holds_labels
                        done.labels_left_out += not out.holds_labels
                    else:
                        out.write(item.events, item.resolution)
                        done.events += len(item.events)
                except InputError as error:
                    known = str(error).startswith(str(target))
                    raise error if known else InputError(f"{source}: {error}") from None
            if done.events == 0:
                raise InputError(f"{source}: holds no events, or none is left; {target} was not written")
        done.labels_left_out += selection.labels_left_out
        done.subtracted_us, done.removed = out.shift_us, recording.removed
        done.losses, done.assumptions = recording.losses, recording.assumptions
    done.bytes_out = target.stat().st_size
    return done
