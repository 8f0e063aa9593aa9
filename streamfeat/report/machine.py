"""The machine that figures were measured on.

Lives here: its description, how far others disturbed what was measured, and how much memory it took.
Not here: measuring anything of streamfeat.
"""

import contextlib
import os
import platform
import resource
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

__all__ = ["Disturbance", "PeakMemory", "describe_machine"]

_CPUINFO, _STAT = Path("/proc/cpuinfo"), Path("/proc/stat")
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_STEAL = 7
"""Column of /proc/stat: time that the hypervisor gave to another machine."""
_GUEST = 8
"""Columns from here on are part of earlier ones."""


def describe_machine() -> dict[str, Any]:
    """Processor, cores that this process may use, system, and versions, as JSON values."""
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        **{name: version(name) for name in ("numba", "numpy", "streamfeat")},
    }


class Disturbance:
    """Disturbance of this process by others since it was made."""

    def __init__(self) -> None:
        """Start now."""
        self._start = _jiffies()
        self._preempted = _preemptions()

    def preemptions(self) -> int:
        """How often the system took the processor away to run something else."""
        return _preemptions() - self._preempted

    def steal_share(self) -> float | None:
        """Share of all processor time that went to other virtual machines, 0 to 1; None where unknown."""
        now = _jiffies()
        if self._start is None or now is None:
            return None
        total = sum(now) - sum(self._start)
        return (now[_STEAL] - self._start[_STEAL]) / total if total > 0 else 0.0


class PeakMemory:
    """The most memory this process held while the block ran, in `peak_mb` afterwards.

    Only Linux can forget an earlier peak; elsewhere it is that of the whole process.
    """

    peak_mb: int

    def __enter__(self) -> Self:
        """Forget the peak so far."""
        with contextlib.suppress(OSError):
            _CLEAR.write_text("5")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Read the peak."""
        if _STATUS.exists():
            lines = _STATUS.read_text().splitlines()
            kilobytes = [int(line.split()[1]) for line in lines if line.startswith("VmHWM")]
        else:
            # In bytes on macOS, in kilobytes elsewhere.
            unit = 1024 if platform.system() == "Darwin" else 1
            kilobytes = [resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // unit]
        self.peak_mb = round(kilobytes[0] * 1024 / 1e6)


def _cpu_model() -> str:
    if _CPUINFO.exists():
        for line in _CPUINFO.read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _preemptions() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_nivcsw


def _jiffies() -> list[int] | None:
    if not _STAT.exists():
        return None
    columns = _STAT.read_text().split("\n", 1)[0].split()[1:]
    return [int(column) for column in columns[:_GUEST]] if len(columns) > _STEAL else None
