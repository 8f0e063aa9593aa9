"""The machine that figures are of.

Lives here: processor, caches, governor, share of time stolen by the host, compiler, versions of packages.
Not here: the figures.
"""

import datetime
import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

__all__ = ["PEERS", "compiler_version", "describe", "version"]

PEERS = ("eventcv", "tonic", "river", "pandas", "spams-bin", "matplotlib", "torch")
"""Packages of the extra `bench` that parts can do without, one by one."""

_PACKAGES = ("streamfeat", "numpy", "numba", "scipy", "scikit-learn", "mcap", "lz4", *PEERS)


def describe(compiler: str | None) -> dict[str, Any]:
    """JSON values that say where and when figures were taken.

    Args:
        compiler: first line of what the C compiler says of itself.
    """
    processor = _processor_fields()
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "processor": processor.get("model name", platform.processor() or platform.machine()),
        "vector_extensions": [
            flag
            for flag in ("avx2", "avx512f", "avx512bw", "neon", "asimd")
            if flag in processor.get("flags", processor.get("Features", "")).split()
        ],
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "hypervisor": "hypervisor" in processor.get("flags", "").split(),
        "caches": _caches(),
        "governor": _read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor") or "not shown",
        "stolen_share_since_boot": _stolen_share(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "compiler": compiler or "none",
        "packages": {name: version(name) for name in _PACKAGES},
    }


def version(package: str) -> str:
    """Version of an installed package, or `missing`."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"


def compiler_version(compiler: str) -> str:
    """What a C compiler calls itself."""
    text = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=True).stdout
    return text.partition("\n")[0]


def _processor_fields() -> dict[str, str]:
    first = _read("/proc/cpuinfo").partition("\n\n")[0]
    pairs = (line.partition(":")[::2] for line in first.splitlines())
    return {name.strip(): value.strip() for name, value in pairs}


def _caches() -> dict[str, str]:
    """Size of each cache that one core sees."""
    found = {}
    for folder in sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*")):
        level, kind = _read(folder / "level"), _read(folder / "type")
        if kind in ("Data", "Unified"):
            found[f"L{level}"] = _read(folder / "size")
    return found


def _stolen_share() -> float:
    fields = [int(value) for value in _read("/proc/stat").partition("\n")[0].split()[1:9]]
    return round(fields[7] / max(1, sum(fields)), 4) if len(fields) == 8 else 0.0


def _read(path: str | Path) -> str:
    try:
        return Path(path).read_text(encoding="utf-8").strip()
    except OSError:
        return ""
