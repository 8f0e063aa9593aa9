"""Files that are written over a while and appear when they are whole.

Lives here: `OutputFile`, the lock that a second writer meets, and writing into devices and pipes.
Not here: what a path stands for, files that are written at once (`atomic`), and any format.
"""

import contextlib
import errno
import io
import os
import time
import weakref
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self, cast

from streamfeat.errors import InputError
from streamfeat.files.atomic import followed, is_replaced, open_file_of, unfinished

try:
    import fcntl
except ImportError:  # a system without locks of this kind: two writers of one output are not told
    fcntl = None  # type: ignore[assignment]

__all__ = ["OutputFile", "locked_file", "remove_unfinished"]

_outputs: "weakref.WeakSet[OutputFile]" = weakref.WeakSet()
"""Of this process, whose parts are removed when it leaves in haste."""

_WAIT_S, _TURN_S = 10, 0.02
_FLAGS = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0)


class OutputFile:
    """A file that is written over a while and appears when it is whole; a context manager.

    Bytes go to `<name>.part`, which takes the name in `close`. The part is locked until then: a second writer
    of the same output, in this process or another, is refused. The lock ends with its process. A device, a
    pipe or `/dev/stdout` is written into as it is. A link stays: what it leads to is replaced.

    Example:
        >>> with OutputFile(Path("out.csv")) as output:
        ...     output.file.write(b"t_us,x,y,p\\n")

    Attributes:
        path: as it was given.
        file: to write to; it can be read and sought in, too, but for devices and pipes.
        part: the file that is written, None for devices and pipes.
    """

    def __init__(
        self,
        path: Path,
        *,
        suffix: str = ".part",
        keep_leftover: bool = False,
        private: bool = False,
        outlives: bool = False,
    ) -> None:
        """Open and lock the part.

        Args:
            path: of the output.
            suffix: what the part's name has after that of the output.
            keep_leftover: refuse to begin where a writer that was killed has left a part with something in
                it; it is overwritten otherwise.
            private: for this user's eyes alone, where a new file otherwise has the permissions of any other.
            outlives: `remove_unfinished` leaves the part, from which much can be saved.

        Raises:
            InputError: it is a folder or a link to nothing, its folder is not there, another writer is at
                work or has left something, or for another reason it cannot be written.
        """
        self.path = path
        self.part: Path | None = None
        try:
            self._target = followed(path)
            if is_replaced(path):
                self.part = self._target.with_name(self._target.name + suffix)
                self.file = locked_file(self.part, path, private=private)
            else:
                self.file = _opened_as_it_is(path)
        except OSError as error:
            raise InputError(f"{path}: cannot write there: {error.strerror}") from None
        if self.part and (keep_leftover and os.fstat(self.file.fileno()).st_size):
            self.file.close()
            raise InputError(
                f"{self.part}: left by a writer that did not finish; save it with `streamfeat recover`, or "
                "delete it"
            )
        if self.part:
            self.file.truncate(0)
            if not outlives:
                _outputs.add(self)

    def __enter__(self) -> Self:
        """Give the output itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Put the file into its place, or remove it after an exception."""
        if kind is None:
            self.close()
        else:
            self.abandon()

    def close(self) -> None:
        """Put the file into its place; a second call does nothing.

        Raises:
            OSError: what is left cannot be written; the part is removed then.
        """
        if self.file.closed:
            return
        try:
            self.file.flush()
            if self.part and fcntl:  # before the lock goes: no other writer may begin with this part
                self.part.replace(self._target)
            self.file.close()
            if self.part and not fcntl:
                self.part.replace(self._target)
        except BaseException:
            self.abandon()
            raise

    def abandon(self, *, keep: bool = False) -> None:
        """End without an output; remove the part, or `keep` what is in it."""
        if self.part and not keep and not self.file.closed:
            self.part.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # what is still buffered may be what there is no room for
            self.file.close()
        with contextlib.suppress(OSError):  # a second time closes what the first could not flush
            self.file.close()


def remove_unfinished() -> None:
    """Remove what is being written and not whole; for a process that ends with its next instruction."""
    parts = [output.part for output in list(_outputs) if output.part and not output.file.closed]
    for path in [*parts, *unfinished]:
        with contextlib.suppress(OSError):
            path.unlink()


def locked_file(path: Path, output: Path | None = None, *, private: bool = False) -> BinaryIO:
    """A file to read and write, from its start, with what is in it; empty if it was not there.

    It is locked until it is closed, or its process ends.

    Args:
        path: of the file.
        output: what to name where it cannot be opened, if not the file itself.
        private: readable by this user alone, if it was not there.

    Raises:
        InputError: another writer has it, or it cannot be opened.
    """
    while True:
        try:
            descriptor = os.open(path, _FLAGS, 0o600 if private else 0o666)
        except OSError as error:
            raise InputError(f"{output or path}: cannot write there: {error.strerror}") from None
        file = os.fdopen(descriptor, "r+b")
        try:
            if fcntl:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # What its writer has just renamed or removed is not the file of that name any more.
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        except BlockingIOError:
            file.close()
            raise InputError(f"{path}: another command is writing this output; give another name") from None
        except FileNotFoundError:
            pass
        except OSError:  # a file system without locks
            return file
        file.close()


def _opened_as_it_is(path: Path) -> BinaryIO:
    target = followed(path)
    number = open_file_of(target)
    descriptor = _opened_with_a_reader(path, target) if number is None else os.dup(number)
    return cast(BinaryIO, io.BufferedWriter(_Counted(descriptor, "wb")))


def _opened_with_a_reader(path: Path, target: Path) -> int:
    """Open a device or pipe; a pipe waits for its reader, but not for ever."""
    until = time.monotonic() + _WAIT_S
    while True:
        try:
            descriptor = os.open(target, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
        except OSError as error:
            if error.errno != errno.ENXIO:
                raise
            if time.monotonic() > until:
                raise InputError(f"{path}: nothing has opened this pipe to read it for {_WAIT_S} s") from None
            time.sleep(_TURN_S)
        else:
            os.set_blocking(descriptor, True)
            return descriptor


class _Counted(io.FileIO):
    """A device or pipe that says how many bytes were written to it, which formats with an index ask."""

    _n = 0

    def write(self, data: Any) -> int:
        n = super().write(data)
        self._n += n
        return n

    def seekable(self) -> bool:
        return False

    def tell(self) -> int:
        return self._n
