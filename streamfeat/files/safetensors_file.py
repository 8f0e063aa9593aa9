"""The safetensors files that models and classifiers are kept in.

Lives here: arrays and a JSON header, written whole, and read from untrusted bytes.
Not here: what the arrays mean; their reader checks shapes and ranges.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from streamfeat.errors import InputError
from streamfeat.files.atomic import write_atomically

__all__ = ["one_line", "read_safetensors", "write_safetensors"]


def write_safetensors(
    path: Path,
    kind: str,
    version: int,
    arrays: Mapping[str, NDArray[Any]],
    header: Mapping[str, Any],
    *,
    private: bool = False,
) -> None:
    """Write arrays and a JSON header as one file, which appears whole or not at all.

    Args:
        path: replaced if it exists.
        kind: what it is.
        versions: of its format, of which it must be one.
        arrays: by name.
        header: JSON values.
        private: readable by this user alone.
    """
    # safetensors writes the buffer of an array as it lies, so a transposed view would come back scrambled.
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    text = json.dumps({"format": kind, "version": version, **header})
    write_atomically(path, save(contiguous, metadata={"streamfeat": text}), private=private)


def one_line(error: BaseException) -> str:
    """The message of an exception on one line."""
    text = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
    return " ".join(text.split())


def read_safetensors(
    path: Path, kind: str | tuple[str, ...], *versions: int
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read all arrays of a safetensors file and the JSON header that streamfeat keeps with them.

    Args:
        path: the file.
        kind: what it must be, or several kinds of which it must be one.
        versions: of its format, of which it must be one.

    Raises:
        InputError: the file cannot be read, or its header is not of this kind and one of these versions.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {}).get("streamfeat", "null"))
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (
        OSError,
        SafetensorError,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        RecursionError,
    ) as error:
        raise InputError(f"{path}: not a readable safetensors file: {one_line(error)}") from error
    kinds = (kind,) if isinstance(kind, str) else kind
    if not isinstance(header, dict) or header.get("format") not in kinds:
        raise InputError(f"{path}: a safetensors file, but not a {kinds[0]} file")
    if header.get("version") not in versions:
        raise InputError(
            f"{path}: format version {header.get('version')!r}, this streamfeat reads version "
            f"{' and '.join(map(str, versions))}; "
            "make the file again"
        )
    return arrays, header
