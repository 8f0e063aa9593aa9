"""What an engine adds to an environment that has NumPy.

Lives here: a fresh environment, and what is in it before and after. Needs a package index.
"""

import subprocess
import sys
import time
from argparse import Namespace
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from tools.compare_clusters.nodes import NotHereError

PACKAGES = {"ray": "ray", "dask": "distributed"}
_LIMIT_S = 300


def install(engine: str, arguments: Namespace) -> dict[str, Any]:
    """Packages, MB on disk and seconds that installing an engine adds."""
    folder = Path(arguments.folder) / "environment"
    _run(sys.executable, "-m", "venv", str(folder))
    (library,) = (folder / "lib").glob("python*/site-packages")
    program = str(folder / "bin" / "python")
    _pip(program, "numpy")
    before = _contents(library)
    began = time.perf_counter()
    _pip(program, PACKAGES[engine])
    seconds = time.perf_counter() - began
    after = _contents(library)
    return {"packages": after[0] - before[0], "mb": after[1] - before[1], "install_s": seconds}


def _contents(library: Path) -> tuple[int, float]:
    size = sum(path.stat().st_size for path in library.rglob("*") if path.is_file())
    return len(list(distributions(path=[str(library)]))), size / 1e6


def _pip(program: str, package: str) -> None:
    _run(program, "-m", "pip", "install", "-q", "--no-compile", "--disable-pip-version-check", package)


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=_LIMIT_S)
    if done.returncode:
        raise NotHereError(f"{' '.join(command)}: {(done.stderr.strip() or 'failed').splitlines()[-1]}")
