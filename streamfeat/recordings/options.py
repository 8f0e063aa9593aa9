"""How a recording is to be read, where it does not say so itself or more is wanted than what is in it.

Lives here: `ReadOptions`, which every command that reads a recording takes.
Not here: what becomes of them (`opening`, `labels`, `streamfeat.denoise`).
"""

from dataclasses import dataclass, field

from streamfeat.camera_files.source import TableOptions
from streamfeat.denoise.stage import Denoising
from streamfeat.events import Resolution

__all__ = ["AS_IT_IS", "ReadOptions"]


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How to read a recording: facts that it lacks, and denoising. It is small and can be pickled.

    Attributes:
        columns: order of the columns of a table, such as `t,x,y,p`.
        time_unit: of the times of a table: `s`, `ms`, `us` or `ns`.
        resolution: `(height, width)` of a camera file, instead of what it says.
        labels: a label file, or a topic of texts, see `streamfeat.recordings.labels`.
        denoising: noise that is taken out before anything else looks at the events.

    Raises:
        InputError: columns, unit or resolution cannot be used.
    """

    columns: str | None = None
    time_unit: str | None = None
    resolution: Resolution | None = None
    labels: str | None = None
    denoising: Denoising = field(default_factory=Denoising)

    def __post_init__(self) -> None:
        """Check what is for tables, whether or not there will be one."""
        TableOptions(self.columns, self.time_unit, self.resolution)


AS_IT_IS = ReadOptions()
"""A recording as its files describe it."""
