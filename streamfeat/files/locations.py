"""Where input is: a path, or the URL of something in a store.

Lives here: what a URL is called and how it is shown, opening, listing and fetching through fsspec, and what
its errors mean.
Not here: any format; and output, which is local.

A plain path stays a `pathlib.Path` and costs nothing: fsspec is imported when a URL is opened. Credentials
and endpoints are found where fsspec and the store's own client look for them (environment, configuration
files), so there is no option for them.
"""

import io
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, cast

from streamfeat.errors import InputError

__all__ = [
    "Location",
    "StoreLocation",
    "absolute",
    "fetched",
    "files_below",
    "is_folder",
    "location_of",
    "natural_order",
    "open_binary",
    "size_of",
]

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*(::[A-Za-z][A-Za-z0-9+.-]*)*://")
_USER = re.compile(r"(?<=://)[^/\s'\"]*@")
_QUERY = re.compile(r"(https?://[^\s'\"?]*\?)[^\s'\"]*")
_BLOCK_BYTES = 4 << 20
_MOST_BLOCKS = 4
"""Of one file in memory. More than one, since records are looked at twice and lie across borders."""

_WHOLE_ONLY = "the store gives it as a whole only; put simplecache:: before the URL"
_OF_THE_EXTRA = frozenset(["fsspec", "s3fs", "aiobotocore", "botocore", "aiohttp"])


@dataclass(frozen=True, slots=True, repr=False)
class StoreLocation:
    """A URL that fsspec knows, also a chain of them (`simplecache::s3://bucket/key`).

    It is small, can be pickled, and holds nothing open. As text it has no user, no password and no query of
    a web address, where signatures are.

    Attributes:
        url: of the file, or of a folder that it is in.
        inside: its path in that folder, where its name holds `::`, which a URL has no way to say.
    """

    url: str
    inside: str = ""

    def __str__(self) -> str:
        """The URL as it may be shown."""
        return _shown(self.url) + (f"/{self.inside}" if self.inside else "")

    def __repr__(self) -> str:
        """As it may be shown, too: tracebacks and logs print this."""
        return f"StoreLocation({str(self)!r})"

    @property
    def name(self) -> str:
        """The part after the last slash."""
        if self.inside:
            return self.inside.rpartition("/")[2]
        # The first of a chain that has a path is what is read; those behind it are where it is kept.
        first = next(part for part in self.url.split("::") if "://" in part)
        path = first.partition("://")[2]
        if first.startswith("http"):
            path = re.split(r"[?#]", path)[0]
        return path.rstrip("/").rpartition("/")[2]

    @property
    def suffix(self) -> str:
        """The ending of the name, with its dot, as that of a path."""
        return Path(self.name).suffix


Location = Path | StoreLocation


def location_of(text: "str | PathLike[str] | StoreLocation") -> Location:
    """The location that a text names: a store for a URL, a path for everything else."""
    if isinstance(text, StoreLocation):
        return text
    if isinstance(text, str) and _URL.match(text):
        return StoreLocation(text)
    return Path(text)


def natural_order(name: str) -> list[tuple[int, str]]:
    """A key that sorts names as people do: 9 before 10."""
    return [(int(part), "") if i % 2 else (-1, part) for i, part in enumerate(re.split(r"(\d{1,18})", name))]


def absolute(place: Location) -> Location:
    """The same location, whatever the working directory."""
    return place.absolute() if isinstance(place, Path) else place


def open_binary(place: Location) -> BinaryIO:
    """Open a file to read at any byte.

    A file in a store is read in blocks of 4 MiB, of which 4 are held. Its reads give all bytes that are asked
    for, up to the end that the file had when it was opened, or raise `InputError`.

    Raises:
        InputError: it is not there, or cannot be opened.
    """
    if isinstance(place, StoreLocation):
        return cast(BinaryIO, _StoredFile(place))
    try:
        return place.open("rb")
    except OSError as error:
        raise InputError(f"{place}: cannot be opened: {error.strerror}") from None


def size_of(place: Location) -> int:
    """Bytes of a file.

    Raises:
        InputError: it is in a store and cannot be opened.
        OSError: it is local, and not there.
    """
    if isinstance(place, Path):
        return place.stat().st_size
    with open_binary(place) as file:
        return file.seek(0, os.SEEK_END)


def is_folder(place: Location) -> bool:
    """Whether a place is there and holds others.

    Raises:
        InputError: the store does not say.
    """
    if isinstance(place, Path):
        return place.is_dir()
    with _explaining(place):
        system, path = _system_of(place)
        return bool(system.isdir(path))


def files_below(folder: StoreLocation) -> list[tuple[StoreLocation, str]]:
    """All files in a folder, however deep, and for each its path from there, with forward slashes.

    Raises:
        InputError: the store does not list them.
    """
    with _explaining(folder):
        system, root = _system_of(folder)
        root = str(root).rstrip("/") + "/"
        names = [str(path).removeprefix(root) for path in system.find(root)]
    # The folder is in the first of a chain that has a path; what is below it goes there.
    before, separator, rest = folder.url.partition("://")
    there, *others = rest.split("::")

    def place(name: str) -> StoreLocation:
        if "::" in name:
            return StoreLocation(folder.url, name)
        return StoreLocation("::".join([f"{before}{separator}{there.rstrip('/')}/{name}", *others]))

    return [(place(name), name) for name in names]


@contextmanager
def fetched(place: Location) -> Iterator[Path]:
    """A local file with the content of a place: a path itself, or a copy that is there for the block only.

    Raises:
        InputError: the store does not give all of it, or there is no room for the copy.
    """
    if isinstance(place, Path):
        yield place
        return
    with tempfile.TemporaryDirectory(prefix="streamfeat-") as folder:
        path = Path(folder, place.name)
        try:
            with open_binary(place) as source, path.open("wb") as copy:
                shutil.copyfileobj(source, copy, _BLOCK_BYTES)
        except OSError as error:
            raise InputError(f"{place}: no copy in {folder}: {error.strerror}; is there room?") from None
        yield path


def _system_of(location: StoreLocation) -> tuple[Any, Any]:
    """The file system of fsspec that a URL means, and the path in it."""
    from fsspec.core import url_to_fs

    system, path = url_to_fs(location.url)
    return system, f"{str(path).rstrip('/')}/{location.inside}" if location.inside else path


class _StoredFile(io.BufferedIOBase):
    """A file that fsspec opened, with a position of its own and errors in one line."""

    def __init__(self, location: StoreLocation) -> None:
        self._location, self._at = location, 0
        with _explaining(location):
            # The system is kept, since one that is a file itself (an archive) is closed with it.
            self._system, path = _system_of(location)
            self._file: Any = self._system.open(
                path,
                "rb",
                block_size=_BLOCK_BYTES,
                cache_type="blockcache",
                cache_options={"maxblocks": _MOST_BLOCKS},
            )
            try:
                self._size = self._size_at(path)
            except BaseException:
                self._file.close()
                raise

    def _size_at(self, path: str) -> int:
        """Bytes of what was opened at a path of the system, if it is a file of which parts can be read."""
        try:
            size = int(self._file.seek(0, os.SEEK_END))
        except (ValueError, OSError):  # which kind depends on the store
            raise InputError(f"{self._location}: {_WHOLE_ONLY}") from None
        # A cache keeps what it had when its store went away, and takes that for the file the next time.
        expected = self._system.info(path).get("size") if "::" in self._location.url else size
        if expected not in (size, None):
            raise InputError(f"{self._location}: {size} of {expected} bytes were fetched; start again")
        return size

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = max(0, offset + (0, self._at, self._size)[whence])
        return self._at

    def read(self, size: int | None = -1) -> bytes:
        wanted = max(0, self._size - self._at)
        if size is not None and size >= 0:
            wanted = min(size, wanted)
        if not wanted:
            return b""
        with _explaining(self._location, f"byte {self._at}: "):
            # All files opened in fsspec's memory share one position.
            self._file.seek(self._at)
            data = bytes(self._file.read(wanted))
        if len(data) < wanted:
            # What is not given must not pass for the end of the file.
            raise InputError(
                f"{self._location}: byte {self._at}: the store gave {len(data)} of {wanted} bytes; "
                "has the file been replaced meanwhile?"
            )
        self._at += len(data)
        return data

    def close(self) -> None:
        if not self.closed and hasattr(self, "_file"):
            self._file.close()
        super().close()


@contextmanager
def _explaining(location: StoreLocation, where: str = "") -> Iterator[None]:
    """Turn whatever goes wrong into one line that says what to do.

    Stores raise errors of their clients' own, which have no common base and quote addresses with all that is
    in them.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = f"{location}: {where}{_shown(_reason(error))}"
    else:
        return
    raise InputError(reason)


def _reason(error: Exception) -> str:
    causes: list[BaseException] = [error]
    while causes[-1].__cause__:
        causes.append(causes[-1].__cause__)
    said = str(causes[-1]).partition("\n")[0] or type(causes[-1]).__name__
    statuses = [getattr(cause, "status", None) for cause in causes]
    if isinstance(error, ImportError):
        names = {(cause.name or "").partition(".")[0] for cause in causes if isinstance(cause, ImportError)}
        return f"{error}; pip install " + (
            "'streamfeat[store]'" if names & _OF_THE_EXTRA else "what is missing"
        )
    if isinstance(error, ValueError) and "rotocol not known" in said:
        return f"no such kind of URL: {said}"
    if isinstance(error, ValueError) and "range requests" in said:
        return _WHOLE_ONLY
    if type(causes[-1]).__name__ in ("NoCredentialsError", "PartialCredentialsError"):
        return (
            f"{said}; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or FSSPEC_S3_ANON=1 for what is public"
        )
    if isinstance(error, PermissionError) or {401, 403} & set(statuses):
        return f"the store refuses: {said}; give it credentials that may read this"
    if isinstance(error, FileNotFoundError) and (len(causes) == 1 or 404 in statuses or _is_404(causes[-1])):
        return "there is no such file; check the name, and that of the bucket"
    return f"cannot be read: {said}; is the store up, and can it be reached?"


def _is_404(error: BaseException) -> bool:
    """Whether this is the answer of an S3 server that has no such thing."""
    response = getattr(error, "response", None) or {}
    return bool(response.get("ResponseMetadata", {}).get("HTTPStatusCode") == 404)


def _shown(text: str) -> str:
    """Text without what is secret in the URLs in it."""
    return _QUERY.sub(r"\1...", _USER.sub("", text))
