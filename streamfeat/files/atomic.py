"""Where an output goes, and whole files that appear at once or not at all.

Lives here: what a path stands for (a file, what a link leads to, a device or pipe, an input), writing bytes
beside it and renaming. Not here: files that are written over a while (`outputs`), and any format.
"""

import contextlib
import os
import re
import stat
import tempfile
from collections.abc import Iterable, Iterator
from os import PathLike
from pathlib import Path

from streamfeat.errors import InputError

__all__ = [
    "followed",
    "is_replaced",
    "open_file_of",
    "refuse_input",
    "sweep",
    "unfinished",
    "unwritable",
    "write_atomically",
]

unfinished: set[Path] = set()
"""Files of this process that are being written and have no name yet."""

_SUFFIX = ".tmp"
_MOST_LINKS = 40
_DESCRIPTORS = re.compile(r"/dev/(?:stdin|stdout|stderr)|(?:/dev|/proc/self)/fd/\d{1,9}")
_STANDARD = {"stdin": 0, "stdout": 1, "stderr": 2}


def write_atomically(path: Path, data: bytes, *, private: bool = False) -> None:
    """Write `data` to `path`, on disk before an earlier file is replaced; `private` ones for this user alone.

    Raises:
        InputError: it cannot be written, for lack of room or of permission; an earlier file is as it was.
    """
    target = followed(path)
    try:
        if not is_replaced(path):
            number = open_file_of(target)
            with target.open("wb") if number is None else os.fdopen(os.dup(number), "wb") as file:
                file.write(data)
            return
        with _replacing(path, target, private) as temporary, temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise unwritable(path, error) from None


def open_file_of(path: Path) -> int | None:
    """The number of the open file of this process that a path such as `/dev/stdout` stands for."""
    if not _DESCRIPTORS.fullmatch(str(path)):
        return None
    return _STANDARD[path.name] if path.name in _STANDARD else int(path.name)


def unwritable(path: Path, error: OSError) -> InputError:
    """The error of an output that could be opened and now cannot be written."""
    return InputError(f"{path}: cannot be written: {error.strerror or error}; is there room?")


def is_replaced(path: Path) -> bool:
    """Whether an output takes the place of what is at `path`, or of nothing; not so for devices and pipes.

    Raises:
        InputError: it is a folder or a link to nothing.
    """
    target = followed(path)
    if open_file_of(target) is not None:
        return False
    try:
        mode = target.stat().st_mode
    except OSError:  # nothing yet, or what opening will tell of
        return True
    if stat.S_ISDIR(mode):
        raise InputError(f"{path}: is a folder; give the name of a file")
    return stat.S_ISREG(mode)


def refuse_input(output: Path, inputs: Iterable[str | PathLike[str] | object]) -> None:
    """Refuse an output that is one of the inputs, under whatever name; what is no path is passed over.

    Raises:
        InputError: it is one of them.
    """
    for one in inputs:
        with contextlib.suppress(OSError):
            if isinstance(one, str | PathLike) and output.samefile(one) and is_replaced(output):
                raise InputError(f"{output}: is read by this command and cannot be its output, too")


def sweep(path: Path) -> None:
    """Remove what writers of `path` that were killed have left beside it; for a file with one writer only."""
    left = re.compile(rf"\.{re.escape(path.name)}\.[a-z0-9_]+{re.escape(_SUFFIX)}")
    if path.parent.is_dir():
        for other in path.parent.iterdir():
            if left.fullmatch(other.name):
                other.unlink(missing_ok=True)


def followed(path: Path) -> Path:
    """The path that links lead to in the end; `/dev/stdout` and other open files of this process stay."""
    target = path.absolute()
    for _ in range(_MOST_LINKS):
        if open_file_of(target) is not None or not target.is_symlink():
            return target
        following = target.parent / target.readlink()
        if not following.is_symlink() and not following.exists():
            raise InputError(f"{path}: is a link to {following}, which is not there; remove the link")
        target = following
    raise InputError(f"{path}: is a link in a circle; remove it")


@contextlib.contextmanager
def _replacing(path: Path, target: Path, private: bool) -> Iterator[Path]:
    """A temporary path beside `target` that takes its place when the block ends without an error."""
    try:
        handle, name = tempfile.mkstemp(_SUFFIX, f".{target.name}.", target.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot write there: {error.strerror}") from error
    os.close(handle)
    temporary = Path(name)
    unfinished.add(temporary)
    try:
        yield temporary
        temporary.chmod(0o600 if private else 0o666 & ~_umask())
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
        unfinished.discard(temporary)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
