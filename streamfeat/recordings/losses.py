"""Losses of a pass over a recording.

Lives here: `Losses`. Not here: finding damage (`records`), and what was read but not used (`timeline`).
"""

from collections import Counter
from dataclasses import dataclass, field

from streamfeat.errors import printable

__all__ = ["Losses"]


@dataclass(slots=True)
class Losses:
    """Losses of one pass over a recording, by named reason."""

    counts: Counter[str] = field(default_factory=Counter)
    bytes: Counter[str] = field(default_factory=Counter)
    first: dict[str, str] = field(default_factory=dict)
    """For each reason, where it struck first and why."""
    removed: Counter[str] = field(default_factory=Counter)  # as noise, on request: no losses
    file: str = ""
    """Which of several files this is about; named where something struck first."""

    def add(self, reason: str, n_bytes: int, where: str, count: int = 1) -> None:
        """Count one loss."""
        self.counts[reason] += count
        self.bytes[reason] += n_bytes
        if reason not in self.first:
            self.first[reason] = printable(f"{self.file}, {where}" if self.file else where)

    def of(self, file: str) -> "Losses":
        """The same counts, for what one of several files lost."""
        return Losses(self.counts, self.bytes, self.first, self.removed, file)

    def add_all(self, others: "Losses") -> None:
        """Count the losses of another part of the same recording."""
        self.counts, self.bytes = self.counts + others.counts, self.bytes + others.bytes
        self.first, self.removed = others.first | self.first, self.removed + others.removed

    def __bool__(self) -> bool:
        """Whether anything was lost."""
        return bool(self.counts)
