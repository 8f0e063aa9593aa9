"""Files that appear whole or not at all.

Lives here: writing beside the target and renaming. Not here: any format.
"""

import contextlib
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

from streamfeat.errors import InputError

__all__ = ["replacing", "sweep", "write_atomically"]

_SUFFIX = ".tmp"


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block ends without an error.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """
    try:
        handle, name = tempfile.mkstemp(_SUFFIX, f".{path.name}.", path.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot write there: {error.strerror}") from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_atomically(path: Path, data: bytes) -> None:
    """Write `data` to `path`, on disk before an earlier file is replaced.

    Raises:
        InputError: it cannot be written, for lack of room or of permission; an earlier file is as it was.
    """
    try:
        with replacing(path) as temporary, temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error


def sweep(path: Path) -> None:
    """Remove what writers of `path` that were killed have left beside it; for a file with one writer only."""
    left = re.compile(rf"\.{re.escape(path.name)}\.[a-z0-9_]+{re.escape(_SUFFIX)}")
    if path.parent.is_dir():
        for other in path.parent.iterdir():
            if left.fullmatch(other.name):
                other.unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
