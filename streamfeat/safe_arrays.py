"""Reading the safetensors files that models and classifiers are kept in.

Lives here: arrays and a JSON header out of bytes that nobody has vouched for.
Not here: what the arrays mean; whoever asks for them checks shapes and ranges.
"""

import json
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from streamfeat.errors import InputError

__all__ = ["one_line", "read_safetensors"]


def one_line(error: BaseException) -> str:
    """What an exception says, on one line."""
    text = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
    return " ".join(text.split())


def read_safetensors(path: Path, kind: str, version: int) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read all arrays of a safetensors file and the JSON header that streamfeat keeps with them.

    Raises:
        InputError: the file cannot be read, or its header is not of this kind and version.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {}).get("streamfeat", "null"))
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, SafetensorError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: not a readable safetensors file: {one_line(error)}") from error
    if not isinstance(header, dict) or header.get("format") != kind:
        raise InputError(f"{path}: a safetensors file, but not a {kind} file")
    if header.get("version") != version:
        raise InputError(
            f"{path}: format version {header.get('version')!r}, this streamfeat reads version {version}; "
            "make the file again"
        )
    return arrays, header
