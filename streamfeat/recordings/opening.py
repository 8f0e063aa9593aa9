"""Which source a path leads to.

Lives here: telling formats apart. Not here: reading them (`mcap_source` and its neighbours).
"""

from os import PathLike

from streamfeat.files.locations import StoreLocation, location_of
from streamfeat.recordings.mcap_source import McapSource
from streamfeat.recordings.sources import Source

__all__ = ["open_source"]


def open_source(path: str | PathLike[str] | StoreLocation) -> Source:
    """Open whatever is at a path.

    Raises:
        InputError: it is missing, empty, or of no format that can be read.
    """
    return McapSource(location_of(path))
