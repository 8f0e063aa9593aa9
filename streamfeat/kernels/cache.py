"""Where compiled kernels are kept, and when they are compiled again.

Lives here: the folder of machine code, which is named after a digest of all sources of kernels; where it may
stand; the removal of folders of earlier sources. Not here: how kernels are compiled (`compiled`).

numba alone compares the file that a kernel stands in, so that a kernel would go on with yesterday's code of
another kernel that it calls. It also numbers its files, so that two processes which compile one kernel for
different types at the same time can take each other's code (numba #4807); here a file is named after types.
"""

import contextlib
import functools
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator
from numba.core.dispatcher import Dispatcher

_HERE = Path(__file__).parent

_SOURCES = (_HERE, _HERE.with_name("events.py"))
"""What machine code is made from: the kernels, and the constants that they take from another room."""

_KEPT = 4
"""Folders that stay: of these sources, and of those last used before, as when branches are switched."""


@functools.cache
def digest() -> str:
    """16 hexadecimal digits for all that machine code depends on; numba itself compares the processor."""
    found = hashlib.sha256(numba.__version__.encode())
    found.update(f" {numba.config.BOUNDSCHECK} {numba.config.OPT}".encode())
    for source in _SOURCES:
        for path in sorted(source.glob("*.py")) if source.is_dir() else [source]:
            text = path.read_bytes()
            found.update(f" {path.name} {len(text)} ".encode() + text)
    return found.hexdigest()[:16]


@functools.cache
def folder() -> Path | None:
    """The folder of these sources' machine code, in the first of these that can be written to.

    `NUMBA_CACHE_DIR`; `__pycache__` beside the kernels; the user's cache (`XDG_CACHE_HOME` or `~/.cache`); a
    folder of this user among the temporary files. None: it is nowhere to be kept, and every process compiles.
    """
    for parent in _parents():
        try:
            return _usable(parent)
        except OSError:
            continue
    return None


def keep(dispatcher: Any) -> None:
    """Load what a kernel was compiled to, and keep what it will be compiled to.

    Nothing is done for a function of another folder, whose source is not in the digest.
    """
    if not isinstance(dispatcher, Dispatcher):  # a plain function: numba is switched off
        return
    if Path(dispatcher.py_func.__code__.co_filename).parent == _HERE and folder():
        dispatcher._cache = _KernelCache(dispatcher.py_func)


def _parents() -> Iterator[Path]:
    if numba.config.CACHE_DIR:
        yield Path(numba.config.CACHE_DIR)
    yield _HERE / "__pycache__"
    if (user := _user_cache()) is not None:
        yield user / "streamfeat"
    try:
        yield _private(Path(tempfile.gettempdir()))
    except OSError:
        return


def _user_cache() -> Path | None:
    given = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    try:
        path = given.expanduser()
    except RuntimeError:  # a user without a home
        return None
    return path if path.is_absolute() else None


def _private(parent: Path) -> Path:
    """A folder that this user alone can write to: what lies in it is run.

    Raises:
        OSError: it cannot be made, or belongs to somebody else.
    """
    path = parent / (f"streamfeat-{os.getuid()}" if hasattr(os, "getuid") else "streamfeat")
    path.mkdir(mode=0o700, exist_ok=True)
    about = path.lstat()
    if hasattr(os, "getuid") and (about.st_uid != os.getuid() or about.st_mode & 0o022):
        raise PermissionError(f"{path} can be written to by others")
    return path


def _usable(parent: Path) -> Path:
    path = parent / f"kernels-{digest()}"
    path.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=path).close()
    os.utime(path)
    _remove_unused(parent)
    return path


def _remove_unused(parent: Path) -> None:
    """Keep the folders used last; a process that still has one of the others compiles again."""
    found: list[tuple[float, Path]] = []
    for path in parent.iterdir():
        if re.fullmatch("kernels-[0-9a-f]{16}", path.name):
            with contextlib.suppress(FileNotFoundError):  # another process has just removed it
                found.append((path.stat().st_mtime, path))
    for _, path in sorted(found, reverse=True)[_KEPT:]:
        shutil.rmtree(path, ignore_errors=True)


class _Locator(_CacheLocator):
    """Tells numba the folder, and when what lies in it is of these sources."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file, self._line = file, function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> "_Locator":
        return cls(function, file)

    def get_cache_path(self) -> str:
        return str(folder())

    def get_source_stamp(self) -> str:
        return digest()

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Implementation(CompileResultCacheImpl):
    _locator_classes = (_Locator,)


class _KernelCache(FunctionCache):
    """The cache of one kernel; a file in it that is cut, or a full disk, costs time and nothing else."""

    _impl_class = _Implementation

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _FilesByTypes(self._impl)

    def load_overload(self, signature: Any, context: Any) -> Any:
        try:
            return super().load_overload(signature, context)
        except Exception:  # whatever unpickling makes of bytes that are not what was written
            return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        try:
            super().save_overload(signature, compiled)
        except OSError:
            return


class _FilesByTypes:
    """numba's index and data file, a pair for each set of argument types and processor."""

    def __init__(self, about: CompileResultCacheImpl) -> None:
        self._about = about

    def load(self, key: tuple[Any, ...]) -> Any:
        return self._files(key).load(key)

    def save(self, key: tuple[Any, ...], data: Any) -> None:
        files = self._files(key)
        files.flush()  # or a damaged index would be read
        files.save(key, data)

    def _files(self, key: tuple[Any, ...]) -> IndexDataCacheFile:
        locator = self._about.locator
        name = f"{self._about.filename_base}-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}"
        return IndexDataCacheFile(locator.get_cache_path(), name, locator.get_source_stamp())
